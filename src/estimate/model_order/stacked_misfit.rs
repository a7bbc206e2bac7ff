//! Stacked misfit: light beside bright spots that recent frames together show to be common to them, where it is too faint in each of them.
//!
//! A ghost that no frame shows among all users stands out beside one of them now and then, and passes for a stranger there. Over frames the
//! least that three quarters of the spots show becomes certain, while a stranger stands beside one of them.

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
/// Significance of a misfit over all samples, and in a single frame: below that none is taken for an emitter.
const SIGNIFICANT: f64 = 6.0;
const HARMFUL: f64 = 0.7;
/// Distance at which a misfit is compared with what stands on both sides of it, σ.
const BESIDE: f64 = 4.5;
/// Distance from one offset to the next, σ.
const SPACING: f64 = 1.0;
/// Spots that an offset needs to itself.
const LEAST_SPOTS: usize = 2;

/// Sums over the samples at one offset.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Σ w q and Σ w, of the shares q of the spots' light with their inverse variances w.
    weighted: f64,
    weight: f64,
    /// Variance of Σ w q.
    variance: f64,
}

impl Sums {
    fn fade(&mut self, by: f64) {
        self.weighted *= by;
        self.weight *= by;
        self.variance *= by * by;
    }

    fn add(&mut self, share: f64, weight: f64) {
        self.weighted += weight * share;
        self.weight += weight;
        self.variance += weight;
    }

    /// The share, where samples of this weight show it for certain and it may do harm.
    fn share(&self, weight: f64) -> Option<f64> {
        let share = self.weighted / self.weight;
        let is_certain = self.weight > LEAST_SAMPLES * weight && self.weighted > SIGNIFICANT * self.variance.sqrt();
        (is_certain && share * weight.sqrt() > HARMFUL).then_some(share)
    }
}

/// The sums of recent frames.
#[derive(Default)]
pub(crate) struct StackedMisfit {
    /// Offset by offset, along the sensor's axes and along each spot's direction from the sensor's middle.
    sums: [Vec<Sums>; 2],
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
        let (mut largest, mut core) = (0.0f64, 0.0f64);
        let mut shown: Vec<[f64; 2]> = Vec::with_capacity(bright.len());
        for (views, sums) in [along_axes, outwards].iter().zip(&mut self.sums) {
            sums.resize(offsets(SPACING).count(), Sums::default());
            for (offset, sums) in offsets(SPACING).zip(sums) {
                sums.fade(fade);
                shown.clear();
                for view in views {
                    if let Some(r) = surroundings.own_response(view, offset, contrast) {
                        let scale = surroundings.scale(view);
                        shown.push([r / scale, scale]);
                    }
                }
                if shown.len() < LEAST_SPOTS || 2 * shown.len() < views.len() {
                    continue;
                }
                let others = shown.len() - (COMMON * shown.len() as f64).ceil() as usize;
                let [share, scale] = [0, 1].map(|k| {
                    shown.select_nth_unstable_by(others, |a, b| a[k].total_cmp(&b[k]));
                    shown[others][k]
                });
                let weight = scale * scale;
                sums.add(share, weight);
                let d2 = distance2(offset, [0.0; 2]);
                if let Some(share) = sums.share(weight) {
                    largest = largest.max(share / halo::height(d2));
                    if d2 < CORE * CORE {
                        core = core.max(share);
                    }
                }
            }
        }
        let is_lens = largest > 0.0 && largest < LEFT * MAX_SPOT_ERROR && core < MAX_CORE;
        self.spot_error = is_lens.then_some(largest / LEFT);
    }
}
