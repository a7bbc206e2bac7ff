//! All zones, and which of them a place is in: a grid over the ground, so that a thousand zones cost no more than the few nearby.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::geojson::collection;
use super::zone::{Zone, ZoneKind};
use crate::hash::fnv1a;

/// Cells of the grid along each axis. More make the lists of each cell shorter and the grid larger.
const CELLS: usize = 32;
/// How far outside of a zone a place is still asked about, m: larger than errors of positions.
pub const REACH_M: f64 = 10.0;

/// The zones in force. Cloning is cheap.
#[derive(Clone, Debug, Default)]
pub struct ZoneMap(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    zones: Vec<Zone>,
    /// Lower and upper corner of each zone's box.
    bounds: Vec<[[f64; 2]; 2]>,
    low: [f64; 2],
    cell_m: [f64; 2],
    /// Zones that reach into each cell, row by row.
    cells: Vec<Vec<u16>>,
    /// Zones that list a user by name, and those that list the beginning of one.
    by_user: BTreeMap<String, Vec<u16>>,
    by_beginning: Vec<(String, u16)>,
}

/// A zone that a place is in or near to.
#[derive(Clone, Copy, Debug)]
pub struct Inside<'a> {
    pub zone: &'a Zone,
    /// Distance from its edge, m: negative outside, down to −10.
    pub depth_m: f64,
}

impl ZoneMap {
    pub fn new(zones: Vec<Zone>) -> Self {
        if zones.is_empty() {
            return Self::default();
        }
        let bounds: Vec<[[f64; 2]; 2]> = zones.iter().map(|zone| zone.shape.bounds()).collect();
        let low = [0, 1].map(|k| bounds.iter().map(|b| b[0][k]).fold(f64::INFINITY, f64::min) - REACH_M);
        let high = [0, 1].map(|k| bounds.iter().map(|b| b[1][k]).fold(f64::NEG_INFINITY, f64::max) + REACH_M);
        let cell_m = [0, 1].map(|k| (high[k] - low[k]) / CELLS as f64);
        let mut cells = vec![Vec::new(); CELLS * CELLS];
        for (z, [near, far]) in bounds.iter().enumerate() {
            let range = |k: usize| {
                let cell = |m: f64| (((m - low[k]) / cell_m[k]) as usize).min(CELLS - 1);
                cell(near[k] - REACH_M)..=cell(far[k] + REACH_M)
            };
            for row in range(1) {
                for column in range(0) {
                    cells[row * CELLS + column].push(z as u16);
                }
            }
        }
        let mut by_user: BTreeMap<String, Vec<u16>> = BTreeMap::new();
        let mut by_beginning = Vec::new();
        for (z, zone) in zones.iter().enumerate() {
            for listed in &zone.users {
                match listed.strip_suffix('*') {
                    Some(beginning) => by_beginning.push((beginning.to_owned(), z as u16)),
                    None => by_user.entry(listed.clone()).or_default().push(z as u16),
                }
            }
        }
        Self(Arc::new(Inner {
            zones,
            by_user,
            by_beginning,
            bounds,
            low,
            cell_m,
            cells,
        }))
    }

    pub fn zones(&self) -> &[Zone] {
        &self.0.zones
    }

    /// A number that differs where zones differ.
    pub fn digest(&self) -> u64 {
        fnv1a(collection(self.zones().iter()).to_string().bytes())
    }

    pub fn is_empty(&self) -> bool {
        self.0.zones.is_empty()
    }

    /// The zones of interest that `p` is in or within `reach_m` of, 10 m at most, in the order of their list.
    pub fn near(
        &self,
        p: [f64; 2],
        reach_m: f64,
        is_of_interest: impl Fn(&Zone) -> bool,
    ) -> impl Iterator<Item = Inside<'_>> {
        let all = &*self.0;
        let reach_m = reach_m.min(REACH_M);
        let cell = |k: usize| ((p[k] - all.low[k]) / all.cell_m[k]).floor();
        let (column, row) = (cell(0), cell(1));
        let is_on = |c: f64| (0.0..CELLS as f64).contains(&c);
        let here: &[u16] = match is_on(column) && is_on(row) && !all.zones.is_empty() {
            true => &all.cells[row as usize * CELLS + column as usize],
            false => &[],
        };
        here.iter().filter_map(move |z| {
            let [near, far] = all.bounds[usize::from(*z)];
            if (0..2).any(|k| p[k] < near[k] - reach_m || p[k] > far[k] + reach_m) {
                return None;
            }
            let zone = &all.zones[usize::from(*z)];
            let depth_m = is_of_interest(zone).then(|| zone.shape.depth_m(p))?;
            (depth_m >= -reach_m).then_some(Inside { zone, depth_m })
        })
    }

    /// The zones that list a user.
    pub fn listing(&self, user: &str) -> Vec<&Zone> {
        let by_name = self.0.by_user.get(user).into_iter().flatten();
        let by_beginning = self
            .0
            .by_beginning
            .iter()
            .filter(|(b, _)| user.starts_with(b))
            .map(|(_, z)| z);
        by_name
            .chain(by_beginning)
            .map(|z| &self.0.zones[usize::from(*z)])
            .collect()
    }

    /// The smallest zone of this kind that `p` is in, at least `depth_m` deep.
    pub fn within(&self, p: [f64; 2], kind: ZoneKind, depth_m: f64) -> Option<&Zone> {
        let of_kind = self
            .near(p, (-depth_m).max(0.0), |zone| zone.kind == kind)
            .filter(|i| i.depth_m >= depth_m);
        let area = |i: &Inside| i.zone.shape.area_m2();
        of_kind.min_by(|a, b| area(a).total_cmp(&area(b))).map(|i| i.zone)
    }
}

