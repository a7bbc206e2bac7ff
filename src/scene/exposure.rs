//! Motion of a spot during an exposure, as sub-frames.

use super::config::Scene;
use super::effect::Effect;
use super::effects::{Shaker, Wander};
use super::error::Error;
use super::platform::Flight;
use super::population::Population;
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use crate::toml_file::Key;

#[derive(Debug)]
pub(super) struct Exposure {
    /// Number of sub-frames; 1 when nothing moves.
    pub steps: usize,
    pub time_s: f64,
    pub motion_blur: bool,
    pub shaker: Option<Shaker>,
    pub wander: Option<Wander>,
}

/// More sub-frames than this are refused.
const MOST_STEPS: f64 = 1024.0;

impl Exposure {
    pub fn new(
        scene: &Scene,
        population: &Population,
        flight: Option<&Flight>,
        streams: Streams,
        decisions: &mut Decisions,
        moved: impl Fn(f64) -> f64,
        z: f64,
    ) -> Result<Self, Error> {
        let effects = &scene.effects;
        let time_s = scene.link.integration_time_s;
        let field = Key::new("effects");
        // Eight sub-frames a period, or a correlation time, follow the motion; 1,024 are the most.
        let needed = |times: f64, field: Key, found: f64| {
            let steps = (8.0 * times).ceil();
            if steps <= MOST_STEPS {
                Ok((steps as usize).max(16))
            } else {
                Err(field.refuse(
                    "motion slow enough for 1024 sub-frames an exposure (T_int at most 128 of its times)",
                    found,
                ))
            }
        };
        let mut steps = 1;

        let vibration = decisions.weigh(Effect::Vibration, &effects.vibration, |all| {
            all.iter()
                .map(|v| moved(z * v.amplitude_rad[0].hypot(v.amplitude_rad[1])))
                .sum()
        });
        for (k, v) in vibration.into_iter().flatten().enumerate() {
            let field = field.item("vibration", k).at("frequency_hz");
            steps = steps.max(needed(time_s * v.frequency_hz, field, v.frequency_hz)?);
        }
        let wander = decisions
            .weigh(Effect::Wander, &effects.wander, |w| moved(z * 3.0 * w.std_rad))
            .cloned();
        if let Some(w) = &wander {
            steps = steps.max(needed(time_s / w.time_s, field.at("wander").at("time_s"), w.time_s)?);
        }
        let scale = scene.optics.plane_distance_m / scene.optics.altitude_m;
        let mut path = population.top_speed() * time_s * scale;
        if let Some(flight) = flight {
            let [speed, turn_rate] = flight.top_rates();
            let [width, height] = scene.optics.sensor_size_m;
            let corner = 0.5 * width.hypot(height);
            path += (speed * scale + turn_rate * z * (1.0 + (corner / z).powi(2))) * time_s;
        }
        let blur = decisions.weigh(Effect::MotionBlur, &effects.motion_blur, |_| moved(0.5 * path));
        if blur.is_some() {
            steps = steps.max(16);
        }
        for (effect, on) in [
            (Effect::Vibration, vibration.is_some()),
            (Effect::Wander, wander.is_some()),
            (Effect::MotionBlur, blur.is_some()),
        ] {
            if on {
                decisions.note(
                    effect,
                    Status::On,
                    format!("the spot moves: {steps} sub-frames an exposure"),
                );
            }
        }
        Ok(Self {
            steps,
            time_s,
            motion_blur: blur.is_some(),
            shaker: vibration.map(|v| Shaker::new(v, streams, &Ledger::default())),
            wander,
        })
    }

    /// Middle of sub-frame `s` of an exposure centred on `t`, s.
    pub fn middle(&self, t: f64, s: usize) -> f64 {
        self.part(t, s, self.steps)
    }

    /// Middle of part `s` of `parts` of an exposure centred on `t`, s.
    pub fn part(&self, t: f64, s: usize, parts: usize) -> f64 {
        t + self.time_s * ((s as f64 + 0.5) / parts as f64 - 0.5)
    }
}
