//! What pixels collect of a template's splines, and its adjoint.

use crate::optics::Axis;

/// What the pixels of one axis collect of the splines of a spot: pixel k of `pixels` touches the splines from `first[k]` on.
pub struct Band {
    pub pixels: std::ops::Range<usize>,
    pub width: usize,
    first: Vec<usize>,
    /// (pixels, width).
    value: Vec<f64>,
    /// Derivative by the spot's place, 1/m.
    slope: Vec<f64>,
}

impl Band {
    /// For a spot at `at` on `axis`, `n` splines, knots `knot_m` apart.
    pub fn new(axis: &Axis, at: f64, n: usize, knot_m: f64) -> Self {
        let radius = 0.5 * (n + 3) as f64 * knot_m;
        let pixels = pixels_within(axis, at, radius);
        let width = ((axis.pitch_m / knot_m).ceil() as usize + 4).min(n);
        let (mut first, mut value, mut slope) = (Vec::new(), Vec::new(), Vec::new());
        for k in pixels.clone() {
            let [lo, hi] = [k, k + 1].map(|e| (axis.edge(e) - at + radius) / knot_m);
            let start = ((lo - 4.0).ceil().max(0.0) as usize).min(n - width);
            first.push(start);
            for i in start..start + width {
                let [(below, b0), (above, b1)] = [lo, hi].map(|t| cardinal(t - i as f64));
                value.push(above - below);
                slope.push((b0 - b1) / knot_m);
            }
        }
        Self {
            pixels,
            width,
            first,
            value,
            slope,
        }
    }

    /// Leaves only the pixels of a range.
    pub fn clip(&mut self, range: &std::ops::Range<usize>) {
        let start = self.pixels.start.max(range.start);
        let end = self.pixels.end.min(range.end).max(start);
        let skip = start - self.pixels.start;
        let skip = skip.min(self.first.len());
        self.first.drain(..skip);
        self.value.drain(..skip * self.width);
        self.slope.drain(..skip * self.width);
        self.pixels = start..end;
    }

    fn line(&self, k: usize, slope: bool) -> (usize, &[f64]) {
        let values = if slope { &self.slope } else { &self.value };
        (self.first[k], &values[k * self.width..(k + 1) * self.width])
    }
}

/// Pixels along one axis that reach within `radius_m` of a place.
pub fn pixels_within(axis: &Axis, at: f64, radius_m: f64) -> std::ops::Range<usize> {
    let pixel = |x: f64| ((x - axis.min_m) / axis.pitch_m).clamp(0.0, axis.n as f64);
    let first = pixel(at - radius_m).floor() as usize;
    first..(pixel(at + radius_m).ceil() as usize).max(first)
}

/// Integral and value of the cardinal cubic B-spline on [0, 4] at t (de Boor, 1978, ch. IX).
fn cardinal(t: f64) -> (f64, f64) {
    // From the middle out: B₃ is even about 2.
    let (r, is_right) = ((t - 2.0).abs(), t > 2.0);
    let (half, value) = if r >= 2.0 {
        (0.5, 0.0)
    } else if r >= 1.0 {
        let s = 2.0 - r;
        (0.5 - s.powi(4) / 24.0, s.powi(3) / 6.0)
    } else {
        (
            2.0 / 3.0 * r - r.powi(3) / 3.0 + r.powi(4) / 8.0,
            2.0 / 3.0 - r * r + 0.5 * r.powi(3),
        )
    };
    (if is_right { 0.5 + half } else { 0.5 - half }, value)
}

/// Buffers of [`forward`] and [`adjoint`].
#[derive(Default)]
pub struct Scratch(Vec<f64>);

/// What pixels collect of n×n splines: (rows, columns) of the two bands, with the derivative along x or y where asked for.
pub fn forward(
    splines: &[f64],
    n: usize,
    [x, y]: [&Band; 2],
    slope: [bool; 2],
    scratch: &mut Scratch,
    out: &mut Vec<f64>,
) {
    let (nx, ny) = (x.pixels.len(), y.pixels.len());
    let t = &mut scratch.0;
    t.clear();
    t.resize(n * nx, 0.0);
    for j in 0..n {
        let line = &splines[j * n..(j + 1) * n];
        for k in 0..nx {
            let (first, values) = x.line(k, slope[0]);
            t[j * nx + k] = line[first..first + x.width]
                .iter()
                .zip(values)
                .map(|(a, b)| a * b)
                .sum();
        }
    }
    out.clear();
    out.resize(nx * ny, 0.0);
    if out.is_empty() {
        return;
    }
    for (k, row) in out.chunks_exact_mut(nx).enumerate().take(ny) {
        let (first, values) = y.line(k, slope[1]);
        for (w, line) in values.iter().zip(t[first * nx..].chunks_exact(nx)) {
            for (o, v) in row.iter_mut().zip(line) {
                *o += w * v;
            }
        }
    }
}

/// The adjoint of [`forward`] without derivatives: the gradient of n×n splines for one of the pixels.
pub fn adjoint(pixels: &[f64], n: usize, [x, y]: [&Band; 2], scratch: &mut Scratch, out: &mut Vec<f64>) {
    let (nx, ny) = (x.pixels.len(), y.pixels.len());
    out.clear();
    out.resize(n * n, 0.0);
    if nx * ny == 0 {
        return;
    }
    let t = &mut scratch.0;
    t.clear();
    t.resize(n * nx, 0.0);
    for (k, row) in pixels.chunks_exact(nx).enumerate().take(ny) {
        let (first, values) = y.line(k, false);
        for (w, line) in values.iter().zip(t[first * nx..].chunks_exact_mut(nx)) {
            for (o, v) in line.iter_mut().zip(row) {
                *o += w * v;
            }
        }
    }
    for j in 0..n {
        let line = &mut out[j * n..(j + 1) * n];
        for k in 0..nx {
            let (first, values) = x.line(k, false);
            let value = t[j * nx + k];
            for (o, w) in line[first..first + x.width].iter_mut().zip(values) {
                *o += value * w;
            }
        }
    }
}
