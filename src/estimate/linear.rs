//! Small dense linear algebra on plain slices: inlined, so that it is compiled for the CPU that the caller's
//! dispatch found, and without allocation.

/// Σ a b over slices of equal length.
#[inline(always)]
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().min(b.len());
    let (a, b) = (&a[..n], &b[..n]);
    let mut lanes = [0.0; 8];
    let (ca, cb) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = ca.remainder().iter().zip(cb.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in ca.zip(cb) {
        for l in 0..8 {
            lanes[l] += x[l] * y[l];
        }
    }
    rest + ((lanes[0] + lanes[4]) + (lanes[1] + lanes[5])) + ((lanes[2] + lanes[6]) + (lanes[3] + lanes[7]))
}

/// y += s x.
#[inline(always)]
pub(super) fn axpy(s: f64, x: &[f64], y: &mut [f64]) {
    let n = x.len().min(y.len());
    let (x, y) = (&x[..n], &mut y[..n]);
    for k in 0..n {
        y[k] += s * x[k];
    }
}

/// Replaces the lower triangle of the n × n row-major `h` by its Cholesky factor L, H = L Lᵀ. `false` where H is
/// not positive definite to rounding. The strict upper triangle is neither read nor written.
#[inline(always)]
pub(super) fn cholesky(h: &mut [f64], n: usize) -> bool {
    for i in 0..n {
        let (above, row) = h.split_at_mut(i * n);
        let row = &mut row[..n];
        for j in 0..i {
            let other = &above[j * n..j * n + j + 1];
            let s = row[j] - dot(&row[..j], &other[..j]);
            row[j] = s / other[j];
        }
        let pivot = row[i] - dot(&row[..i], &row[..i]);
        if !(pivot > 1e-15 * row[i].abs() && pivot > 0.0) {
            return false;
        }
        row[i] = pivot.sqrt();
    }
    true
}

/// Solves L Lᵀ x = b in place.
#[inline(always)]
pub(super) fn solve(l: &[f64], n: usize, b: &mut [f64]) {
    for i in 0..n {
        b[i] = (b[i] - dot(&l[i * n..i * n + i], &b[..i])) / l[i * n + i];
    }
    for i in (0..n).rev() {
        b[i] /= l[i * n + i];
        let s = -b[i];
        axpy(s, &l[i * n..i * n + i], &mut b[..i]);
    }
}

/// Writes (L Lᵀ)⁻¹ into `out`, n × n.
pub(super) fn invert(l: &[f64], n: usize, out: &mut [f64]) {
    out[..n * n].fill(0.0);
    for (i, row) in out.chunks_exact_mut(n.max(1)).take(n).enumerate() {
        row[i] = 1.0;
        solve(l, n, row);
    }
    // Each column is rounded on its own; what is handed on must be symmetric to the last bit.
    for i in 0..n {
        for j in 0..i {
            out[j * n + i] = out[i * n + j];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_times_matrix_is_the_identity() {
        let n = 11;
        let a: Vec<f64> = (0..n * n).map(|k| ((k * 37 % 101) as f64 / 50.0) - 1.0).collect();
        let h: Vec<f64> = (0..n * n)
            .map(|k| {
                dot(&a[k / n * n..k / n * n + n], &a[k % n * n..k % n * n + n]) + if k / n == k % n { 0.1 } else { 0.0 }
            })
            .collect();
        let mut l = h.clone();
        assert!(cholesky(&mut l, n));
        let mut inverse = vec![0.0; n * n];
        invert(&l, n, &mut inverse);
        for i in 0..n {
            for j in 0..n {
                let product: f64 = (0..n).map(|k| h[i * n + k] * inverse[k * n + j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-10);
            }
        }
        let mut indefinite = vec![1.0, 0.0, 2.0, 1.0];
        assert!(!cholesky(&mut indefinite, 2));
    }
}
