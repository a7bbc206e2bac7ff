//! Measurements over many random stories: how often honest users raise an alert, how often and how soon an attack does, how
//! much error a calibration leaves, what zones and known lights hide, and what a fleet makes of users who walk on to the next access
//! point.

mod alone;
mod any_flights;
mod calibration;
mod crowds;
mod flights;
mod formats;
mod handover;
mod honest_cameras;
mod lamps;
mod lens;
mod light;
mod measured;
mod pixels;
mod places;
mod sequence;
mod smear;
mod zone_cost;
mod zones;

use crate::estimate;
pub use measured::{Measured, Say};

/// Something to measure.
pub struct Measurement {
    pub name: &'static str,
    /// Stories (devices of a calibration, frames of a format, walks of a cell), unless another number is asked for.
    pub stories: u64,
    run: Run,
}

type RunRows = fn(stories: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured;

enum Run {
    Whole(fn(stories: u64, seed: u64) -> Measured),
    /// Of the program with an estimator and its rules.
    With(fn(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured),
    /// The same, of the rows that are named; each is said as soon as it is measured.
    Rows(RunRows),
}

impl Measurement {
    /// Measures `stories` stories, whose seeds begin with `seed`; where a measurement has rows, those that `only` names, and says each; where
    /// frames are of pixels, with this estimator.
    pub fn run(&self, stories: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured {
        match self.run {
            Run::Whole(run) => run(stories, seed),
            Run::With(run) => run(stories, seed, estimator),
            Run::Rows(run) => run(stories, seed, only, estimator, say),
        }
    }
}

/// All measurements: of the monitor alone, through pixels, of the optics and the estimator.
pub const ALL: &[Measurement] = &[
    measurement("honest", 1000, alone::honest_users),
    measurement("intruder", 3000, alone::intruders),
    measurement("beyond", 3000, alone::beyond),
    measurement("drift", 300, alone::drifts),
    measurement("handover", 1000, handover::walks),
    measurement("lamp-or-beam", 100, light::lamp_or_beam),
    measurement("lamps", 40, lamps::lamps),
    measurement("headlights", 40, lamps::headlights),
    measurement("zones", 40, zones::known_lights_and_zones),
    with("honest-pixels", 15, pixels::honest_users),
    with("honest-crowd", 15, pixels::honest_crowd),
    with("honest-fading", 60, pixels::honest_fading),
    with("stranger", 1500, pixels::strangers),
    with("stranger-near", 300, pixels::strangers_near),
    with("stranger-in-crowd", 200, pixels::strangers_in_crowd),
    with("shadow", 10, pixels::shadows),
    with("shadow-fading", 10, pixels::shadows_fading),
    with("any-flights", 60, any_flights::flights),
    with("flights", 10, flights::flights),
    measurement("calibration", 5, calibration::error_left),
    rows("lens", 40, lens::uncalibrated),
    rows("lens-calibrated", 40, lens::calibrated),
    rows("lens-alerts", 30, honest_cameras::lenses),
    rows("sensor-alerts", 30, honest_cameras::sensors),
    with("sequence", 8, sequence::frames_together),
    measurement("smear", 100, smear::smears),
    measurement("formats", 200, formats::cost),
    measurement("crowds", 40, crowds::crowds),
];

const fn measurement(name: &'static str, stories: u64, run: fn(u64, u64) -> Measured) -> Measurement {
    Measurement {
        name,
        stories,
        run: Run::Whole(run),
    }
}

const fn with(name: &'static str, stories: u64, run: fn(u64, u64, &estimate::Config) -> Measured) -> Measurement {
    Measurement {
        name,
        stories,
        run: Run::With(run),
    }
}

const fn rows(name: &'static str, stories: u64, run: RunRows) -> Measurement {
    Measurement {
        name,
        stories,
        run: Run::Rows(run),
    }
}
