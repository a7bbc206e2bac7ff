//! Stacked misfit: light beside bright spots that recent frames together show to be common to them, where it is too faint in each of them.
//!
//! A ghost that no frame shows among all users stands out beside one of them now and then, and passes for a stranger there. Over frames each
//! spot shows what stands beside it, and what three quarters of them show at least is the lens's: a stranger stands beside one of them.

use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model_order::bright_spots::{CORE, distance2};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::common_misfit::{COMMON, LEFT, MAX_CORE, MAX_SPOT_ERROR};
use crate::estimate::model_order::search::Search;
use crate::estimate::model_order::spot_views::{Surroundings, View, comparable, offsets};

/// Samples that are remembered; frames from one to the next once there are as many.
const SAMPLES: usize = 32;
const EVERY: usize = 16;
/// Samples that must tell something of an offset.
const LEAST_SAMPLES: f64 = 4.0;
/// Combined significance, squared, of the spots that agree at an offset, and of them without the one that shows most.
const SIGNIFICANT: f64 = 36.0;
const WITHOUT_ONE: f64 = 18.0;
/// Significance of a misfit in a single frame: below that none is taken for an emitter, by many frames together neither.
const HARMFUL: f64 = 0.3;
/// Part of what a lens makes beside a spot that need not go with the spot's light, and standard deviations of chance.
const OWN: f64 = 0.5;
const CHANCE: f64 = 3.0;
/// Distance at which a misfit is compared with what stands on both sides of it, σ.
const BESIDE: f64 = 4.5;
/// Distance from one offset to the next, σ.
const SPACING: f64 = 1.0;
/// Spots that an offset needs to itself.
const LEAST_SPOTS: usize = 2;
/// Spots that are remembered.
const MOST_STACKS: usize = 16;

/// Sums over a spot's samples at one offset.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Σ w q and Σ w, of the shares q of the spot's light with their inverse variances w.
    weighted: f64,
    weight: f64,
    /// Variance of Σ w q.
    variance: f64,
    /// Σ w q² and the number of samples.
    squares: f64,
    count: f64,
}

impl Sums {
    fn fade(&mut self, by: f64) {
        self.weighted *= by;
        self.weight *= by;
        self.variance *= by * by;
        self.squares *= by;
        self.count *= by;
    }

    fn add(&mut self, response: f64, scale: f64) {
        self.weighted += scale * response;
        self.weight += scale * scale;
        self.variance += scale * scale;
        self.squares += response * response;
        self.count += 1.0;
    }

    /// The share with its significance; none where the light beside the spot does not go with the spot's own, and is another's.
    fn shown(&self) -> [f64; 2] {
        let explained = self.weighted.powi(2) / self.weight;
        let left = self.squares - explained - self.count;
        match left < OWN * explained + CHANCE * (2.0 * self.count).sqrt() {
            true => [self.weight, self.variance.sqrt()].map(|by| self.weighted / by),
            false => [0.0; 2],
        }
    }
}

/// What stood beside a spot in recent frames.
struct SpotStack {
    /// Where it was last, σ.
    u: [f64; 2],
    /// Offset by offset, along the sensor's axes and along its direction from the sensor's middle.
    sums: [Vec<Sums>; 2],
}

impl SpotStack {
    fn new(u: [f64; 2]) -> Self {
        let sums = vec![Sums::default(); offsets(SPACING).count()];
        Self {
            u,
            sums: [sums.clone(), sums],
        }
    }
}

/// The sums of recent frames.
#[derive(Default)]
pub(crate) struct StackedMisfit {
    spots: Vec<SpotStack>,
    samples: usize,
    frames: usize,
    spot_error: Option<f64>,
}

impl StackedMisfit {
    /// Whether a frame with light is to be sampled.
    pub fn is_due(&mut self) -> bool {
        self.frames += 1;
        self.samples < SAMPLES || self.frames.is_multiple_of(EVERY)
    }

    /// The spot error that the frames show together.
    pub fn spot_error(&self) -> Option<f64> {
        self.spot_error
    }

