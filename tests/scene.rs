//! Scenes from outside: files in, frames with truth out.

#[path = "scene/claims.rs"]
mod claims;
#[path = "scene/command.rs"]
mod command;
#[path = "scene/detector.rs"]
mod detector;
#[path = "scene/files.rs"]
mod files;
#[path = "scene/light.rs"]
mod light;
#[path = "scene/platform.rs"]
mod platform;
#[path = "scene/streams.rs"]
mod streams;

use oapwatch::scene::{Plan, Scene};

/// A scene from TOML; one that the test wrote itself must parse.
fn scene(text: &str) -> Scene {
    toml::from_str(text).unwrap_or_else(|e| panic!("{e}"))
}

fn plan(text: &str) -> Plan {
    Plan::compile(&scene(text), 20).unwrap_or_else(|e| panic!("{e}"))
}

/// Mean, variance (unbiased) of the values.
fn moments(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, variance)
}
