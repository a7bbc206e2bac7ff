//! Photon transfer: how a camera's noise grows with its light, from differences of successive frames (EMVA Standard 1288,
//! release 4.0, sections 5 and 6).

use ndarray::Array2;

/// Noise against light, in counts. Variance = `read_variance` + `gain` · (mean − dark level).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotonTransfer {
    /// Variance without light, quantisation included, counts².
    pub read_variance: f64,
    /// The level without light: that of the darkest pixels where no dark frames say it.
    pub dark_counts: f64,
    /// Counts an electron (system gain K); `None` where too little light grows the noise to tell.
    pub gain: Option<Gain>,
}

/// Slope of variance over mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gain {
    /// Counts an electron.
    pub counts_per_electron: f64,
    /// Relative standard deviation of the above.
    pub relative_std: f64,
    /// Root mean square of the levels' relative distances from the line, each less three of its own standard deviations: a raw
    /// sensor is below 0.1, a gamma curve above.
    pub misfit: f64,
    /// Brightest mean that the line was fitted to, counts.
    pub up_to_counts: f64,
}

/// Pixels a side of the tiles within which a beam's flicker is removed: a few spots wide, so that one beam fills one.
const TILE: usize = 8;
/// Largest share of a pixel in its own tile's fit: above it little of its noise is left in the residual.
const MOST_LEVERAGE: f64 = 0.5;
/// A tile in which the mean rises by more than this many standard deviations of one frame's noise holds a beam.
const LIT: f64 = 3.0;
/// Levels of light, each with the same number of pixels.
const LEVELS: usize = 24;
/// A pixel whose variance exceeds its level's median by this factor flickers by itself.
const UNSTEADY: f64 = 4.0;
/// The slope must be this many of its standard deviations above zero.
const SIGNIFICANT: f64 = 5.0;

/// Means and variances of pixels that can be used, with the number of differences behind each variance.
struct Pixels {
    /// Mean and variance.
    at: Vec<(f64, f64)>,
    differences: usize,
}

/// Measures noise against light. `frames` are counts of one scene at one setting; pixels that reach `saturation` once are left out, as
/// are those in `bad`.
///
/// Light may flicker and move a little between frames: in each tile the differences are fitted by the mean image and its two slopes.
/// `dark_counts` is the level without light, from dark frames.
///
/// # Errors
/// What the frames lack.
pub fn measure(
    frames: &[Array2<f64>],
    saturation: f64,
    bad: &Array2<bool>,
    dark_counts: Option<f64>,
) -> Result<PhotonTransfer, String> {
    const FEWEST: usize = 10;
    if frames.len() < FEWEST {
        return Err(format!(
            "{} frames; photon transfer takes {FEWEST} or more",
            frames.len()
        ));
    }
    let mean = mean_of(frames);
    let mut usable = bad.mapv(|b| !b);
    for frame in frames {
        usable.zip_mut_with(frame, |usable, value| {
            *usable &= value.is_finite() && *value < saturation
        });
    }
    let pixels = variances(frames, &mean, &usable);
    const FEWEST_PIXELS: usize = 4 * LEVELS;
    if pixels.at.len() < FEWEST_PIXELS {
        return Err(format!(
            "{} pixels are neither saturated nor bad; photon transfer takes {FEWEST_PIXELS}",
            pixels.at.len()
        ));
    }
    Ok(fit(pixels, dark_counts))
}

/// Mean of each pixel over frames.
pub fn mean_of(frames: &[Array2<f64>]) -> Array2<f64> {
    let mut sum = Array2::zeros(frames[0].dim());
    frames.iter().for_each(|frame| sum += frame);
    sum / frames.len() as f64
}

