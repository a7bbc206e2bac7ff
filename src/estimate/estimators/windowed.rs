//! Maximum likelihood on a large sensor: each window of a segmented frame is searched as a small frame of its own, so that the time grows
//! with the light and not with the area.

use std::collections::BTreeMap;

use ndarray::{Array2, s};

use crate::estimate::detect::segmentation::{Dark, PixelSums, Segmentation, Window};
use crate::estimate::emitter::{Emitter, Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::EstimatorSpec;
use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::{OVERLAPPING, PointSource};
use crate::estimate::model_order::criterion::source_penalty;
use crate::estimate::preprocess::screening::is_background_visible;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise::EDGE_DISTANCE;
use crate::frame::Frame;
use crate::optics::{Axis, Camera, Distortion, Smear};

/// Sensors wider than this, σ, are searched by windows. On smaller ones a basis measures the noise beside the spots.
const WIDE: f64 = 116.0;
/// Largest share of the frame that a window may be: above, the whole frame is one search.
const LARGEST: f64 = 0.5;
/// Most windows of a frame, the most significant ones: bounds the time that an attacker's crowd can take.
const MOST_WINDOWS: usize = 1000;
/// Steps of fits after which a frame's other windows are left: a frame of 200 emitters takes 5,000.
const MOST_STEPS: u64 = 100_000;
/// Excess of the windows' deviance together, in standard deviations, from which the frame is not explained; as for the flag `poor_fit`.
const MOST_MISFIT: f64 = 5.0;
/// Most windows with emitters for which a frame that these do not explain is searched as a whole: what is common to all spots, as a lens's
/// misfit, shows only there, and more would take seconds.
const MOST_FOR_WHOLE: usize = 40;

/// Spots smeared by more than this, σ, are searched for as a whole: a block holds too little of the light of faint ones.
const MOST_SMEAR: f64 = 3.5;
/// Least height of a halo in a window, in units of the noise, that counts there: less adds 1 % to a pixel's variance.
const LEAST_HALO: f64 = 0.1;

/// A companion of an emitter is within `COMPANION` σ and fainter than `FAINT` of it, or within [`OVERLAPPING`]. Where half of the bright
/// emitters have one, the spot may be wider than the model or have a ghost: of 80 emitters on 256 × 256 pixels a quarter have.
const COMPANION: f64 = 6.0;
const FAINT: f64 = 0.5;
/// Fewest emitters that show what is common to them.
const FEWEST: usize = 3;
/// Sizes of windows whose searches are kept: a large sensor has thousands. Fewer make searches anew, more take memory.
const MOST_SIZES: usize = 64;

/// Searches windows of a frame, or all of it where windows gain nothing.
pub(crate) struct WindowedEstimator {
    spec: &'static EstimatorSpec,
    camera: Camera,
    rules: Rules,
    source_penalty: f64,
    segmentation: Segmentation,
    /// By the number of pixels along x and y.
    searches: BTreeMap<[usize; 2], SizedSearch>,
    /// Windows so far.
    searched: u64,
    /// Made for the first frame that needs it: it takes memory that grows with the area.
    whole: Option<AnalyticEstimator>,
    smear: Option<Smear>,
}

/// The search of windows of one size.
struct SizedSearch {
    /// The last of the windows that it was used for.
    used_for: u64,
    /// The window's lower edges on its own sensor, m.
    low_m: [f64; 2],
    estimator: AnalyticEstimator,
    frame: Frame,
}

impl WindowedEstimator {
    /// Whether the sensor is large.
    pub fn suits(camera: &Camera, rules: Rules) -> bool {
        let [x, y] = widths(camera);
        rules.windows && x.max(y) > WIDE
    }

    pub fn new(spec: &'static EstimatorSpec, camera: &Camera, rules: Rules) -> Self {
        let source_penalty = source_penalty(widths(camera));
        Self {
            spec,
            camera: camera.clone(),
            rules,
            source_penalty,
            segmentation: Segmentation::new(camera, source_penalty.sqrt()),
            searches: BTreeMap::new(),
            searched: 0,
            whole: None,
            smear: None,
        }
    }

    fn search_whole(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let (spec, camera, rules) = (self.spec, &self.camera, self.rules);
        let whole = (self.whole).get_or_insert_with(|| AnalyticEstimator::new(spec, camera, None, rules));
        whole.set_smear(self.smear.as_ref());
        whole.estimate_until(frame, is_over)
    }

    fn has_visible_background(&self) -> bool {
        let sums = &self.segmentation.sums;
        is_background_visible(sums.usable, sums.low)
    }

    /// Whether spots differ from the PSF in a way that all have in common, and that no window shows alone.
    fn may_share_misfit(&self) -> bool {
        !self.camera.spot_error.is_fixed() || self.camera.spot_shape.is_none()
    }

    /// Whether the frame's light stands apart before a dark background.
    fn is_apart(&self) -> bool {
        let sums = &self.segmentation.sums;
        let largest = self.segmentation.windows.iter().map(Window::area).max().unwrap_or(0);
        sums.usable > 0.0
            && !self.has_visible_background()
            && (largest as f64) < LARGEST * (self.camera.x.n * self.camera.y.n) as f64
    }

    /// Searches a window beside the brighter emitters that were found before; `None` where it has no usable pixel.
    fn search(
        &mut self,
        frame: &Frame,
        window: &Window,
        brighter: &[Emitter],
        is_over: &dyn Fn() -> bool,
    ) -> Option<Found> {
        let [x, y] = &window.pixels;
        let size = [x.len(), y.len()];
        if self.searches.len() == MOST_SIZES
            && !self.searches.contains_key(&size)
            && let Some(oldest) = self
                .searches
                .iter()
                .min_by_key(|(_, s)| s.used_for)
                .map(|(size, _)| *size)
        {
            self.searches.remove(&oldest);
        }
        self.searched += 1;
        let search = self
            .searches
            .entry(size)
            .or_insert_with(|| SizedSearch::new(self.spec, &self.camera, self.rules, self.source_penalty, size));
        search.used_for = self.searched;
        let part = s![y.clone(), x.clone()];
        search.frame.pixels.assign(&frame.pixels.slice(part));
        let Dark { level_j, noise_std_j } = self.segmentation.dark;
        let limit = self.camera.saturation_limit_j();
        if level_j != 0.0 {
            search
                .frame
                .pixels
                .mapv_inplace(|v| if v < limit { v - level_j } else { v });
        }
        search.frame.masked = frame.masked.as_ref().map(|m| m.slice(part).to_owned());
        let offset = [0, 1].map(|k| [&self.camera.x, &self.camera.y][k].edge(window.pixels[k].start) - search.low_m[k]);
        let beyond = beyond(&self.camera, brighter, offset, window);
        let estimator = &mut search.estimator;
        estimator.place_window(offset, beyond);
        estimator.set_smear(self.smear.as_ref().map(|smear| smear.seen_from(offset)).as_ref());
        let segmentation = &self.segmentation;
        // Of the squares of standard normal variates, one for each window, the largest is about 2 ln of their number.
        let spare_excess = (2.0 * (segmentation.windows.len() as f64).ln()).sqrt();
        let sums = estimator
            .load_window(
                &search.frame,
                |each| segmentation.foreign_pixels(window, each),
                noise_std_j,
                spare_excess,
            )
            .ok()?;
        if !estimator.has_peak() {
            return Some(Found {
                estimate: Estimate::default(),
                sums,
            });
        }
        let mut estimate = estimator.estimate_loaded(1.0, is_over);
        for emitter in &mut estimate.emitters {
            place(emitter, &self.camera, offset);
        }
        Some(Found { estimate, sums })
    }
}

/// What a window holds.
struct Found {
    estimate: Estimate,
    sums: PixelSums,
}

/// What windows together hold.
#[derive(Default)]
struct Total {
    estimate: Estimate,
    /// Of the windows with emitters: noise is chosen for its peaks, and says nothing of how well emitters explain light.
    deviance: f64,
    freedom: f64,
    sums: PixelSums,
    windows: usize,
}

impl Total {
    fn add(&mut self, found: Found) {
        let count = found.estimate.emitters.len();
        let all = &mut self.estimate;
        all.is_cut_short |= found.estimate.is_cut_short;
        all.is_limited |= found.estimate.is_limited;
        all.condition = all.condition.max(found.estimate.condition);
        all.spot_error = all.spot_error.max(found.estimate.spot_error);
        all.steps += found.estimate.steps;
        all.emitters.extend(found.estimate.emitters);
        if count > 0 {
            let freedom = (found.sums.usable - 3.0 * count as f64).max(1.0);
            self.deviance += freedom * found.estimate.reduced_chi2;
            self.freedom += freedom;
            self.windows += 1;
            self.sums.usable += found.sums.usable;
            self.sums.square += found.sums.square;
        }
    }

    /// Whether the windows' emitters explain their light without a misfit of the spot.
    fn is_explained(&self, camera: &Camera) -> bool {
        let spread = (2.0 * self.freedom).sqrt() + 1.0;
        let has_misfit = self.deviance > self.freedom + MOST_MISFIT * spread;
        let known = camera.spot_error.least();
        let is_shape_known = camera.spot_error.is_fixed() && known > 0.0;
        !has_misfit
            && (is_shape_known
                || self.estimate.spot_error <= known && !are_attended(&self.estimate.emitters, camera.spot_sigma_m))
    }

    /// The frame's estimate, given the sums over all of its pixels.
    fn finish(self, sums: PixelSums) -> Estimate {
        let mut all = self.estimate;
        let dark = [sums.square - self.sums.square, sums.usable - self.sums.usable].map(|d| d.max(0.0));
        all.reduced_chi2 = (self.deviance + dark[0]) / (self.freedom + dark[1]).max(1.0);
        let mut flags = Flags::empty();
        flags.set(Flags::OUT_OF_TIME, all.is_cut_short);
        flags.set(Flags::LIMIT_REACHED, all.is_limited);
        for emitter in &mut all.emitters {
            emitter.flags |= flags;
        }
        all
    }
}

impl SizedSearch {
    fn new(
        spec: &'static EstimatorSpec,
        camera: &Camera,
        rules: Rules,
        source_penalty: f64,
        [nx, ny]: [usize; 2],
    ) -> Self {
        let axis = |axis: &Axis, n: usize| Axis::centred(n, n as f64 * axis.pitch_m);
        let own = Camera {
            x: axis(&camera.x, nx),
            y: axis(&camera.y, ny),
            // Its ground is the sensor itself.
            altitude_m: 1.0,
            plane_distance_m: 1.0,
            distortion: Distortion::default(),
            ..camera.clone()
        };
        Self {
            used_for: 0,
            low_m: [own.x.min_m, own.y.min_m],
            estimator: AnalyticEstimator::of_window(spec, &own, rules, source_penalty),
            frame: Frame {
                index: 0,
                time: jiff::Timestamp::UNIX_EPOCH,
                pixels: Array2::zeros((ny, nx)),
                masked: None,
                exposure_s: None,
                energy_scale: 1.0,
            },
        }
    }
}

/// Whether so many emitters have companions that these may be the spot's own shape.
fn are_attended(emitters: &[Emitter], spot_sigma_m: f64) -> bool {
    let distance = |a: &Emitter, b: &Emitter| {
        let [dx, dy] = [0, 1].map(|k| a.sensor_m[k] - b.sensor_m[k]);
        dx.hypot(dy) / spot_sigma_m
    };
    let is_faint_beside = |a: &Emitter, b: &Emitter| a.energy_j < FAINT * b.energy_j && distance(a, b) < COMPANION;
    let is_bright = |e: &&Emitter| !emitters.iter().any(|other| is_faint_beside(e, other));
    let is_attended = |e: &&Emitter| {
        let is_companion = |c: &Emitter| is_faint_beside(c, e) || distance(c, e) < OVERLAPPING;
        emitters.iter().any(|c| !std::ptr::eq(*e, c) && is_companion(c))
    };
    let (bright, attended) = emitters.iter().filter(is_bright).fold((0, 0), |(bright, attended), e| {
        (bright + 1, attended + usize::from(is_attended(&e)))
    });
    bright >= FEWEST && 2 * attended >= bright
}

/// The emitters that cast a halo into a window of the sensor, as the window, whose middle is at `offset`, sees them.
fn beyond(camera: &Camera, emitters: &[Emitter], offset: [f64; 2], window: &Window) -> Vec<PointSource> {
    let error = camera.spot_error.least();
    if error == 0.0 {
        return Vec::new();
    }
    let beyond = camera.spot_shape.as_ref().and_then(|shape| shape.beyond());
    let beyond = beyond.map_or(0.0, |beyond| beyond.error);
    let sigma = camera.spot_sigma_m;
    let norm = halo::norm_of_pitches([&camera.x, &camera.y].map(|axis| axis.pitch_m / sigma));
    let ends = [0, 1].map(|k| {
        let axis = [&camera.x, &camera.y][k];
        [window.pixels[k].start, window.pixels[k].end].map(|p| axis.edge(p))
    });
    let source = |e: &Emitter| {
        let distance = [0, 1].map(|k| (e.sensor_m[k].clamp(ends[k][0], ends[k][1]) - e.sensor_m[k]) / sigma);
        let a = e.energy_j / camera.noise_std_j;
        let highest = error.max(beyond) * norm * a * halo::height(distance[0].powi(2) + distance[1].powi(2));
        (highest > LEAST_HALO).then(|| PointSource::new([0, 1].map(|k| (e.sensor_m[k] - offset[k]) / sigma), a))
    };
    emitters.iter().filter_map(source).collect()
}

/// Widths of a camera's sensor, σ.
fn widths(camera: &Camera) -> [f64; 2] {
    [&camera.x, &camera.y].map(|axis| 2.0 * axis.half_width() / camera.spot_sigma_m)
}

/// Moves an emitter of a window by `offset`, m, to its place on the sensor of `camera` and on the ground.
fn place(emitter: &mut Emitter, camera: &Camera, offset: [f64; 2]) {
    let sensor_m = [0, 1].map(|k| emitter.sensor_m[k] + offset[k]);
    [emitter.x_m, emitter.y_m] = camera.to_ground(sensor_m);
    emitter.cov_m2 = camera.cov_to_ground(sensor_m, emitter.cov_m2);
    emitter.sensor_m = sensor_m;
    let margin = EDGE_DISTANCE * camera.spot_sigma_m;
    let is_near_edge = [&camera.x, &camera.y]
        .iter()
        .zip(sensor_m)
        .any(|(axis, at)| at < axis.edge(0) + margin || at > axis.edge(axis.n) - margin);
    emitter.flags.set(Flags::NEAR_EDGE, is_near_edge);
}

impl Estimator for WindowedEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.smear = smear.cloned();
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let is_smeared = |smear: &Smear| smear.longest_m(&self.camera) > MOST_SMEAR * self.camera.spot_sigma_m;
        if frame.pixels.dim() != self.camera.shape() || self.smear.as_ref().is_some_and(is_smeared) {
            return self.search_whole(frame, is_over);
        }
        self.segmentation.run(frame);
        if self.has_visible_background() && !self.segmentation.run_in_measured_dark(frame) || !self.is_apart() {
            return self.search_whole(frame, is_over);
        }
        let windows = self.segmentation.windows.clone();
        let sums = self.segmentation.sums;
        let mut total = Total::default();
        total.estimate.estimator = self.spec.name;
        total.estimate.condition = 1.0;
        total.estimate.saturated_share = sums.saturated / frame.pixels.len() as f64;
        total.estimate.is_limited = windows.len() > MOST_WINDOWS;
        for window in windows.iter().take(MOST_WINDOWS) {
            if is_over() || total.estimate.steps > MOST_STEPS {
                total.estimate.is_cut_short = true;
                break;
            }
            if let Some(found) = self.search(frame, window, &total.estimate.emitters, is_over) {
                total.add(found);
            }
        }
        let may_be_whole = self.may_share_misfit() && total.windows <= MOST_FOR_WHOLE && !total.estimate.is_cut_short;
        let is_lens_known = self.whole.as_ref().is_some_and(AnalyticEstimator::remembers_spot_error);
        if may_be_whole && (is_lens_known || !total.is_explained(&self.camera)) {
            return self.search_whole(frame, is_over);
        }
        Ok(total.finish(sums))
    }
}