    /// Adds what the bright spots of a frame leave.
    pub fn add(&mut self, search: &mut Search, candidate: &mut Candidate) {
        let (mx, my) = (search.compressed().mx, search.compressed().my);
        let residual = &candidate.evaluation(&mut search.context).residual;
        search.matched_filter.respond(residual, mx, my);
        // A background that is not level is no part of a spot.
        search.matched_filter.subtract_sides(BESIDE);
        let contrast = |_: &PointSource, u| search.matched_filter.response_at(u).filter(|r| r.is_finite());
        let Some(bright) = comparable(&candidate.sources).filter(|bright| bright.len() >= LEAST_SPOTS) else {
            return;
        };
        let surroundings = Surroundings::new(search.context.bases, &candidate.sources);
        let along_axes: Vec<View> = bright.iter().map(|spot| View::new(spot, [1.0, 0.0])).collect();
        let outwards = surroundings.growing(&bright, surroundings.nearest_edge());
        self.samples += 1;
        let fade = match self.samples > SAMPLES {
            true => 1.0 - 1.0 / SAMPLES as f64,
            false => 1.0,
        };
        self.follow(&bright);
        let (mut largest, mut core) = (0.0f64, 0.0f64);
        let mut shown: Vec<[f64; 3]> = Vec::with_capacity(bright.len());
        for (k, views) in [along_axes, outwards].iter().enumerate() {
            for (o, offset) in offsets(SPACING).enumerate() {
                shown.clear();
                for view in views {
                    let Some(stack) = self.spots.iter_mut().find(|stack| stack.u == view.spot.u) else {
                        continue;
                    };
                    let sums = &mut stack.sums[k][o];
                    sums.fade(fade);
                    let Some(r) = surroundings.own_response(view, offset, contrast) else {
                        continue;
                    };
                    let scale = surroundings.scale(view);
                    sums.add(r, scale);
                    if sums.weight > LEAST_SAMPLES * scale * scale {
                        let [share, significance] = sums.shown();
                        shown.push([share, significance, scale]);
                    }
                }
                if shown.len() < LEAST_SPOTS || 2 * shown.len() < views.len() {
                    continue;
                }
                let Some([share, ..]) = common(&mut shown).filter(|[share, _, scale]| share * scale > HARMFUL) else {
                    continue;
                };
                let d2 = distance2(offset, [0.0; 2]);
                largest = largest.max(share / halo::height(d2));
                if d2 < CORE * CORE {
                    core = core.max(share);
                }
            }
        }
        let is_lens = largest > 0.0 && largest < LEFT * MAX_SPOT_ERROR && core < MAX_CORE;
        self.spot_error = is_lens.then_some(largest / LEFT);
    }

    /// Takes the spots for those of the sample before that were nearest.
    fn follow(&mut self, bright: &[&PointSource]) {
        let mut pairs: Vec<(f64, usize, usize)> = Vec::with_capacity(bright.len() * self.spots.len());
        for (i, spot) in bright.iter().enumerate() {
            pairs.extend(
                self.spots
                    .iter()
                    .enumerate()
                    .map(|(k, stack)| (distance2(spot.u, stack.u), i, k)),
            );
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut is_new, mut is_gone) = (vec![true; bright.len()], vec![true; self.spots.len()]);
        for (_, i, k) in pairs {
            if is_new[i] && is_gone[k] {
                (is_new[i], is_gone[k]) = (false, false);
                self.spots[k].u = bright[i].u;
            }
        }
        for (spot, _) in bright.iter().zip(is_new).filter(|(_, is_new)| *is_new) {
            self.spots.push(SpotStack::new(spot.u));
        }
        // Of those that are dark the ones that were seen last are kept.
        self.spots
            .sort_by_key(|stack| !bright.iter().any(|spot| spot.u == stack.u));
        self.spots.truncate(MOST_STACKS);
    }
}

/// Of the shares of their light that spots show, each with its significance and the spot's scale, the least that three quarters of them show;
/// `None` where that is not certain.
fn common(shown: &mut [[f64; 3]]) -> Option<[f64; 3]> {
    shown.sort_by(|a, b| b[0].total_cmp(&a[0]));
    let agreeing = &shown[..(COMMON * shown.len() as f64).ceil() as usize];
    let squares = || agreeing.iter().map(|s| s[1] * s[1]);
    let (all, strongest) = (squares().sum::<f64>(), squares().fold(0.0, f64::max));
    let is_certain = agreeing.iter().all(|s| s[1] > 1.0) && all > SIGNIFICANT && all - strongest > WITHOUT_ONE;
    agreeing.last().copied().filter(|_| is_certain)
}
