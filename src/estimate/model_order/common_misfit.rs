//! Common misfit: what the residuals around bright spots have in common, which is the lens's and not the sky's.
//!
//! A stranger stands beside one user; a lens makes the same rings, tails and ghosts beside all. The share of its light by which a spot
//! misses the model at an offset is therefore taken to be what three quarters of the bright spots show there at least.

use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model_order::bright_spots::{CORE, distance2};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::ring_misfit::Rings;
use crate::estimate::model_order::search::Search;
use crate::estimate::model_order::spot_views::{Surroundings, View, comparable, offsets};

/// Distance from one offset to the next, σ.
const SPACING: f64 = 0.75;
/// Combined significance, squared, of the spots that agree at an offset; noise alone reaches it at one of 4,000 offsets in a few of a
/// million frames.
const SIGNIFICANT: f64 = 36.0;
/// Significance at which a spot that does not follow the common misfit shows it.
const VISIBLE: f64 = 5.0;
/// Largest share of the squared residual that the common misfit may leave, of all spots together and of one that follows it: lenses of
/// the kinds above leave a tenth, nine in ten frames less than a third; unfinished searches of crowds two fifths and more.
const MAX_LEFT: f64 = 0.35;
const MAX_LEFT_OF_ONE: f64 = 0.5;
/// Share of the spots that a misfit is common to, at an offset and in all. Half agree by chance where a crowd is not resolved yet.
pub(crate) const COMMON: f64 = 0.75;

/// How far spots must agree for a misfit to be the lens's.
#[derive(Clone, Copy)]
pub(crate) struct Agreement {
    /// More than this share of the spots that show a misfit must follow the common one.
    share: f64,
    /// Largest ratio of a spot's misfit to the common one with which it follows that.
    most_growth: f64,
    /// Spots that an offset needs to itself, and spots that must show the misfit.
    least: usize,
    least_showing: f64,
    /// Largest misfit as a share of the light, over the halo's height.
    most: f64,
}

impl Agreement {
    /// Where a frame decides alone: it takes a misfit that one spot shows much more strongly for a stranger.
    pub const ALONE: Self = Self {
        share: COMMON,
        most_growth: 2.5,
        least: 2,
        least_showing: 1.0,
        most: f64::INFINITY,
    };
    /// Where many frames decide together: three of four spots are enough, as the fourth's ghost may fall beside the sensor; and coma that
    /// grows from the sensor's middle is several times as strong at its corners as in most spots.
    pub const OF_FRAMES: Self = Self {
        share: 0.7,
        most_growth: 10.0,
        ..Self::ALONE
    };

    /// Of the few spots where a misfit that grows shows: crowds and glints have next to nothing in common but by chance, and then much.
    fn of_few(self) -> Self {
        Self {
            least: 3,
            least_showing: 2.0,
            most: LEFT * MAX_SPOT_ERROR,
            ..self
        }
    }
}

/// Significance that the common misfit keeps under the weights: well below a source's threshold (5.5), so that spots that differ from
/// the common one are covered too.
pub(crate) const LEFT: f64 = 2.0;
/// Largest spot error found, under which spots 2 σ apart stay two: fixed at 0.07, `oapwatch study lens` counts all of them right through the Airy disc,
/// Moffat halo, defocus disc, coma and ghost; at 0.1 it merges all through coma and the ghost, and at 0.04 a Moffat halo still makes 6 %
/// of invented emitters.
pub(crate) const MAX_SPOT_ERROR: f64 = 0.07;
/// Largest common misfit, as a share of the light, within the core. Two equal sources 2 σ apart, taken for one, show 0.14 and more; Airy
/// discs, Moffat profiles, defocus, coma and astigmatism up to 0.06.
pub(crate) const MAX_CORE: f64 = 0.1;

