//! Configs: read or refused with a message; what is read is a camera or refused with a message.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::config::Config;

fuzz_target!(|bytes: &[u8]| {
    oapwatch_fuzz::with_file(bytes, |path| match Config::load(path) {
        Ok(config) => match config.optics.camera() {
            Ok(camera) => assert!(camera.spot_sigma_m > 0.0 && camera.noise_std_j > 0.0),
            Err(e) => assert!(!e.to_string().is_empty()),
        },
        Err(e) => assert!(!e.to_string().is_empty()),
    });
});
