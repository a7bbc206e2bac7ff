//! A round spot learned from the frames that are searched: what lies between the Gaussian of the config and a calibration.
//!
//! The spot is p(r) = Σ_j c_j·B₃(s(r) − j), a cubic spline whose knots lie the farther apart the farther from the centre, the same for all
//! sources. A frame adds what it says of the c_j under white noise, whatever the places and energies of its sources and its background, which are
//! projected out (Golub and Pereyra, 1973). The prior is the Gaussian.

use faer::linalg::solvers::Solve;
use faer::{Mat, Scale, Side};

use crate::estimate::model::bases::Bases;
use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model::separable_model::WHOLE;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::optics::spot::{Field, SpotShape, Template};
use crate::optics::{Camera, DisplacedSpots};

/// Radius out to which the spot is learned, σ.
const REACH: f64 = 12.0;
/// Distance of the knots at the centre: in pixels, and the least, σ.
const KNOT_PIXELS: f64 = 0.5;
const LEAST_KNOT: f64 = 0.2;
/// Distance from which on knots lie farther apart, σ: they are even steps of asinh(r/this).
const EVEN: f64 = 3.0;
/// Standard deviation of the prior, as a share of the Gaussian's peak, over the halo's height.
const PRIOR: f64 = 0.1;
/// Light of a pixel in units of the noise below which the brightest spot's tail is left out.
const VISIBLE: f64 = 0.1;
/// What earlier frames say counts so much less with every later one.
const MEMORY: f64 = 1.0 - 1.0 / 32.0;
/// What is left out of the separable terms, and how far spots may differ, over the inverse of the signal-to-noise ratio of all spots together.
const LEFT_OUT: f64 = 10.0;
const ERROR: f64 = 5.0;
/// Least share that is left out of the separable terms.
const LEAST_LEFT_OUT: f64 = 1e-4;
/// Parameters of a source and of the background.
const OF_SOURCE: usize = 3;
const OF_BACKGROUND: usize = 3;
/// Nodes of Gauss and Legendre within a pixel along an axis, in pitches.
const NODES: [f64; 2] = [-0.288_675_134_594_812_9, 0.288_675_134_594_812_9];
/// Height of the Gaussian of unit light, 1/σ².
const PEAK: f64 = 1.0 / std::f64::consts::TAU;

/// What frames said of the spot.
#[derive(Clone)]
pub(crate) struct LearnedSpot {
    /// Distance of the knots at the centre, σ.
    knot: f64,
    information: Mat<f64>,
    vector: Mat<f64>,
    /// The c_j, 1/σ²: the Gaussian's at first.
    coefficients: Vec<f64>,
    /// Σ of the spots' squared signal-to-noise ratios.
    square: f64,
    /// Energy of the brightest spot of the last frame.
    brightest: f64,
}

impl LearnedSpot {
    pub fn new(bases: &Bases) -> Self {
        let knot = (KNOT_PIXELS * bases.pitch()).max(LEAST_KNOT);
        let count = place(knot, REACH).ceil() as usize;
        Self {
            knot,
            information: Mat::zeros(count, count),
            vector: Mat::zeros(count, 1),
            coefficients: gaussian(knot, count),
            square: 0.0,
            brightest: 0.0,
        }
    }

    /// What was known before, to be linearised where `other` is.
    pub fn at(&self, other: &Self) -> Self {
        Self {
            coefficients: other.coefficients.clone(),
            ..self.clone()
        }
    }

    /// Adds what a frame says, whose sources are these, smeared by motion.
    pub fn add(
        &mut self,
        bases: &Bases,
        frame: &PreprocessedFrame,
        smear: Option<&DisplacedSpots>,
        sources: &[PointSource],
    ) {
        let count = self.coefficients.len();
        let (mut normal, right) = self.normal_equations(bases, frame, smear, sources);
        let others = normal.nrows() - count;
        for k in count..normal.nrows() {
            normal[(k, k)] = normal[(k, k)] * (1.0 + 1e-9) + f64::MIN_POSITIVE;
        }
        let part = |row, column, rows, columns| normal.as_ref().submatrix(row, column, rows, columns);
        let cross = part(count, 0, others, count);
        let Ok(factors) = part(count, count, others, others).llt(Side::Lower) else {
            return;
        };
        let projected = factors.solve(cross);
        let information = part(0, 0, count, count) - cross.transpose() * &projected;
        let vector = right.as_ref().subrows(0, count) - projected.transpose() * right.as_ref().subrows(count, others);
        self.information = Scale(MEMORY) * &self.information + information;
        self.vector = Scale(MEMORY) * &self.vector + vector;
        let norm = halo::spot_norm(bases);
        self.square = MEMORY * self.square + sources.iter().map(|s| (s.a * norm).powi(2)).sum::<f64>();
        self.brightest = sources.iter().fold(0.0, |most, s| s.a.max(most));
        self.solve();
    }

