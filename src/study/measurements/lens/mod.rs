//! What the estimator makes of spots that are no Gaussians: without a calibration, and with one that was learned blind.

pub mod bench;
pub mod shapes;
mod tally;

use std::time::Instant;

use super::measured::{Measured, Say, is_named};
use crate::estimate;
use crate::optics::Camera;
use bench::{Bench, Layout};
use shapes::{LENSES, Lens};
use tally::Tally;

const SNRS: [f64; 4] = [30.0, 100.0, 300.0, 1000.0];
/// Largest share of invented emitters, %, of separated spots on 64 × 64 pixels without a calibration.
const MOST_INVENTED: f64 = 1.0;
const FIGURES: &str = "number right %, invented %, missed %, in ellipse %, error over bound, median and longest ms";

/// So many frames of each lens, peak SNR and layout, without a calibration; of the rows that `only` names.
pub fn uncalibrated(frames: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured {
    say(&format!(
        "| lens | SNR | {FIGURES}: 64×64 apart | 64×64, pairs 2 σ apart | 20×20 |\n|---|---|---|---|---|"
    ));
    let mut holds = true;
    for (lens, snr) in rows(only) {
        let cells = [(64, Layout::Apart), (64, Layout::Pairs), (20, Layout::Apart)].map(|(pixels, layout)| {
            let mut bench = Bench::new(lens, pixels, snr, seed);
            let camera = bench.camera.clone();
            measure(&mut bench, layout, &camera, estimator, frames)
        });
        holds &= 100.0 * cells[0].invented as f64 <= MOST_INVENTED * cells[0].spots as f64;
        let cells = cells.map(Tally::cell);
        say(&format!("| {} | {snr} | {} |", lens.name, cells.join(" | ")));
    }
    Measured {
        text: String::new(),
        holds,
    }
}

/// The same with a calibration that was learned from other frames of the lens, whose positions it was not told.
pub fn calibrated(frames: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured {
    say(&format!(
        "| lens | SNR | 64×64: learned | {FIGURES}: apart | pairs 2 σ apart | 20×20: learned | apart |\n|---|---|---|---|---|---|---|"
    ));
    for (lens, snr) in rows(only) {
        let mut cells = Vec::new();
        for (pixels, layouts) in [(64, &[Layout::Apart, Layout::Pairs][..]), (20, &[Layout::Apart])] {
            let mut bench = Bench::new(lens, pixels, snr, seed);
            let (camera, learned) = calibrate(&mut bench);
            cells.push(learned);
            for layout in layouts {
                let tally = measure(&mut bench, *layout, &camera, estimator, frames);
                let tally = match lens.is_uniform {
                    true => tally,
                    false => tally.without_distortion(),
                };
                cells.push(tally.cell());
            }
        }
        say(&format!("| {} | {snr} | {} |", lens.name, cells.join(" | ")));
    }
    Measured {
        text: String::new(),
        holds: true,
    }
}

/// Lenses and peak SNRs of the rows, "Airy disc 300", that `only` names.
fn rows(only: &[String]) -> impl Iterator<Item = (Lens, f64)> {
    let all = LENSES.iter().flat_map(|lens| SNRS.map(|snr| (*lens, snr)));
    all.filter(move |(lens, snr)| is_named(&format!("{} {snr}", lens.name), only))
}

/// The camera after `oapwatch calibrate`, and what that found; the camera as it is where that refused or found nothing better.
fn calibrate(bench: &mut Bench) -> (Camera, String) {
    let plain = bench.camera.clone();
    match bench.learn() {
        Err(error) => (plain, format!("refused: {error}")),
        Ok(learned) if !learned.is_better(&plain) => (plain, "the Gaussian stays".to_owned()),
        Ok(learned) => {
            let text = format!(
                "χ² {:.1} to {:.3}, {} terms of degree {}, spot error {:.1e}",
                learned.before.reduced(),
                learned.after.reduced(),
                learned.shape.terms(),
                learned.field_degree,
                learned.calibration.spot_error.unwrap_or_default()
            );
            let camera = learned.calibration.applied_to(&plain);
            (camera.expect("a calibration of this camera"), text)
        }
    }
}

/// What the estimator makes of so many frames as `camera` describes them.
fn measure(bench: &mut Bench, layout: Layout, camera: &Camera, estimator: &estimate::Config, frames: u64) -> Tally {
    let mut estimator = estimate::build(estimator, camera).expect("an estimator");
    let mut tally = Tally::default();
    for index in 0..frames {
        let (frame, spots) = bench.frame(index, layout);
        let clock = Instant::now();
        let estimate = estimator.estimate(&frame).expect("a frame that can be used");
        let time_ms = 1e3 * clock.elapsed().as_secs_f64();
        let ground: Vec<_> = spots.places_m.iter().map(|p| bench.camera.to_ground(*p)).collect();
        let bounds = bench.bounds(&spots);
        let scale = bench.camera.ground_scale();
        tally.count(&estimate.emitters, &ground, &bounds, scale, time_ms);
    }
    tally
}
