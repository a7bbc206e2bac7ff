//! Beams without a claim that came and went: a beam that blinks is without a claim for as long as it shone.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use nalgebra::Vector2;

use crate::monitor::alert::SAME_PLACE_M;
use crate::monitor::track::beam_track::Track;
use crate::monitor::track::tracker::Tracker;
use crate::time::seconds;

/// How long a flash is remembered, s. Longer alerts newcomers whose claim is late where a beam has flashed, shorter lets one go without an
/// alert that shines for half a second as rarely. Not measured.
const REMEMBERED_S: f64 = 30.0;
/// Most flashes that are remembered: the newest.
const MOST: usize = 256;

/// By track.
#[derive(Debug, Default)]
pub struct Flashes(BTreeMap<u64, Flash>);

#[derive(Debug)]
struct Flash {
    place: Vector2<f64>,
    since: Timestamp,
    until: Timestamp,
}

impl Flashes {
    /// Forgets what is too old.
    pub fn forget_old(&mut self, now: Timestamp) {
        self.0.retain(|_, flash| seconds(flash.until, now) < REMEMBERED_S);
        while self.0.len() > MOST {
            self.0.pop_first();
        }
    }

    /// The track has no claim since then.
    pub fn shines(&mut self, track: &Track, since: Timestamp) {
        let flash = Flash {
            place: track.filter.position(),
            since,
            until: track.last_hit,
        };
        self.0.insert(track.id, flash);
    }

    /// The track has a claim.
    pub fn is_claimed(&mut self, track: u64) {
        self.0.remove(&track);
    }

    /// For how long a beam had no claim that shone where a new one does, and whose track is over.
    pub fn before(&self, track: &Track, tracker: &Tracker) -> SignedDuration {
        let here = track.filter.position();
        let is_over = |id: u64| tracker.get(id).is_none();
        let mut newest_first = self.0.iter().rev();
        newest_first
            .find(|(id, flash)| is_over(**id) && (flash.place - here).norm() < SAME_PLACE_M)
            .map_or(SignedDuration::ZERO, |(_, flash)| {
                flash.until.duration_since(flash.since)
            })
    }
}
