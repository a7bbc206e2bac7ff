//! Scene files: refused with a message, or compiled into a plan.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::scene::{Plan, Scene};

fuzz_target!(|bytes: &[u8]| {
    oapwatch_fuzz::with_file(bytes, |path| match Scene::load(path) {
        Ok(scene) => match Plan::compile(&scene, 1) {
            Ok(plan) => assert!(plan.rate_hz() > 0.0),
            Err(e) => assert!(!e.to_string().is_empty()),
        },
        Err(e) => assert!(!e.to_string().is_empty()),
    });
});
