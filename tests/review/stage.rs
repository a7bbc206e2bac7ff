//! Stories through pixels, and what a test expects of one.

#[path = "../stories/expected.rs"]
mod expected;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use oapwatch::monitor::AlertKind;
use oapwatch::scene::SimulatedFrame;
pub use oapwatch::study::stories::pixels::{CROWD, PixelStory as Story, Reviewed, review};

/// A scene file of the repository.
pub fn scene_file(seed: u64, path: &str) -> Story {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    Story::file(seed, &path).unwrap()
}

/// Every other frame is exposed for a part as long, as beside a beam that dazzles, with the same noise of read-out. Pixels of the others
/// are masked from `saturation_j` on.
pub fn expose_in_turns(story: &mut Story, part: f64, saturation_j: f64) {
    let noise = Normal::new(0.0, 1e-6 * (1.0 - part * part).sqrt()).unwrap();
    story.tamper = Box::new(move |t, made: &mut SimulatedFrame| {
        let frame = &mut made.frame;
        if frame.index % 2 == 1 {
            let mut rng = ChaCha8Rng::seed_from_u64(t.to_bits());
            frame.energy_scale = 1.0 / part;
            frame.pixels.mapv_inplace(|pixel| pixel * part + noise.sample(&mut rng));
        } else {
            frame.masked = Some(frame.pixels.mapv(|pixel| pixel >= saturation_j));
            frame.pixels.mapv_inplace(|pixel| pixel.min(saturation_j));
        }
    });
}

pub trait Expect {
    /// Exactly these were raised, each within its interval, s, and nothing else.
    fn expect(&self, expected: &[(AlertKind, Option<&str>, f64, f64)]);
}

impl Expect for Reviewed {
    #[track_caller]
    fn expect(&self, expected: &[(AlertKind, Option<&str>, f64, f64)]) {
        let lines = self.events.iter().map(|e| serde_json::to_string(e).unwrap() + "\n");
        expected::expect(&self.raised(), expected, &lines.collect::<String>());
    }
}
