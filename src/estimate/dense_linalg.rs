//! Small dense linear algebra on plain slices: inlined, so that it is compiled for the CPU that the caller's
//! dispatch found, and without allocation.

/// Evaluates an expression of the values given, compiled for the best instructions that this processor has. What it calls is compiled so
/// where it is `#[inline(always)]`; closures never are.
macro_rules! dispatch {
    (<$($life:lifetime),+> $($name:ident: $kind:ty = $value:expr),+ => $out:ty: $body:expr) => {{
        struct Call<$($life),+> {
            $($name: $kind),+
        }
        impl<$($life),+> pulp::NullaryFnOnce for Call<$($life),+> {
            type Output = $out;

            #[inline(always)]
            fn call(self) -> $out {
                let Self { $($name),+ } = self;
                $body
            }
        }
        pulp::Arch::new().dispatch(Call { $($name: $value),+ })
    }};
}
pub(crate) use dispatch;

/// Σ a b over slices of equal length.
#[inline(always)]
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().min(b.len());
    let (a, b) = (&a[..n], &b[..n]);
    let mut lanes = [0.0; 8];
    let (mut ca, mut cb) = (a.chunks_exact(8), b.chunks_exact(8));
    for (x, y) in (&mut ca).zip(&mut cb) {
        for l in 0..8 {
            lanes[l] += x[l] * y[l];
        }
    }
    let (mut a, mut b) = (ca.remainder(), cb.remainder());
    if a.len() >= 4 {
        for l in 0..4 {
            lanes[l] += a[l] * b[l];
        }
        (a, b) = (&a[4..], &b[4..]);
    }
    let rest: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    rest + sum_lanes(lanes)
}

/// One after another: summed in pairs, they would be kept in vectors of two.
#[inline(always)]
fn sum_lanes(lanes: [f64; 8]) -> f64 {
    let mut sum = 0.0;
    for lane in lanes {
        sum += lane;
    }
    sum
}

/// Σ w a b over slices of equal length, a multiple of 4.
#[inline(always)]
pub(crate) fn weighted_dot(w: &[f64], a: &[f64], b: &[f64]) -> f64 {
    let n = w.len();
    let (a, b) = (&a[..n], &b[..n]);
    let mut lanes = [0.0; 8];
    let ((w8, w4), (a8, a4), (b8, b4)) = (w.as_chunks::<8>(), a.as_chunks::<8>(), b.as_chunks::<8>());
    for ((w, a), b) in w8.iter().zip(a8).zip(b8) {
        for l in 0..8 {
            lanes[l] += w[l] * a[l] * b[l];
        }
    }
    if n % 8 >= 4 {
        for l in 0..4 {
            lanes[l] += w4[l] * a4[l] * b4[l];
        }
    }
    sum_lanes(lanes)
}

/// Adds the products of numbers, whose count is a multiple of four, to sixteen sums.
#[inline(always)]
pub(crate) fn add_products<const N: usize>(factors: [&[f64]; N], sums: &mut [[f64; 4]; 4]) {
    let count = factors[0].len();
    let mut rows = factors;
    for k in 0..N {
        rows[k] = &factors[k][..count];
    }
    let mut first = 0;
    while first + 16 <= count {
        for c in 0..4 {
            add_four(rows, first + 4 * c, &mut sums[c]);
        }
        first += 16;
    }
    for c in 0..4 {
        if first + 4 * c < count {
            add_four(rows, first + 4 * c, &mut sums[c]);
        }
    }
}

#[inline(always)]
fn add_four<const N: usize>(rows: [&[f64]; N], first: usize, sums: &mut [f64; 4]) {
    let mut products = [1.0; 4];
    for row in rows {
        let row = &row[first..first + 4];
        for l in 0..4 {
            products[l] *= row[l];
        }
    }
    for l in 0..4 {
        sums[l] += products[l];
    }
}

/// y += s x.
#[inline(always)]
pub(crate) fn axpy(s: f64, x: &[f64], y: &mut [f64]) {
    let n = x.len().min(y.len());
    let (x, y) = (&x[..n], &mut y[..n]);
    for k in 0..n {
        y[k] += s * x[k];
    }
}

/// Largest of `first` and the numbers of `v`.
#[inline(always)]
pub(crate) fn largest(first: f64, v: &[f64]) -> f64 {
    let mut lanes = [first; 8];
    let chunks = v.chunks_exact(8);
    let rest = chunks.remainder();
    for chunk in chunks {
        for l in 0..8 {
            lanes[l] = if chunk[l] > lanes[l] { chunk[l] } else { lanes[l] };
        }
    }
    lanes.iter().chain(rest).fold(first, |a, &x| a.max(x))
}

