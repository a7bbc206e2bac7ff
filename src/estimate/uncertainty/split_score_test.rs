//! Score test of a split (Rao, 1948). Two unresolved emitters look like one whose light is spread along the line between them: the
//! score in the second moments, projected off the fitted parameters, tests for that.

use crate::estimate::dense_linalg::{axpy, dot};
use crate::estimate::emitter::SecondMomentScore;
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::model::separable_model::SeparableModel;

/// Orders and factors of the derivatives for the second moments xx, xy, yy: a source spread by M changes by
/// ½A(M_xx f_xx + 2 M_xy f_xy + M_yy f_yy).
const SECOND: [([usize; 2], f64); 3] = [([2, 0], 0.5), ([1, 1], 1.0), ([0, 2], 0.5)];
/// Directions tested, over half a turn.
const DIRECTIONS: usize = 16;
/// Smallest cross_information of a moment's information that must remain after projection off the fitted parameters.
const LEAST: f64 = 1e-6;

/// A split suggested by a second-moment score.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SplitProposal {
    /// Predicted decrease of the deviance, to second order.
    pub gain: f64,
    pub index: usize,
    pub direction: [f64; 2],
    /// Distance of equal halves from the source, σ.
    pub distance: f64,
}

impl SecondMomentScore {
    /// The split along the direction of the largest gain, if any gains.
    pub(crate) fn split(&self, index: usize) -> Option<SplitProposal> {
        let (g, s) = (&self.score, &self.information);
        let along = |k: usize| {
            let (y, x) = (std::f64::consts::PI * k as f64 / DIRECTIONS as f64).sin_cos();
            let v = [x * x, x * y, y * y];
            let slope: f64 = (0..3).map(|r| g[r] * v[r]).sum();
            let curvature: f64 = (0..3).map(|r| v[r] * (0..3).map(|c| s[r][c] * v[c]).sum::<f64>()).sum();
            (slope > 0.0 && curvature > 0.0).then(|| SplitProposal {
                gain: slope * slope / curvature,
                index,
                direction: [x, y],
                distance: (slope / curvature).sqrt(),
            })
        };
        (0..DIRECTIONS)
            .filter_map(along)
            .max_by(|a, b| a.gain.total_cmp(&b.gain))
    }
}

