//! What the light of a beam says of its source: whether it scintillates as a beam through the air does, comes from a point as a beam does,
//! flickers as a lamp on the mains does, fades with another beam as a reflection of that does, or stays on the sensor while the camera
//! moves, as a glint does. Evidence in alerts; it decides nothing.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Vector2, Vector3};
use serde_json::{Value, json};

use crate::estimate::Flags;
use crate::geo::View;
use crate::monitor::stats::lamp_or_beam::{beam_over_lamp, point_over_lamp, stated, steady_over_flicker};
use crate::monitor::stats::moment_score::MomentScore;
use crate::monitor::stats::second_moment::{LENS_SCATTER, middle};
use crate::monitor::track::beam_track::Track;
use crate::monitor::track::tracker::Tracker;

/// Frames that are kept of each track, and frames from which anything is said.
const FRAMES: usize = 128;
const MIN_FRAMES: usize = 30;
/// Share of the frames that count as independent.
const INDEPENDENT: f64 = 0.5;
/// Twice the mains' frequencies, Hz.
const FLICKER_HZ: [f64; 2] = [100.0, 120.0];
/// −ln p from which a line in the spectrum or a correlation is named: one in 10⁵ for each of the pairs that are looked at.
const NAMED: f64 = 15.0;
/// Scatter of a reflection's offset from its beam, m, at most. Larger names neighbours, smaller misses ghosts of beams that move.
const OFFSET_STD_M: f64 = 0.5;

/// Scatter of what rests, m, per axis: a walker's step, and what a pose error leaves. Larger needs a camera that moves more.
const RESTS_STD_M: f64 = 0.5;

/// A track's light in one frame.
#[derive(Clone, Copy, Debug)]
struct Shown {
    frame: u64,
    ln_energy: f64,
    /// Of ln energy, by the detector's noise.
    noise: f64,
    moments: MomentScore,
    position: Vector2<f64>,
    /// Where a level camera would have it, m, where the camera moves: the place on the sensor.
    on_sensor: Option<Vector2<f64>>,
}

/// The newest frames of every track.
#[derive(Debug, Default)]
pub struct LightHistory {
    frame: u64,
    tracks: BTreeMap<u64, VecDeque<Shown>>,
}

/// A beam that another is a reflection of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ghost {
    /// The track of the beam.
    pub of: u64,
    pub offset_m: f64,
    pub correlation: f64,
    pub neg_log_p: f64,
}

impl LightHistory {
    /// Takes a frame.
    pub fn update(&mut self, tracker: &Tracker, view: &View) {
        self.frame += 1;
        self.tracks.retain(|id, _| tracker.get(*id).is_some());
        let incomplete = Flags::SATURATED | Flags::MASKED | Flags::NEAR_EDGE | Flags::OUT_OF_TIME;
        for track in tracker.tracks.iter().filter(|t| t.hit) {
            let detection = &track.detection;
            if !(detection.energy_j > 0.0) || detection.flags.intersects(incomplete) {
                continue;
            }
            let shown = Shown {
                frame: self.frame,
                ln_energy: detection.energy_j.ln(),
                noise: 1.0 / detection.snr.max(1.0),
                moments: detection.moments,
                position: detection.position,
                on_sensor: view.sight.is_some().then(|| {
                    let sensor = Vector2::from(view.to_sensor(detection.position.into()));
                    sensor * view.ground_scale()
                }),
            };
            let known = self.tracks.entry(track.id).or_default();
            known.push_back(shown);
            if known.len() > FRAMES {
                known.pop_front();
            }
        }
    }

