//! Keeps the brightest beam just below saturation by the exposure time: pure decisions, one frame at a time.

/// The brightest pixel of a frame, as a share of saturation, and whether it is saturated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Brightness {
    pub share: f64,
    pub is_saturated: bool,
}

/// Decides on exposures. Between the thresholds nothing changes, so that fading does not make the exposure swing.
#[derive(Clone, Debug)]
pub struct ExposureControl {
    /// In force, µs.
    exposure_us: f64,
    /// Shortest and longest, µs.
    range_us: [f64; 2],
    bright: u32,
    dim: u32,
}

/// A frame above this share of saturation is too bright, one below the other too dim. A factor of 2.6 apart: fading of a steady beam
/// (a few tens of per cent) crosses neither.
const TOO_BRIGHT: f64 = 0.9;
const TOO_DIM: f64 = 0.35;
/// The share that a change aims at.
const TARGET: f64 = 0.7;
/// Frames in a row before a change: few where light is lost, many where it is only faint, since a beam may be away for a moment.
const BRIGHT_FRAMES: u32 = 2;
const DIM_FRAMES: u32 = 30;
/// Largest change at a time. What is saturated says nothing of how far it is above.
const STEP: f64 = 2.0;
/// The shortest exposure is this share of the configured one: a beam that dazzles even then does not make others, up to so many times
/// fainter, disappear.
const SHORTEST: f64 = 1.0 / 16.0;

impl ExposureControl {
    /// Begins at the configured exposure, which is also the longest.
    pub fn new(configured_us: f64) -> Self {
        Self {
            exposure_us: configured_us,
            range_us: [SHORTEST * configured_us, configured_us],
            bright: 0,
            dim: 0,
        }
    }

    /// The exposure that the device reports, µs.
    pub fn granted(&mut self, exposure_us: f64) {
        self.exposure_us = exposure_us;
        (self.bright, self.dim) = (0, 0);
    }

    /// The next exposure, µs, where it has to change after a frame.
    pub fn after(&mut self, frame: Brightness) -> Option<f64> {
        let is_bright = frame.is_saturated || frame.share > TOO_BRIGHT;
        let is_dim = !is_bright && frame.share < TOO_DIM;
        self.bright = if is_bright { self.bright + 1 } else { 0 };
        self.dim = if is_dim { self.dim + 1 } else { 0 };
        let factor = if self.bright >= BRIGHT_FRAMES {
            if frame.is_saturated {
                1.0 / STEP
            } else {
                TARGET / frame.share
            }
        } else if self.dim >= DIM_FRAMES {
            (TARGET / frame.share.max(1e-3)).min(STEP)
        } else {
            return None;
        };
        (self.bright, self.dim) = (0, 0);
        let [shortest, longest] = self.range_us;
        let next = (factor * self.exposure_us).clamp(shortest, longest);
        // A change below a tenth is not worth the frames that it costs.
        ((next / self.exposure_us).ln().abs() > 0.1).then_some(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs the control on a beam of constant power: the exposure after each frame. `power` is the share of saturation at 1 µs.
    fn exposures(power: impl Fn(usize) -> f64, frames: usize, start_us: f64) -> Vec<f64> {
        let mut control = ExposureControl::new(start_us);
        let mut exposure = start_us;
        (0..frames)
            .map(|k| {
                let share = power(k) * exposure;
                let frame = Brightness {
                    share: share.min(1.0),
                    is_saturated: share >= 1.0,
                };
                if let Some(next) = control.after(frame) {
                    exposure = next;
                    control.granted(next);
                }
                exposure
            })
            .collect()
    }

    #[test]
    fn a_beam_that_saturates_is_brought_below_saturation_and_stays_there() {
        let found = exposures(|_| 3.1 / 8000.0, 200, 8000.0);
        let share = found[199] * 3.1 / 8000.0;
        assert!((TOO_DIM..TOO_BRIGHT).contains(&share), "{share}");
        assert!(found[20] == found[199], "settled within 20 frames: {found:?}");
    }

    #[test]
    fn fading_does_not_make_the_exposure_swing() {
        let fading = |k: usize| (0.6 + 0.25 * (k as f64 * 1.7).sin()) / 1000.0;
        assert!(exposures(fading, 500, 1000.0).iter().all(|e| *e == 1000.0));
    }

    #[test]
    fn a_dazzling_beam_shortens_it_only_so_far_and_when_it_is_gone_it_grows_again() {
        let found = exposures(|k| if k < 100 { 1.0 } else { 0.2 / 1600.0 }, 400, 1600.0);
        assert_eq!(found[99], 100.0, "a sixteenth");
        assert_eq!(found[399], 1600.0);
        let raised = found[100..]
            .windows(2)
            .all(|pair| pair[1] <= STEP * pair[0] && pair[1] >= pair[0]);
        assert!(raised, "{found:?}");
    }
}
