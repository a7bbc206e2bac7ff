//! Who has left their straight course.

use nalgebra::{Matrix2, Vector2};

use crate::estimate::sequence::restlessness::Restlessness;

/// Frames over which changes of an emitter's position are added up: the newest alone shows a corner, more of them a bend.
const MEMORIES: [f64; 3] = [1.0, 8.0, 32.0];
/// Squared standard deviations of such a sum from which an emitter has turned: by chance once in 270,000 frames, and what it costs is
/// the knowledge of one velocity. More leaves bends to the search of the window, which takes them for newcomers; 18 loses melted emitters.
pub(crate) const SURPRISE: f64 = 25.0;

/// Turns for each that shows as one of `SURPRISE`, and the frames in which so many happen to somebody who is not known for it. Fewer turns leave
/// walkers too small errors at corners, more give standing users errors that are not there.
const TURNS: f64 = 4.0;
const FRAMES: f64 = 1600.0;
/// The variance of a sum's mean where an emitter has turned, in units of the sum's own.
const SPREAD: f64 = 10.0;

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
    /// The frames that count.
    frames: f64,
}

impl Sum {
    fn add(&mut self, change: Vector2<f64>, kept: f64) {
        self.changes = kept * self.changes + change;
        self.variance = kept * kept * self.variance + 1.0;
        self.frames = kept * self.frames + 1.0;
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
    /// How many turns have shown, and in how many frames.
    shown: f64,
    frames: f64,
    /// The error that is left in the position, σ, where a frame has changed it by a standard deviation.
    left: Matrix2<f64>,
    /// How far a turn leads astray in a frame, σ.
    reach: f64,
    /// Variance of the position along an axis, σ².
    variance: f64,
    restlessness: Restlessness,
    /// Spectral density of the acceleration, σ²/s³.
    density: f64,
    /// Whether frames do not tell its course.
    is_hidden: bool,
}

impl Straying {
    /// Takes a new frame's change, in its standard deviations, what error it leaves for each of these, the variance that the position has then
    /// along an axis, σ², and how far a turn leads astray in a frame, σ. Whether chance does not explain the changes of some memory.
    pub fn add(&mut self, change: Vector2<f64>, left: Matrix2<f64>, variance: f64, reach: f64) -> bool {
        (self.left, self.variance, self.reach, self.is_hidden) = (left, variance, reach, false);
        self.frames += 1.0;
        for (sum, frames) in self.sums.iter_mut().zip(MEMORIES) {
            sum.add(change, 1.0 - 1.0 / frames);
        }
        self.sums.iter().any(|sum| sum.z2() > SURPRISE)
    }

    /// Takes where the frame at `time_s` alone shows it, σ, with the variance of each coordinate, σ². `unit` is 1 m in σ.
    pub fn see(&mut self, place: [f64; 2], variance: [f64; 2], time_s: f64, unit: f64) {
        let (place_m, variance_m2) = (place.map(|v| v / unit), variance.map(|v| v / (unit * unit)));
        self.restlessness.see(place_m, variance_m2, time_s);
        self.density = self.restlessness.density_m2_s3() * unit * unit;
    }

    /// The frame does not tell its course, which then does not count as straight.
    pub fn hide(&mut self) {
        self.is_hidden = true;
    }

    /// The emitter has turned: what the frames have shown so far is of its course before.
    pub fn turn(&mut self) {
        self.sums = Default::default();
        self.shown += 1.0;
        self.restlessness.turn();
    }

    /// What it has shown of accelerations so far is forgotten.
    pub fn go_straight(&mut self) {
        (self.restlessness, self.density) = Default::default();
    }

    /// How long the course counts as straight, s.
    pub fn straight_s(&self) -> f64 {
        if self.is_hidden { 0.0 } else { self.unbent_s() }
    }

    /// Spectral density of the acceleration, σ²/s³.
    pub fn acceleration(&self) -> f64 {
        STRAIGHT * self.variance / self.unbent_s().powi(3)
    }

    fn unbent_s(&self) -> f64 {
        if self.density == 0.0 {
            return LONGEST_S;
        }
        (STRAIGHT * self.variance / self.density)
            .cbrt()
            .clamp(SHORTEST_S, LONGEST_S)
    }