    /// JᵀJ and Jᵀz of the c_j, then of each source's place along x and y and energy, then of the background.
    fn normal_equations(
        &self,
        bases: &Bases,
        frame: &PreprocessedFrame,
        smear: Option<&DisplacedSpots>,
        sources: &[PointSource],
    ) -> (Mat<f64>, Mat<f64>) {
        let count = self.coefficients.len();
        let motion = smear.map_or(WHOLE.as_slice(), |smear| &smear.nodes);
        let displacement = |u: [f64; 2]| smear.map_or([0.0; 2], |smear| smear.displacement(u));
        let background = count + OF_SOURCE * sources.len();
        let size = background + OF_BACKGROUND;
        let (mut normal, mut right) = (Mat::zeros(size, size), Mat::zeros(size, 1));
        let (bx, by) = (&bases.x, &bases.y);
        let centre = |edges: &[f64], k: usize| 0.5 * (edges[k] + edges[k + 1]);
        let mut row = vec![0.0; size];
        let mut used: Vec<usize> = Vec::new();
        for y in 0..by.n {
            let v = centre(&by.edges, y);
            for x in (0..bx.n).filter(|x| !frame.is_masked[y * bx.n + x]) {
                let u = centre(&bx.edges, x);
                for (i, source) in sources.iter().enumerate() {
                    let offset = [u - source.u[0], v - source.u[1]];
                    if offset[0].hypot(offset[1]) >= REACH {
                        continue;
                    }
                    let (own, moved) = (count + OF_SOURCE * i, displacement(source.u));
                    for (part, share) in motion {
                        let offset = [0, 1].map(|k| offset[k] - part * moved[k]);
                        self.add_to_row([bx.pitch(), by.pitch()], share * source.a, offset, &mut row, own);
                    }
                    used.extend(own..own + OF_SOURCE);
                }
                used.extend((0..count).filter(|j| row[*j] != 0.0));
                row[background..].copy_from_slice(&[1.0, u, v]);
                used.extend(background..size);
                for &i in &used {
                    right[(i, 0)] += row[i] * frame.pixels[y * bx.n + x];
                    for &j in &used {
                        normal[(i, j)] += row[i] * row[j];
                    }
                }
                used.drain(..).for_each(|k| row[k] = 0.0);
            }
        }
        (normal, right)
    }

    /// Adds to a pixel's row what a source of energy `a` casts on it, whose own parameters begin at `own`.
    fn add_to_row(&self, pitches: [f64; 2], a: f64, offset: [f64; 2], row: &mut [f64], own: usize) {
        let light = a * pitches[0] * pitches[1] / (NODES.len() * NODES.len()) as f64;
        for node in NODES.iter().flat_map(|x| NODES.map(|y| [*x, y])) {
            let at = [0, 1].map(|k| offset[k] + node[k] * pitches[k]);
            let r = at[0].hypot(at[1]).max(1e-9);
            let (mut height, mut slope) = (0.0, 0.0);
            for (j, value, derivative) in splines(place(self.knot, r), self.coefficients.len()) {
                row[j] += light * value;
                height += self.coefficients[j] * value;
                slope += self.coefficients[j] * derivative;
            }
            let per_place = light * slope / (self.knot * (r / EVEN).hypot(1.0) * r);
            row[own] -= per_place * at[0];
            row[own + 1] -= per_place * at[1];
            row[own + 2] += light * height;
        }
    }

    /// The c_j of least squares under the prior.
    fn solve(&mut self) {
        let count = self.coefficients.len();
        let prior = gaussian(self.knot, count);
        let precision = |j: usize| {
            let r = radius(self.knot, j as f64);
            (PRIOR * PEAK * halo::height(r * r)).powi(-2)
        };
        let mut matrix = self.information.clone();
        let mut vector = self.vector.clone();
        for (j, c) in prior.iter().enumerate() {
            matrix[(j, j)] += precision(j);
            vector[(j, 0)] += precision(j) * c;
        }
        if let Ok(factors) = matrix.llt(Side::Lower) {
            let solved = factors.solve(&vector);
            self.coefficients = (0..count).map(|j| solved[(j, 0)]).collect();
        }
    }

    /// The spot, and the share of its light by which it may differ from those of the frames if these are round. None where it has no light.
    pub fn shape(&self, camera: &Camera) -> Option<(SpotShape, f64)> {
        let sigma = camera.spot_sigma_m;
        let pixel = camera.x.pitch_m * camera.y.pitch_m / (sigma * sigma);
        let is_seen = |c: &f64| c.abs() * pixel * self.brightest > VISIBLE;
        let seen = self.coefficients.iter().rposition(is_seen).map_or(1, |k| k + 1);
        let density = |x: f64, y: f64| -> f64 {
            let splines = splines(place(self.knot, x.hypot(y) / sigma), seen);
            splines.map(|(j, value, _)| self.coefficients[j] * value).sum()
        };
        let field = Field {
            half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
        };
        let end = radius(self.knot, seen as f64 + 1.0);
        let template = Template::of_density(field, self.knot * sigma, end * sigma, density);
        let unit = 1.0 / self.square.sqrt();
        let shape = SpotShape::from_template(&template, (LEFT_OUT * unit).max(LEAST_LEFT_OUT))?;
        Some((shape, (ERROR * unit).min(Camera::LARGEST_SPOT_ERROR)))
    }
}