/// Variance of each usable pixel about what moves its whole tile.
fn variances(frames: &[Array2<f64>], mean: &Array2<f64>, usable: &Array2<bool>) -> Pixels {
    let (ny, nx) = mean.dim();
    let mut at = Vec::new();
    for y0 in (0..ny).step_by(TILE) {
        for x0 in (0..nx).step_by(TILE) {
            let (y1, x1) = ((y0 + TILE).min(ny), (x0 + TILE).min(nx));
            let places: Vec<(usize, usize)> = (y0..y1)
                .flat_map(|y| (x0..x1).map(move |x| (y, x)))
                .filter(|place| usable[*place])
                .collect();
            tile(frames, mean, &places, &mut at);
        }
    }
    Pixels {
        at,
        differences: frames.len() - 1,
    }
}

fn tile(frames: &[Array2<f64>], mean: &Array2<f64>, places: &[(usize, usize)], found: &mut Vec<(f64, f64)>) {
    let values = |f: &Array2<f64>| -> Vec<f64> { places.iter().map(|place| f[*place]).collect() };
    let means = values(mean);
    let steps = frames.windows(2).map(|pair| {
        let (a, b) = (values(&pair[0]), values(&pair[1]));
        let step: Vec<f64> = a
            .iter()
            .zip(&b)
            .map(|(a, b)| (b - a) * std::f64::consts::FRAC_1_SQRT_2)
            .collect();
        step
    });
    let steps: Vec<Vec<f64>> = steps.collect();
    let least = |v: &[f64]| v.iter().copied().fold(f64::INFINITY, f64::min);
    let most = |v: &[f64]| v.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    // Noise of the dimmer pixels, whatever beam flickers over the others.
    let mut each: Vec<f64> = (0..places.len())
        .map(|k| steps.iter().map(|s| s[k] * s[k]).sum::<f64>() / steps.len() as f64)
        .collect();
    each.sort_by(f64::total_cmp);
    let Some(quiet) = each.get(each.len() / 4) else {
        return;
    };
    let is_lit = most(&means) - least(&means) > LIT * quiet.sqrt();
    let basis = basis(mean, places, &means, is_lit);
    let leverage = |k: usize| basis.iter().map(|b| b[k] * b[k]).sum::<f64>();
    let mut squares = vec![0.0; places.len()];
    for step in &steps {
        let mut rest = step.clone();
        for b in &basis {
            let share: f64 = b.iter().zip(step).map(|(b, s)| b * s).sum();
            rest.iter_mut().zip(b).for_each(|(r, b)| *r -= share * b);
        }
        squares.iter_mut().zip(&rest).for_each(|(sum, r)| *sum += r * r);
    }
    for k in 0..places.len() {
        let left = 1.0 - leverage(k);
        if left > 1.0 - MOST_LEVERAGE {
            found.push((means[k], squares[k] / (left * steps.len() as f64)));
        }
    }
}

/// Orthonormal vectors over a tile's pixels: a constant, and where a beam is its mean image and the slopes of that.
fn basis(mean: &Array2<f64>, places: &[(usize, usize)], means: &[f64], is_lit: bool) -> Vec<Vec<f64>> {
    let (ny, nx) = mean.dim();
    let slope = |(y, x): (usize, usize), along_x: bool| {
        let (low, high) = match along_x {
            true => ((y, x.saturating_sub(1)), (y, (x + 1).min(nx - 1))),
            false => ((y.saturating_sub(1), x), ((y + 1).min(ny - 1), x)),
        };
        mean[high] - mean[low]
    };
    let mut vectors = vec![vec![1.0; places.len()]];
    if is_lit {
        vectors.push(means.to_vec());
        vectors.push(places.iter().map(|p| slope(*p, true)).collect());
        vectors.push(places.iter().map(|p| slope(*p, false)).collect());
    }
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for mut vector in vectors {
        let before = vector.iter().map(|v| v * v).sum::<f64>();
        for b in &basis {
            let share: f64 = b.iter().zip(&vector).map(|(b, v)| b * v).sum();
            vector.iter_mut().zip(b).for_each(|(v, b)| *v -= share * b);
        }
        let norm = vector.iter().map(|v| v * v).sum::<f64>();
        // What lies in the span of the others is rounding.
        if norm > 1e-9 * before {
            vector.iter_mut().for_each(|v| *v /= norm.sqrt());
            basis.push(vector);
        }
    }
    basis
}

