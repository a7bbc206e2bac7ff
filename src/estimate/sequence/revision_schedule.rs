//! When a window is searched for another number of emitters: whenever it has grown, for a share of each frame's time.

use crate::estimate::sequence::residual_map::ResidualSum;
use crate::estimate::sequence::revision::{Revised, Revision};
use crate::estimate::sequence::search::WindowSearch;
use crate::estimate::sequence::upkeep::bury;
use crate::estimate::sequence::window::Window;

/// A search of the window begins when it has grown by this factor since the last, and at the latest after this many frames.
const SEARCH_GROWTH: f64 = 1.4;
const SEARCH_AFTER: usize = 32;
/// Work of a search that goes on from frame to frame, a frame: less finds emitters later, more makes frames slower. A window that is shorter
/// than `SEARCH_AFTER` by some factor is given more by that factor, up to [`YOUNG`]: it is the first frames that make the number right.
const REVISION_WORK: f64 = 0.06;
/// Frames up to which what is remembered is likelier wrong than that somebody has turned.
pub(crate) const YOUNG: usize = 8;

/// The search in progress.
#[derive(Default)]
pub(crate) struct RevisionSchedule {
    revision: Option<Revision>,
    /// Frames since it began, and the window's length then.
    frames: usize,
    searched: usize,
}

impl RevisionSchedule {
    /// Whether a search of `window` goes on or begins with this frame.
    pub fn is_due(&mut self, window: &Window) -> bool {
        let length = window.snapshots.len();
        self.frames += 1;
        self.revision = self.revision.take().filter(|r| r.is_of(window));
        if self.revision.is_some() {
            return true;
        }
        let has_grown = length as f64 >= SEARCH_GROWTH * self.searched as f64;
        let begins = length >= 2 && (self.frames >= SEARCH_AFTER || has_grown);
        if begins {
            (self.frames, self.searched) = (0, length);
        }
        begins
    }

    /// A frame's share of the work, in frames' searches.
    pub fn work(window: &Window) -> f64 {
        let youth = SEARCH_AFTER as f64 / window.age.max(1) as f64;
        REVISION_WORK * youth.clamp(1.0, YOUNG as f64)
    }

    /// Does a frame's share, where frames have `left` something unexplained. Returns whether another number of emitters was found.
    pub fn advance(
        &mut self,
        window: &mut Window,
        search: &mut WindowSearch,
        left: &ResidualSum,
        memory_s: f64,
    ) -> bool {
        let revision = self.revision.take();
        let revision = revision.or_else(|| Revision::begin(window, search, search.births(window, left)));
        let Some(mut revision) = revision else {
            return false;
        };
        match revision.advance(search) {
            Revised::Finished => false,
            Revised::Unfinished => {
                self.revision = Some(revision);
                false
            }
            Revised::Better(mut better) => {
                let newer = window.snapshots.iter().filter(|s| s.time_s > revision.time_s());
                for snapshot in newer {
                    let elapsed = snapshot.time_s - better.time_s;
                    better.catch_up(search.engine, snapshot, memory_s);
                    bury(&mut better, search.engine, elapsed);
                }
                *window = *better;
                self.searched = 0;
                true
            }
        }
    }
}
