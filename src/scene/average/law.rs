//! Draws the mean of many independent fading and pointing factors at once.
//!
//! While the spot stays where it is, a frame sees the mean of T_int/T_coh values of ρ·h, ρ Gamma–Gamma and h the share
//! captured of a beam that misses. Its distribution is computed once: the characteristic function of one value by quadrature,
//! its n-th power, and from that the distribution function by the Fourier-cosine expansion (Fang and Oosterlee, 2008, "A novel
//! pricing method for European options based on Fourier-cosine series expansions", eq. 11). A frame then draws one uniform
//! number an emitter.

use std::f64::consts::PI;

use crate::optics::fading::GammaGamma;
use crate::scene::effects::{Capture, Pointing};

/// Cosine terms: the last frequency is 27 standard deviations' worth, where 16 or more smooth factors have died out.
const TERMS: usize = 256;
/// Points of the tabulated distribution function. Between them it is taken as linear, wrong by at most 10⁻⁵ of
/// probability (h²/8 times the density's steepest slope, h = 30/2048 standard deviations: 7·10⁻⁶).
const POINTS: usize = 2048;
/// From this many values on; fewer are drawn one by one.
pub(super) const WORTH_FROM: u32 = 16;
/// Quadrature nodes beyond which drawing is cheaper than preparing.
const MOST_NODES: usize = 4_000_000;

/// The mean's distribution function, to be inverted at a uniform number.
#[derive(Debug)]
pub(in crate::scene) struct MeanLaw {
    from: f64,
    step: f64,
    cumulative: Vec<f64>,
}

impl MeanLaw {
    /// The law of the mean of `n` values of ρ·h. `None` where the quadrature would need too many nodes.
    pub fn new(law: Option<GammaGamma>, pointing: Option<(&Pointing, &Capture)>, n: u32) -> Option<Self> {
        let captured = captured_nodes(law, pointing)?;
        let (nodes, shape) = match law {
            Some(law) => (fading_nodes(law.alpha, &captured)?, Some(law.beta)),
            None => (captured, None),
        };
        let mean: f64 = nodes.iter().map(|(w, c)| w * c).sum();
        let square: f64 = nodes.iter().map(|(w, c)| w * c * c).sum::<f64>() * shape.map_or(1.0, |b| 1.0 + 1.0 / b);
        let n = f64::from(n);
        let std = ((square - mean * mean).max(0.0) / n).sqrt();
        if std <= 1e-12 * mean {
            return Some(Self {
                from: mean,
                step: 0.0,
                cumulative: vec![0.0, 1.0],
            });
        }
        let from = (mean - 10.0 * std).max(0.0);
        let width = mean + 20.0 * std - from;
        let coefficients: Vec<f64> = (1..TERMS)
            .map(|k| {
                let t = k as f64 * PI / width;
                let (ln_modulus, angle) = log_characteristic(t / n, &nodes, shape);
                2.0 / (k as f64 * PI) * libm::exp(n * ln_modulus) * libm::cos(n * angle - t * from)
            })
            .collect();
        let step = width / (POINTS - 1) as f64;
        let mut highest = 0.0_f64;
        let cumulative = (0..POINTS).map(|j| {
            let share = j as f64 / (POINTS - 1) as f64;
            // Rounding may break the order by 10⁻¹⁵ far out.
            highest = highest.max((share + sine_series(&coefficients, PI * share)).min(1.0));
            highest
        });
        Some(Self {
            from,
            step,
            cumulative: cumulative.collect(),
        })
    }

    /// The value below which a share `u` of all means lies.
    pub fn quantile(&self, u: f64) -> f64 {
        let above = self
            .cumulative
            .partition_point(|c| *c <= u)
            .clamp(1, self.cumulative.len() - 1);
        let (a, b) = (self.cumulative[above - 1], self.cumulative[above]);
        let within = if b > a {
            ((u - a) / (b - a)).clamp(0.0, 1.0)
        } else {
            0.5
        };
        self.from + self.step * ((above - 1) as f64 + within)
    }
}

/// Σ c_k sin(kx), k from 1 (Clenshaw, 1955).
fn sine_series(coefficients: &[f64], x: f64) -> f64 {
    let twice = 2.0 * libm::cos(x);
    let (b1, _) = coefficients
        .iter()
        .rev()
        .fold((0.0, 0.0), |(b1, b2), c| (c + twice * b1 - b2, b1));
    b1 * libm::sin(x)
}

