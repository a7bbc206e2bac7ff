//! Which shape explains the spots: one that is the same everywhere, that of a lens's wavefront, or one that changes over the field.

use super::error::Error;
use super::grouping::Image;
use super::learn::Learner;
use super::parts;
use super::pupil::Pupil;
use super::statistics;
use super::template_model::TemplateModel;
use crate::optics::Camera;

/// Learns for a number of rounds and says which stage that is.
type Run<'a> = &'a mut dyn FnMut(&mut Learner, usize, &'static str);

/// Steps of the places before anything is learned.
const PLACES: usize = 15;
const SHAPE_ROUNDS: usize = 12;
const WAVEFRONT_ROUNDS: usize = 30;
const FIELD_ROUNDS: usize = 4;
/// Degrees that are tried in turn while the held-out frames gain by them.
const FIELD_DEGREES: [usize; 3] = [2, 3, 4];
/// Support of what changes over the field, σ: aberrations that change widely are near the core.
const FIELD_RADIUS: f64 = 7.0;
/// Fall of χ², or of a score of it, that is more than chance.
pub const BETTER: f64 = 30.0;
/// Share of the light that a wavefront may leave unexplained for no other shape to be tried.
const EXPLAINED: f64 = 0.03;
/// Share of the light that the wavefront of a whole aperture leaves from which on a cut one is tried, which takes as long again. Of lenses
/// whose aperture is round it leaves none.
const WHOLE: f64 = 0.01;
/// Score of a whole aperture over that of a shape that is the same everywhere up to which spots may be a cut one's: Gaussians, Moffat profiles
/// and defocused discs are at 2.2 to 5, lenses with a cut aperture at 0.7 to 1.1.
const NEARLY: f64 = 1.5;
/// Parameters of a spot, each of which lowers χ² by chance (Akaike, 1974).
const PER_SPOT: usize = 3;

/// The same shape everywhere; where that passes no check, a lens's wavefront.
pub fn first<'a>(
    detected: Learner<'a>,
    run: Run,
    check: &dyn Fn(&Learner) -> Result<(), Error>,
) -> Result<Learner<'a>, Error> {
    let (camera, images, noise_j) = (detected.camera, detected.images, detected.noise_j);
    let mut shape = detected;
    run(&mut shape, SHAPE_ROUNDS, "the spot's shape");
    let Err(error) = check(&shape) else {
        return Ok(shape);
    };
    let wavefront = wavefront(camera, images, noise_j, Lens::Varying, run);
    check(&wavefront).map_err(|_| error)?;
    Ok(wavefront)
}

/// What explains the held-out images best.
pub fn best<'a>(first: Learner<'a>, held: &[&Image], is_field_covered: bool, run: Run) -> Learner<'a> {
    if first.model.pupil.is_some() || is_as_said(&first) {
        return first;
    }
    let on_held = |learner: &Learner| {
        let held = Learner::with_model(learner.camera, held, learner.noise_j, &learner.model, learner.misfit);
        let score = held.chi2_of_images() + (2 * PER_SPOT * held.sources()) as f64;
        let unexplained = |noise: f64| statistics::unexplained(&held, noise, 0.0);
        // A worse shape's misfit is in the noise so far, and hides this one's.
        (score, unexplained(1.0), unexplained(statistics::residual_scale(&held)))
    };
    let (mut least, ..) = on_held(&first);
    let mut learned = |lens: Lens| {
        let wavefront = wavefront(first.camera, first.images, first.noise_j, lens, run);
        let (score, unexplained, at_own_noise) = on_held(&wavefront);
        (wavefront, score, unexplained, at_own_noise)
    };
    let mut of_lens = learned(Lens::Varying);
    // Where no spot stood a change over the field is extrapolated, which the held-out frames do not see.
    if !is_field_covered {
        let same = learned(Lens::Uniform);
        if same.1 - of_lens.1 < BETTER {
            of_lens = same;
        }
    } else if of_lens.3 > WHOLE && of_lens.1 < NEARLY * least {
        let cut = learned(Lens::Cut);
        if of_lens.1 - cut.1 > BETTER {
            of_lens = cut;
        }
    }
    let (wavefront, score, unexplained, _) = of_lens;
    if score < least && unexplained < EXPLAINED {
        return wavefront;
    }
    let mut best = first;
    let degrees = if is_field_covered { &FIELD_DEGREES[..] } else { &[] };
    for degree in degrees {
        let mut varied = Learner::with_model(best.camera, best.images, best.noise_j, &best.model, best.misfit);
        varied.model.vary(*degree, FIELD_RADIUS * best.camera.spot_sigma_m);
        run(&mut varied, FIELD_ROUNDS, "its change over the field");
        let (score, ..) = on_held(&varied);
        if least - score < BETTER {
            break;
        }
        (least, best) = (score, varied);
    }
    if score < least { wavefront } else { best }
}

/// Whether nothing shows around the spots that the camera's own shape would not leave.
fn is_as_said(learner: &Learner) -> bool {
    let own = learner.refitted(TemplateModel::of_camera(learner.camera, &learner.model));
    let left = statistics::variance(&own);
    left.spot_error == 0.0 && left.quantum_j.is_none()
}

/// What a lens's wavefront may be.
#[derive(Clone, Copy)]
enum Lens {
    /// The same everywhere.
    Uniform,
    /// Another at other places of the field.
    Varying,
    /// The same, of an aperture that is cut.
    Cut,
}

fn wavefront<'a>(camera: &'a Camera, images: &'a [&'a Image], noise_j: f64, lens: Lens, run: Run) -> Learner<'a> {
    let mut learner = Learner::new(camera, images, noise_j);
    let whole = Pupil::of_camera(camera);
    learner.begin_wavefront(match lens {
        Lens::Uniform | Lens::Varying => whole,
        Lens::Cut => whole.cut(),
    });
    if let Lens::Varying | Lens::Cut = lens {
        learner.fit(PLACES);
        learner.model = learner.model.with_pupil(parts::start(&learner));
    }
    run(&mut learner, WAVEFRONT_ROUNDS, "the lens's wavefront");
    learner
}
