//! Accuracy against observation time: one long exposure against many short ones of the same light.

use std::fmt::Write;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::snapshots::{Snapshots, Walk};
use super::{CUTOFF_M, Cell, Error, Noise};
use crate::assign::ospa;
use crate::estimate;
use crate::optics::Camera;
use crate::stats::median;

/// Exposures, s: the paper's, and what a camera of 10, 100 or 1000 frames a second takes.
pub(super) const EXPOSURES_S: [f64; 4] = [1.0, 0.1, 0.01, 0.001];
/// How long users are observed, s.
pub(super) const OBSERVED_S: [f64; 4] = [0.01, 0.1, 1.0, 10.0];
const SIGMAS_MM: [f64; 3] = [4.0, 6.0, 8.0];
/// Time within which a beam's fading is one draw, s, and the relative standard deviation of that draw.
const COHERENCE_S: f64 = 0.01;
const FADING_STD: f64 = 0.9;
/// Estimators answer for at most this many frames: more take long.
const MOST_FRAMES: usize = 100;

/// What comes of observing a cell for a time.
pub(super) struct Row {
    pub cell: Cell,
    /// Whether each read adds the same noise, instead of noise that grows with the exposure.
    pub is_read_noise: bool,
    pub observed_s: f64,
    /// By exposure: none where it is longer than the time.
    pub outcomes: [Option<Outcome>; EXPOSURES_S.len()],
}

/// Medians over emitters, m², both axes summed.
pub(super) struct Outcome {
    pub bound_m2: f64,
    /// Error of `sequence`, or of `ml` on a single frame; none where most are missed, or where it was not measured.
    pub error_m2: Option<f64>,
}

/// Measures `scenes` scenes of each cell. `progress` is called after each cell, of which there are [`CELLS`].
pub(super) fn measure_all(scenes: usize, seed: u64, progress: &mut dyn FnMut(&Cell)) -> Result<Vec<Row>, Error> {
    let mut rows = Vec::new();
    for is_read_noise in [false, true] {
        for sigma_mm in SIGMAS_MM {
            let cell = Cell::new(Noise::Energy, sigma_mm, 64);
            rows.extend(measure(&cell, is_read_noise, scenes, seed)?);
            progress(&cell);
        }
    }
    Ok(rows)
}

/// Cells that are measured.
pub const CELLS: usize = 2 * SIGMAS_MM.len();

fn measure(cell: &Cell, is_read_noise: bool, scenes: usize, seed: u64) -> Result<Vec<Row>, Error> {
    let camera = cell.camera()?;
    let mut found: Vec<Vec<[Vec<f64>; 2]>> = OBSERVED_S
        .map(|_| EXPOSURES_S.map(|_| Default::default()).into())
        .into();
    for scene in 0..scenes as u64 {
        for (exposure, &exposure_s) in EXPOSURES_S.iter().enumerate() {
            let camera = exposed(&camera, exposure_s, is_read_noise);
            let mut rng = ChaCha8Rng::seed_from_u64(seed + scene);
            let snapshots = expose(&camera, exposure_s, &mut rng);
            let frames = OBSERVED_S.map(|t| (t / exposure_s).round() as usize);
            let observed: Vec<usize> = (0..frames.len()).filter(|t| frames[*t] > 0).collect();
            let counts: Vec<usize> = observed.iter().map(|t| frames[*t]).collect();
            let bounds = snapshots.bounds_m2(&camera, &counts, false);
            for (time, bounds) in observed.iter().zip(bounds) {
                found[*time][exposure][0].extend(bounds);
            }
            if is_read_noise {
                continue;
            }
            let measured: Vec<usize> = counts.iter().copied().filter(|k| *k <= MOST_FRAMES).collect();
            let errors = errors_m2(&camera, &snapshots, &measured, &mut rng)?;
            for (time, errors) in observed.iter().zip(errors) {
                found[*time][exposure][1].extend(errors);
            }
        }
    }
    let outcome = |[bounds, errors]: [Vec<f64>; 2]| {
        Some(Outcome {
            bound_m2: median(bounds)?,
            error_m2: median(errors).filter(|e| e.is_finite()),
        })
    };
    let row = |(observed_s, by_exposure): (f64, Vec<[Vec<f64>; 2]>)| {
        let mut outcomes = by_exposure.into_iter().map(outcome);
        Row {
            cell: *cell,
            is_read_noise,
            observed_s,
            outcomes: std::array::from_fn(|_| outcomes.next().flatten()),
        }
    };
    Ok(OBSERVED_S.into_iter().zip(found).map(row).collect())
}

/// The camera of frames that long. The noise of background light grows with the time, that of a read does not.
fn exposed(camera: &Camera, exposure_s: f64, is_read_noise: bool) -> Camera {
    let scale = if is_read_noise { 1.0 } else { exposure_s.sqrt() };
    Camera {
        noise_std_j: scale * camera.noise_std_j,
        ..camera.clone()
    }
}

