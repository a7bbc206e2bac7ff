//! The spot errors that recent frames showed: all are of one lens, and many of its frames can be explained by emitters instead.

use std::collections::VecDeque;

use crate::estimate::model_order::stacked_misfit::StackedMisfit;

/// Frames that are remembered. Over so many a glint on water, which passes for a lens's halo while it lasts, shows a spot error in at most 22 %
/// of the frames (`config/scenes/hazy-noon.toml`; 41 % over 32 frames), and crowds of Gaussian spots in 5 % (`dense-crowd.toml`).
const FRAMES: usize = 128;

/// The spot errors of a stream's last frames with light; 0 where a frame shows none.
#[derive(Default)]
pub(crate) struct SpotErrorHistory {
    pub stacked: StackedMisfit,
    recent: VecDeque<f64>,
}

impl SpotErrorHistory {
    pub fn push(&mut self, shown: f64) {
        if self.recent.len() == FRAMES {
            self.recent.pop_front();
        }
        self.recent.push_back(shown);
    }

    /// The lens's spot error, of each frame or of all together.
    pub fn spot_error(&self) -> Option<f64> {
        let errors = [self.usual(), self.stacked.spot_error()];
        errors.into_iter().flatten().reduce(f64::max)
    }

    /// Where more than half of the frames show one: their median.
    fn usual(&self) -> Option<f64> {
        let count = self.recent.len();
        let mut sorted = [0.0; FRAMES];
        for (out, error) in sorted.iter_mut().zip(&self.recent) {
            *out = *error;
        }
        sorted[..count].sort_by(f64::total_cmp);
        let without = sorted[..count].partition_point(|e| *e == 0.0);
        let with = count - without;
        (with > without).then(|| sorted[without + with / 2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn history(shown: impl IntoIterator<Item = f64>) -> SpotErrorHistory {
        let mut history = SpotErrorHistory::default();
        shown.into_iter().for_each(|e| history.push(e));
        history
    }

    #[test]
    fn half_of_the_frames_are_no_lens() {
        assert_eq!(history([]).spot_error(), None);
        assert_eq!(history([0.03]).spot_error(), Some(0.03));
        assert_eq!(history([0.03, 0.0]).spot_error(), None);
        assert_eq!(history([0.03, 0.0, 0.02]).spot_error(), Some(0.03));
    }

    #[test]
    fn a_lens_that_was_changed_is_forgotten() {
        let mut history = history([0.05; 2 * FRAMES]);
        for _ in 0..FRAMES / 2 - 1 {
            history.push(0.0);
        }
        assert_eq!(history.spot_error(), Some(0.05));
        history.push(0.0);
        assert_eq!(history.spot_error(), None);
    }
}
