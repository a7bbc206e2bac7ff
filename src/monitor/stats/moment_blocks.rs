//! What the blocks of a beam's past second moments say together.

use nalgebra::Vector3;

use super::block_history::MIN_DRIFT_BLOCKS;
use super::moment_score::MomentScore;

/// The blocks' sum, and how their means scatter: the sum of squares over one less than their number, and the trace of a mean's own covariance.
/// The latter two are only of enough blocks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Blocks {
    pub sum: MomentScore,
    pub scatter: Option<(f64, f64)>,
}

impl Blocks {
    pub fn of<'a>(blocks: impl Iterator<Item = &'a MomentScore> + Clone) -> Self {
        let mut sum = MomentScore::default();
        blocks.clone().for_each(|block| sum.add(block));
        let means: Vec<_> = blocks.filter_map(MomentScore::solved).collect();
        let n = means.len() as f64;
        let scatter = (means.len() >= MIN_DRIFT_BLOCKS).then(|| {
            let middle = means.iter().map(|(m, _)| m).sum::<Vector3<f64>>() / n;
            let squares: f64 = means.iter().map(|(m, _)| (m - middle).norm_squared()).sum();
            (
                squares / (n - 1.0),
                means.iter().map(|(_, cov)| cov.trace()).sum::<f64>() / n,
            )
        });
        Self { sum, scatter }
    }
}
