//! A map of the sensor in one frame of a moving platform as another frame sees it.

use crate::estimate::detect::matched_filter::MatchedFilter;
use crate::estimate::sequence::outlook::Outlook;

/// Points along an axis whose way is followed; between them it is bilinear. What that leaves of a tilt by 10° is below the filter's spacing.
const NODES: usize = 9;

/// `map`, on the filter's grid as `from` sees it, on the same grid as `to` sees it; zero where `from` sees nothing.
pub(crate) fn reprojected(filter: &MatchedFilter, map: &[f64], from: &Outlook, to: &Outlook) -> Vec<f64> {
    let (width, height) = (filter.width(), map.len() / filter.width());
    let (first, last) = (filter.position(0), filter.position(map.len() - 1));
    let sizes = [width, height].map(|n| (n - 1) as f64);
    let cells = (NODES - 1) as f64;
    // In points of the grid.
    let node = |index: usize| {
        let share = [index % NODES, index / NODES].map(|k| k as f64 / cells);
        let position = [0, 1].map(|k| first[k] + share[k] * (last[k] - first[k]));
        let seen = to.seen_by(from, position)?;
        Some([0, 1].map(|k| (seen[k] - first[k]) / (last[k] - first[k]) * sizes[k]))
    };
    let nodes: Vec<Option<[f64; 2]>> = (0..NODES * NODES).map(node).collect();
    let source = |i: usize, j: usize| {
        let at = [i as f64 / sizes[0] * cells, j as f64 / sizes[1] * cells];
        let cell = at.map(|v| (v as usize).min(NODES - 2));
        let [s, t] = [0, 1].map(|k| at[k] - cell[k] as f64);
        let corner = |di: usize, dj: usize| nodes[(cell[1] + dj) * NODES + cell[0] + di];
        let corners = [corner(0, 0)?, corner(1, 0)?, corner(0, 1)?, corner(1, 1)?];
        let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t];
        let point = [0, 1].map(|k| corners.iter().zip(weights).map(|(c, w)| w * c[k]).sum::<f64>().round());
        let is_inside = (0..2).all(|k| point[k] >= 0.0 && point[k] <= sizes[k]);
        is_inside.then(|| point[1] as usize * width + point[0] as usize)
    };
    let points = (0..height).flat_map(|j| (0..width).map(move |i| (i, j)));
    points.map(|(i, j)| source(i, j).map_or(0.0, |k| map[k])).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use jiff::Timestamp;
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::estimate::test_frame::Shown;
    use crate::geo::Sight;
    use crate::pose::{Mount, Pose};

    #[test]
    fn a_peak_is_where_the_other_frame_sees_its_place() {
        let mut test = Shown {
            pixels_per_sigma: 2.0,
            sources: &[([0.0, 0.0], 1.0)],
            ..Shown::default()
        }
        .frame();
        let camera = Arc::new(test.camera.clone());
        let unit_m = camera.ground_scale() * camera.spot_sigma_m;
        let outlook = |tilt_rad: f64, turn_rad: f64| {
            let pose = Pose {
                attitude: UnitQuaternion::from_euler_angles(tilt_rad, -tilt_rad, turn_rad),
                ..Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0])
            };
            Outlook::new(&Sight::new(&pose, &Mount::default()), &camera, unit_m)
        };
        let filter = &mut test.space.matched_filter;
        filter.respond(
            &vec![0.0; test.compressed.mx * test.compressed.my],
            test.compressed.mx,
            test.compressed.my,
        );
        let (from, to) = (outlook(0.0, 0.0), outlook(0.03, 0.4));
        let points = filter.map().len();
        for peak in [points / 3 + 5, points / 2 + 7] {
            let mut map = vec![0.0; points];
            map[peak] = 1.0;
            let seen = reprojected(filter, &map, &from, &to);
            let expected = from.seen_by(&to, filter.position(peak)).expect("looks down");
            let near = |k: usize| {
                let at = filter.position(k);
                (at[0] - expected[0]).hypot(at[1] - expected[1]) < 0.75
            };
            let found: Vec<usize> = (0..points).filter(|k| seen[*k] > 0.0).collect();
            assert!(
                !found.is_empty() && found.iter().all(|k| near(*k)),
                "{expected:?} {found:?}"
            );
        }
    }
}