    /// Scintillation, extent and flicker, with the likelihood of a beam's light over a lamp's.
    pub fn lamp_or_beam(&self, track: &Track, rate_hz: f64) -> Option<Value> {
        let shown = self.tracks.get(&track.id).filter(|s| s.len() >= MIN_FRAMES)?;
        let n = shown.len() as f64;
        let mean = shown.iter().map(|s| s.ln_energy).sum::<f64>() / n;
        let variance = shown.iter().map(|s| (s.ln_energy - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let noise = shown.iter().map(|s| s.noise * s.noise).sum::<f64>() / n;
        let lines = FLICKER_HZ.map(|hz| Some((hz, line(shown, mean, variance, hz, rate_hz)?)));
        let lines: Vec<(f64, f64)> = lines.into_iter().flatten().collect();
        let named = lines.iter().filter(|(_, neg_log_p)| *neg_log_p > NAMED);
        // A line has 2/n of its −ln p of the variance.
        let flickers: f64 = named.clone().map(|(_, neg_log_p)| 2.0 * neg_log_p / n).sum();
        let scintillates = variance * (1.0 - flickers).max(0.0);
        let strongest = lines.iter().map(|(_, neg_log_p)| *neg_log_p).max_by(f64::total_cmp);
        let extent = self.trace(track.id);
        let ratios = [
            Some(("scintillation", beam_over_lamp(scintillates, noise, INDEPENDENT * n))),
            extent.map(|(trace, variance)| ("extent", point_over_lamp(trace, variance))),
            strongest.map(|neg_log_p| ("mains_flicker", steady_over_flicker(neg_log_p, n))),
        ];
        let ratios: BTreeMap<&str, f64> = ratios.into_iter().flatten().collect();
        Some(json!({
            "frames": shown.len(),
            "scintillation_index": (scintillates - noise).max(0.0),
            "trace_sigma2": extent.map(|(trace, _)| trace),
            "mains_flicker": named.map(|(hz, neg_log_p)| json!({ "mains_hz": 0.5 * hz, "surprise": neg_log_p })).collect::<Vec<_>>(),
            "likelihood_ratio": stated(ratios.values().product()),
            "likelihood_ratios": ratios,
        }))
    }

    /// Trace of the second moments beyond what the other beams' spots show, and its variance, σ² and σ⁴.
    fn trace(&self, id: u64) -> Option<(f64, f64)> {
        let moments = |id: &u64| {
            let mut sum = MomentScore::default();
            self.tracks[id].iter().for_each(|s| sum.add(&s.moments));
            sum.solved()
        };
        let (own, cov) = self.tracks.contains_key(&id).then(|| moments(&id))??;
        let others = self
            .tracks
            .iter()
            .filter(|(other, s)| **other != id && s.len() >= MIN_FRAMES);
        let (usual, usual_cov) = middle(others.filter_map(|(other, _)| Some(moments(other)?.0)).collect());
        let along = Vector3::new(1.0, 0.0, 1.0);
        let lens = 2.0 * LENS_SCATTER * LENS_SCATTER;
        Some((
            along.dot(&(own - usual)),
            along.dot(&((cov + usual_cov) * along)) + lens,
        ))
    }

    /// Whether the light rests on the ground or on the sensor, where the camera moves: the likelihood of the first over the second.
    pub fn rests_in(&self, track: &Track) -> Option<Value> {
        let shown = self.tracks.get(&track.id)?;
        let on_sensor: Vec<Vector2<f64>> = shown.iter().filter_map(|s| s.on_sensor).collect();
        if on_sensor.len() < MIN_FRAMES {
            return None;
        }
        let in_world = variance_m2(shown.iter().filter(|s| s.on_sensor.is_some()).map(|s| s.position));
        let on_sensor_m2 = variance_m2(on_sensor.iter().copied());
        let independent = INDEPENDENT * on_sensor.len() as f64;
        let ln_ratio = independent * (on_sensor_m2 - in_world) / (RESTS_STD_M * RESTS_STD_M);
        Some(json!({
            "frames": on_sensor.len(),
            "on_ground_std_m": in_world.sqrt(),
            "on_sensor_std_m": on_sensor_m2.sqrt(),
            "likelihood_ratio": stated(ln_ratio.exp()),
        }))
    }

    /// The beam that the track fades with at a fixed offset.
    pub fn ghost_of(&self, track: &Track, tracker: &Tracker) -> Option<Ghost> {
        let own = self.tracks.get(&track.id).filter(|s| s.len() >= MIN_FRAMES)?;
        let brighter = tracker.tracks.iter().filter(|t| t.id != track.id);
        let brighter = brighter.filter(|t| t.detection.energy_j > track.detection.energy_j);
        let ghosts = brighter.filter_map(|t| reflection(own, self.tracks.get(&t.id)?, t.id));
        ghosts.max_by(|a, b| a.neg_log_p.total_cmp(&b.neg_log_p))
    }
}

/// Variance per axis, m².
fn variance_m2(places: impl Iterator<Item = Vector2<f64>> + Clone) -> f64 {
    let n = places.clone().count() as f64;
    let mean = places.clone().sum::<Vector2<f64>>() / n;
    0.5 * places.map(|p| (p - mean).norm_squared()).sum::<f64>() / n
}

/// −ln p of the line that light at `hz` makes in frames of `rate_hz`; none where it cannot be told from slow changes. White noise's
/// periodogram over its mean is exponential (Schuster, 1898).
fn line(shown: &VecDeque<Shown>, mean: f64, variance: f64, hz: f64, rate_hz: f64) -> Option<f64> {
    let alias_hz = (hz - rate_hz * (hz / rate_hz).round()).abs();
    let duration_s = shown.len() as f64 / rate_hz;
    // The mains' frequency wanders by 0.2 % at most, and so does its alias by as many Hz.
    if alias_hz * duration_s < 4.0 || variance <= 0.0 {
        return None;
    }
    let (mut re, mut im) = (0.0, 0.0);
    for s in shown {
        let (sin, cos) = (std::f64::consts::TAU * alias_hz * s.frame as f64 / rate_hz).sin_cos();
        re += (s.ln_energy - mean) * cos;
        im += (s.ln_energy - mean) * sin;
    }
    Some((re * re + im * im) / (shown.len() as f64 * variance))
}

/// Whether `own` is a reflection of `other`. Fisher (1921): artanh r of n pairs has variance 1/(n − 3).
fn reflection(own: &VecDeque<Shown>, other: &VecDeque<Shown>, of: u64) -> Option<Ghost> {
    let mut theirs = other.iter().peekable();
    let mut pairs: Vec<(Shown, Shown)> = Vec::with_capacity(own.len());
    for s in own {
        while theirs.next_if(|o| o.frame < s.frame).is_some() {}
        if let Some(o) = theirs.next_if(|o| o.frame == s.frame) {
            pairs.push((*s, *o));
        }
    }
    let n = pairs.len() as f64;
    if pairs.len() < MIN_FRAMES {
        return None;
    }
    let mean = |f: &dyn Fn(&(Shown, Shown)) -> f64| pairs.iter().map(f).sum::<f64>() / n;
    let (a, b) = (mean(&|p| p.0.ln_energy), mean(&|p| p.1.ln_energy));
    let product = mean(&|p| (p.0.ln_energy - a) * (p.1.ln_energy - b));
    let (aa, bb) = (
        mean(&|p| (p.0.ln_energy - a).powi(2)),
        mean(&|p| (p.1.ln_energy - b).powi(2)),
    );
    let correlation = product / (aa * bb).sqrt().max(1e-12);
    let offset = |p: &(Shown, Shown)| p.0.position - p.1.position;
    let usual = pairs.iter().map(offset).sum::<Vector2<f64>>() / n;
    let scatter = mean(&|p| (offset(p) - usual).norm_squared()).sqrt();
    let z = correlation.clamp(-0.999_999, 0.999_999).atanh() * (INDEPENDENT * n - 3.0).max(0.0).sqrt();
    let neg_log_p = if z > 0.0 { 0.5 * z * z } else { 0.0 };
    (neg_log_p > NAMED && scatter < OFFSET_STD_M).then_some(Ghost {
        of,
        offset_m: usual.norm(),
        correlation,
        neg_log_p,
    })
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use nalgebra::{Matrix2, UnitQuaternion};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::geo::Sight;
    use crate::monitor::track::detection::fixture::detection;
    use crate::optics::{self, Camera};
    use crate::pose::{Mount, Pose};

    fn camera() -> Camera {
        optics::Config::default().camera().unwrap()
    }

    /// 128 frames of lights at these x, whose ln energies `light` gives.
    fn watched(places: &[f64], rate_hz: f64, light: impl Fn(f64, &[f64]) -> Vec<f64>) -> (LightHistory, Tracker) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut history, mut tracker) = (LightHistory::default(), Tracker::new(50.0));
        for k in 0..128i64 {
            let t = k as f64 / rate_hz;
            let noise: Vec<f64> = (0..3).map(|_| StandardNormal.sample(&mut rng)).collect();
            let ln_energies = light(t, &noise);
            let beams = places.iter().zip(ln_energies).map(|(x, ln)| {
                let mut beam = detection(*x, 0.0);
                beam.energy_j = ln.exp();
                beam
            });
            let beams: Vec<_> = beams.collect();
            tracker.step(
                Timestamp::from_microsecond((t * 1e6) as i64).unwrap(),
                &beams,
                1.0 / rate_hz,
            );
            history.update(&tracker, &View::level(&camera()));
        }
        (history, tracker)
    }

