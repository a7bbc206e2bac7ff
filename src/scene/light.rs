//! From a beam to the spots that it leaves on the sensor during one exposure.

use rand::RngExt;
use rand_distr::Distribution;

use super::average::{MeanLaw, WORTH_FROM};
use super::config::Scene;
use super::effects::{Capture, Fades, Pointing, Pose, Shaker, Turbulence, Wander, attitude};
use super::error::{Error, Field};
use super::population::{Beam, Population};
use super::render::Spot;
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use super::{Attenuation, Effect, Vignetting};
use crate::optics::{Camera, geometry, psf};

/// Everything between a beam and its spots.
#[derive(Debug)]
pub(super) struct Light {
    /// The camera as it is, not as its data sheet has it.
    pub lens: Camera,
    /// T_int · η_s · τ · (2/(π w_z²)) · π r_a²: energy per watt of a beam straight below that does not miss, J/W.
    straight_j_per_w: f64,
    attenuation: Option<Attenuation>,
    average: Average,
    pose: Option<Pose>,
    vignetting: Option<Vignetting>,
    exposure: Exposure,
}

/// How the spot moves while the shutter is open.
#[derive(Debug)]
struct Exposure {
    /// Number of sub-frames; 1 when nothing moves.
    steps: usize,
    time_s: f64,
    motion_blur: bool,
    shaker: Option<Shaker>,
    wander: Option<Wander>,
}

/// The mean over the exposure of what fading and pointing leave of a beam.
#[derive(Debug)]
enum Average {
    Constant(f64),
    /// One draw from the mean's own law, from the stream of this effect.
    OneDraw(Effect, MeanLaw),
    /// Every value by itself.
    Drawn {
        turbulence: Option<Turbulence>,
        pointing: Option<Pointing>,
        capture: Capture,
        count: usize,
    },
}

/// What the beams of one frame share, and room to work in.
#[derive(Debug, Default)]
pub(super) struct Shot {
    rotation: attitude::Rotation,
    /// Common shift of the angles in each sub-frame, rad.
    shaken: Vec<[f64; 2]>,
    wandered: Vec<[f64; 2]>,
    factors: Vec<f64>,
}

/// Frame number, time and where its randomness comes from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment<'a> {
    pub k: u64,
    pub t: f64,
    pub streams: Streams,
    pub ledger: &'a Ledger,
}

/// More sub-frames than this are refused.
const MOST_STEPS: f64 = 1024.0;
/// The steepest slope of a unit Gaussian, exp(−1/2).
const STEEPEST: f64 = 0.606_530_659_712_633_4;

/// Energy of the brightest pixel that a beam of the scene is likely to leave, J: the strongest beam straight below, unfaded.
pub(super) fn brightest_pixel(scene: &Scene, camera: &Camera) -> f64 {
    let own = scene
        .user
        .iter()
        .map(|u| u.power_w)
        .chain(scene.intruder.iter().map(|i| i.power_w));
    let strongest = own.flatten().fold(scene.link.power_w, f64::max);
    let share = |pitch: f64| psf::pixel_fraction(-0.5 * pitch, 0.5 * pitch, 0.0, camera.spot_sigma_m);
    straight_j_per_w(scene, camera) * strongest * share(camera.x.pitch_m) * share(camera.y.pitch_m)
}

fn straight_j_per_w(scene: &Scene, camera: &Camera) -> f64 {
    let link = &scene.link;
    let flat = crate::optics::radiometry::flat_aperture_fraction(camera.lens_radius_m, link.beam_radius_m, 0.0);
    link.integration_time_s * link.efficiency * link.transmittance * flat
}

impl Light {
    pub fn new(
        scene: &Scene,
        camera: &Camera,
        population: &Population,
        streams: Streams,
        decisions: &mut Decisions,
    ) -> Result<Self, Error> {
        let ledger = Ledger::default();
        let effects = &scene.effects;
        let peak = brightest_pixel(scene, camera);
        let sigma = camera.spot_sigma_m;
        let z = camera.plane_distance_m;
        let corner = camera.x.half_width().hypot(camera.y.half_width());
        // A spot that moves by d changes no pixel by more than the steepest slope of its profile allows.
        let moved = |d: f64| peak * STEEPEST * d / sigma;

        let far = geometry::link_length(camera.altitude_m, camera.to_ground([corner, 0.0]));
        let attenuation = decisions
            .weigh(Effect::Attenuation, &effects.attenuation, |a| {
                peak * (1.0 - a.transmittance(far))
            })
            .cloned();
        if attenuation.is_some() {
            decisions.note(
                Effect::Attenuation,
                Status::On,
                "one exponential an emitter, for its own path",
            );
        }

        let exposure = Exposure::new(scene, population, streams, decisions, moved, z)?;
        let average = Average::new(scene, camera, exposure.steps, peak, decisions)?;

        let tilted = |angle: f64| moved(z * angle * (1.0 + (corner / z).powi(2)));
        let pose = decisions.weigh(Effect::Attitude, &effects.attitude, |a| {
            let reach = |i: usize| 3.0 * a.tilt_std_rad[i] + a.tilt_bias_rad[i].abs();
            tilted(reach(0).hypot(reach(1))) + moved(corner * (3.0 * a.yaw_std_rad + a.yaw_bias_rad.abs()))
        });
        if pose.is_some() {
            decisions.note(
                Effect::Attitude,
                Status::On,
                "one rotation a frame, common to all spots",
            );
        }
        let pose = pose.map(|a| Pose::new(a, streams, &ledger));

        let mut lens = camera.clone();
        let distortion = decisions.weigh(Effect::Distortion, &effects.distortion, |d| {
            let [x, y] = d
                .lens()
                .project(z, [camera.x.half_width() / z, camera.y.half_width() / z]);
            moved((x - camera.x.half_width()).hypot(y - camera.y.half_width())) + 2.0 * peak * d.spot_growth.abs()
        });
        if let Some(distortion) = distortion {
            lens.distortion = distortion.lens();
            lens.spot_growth = distortion.spot_growth;
            decisions.note(
                Effect::Distortion,
                Status::On,
                "moves the centre of each spot, not its pixels",
            );
        }

        let vignetting = decisions
            .weigh(Effect::Vignetting, &effects.vignetting, |v| peak * v.corner_loss)
            .cloned();
        if vignetting.is_some() {
            decisions.note(
                Effect::Vignetting,
                Status::On,
                "one factor a spot; the background's is in its image",
            );
        }
        Ok(Self {
            lens,
            straight_j_per_w: straight_j_per_w(scene, camera),
            attenuation,
            average,
            pose,
            vignetting,
            exposure,
        })
    }