/// Share of a view of these half-widths, m, in which a beam that nobody claims raises nothing; by a grid of 100 × 100 places.
pub fn ignored_share(zones: Vec<Zone>, half: [f64; 2]) -> f64 {
    const PLACES: usize = 100;
    let map = ZoneMap::new(zones);
    if map.is_empty() {
        return 0.0;
    }
    let at = |k: usize, axis: usize| half[axis] * (2.0 * (k as f64 + 0.5) / PLACES as f64 - 1.0);
    let is_ignored = |k: &usize| {
        let place = [at(k % PLACES, 0), at(k / PLACES, 1)];
        map.within(place, ZoneKind::Ignore, 0.0).is_some() && map.within(place, ZoneKind::Restricted, 0.0).is_none()
    };
    (0..PLACES * PLACES).filter(is_ignored).count() as f64 / (PLACES * PLACES) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::zones::Shape;

    fn square(name: usize, x: f64, y: f64, side: f64, kind: ZoneKind) -> Zone {
        let ring = vec![[x, y], [x + side, y], [x + side, y + side], [x, y + side]];
        Zone {
            name: name.to_string(),
            kind,
            shape: Shape::new(vec![vec![ring]]).unwrap(),
            users: Vec::new(),
            tolerated_distance_m: None,
            severity: None,
            webhooks: None,
            is_fixed: true,
        }
    }

    #[test]
    fn the_grid_finds_what_a_search_finds() {
        let zones: Vec<Zone> = (0..400)
            .map(|k| {
                let (row, column) = (k / 20, k % 20);
                square(
                    k,
                    17.0 * column as f64 - 170.0,
                    13.0 * row as f64 - 130.0,
                    3.0 + (k % 7) as f64,
                    ZoneKind::Watch,
                )
            })
            .collect();
        let map = ZoneMap::new(zones.clone());
        for k in 0..2000 {
            let p = [f64::from(k % 50) * 9.1 - 230.0, f64::from(k / 50) * 8.3 - 170.0];
            let searched = zones.iter().filter(|z| z.shape.depth_m(p) >= -REACH_M);
            let found: Vec<_> = map.near(p, REACH_M, |_| true).map(|i| i.zone.name.clone()).collect();
            assert_eq!(found, searched.map(|z| z.name.clone()).collect::<Vec<_>>(), "{p:?}");
        }
        assert_eq!(map.near([f64::NAN, 0.0], REACH_M, |_| true).count(), 0);
        assert_eq!(map.near([1e300, 0.0], REACH_M, |_| true).count(), 0);
    }

    #[test]
    fn the_smallest_zone_of_a_kind() {
        let map = ZoneMap::new(vec![
            square(0, 0.0, 0.0, 100.0, ZoneKind::Watch),
            square(1, 40.0, 40.0, 20.0, ZoneKind::Watch),
            square(2, 45.0, 45.0, 10.0, ZoneKind::Ignore),
        ]);
        let name = |p, kind, depth| map.within(p, kind, depth).map(|z| z.name.as_str());
        assert_eq!(name([50.0, 50.0], ZoneKind::Watch, 0.0), Some("1"));
        assert_eq!(name([50.0, 50.0], ZoneKind::Ignore, 0.0), Some("2"));
        assert_eq!(name([44.0, 50.0], ZoneKind::Ignore, 0.0), None);
        assert_eq!(name([44.0, 50.0], ZoneKind::Ignore, -2.0), Some("2"));
        assert_eq!(name([50.0, 50.0], ZoneKind::Restricted, -2.0), None);
        let half = square(0, -100.0, -100.0, 100.0, ZoneKind::Ignore);
        assert_eq!(ignored_share(vec![half], [100.0, 100.0]), 0.25);
        assert!(ZoneMap::default().is_empty());
        assert_eq!(ZoneMap::default().near([0.0, 0.0], REACH_M, |_| true).count(), 0);
    }
}
