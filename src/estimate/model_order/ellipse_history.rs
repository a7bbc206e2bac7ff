//! The elongated spots that recent frames showed: all are of one lens, and where spots overlap a search seldom finds their ellipse.

use std::collections::VecDeque;

use crate::estimate::model::hypothesis::{Hypothesis, Width};

/// Frames that are remembered.
const FRAMES: usize = 32;

/// The widths along x and y, relative to the configured σ, and the covariance between the axes, σ².
pub(crate) type Ellipse = [f64; 3];

/// The ellipses of a stream's last frames with light that are explained; `None` where a frame is explained without.
#[derive(Default)]
pub(crate) struct EllipseHistory {
    recent: VecDeque<Option<Ellipse>>,
}

impl EllipseHistory {
    /// Takes the hypothesis that explains a frame; one without light tells nothing.
    pub fn push(&mut self, hypothesis: &Hypothesis) {
        if hypothesis.sources.is_empty() {
            return;
        }
        if self.recent.len() == FRAMES {
            self.recent.pop_front();
        }
        let [x, y] = hypothesis.width;
        let is_elongated = hypothesis.nuisances.width == Width::RotatedEllipse;
        self.recent
            .push_back(is_elongated.then_some([x, y, hypothesis.covariance_xy]));
    }

    /// The lens's ellipse where more than half of the frames show one: the median of each number.
    pub fn usual(&self) -> Option<Ellipse> {
        let shown: Vec<Ellipse> = self.recent.iter().flatten().copied().collect();
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
    use crate::estimate::model::hypothesis::{Background, Nuisances, PointSource};

    fn hypothesis(width: Width, x: f64) -> Hypothesis {
        let nuisances = Nuisances {
            background: Background::Plane,
            width,
        };
        Hypothesis {
            width: [x, 1.0],
            covariance_xy: 0.1,
            sources: vec![PointSource::default()],
            ..Hypothesis::empty(nuisances)
        }
    }

    #[test]
    fn the_usual_ellipse_is_that_of_most_frames() {
        let mut history = EllipseHistory::default();
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