    /// The second moment of how far the fitted position is behind, σ², over whether the emitter has left its course, by the memory that tells
    /// most of it and by how often it has turned so far. The position itself stays: moved by the expected lag, those of straight walkers and of
    /// who stands would be worse.
    pub fn lag(&self) -> Matrix2<f64> {
        let most = self.sums.iter().max_by(|a, b| a.z2().total_cmp(&b.z2()));
        let Some(most) = most.filter(|sum| sum.frames > 0.0) else {
            return Matrix2::zeros();
        };
        let gain = SPREAD / (1.0 + SPREAD);
        let turns = TURNS * (1.0 + self.shown) / (FRAMES + self.frames) * most.frames;
        let odds = turns * (0.5 * gain * most.z2()).exp() / (1.0 + SPREAD);
        let mean = gain / most.frames * (self.left * most.changes);
        let own = gain * most.variance / most.frames.powi(2) * self.left * self.left.transpose();
        let error = own + mean * mean.transpose();
        let farthest = (self.reach * most.frames).powi(2);
        odds / (1.0 + odds) * (farthest / error.trace()).min(1.0) * error
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::Straying;

    #[test]
    fn a_corner_and_a_bend_are_straying_and_noise_is_not() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut noise = || Vector2::from_fn(|_, _| StandardNormal.sample(&mut rng));
        let mut straying = Straying::default();
        let by_chance = (0..20_000)
            .filter(|_| straying.add(noise(), Matrix2::identity(), 1.0, 1.0))
            .count();
        assert!(by_chance <= 2, "{by_chance} times by chance");
        let frames_until = |bias: f64, noise: &mut dyn FnMut() -> Vector2<f64>| {
            let mut straying = Straying::default();
            (1..100).find(|_| straying.add(noise() + Vector2::new(bias, 0.0), Matrix2::identity(), 1.0, 1.0))
        };
        assert_eq!(frames_until(9.0, &mut noise), Some(1));
        // Two standard deviations a frame are 5.3 of eight frames.
        let bend = frames_until(2.0, &mut noise).expect("a bend is seen");
        assert!((3..16).contains(&bend), "after {bend} frames");
    }

    #[test]
    fn who_strays_may_be_elsewhere_and_who_does_not_is_where_expected() {
        // One coordinate, filtered with a gain of a tenth: a change has a standard deviation of 0.316 of the measurement's, and leaves 0.9 of
        // the error that it is a tenth of.
        let (gain, std) = (0.1, 0.1f64.sqrt());
        let lag_of = |error: f64, reach: f64| {
            let mut straying = Straying::default();
            for _ in 0..8 {
                straying.add(
                    Vector2::new(gain * error / std, 0.0),
                    Matrix2::identity() * std * (1.0 - gain) / gain,
                    1.0,
                    reach,
                );
            }
            straying.lag()
        };
        let far = lag_of(8.0, 10.0)[(0, 0)].sqrt();
        assert!((0.8..1.2).contains(&(far / (0.9 * 8.0))), "{far}");
        let near = lag_of(0.5, 10.0)[(0, 0)].sqrt();
        assert!(near < 0.3 * std && near < 0.1 * far, "{near}");
        // Nobody gets farther astray in eight frames than they can.
        let slow = lag_of(8.0, 0.1)[(0, 0)].sqrt();
        assert!(slow < 0.8, "{slow}");
    }

    #[test]
    fn who_is_known_to_turn_may_have_turned_and_who_is_known_to_stand_has_not() {
        let lag_after = |turns: usize, frames: usize| {
            let mut straying = Straying::default();
            for _ in 0..frames {
                straying.add(Vector2::zeros(), Matrix2::identity(), 1.0, 1.0);
            }
            (0..turns).for_each(|_| straying.turn());
            straying.add(Vector2::new(3.0, 0.0), Matrix2::identity(), 1.0, 1.0);
            straying.lag()[(0, 0)]
        };
        let (unknown, stands, roams) = (lag_after(0, 0), lag_after(0, 100_000), lag_after(200, 2000));
        assert!(
            stands < 0.05 * unknown && roams > 5.0 * unknown,
            "{stands} {unknown} {roams}"
        );
    }

    #[test]
    fn whose_course_no_frame_tells_does_not_go_straight_on_until_one_does() {
        let mut straying = Straying::default();
        straying.add(Vector2::zeros(), Matrix2::identity(), 1.0, 1.0);
        assert!(straying.straight_s() > 1.0);
        straying.hide();
        assert_eq!(straying.straight_s(), 0.0);
        straying.add(Vector2::zeros(), Matrix2::identity(), 1.0, 1.0);
        assert!(straying.straight_s() > 1.0);
    }
}