/// Mean light, mean variance and number of pixels of one level.
#[derive(Clone, Copy, Debug)]
struct Level {
    mean: f64,
    variance: f64,
    /// Standard deviation of `variance` for a variance of one.
    relative_std: f64,
}

fn fit(mut pixels: Pixels, dark_counts: Option<f64>) -> PhotonTransfer {
    let differences = pixels.differences as f64;
    pixels.at.sort_by(|a, b| a.0.total_cmp(&b.0));
    let levels = levels(&pixels.at, differences);
    let dark = dark_counts.unwrap_or(levels[0].mean);
    let light = |level: &Level| level.mean - dark;
    // Weights follow the fit: the scatter of a variance is in proportion to it.
    let mut line = [levels[0].variance, 0.0];
    let mut covariance = [[0.0; 2]; 2];
    for _ in 0..20 {
        let mut normal = [[0.0; 2]; 2];
        let mut right = [0.0; 2];
        for level in &levels {
            let predicted = (line[0] + line[1] * light(level)).max(0.25 * level.variance);
            let weight = (predicted * level.relative_std).powi(-2);
            let row = [1.0, light(level)];
            for i in 0..2 {
                right[i] += weight * row[i] * level.variance;
                for j in 0..2 {
                    normal[i][j] += weight * row[i] * row[j];
                }
            }
        }
        let determinant = normal[0][0] * normal[1][1] - normal[0][1] * normal[1][0];
        covariance = [
            [normal[1][1] / determinant, -normal[0][1] / determinant],
            [-normal[1][0] / determinant, normal[0][0] / determinant],
        ];
        line = [0, 1].map(|i| covariance[i][0] * right[0] + covariance[i][1] * right[1]);
    }
    let slope_std = covariance[1][1].sqrt();
    let is_found = line[1].is_finite() && line[1] > SIGNIFICANT * slope_std;
    let misfit = |level: &Level| {
        let predicted = line[0] + line[1] * light(level);
        ((level.variance / predicted - 1.0).abs() - 3.0 * level.relative_std).max(0.0)
    };
    let gain = is_found.then(|| Gain {
        counts_per_electron: line[1],
        relative_std: slope_std / line[1],
        misfit: (levels.iter().map(|l| misfit(l).powi(2)).sum::<f64>() / levels.len() as f64).sqrt(),
        up_to_counts: levels[levels.len() - 1].mean,
    });
    PhotonTransfer {
        read_variance: if is_found { line[0].max(0.0) } else { levels[0].variance },
        dark_counts: dark,
        gain,
    }
}

/// Levels from the darkest up. `pixels` are sorted by their means. The upper half of the range has its levels too, however few pixels
/// it holds: they determine the slope.
fn levels(pixels: &[(f64, f64)], differences: f64) -> Vec<Level> {
    let n = pixels.len();
    let (darkest, brightest) = (pixels[n / 20].0, pixels[n - 1].0);
    // Half of the levels by number of pixels, half by light.
    let mut cuts: Vec<usize> = (1..LEVELS / 2).map(|k| k * n / (LEVELS / 2)).collect();
    cuts.extend((1..LEVELS / 2).map(|k| {
        let edge = darkest + (brightest - darkest) * (k as f64 / (LEVELS / 2) as f64).powi(2);
        pixels.partition_point(|p| p.0 < edge)
    }));
    cuts.extend([0, n]);
    cuts.sort_unstable();
    // A level of fewer pixels joins the one below.
    const FEWEST: usize = 8;
    let mut kept = vec![0];
    for cut in cuts {
        if cut - kept[kept.len() - 1] >= FEWEST && (n - cut >= FEWEST || cut == n) {
            kept.push(cut);
        }
    }
    kept.windows(2)
        .map(|range| {
            let pixels = &pixels[range[0]..range[1]];
            let mut sorted: Vec<f64> = pixels.iter().map(|p| p.1).collect();
            sorted.sort_by(f64::total_cmp);
            let median = sorted[sorted.len() / 2];
            let calm: Vec<&(f64, f64)> = pixels.iter().filter(|p| p.1 <= UNSTEADY * median).collect();
            let count = calm.len() as f64;
            Level {
                mean: calm.iter().map(|p| p.0).sum::<f64>() / count,
                variance: calm.iter().map(|p| p.1).sum::<f64>() / count,
                // Successive differences share a frame: 3/2 the variance of independent ones.
                relative_std: (3.0 / (differences * count)).sqrt(),
            }
        })
        .collect()
}

