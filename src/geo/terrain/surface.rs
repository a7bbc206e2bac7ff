//! Heights on a regular grid about the origin, bilinear between its nodes.

use std::fmt;

/// Cells along a side of a block: rays pass over a whole block that lies below them. 8 to 32 cost the same within a tenth.
pub(super) const BLOCK: usize = 16;

/// The ground about the origin: local up by local east and north, m.
pub struct Terrain {
    /// Nodes from the origin to each side.
    pub(super) half: usize,
    pub(super) spacing_m: f64,
    /// Row by row from the south-west; NaN where no height is known.
    z_m: Vec<f32>,
    /// Blocks along a side, and the largest height of each; −∞ where none is known.
    pub(super) blocks: usize,
    block_max_m: Vec<f32>,
    has_void: Vec<bool>,
    pub(super) min_m: f64,
    pub(super) max_m: f64,
}

/// The ground at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Above the origin, m.
    pub z_m: f64,
    /// ∂z/∂(east, north).
    pub slope: [f64; 2],
}

/// Bilinear height within one cell: z = corner + along·(fx, fy) + twist·fx·fy, with fx and fy from 0 to 1; NaN in a void.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cell {
    pub corner: f64,
    pub along: [f64; 2],
    pub twist: f64,
}

impl Terrain {
    /// Heights by `z_m(x, y)`, NaN where there are none, on a grid of `2·half + 1` nodes along a side.
    pub fn sampled(half: usize, spacing_m: f64, z_m: impl Fn(f64, f64) -> f64) -> Self {
        let n = 2 * half + 1;
        let at = |k: usize| (k as f64 - half as f64) * spacing_m;
        let z_m = (0..n * n).map(|k| z_m(at(k % n), at(k / n)) as f32).collect();
        Self::of_nodes(half, spacing_m, z_m)
    }

    /// `z_m` are the nodes, row by row from the south-west.
    pub(super) fn of_nodes(half: usize, spacing_m: f64, z_m: Vec<f32>) -> Self {
        let (n, cells) = (2 * half + 1, 2 * half);
        debug_assert_eq!(z_m.len(), n * n);
        let blocks = cells.div_ceil(BLOCK);
        let mut block_max_m = vec![f32::NEG_INFINITY; blocks * blocks];
        let mut has_void = vec![false; blocks * blocks];
        for j in 0..blocks {
            for i in 0..blocks {
                // The nodes of the far edge belong to the next block too.
                for row in j * BLOCK..=(j * BLOCK + BLOCK).min(cells) {
                    let nodes = &z_m[row * n + i * BLOCK..=row * n + (i * BLOCK + BLOCK).min(cells)];
                    let block = j * blocks + i;
                    block_max_m[block] = nodes.iter().copied().fold(block_max_m[block], f32::max);
                    has_void[block] |= nodes.iter().any(|z| z.is_nan());
                }
            }
        }
        let min_m = z_m.iter().copied().fold(f32::INFINITY, f32::min).into();
        let max_m = z_m.iter().copied().fold(f32::NEG_INFINITY, f32::max).into();
        Self {
            half,
            spacing_m,
            z_m,
            blocks,
            block_max_m,
            has_void,
            min_m,
            max_m,
        }
    }

    /// The ground at local east and north, m; `None` in a void and off the grid.
    pub fn at(&self, [x, y]: [f64; 2]) -> Option<Ground> {
        let [u, v] = [x, y].map(|c| c / self.spacing_m + self.half as f64);
        let cells = 2 * self.half;
        if !(0.0..=cells as f64).contains(&u) || !(0.0..=cells as f64).contains(&v) {
            return None;
        }
        let [i, j] = [u, v].map(|c| (c as usize).min(cells - 1));
        let ground = self.cell(i, j).ground([u - i as f64, v - j as f64], self.spacing_m);
        ground.z_m.is_finite().then_some(ground)
    }

