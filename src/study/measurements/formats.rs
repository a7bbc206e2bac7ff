//! What a camera's pixel format costs.

use super::measured::Measured;
use crate::study::formats::table;

/// The right number of emitters and the error over the bound through each format, over so many frames.
pub fn cost(frames: u64, seed: u64) -> Measured {
    let text = table(frames as usize, seed).expect("the paper's scene and the default estimator");
    Measured { text, holds: true }
}
