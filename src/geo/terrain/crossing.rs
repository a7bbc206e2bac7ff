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
