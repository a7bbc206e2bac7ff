//! Segments a large frame into windows that hold all of its significant light, so that what stands apart is searched apart.
//!
//! Pixels are summed to cells of about a spot's σ and these to blocks of about 2.8 σ, the box nearest to a matched filter. Cells whose
//! block is significant are grouped, and each group's bounding box, with a margin, is a window. One pass over the pixels, and one over the
//! cells, is all that grows with the area.

use std::ops::Range;

use crate::estimate::preprocess::screening::is_usable;
use crate::frame::Frame;
use crate::optics::{Axis, Camera};

/// Side of a block, σ: the box that passes most of a spot's signal-to-noise ratio, 89 % where it is centred and 80 % at worst.
const BLOCK: f64 = 2.8;
/// Most cells along a block: more would find a spot's place better and cost more.
const MOST_CELLS: usize = 3;
/// Least significance of a block, of the threshold of a detection by the matched filter: of emitters at that threshold a block misses one in
/// a hundred at worst. Less makes more windows of noise, which cost a search each.
const SHARE: f64 = 0.55;
/// Margin around significant blocks and least width of a window, σ: beyond them a spot that is just significant has 1 % of its information,
/// and a bright one less than a twentieth of the noise in a pixel. More costs time.
const MARGIN: f64 = 0.25;
const LEAST_WIDTH: f64 = 8.0;
/// Windows have a multiple of this many pixels along each axis: few sizes are prepared for, and rows are whole vectors.
const STEP: usize = 4;

/// Groups farther apart than this many dark cells are separate: what each leaves in the other's pixels biases positions by 2 % of their
/// standard deviation at most.
const GAP: usize = 1;

/// Cells from which the dark is measured: with them its level is known to a hundredth of a cell's noise.
const SAMPLES: usize = 20_000;
/// Most of the cells may be lit where the dark is measured: more shift its median by more than a fiftieth of a pixel's noise.
const SPARSE: f64 = 0.03;

/// A part of a frame that holds one group of light.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Window {
    /// Pixels along x and y. Windows may overlap, and hold light of other groups.
    pub pixels: [Range<usize>; 2],
    /// The most significant block, in standard deviations.
    pub significance: f64,
    group: usize,
}

impl Window {
    pub fn area(&self) -> usize {
        self.pixels[0].len() * self.pixels[1].len()
    }
}

/// Sums over a frame's usable pixels, in units of the noise.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PixelSums {
    pub usable: f64,
    pub saturated: f64,
    pub square: f64,
    /// Pixels below −1.
    pub low: f64,
}

/// The dark of a frame: what lies under its light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Dark {
    /// Mean of a pixel, and its standard deviation, J.
    pub level_j: f64,
    pub noise_std_j: f64,
}

/// How an axis is cut into cells and blocks.
struct Cells {
    pixels: usize,
    /// Pixels of a cell.
    size: usize,
    /// Cells before and after a block's first one; the middle one is the block's place.
    reach: usize,
    /// 1/√pixels of the block around each cell.
    scale: Vec<f64>,
    margin: usize,
    least_width: usize,
}

impl Cells {
    fn new(axis: &Axis, sigma_m: f64) -> Self {
        let sigma = sigma_m / axis.pitch_m;
        let size = (sigma.round() as usize).clamp(1, axis.n);
        let reach = (BLOCK * sigma / size as f64).round() as usize / 2;
        let reach = reach.min(MOST_CELLS / 2);
        let count = axis.n.div_ceil(size);
        let pixels = |k: usize| {
            let cells = around(k, reach, count);
            ((cells.end() + 1) * size).min(axis.n) - cells.start() * size
        };
        Self {
            pixels: axis.n,
            size,
            reach,
            scale: (0..count).map(|k| 1.0 / (pixels(k) as f64).sqrt()).collect(),
            margin: (MARGIN * sigma).ceil() as usize,
            least_width: (LEAST_WIDTH * sigma).ceil() as usize,
        }
    }

    fn count(&self) -> usize {
        self.scale.len()
    }

    /// The pixels of a window of the cells `first` to `last`: with the margin, as many as it takes, and a multiple of [`STEP`].
    fn window(&self, first: usize, last: usize) -> Range<usize> {
        let (low, high) = (first * self.size, ((last + 1) * self.size).min(self.pixels));
        let least = (high - low + 2 * self.margin).max(self.least_width);
        let length = least.next_multiple_of(STEP).min(self.pixels);
        let start = low
            .saturating_sub((length - (high - low)) / 2)
            .min(self.pixels - length);
        start..start + length
    }
}