/// The longest observation in frames of that exposure: users who stand still, whose light arrives in draws of [`COHERENCE_S`] that
/// are the same for all exposures.
fn expose(camera: &Camera, exposure_s: f64, rng: &mut ChaCha8Rng) -> Snapshots {
    let longest_s = OBSERVED_S[OBSERVED_S.len() - 1];
    let fading = Walk {
        emitters: None,
        frames: (longest_s / COHERENCE_S).round() as usize,
        rate_hz: 1.0 / COHERENCE_S,
        speed_m_s: 0.0,
        relative_std: FADING_STD,
    };
    let draws = Snapshots::draw(camera, &fading, rng);
    let frames = (longest_s / exposure_s).round() as usize;
    // Draws that a frame collects, or frames that share a draw.
    let collected = ((exposure_s / COHERENCE_S).round() as usize).max(1);
    let sharing = ((COHERENCE_S / exposure_s).round() as usize).max(1);
    let share = exposure_s / collected as f64;
    let energy = |frame: usize, e: usize| {
        let first = frame / sharing * collected;
        let draws = draws.energies_j[first..first + collected].iter();
        share * draws.map(|energies| energies[e]).sum::<f64>()
    };
    let emitters = draws.starts_m.len();
    Snapshots {
        times_s: (0..frames).map(|k| k as f64 * exposure_s).collect(),
        energies_j: (0..frames)
            .map(|k| (0..emitters).map(|e| energy(k, e)).collect())
            .collect(),
        ..draws
    }
}

/// Squared errors, m², after these numbers of frames, which rise; ∞ for a missed emitter.
fn errors_m2(
    camera: &Camera,
    snapshots: &Snapshots,
    after: &[usize],
    rng: &mut ChaCha8Rng,
) -> Result<Vec<Vec<f64>>, Error> {
    let config = estimate::Config {
        name: Some("sequence".to_owned()),
        ..Default::default()
    };
    let mut estimator = estimate::build(&config, camera)?;
    let mut errors = Vec::new();
    for frame in 0..after.last().copied().unwrap_or(0) {
        let answer = estimator.estimate(&snapshots.frame(camera, frame, rng));
        if after.contains(&(frame + 1)) {
            let emitters = answer.map(|a| a.emitters).unwrap_or_default();
            let found: Vec<[f64; 2]> = emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
            let mut own = vec![f64::INFINITY; snapshots.starts_m.len()];
            for (i, j) in ospa(&snapshots.starts_m, &found, CUTOFF_M).matching.pairs {
                own[i] = (0..2).map(|k| (snapshots.starts_m[i][k] - found[j][k]).powi(2)).sum();
            }
            errors.push(own);
        }
    }
    Ok(errors)
}

pub(super) fn markdown(rows: &[Row], scenes: usize, seed: u64) -> String {
    let mut text = format!(
        "# Accuracy against observation time\n\n{scenes} scenes a cell, seed {seed}; 5 to 9 users who stand still. Every 10 ms is one draw of a \
         beam's fading (relative std {FADING_STD}). Median Cramér–Rao bound of all frames of the observation together, m², both axes summed; in \
         brackets the median error of `sequence` on them, of at most {MOST_FRAMES} frames (– where it misses more than half).\n"
    );
    for is_read_noise in [false, true] {
        let title = match is_read_noise {
            false => "Noise of background light: grows with the exposure",
            true => "Noise of the read alone: the same in every frame, 10⁻⁶ J",
        };
        let _ = write!(text, "\n## {title}\n\n| cell | observed, s |");
        for exposure_s in EXPOSURES_S {
            let _ = write!(text, " exposure {exposure_s} s |");
        }
        let _ = writeln!(text, "\n|---|---|{}", "---|".repeat(EXPOSURES_S.len()));
        for row in rows.iter().filter(|r| r.is_read_noise == is_read_noise) {
            let _ = write!(text, "| {} | {} |", row.cell.name(), row.observed_s);
            for (outcome, exposure_s) in row.outcomes.iter().zip(EXPOSURES_S) {
                let is_measured = !is_read_noise && row.observed_s <= MOST_FRAMES as f64 * exposure_s * (1.0 + 1e-9);
                let _ = match outcome {
                    None => write!(text, " |"),
                    Some(o) if !is_measured => write!(text, " {:.2e} |", o.bound_m2),
                    Some(Outcome {
                        bound_m2,
                        error_m2: Some(error),
                    }) => write!(text, " {bound_m2:.2e} ({error:.2e}) |"),
                    Some(o) => write!(text, " {:.2e} (–) |", o.bound_m2),
                };
            }
            text.push('\n');
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposures_collect_the_same_light() {
        let camera = Cell::new(Noise::Energy, 8.0, 64).camera().unwrap();
        let total = |exposure_s: f64| -> f64 {
            let snapshots = expose(&camera, exposure_s, &mut ChaCha8Rng::seed_from_u64(3));
            snapshots.energies_j.iter().map(|e| e[0]).sum()
        };
        for exposure_s in EXPOSURES_S {
            assert!((total(exposure_s) / total(1.0) - 1.0).abs() < 1e-9, "{exposure_s}");
        }
    }

    #[test]
    fn a_second_in_hundredths_bounds_melted_spots_tighter_unless_each_read_adds_the_noise() {
        let bounds = |is_read_noise: bool| {
            let rows = measure(&Cell::new(Noise::Energy, 8.0, 64), is_read_noise, 2, 1).unwrap();
            assert!(rows[0].outcomes[0].is_none(), "a second does not fit into 10 ms");
            [0, 2].map(|exposure| rows[2].outcomes[exposure].as_ref().unwrap().bound_m2)
        };
        let [whole, split] = bounds(false);
        assert!(split < 0.1 * whole, "{split} {whole}");
        let [whole, split] = bounds(true);
        assert!(split > whole, "{split} {whole}");
    }
}
