//! Keeps the brightest beam just below saturation by the exposure time: pure decisions, one frame at a time.

/// The brightest pixel of a frame, as a share of saturation, and whether it is saturated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Brightness {
    pub share: f64,
    pub is_saturated: bool,
}

/// Decides on exposures. Between the thresholds nothing changes, so that fading does not make the exposure swing. One exposure serves
/// while it loses the others little; for a beam that needs a much shorter one, short and long exposures are taken in turns.
#[derive(Clone, Debug)]
pub struct ExposureControl {
    /// As configured, which is also the longest, µs.
    longest_us: f64,
    /// As far as the device has shown, µs.
    shortest_us: f64,
    /// That follows the brightest beam, µs: the only one, or the short one of a pair.
    exposure_us: f64,
    /// Whether frames of the longest exposure are taken between those.
    is_pair: bool,
    /// Whether the newest frame's is the longest of a pair.
    is_long: bool,
    /// The exposure that was last asked for, the longest of a pair apart, µs.
    asked_us: f64,
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
/// Shortest share of the configured exposure that is used alone. Shorter, fainter beams disappear for a dazzling one; longer, a pair
/// costs its frames for little.
const SHORTEST_ALONE: f64 = 0.25;
/// And the shortest of a pair: a beam may be a thousand times as bright as what the configured exposure bears.
const SHORTEST: f64 = 1.0 / 1024.0;
/// A device that grants more than this many times a shorter exposure has no shorter one: rounding to its steps changes less.
const REFUSED: f64 = 1.2;

impl ExposureControl {
    /// Begins at the configured exposure, which is also the longest.
    pub fn new(configured_us: f64) -> Self {
        Self {
            longest_us: configured_us,
            shortest_us: SHORTEST * configured_us,
            exposure_us: configured_us,
            is_pair: false,
            is_long: false,
            asked_us: configured_us,
            bright: 0,
            dim: 0,
        }
    }

    pub fn is_pair(&self) -> bool {
        self.is_pair
    }

    /// The exposure that the device reports after a change, µs.
    pub fn granted(&mut self, exposure_us: f64) {
        if self.is_long {
            return;
        }
        if exposure_us > REFUSED * self.asked_us {
            self.shortest_us = exposure_us;
        }
        self.exposure_us = exposure_us;
    }

    /// The next exposure, µs, where it has to change after a frame.
    pub fn after(&mut self, frame: Brightness) -> Option<f64> {
        if self.is_long {
            self.is_long = false;
            self.asked_us = self.exposure_us;
            return Some(self.exposure_us);
        }
        let wanted_us = self.follow(frame);
        let next_us = wanted_us.unwrap_or(self.exposure_us).max(self.shortest_us);
        self.asked_us = next_us;
        self.is_pair = next_us < SHORTEST_ALONE * self.longest_us;
        if self.is_pair {
            self.exposure_us = next_us;
            self.is_long = true;
            return Some(self.longest_us);
        }
        // A change below a tenth is not worth the frames that it costs.
        ((next_us / self.exposure_us).ln().abs() > 0.1).then_some(next_us)
    }

    /// The exposure that the brightest beam needs, µs, where that has changed.
    fn follow(&mut self, frame: Brightness) -> Option<f64> {
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
        Some((factor * self.exposure_us).min(self.longest_us))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs the control on a beam of constant power: the exposure of each frame. `power` is the share of saturation at 1 µs.
    fn exposures(power: impl Fn(usize) -> f64, frames: usize, start_us: f64) -> Vec<f64> {
        exposures_from(0.0, power, frames, start_us)
    }

    /// The same on a device whose shortest exposure is `shortest_us`.
    fn exposures_from(shortest_us: f64, power: impl Fn(usize) -> f64, frames: usize, start_us: f64) -> Vec<f64> {
        let mut control = ExposureControl::new(start_us);
        let mut exposure = start_us;
        (0..frames)
            .map(|k| {
                let share = power(k) * exposure;
                let frame = Brightness {
                    share: share.min(1.0),
                    is_saturated: share >= 1.0,
                };
                let seen = exposure;
                if let Some(next) = control.after(frame) {
                    exposure = next.max(shortest_us);
                    control.granted(exposure);
                }
                seen
            })
            .collect()
    }

    #[test]
    fn a_beam_that_saturates_is_brought_below_saturation_and_stays_there() {
        let found = exposures(|_| 3.1 / 8000.0, 200, 8000.0);
        let share = found[199] * 3.1 / 8000.0;
        assert!((TOO_DIM..TOO_BRIGHT).contains(&share), "{share}");
        assert!(
            found[20..].iter().all(|e| *e == found[199]),
            "settled within 20 frames: {found:?}"
        );
    }

    #[test]
    fn fading_does_not_make_the_exposure_swing() {
        let fading = |k: usize| (0.6 + 0.25 * (k as f64 * 1.7).sin()) / 1000.0;
        assert!(exposures(fading, 500, 1000.0).iter().all(|e| *e == 1000.0));
    }

    #[test]
    fn beside_a_dazzling_beam_every_other_frame_is_a_long_one() {
        // Forty times what the configured exposure bears.
        let found = exposures(|_| 40.0 / 1600.0, 300, 1600.0);
        let settled = &found[100..];
        for pair in settled.chunks(2) {
            let [short, long] = [pair[0].min(pair[1]), pair[0].max(pair[1])];
            assert_eq!(long, 1600.0);
            assert!((TOO_DIM..TOO_BRIGHT).contains(&(short * 40.0 / 1600.0)), "{short}");
        }
    }

    #[test]
    fn no_beam_is_so_bright_that_the_exposure_vanishes() {
        let found = exposures(|_| 1e6, 300, 1600.0);
        assert_eq!(found.iter().copied().fold(f64::INFINITY, f64::min), 1600.0 / 1024.0);
        assert!(found[200..].contains(&1600.0));
    }

    #[test]
    fn a_device_without_short_exposures_keeps_to_its_shortest() {
        for shortest in [480.0, 700.0] {
            let found = exposures_from(shortest, |_| 40.0 / 1600.0, 300, 1600.0);
            assert!(found[20..].iter().all(|e| *e == shortest), "{:?}", &found[20..40]);
        }
    }

    #[test]
    fn when_the_dazzling_beam_is_gone_the_pair_ends_and_the_exposure_grows_again() {
        let found = exposures(|k| if k < 100 { 40.0 / 1600.0 } else { 0.2 / 1600.0 }, 1000, 1600.0);
        let last_change = (1..1000).rev().find(|k| found[*k] != found[k - 1]).unwrap();
        // Five doublings, of 30 frames each or twice as many in a pair.
        assert!((200..500).contains(&last_change), "{last_change}");
        assert_eq!(found[999], 1600.0);
    }
}
