//! Where a ray first meets the terrain: through the grid cell by cell (Amanatides and Woo 1987), in each the exact root.

use std::ops::ControlFlow::{self, Break, Continue};

use nalgebra::Vector3;

use super::surface::{BLOCK, Cell, Ground, Terrain};

/// Where a ray meets the ground.
#[derive(Clone, Copy, Debug)]
pub struct Crossing {
    /// In lengths of the ray.
    pub reach: f64,
    pub ground: Ground,
}

/// A ray over the grid: position and direction in cells, and up in m.
struct Ray {
    start: [f64; 2],
    step: [f64; 2],
    z_m: f64,
    rise_m: f64,
}

impl Terrain {
    /// The crossing nearest to the ray's start. `None` where the ray leaves the grid above the ground, starts off it or below the
    /// ground, or passes where the ground is not known and may reach it.
    pub fn cross(&self, from: &Vector3<f64>, ray: &Vector3<f64>) -> Option<Crossing> {
        let cells = 2 * self.half;
        let ray = Ray {
            start: [from.x, from.y].map(|c| c / self.spacing_m + self.half as f64),
            step: [ray.x / self.spacing_m, ray.y / self.spacing_m],
            z_m: from.z,
            rise_m: ray.z,
        };
        let is_inside = ray.start.iter().all(|c| (0.0..=cells as f64).contains(c));
        let is_below = self.at([from.x, from.y]).is_some_and(|ground| from.z <= ground.z_m);
        if !is_inside || is_below {
            return None;
        }
        let (begin, end) = self.within_heights(&ray)?;
        let found = walk(&ray, 1.0 / BLOCK as f64, self.blocks, begin, end, |block, t| {
            let [i, j] = block;
            let (highest_m, has_void) = self.block(i, j);
            if !has_void && ray.lowest_m(t) > highest_m {
                return Continue(());
            }
            let bound_m = || self.void_bound_m(i, j);
            let found = walk(&ray, 1.0, cells, t[0], t[1], |cell, t| {
                self.cross_cell(&ray, cell, t, bound_m)
            });
            found.map_or(Continue(()), Break)
        });
        found.flatten()
    }

    /// The part of a ray, from and to, in which its height is between the ground's least and largest.
    fn within_heights(&self, ray: &Ray) -> Option<(f64, f64)> {
        let at = |z_m: f64| (z_m - ray.z_m) / ray.rise_m;
        // A metre below the lowest, so that a ray ends below the ground and not on it.
        let lowest_m = self.min_m - 1.0;
        let (begin, end) = match ray.rise_m {
            rise if rise < 0.0 => (at(self.max_m).max(0.0), at(lowest_m)),
            rise if rise > 0.0 && ray.z_m <= self.max_m => (0.0, at(self.max_m)),
            0.0 if ray.z_m <= self.max_m && ray.step != [0.0, 0.0] => (0.0, f64::INFINITY),
            _ => return None,
        };
        (begin <= end).then_some((begin, end))
    }

    fn cross_cell(
        &self,
        ray: &Ray,
        [i, j]: [usize; 2],
        t: [f64; 2],
        void_bound_m: impl Fn() -> f64,
    ) -> ControlFlow<Option<Crossing>> {
        let cell = self.cell(i, j);
        let corner = [i as f64, j as f64];
        let at = |t: f64| [0, 1].map(|k| ray.start[k] + ray.step[k] * t - corner[k]);
        if !(cell.corner + cell.along[0] + cell.along[1] + cell.twist).is_finite() {
            return match ray.lowest_m(t) > void_bound_m() {
                true => Continue(()),
                false => Break(None),
            };
        }
        let Some(since) = ray.meets(&cell, at(t[0]), t) else {
            return Continue(());
        };
        let reach = t[0] + since;
        Break(Some(Crossing {
            reach,
            ground: cell.ground(at(reach).map(|f| f.clamp(0.0, 1.0)), self.spacing_m),
        }))
    }
}

impl Ray {
    fn height_m(&self, t: f64) -> f64 {
        self.z_m + self.rise_m * t
    }

