//! Messages that were refused, by station and reason: shown with the stations, and nothing that alerts depend on.

use std::collections::BTreeMap;
use std::sync::Arc;

use jiff::Timestamp;

use crate::api::{StationState, StationStatus};
use crate::monitor::StationName;

/// Stations of which refusals are kept: as many as the hub knows.
const MOST_STATIONS: usize = 4096;

#[derive(Debug, Default)]
pub struct Refusals {
    of: BTreeMap<StationName, Refused>,
}

#[derive(Debug)]
struct Refused {
    last: Timestamp,
    by_reason: BTreeMap<&'static str, u64>,
}

impl Refusals {
    /// Counts one; gives how many of the station there were for this reason, 0 where no more stations are kept.
    pub fn note(&mut self, name: &StationName, reason: &'static str, now: Timestamp) -> u64 {
        if !self.of.contains_key(name) && self.of.len() >= MOST_STATIONS {
            return 0;
        }
        let refused = self.of.entry(name.clone()).or_insert_with(|| Refused {
            last: now,
            by_reason: BTreeMap::new(),
        });
        refused.last = now;
        let count = refused.by_reason.entry(reason).or_default();
        *count += 1;
        *count
    }

    /// Adds them to the stations that are known, and those of which nothing else is.
    pub fn show(&self, stations: &mut Vec<StationStatus>) {
        if self.of.is_empty() {
            return;
        }
        let mut others: BTreeMap<&StationName, &Refused> = self.of.iter().collect();
        for station in stations.iter_mut() {
            let name = StationName {
                site: station.site.clone(),
                station: station.station.clone(),
            };
            if let Some(refused) = others.remove(&name) {
                station.refused = refused.by_reason.clone();
            }
        }
        stations.extend(others.into_iter().map(|(name, refused)| StationStatus {
            site: name.site.clone(),
            station: name.station.clone(),
            state: StationState::Refused,
            last_seen_at: refused.last,
            lag_s: None,
            alerts_waiting: 0,
            emitters: 0,
            field_of_view_m: None,
            footprint_m: Vec::new(),
            pose: None,
            is_compared: false,
            refused: refused.by_reason.clone(),
            status: Arc::default(),
        }));
    }
}
