//! `sequence` where spots are what the config says. Many frames together take a lens's halo, or another width, for emitters long before one frame
//! shows it; so frames are looked at one by one first and now and then later, and answered so where they show another lens and fewer emitters.

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::model::hypothesis::OVERLAPPING;
use crate::estimate::sequence::SequenceEstimator;
use crate::frame::Frame;
use crate::geo::Sight;
use crate::optics::Smear;

/// First frames with light that are looked at one by one: so many show together what none does. Later one in so many: more follow a change of
/// the lens sooner, and make frames slower.
const FIRST: u32 = 32;
const ONE_IN: u32 = 128;
/// Emitters of which a frame alone takes long: with more it is looked at seldom from the start.
const MANY: usize = 12;
/// One in so many while more emitters overlap with others than in the answer before the last look.
const ONE_IN_DOUBT: u32 = 8;
/// Least that ln width differs for memory to begin anew: so much makes no pair of a spot of SNR 300.
const ANOTHER_WIDTH: f64 = 1e-3;
/// Emitters more than a frame alone shows that another lens makes: one may be a pair that no single frame tells apart, which can look like
/// another lens where all fade deeply.
const MADE: usize = 2;

/// An estimator that remembers, and one that watches the lens.
pub(crate) struct LensWatch {
    together: SequenceEstimator,
    alone: AnalyticEstimator,
    frames: u32,
    with_light: u32,
    /// Emitters of the last answer that overlap with others, and of that before the last look.
    overlapping: usize,
    looked_at: usize,
    /// Frame from which on one by one are looked at again where they show fewer emitters.
    doubted_again: u32,
    /// Frames are answered one by one.
    is_another: bool,
}

impl LensWatch {
    pub fn new(together: SequenceEstimator, alone: AnalyticEstimator) -> Self {
        Self {
            together,
            alone,
            frames: 0,
            with_light: 0,
            overlapping: 0,
            looked_at: 0,
            doubted_again: 0,
            is_another: false,
        }
    }

    /// What the frame shows alone, where that is asked.
    fn alone(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Option<Estimate>, Error> {
        self.frames = self.frames.wrapping_add(1);
        let is_doubted = self.overlapping > self.looked_at && self.frames.is_multiple_of(ONE_IN_DOUBT);
        let is_due = self.with_light < FIRST || is_doubted || self.frames.is_multiple_of(ONE_IN);
        if !is_due && !self.alone.remembers_spot_error() {
            return Ok(None);
        }
        self.looked_at = self.overlapping;
        let estimator = self.name();
        let alone = self.alone.estimate_until(frame, is_over)?;
        self.with_light = self.with_light.saturating_add(match alone.emitters.len() {
            0 => 0,
            1..=MANY => 1,
            _ => FIRST,
        });
        Ok(Some(Estimate { estimator, ..alone }))
    }

    /// Has frames together go on with the width that single frames have learned.
    fn teach_width(&mut self) {
        let learned = self.alone.camera().spot_sigma_m;
        if (learned / self.together.camera().spot_sigma_m).ln().abs() > ANOTHER_WIDTH {
            self.together.take_width(learned);
        }
    }

    /// Single frames show fewer emitters than frames together: more of them are looked at, less often each time that this shows nothing.
    fn doubt(&mut self) {
        if self.with_light >= FIRST && self.frames >= self.doubted_again {
            self.with_light = 0;
            self.doubted_again = self.frames.saturating_mul(2);
        }
    }
}

/// Emitters that overlap with another one.
fn overlapping(found: &Estimate, sigma_m: f64) -> usize {
    let reach = OVERLAPPING * sigma_m;
    let places = || found.emitters.iter().map(|e| e.sensor_m);
    let is_near = |[x, y]: [f64; 2]| move |[a, b]: &[f64; 2]| (a - x).hypot(b - y) < reach;
    places().filter(|at| places().filter(is_near(*at)).count() > 1).count()
}

impl Estimator for LensWatch {
    fn name(&self) -> &'static str {
        self.together.name()
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.together.set_smear(smear);
        self.alone.set_smear(smear);
    }

    fn set_sight(&mut self, sight: Option<&Sight>) {
        self.together.set_sight(sight);
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let looked_at = self.alone(frame, is_over)?;
        let is_shown = self.alone.remembers_spot_error();
        self.is_another &= is_shown;
        if let Some(alone) = looked_at.as_ref().filter(|_| self.is_another) {
            return Ok(alone.clone());
        }
        if looked_at.is_some() && !is_shown {
            self.teach_width();
        }
        let before = self.together.camera().spot_sigma_m;
        let together = self.together.estimate_until(frame, is_over)?;
        let after = self.together.camera().spot_sigma_m;
        if after != before && !is_shown {
            self.alone.take_width(after);
        }
        self.overlapping = overlapping(&together, after);
        let Some(alone) = looked_at else {
            return Ok(together);
        };
        let has_more = together.emitters.len() >= alone.emitters.len() + MADE;
        let is_of_lens = together.spot_error > 0.0 && together.spot_error >= alone.spot_error;
        self.is_another = is_shown && (has_more || is_of_lens);
        if has_more && !is_shown {
            self.doubt();
        }
        Ok(if self.is_another { alone } else { together })
    }
}
