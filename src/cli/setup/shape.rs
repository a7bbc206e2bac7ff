//! The spot's shape, learned from the frames that were looked at.

use ndarray::{Array2, s};

use super::new_config::NewConfig;
use super::view::View;
use crate::calibrate::first_look::FoundSpot;
use crate::calibrate::spot::{self, Learned};
use crate::cli::Failure;
use crate::cli::progress::Steps;
use crate::optics::{Calibration, Camera};

/// Fewest beams that stand still and may show a shape: one for each of the pixel phases that it takes.
const FEWEST_STILL: usize = 8;
/// Way of a spot from the first half of the frames to the second, pixels, from which it moves. Noise moves one by hundredths.
const MOVES: f64 = 0.2;

/// What became of the shape.
pub enum Shape {
    NoSpots,
    Learned(Box<Learned>),
    /// Why it could not be.
    Unknown(String),
}

/// Whether a spot that was found moves.
fn is_moving(view: &View) -> bool {
    let halves = view.images.split_at(view.images.len() / 2);
    view.look.spots.iter().any(|spot| {
        let [first, second] = [halves.0, halves.1].map(|half| centre(half, spot));
        (first[0] - second[0]).hypot(first[1] - second[1]) > MOVES
    })
}

/// Centre of the light around a spot, over frames, pixels.
fn centre(frames: &[Array2<f64>], spot: &FoundSpot) -> [f64; 2] {
    let reach = (3.0 * spot.sigma).ceil();
    let range = |at: f64, n: usize| (at - reach).max(0.0) as usize..((at + reach) as usize + 1).min(n);
    let Some((ny, nx)) = frames.first().map(Array2::dim) else {
        return [0.0; 2];
    };
    let (rows, columns) = (range(spot.y, ny), range(spot.x, nx));
    let mut sum = Array2::<f64>::zeros((rows.len(), columns.len()));
    for frame in frames {
        sum += &frame.slice(s![rows.clone(), columns.clone()]);
    }
    let ground = sum.iter().copied().fold(f64::INFINITY, f64::min);
    let (mut light, mut x, mut y) = (0.0, 0.0, 0.0);
    for ((row, column), value) in sum.indexed_iter() {
        let value = value - ground;
        light += value;
        x += value * column as f64;
        y += value * row as f64;
    }
    [x / light, y / light]
}

impl Shape {
    pub fn learn(view: &View, new: &NewConfig, mut camera: Camera) -> Self {
        if view.look.spots.is_empty() {
            return Self::NoSpots;
        }
        if view.look.spots.len() < FEWEST_STILL && !is_moving(view) {
            return Self::Unknown("the beams stand still, on too few parts of a pixel".to_owned());
        }
        let frames = new.array_frames(view);
        let list: Vec<_> = frames.iter().enumerate().collect();
        let mut steps = Steps::unbounded();
        let mut learn = |camera: &Camera| {
            spot::learn(camera, &list, &mut |p| {
                steps.next(&format!("the spot's shape: {}, round {}", p.stage, p.round));
            })
        };
        let mut learned = learn(&camera);
        // The width seen so far is the mean frame's, in which a beam that moves is wider.
        if let Ok(wider) = learned.as_ref()
            && wider.is_shape_better
        {
            camera.spot_sigma_m = wider.shape.sigma_equivalent_m();
            learned = learn(&camera);
        }
        steps.finish();
        match learned {
            Ok(learned) => Self::Learned(Box::new(learned)),
            Err(why) => Self::Unknown(why.to_string()),
        }
    }

    /// Width of the Gaussian that is nearest to the learned shape, m.
    pub fn sigma_m(&self) -> Option<f64> {
        match self {
            Self::Learned(learned) => Some(learned.shape.sigma_equivalent_m()),
            _ => None,
        }
    }

    fn better(&self) -> Option<&Learned> {
        match self {
            Self::Learned(learned) if learned.is_shape_better => Some(learned),
            _ => None,
        }
    }

    /// What a config cannot hold: `maps`, and a shape that explains the frames better than a Gaussian.
    pub fn calibration(&self, camera: &Camera, maps: Option<Calibration>) -> Result<Option<Calibration>, Failure> {
        let Some(learned) = self.better() else { return Ok(maps) };
        let calibration = Calibration {
            noise_std_j: camera.noise_std_j,
            pixels: maps.and_then(|maps| maps.pixels),
            ..learned.calibration.clone()
        };
        calibration.applied_to(camera).map_err(Failure::other)?;
        Ok(Some(calibration))
    }

    pub fn report(&self) -> Option<String> {
        match self {
            Self::NoSpots => None,
            Self::Unknown(why) => Some(format!(
                "the spot's shape was not learned, it is taken for a Gaussian: {why}. `oapwatch calibrate` learns it later"
            )),
            Self::Learned(learned) => Some(format!(
                "the spot's shape: {:.1} % of its light within 2 σ (a Gaussian: 86.5 %), from {} spots; held-out frames: reduced χ² {:.3} \
                 with a Gaussian, {:.3} with it{}",
                100.0
                    * learned
                        .shape
                        .encircled_energy([0.0; 2], 2.0 * learned.shape.sigma_equivalent_m()),
                learned.spots,
                learned.before.reduced(),
                learned.after.reduced(),
                if learned.is_shape_better {
                    ""
                } else {
                    ": a Gaussian it is"
                }
            )),
        }
    }
}
