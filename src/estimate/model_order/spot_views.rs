//! What stands around bright spots, offset by offset, as one spot is compared with another.

use crate::estimate::model::bases::Bases;
use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model_order::bright_spots::distance2;

/// Largest offset at which spots are compared, σ.
const FARTHEST: f64 = 12.0;
/// Spots of less than this share of the brightest one's energy, and more than this number, are not compared.
const BRIGHT: f64 = 0.1;
const MAX_SPOTS: usize = 12;
/// Other bright spots within [`NEAR`] σ of half of the spots, up to which these are no crowd.
const MAX_NEAR: usize = 1;
const NEAR: f64 = 5.0;
/// A misfit that grows from the sensor's middle is compared among spots beyond this share of the farthest one's distance from there.
const TELLING_GROWTH: f64 = 0.5;

/// The spots that are compared, the brightest first; `None` in a crowd.
pub(crate) fn comparable(sources: &[PointSource]) -> Option<Vec<&PointSource>> {
    let brightest = sources.iter().fold(0.0, |m: f64, s| m.max(s.a));
    let mut bright: Vec<&PointSource> = sources.iter().filter(|s| s.a > BRIGHT * brightest).collect();
    bright.sort_by(|a, b| b.a.total_cmp(&a.a));
    let near = |s: &&PointSource| bright.iter().filter(|t| distance2(s.u, t.u) < NEAR * NEAR).count() - 1;
    if bright.is_empty() || 2 * bright.iter().filter(|s| near(s) > MAX_NEAR).count() > bright.len() {
        return None;
    }
    bright.truncate(MAX_SPOTS);
    Some(bright)
}

/// The offsets at which spots are compared, this far apart, σ.
pub(crate) fn offsets(spacing: f64) -> impl Iterator<Item = [f64; 2]> {
    let last = (FARTHEST / spacing).floor() as i32;
    let axis = move || (-last..=last).map(move |k| f64::from(k) * spacing);
    axis()
        .flat_map(move |x| axis().map(move |y| [x, y]))
        .filter(|offset| distance2(*offset, [0.0; 2]) <= FARTHEST * FARTHEST)
}

/// A spot as it is compared with others.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub spot: &'a PointSource,
    /// The direction that offsets are taken along.
    direction: [f64; 2],
    /// How strong the common misfit is here, of the strongest.
    pub growth: f64,
}

impl<'a> View<'a> {
    pub fn new(spot: &'a PointSource, direction: [f64; 2]) -> Self {
        Self {
            spot,
            direction,
            growth: 1.0,
        }
    }

    pub fn outwards(spot: &'a PointSource, middle: [f64; 2]) -> Self {
        let d = [0, 1].map(|k| spot.u[k] - middle[k]);
        let far = d[0].hypot(d[1]);
        Self::new(spot, if far > 0.0 { d.map(|v| v / far) } else { [1.0, 0.0] })
    }

    fn at(&self, offset: [f64; 2]) -> [f64; 2] {
        let [c, s] = self.direction;
        [
            self.spot.u[0] + c * offset[0] - s * offset[1],
            self.spot.u[1] + s * offset[0] + c * offset[1],
        ]
    }
}

/// All sources of a frame on its sensor.
pub(crate) struct Surroundings<'a> {
    sources: &'a [PointSource],
    /// The sensor's first and last edge along x and y, σ.
    ends: [[f64; 2]; 2],
    /// Norm of a spot of unit energy over the pixels.
    norm: f64,
}

impl<'a> Surroundings<'a> {
    pub fn new(bases: &Bases, sources: &'a [PointSource]) -> Self {
        Self {
            sources,
            ends: bases.axes().map(|b| [b.edges[0], b.edges[b.n]]),
            norm: halo::spot_norm(bases),
        }
    }

    pub fn middle(&self) -> [f64; 2] {
        self.ends.map(|[low, high]| 0.5 * (low + high))
    }

    /// The spots that show best what grows from the sensor's middle, and is whole at a distance `whole` from there: those farther out.
    pub fn growing<'b>(&self, bright: &[&'b PointSource], whole: f64) -> Vec<View<'b>> {
        let middle = self.middle();
        let least = TELLING_GROWTH * self.farthest(bright) / whole;
        let grown = bright.iter().map(|spot| View {
            growth: distance2(spot.u, middle).sqrt() / whole,
            ..View::outwards(spot, middle)
        });
        grown.filter(|view| view.growth > least).collect()
    }

    /// The largest distance of a spot from the sensor's middle, σ.
    pub fn farthest(&self, bright: &[&PointSource]) -> f64 {
        let middle = self.middle();
        bright
            .iter()
            .map(|spot| distance2(spot.u, middle).sqrt())
            .fold(f64::MIN_POSITIVE, f64::max)
    }

    /// The distance of the nearest edge from the sensor's middle, σ.
    pub fn nearest_edge(&self) -> f64 {
        self.ends
            .map(|[low, high]| 0.5 * (high - low))
            .into_iter()
            .fold(f64::INFINITY, f64::min)
    }

    /// The response at an offset that belongs to this spot more than to any other.
    pub fn own_response(
        &self,
        view: &View,
        offset: [f64; 2],
        response: impl Fn(&PointSource, [f64; 2]) -> Option<f64>,
    ) -> Option<f64> {
        let (spot, u) = (view.spot, view.at(offset));
        if (0..2).any(|k| u[k] < self.ends[k][0] || u[k] > self.ends[k][1]) {
            return None;
        }
        let own = spot.a * halo::height(distance2(offset, [0.0; 2]));
        let is_other = |t: &PointSource| !std::ptr::eq(t, spot) && t.a * halo::height(distance2(t.u, u)) >= own;
        if self.sources.iter().any(is_other) {
            return None;
        }
        response(spot, u)
    }

    /// Scale of the response to the common misfit.
    pub fn scale(&self, view: &View) -> f64 {
        view.growth * view.spot.a * self.norm
    }
}