impl Fitter {
    /// Second-moment score of each source of `hypothesis`, given the inverse of the information matrix that was set last, (p, p).
    pub fn second_moment_scores(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &Hypothesis,
        covariance: &[f64],
    ) -> Vec<SecondMomentScore> {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            compressed,
            hypothesis,
            covariance,
        })
    }

    #[inline(always)]
    fn projected_scores(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &Hypothesis,
        covariance: &[f64],
    ) -> Vec<SecondMomentScore> {
        let p = hypothesis.parameters();
        let widths = hypothesis.nuisances.widths();
        self.work += (hypothesis.sources.len() * p * 3 * p) as f64;
        let (mut cross, mut taken) = (vec![0.0; 3 * p], vec![0.0; 3 * p]);
        let mut scores = Vec::with_capacity(hypothesis.sources.len());
        for i in 0..hypothesis.sources.len() {
            cross.fill(0.0);
            let (mut score, mut information) = self.unprojected_score(compressed, i, widths, &mut cross);
            let whole = information;
            for r in 0..3 {
                for k in 0..p {
                    taken[r * p + k] = dot(&cross[r * p..(r + 1) * p], &covariance[k * p..(k + 1) * p]);
                }
            }
            for r in 0..3 {
                let taken = &taken[r * p..(r + 1) * p];
                score[r] -= dot(taken, &self.gradient[..p]);
                for c in 0..3 {
                    information[r][c] -= dot(taken, &cross[c * p..(c + 1) * p]);
                }
            }
            let is_left = (0..3).all(|r| information[r][r] > LEAST * whole[r][r]);
            scores.push(if is_left {
                SecondMomentScore { score, information }
            } else {
                SecondMomentScore::default()
            });
        }
        scores
    }

    /// Score and information of source `i`'s second moments, and their cross information with the model's parameters, (3, p).
    #[inline(always)]
    fn unprojected_score(
        &mut self,
        compressed: &CompressedFrame,
        i: usize,
        widths: usize,
        cross: &mut [f64],
    ) -> ([f64; 3], [[f64; 3]; 3]) {
        let p = cross.len() / 3;
        let separable: &SeparableModel = &self.current;
        let own = SECOND.map(|(_, f)| f * separable.amplitude(i));
        let strip = &mut self.strip;
        let mut information = [[0.0; 3]; 3];
        if compressed.weights.is_empty()
            && compressed.masked.runs().is_empty()
            && widths == 0
            && separable.covariance_xy == 0.0
        {
            for (r, (second, _)) in SECOND.into_iter().enumerate() {
                for (c, (other, _)) in SECOND.into_iter().enumerate() {
                    information[r][c] = own[r] * own[c] * separable.inner_product(i, second, i, other, &[], strip);
                }
            }
            cross_information(separable, i, own, cross);
            self.velocity.resize(p, 0.0);
            for bad in compressed.masked.scattered() {
                let at = separable.derivatives_at(i, [bad.x, bad.y], SECOND.map(|(second, _)| second));
                if at == [0.0; 3] {
                    continue;
                }
                separable.jacobian_row_at([bad.x, bad.y], &mut self.velocity);
                for r in 0..3 {
                    axpy(-own[r] * at[r], &self.velocity, &mut cross[r * p..(r + 1) * p]);
                    for c in 0..3 {
                        information[r][c] -= own[r] * at[r] * own[c] * at[c];
                    }
                }
            }
        } else {
            for (r, (second, _)) in SECOND.into_iter().enumerate() {
                self.second_derivative.clear();
                self.second_derivative.resize(compressed.mx * compressed.my, 0.0);
                separable.accumulate(i, second[0], second[1], own[r], &mut self.second_derivative);
                compressed.apply_weights(
                    &mut self.second_derivative,
                    [&self.bx, &self.by],
                    false,
                    &mut self.scratch,
                );
                let row = &mut cross[r * p..(r + 1) * p];
                separable.transposed_jacobian_times(&self.second_derivative, strip, row);
                for w in 0..widths {
                    row[p - widths + w] = dot(&self.second_derivative, &self.width_derivatives[w]);
                }
                let projected = separable.project_second_derivatives(i, &self.second_derivative, strip);
                for c in 0..3 {
                    information[r][c] = own[c] * projected[c];
                }
            }
        }
        let projected = separable.project_second_derivatives(i, &self.residual, strip);
        ([0, 1, 2].map(|r| own[r] * projected[r]), information)
    }
}

/// Cross information of source `i`'s second moments with all parameters in an unweighted frame, (3, p).
#[inline(always)]
fn cross_information(separable: &SeparableModel, i: usize, own: [f64; 3], cross: &mut [f64]) {
    let (n, p) = (separable.sources.len(), cross.len() / 3);
    for j in 0..separable.components() {
        let Some([x, y]) = separable.axis_inner_products(i, j) else {
            continue;
        };
        for (r, (second, _)) in SECOND.into_iter().enumerate() {
            let along = |first: [usize; 2]| own[r] * x[second[0]][first[0]] * y[second[1]][first[1]];
            if j >= n {
                cross[r * p + 2 * n + j] = along([0, 0]);
                continue;
            }
            let a = separable.amplitude(j);
            cross[r * p + 3 * j] = a * along([1, 0]);
            cross[r * p + 3 * j + 1] = a * along([0, 1]);
            cross[r * p + 3 * j + 2] = along([0, 0]);
        }
    }
}

struct Job<'a> {
    fitter: &'a mut Fitter,
    compressed: &'a CompressedFrame,
    hypothesis: &'a Hypothesis,
    covariance: &'a [f64],
}

impl pulp::NullaryFnOnce for Job<'_> {
    type Output = Vec<SecondMomentScore>;

    #[inline(always)]
    fn call(self) -> Vec<SecondMomentScore> {
        self.fitter
            .projected_scores(self.compressed, self.hypothesis, self.covariance)
    }
}
