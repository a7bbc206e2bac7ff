//! Whether frames, spots and what was learned of them can be a calibration.

use ndarray::Array2;

use super::coverage::Coverage;
use super::error::{Error, MIN_SPOTS};
use super::learn::Learner;
use super::prepare::Prepared;
use super::statistics;
use crate::optics::SpotShape;

/// Misfit of most spots in training, and of all that are not odd on the held-out frames, beyond which spots have no common shape.
const UNLIKE: f64 = 0.25;
pub const UNEXPLAINED: f64 = 0.05;
/// Least share of a spot's light within two of its widths.
const COMPACT: f64 = 0.4;

pub fn shape(learner: &Learner, detected: &Coverage) -> Result<(), Error> {
    let (covered, needed) = (Coverage::of(learner).phases, Coverage::needed(learner.camera));
    // Places that were spread over the pixel and are not any more follow a template that is none.
    let unexplained = statistics::unexplained(learner, 1.0, 0.0);
    let is_locked = covered < needed && detected.phases >= needed && unexplained > UNEXPLAINED;
    if learner.misfit > UNLIKE || is_locked {
        return Err(Error::NotAlike {
            share: 100.0 * learner.misfit.max(unexplained),
        });
    }
    if covered < needed {
        return Err(Error::Phases { covered, needed });
    }
    Ok(())
}

/// Gains and shape are free together, so that a needle amid ripples may explain the held-out frames too. Spots of lenses have more than 70 %
/// of their light within two widths. Where most frames are saturated, so many `of_frames`, what is left are the feet of spots.
pub fn compact(shape: &SpotShape, of_frames: [usize; 2]) -> Result<(), Error> {
    let within = shape.encircled_energy([0.0; 2], 2.0 * shape.sigma_equivalent_m());
    if within >= COMPACT {
        return Ok(());
    }
    saturated(of_frames)?;
    Err(Error::Scattered { share: 100.0 * within })
}

/// Refuses frames most of which are saturated.
fn saturated([saturated, frames]: [usize; 2]) -> Result<(), Error> {
    match 2 * saturated > frames {
        true => Err(Error::Saturated { frames, saturated }),
        false => Ok(()),
    }
}

pub fn pixels(prepared: &Prepared, frames: &[(usize, &Array2<f64>)]) -> Result<(), Error> {
    let is_finite = frames.iter().any(|(_, pixels)| pixels.iter().any(|v| v.is_finite()));
    if !is_finite {
        return Err(Error::NotFinite { frames: frames.len() });
    }
    if prepared.noise_j <= f64::MIN_POSITIVE {
        return Err(Error::NoNoise { frames: frames.len() });
    }
    Ok(())
}

pub fn spots(learner: &Learner, prepared: &Prepared, frames: usize) -> Result<(), Error> {
    let spots = learner.sources();
    if spots >= MIN_SPOTS {
        return Ok(());
    }
    saturated([prepared.saturated_frames, frames])?;
    Err(match spots {
        0 => Error::NoSpots {
            frames,
            noise_j: prepared.noise_j,
        },
        _ => Error::TooFewSpots { frames, spots },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::spot::{Field, FieldPolynomial};

    #[test]
    fn a_needle_amid_ripples_is_no_spot() {
        let field = Field {
            half_sensor_m: [0.01; 2],
        };
        let profile = |core: f64, rest: f64| (0..41).map(|k| if k == 20 { core } else { rest }).collect::<Vec<f64>>();
        let shape = |core: f64, rest: f64| {
            let term = (FieldPolynomial::constant(1.0), profile(core, rest), profile(core, rest));
            SpotShape::from_terms(field, 1e-4, [term]).expect("light")
        };
        assert!(compact(&shape(1.0, 0.0), [10, 10]).is_ok());
        assert!(matches!(compact(&shape(1.0, 0.04), [5, 10]), Err(Error::Scattered { share }) if share < 40.0));
        assert!(matches!(
            compact(&shape(1.0, 0.04), [6, 10]),
            Err(Error::Saturated { saturated: 6, .. })
        ));
    }
}