/// ln|φ| and arg φ of one value at `t`: φ(t) = Σ w (1 − itc/β)^−β, or Σ w exp(itc) without a second gamma factor.
fn log_characteristic(t: f64, nodes: &[(f64, f64)], shape: Option<f64>) -> (f64, f64) {
    let (re, im) = nodes.iter().fold((0.0, 0.0), |(re, im), (w, c)| {
        let (modulus, angle) = match shape {
            Some(beta) => {
                let x = t * c / beta;
                (w * libm::exp(-0.5 * beta * libm::log1p(x * x)), beta * libm::atan(x))
            }
            None => (*w, t * c),
        };
        (re + modulus * libm::cos(angle), im + modulus * libm::sin(angle))
    });
    (libm::log(libm::hypot(re, im)), libm::atan2(im, re))
}

/// Weights and values of h: the trapezoidal rule over both components of the miss, which converges exponentially for a
/// Gaussian weight (Trefethen and Weideman, 2014, section 4).
fn captured_nodes(law: Option<GammaGamma>, pointing: Option<(&Pointing, &Capture)>) -> Option<Vec<(f64, f64)>> {
    let Some((pointing, capture)) = pointing else {
        return Some(vec![(1.0, 1.0)]);
    };
    let sigma = pointing.jitter_m;
    let mean = pointing.boresight_m[0].hypot(pointing.boresight_m[1]);
    if sigma == 0.0 {
        return Some(vec![(1.0, capture.at(mean * mean))]);
    }
    // h falls over this length; with fading, ln h must be resolved to the narrowness of the gamma density besides.
    let scale = match capture {
        Capture::Flat { beam_radius_m } => 0.5 * beam_radius_m,
        Capture::Exact { step_m, .. } => 0.5 * Capture::PER_RADIUS * step_m,
    };
    let slope = (sigma / scale).powi(2) * (3.0 + mean / sigma);
    let step = law
        .map_or(0.5, |l| (0.5 / (slope * l.alpha.sqrt())).min(0.5))
        .min(0.3 * scale / sigma);
    let reach = (8.5 / step).ceil();
    if reach * reach > MOST_NODES as f64 / 64.0 {
        return None;
    }
    let reach = reach as i64;
    let mut nodes = Vec::with_capacity((2 * reach + 1) as usize * (reach + 1) as usize);
    for i in -reach..=reach {
        for j in 0..=reach {
            let (x, y) = (i as f64 * step, j as f64 * step);
            let twofold = if j == 0 { 1.0 } else { 2.0 };
            let weight = twofold * libm::exp(-0.5 * (x * x + y * y));
            if weight > 1e-17 {
                nodes.push((weight, capture.at((mean + sigma * x).powi(2) + (sigma * y).powi(2))));
            }
        }
    }
    Some(normalised(nodes))
}

/// Weights and values of a·h, a ~ Gamma(α, 1/α): the trapezoidal rule over ln(a·h).
fn fading_nodes(alpha: f64, captured: &[(f64, f64)]) -> Option<Vec<(f64, f64)>> {
    // ln of the density of ln a, its peak at 0 taken off.
    let ln_density = |u: f64| alpha * (u - f64::exp_m1(u));
    let step = (0.6 / alpha.sqrt()).min(0.25);
    // The first place on either side where the density is nothing; for an absurd α there is none within reach.
    let end = |step: f64| {
        let mut places = (0..MOST_NODES).map(|k| k as f64 * step);
        places.find(|u| ln_density(*u) <= -38.0)
    };
    let (low, high) = (end(-step)?, end(step)?);
    let logs: Vec<(f64, f64)> = captured
        .iter()
        .filter(|(_, h)| *h > 0.0)
        .map(|(w, h)| (*w, libm::log(*h)))
        .collect();
    let nearest = logs.iter().map(|l| l.1).fold(f64::NEG_INFINITY, f64::max);
    // Weightless misses may reach far down; what they add to the sum of powers is less than their weight.
    let farthest = logs
        .iter()
        .filter(|l| l.0 > 1e-16)
        .map(|l| l.1)
        .fold(nearest, f64::min)
        .max(-60.0);
    let count = ((high - low + nearest - farthest) / step).ceil() as usize + 1;
    if count.saturating_mul(logs.len()) > MOST_NODES {
        return None;
    }
    let nodes = (0..count).map(|m| {
        let u = low + farthest + m as f64 * step;
        let weight = logs.iter().map(|(w, l)| w * libm::exp(ln_density(u - l))).sum();
        (weight, libm::exp(u))
    });
    Some(normalised(nodes.collect()))
}

fn normalised(mut nodes: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    let total: f64 = nodes.iter().map(|n| n.0).sum();
    for node in &mut nodes {
        node.0 /= total;
    }
    nodes
}