/// Writes `Σₖ weights[j][k·step]·row(k)` to row j of `out`, (K, width), for each of K weightings; the last weight is the last
/// row's. Row k is the `width` numbers, a multiple of 4, from k·stride on. Sums are kept in registers.
#[inline(always)]
pub(crate) fn combine<const K: usize>(
    weights: [&[f64]; K],
    step: usize,
    rows: &[f64],
    stride: usize,
    width: usize,
    out: &mut [f64],
) {
    let count = weights[0].len().div_ceil(step);
    let mut x = 0;
    // An addition takes several clock cycles: eight vectors of sums keep the adders busy.
    while x < width {
        let left = width - x;
        x = if K == 1 && left >= 32 {
            columns::<K, 32>(weights, step, count, rows, stride, width, x, out)
        } else if K <= 2 && left >= 16 {
            columns::<K, 16>(weights, step, count, rows, stride, width, x, out)
        } else if left >= 8 {
            columns::<K, 8>(weights, step, count, rows, stride, width, x, out)
        } else {
            columns::<K, 4>(weights, step, count, rows, stride, width, x, out)
        };
    }
}

#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn columns<const K: usize, const W: usize>(
    weights: [&[f64]; K],
    step: usize,
    count: usize,
    rows: &[f64],
    stride: usize,
    width: usize,
    x: usize,
    out: &mut [f64],
) -> usize {
    let mut sums = [[0.0; W]; K];
    for k in 0..count {
        let row = &rows[k * stride + x..k * stride + x + W];
        for j in 0..K {
            let weight = weights[j][k * step];
            for l in 0..W {
                sums[j][l] += weight * row[l];
            }
        }
    }
    for j in 0..K {
        out[j * width + x..j * width + x + W].copy_from_slice(&sums[j]);
    }
    x + W
}

/// Replaces the upper triangle of the n × n row-major `h` by its Cholesky factor U, H = UᵀU. `false` where H is not positive
/// definite to rounding. The strict lower triangle is neither read nor written. What is not coupled costs nothing.
#[inline(always)]
pub(crate) fn cholesky(h: &mut [f64], n: usize) -> bool {
    for i in 0..n {
        let (above, row) = h.split_at_mut(i * n);
        let row = &mut row[i..n];
        let diagonal = row[0];
        let mut rows = above.chunks_exact(n);
        // Four rows at a time: each number of this one is loaded and stored once for all four.
        while rows.len() >= 4
            && let (Some(a), Some(b), Some(c), Some(d)) = (rows.next(), rows.next(), rows.next(), rows.next())
        {
            let s = [a[i], b[i], c[i], d[i]];
            if s == [0.0; 4] {
                continue;
            }
            let (a, b, c, d) = (&a[i..n], &b[i..n], &c[i..n], &d[i..n]);
            for k in 0..row.len() {
                row[k] -= (s[0] * a[k] + s[1] * b[k]) + (s[2] * c[k] + s[3] * d[k]);
            }
        }
        for a in rows.filter(|a| a[i] != 0.0) {
            axpy(-a[i], &a[i..n], row);
        }
        let pivot = row[0];
        if !(pivot > 1e-15 * diagonal.abs() && pivot > 0.0) {
            return false;
        }
        let root = pivot.sqrt();
        row[0] = root;
        for v in &mut row[1..] {
            *v /= root;
        }
    }
    true
}

/// Solves UᵀU x = b in place.
#[inline(always)]
pub(crate) fn solve(u: &[f64], n: usize, b: &mut [f64]) {
    for i in 0..n {
        let (x, rest) = b[i..n].split_first_mut().expect("i < n");
        *x /= u[i * n + i];
        if *x != 0.0 {
            axpy(-*x, &u[i * n + i + 1..(i + 1) * n], rest);
        }
    }
    for i in (0..n).rev() {
        b[i] = (b[i] - dot(&u[i * n + i + 1..(i + 1) * n], &b[i + 1..n])) / u[i * n + i];
    }
}

/// Writes (UᵀU)⁻¹ into `out`, n × n, symmetric to the last bit.
#[inline(always)]
pub(crate) fn invert(u: &[f64], n: usize, out: &mut [f64]) {
    // W = U⁻¹, row by row from the last.
    for i in (0..n).rev() {
        let (row, below) = out[i * n..n * n].split_at_mut(n);
        row.fill(0.0);
        for (k, other) in (i + 1..n).zip(below.chunks_exact(n)) {
            let s = u[i * n + k];
            if s != 0.0 {
                axpy(-s, &other[k..], &mut row[k..]);
            }
        }
        let pivot = u[i * n + i];
        row[i] = 1.0;
        for v in &mut row[i..] {
            *v /= pivot;
        }
    }
    // W Wᵀ goes to the lower triangle, a row's diagonal last: nothing beyond needs it.
    for i in 0..n {
        for j in (i..n).rev() {
            out[j * n + i] = dot(&out[i * n + j..(i + 1) * n], &out[j * n + j..(j + 1) * n]);
        }
    }
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
        let mut indefinite = vec![1.0, 2.0, 0.0, 1.0];
        assert!(!cholesky(&mut indefinite, 2));
    }
}
