//! Stories through pixels, and what a test expects of one.

#[path = "../stories/expected.rs"]
mod expected;

use oapwatch::monitor::AlertKind;
pub use oapwatch::study::stories::pixels::{CROWD, PixelStory as Story, Reviewed, review};

/// A scene file of the repository.
pub fn scene_file(seed: u64, path: &str) -> Story {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    Story::file(seed, &path).unwrap()
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
