//! Calibration files: read, and then either applied to a camera whose map stays finite over the sensor, or refused.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::calibrate::file;
use oapwatch::optics::Config;

fuzz_target!(|bytes: &[u8]| {
    oapwatch_fuzz::with_file(bytes, |path| {
        let Ok(calibration) = file::read(path) else {
            return;
        };
        let camera = Config::default().camera().expect("the default is a camera");
        let Ok(camera) = calibration.applied_to(&camera) else {
            return;
        };
        for sensor in [[0.0, 0.0], [0.015, 0.015], [-0.015, 0.007]] {
            let ground = camera.to_ground(sensor);
            assert!(ground.iter().all(|p| p.is_finite()), "{sensor:?} → {ground:?}");
            assert!(camera.spot_sigma_at(sensor) > 0.0);
        }
    });
});