    #[test]
    fn a_lamp_is_steady_and_a_beam_scintillates() {
        let (history, tracker) = watched(&[0.0, 50.0], 10.0, |_, z| vec![0.02 * z[0], 0.3 * z[1]]);
        let ratio = |k: usize| {
            let said = history.lamp_or_beam(&tracker.tracks[k], 10.0).unwrap();
            assert_eq!(said["mains_flicker"], json!([]));
            said["likelihood_ratio"].as_f64().unwrap()
        };
        assert!(ratio(0) < 1e-5 && ratio(1) > 1e5, "{} {}", ratio(0), ratio(1));
    }

    #[test]
    fn a_light_of_some_extent_is_no_beam() {
        let extents_sigma2 = [0.0, 0.0, 0.0, 0.5];
        let (mut history, mut tracker) = (LightHistory::default(), Tracker::new(50.0));
        for k in 0..40i64 {
            let beams = extents_sigma2.iter().zip(0u8..).map(|(extent, place)| {
                let mut beam = detection(50.0 * f64::from(place), 0.0);
                // What all spots show is the lens's.
                beam.moments = MomentScore::of_spread(Matrix2::identity() * (extent + 0.3), 100.0);
                beam
            });
            let beams: Vec<_> = beams.collect();
            tracker.step(Timestamp::from_millisecond(100 * k).unwrap(), &beams, 0.1);
            history.update(&tracker, &View::level(&camera()));
        }
        let said = |k: usize| {
            let said = history.lamp_or_beam(&tracker.tracks[k], 10.0).unwrap();
            let of = |value: &Value| value.as_f64().unwrap();
            (of(&said["trace_sigma2"]), of(&said["likelihood_ratios"]["extent"]))
        };
        let ((point, point_ratio), (wide, wide_ratio)) = (said(0), said(3));
        assert!(point.abs() < 1e-9 && (wide - 1.0).abs() < 1e-9, "{point} {wide}");
        // A lamp may be a point, so a point speaks for a beam by less than two.
        assert!(
            (1.0..2.0).contains(&point_ratio) && wide_ratio < 1e-5,
            "{point_ratio} {wide_ratio}"
        );
    }

