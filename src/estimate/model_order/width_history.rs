//! The widths that recent frames showed: all are of one lens, and where spots overlap a search seldom finds them.

use std::collections::VecDeque;

use crate::estimate::model::hypothesis::{Hypothesis, Width};

/// Frames that are remembered.
const FRAMES: usize = 32;

/// The widths along x and y, relative to the configured σ, and the covariance between the axes, σ².
pub(crate) type Widths = [f64; 3];

/// The widths of a stream's last frames with light that are explained; `None` where the configured one explains a frame.
#[derive(Default)]
pub(crate) struct WidthHistory {
    recent: VecDeque<Option<Widths>>,
}

impl WidthHistory {
    /// Takes the hypothesis that explains a frame.
    pub fn push(&mut self, hypothesis: &Hypothesis) {
        if self.recent.len() == FRAMES {
            self.recent.pop_front();
        }
        let [x, y] = hypothesis.width;
        let is_known = hypothesis.nuisances.width == Width::Known;
        self.recent
            .push_back((!is_known).then_some([x, y, hypothesis.covariance_xy]));
    }

    /// The lens's widths where more than half of the frames show others than the configured one: the median of each.
    pub fn usual(&self) -> Option<Widths> {
        let shown: Vec<Widths> = self.recent.iter().flatten().copied().collect();
        let median = |k: usize| {
            let mut sorted: Vec<f64> = shown.iter().map(|w| w[k]).collect();
            sorted.sort_by(f64::total_cmp);
            sorted[sorted.len() / 2]
        };
        (2 * shown.len() > self.recent.len()).then(|| [0, 1, 2].map(median))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::model::hypothesis::Nuisances;

    fn hypothesis(width: Width, x: f64) -> Hypothesis {
        let nuisances = Nuisances {
            background: true,
            width,
        };
        Hypothesis {
            width: [x, 1.0],
            covariance_xy: 0.1,
            ..Hypothesis::empty(nuisances)
        }
    }

    #[test]
    fn the_usual_widths_are_those_of_most_frames() {
        let mut history = WidthHistory::default();
        assert_eq!(history.usual(), None);
        for x in [1.2, 1.3, 1.9] {
            history.push(&hypothesis(Width::RotatedEllipse, x));
        }
        assert_eq!(history.usual(), Some([1.3, 1.0, 0.1]));
        for _ in 0..3 {
            history.push(&hypothesis(Width::Known, 1.0));
        }
        assert_eq!(history.usual(), None);
    }
}
