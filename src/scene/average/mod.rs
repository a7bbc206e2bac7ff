//! Mean over the exposure of the factor that fading and pointing apply to a beam.

mod law;

use law::{MeanLaw, WORTH_FROM};
use rand::RngExt;
use rand_distr::Distribution;

use super::config::Scene;
use super::effect::Effect;
use super::effects::{Capture, Fades, Pointing, Turbulence};
use super::error::Error;
use super::moment::Moment;
use super::report::{Decisions, Status};
use crate::optics::Camera;
use crate::toml_file::Key;

#[derive(Debug)]
pub(super) enum Average {
    Constant(f64),
    /// One draw from the distribution of the mean, from the stream of this effect.
    OneDraw(Effect, MeanLaw),
    /// Each value drawn separately.
    Drawn {
        turbulence: Option<Turbulence>,
        pointing: Option<Pointing>,
        capture: Capture,
        count: usize,
    },
}

impl Average {
    pub fn new(
        scene: &Scene,
        camera: &Camera,
        steps: usize,
        peak: f64,
        decisions: &mut Decisions,
    ) -> Result<Self, Error> {
        let effects = &scene.effects;
        let w = scene.link.beam_radius_m;
        let fading = decisions.weigh(Effect::Fading, &effects.fading, |_| f64::INFINITY);
        let turbulence = match fading {
            Some(fading) => Some(fading.turbulence(&Key::new("effects.fading"))?),
            None => None,
        };
        let pointing = decisions.weigh(Effect::Pointing, &effects.pointing, |p| {
            let reach = |i: usize| 3.0 * p.jitter_m + p.boresight_m[i].abs();
            peak * 2.0 * (reach(0).powi(2) + reach(1).powi(2)) / (w * w)
        });
        let ratio = camera.lens_radius_m / w;
        let exact = decisions.weigh(Effect::ExactAperture, &effects.exact_aperture, |_| peak * ratio * ratio);
        let capture = match exact {
            Some(_) => {
                let reach = pointing.map_or(0.0, |p| p.boresight_m[0].hypot(p.boresight_m[1]) + 9.0 * p.jitter_m);
                let reason = format!(
                    "tabulated once over the miss; the flat form errs by about {:.1e}",
                    ratio * ratio
                );
                decisions.note(Effect::ExactAperture, Status::Folded, reason);
                Capture::exact(camera.lens_radius_m, w, reach)
            }
            None => Capture::Flat { beam_radius_m: w },
        };
        let count = scene.link.coherence_times();
        if turbulence.is_none() && pointing.is_none_or(|p| p.jitter_m == 0.0) {
            let miss = pointing.map_or(0.0, |p| p.boresight_m[0].powi(2) + p.boresight_m[1].powi(2));
            if pointing.is_some() {
                decisions.note(Effect::Pointing, Status::Folded, "a steady miss is one constant factor");
            }
            return Ok(Self::Constant(capture.at(miss)));
        }
        let fixed = match turbulence {
            Some(Turbulence::FromPath { .. }) => None,
            Some(Turbulence::Given(law)) => Some(Some(law)),
            None => Some(None),
        };
        let law = fixed
            .filter(|_| steps == 1 && count >= WORTH_FROM)
            .and_then(|law| MeanLaw::new(law, pointing.map(|p| (p, &capture)), count));
        let on = [
            (Effect::Fading, fading.is_some()),
            (Effect::Pointing, pointing.is_some()),
        ];
        let on = on.into_iter().filter(|o| o.1).map(|o| o.0);
        if let Some(law) = law {
            let from = if fading.is_some() {
                Effect::Fading
            } else {
                Effect::Pointing
            };
            for effect in on {
                let reason = format!(
                    "the mean of T_int/T_coh = {count} values is one draw from its distribution, tabulated once"
                );
                decisions.note(effect, Status::Folded, reason);
            }
            return Ok(Self::OneDraw(from, law));
        }
        for effect in on {
            let why = match (steps, fixed.is_none()) {
                (2.., _) => "the spot moves during the exposure",
                (_, true) => "their distribution depends on each emitter's range",
                _ => "too few values for a table",
            };
            let reason = format!("T_int/T_coh = {count} values an emitter, averaged: {why}");
            decisions.note(effect, Status::On, reason);
        }
        Ok(Self::Drawn {
            turbulence,
            pointing: pointing.cloned(),
            capture,
            count: count as usize,
        })
    }

    /// Pushes the mean factor of each of `steps` sub-frames.
    pub fn draw(&self, entity: u64, length_m: f64, steps: usize, at: Moment<'_>, out: &mut Vec<f64>) {
        let open = |effect| at.streams.open(effect, entity, at.k, at.ledger);
        match self {
            Self::Constant(factor) => out.resize(steps, *factor),
            Self::OneDraw(effect, law) => out.resize(steps, law.quantile(open(*effect).random())),
            Self::Drawn {
                turbulence,
                pointing,
                capture,
                count,
            } => {
                let mut fading = turbulence.map(|t| (Fades::new(t.law(length_m)), open(Effect::Fading)));
                let mut pointing = pointing.as_ref().map(|p| (p, open(Effect::Pointing)));
                let still = capture.at(0.0);
                let mut value = || {
                    let rho = fading
                        .as_mut()
                        .map_or(1.0, |(fades, stream)| fades.sample(&mut **stream));
                    let h = pointing
                        .as_mut()
                        .map_or(still, |(p, stream)| capture.at(p.squared_miss(&mut **stream)));
                    rho * h
                };
                // Value i holds for the share of the exposure from i/count to (i + 1)/count.
                let (mut drawn, mut current) = (0, 0.0);
                for s in 0..steps {
                    if *count >= steps {
                        let end = (s + 1) * count / steps;
                        let sum: f64 = (drawn..end).map(|_| value()).sum();
                        // Weighted so that the mean over the sub-frames is the mean of all values.
                        out.push(sum * steps as f64 / *count as f64);
                        drawn = end;
                    } else {
                        while drawn <= s * count / steps {
                            current = value();
                            drawn += 1;
                        }
                        out.push(current);
                    }
                }
            }
        }
    }
}
