//! What an estimator made of a lens's frames: numbers, errors, ellipses, times.

use faer::Mat;
use faer::linalg::solvers::SolveLstsq;

use super::bench::PITCH_M;
use crate::estimate::Emitter;

/// Farther than this from every true spot, pixels, an emitter is invented; and so is a second one of the same spot.
const NEAR: f64 = 3.0;
/// The 95 % point of χ² with two degrees of freedom.
const ELLIPSE: f64 = 5.991;

/// What came of the frames of one lens, SNR and layout.
#[derive(Default)]
pub struct Tally {
    frames: usize,
    /// Frames with neither a spot missed nor an emitter invented.
    right: usize,
    pub spots: usize,
    missed: usize,
    pub invented: usize,
    found: Vec<Found>,
    times_ms: Vec<f64>,
}

/// A spot that was found.
struct Found {
    truth_m: [f64; 2],
    error_m: [f64; 2],
    cov_m2: [[f64; 2]; 2],
    bound_m2: f64,
}

impl Tally {
    /// Counts a frame: its emitters, its spots on the ground, their bounds, and how long it took. `scale`: from sensor to ground.
    pub fn count(&mut self, emitters: &[Emitter], truth: &[[f64; 2]], bounds: &[f64], scale: f64, time_ms: f64) {
        let near_m = NEAR * PITCH_M * scale;
        let distance = |i: usize, j: usize| (emitters[j].x_m - truth[i][0]).hypot(emitters[j].y_m - truth[i][1]);
        let mut pairs: Vec<(f64, usize, usize)> = (0..truth.len())
            .flat_map(|i| (0..emitters.len()).map(move |j| (i, j)))
            .map(|(i, j)| (distance(i, j), i, j))
            .filter(|p| p.0 < near_m)
            .collect();
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut seen, mut used) = (vec![false; truth.len()], vec![false; emitters.len()]);
        for (_, i, j) in pairs {
            if seen[i] || used[j] {
                continue;
            }
            (seen[i], used[j]) = (true, true);
            let e = &emitters[j];
            self.found.push(Found {
                truth_m: truth[i],
                error_m: [e.x_m - truth[i][0], e.y_m - truth[i][1]],
                cov_m2: e.cov_m2,
                bound_m2: bounds[i],
            });
        }
        let missed = seen.iter().filter(|s| !**s).count();
        let invented = used.iter().filter(|u| !**u).count();
        self.spots += truth.len();
        self.missed += missed;
        self.invented += invented;
        self.frames += 1;
        self.right += usize::from(missed + invented == 0);
        self.times_ms.push(time_ms);
    }

    /// Takes a cubic of the place out of the errors: what the spot's centre is, where its shape changes over the field, is a convention.
    pub fn without_distortion(mut self) -> Self {
        let far = self
            .found
            .iter()
            .flat_map(|f| f.truth_m)
            .fold(1e-9, |m: f64, t| m.max(t.abs()));
        let terms = |[x, y]: [f64; 2]| {
            let powers = (0..4).flat_map(|i| (0..4 - i).map(move |j| (i, j)));
            powers.map(move |(i, j)| (x / far).powi(i) * (y / far).powi(j))
        };
        let rows: Vec<Vec<f64>> = self.found.iter().map(|f| terms(f.truth_m).collect()).collect();
        let count = rows.first().map_or(0, Vec::len);
        if rows.len() < 2 * count || count == 0 {
            return self;
        }
        let matrix = Mat::from_fn(rows.len(), count, |i, k| rows[i][k]);
        let errors = Mat::from_fn(rows.len(), 2, |i, k| self.found[i].error_m[k]);
        let fitted = matrix.qr().solve_lstsq(&errors);
        // What the fit took of the noise comes back.
        let back = (rows.len() as f64 / (rows.len() - count) as f64).sqrt();
        let smooth = &matrix * &fitted;
        for (i, found) in self.found.iter_mut().enumerate() {
            found.error_m = [0, 1].map(|k| back * (found.error_m[k] - smooth[(i, k)]));
        }
        self
    }

    /// Share of the frames with the right number, of invented emitters and missed spots, of positions within their 95 % ellipse, %; root
    /// mean square of the error over the bound without the worst 5 %, as in the trade-off; the median and longest time.
    pub fn cell(mut self) -> String {
        let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
        let is_inside = |f: &&Found| {
            let ([dx, dy], [[a, b], [_, c]]) = (f.error_m, f.cov_m2);
            (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b) < ELLIPSE
        };
        let inside = self.found.iter().filter(is_inside).count();
        let square = |f: &Found| f.error_m.iter().map(|e| e * e).sum::<f64>() / f.bound_m2;
        let mut ratios: Vec<f64> = self.found.iter().map(square).collect();
        self.times_ms.sort_by(f64::total_cmp);
        ratios.sort_by(f64::total_cmp);
        let kept = &ratios[..ratios.len() * 19 / 20];
        let ratio = (kept.iter().sum::<f64>() / kept.len().max(1) as f64).sqrt();
        format!(
            "{:.1}, {:.1}, {:.1}, {:.0}, {ratio:.2}, {:.1}, {:.0}",
            percent(self.right, self.frames),
            percent(self.invented, self.spots),
            percent(self.missed, self.spots),
            percent(inside, self.found.len()),
            self.times_ms[self.times_ms.len() / 2],
            self.times_ms[self.times_ms.len() - 1],
        )
    }
}