/// Knots between the centre and a distance, σ.
fn place(knot: f64, r: f64) -> f64 {
    (r / EVEN).asinh() * EVEN / knot
}

/// The distance, σ, of a place between the knots.
fn radius(knot: f64, place: f64) -> f64 {
    EVEN * (place * knot / EVEN).sinh()
}

/// Of the splines that are not zero `t` knots from the centre, about which they are even: index, value and derivative by `t`.
fn splines(t: f64, count: usize) -> impl Iterator<Item = (usize, f64, f64)> {
    let (first, s) = (t.floor(), t - t.floor());
    let rest = 1.0 - s;
    let values = [
        rest.powi(3) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s.powi(3)) / 6.0,
        (4.0 - 6.0 * rest * rest + 3.0 * rest.powi(3)) / 6.0,
        s.powi(3) / 6.0,
    ];
    let slopes = [
        -0.5 * rest * rest,
        1.5 * s * s - 2.0 * s,
        2.0 * rest - 1.5 * rest * rest,
        0.5 * s * s,
    ];
    (0..4).filter_map(move |n| {
        let j = (first as i64 - 1 + n as i64).unsigned_abs() as usize;
        (j < count).then_some((j, values[n], slopes[n]))
    })
}

/// Coefficients of the Gaussian of unit light and width: its values with the splines' blur taken out to second order.
fn gaussian(knot: f64, count: usize) -> Vec<f64> {
    let at = |j: f64| PEAK * (-0.5 * radius(knot, j).powi(2)).exp();
    let of = |j: f64| at(j) - (at(j + 1.0) - 2.0 * at(j) + at(j - 1.0)) / 6.0;
    (0..count).map(|j| of(j as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::model::svd_basis::Basis;
    use crate::optics::Config;

    /// Light of a Moffat profile of index 2.5 and core radius 2.05σ per area, 1/σ².
    fn moffat(r: f64) -> f64 {
        const CORE2: f64 = 2.05 * 2.05;
        1.5 / (std::f64::consts::PI * CORE2) * (1.0 + r * r / CORE2).powf(-2.5)
    }

    #[test]
    fn a_halo_is_learned_from_one_frame_without_noise() {
        let camera = Config::default().camera().unwrap();
        let bases = Bases::new([&camera.x, &camera.y].map(|axis| Basis::pixels(axis, camera.spot_sigma_m)));
        let sources = [[-6.1, -5.3], [5.2, -4.4], [-4.7, 5.6], [5.9, 6.3]].map(|u| PointSource::new(u, 1e5));
        let [columns, rows] = bases.axes().map(|b| b.edges.windows(2).collect::<Vec<_>>());
        let mut frame = PreprocessedFrame {
            is_masked: vec![false; columns.len() * rows.len()],
            ..PreprocessedFrame::default()
        };
        const STEPS: usize = 4;
        for (row, column) in rows.iter().flat_map(|r| columns.iter().map(move |c| (r, c))) {
            let at = |edges: &[f64], k: usize| edges[0] + (edges[1] - edges[0]) * (k as f64 + 0.5) / STEPS as f64;
            let mut light = 0.0;
            for k in 0..STEPS * STEPS {
                let (u, v) = (at(column, k % STEPS), at(row, k / STEPS));
                light += sources
                    .iter()
                    .map(|s| s.a * moffat((u - s.u[0]).hypot(v - s.u[1])))
                    .sum::<f64>();
            }
            let area = bases.x.pitch() * bases.y.pitch();
            frame.pixels.push(3.0 + light * area / (STEPS * STEPS) as f64);
        }
        let mut spot = LearnedSpot::new(&bases);
        for _ in 0..3 {
            spot.add(&bases, &frame, None, &sources);
        }
        let (shape, error) = spot.shape(&camera).unwrap();
        let sigma = camera.spot_sigma_m;
        let density = |r: f64| shape.density([0.0; 2], [r * sigma, 0.0]) * sigma * sigma;
        // The light beyond the reach is background.
        for r in [0.0, 0.5, 1.0, 2.0, 3.0, 5.0] {
            let off = density(r) / density(0.0) - moffat(r) / moffat(0.0);
            assert!(off.abs() < 2e-3, "{r}: {off}");
        }
        assert!(error < 1e-3 && shape.terms() < 12, "{error} {}", shape.terms());
    }
}