/// The spot error that a fitted hypothesis shows: by rings around its bright spots, or offset by offset where these are `least` or more. 0
/// where their residuals have nothing in common. `is_explained`: whether more sources explain the frame.
pub(crate) fn common_misfit(
    search: &mut Search,
    candidate: &mut Candidate,
    least: usize,
    is_explained: bool,
    agreement: Agreement,
) -> f64 {
    let (mx, my) = (search.compressed().mx, search.compressed().my);
    let bases = search.context.bases;
    let norm = halo::spot_norm(bases);
    let residual = candidate.evaluation(&mut search.context).residual.clone();
    search.matched_filter.respond(&residual, mx, my);
    let filter = &*search.matched_filter;
    let sources = &candidate.sources;
    let Some(bright) = comparable(sources) else {
        return 0.0;
    };
    let rings = Rings {
        axes: bases.axes(),
        residual: &residual,
        stride: mx,
        is_masked: &search.frame.is_masked,
        norm,
    };
    let ring = match bases.is_narrow() {
        true => None,
        false => rings.common(&bright, CORE, is_explained),
    };
    let ring = match ring {
        Some((largest, core)) if core < MAX_CORE => (largest / LEFT).min(MAX_SPOT_ERROR),
        _ => 0.0,
    };
    if bright.len() < least {
        return ring;
    }
    let surroundings = Surroundings::new(bases, sources);
    let middle = surroundings.middle();
    let along = |direction: [f64; 2]| bright.iter().map(|spot| View::new(spot, direction)).collect::<Vec<_>>();
    // Along the sensor's axes; along each spot's direction from the sensor's middle, as for coma; and each spot with itself turned by half a
    // turn, as few spots have little else to be compared with.
    let along_axes = along([1.0, 0.0]);
    let outwards: Vec<View> = bright.iter().map(|spot| View::outwards(spot, middle)).collect();
    let mirrored = [along_axes.clone(), along([-1.0, 0.0])].concat();
    let growing = surroundings.growing(&bright, surroundings.farthest(&bright));
    let response = |_: &PointSource, u| filter.response_at(u);
    // What is the same in all directions, as another width, does not tell whether it grows.
    let directed = |spot: &PointSource, u: [f64; 2]| {
        let [x, y] = [0, 1].map(|k| u[k] - spot.u[k]);
        let turned = [[-y, x], [-x, -y], [y, -x]].map(|d| filter.response_at([0, 1].map(|k| spot.u[k] + d[k])));
        let r = filter.response_at(u)?;
        let others = turned.into_iter().sum::<Option<f64>>()?;
        // As uncertain as a single response.
        Some((0.75 * r - 0.25 * others) / 0.75f64.sqrt())
    };
    [along_axes, outwards, mirrored]
        .iter()
        .map(|views| compare(views, &surroundings, agreement, response))
        .fold(ring, f64::max)
        .max(compare(&growing, &surroundings, agreement.of_few(), directed))
}

fn compare(
    views: &[View],
    surroundings: &Surroundings,
    agreement: Agreement,
    response: impl Fn(&PointSource, [f64; 2]) -> Option<f64>,
) -> f64 {
    let (mut largest, mut core) = (0.0f64, 0.0f64);
    // Per spot: Σ r², Σ r t and Σ t² over the offsets that tell something.
    let mut sums = vec![[0.0; 3]; views.len()];
    let mut values: Vec<(f64, f64, usize)> = Vec::with_capacity(views.len());
    for offset in offsets(SPACING) {
        let d2 = distance2(offset, [0.0; 2]);
        values.clear();
        for (i, view) in views.iter().enumerate() {
            if let Some(r) = surroundings.own_response(view, offset, &response) {
                values.push((r / surroundings.scale(view), r, i));
            }
        }
        // In a crowd few spots have an offset to themselves, and a few agree by chance.
        if values.len() < agreement.least || 2 * values.len() < views.len() {
            continue;
        }
        let need = (COMMON * values.len() as f64).ceil() as usize;
        let mut common = 0.0f64;
        for sign in [1.0, -1.0] {
            values.sort_by(|a, b| (sign * b.0).total_cmp(&(sign * a.0)));
            let least = sign * values[need - 1].0;
            let square: f64 = values[..need].iter().map(|v| v.1 * v.1).sum();
            if least > 0.0 && square > SIGNIFICANT && values[..need].iter().all(|v| sign * v.1 > 1.0) {
                common = sign * least;
                largest = largest.max(least / halo::height(d2));
                if d2 < CORE * CORE {
                    core = core.max(least);
                }
            }
        }
        let is_visible = values.iter().any(|v| v.1.abs() > VISIBLE);
        for &(_, r, i) in &values {
            if is_visible {
                let t = common * surroundings.scale(&views[i]);
                sums[i][0] += r * r - 1.0;
                sums[i][1] += r * t;
                sums[i][2] += t * t;
            }
        }
    }
    let (mut whole, mut left, mut strongest) = (0.0, 0.0, 1.0f64);
    let (mut visible, mut following) = (0.0, 0.0);
    for [rr, rt, tt] in sums {
        let follows = if tt > 0.0 { rt.max(0.0).powi(2) / tt } else { 0.0 };
        whole += rr;
        left += rr - follows;
        visible += f64::from(rr > SIGNIFICANT);
        // Aberrations grow towards the edge: a spot may show the common misfit more strongly than most.
        if rr - follows < MAX_LEFT_OF_ONE * rr {
            following += f64::from(rr > SIGNIFICANT && rt < agreement.most_growth * tt);
            strongest = strongest.max((rt / tt).min(agreement.most_growth));
        }
    }
    let is_common =
        left < MAX_LEFT * whole && following >= agreement.least_showing && following > agreement.share * visible;
    if is_common && core < MAX_CORE && largest < agreement.most {
        (strongest * largest / LEFT).min(MAX_SPOT_ERROR)
    } else {
        0.0
    }
}