    /// Share of the light that the lens passes at a sensor position.
    pub fn passed(&self, sensor: [f64; 2]) -> f64 {
        let ratio = || self.lens.corner_ratio2(sensor);
        self.vignetting.as_ref().map_or(1.0, |v| v.passed(ratio()))
    }

    /// Prepares what all beams of a frame share.
    pub fn open(&self, at: Moment<'_>, shot: &mut Shot) {
        if let Some(pose) = &self.pose {
            shot.rotation = pose.at(at.k, at.t, at.streams, at.ledger);
        }
        if let Some(shaker) = &self.exposure.shaker {
            shot.shaken.clear();
            let times = (0..self.exposure.steps).map(|s| self.exposure.middle(at.t, s));
            shot.shaken.extend(times.map(|t| shaker.at(t)));
        }
    }

    /// Adds the spots of one beam; gives their energy, J (`lens_power_user`, collected over T_int).
    pub fn cast(
        &self,
        beam: &Beam,
        population: &Population,
        at: Moment<'_>,
        shot: &mut Shot,
        out: &mut Vec<Spot>,
    ) -> f64 {
        let length_m = geometry::link_length(self.lens.altitude_m, beam.ground);
        let mut energy = self.straight_j_per_w * beam.power_w * self.lens.altitude_m / length_m;
        if let Some(attenuation) = &self.attenuation {
            energy *= attenuation.transmittance(length_m);
        }
        let steps = self.exposure.steps;
        shot.factors.clear();
        self.average.draw(beam.entity, length_m, steps, at, &mut shot.factors);
        if let Some(wander) = &self.exposure.wander {
            shot.wandered.resize(steps, [0.0; 2]);
            let mut stream = at.streams.open(Effect::Wander, beam.entity, at.k, at.ledger);
            wander.fill(self.exposure.time_s / steps as f64, &mut shot.wandered, &mut *stream);
        }
        let mut total = 0.0;
        for s in 0..steps {
            let ground = match beam.actor {
                Some(actor) if self.exposure.motion_blur => population.position(actor, self.exposure.middle(at.t, s)),
                _ => beam.ground,
            };
            let mut tangents = self.lens.tangents(ground);
            if self.pose.is_some() {
                tangents = shot.rotation.apply(tangents);
            }
            if self.exposure.shaker.is_some() {
                tangents = attitude::tilt(tangents, shot.shaken[s]);
            }
            if self.exposure.wander.is_some() {
                tangents = attitude::tilt(tangents, shot.wandered[s]);
            }
            let centre = self.lens.distortion.project(self.lens.plane_distance_m, tangents);
            let energy_j = energy * shot.factors[s] / steps as f64 * self.passed(centre);
            total += energy_j;
            out.push(Spot {
                centre,
                sigma_m: self.lens.spot_sigma_at(centre),
                energy_j,
            });
        }
        total
    }
}

impl Exposure {
    fn new(
        scene: &Scene,
        population: &Population,
        streams: Streams,
        decisions: &mut Decisions,
        moved: impl Fn(f64) -> f64,
        z: f64,
    ) -> Result<Self, Error> {
        let effects = &scene.effects;
        let time_s = scene.link.integration_time_s;
        let field = Field::new("effects");
        // Eight sub-frames a period, or a correlation time, follow the motion; 1,024 are the most.
        let needed = |times: f64, field: Field, found: f64| {
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
        let path = population.top_speed() * time_s * scale;
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
    fn middle(&self, t: f64, s: usize) -> f64 {
        t + self.time_s * ((s as f64 + 0.5) / self.steps as f64 - 0.5)
    }
}

impl Average {
    fn new(scene: &Scene, camera: &Camera, steps: usize, peak: f64, decisions: &mut Decisions) -> Result<Self, Error> {
        let effects = &scene.effects;
        let w = scene.link.beam_radius_m;
        let fading = decisions.weigh(Effect::Fading, &effects.fading, |_| f64::INFINITY);
        let turbulence = match fading {
            Some(fading) => Some(fading.turbulence(&Field::new("effects.fading"))?),
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
                let reason =
                    format!("the mean of T_int/T_coh = {count} values is one draw from its own law, tabulated once");
                decisions.note(effect, Status::Folded, reason);
            }
            return Ok(Self::OneDraw(from, law));
        }
        for effect in on {
            let why = match (steps, fixed.is_none()) {
                (2.., _) => "the spot moves meanwhile",
                (_, true) => "their law depends on each emitter's range",
                _ => "too few for a table to pay",
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
    fn draw(&self, entity: u64, length_m: f64, steps: usize, at: Moment<'_>, out: &mut Vec<f64>) {
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