    /// Half the side of the square that is known, m.
    pub fn half_m(&self) -> f64 {
        self.half as f64 * self.spacing_m
    }

    /// The share of the square without a height, and the distance from the origin to the nearest place without one, m; none where
    /// all are known.
    pub fn voids(&self) -> Option<(f64, f64)> {
        let n = 2 * self.half + 1;
        let voids = self.z_m.iter().enumerate().filter(|(_, z)| z.is_nan());
        let at = |k: usize| (k as f64 - self.half as f64) * self.spacing_m;
        let (count, nearest_m) = voids.fold((0, f64::INFINITY), |(count, nearest), (k, _)| {
            (count + 1, at(k % n).hypot(at(k / n)).min(nearest))
        });
        (count > 0).then(|| (f64::from(count) / self.z_m.len() as f64, nearest_m))
    }

    pub(super) fn cell(&self, i: usize, j: usize) -> Cell {
        let at = j * (2 * self.half + 1) + i;
        let above = at + 2 * self.half + 1;
        let [z00, z10, z01, z11] = [at, at + 1, above, above + 1].map(|k| f64::from(self.z_m[k]));
        Cell {
            corner: z00,
            along: [z10 - z00, z01 - z00],
            twist: z11 - z10 - z01 + z00,
        }
    }

    /// The largest height of a block, m, and whether some of it is not known.
    pub(super) fn block(&self, i: usize, j: usize) -> (f64, bool) {
        let block = j * self.blocks + i;
        (self.block_max_m[block].into(), self.has_void[block])
    }

    /// What the ground in a void of a block is taken to stay below, m: what is known around it. Infinite where nothing is.
    pub(super) fn void_bound_m(&self, i: usize, j: usize) -> f64 {
        let around = |k: usize| k.saturating_sub(1)..=(k + 1).min(self.blocks - 1);
        let known = around(j).flat_map(|j| around(i).map(move |i| self.block(i, j).0));
        let bound = known.fold(f64::NEG_INFINITY, f64::max);
        if bound.is_finite() { bound } else { f64::INFINITY }
    }
}

impl Cell {
    pub fn ground(&self, [fx, fy]: [f64; 2], spacing_m: f64) -> Ground {
        let [a, b] = self.along;
        Ground {
            z_m: self.corner + a * fx + b * fy + self.twist * fx * fy,
            slope: [(a + self.twist * fy) / spacing_m, (b + self.twist * fx) / spacing_m],
        }
    }
}

impl fmt::Debug for Terrain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Terrain")
            .field("half_m", &self.half_m())
            .field("spacing_m", &self.spacing_m)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ground_is_bilinear_and_unknown_beside_a_void_and_off_the_grid() {
        let terrain = Terrain::sampled(20, 10.0, |x, y| match (x, y) {
            (50.0, 0.0) => f64::NAN,
            _ => 0.25 * x - 0.5 * y + 0.01 * x * y,
        });
        let ground = terrain.at([13.0, -27.0]).expect("known");
        assert!((ground.z_m - (0.25 * 13.0 + 0.5 * 27.0 - 0.01 * 13.0 * 27.0)).abs() < 1e-4);
        assert!((ground.slope[0] - (0.25 - 0.27)).abs() < 1e-6 && (ground.slope[1] - (-0.5 + 0.13)).abs() < 1e-6);
        assert!(terrain.at([200.0, 200.0]).is_some() && terrain.at([-200.0, -200.0]).is_some());
        assert!(terrain.at([200.1, 0.0]).is_none() && terrain.at([f64::NAN, 0.0]).is_none());
        assert!(terrain.at([45.0, 5.0]).is_none() && terrain.at([39.0, 0.0]).is_some());
        let (share, nearest_m) = terrain.voids().expect("one");
        assert_eq!((share, nearest_m), (1.0 / 1681.0, 50.0));
        assert_eq!(terrain.half_m(), 200.0);
    }
}
