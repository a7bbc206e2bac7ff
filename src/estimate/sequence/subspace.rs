//! The subspace of the window's frames: as if emitters stood still, K frames of independently fading emitters span as many dimensions as
//! there are emitters, however close these are (Schmidt, 1986).

use std::sync::Arc;

use faer::Mat;

use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;

/// Margin on the largest eigenvalue of noise, (√K + √m)² (Marchenko and Pastur, 1967): noise exceeds it once in a thousand windows.
const MARGIN: f64 = 1.15;
/// Components of noise that are kept beside those of the emitters, in case some fell below the margin.
const SPARE: usize = 3;
/// Spacing of the grid of the MUSIC spectrum, σ, and the most points along an axis: emitters a third of a σ apart have maxima of their own.
const SPACING: f64 = 0.08;
const MAX_GRID: usize = 96;
/// Frames of more coefficients are searched by residual peaks alone: their spots are narrow and stand apart.
const MAX_COEFFICIENTS: usize = 1200;

/// The principal components of a window's frames.
pub(crate) struct Subspace {
    /// Emitters that the eigenvalues show.
    pub count: usize,
    /// Components as frames, the strongest first: they have the frames' likelihood for emitters that stand still.
    pub components: Vec<Arc<CompressedFrame>>,
    /// Components that hold noise alone and were left out.
    pub dropped: usize,
}

impl Subspace {
    /// Of frames without masked pixels and weights; `None` where there are none, or they have too many coefficients.
    pub fn new(frames: &[&CompressedFrame]) -> Option<Self> {
        let frames: Vec<&CompressedFrame> = frames.iter().copied().filter(|f| f.is_unweighted()).collect();
        let widest = frames.iter().max_by_key(|f| f.mx * f.my)?;
        let mx = frames.iter().map(|f| f.mx).max()?;
        let my = frames.iter().map(|f| f.my).max()?;
        let (m, k) = (mx * my, frames.len());
        if m > MAX_COEFFICIENTS {
            return None;
        }
        let mut matrix = Mat::<f64>::zeros(m, k);
        for (column, frame) in frames.iter().enumerate() {
            for (y, row) in frame.coefficients.chunks_exact(frame.mx).enumerate() {
                for (x, value) in row.iter().enumerate() {
                    matrix[(y * mx + x, column)] = *value;
                }
            }
        }
        let svd = matrix.thin_svd().ok()?;
        let rank = m.min(k);
        let freedom = frames.iter().map(|f| f.data_count).fold(0.0, f64::max);
        let edge = ((k as f64).sqrt() + freedom.sqrt()).powi(2) * MARGIN;
        let values: Vec<f64> = (0..rank).map(|c| svd.S()[c]).collect();
        let count = values.iter().filter(|s| **s * **s > edge).count();
        let kept = (count + SPARE).min(rank);
        let components = (0..kept).map(|c| {
            let mut component = CompressedFrame::clone(widest);
            component.coefficients = (0..m).map(|r| svd.U()[(r, c)] * values[c]).collect();
            (component.mx, component.my) = (mx, my);
            component.rank = [
                frames.iter().map(|f| f.rank[0]).max().unwrap_or(mx),
                frames.iter().map(|f| f.rank[1]).max().unwrap_or(my),
            ];
            component.reach = frames.iter().map(|f| f.reach).fold(0.0, f64::max);
            component.data_count = freedom;
            Arc::new(component)
        });
        Some(Self {
            count,
            components: components.collect(),
            dropped: k - kept,
        })
    }

    /// Maxima of the MUSIC spectrum of the first `count` components, σ, the highest first.
    pub fn music(&self, bases: &Bases, count: usize) -> Vec<[f64; 2]> {
        let Some(first) = self.components.first() else {
            return Vec::new();
        };
        let (mx, my) = (first.mx, first.my);
        let [(gx, fx), (gy, fy)] = [(&bases.x, mx), (&bases.y, my)].map(|(b, m)| grid(b, m));
        let mut left = vec![1.0; gx.len() * gy.len()];
        let mut half = vec![0.0; mx];
        for component in self.components.iter().take(count) {
            let norm = component.coefficients.iter().map(|c| c * c).sum::<f64>().sqrt();
            for (j, profile) in fy.chunks_exact(my).enumerate() {
                half.fill(0.0);
                for (weight, row) in profile.iter().zip(component.coefficients.chunks_exact(mx)) {
                    for (h, v) in half.iter_mut().zip(row) {
                        *h += weight * v;
                    }
                }
                for (i, profile) in fx.chunks_exact(mx).enumerate() {
                    let inner: f64 = half.iter().zip(profile).map(|(h, f)| h * f).sum();
                    left[j * gx.len() + i] -= (inner / norm).powi(2);
                }
            }
        }
        let at = |i: usize, j: usize| left[j * gx.len() + i];
        let mut found = Vec::new();
        for j in 1..gy.len() - 1 {
            for i in 1..gx.len() - 1 {
                let own = at(i, j);
                let is_least = (j - 1..=j + 1).all(|b| (i - 1..=i + 1).all(|a| (a, b) == (i, j) || at(a, b) > own));
                if is_least {
                    found.push((own, [gx[i], gy[j]]));
                }
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found.into_iter().map(|(_, u)| u).collect()
    }
}

/// Positions along an axis and the unit-norm profiles there, (grid, m).
fn grid(basis: &Basis, m: usize) -> (Vec<f64>, Vec<f64>) {
    let (low, high) = (basis.edges[0] - 0.5, basis.edges[basis.n] + 0.5);
    let count = (((high - low) / SPACING) as usize + 1).min(MAX_GRID);
    let (mut scratch, mut out) = (vec![0.0; 3 * basis.n], vec![0.0; 3 * m]);
    let mut profiles = Vec::with_capacity(count * m);
    let at: Vec<f64> = (0..count)
        .map(|k| low + (high - low) * k as f64 / (count - 1) as f64)
        .collect();
    for u in &at {
        out.fill(0.0);
        basis.profile(*u, 1.0, psf_table::REACH, m, &mut scratch, &mut out);
        let norm = out[..m].iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
        profiles.extend(out[..m].iter().map(|v| v / norm));
    }
    (at, profiles)
}
