//! Pixels that tell nothing: what stands in their place until the fit takes it out again.

use super::basis::Basis;
use super::linear::{axpy, cholesky, dot, solve};

/// A further change of the deviance that is not worth another round.
const SMALL: f64 = 0.01;
const ROUNDS: usize = 100;
/// From so many pixels on it may be cheaper to solve for the coefficients, where there are few.
const MANY: usize = 200;
/// Precision of what only unusable pixels could tell, over a coefficient's.
const RIDGE: f64 = 1e-9;

/// An unusable pixel with the value it was filled with, which the fit takes out again exactly.
#[derive(Clone, Copy)]
pub(super) struct BadPixel {
    pub x: usize,
    pub y: usize,
    pub value: f64,
}

/// Fills unusable pixels with what the usable ones let the bases say there, and `z`, (my, mx), accordingly: then nothing of
/// them lies outside the bases, where it would pass for noise, and the deviance is that of the usable pixels alone.
///
/// With P the projection on the bases, the values solve (I − P)ᵦᵦ v = (P y)ᵦ; conjugate gradients (Hestenes and Stiefel, 1952).
#[inline(always)]
pub(super) fn fill(bad: &mut [BadPixel], z: &mut [f64], mx: usize, bx: &Basis, by: &Basis) {
    let size = z.len() as f64;
    let iterated = ROUNDS as f64 * 4.0 * bad.len() as f64 * size;
    if bad.len() > MANY && size * size * (size / 3.0 + bad.len() as f64 / 2.0) < iterated {
        return solve_all(bad, z, mx, bx, by);
    }
    let my = z.len() / mx;
    let at = |matrix: &[f64], b: &BadPixel| -> f64 {
        let (ux, uy) = (&bx.row(b.x)[..mx], &by.row(b.y)[..my]);
        uy.iter()
            .zip(matrix.chunks_exact(mx))
            .map(|(u, row)| u * dot(row, ux))
            .sum()
    };
    let mut left: Vec<f64> = bad.iter().map(|b| at(z, b) - b.value).collect();
    let mut direction = left.clone();
    let mut spread = vec![0.0; z.len()];
    let mut change = left.clone();
    let mut square = dot(&left, &left);
    for _ in 0..ROUNDS {
        spread.fill(0.0);
        for (b, d) in bad.iter().zip(&direction) {
            let ux = &bx.row(b.x)[..mx];
            for (u, row) in by.row(b.y).iter().zip(spread.chunks_exact_mut(mx)) {
                axpy(d * u, ux, row);
            }
        }
        for ((c, b), d) in change.iter_mut().zip(bad.iter()).zip(&direction) {
            *c = d - at(&spread, b);
        }
        let curvature = dot(&direction, &change);
        if !(curvature > 1e-12 * dot(&direction, &direction)) {
            return;
        }
        let step = square / curvature;
        for (b, d) in bad.iter_mut().zip(&direction) {
            b.value += step * d;
        }
        axpy(step, &spread, z);
        axpy(-step, &change, &mut left);
        let before = std::mem::replace(&mut square, dot(&left, &left));
        if step * before < SMALL {
            return;
        }
        for (d, l) in direction.iter_mut().zip(&left) {
            *d = l + square / before * *d;
        }
    }
}

/// The same by the coefficients that the usable pixels give, (I − UᵦᵀUᵦ) z = Uᵀ y over them.
#[inline(always)]
fn solve_all(bad: &mut [BadPixel], z: &mut [f64], mx: usize, bx: &Basis, by: &Basis) {
    let (n, my) = (z.len(), z.len() / mx);
    let mut gram = vec![0.0; n * n];
    let mut atom = vec![0.0; n];
    for i in 0..n {
        gram[i * n + i] = 1.0 + RIDGE;
    }
    for b in bad.iter() {
        let (ux, uy) = (&bx.row(b.x)[..mx], &by.row(b.y)[..my]);
        for (row, u) in atom.chunks_exact_mut(mx).zip(uy) {
            row.fill(0.0);
            axpy(*u, ux, row);
        }
        axpy(-b.value, &atom, z);
        for i in 0..n {
            axpy(-atom[i], &atom[i..], &mut gram[i * n + i..(i + 1) * n]);
        }
    }
    if cholesky(&mut gram, n) {
        solve(&gram, n, z);
    }
    for b in bad.iter_mut() {
        let (ux, uy) = (&bx.row(b.x)[..mx], &by.row(b.y)[..my]);
        b.value = uy.iter().zip(z.chunks_exact(mx)).map(|(u, row)| u * dot(row, ux)).sum();
    }
}