    #[test]
    fn flicker_shows_where_the_frame_rate_does_not_hide_it() {
        let shows = |rate_hz: f64| {
            let flicker = |t: f64, z: &[f64]| vec![0.05 * (std::f64::consts::TAU * 100.0 * t).sin() + 0.02 * z[0]];
            let (history, tracker) = watched(&[0.0], rate_hz, flicker);
            let said = history.lamp_or_beam(&tracker.tracks[0], rate_hz).unwrap();
            let ratio = said["likelihood_ratio"].as_f64().unwrap();
            assert!(ratio < 1e-4, "{rate_hz}: {said}");
            said["mains_flicker"].clone()
        };
        assert_eq!(shows(70.0)[0]["mains_hz"], 50.0);
        assert_eq!(shows(330.0)[0]["mains_hz"], 50.0);
        assert_eq!(shows(100.0), json!([]));
        // All of the light's changes are the mains'.
        let (history, tracker) = watched(&[0.0], 70.0, |t, _| {
            vec![0.3 * (std::f64::consts::TAU * 100.0 * t).sin()]
        });
        let said = history.lamp_or_beam(&tracker.tracks[0], 70.0).unwrap();
        assert!(said["scintillation_index"].as_f64().unwrap() < 1e-3, "{said}");
        assert!(said["likelihood_ratio"].as_f64().unwrap() < 1e-5, "{said}");
    }

    #[test]
    fn a_glint_rests_on_the_sensor_while_the_camera_sways() {
        let camera = camera();
        let (mut history, mut tracker) = (LightHistory::default(), Tracker::new(50.0));
        for k in 0..100i32 {
            let t = 0.1 * f64::from(k);
            let pose = Pose {
                attitude: UnitQuaternion::from_euler_angles(0.05 * (0.8 * t).sin(), 0.04 * (0.7 * t).cos(), 0.0),
                ..Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, camera.altitude_m])
            };
            let sight = Sight::new(&pose, &Mount::default());
            let glint = sight.ground(&camera, [0.003, 0.002]).unwrap().horizontal_m();
            let view = View {
                camera: camera.clone(),
                sight: Some(sight),
            };
            let beams = [detection(-40.0, 10.0), detection(glint.x, glint.y)];
            tracker.step(Timestamp::from_millisecond(i64::from(k) * 100).unwrap(), &beams, 0.1);
            history.update(&tracker, &view);
        }
        let said = |k: usize| history.rests_in(&tracker.tracks[k]).unwrap();
        let (user, glint) = (said(0), said(1));
        assert!(user["likelihood_ratio"].as_f64().unwrap() > 1e5, "{user}");
        assert!(user["on_ground_std_m"].as_f64().unwrap() < 1e-9, "{user}");
        assert!(glint["likelihood_ratio"].as_f64().unwrap() < 1e-5, "{glint}");
        assert!(glint["on_sensor_std_m"].as_f64().unwrap() < 1e-6, "{glint}");
        let (history, tracker) = watched(&[0.0], 10.0, |_, z| vec![0.1 * z[0]]);
        assert_eq!(
            history.rests_in(&tracker.tracks[0]),
            None,
            "a camera that stands tells nothing"
        );
    }

    #[test]
    fn a_ghost_fades_with_its_beam() {
        let (history, tracker) = watched(&[0.0, 20.0, 60.0], 10.0, |_, z| {
            vec![0.3 * z[0], 0.3 * z[0] + 0.05 * z[1] - 3.0, 0.3 * z[2] - 3.0]
        });
        let ghost = history.ghost_of(&tracker.tracks[1], &tracker).unwrap();
        assert_eq!((ghost.of, ghost.offset_m.round()), (1, 20.0));
        assert!(ghost.correlation > 0.95);
        assert_eq!(history.ghost_of(&tracker.tracks[2], &tracker), None);
        assert_eq!(history.ghost_of(&tracker.tracks[0], &tracker), None);
    }
}
