//! The chances that noise has to look like an emitter in many frames, and what a source must bring against them.

use crate::estimate::sequence::course::courses;
use crate::estimate::sequence::local_quadratic::Energies;
use crate::estimate::sequence::window::Window;

/// Least decrease of the deviance that a source must bring when its energy is free in each of `frames` frames: the bound of χ² with that
/// many degrees of freedom (Laurent and Massart, 2000, eq. 4.3) that one frame exceeds as rarely as `single`, the penalty in a lone frame.
fn penalty(single: f64, frames: f64) -> f64 {
    let root = 0.5 * ((2.0 * single - 1.0).sqrt() - 1.0);
    frames + 2.0 * frames.sqrt() * root + 2.0 * root * root
}

/// The chances that noise has to look like an emitter in the frames of a window.
pub(crate) struct Chances {
    /// The penalty of a source in a lone frame.
    single: f64,
    /// Standard deviation of an unknown speed, σ/s.
    speed_std: f64,
    /// Times of the window's frames, s.
    times_s: Vec<f64>,
    now_s: f64,
}

impl Chances {
    pub fn new(window: &Window, single: f64) -> Self {
        Self {
            single,
            speed_std: window.unknown[1].sqrt(),
            times_s: window.snapshots.iter().map(|s| s.time_s).collect(),
            now_s: window.time_s,
        }
    }

    /// The penalty of a source born at `born_s` that lights `lit` frames. It pays for the straight courses it may have taken, and what many
    /// frames take for an emitter stays as long as they do.
    pub fn penalty(&self, born_s: f64, lit: f64) -> f64 {
        let first_s = self.times_s.first().map_or(self.now_s, |first| first.max(born_s));
        let frames = self.times_s.iter().filter(|t| **t >= born_s).count().max(1) as f64;
        let courses = courses(self.speed_std, self.now_s - first_s);
        penalty(self.single + 2.0 * (courses * frames).ln(), lit)
    }

    /// The height of a residual map of `frames` frames from which an emitter born at `born_s` is tried: its noise, and this share of what a
    /// source must bring beyond it.
    pub fn beyond_noise(&self, born_s: f64, frames: f64, energies: Energies, share: f64) -> f64 {
        let lit = energies.lit_by_noise() * frames;
        lit + share * (self.penalty(born_s, lit) - lit)
    }
}

#[cfg(test)]
mod tests {
    use super::{Chances, penalty};

    #[test]
    fn a_lone_frame_pays_the_penalty_of_a_frame_and_many_pay_for_their_noise_and_courses() {
        assert!((penalty(30.0, 1.0) - 30.0).abs() < 1e-9);
        let chances = Chances {
            single: 30.0,
            speed_std: 1.0,
            times_s: (0..10).map(|k| 0.1 * f64::from(k)).collect(),
            now_s: 0.9,
        };
        // Born with the newest frame: one frame, and no course.
        assert!((chances.penalty(0.9, 1.0) - 30.0).abs() < 1e-9);
        // Born with the first: ten frames, and 2.8² straight courses a σ apart.
        let since_first = chances.penalty(0.0, 1.0);
        assert!((since_first - 30.0 - 2.0 * (2.8f64.powi(2) * 10.0).ln()).abs() < 1e-9);
        // Each frame that it lights adds its own noise.
        let growth = chances.penalty(0.0, 5.0) - since_first;
        assert!((4.0..40.0).contains(&growth), "{growth}");
    }
}
