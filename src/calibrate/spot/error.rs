//! Why nothing was learned.

use super::coverage::CELLS;

/// Why nothing was learned.
#[derive(Clone, Debug, thiserror::Error)]
pub enum Error {
    #[error("expected at least {MIN_FRAMES} frames, found {frames}")]
    TooFewFrames { frames: usize },
    #[error(
        "no spots in {frames} frames: nothing is {SIGMAS} σ above the noise of {noise_j:.2e} J a pixel; are they dark frames?"
    )]
    NoSpots { frames: usize, noise_j: f64 },
    #[error(
        "{saturated} of {frames} frames hold saturated pixels, and too little else can be learned from; reduce the exposure or the gain"
    )]
    Saturated { frames: usize, saturated: usize },
    #[error(
        "expected at least {MIN_SPOTS} spots {SIGMAS} σ above the noise, found {spots} in {frames} frames: too few or too faint"
    )]
    TooFewSpots { frames: usize, spots: usize },
    #[error(
        "the spots stand on {covered} of the {} sixteenths of a pixel (expected {needed}): let them move by a pixel or more while \
         frames are taken",
        CELLS
    )]
    Phases { covered: usize, needed: usize },
    #[error(
        "the spots are not alike: no common shape explains them (the best leaves {share:.0} % of their light unexplained); are all of \
         them beams, below saturation, and none always beside another?"
    )]
    NotAlike { share: f64 },
    #[error(
        "the learned spot has only {share:.0} % of its light within two of its widths: it is no spot; give more frames, or brighter beams"
    )]
    Scattered { share: f64 },
    #[error("no pixel of the {frames} frames has a finite value")]
    NotFinite { frames: usize },
    #[error("the pixels of the {frames} frames hardly differ, not even by noise: is there a picture in them?")]
    NoNoise { frames: usize },
}

/// Fewest frames and spots: a fifth is held out, and each pixel phase wants several spots.
pub(super) const MIN_FRAMES: usize = 15;
pub(super) const MIN_SPOTS: usize = 60;
const SIGMAS: f64 = 8.0;
