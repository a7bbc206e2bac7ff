//! Who has left their straight course.

use nalgebra::Vector2;

use crate::estimate::sequence::acceleration_bank::AccelerationBank;

/// Frames over which changes of an emitter's position are added up: the newest alone shows a corner, more of them a bend.
const MEMORIES: [f64; 3] = [1.0, 8.0, 32.0];
/// Squared standard deviations of such a sum from which an emitter has turned: by chance once in 270,000 frames, and what it costs is
/// the knowledge of one velocity. More leaves bends to the search of the window, which takes them for newcomers; 18 loses melted emitters.
pub(crate) const SURPRISE: f64 = 25.0;

/// A course counts as straight for t where t³ is this times the variance of the position over the acceleration's spectral density: the line that
/// fits it best then ends half a standard deviation from it.
const STRAIGHT: f64 = 5.0;
/// How long courses count as straight, s: of who goes straight on, and of who accelerates all the time.
const LONGEST_S: f64 = 40.0;
const SHORTEST_S: f64 = 0.3;

/// Changes added up over a memory: the older, the less they count.
#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    changes: Vector2<f64>,
    variance: f64,
}

impl Sum {
    fn add(&mut self, change: Vector2<f64>, kept: f64) {
        self.changes = kept * self.changes + change;
        self.variance = kept * kept * self.variance + 1.0;
    }

    /// Squared standard deviations.
    fn z2(&self) -> f64 {
        self.changes.norm_squared() / self.variance.max(1.0)
    }
}

/// How an emitter has strayed from its straight course over the last frames: sums of the changes of its position by each of them, in their
/// standard deviations, over memories of `MEMORIES` frames.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Straying {
    sums: [Sum; MEMORIES.len()],
    /// Variance of the position along an axis, σ².
    variance: f64,
    accelerations: AccelerationBank,
    /// Spectral density of the acceleration, σ²/s³.
    density: f64,
}

impl Straying {
    /// Takes a new frame's change, in its standard deviations, and the variance that the position has then along an axis, σ². Whether chance does
    /// not explain the changes of some memory.
    pub fn add(&mut self, change: Vector2<f64>, variance: f64) -> bool {
        self.variance = variance;
        for (sum, frames) in self.sums.iter_mut().zip(MEMORIES) {
            sum.add(change, 1.0 - 1.0 / frames);
        }
        self.sums.iter().any(|sum| sum.z2() > SURPRISE)
    }

    /// Takes where the frame at `time_s` alone shows it, σ, with the variance of each coordinate, σ². `unit` is 1 m in σ.
    pub fn see(&mut self, place: [f64; 2], variance: [f64; 2], time_s: f64, unit: f64) {
        let (place_m, variance_m2) = (place.map(|v| v / unit), variance.map(|v| v / (unit * unit)));
        self.accelerations.see(place_m, variance_m2, time_s);
        self.density = self.accelerations.density_m2_s3() * unit * unit;
    }

    /// The emitter has turned: what the frames have shown so far is of its course before.
    pub fn turn(&mut self) {
        self.sums = Default::default();
        self.accelerations.turn();
    }

    /// What it has shown of accelerations so far is forgotten.
    pub fn go_straight(&mut self) {
        (self.accelerations, self.density) = Default::default();
    }

    /// How long the course counts as straight, s.
    pub fn straight_s(&self) -> f64 {
        if self.density == 0.0 {
            return LONGEST_S;
        }
        (STRAIGHT * self.variance / self.density)
            .cbrt()
            .clamp(SHORTEST_S, LONGEST_S)
    }

    /// Spectral density of the acceleration, σ²/s³.
    pub fn acceleration(&self) -> f64 {
        STRAIGHT * self.variance / self.straight_s().powi(3)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::Straying;

    #[test]
    fn a_corner_and_a_bend_are_straying_and_noise_is_not() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut noise = || Vector2::from_fn(|_, _| StandardNormal.sample(&mut rng));
        let mut straying = Straying::default();
        let by_chance = (0..20_000).filter(|_| straying.add(noise(), 1.0)).count();
        assert!(by_chance <= 2, "{by_chance} times by chance");
        let frames_until = |bias: f64, noise: &mut dyn FnMut() -> Vector2<f64>| {
            let mut straying = Straying::default();
            (1..100).find(|_| straying.add(noise() + Vector2::new(bias, 0.0), 1.0))
        };
        assert_eq!(frames_until(9.0, &mut noise), Some(1));
        // Two standard deviations a frame are 5.3 of eight frames.
        let bend = frames_until(2.0, &mut noise).expect("a bend is seen");
        assert!((3..16).contains(&bend), "after {bend} frames");
    }
}
