//! Honest stories raise nothing. `oapwatch study honest` tells many more of them.

use oapwatch::study::stories::{honest, tally, tell_with};

/// Honest stories of 100 s until `frames` are told, and what was raised, with the seeds that raised it.
fn soak(frames: u64, seed: u64) -> Vec<(u64, String)> {
    let told = (seed..seed + frames / 1000).map(|k| (k, tell_with(&honest(k, 100.0), false)));
    let raised = told.filter(|(_, told)| !tally(&told.events).is_empty());
    raised.map(|(k, told)| (k, told.ndjson())).collect()
}

#[test]
fn honest_scenes_raise_nothing() {
    let raised = soak(20_000, 1);
    assert!(raised.is_empty(), "{raised:#?}");
}

/// A user leaves just as another walks by: the track left behind in that one's spot now and then takes its detection.
#[test]
fn a_track_in_anothers_spot_is_no_beam() {
    let raised = soak(1000, 1_500_598);
    assert!(raised.is_empty(), "{raised:#?}");
}
