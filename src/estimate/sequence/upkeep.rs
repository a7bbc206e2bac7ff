//! The window between frames: who is gone, and what it may hold.

use crate::estimate::sequence::local_quadratic::Engine;
use crate::estimate::sequence::search::WINDOW_STEPS;
use crate::estimate::sequence::snapshot::view;
use crate::estimate::sequence::window::Window;
use crate::optics::COHERENCE_S;

/// Frames of the window, and the numbers that all of them may hold: bounds memory, and the time of a fit of the whole window.
pub(crate) const MAX_SNAPSHOTS: usize = 128;
const MAX_NUMBERS: usize = 1 << 20;
/// Snapshots that are linearised anew with a frame: more follow a change sooner, each costs as much as a step of the frame's own fit.
const REFRESHED: usize = 8;

/// Frames of so many coefficients that the window may hold.
pub(crate) fn most_snapshots(coefficients: usize) -> usize {
    MAX_SNAPSHOTS.min(MAX_NUMBERS / coefficients.max(1)).max(2)
}

/// Ends targets that have gone dark or left the view: frames before hold them still.
pub(crate) fn bury(window: &mut Window, engine: &mut Engine, elapsed: f64) {
    let Some(last) = window.snapshots.last() else { return };
    // Frames nearer in time than the coherence time count as one draw of the fading.
    let (time_s, weight) = (last.time_s, (elapsed / COHERENCE_S).clamp(0.0, 1.0));
    let (positions, view) = (window.positions(engine.bases), view(engine.bases));
    let mut has_died = false;
    for (i, e) in window.present(time_s).into_iter().enumerate() {
        let target = &mut window.targets[e];
        target.weigh(time_s, last.local.energies[i], last.local.energy_variances[i], weight);
        let has_left = (0..2).any(|k| !(view[k][0]..view[k][1]).contains(&positions[2 * i + k]));
        if target.is_dark(engine.rules) || has_left {
            target.died_s = time_s;
            has_died = true;
        }
    }
    if has_died {
        window.relinearise_last(engine);
    }
}

/// Keeps at most `most` snapshots, and linearises those anew that need it.
pub(crate) fn refresh(window: &mut Window, engine: &mut Engine, most: usize) {
    if window.snapshots.len() > most {
        window.fold(window.snapshots.len() - most);
    }
    window.forget_dead();
    if window.refresh(engine, REFRESHED) && window.snapshots.len() <= REFRESHED {
        window.fit(engine, WINDOW_STEPS);
    }
}
