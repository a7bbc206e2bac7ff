//! Honest users through a lens or on a sensor that the config does not describe: nobody is to be alerted.

use rayon::prelude::*;

use super::measured::{Measured, Say, exceptions, is_named};
use crate::estimate;
use crate::study::stories::pixels::{PixelStory, RATE_HZ, review};

/// Spots on the story's pixels of 0.75 mm, as wide as its Gaussian of 1 mm.
const SPOTS: [(&str, &str); 8] = [
    ("Gaussian", ""),
    ("Airy disc", "kind = \"airy\"\nfirst_zero_m = 2.9e-3"),
    ("Moffat, β 2.5", "kind = \"moffat\"\ncore_m = 2.05e-3\nindex = 2.5"),
    ("defocus disc", "kind = \"defocus\"\nradius_m = 1.8e-3\nblur_m = 2.5e-4"),
    (
        "coma, to 0.08 waves at the edge",
        "kind = \"zernike\"\nfirst_zero_m = 2.9e-3\n[[effects.spot.term]]\nnoll = 8\nwaves = [0.0, 0.08]\n[[effects.spot.term]]\nnoll = 7\nwaves = [0.0, 0.0, 0.08]",
    ),
    (
        "coma, to 0.2 waves at the edge",
        "kind = \"zernike\"\nfirst_zero_m = 2.9e-3\n[[effects.spot.term]]\nnoll = 8\nwaves = [0.0, 0.2]\n[[effects.spot.term]]\nnoll = 7\nwaves = [0.0, 0.0, 0.2]",
    ),
    (
        "astigmatism of 0.1 waves at 45°",
        "kind = \"zernike\"\nfirst_zero_m = 2.9e-3\n[[effects.spot.term]]\nnoll = 5\nwaves = [0.1]",
    ),
    (
        "ghost of 2 %",
        "kind = \"ghost\"\nshare = 0.02\noffset_m = [4.5e-3, -3.0e-3]\nspread_m = 1.0e-3",
    ),
];
/// Seconds of a story.
const HONEST_S: f64 = 120.0;

/// What a sensor adds to all frames; the noise is 1e-6 J.
const SENSORS: [(&str, &str); 9] = [
    ("as the config says", ""),
    (
        "background of 0.1 of the noise",
        "[effects.background]\nuniform_j = 1e-7",
    ),
    (
        "background of 0.3 of the noise",
        "[effects.background]\nuniform_j = 3e-7",
    ),
    (
        "background of 1 to 3 of the noise",
        "[effects.background]\nuniform_j = 2e-6\ngradient_j = [1e-6, 0.0]",
    ),
    (
        "background of 20 of the noise",
        "[effects.background]\nuniform_j = 2e-5",
    ),
    (
        "one pixel in 800 hot by 4 of the noise",
        "[effects.defects]\nhot = 0.00125\nhot_j = 4e-6",
    ),
    (
        "one pixel in 800 hot by 15 of the noise",
        "[effects.defects]\nhot = 0.00125\nhot_j = 1.5e-5",
    ),
    (
        "dark levels that scatter by 0.3 of the noise",
        "[effects.dark_current]\nenergy_j = 1e-6\nspread = 0.3",
    ),
    ("gains that scatter by 2 %", "[effects.gain]\nstd = 0.02"),
];

/// Four honest users through each lens, so many stories of two minutes: thirty make an hour.
pub fn lenses(stories: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured {
    let table = |(name, spot): (&'static str, &str)| match spot {
        "" => (name, String::new()),
        _ => (name, format!("[effects.spot]\n{spot}\n")),
    };
    say("| lens | honest frames | alerts |\n|---|---|---|");
    through(SPOTS.map(table), stories, seed, only, estimator, say)
}

/// The same on each sensor.
pub fn sensors(stories: u64, seed: u64, only: &[String], estimator: &estimate::Config, say: Say) -> Measured {
    say("| sensor | honest frames | alerts |\n|---|---|---|");
    let tables = SENSORS.map(|(name, table)| (name, format!("{table}\n")));
    through(tables, stories, seed, only, estimator, say)
}

fn through(
    effects: impl IntoIterator<Item = (&'static str, String)>,
    stories: u64,
    seed: u64,
    only: &[String],
    estimator: &estimate::Config,
    say: Say,
) -> Measured {
    let mut all = Vec::new();
    for (name, table) in effects.into_iter().filter(|(name, _)| is_named(name, only)) {
        let tell = |k| {
            let mut story = PixelStory::with(k, &table);
            story.seconds = HONEST_S;
            story.config.estimator = estimator.clone();
            (k, review(&story).raised())
        };
        let mut raised: Vec<_> = (seed..seed + stories).into_par_iter().map(tell).collect();
        let count: usize = raised.iter().map(|(_, raised)| raised.len()).sum();
        let frames = stories as f64 * HONEST_S * RATE_HZ;
        say(&format!("| {name} | {frames} | {count} |"));
        raised.retain(|(_, raised)| !raised.is_empty());
        all.extend(raised);
    }
    Measured {
        text: format!("\n{}", exceptions(&all)),
        holds: all.is_empty(),
    }
}
