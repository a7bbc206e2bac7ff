//! Who has left their straight course.

use nalgebra::Vector2;

/// Frames over which changes of an emitter's position are added up: the newest alone shows a corner, more of them a bend.
const MEMORIES: [f64; 3] = [1.0, 8.0, 32.0];
/// Squared standard deviations of such a sum from which an emitter has turned: by chance once in 270,000 frames, and what it costs is
/// the knowledge of one velocity. More leaves bends to the search of the window, which takes them for newcomers; 18 loses melted emitters.
const SURPRISE: f64 = 25.0;

/// How an emitter has strayed from its straight course over the last frames: sums of the changes of its position by each of them, in their
/// standard deviations, over memories of `MEMORIES` frames.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Straying([(Vector2<f64>, f64); MEMORIES.len()]);

impl Straying {
    /// Takes a new frame's change. Whether chance does not explain the changes of some memory.
    pub fn add(&mut self, change: Vector2<f64>) -> bool {
        for ((sum, variance), frames) in self.0.iter_mut().zip(MEMORIES) {
            let kept = 1.0 - 1.0 / frames;
            *sum = kept * *sum + change;
            *variance = kept * kept * *variance + 1.0;
        }
        self.0.iter().any(|(sum, v)| sum.norm_squared() > SURPRISE * v)
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
        let by_chance = (0..20_000).filter(|_| straying.add(noise())).count();
        assert!(by_chance <= 2, "{by_chance} times by chance");
        let frames_until = |bias: f64, noise: &mut dyn FnMut() -> Vector2<f64>| {
            let mut straying = Straying::default();
            (1..100).find(|_| straying.add(noise() + Vector2::new(bias, 0.0)))
        };
        assert_eq!(frames_until(9.0, &mut noise), Some(1));
        // Two standard deviations a frame are 5.3 of eight frames.
        let bend = frames_until(2.0, &mut noise).expect("a bend is seen");
        assert!((3..16).contains(&bend), "after {bend} frames");
    }
}
