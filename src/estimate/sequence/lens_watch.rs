//! `sequence` where spots are what the config says. Many frames together take a lens's halo for emitters long before one frame shows it; so
//! frames are looked at one by one first and now and then later, and answered so where they show another lens and fewer emitters.

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
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
/// Emitters more than a frame alone shows that another lens makes: one may be a pair that no single frame tells apart, which can look like
/// another lens where all fade deeply.
const MADE: usize = 2;

/// An estimator that remembers, and one that watches the lens.
pub(crate) struct LensWatch {
    together: SequenceEstimator,
    alone: AnalyticEstimator,
    frames: u32,
    with_light: u32,
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
            is_another: false,
        }
    }

    /// What the frame shows alone, where that is asked.
    fn alone(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Option<Estimate>, Error> {
        self.frames = self.frames.wrapping_add(1);
        let is_due = self.with_light < FIRST || self.frames.is_multiple_of(ONE_IN);
        if !is_due && !self.alone.remembers_spot_error() {
            return Ok(None);
        }
        let estimator = self.name();
        let alone = self.alone.estimate_until(frame, is_over)?;
        self.with_light = self.with_light.saturating_add(match alone.emitters.len() {
            0 => 0,
            1..=MANY => 1,
            _ => FIRST,
        });
        let is_shown = self.alone.remembers_spot_error();
        self.is_another &= is_shown;
        Ok(is_shown.then_some(Estimate { estimator, ..alone }))
    }
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
        let alone = self.alone(frame, is_over)?;
        if let Some(alone) = alone.as_ref().filter(|_| self.is_another) {
            return Ok(alone.clone());
        }
        let together = self.together.estimate_until(frame, is_over)?;
        let is_wrong = |alone: &Estimate| {
            together.emitters.len() >= alone.emitters.len() + MADE
                || (together.spot_error > 0.0 && together.spot_error >= alone.spot_error)
        };
        self.is_another = alone.as_ref().is_some_and(is_wrong);
        Ok(alone.filter(|_| self.is_another).unwrap_or(together))
    }
}