#[cfg(test)]
pub(super) mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// What a sensor would count.
    pub struct Sensor {
        pub gain: f64,
        pub read_std: f64,
        pub dark: f64,
        /// Relative flicker of each beam from frame to frame.
        pub flicker: f64,
    }

    impl Sensor {
        /// Counts of `n` frames with three beams of σ 2 pixels that flicker and tremble, over a faint background.
        pub fn frames(&self, n: usize, seed: u64) -> Vec<Array2<f64>> {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let mut normal = move || {
                let [u, v]: [f64; 2] = [random.random(), random.random()];
                (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
            };
            let beams = [(14.2, 12.7, 1500.0), (40.4, 21.1, 2600.0), (22.9, 45.3, 800.0)];
            (0..n)
                .map(|_| {
                    let now = beams.map(|(x, y, peak): (f64, f64, f64)| {
                        let peak = peak * (1.0 + self.flicker * normal()).max(0.1);
                        (x + 0.05 * normal(), y + 0.05 * normal(), peak)
                    });
                    Array2::from_shape_fn((56, 64), |(row, column)| {
                        let light = now.iter().map(|(x, y, peak)| {
                            let r2 = (column as f64 - x).powi(2) + (row as f64 - y).powi(2);
                            peak * (-r2 / 8.0).exp()
                        });
                        let light = 20.0 + light.sum::<f64>();
                        let noise = (self.gain * light + self.read_std.powi(2)).sqrt() * normal();
                        (self.dark + light + noise).round()
                    })
                })
                .collect()
        }
    }

    fn none_bad() -> Array2<bool> {
        Array2::from_elem((56, 64), false)
    }

    #[test]
    fn gain_and_read_noise_are_found_within_three_per_cent() {
        for (seed, flicker) in [(1, 0.0), (2, 0.3), (3, 0.3)] {
            let sensor = Sensor {
                gain: 0.5,
                read_std: 4.0,
                dark: 64.0,
                flicker,
            };
            let found = measure(&sensor.frames(100, seed), 4095.0, &none_bad(), Some(64.0)).unwrap();
            let gain = found.gain.unwrap();
            println!("{found:?}");
            assert!((gain.counts_per_electron / 0.5 - 1.0).abs() < 0.03, "{found:?}");
            let read = found.read_variance - 1.0 / 12.0;
            assert!((read.sqrt() / 4.0 - 1.0).abs() < 0.03, "{found:?}");
            assert!(gain.misfit < 0.1, "{found:?}");
        }
    }

    #[test]
    fn without_light_there_is_no_gain() {
        let sensor = Sensor {
            gain: 0.0,
            read_std: 4.0,
            dark: 64.0,
            flicker: 0.0,
        };
        let found = measure(&sensor.frames(60, 5), 4095.0, &none_bad(), None).unwrap();
        assert_eq!(found.gain, None);
        assert!((found.read_variance.sqrt() / 4.0 - 1.0).abs() < 0.03, "{found:?}");
        assert!(measure(&sensor.frames(5, 5), 4095.0, &none_bad(), None).is_err());
    }
}