/// Segments the frames of one camera; holds its scratch memory.
pub(crate) struct Segmentation {
    cells: [Cells; 2],
    configured: Dark,
    saturation_limit_j: f64,
    threshold: f64,
    sample: Vec<f64>,
    strip: Vec<f64>,
    squares: Vec<f64>,
    lows: Vec<f64>,
    /// Light of each cell, (cells y, cells x).
    light: Vec<f64>,
    /// Significance of the block around each cell.
    blocks: Vec<f64>,
    /// Number of the group of each cell; 0 where it is dark.
    groups: Vec<usize>,
    pending: Vec<usize>,
    pub windows: Vec<Window>,
    pub sums: PixelSums,
    pub dark: Dark,
}

impl Segmentation {
    /// `detection` is the threshold of the matched filter, in standard deviations.
    pub fn new(camera: &Camera, detection: f64) -> Self {
        let configured = Dark {
            level_j: 0.0,
            noise_std_j: camera.noise_std_j,
        };
        Self {
            cells: [&camera.x, &camera.y].map(|axis| Cells::new(axis, camera.spot_sigma_m)),
            configured,
            dark: configured,
            sample: Vec::new(),
            saturation_limit_j: camera.saturation_limit_j(),
            threshold: SHARE * detection,
            strip: vec![0.0; camera.x.n],
            squares: vec![0.0; camera.x.n],
            lows: vec![0.0; camera.x.n],
            light: Vec::new(),
            blocks: Vec::new(),
            groups: Vec::new(),
            pending: Vec::new(),
            windows: Vec::new(),
            sums: PixelSums::default(),
        }
    }

    /// Sets `windows`, the most significant first, `sums` and `dark`. The frame has the camera's shape.
    pub fn run(&mut self, frame: &Frame) {
        self.segment(frame, self.configured);
    }

    /// The same above a dark that is measured, after [`Segmentation::run`]. Returns whether it could be: the frame's light must be sparse.
    pub fn run_in_measured_dark(&mut self, frame: &Frame) -> bool {
        let dark = self.measure_dark();
        if !(dark.noise_std_j > 0.0 && dark.noise_std_j.is_finite() && dark.level_j.is_finite()) {
            return false;
        }
        self.segment(frame, dark);
        let lit = self.groups.iter().filter(|g| **g != 0).count();
        (lit as f64) < SPARSE * self.groups.len() as f64
    }

    fn segment(&mut self, frame: &Frame, dark: Dark) {
        self.dark = dark;
        self.sum_cells(frame);
        self.sum_blocks();
        self.group();
        self.windows.sort_by(|a, b| b.significance.total_cmp(&a.significance));
    }

    fn sum_cells(&mut self, frame: &Frame) {
        let [cx, cy] = [&self.cells[0], &self.cells[1]];
        let (scale, limit) = (1.0 / self.dark.noise_std_j, self.saturation_limit_j);
        let level = scale * self.dark.level_j;
        self.light.clear();
        self.light.resize(cx.count() * cy.count(), 0.0);
        self.squares.fill(0.0);
        self.lows.fill(0.0);
        self.sums = PixelSums::default();
        let mut unusable = 0.0;
        for (j, light) in self.light.chunks_exact_mut(cx.count()).enumerate() {
            self.strip.fill(0.0);
            for y in j * cy.size..((j + 1) * cy.size).min(cy.pixels) {
                let row = frame.pixels.row(y);
                let row = row.as_slice().filter(|row| {
                    frame.masked.is_none() && row.iter().fold(true, |all, &v| all & is_usable(v, scale, limit))
                });
                if let Some(row) = row {
                    let sums = self.strip.iter_mut().zip(&mut self.squares).zip(&mut self.lows);
                    for (((strip, square), low), v) in sums.zip(row) {
                        let p = v * scale - level;
                        *strip += p;
                        *square += p * p;
                        *low += if p < -1.0 { 1.0 } else { 0.0 };
                    }
                    continue;
                }
                for (x, &v) in frame.pixels.row(y).iter().enumerate() {
                    let is_masked = frame.masked.as_ref().is_some_and(|m| m.get((y, x)) == Some(&true));
                    if is_usable(v, scale, limit) && !is_masked {
                        let p = v * scale - level;
                        self.strip[x] += p;
                        self.squares[x] += p * p;
                        self.lows[x] += if p < -1.0 { 1.0 } else { 0.0 };
                        continue;
                    }
                    unusable += 1.0;
                    if v >= limit {
                        self.sums.saturated += 1.0;
                        // As bright as it can be: never outside a window.
                        self.strip[x] += limit * scale;
                    }
                }
            }
            for (sum, pixels) in light.iter_mut().zip(self.strip.chunks(cx.size)) {
                *sum = pixels.iter().sum();
            }
        }
        self.sums.usable = frame.pixels.len() as f64 - unusable;
        self.sums.square = self.squares.iter().sum();
        self.sums.low = self.lows.iter().sum();
    }