    fn lowest_m(&self, [begin, end]: [f64; 2]) -> f64 {
        self.height_m(begin).min(self.height_m(end))
    }

    /// When, after `t[0]`, the ray first meets the surface of a cell that it is in during `t`, and enters at (fx, fy): along a line
    /// a bilinear surface is a parabola.
    fn meets(&self, cell: &Cell, [fx, fy]: [f64; 2], [begin, end]: [f64; 2]) -> Option<f64> {
        let [dx, dy] = self.step;
        let [a, b] = cell.along;
        // The ray above the surface is p·τ² + q·τ + r.
        let p = -cell.twist * dx * dy;
        let q = self.rise_m - (a * dx + b * dy + cell.twist * (fx * dy + fy * dx));
        let r = self.height_m(begin) - (cell.corner + a * fx + b * fy + cell.twist * fx * fy);
        let width = end - begin;
        // At the edge between two cells rounding may leave the root to neither.
        if r <= 0.0 {
            return Some(0.0);
        }
        let ends_below = (p * width + q) * width + r <= 0.0;
        let vertex = -q / (2.0 * p);
        let dips_below = p > 0.0 && (0.0..width).contains(&vertex) && q * q >= 4.0 * p * r;
        if !ends_below && !dips_below {
            return None;
        }
        // The least positive root, in the form without cancellation.
        let root = (q * q - 4.0 * p * r).max(0.0).sqrt();
        let since = match q < 0.0 {
            true => 2.0 * r / (root - q),
            false => -(q + root) / (2.0 * p),
        };
        Some(since.clamp(0.0, width))
    }
}

