//! Ring misfit: a profile around every bright spot, the same for all and in all directions, that explains what the PSF leaves.
//!
//! Unlike the comparison offset by offset it allows for spots within each other's rings and tails. Each
//! quadrant of each spot is predicted by the profile of the others (cross-validation: Stone, 1974), so that light in one of them is not
//! taken for a ring.

use faer::linalg::solvers::Solve;
use faer::{Mat, Side};

use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model::svd_basis::Basis;

/// Distance of the profile's knots and the last one, σ: linear between them; finer ones follow the noise of faint halos.
const SPACING: f64 = 0.75;
const KNOTS: usize = 17;
/// Decrease of the deviance by the profile of the others, of all quadrants together; and standard deviations of a knot from which it counts.
/// These and the thresholds below are estimates; none was varied.
const SIGNIFICANT: f64 = 16.0;
const SIGNIFICANT_KNOT: f64 = 3.0;
/// Deviance that a quadrant keeps from which it holds light of its own.
const SIGNIFICANT_LIGHT: f64 = 36.0;
/// Square of the predicted light of a quadrant, over the noise's, from which it can be told whether it is there.
const VISIBLE: f64 = 9.0;
/// Spots from which rings are taken for the lens's: a single one may be several sources.
const LEAST_SPOTS: usize = 2;
/// Share of such quadrants that must show it, and their least number: lenses show it in nearly all.
const COMMON: f64 = 0.75;
const LEAST_QUADRANTS: usize = 3;
/// Largest share of the residual that the profile may leave, and standard deviations of its chance.
const MAX_LEFT: f64 = 0.35;
const CHANCE: f64 = 3.0;

/// The frame's residual around spots, pixel by pixel.
pub(crate) struct Rings<'a> {
    pub axes: [&'a Basis; 2],
    /// Residual over the noise, (Ny, `stride`).
    pub residual: &'a [f64],
    pub stride: usize,
    pub is_masked: &'a [bool],
    /// Norm of a spot of unit energy over the pixels.
    pub norm: f64,
}

/// Sums over the pixels of a quadrant.
struct Quadrant {
    matrix: Mat<f64>,
    vector: Mat<f64>,
    square: f64,
    pixels: f64,
}

impl Quadrant {
    fn new() -> Self {
        Self {
            matrix: Mat::zeros(KNOTS, KNOTS),
            vector: Mat::zeros(KNOTS, 1),
            square: 0.0,
            pixels: 0.0,
        }
    }

    /// rᵀt and tᵀt of a profile.
    fn against(&self, profile: &Mat<f64>) -> (f64, f64) {
        let rt = (profile.transpose() * &self.vector)[(0, 0)];
        let tt = (profile.transpose() * &self.matrix * profile)[(0, 0)];
        (rt, tt)
    }
}

