//! Spots of eight lenses, as densities in pixels.

use std::f64::consts::TAU;

/// Width that the estimator is told, pixels: the best Gaussian's of each kind, within 10 %.
pub const SIGMA: f64 = 2.1;

/// A lens's spot.
#[derive(Clone, Copy)]
pub struct Lens {
    pub name: &'static str,
    /// Light per square pixel at an offset from the spot's centre, pixels, of a spot whose place is given in half sensors.
    pub density: fn(x: f64, y: f64, u: [f64; 2]) -> f64,
    /// Whether the spot is the same all over the sensor.
    pub is_uniform: bool,
}

pub const AIRY: Lens = uniform("Airy disc", |x, y, _| {
    let r = (x.hypot(y) * 3.8317 / (2.9 * SIGMA)).max(1e-9);
    (2.0 * libm::j1(r) / r).powi(2)
});

pub const LENSES: [Lens; 8] = [
    uniform("Gaussian", |x, y, _| gaussian(x, y, SIGMA)),
    uniform("1 % wider", |x, y, _| gaussian(x, y, 1.01 * SIGMA)),
    AIRY,
    uniform("Moffat, β 2.5", |x, y, _| {
        (1.0 + (x * x + y * y) / (2.05 * SIGMA).powi(2)).powf(-2.5)
    }),
    uniform("defocus disc", |x, y, _| {
        1.0 / (1.0 + ((x.hypot(y) - 1.8 * SIGMA) / 0.5).exp())
    }),
    Lens {
        name: "coma, growing off axis",
        density: coma,
        is_uniform: false,
    },
    uniform("astigmatism at 45°", |x, y, _| {
        let [a, b] = [x + y, x - y].map(|d| d / 2f64.sqrt());
        (-0.5 * ((a / 2.5).powi(2) + (b / 1.8).powi(2))).exp()
    }),
    uniform("ghost of 2 %", |x, y, _| {
        gaussian(x, y, SIGMA) + 0.02 * gaussian(x - 9.0, y + 6.0, SIGMA)
    }),
];

const fn uniform(name: &'static str, density: fn(f64, f64, [f64; 2]) -> f64) -> Lens {
    Lens {
        name,
        density,
        is_uniform: true,
    }
}

fn gaussian(x: f64, y: f64, sigma: f64) -> f64 {
    (-0.5 * (x * x + y * y) / (sigma * sigma)).exp()
}

/// Circles of the aperture's zones (Welford, 1986, ch. 8), blurred.
fn coma(x: f64, y: f64, [u, v]: [f64; 2]) -> f64 {
    let (size, far) = (1.2 * u.hypot(v), u.hypot(v).max(1e-9));
    let (along, across) = ((x * u + y * v) / far, (y * u - x * v) / far);
    // The outermost circle reaches 2·size from its own centre at most; beyond five widths there is no light.
    if x.hypot(y) > 2.0 * size + 5.0 * SIGMA {
        return 0.0;
    }
    let zone = |k: usize| {
        let (radius, angle) = (((k / 12) as f64 + 0.5) / 5.0, (k % 12) as f64 * TAU / 12.0);
        let centre = size * (2.0 * radius - 1.0);
        gaussian(
            along - centre - size * radius * angle.cos(),
            across - size * radius * angle.sin(),
            0.85 * SIGMA,
        )
    };
    (0..60).map(zone).sum()
}