    /// The dark by the median of the cells and of their deviations, which sparse light hardly changes (Hampel, 1974).
    fn measure_dark(&mut self) -> Dark {
        let [cx, cy] = [&self.cells[0], &self.cells[1]];
        let pixels = (cx.size * cy.size) as f64;
        self.sample.clear();
        let step = self.light.len().div_ceil(SAMPLES).max(1);
        self.sample.extend(self.light.iter().step_by(step));
        let level = median(&mut self.sample);
        for v in &mut self.sample {
            *v = (*v - level).abs();
        }
        // The median of |normal| is 0.6745.
        let noise = median(&mut self.sample) / 0.6745;
        Dark {
            level_j: level / pixels * self.configured.noise_std_j,
            noise_std_j: noise / pixels.sqrt() * self.configured.noise_std_j,
        }
    }

    fn sum_blocks(&mut self) {
        let [cx, cy] = [&self.cells[0], &self.cells[1]];
        let (nx, ny) = (cx.count(), cy.count());
        self.blocks.resize(nx * ny, 0.0);
        let mut column = vec![0.0; nx];
        for (j, out) in self.blocks.chunks_exact_mut(nx).enumerate() {
            column.fill(0.0);
            for y in around(j, cy.reach, ny) {
                for (c, light) in column.iter_mut().zip(&self.light[y * nx..(y + 1) * nx]) {
                    *c += light;
                }
            }
            for (i, o) in out.iter_mut().enumerate() {
                *o = column[around(i, cx.reach, nx)].iter().sum::<f64>() * cx.scale[i] * cy.scale[j];
            }
        }
    }

    /// Groups significant cells; sets `windows` and the cells' `groups`.
    fn group(&mut self) {
        let [cx, cy] = [&self.cells[0], &self.cells[1]];
        let (nx, ny) = (cx.count(), cy.count());
        self.windows.clear();
        self.groups.clear();
        self.groups.resize(nx * ny, 0);
        for first in 0..self.blocks.len() {
            if !(self.blocks[first] > self.threshold) || self.groups[first] != 0 {
                continue;
            }
            let group = self.windows.len() + 1;
            let (mut low, mut high, mut significance) = ([nx, ny], [0, 0], 0.0f64);
            self.groups[first] = group;
            self.pending.push(first);
            while let Some(k) = self.pending.pop() {
                let (i, j) = (k % nx, k / nx);
                low = [low[0].min(i), low[1].min(j)];
                high = [high[0].max(i), high[1].max(j)];
                significance = significance.max(self.blocks[k]);
                for y in around(j, GAP + 1, ny) {
                    for x in around(i, GAP + 1, nx) {
                        let k = y * nx + x;
                        if self.blocks[k] > self.threshold && self.groups[k] == 0 {
                            self.groups[k] = group;
                            self.pending.push(k);
                        }
                    }
                }
            }
            self.windows.push(Window {
                pixels: [cx.window(low[0], high[0]), cy.window(low[1], high[1])],
                significance,
                group,
            });
        }
    }

    /// Calls `each` with every pixel of a window, counted from its corner, that holds light of other groups.
    pub fn foreign_pixels(&self, window: &Window, mut each: impl FnMut(usize, usize)) {
        let [cx, cy] = [&self.cells[0], &self.cells[1]];
        let (nx, ny) = (cx.count(), cy.count());
        let [x, y] = &window.pixels;
        let [columns, rows] = [(x, cx), (y, cy)].map(|(p, c)| p.start / c.size..=(p.end - 1) / c.size);
        for (j, i) in rows.flat_map(|j| columns.clone().map(move |i| (j, i))) {
            let near = around(j, 1, ny).flat_map(|y| around(i, 1, nx).map(move |x| y * nx + x));
            let groups = || near.clone().map(|k| self.groups[k]).filter(|g| *g != 0);
            if groups().next().is_none() || groups().any(|g| g == window.group) {
                continue;
            }
            for b in (j * cy.size).max(y.start)..((j + 1) * cy.size).min(y.end) {
                for a in (i * cx.size).max(x.start)..((i + 1) * cx.size).min(x.end) {
                    each(a - x.start, b - y.start);
                }
            }
        }
    }
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The cells up to `reach` from cell `k` of `count`.
fn around(k: usize, reach: usize, count: usize) -> std::ops::RangeInclusive<usize> {
    k.saturating_sub(reach)..=(k + reach).min(count - 1)
}