impl Rings<'_> {
    /// What the rings of `bright` spots have in common as a share of a spot's light: the largest over the halo's height, and the largest
    /// within `core` σ. `None` where a profile does not explain the residual, but for chance where other sources explain it.
    pub fn common(&self, bright: &[&PointSource], core: f64, is_explained: bool) -> Option<(f64, f64)> {
        if bright.len() < LEAST_SPOTS {
            return None;
        }
        let quadrants = self.quadrants(bright);
        let mut whole = Quadrant::new();
        for q in &quadrants {
            whole.matrix += &q.matrix;
            whole.vector += &q.vector;
            whole.square += q.square;
            whole.pixels += q.pixels;
        }
        let (profile, inverse) = solve(&whole.matrix, &whole.vector)?;
        let (mut gain, mut visible, mut following) = (0.0, 0usize, 0usize);
        for q in &quadrants {
            let (others, _) = solve(&(&whole.matrix - &q.matrix), &(&whole.vector - &q.vector))?;
            let (rt, tt) = q.against(&others);
            gain += 2.0 * rt - tt;
            let left = q.square - 2.0 * rt + tt - q.pixels;
            let is_other =
                left > SIGNIFICANT_LIGHT + CHANCE * (2.0 * q.pixels).sqrt() && left > MAX_LEFT * (q.square - q.pixels);
            if tt > VISIBLE || is_other {
                visible += 1;
                following += usize::from(2.0 * rt > tt && !is_other);
            }
        }
        let (rt, tt) = whole.against(&profile);
        let excess = whole.square - whole.pixels;
        let left = excess - 2.0 * rt + tt;
        let most_left = if is_explained { 0.0 } else { MAX_LEFT * excess.max(0.0) };
        let is_common = gain > SIGNIFICANT
            && following >= LEAST_QUADRANTS
            && following as f64 >= COMMON * visible as f64
            && left < most_left + CHANCE * (2.0 * whole.pixels).sqrt();
        if !is_common {
            return None;
        }
        let (mut largest, mut in_core) = (0.0f64, 0.0f64);
        for k in 0..KNOTS {
            let d = SPACING * k as f64;
            let height = profile[(k, 0)].abs();
            if height < SIGNIFICANT_KNOT * inverse[(k, k)].max(0.0).sqrt() {
                continue;
            }
            // Light that is even over a spot's width, as a spot's own.
            let share = height / (self.norm * self.norm);
            largest = largest.max(share / halo::height(d * d));
            if d < core {
                in_core = in_core.max(share);
            }
        }
        Some((largest, in_core))
    }

    /// The pixels of each spot's quadrants, each given to the spot whose light is most there.
    fn quadrants(&self, bright: &[&PointSource]) -> Vec<Quadrant> {
        let [bx, by] = self.axes;
        let reach = SPACING * (KNOTS - 1) as f64;
        let mut quadrants: Vec<Quadrant> = (0..4 * bright.len()).map(|_| Quadrant::new()).collect();
        let mut row = [0.0; KNOTS];
        for y in 0..by.n {
            let v = 0.5 * (by.edges[y] + by.edges[y + 1]);
            for x in (0..bx.n).filter(|x| !self.is_masked[y * bx.n + x]) {
                let u = 0.5 * (bx.edges[x] + bx.edges[x + 1]);
                row.fill(0.0);
                let (mut owner, mut most) = (None, 0.0);
                for (i, spot) in bright.iter().enumerate() {
                    let (dx, dy) = (u - spot.u[0], v - spot.u[1]);
                    let d = dx.hypot(dy);
                    if d >= reach {
                        continue;
                    }
                    let place = d / SPACING;
                    let (k, t) = (place as usize, place.fract());
                    row[k] += spot.a * (1.0 - t);
                    row[k + 1] += spot.a * t;
                    let light = spot.a * halo::height(d * d);
                    if light > most {
                        most = light;
                        owner = Some(4 * i + usize::from(dx > 0.0) + 2 * usize::from(dy > 0.0));
                    }
                }
                let Some(owner) = owner else { continue };
                let q = &mut quadrants[owner];
                let r = self.residual[y * self.stride + x];
                q.square += r * r;
                q.pixels += 1.0;
                for (i, a) in row.iter().enumerate().filter(|(_, a)| **a != 0.0) {
                    q.vector[(i, 0)] += a * r;
                    for (j, b) in row.iter().enumerate().filter(|(_, b)| **b != 0.0) {
                        q.matrix[(i, j)] += a * b;
                    }
                }
            }
        }
        quadrants
    }
}

/// The profile of least squares and its covariance; a knot that no pixel determines is zero.
fn solve(matrix: &Mat<f64>, vector: &Mat<f64>) -> Option<(Mat<f64>, Mat<f64>)> {
    let mean = (0..KNOTS).map(|k| matrix[(k, k)]).sum::<f64>() / KNOTS as f64;
    let regular = Mat::from_fn(KNOTS, KNOTS, |i, j| {
        matrix[(i, j)] + if i == j { 1e-6 * mean + f64::MIN_POSITIVE } else { 0.0 }
    });
    let factors = regular.llt(Side::Lower).ok()?;
    Some((factors.solve(vector), factors.solve(Mat::<f64>::identity(KNOTS, KNOTS))))
}