/// The squares of a grid of `n` × `n`, whose side is `1 / scale` cells, that a ray passes between `begin` and `end`, in order, until
/// `visit` breaks or the grid ends.
fn walk<T>(
    ray: &Ray,
    scale: f64,
    n: usize,
    begin: f64,
    end: f64,
    mut visit: impl FnMut([usize; 2], [f64; 2]) -> ControlFlow<T>,
) -> Option<T> {
    let (start, step) = (ray.start.map(|c| c * scale), ray.step.map(|c| c * scale));
    let entered = [0, 1].map(|k| start[k] + step[k] * begin);
    if entered.iter().any(|c| !(-1e-6..=n as f64 + 1e-6).contains(c)) {
        return None;
    }
    let mut square = entered.map(|c| (c.max(0.0) as usize).min(n - 1));
    let mut now = begin;
    loop {
        let leaves = [0, 1].map(|k| match step[k] {
            s if s > 0.0 => ((square[k] + 1) as f64 - start[k]) / s,
            s if s < 0.0 => (square[k] as f64 - start[k]) / s,
            _ => f64::INFINITY,
        });
        let axis = usize::from(leaves[1] < leaves[0]);
        let until = leaves[axis].min(end).max(now);
        if let Break(found) = visit(square, [now, until]) {
            return Some(found);
        }
        if leaves[axis] >= end {
            return None;
        }
        square[axis] = match step[axis] > 0.0 {
            true => square[axis] + 1,
            false => square[axis].checked_sub(1)?,
        };
        if square[axis] >= n {
            return None;
        }
        now = until;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cross(terrain: &Terrain, from: [f64; 3], ray: [f64; 3]) -> Option<Vector3<f64>> {
        let (from, ray) = (Vector3::from(from), Vector3::from(ray));
        let found = terrain.cross(&from, &ray)?;
        let place = from + ray * found.reach;
        assert!((place.z - found.ground.z_m).abs() < 1e-6, "{place} {found:?}");
        Some(place)
    }

    fn hill(x: f64, y: f64) -> f64 {
        80.0 * (-((x - 100.0).powi(2) + y * y) / 5000.0).exp() - 20.0
    }

    #[test]
    fn on_a_plane_the_crossing_is_the_exact_one() {
        // Slopes and nodes that f32 holds exactly.
        let plane = Terrain::sampled(100, 8.0, |x, y| 0.25 * x - 0.125 * y + 16.0);
        for ray in [
            [0.1, 0.2, -1.0],
            [-0.7, 0.4, -1.0],
            [0.0, 0.0, -2.0],
            [0.9, 0.0, 0.05],
            [0.0, -0.3, -0.5],
        ] {
            let from = [12.5, -31.0, 290.0];
            // n·(from + t·ray) = 16 with n = (−1/4, 1/8, 1).
            let n = Vector3::new(-0.25, 0.125, 1.0);
            let t = (16.0 - n.dot(&from.into())) / n.dot(&ray.into());
            let expected = Vector3::from(from) + Vector3::from(ray) * t;
            let found = cross(&plane, from, ray);
            match expected.x.abs().max(expected.y.abs()) < 800.0 && t > 0.0 {
                true => assert!(
                    (found.expect("on the map") - expected).norm() < 1e-9,
                    "{found:?} {expected}"
                ),
                false => assert!(found.is_none(), "{found:?} {expected}"),
            }
        }
    }

    #[test]
    fn of_several_crossings_the_nearest_counts() {
        let terrain = Terrain::sampled(300, 2.0, hill);
        // A ray that only touches the hill is found by small steps; the reference goes along it by a centimetre.
        let from = [-150.0, 7.0, 70.0];
        for down in 0..40 {
            let ray = [1.0, -0.02, -0.005 * f64::from(down)];
            let along = |t: f64| [from[0] + t, from[1] - 0.02 * t, from[2] + ray[2] * t];
            let first = (1..60_000).map(|k| 0.01 * f64::from(k)).find(|t| {
                let [x, y, z] = along(*t);
                terrain.at([x, y]).is_some_and(|ground| z <= ground.z_m)
            });
            let found = terrain.cross(&from.into(), &ray.into()).map(|found| found.reach);
            match (first, found) {
                (Some(first), Some(found)) => assert!((0.0..=0.0101).contains(&(first - found)), "{first} {found}"),
                (None, None) => {}
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn rays_that_start_below_or_off_the_map_or_leave_it_meet_nothing() {
        let terrain = Terrain::sampled(50, 4.0, hill);
        assert!(
            cross(&terrain, [100.0, 0.0, 59.0], [0.0, 0.0, -1.0]).is_none(),
            "inside the hill"
        );
        assert!(cross(&terrain, [100.0, 0.0, 61.0], [0.0, 0.0, -1.0]).is_some());
        assert!(cross(&terrain, [100.0, 0.0, 61.0], [0.0, 0.0, 1.0]).is_none());
        assert!(cross(&terrain, [201.0, 0.0, 300.0], [-1.0, 0.0, -1.0]).is_none());
        assert!(cross(&terrain, [0.0, 0.0, 300.0], [1.0, 0.0, -1.0]).is_none());
        assert!(cross(&terrain, [0.0, 0.0, 30.0], [0.0, 0.0, 0.0]).is_none());
        assert!(cross(&terrain, [0.0, 0.0, 30.0], [1.0, 0.0, 0.0]).is_some());
        assert!(cross(&terrain, [0.0, 0.0, f64::NAN], [0.0, 0.0, -1.0]).is_none());
        assert!(cross(&terrain, [0.0, 0.0, 30.0], [f64::NAN, 0.0, -1.0]).is_none());
    }

    #[test]
    fn a_void_hides_what_passes_low_over_it_and_nothing_else() {
        let terrain = Terrain::sampled(200, 4.0, |x, y| match (x + 40.0).hypot(y) < 10.0 {
            true => f64::NAN,
            false => hill(x, y),
        });
        assert!(cross(&terrain, [-40.0, 0.0, 300.0], [0.0, 0.0, -1.0]).is_none());
        assert!(
            cross(&terrain, [-300.0, 0.0, 300.0], [1.0, 0.0, -0.7]).is_some(),
            "61 m above the hilltop"
        );
        assert!(cross(&terrain, [-300.0, 0.0, 20.0], [1.0, 0.0, -0.05]).is_none());
    }
}
