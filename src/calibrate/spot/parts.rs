//! Where the learning of a wavefront that changes over the field begins: wavefronts that do not, each fitted to the spots of one part of
//! the field, joined by a polynomial. A start that is the same everywhere can end in another wavefront's neighbourhood: of astigmatism
//! that grows with the square of the field (Thompson, 2005) it found a constant orientation, 8 % too weak.

use faer::Mat;
use rayon::prelude::*;

use super::grouping::{self, Image};
use super::learn::Learner;
use super::patch::{Patch, Source};
use super::pupil::{FIELD, Pupil, ZERNIKES};
use super::template_model::TemplateModel;
use super::wavefront;
use crate::calibrate::exposure::ScaledCholesky;
use crate::optics::Camera;

/// Parts of the field a side.
const PARTS: usize = 3;
/// Fewest spots of a part, and most that are used: they need not be exact.
const LEAST_SPOTS: usize = 10;
const MOST_SPOTS: usize = 24;
/// Half the window around a spot, σ: its core and the ring or lobes around it.
const REACH: f64 = 5.0;
const STEPS: usize = 6;
/// Steps of the places within one of the wavefront.
const PLACES: usize = 4;
/// Share of the parts' information by which the joined wavefront is held at zero where there are too few parts.
const DAMPING: f64 = 1e-3;

/// A part's place in the field and its wavefront, as [`Pupil::local`] has it.
struct Part {
    place: [f64; 2],
    local: [f64; Pupil::CHANGES],
}

/// The wavefront that changes over the field from which to learn, for a learner of one that does not and whose places are fitted: of the
/// joined one and one that is the same everywhere, what explains lone spots better after some steps. Of a cut aperture each with a rim that
/// moves one way or the other: with the sign of all even polynomials the image would stay the same.
pub fn start(learner: &Learner) -> Pupil {
    let first = learner.model.pupil.unwrap_or(Pupil::of_camera(learner.camera));
    let parts: Vec<Vec<Patch>> = (0..PARTS * PARTS)
        .map(|k| lone_spots(learner, [k % PARTS, k / PARTS]))
        .filter(|spots| spots.len() >= LEAST_SPOTS)
        .collect();
    let uniform = Pupil { varies: true, ..first };
    let fits: Vec<Part> = parts
        .iter()
        .filter_map(|spots| Part::of(learner, spots, first))
        .collect();
    let spots = parts.concat();
    let starts = std::iter::once(uniform).chain(join(&fits, uniform));
    let starts = starts.flat_map(|start| match start.is_cut {
        true => vec![start.with_rim(1.0), start.with_rim(-1.0)],
        false => vec![start],
    });
    let fits = starts.map(|start| fitted(learner.camera, &learner.model, spots.clone(), start));
    fits.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(uniform, |best| best.1)
}

/// Patches of spots of part (x, y) beside which there is no other.
fn lone_spots(learner: &Learner, part: [usize; 2]) -> Vec<Patch> {
    let is_inside = |at: [f64; 2]| {
        let place = learner.model.field.at(at).0;
        place.map(|t| (0.5 * (t + 1.0) * PARTS as f64) as usize) == part
    };
    let reach = REACH * learner.camera.spot_sigma_m;
    let is_alone = |patch: &Patch, s: usize| {
        let at = patch.sources[s].at;
        let near = |other: &Source| (other.at[0] - at[0]).hypot(other.at[1] - at[1]) < reach;
        patch.sources.iter().filter(|other| near(other)).count() == 1
    };
    let spots: Vec<(usize, usize)> = (learner.patches.iter().enumerate())
        .flat_map(|(p, patch)| (0..patch.sources.len()).map(move |s| (p, s)))
        .filter(|(p, s)| is_inside(learner.patches[*p].sources[*s].at) && is_alone(&learner.patches[*p], *s))
        .collect();
    let step = spots.len().div_ceil(MOST_SPOTS).max(1);
    let chosen: Vec<(usize, usize)> = spots.into_iter().step_by(step).collect();
    chosen
        .par_iter()
        .flat_map_iter(|(p, s)| alone(learner, *p, *s))
        .collect()
}

impl Part {
    fn of(learner: &Learner, spots: &[Patch], first: Pupil) -> Option<Self> {
        let place = std::array::from_fn(|k| {
            let at = |patch: &Patch| learner.model.field.at(patch.sources[0].at).0[k];
            spots.iter().map(at).sum::<f64>() / spots.len() as f64
        });
        // Astigmatism at its best focus looks the same after a quarter turn: from one diagonal no way leads down to the other.
        let starts = [1.0, -1.0].map(|sign| {
            let mut start = first;
            start.parameters[Pupil::range(Pupil::OBLIQUE_ASTIGMATISM)]
                .iter_mut()
                .for_each(|p| *p *= sign);
            start
        });
        let fits = starts.map(|start| fitted(learner.camera, &learner.model, spots.to_vec(), start));
        let best = fits.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(Self {
            place,
            local: best.1.local([0.0; 2]),
        })
    }
}

/// The surroundings of spot `s` of patch `p`, without the other spots of its frame.
fn alone(learner: &Learner, p: usize, s: usize) -> Vec<Patch> {
    let (camera, chosen) = (learner.camera, &learner.patches[p]);
    let mut others = chosen.clone();
    let own = others.sources.remove(s);
    let image = learner.images[chosen.frame];
    let of_frame: Vec<&Patch> = (learner.patches.iter().enumerate())
        .filter(|(_, patch)| patch.frame == chosen.frame)
        .map(|(k, patch)| if k == p { &others } else { patch })
        .collect();
    let alone = Image {
        pixels: grouping::residual(camera, &learner.model, image, &of_frame),
        weight: image.weight.clone(),
        level: 0.0,
    };
    grouping::patches(camera, chosen.frame, &alone, vec![own], REACH * camera.spot_sigma_m)
}

/// χ² and wavefront after some steps from a start.
fn fitted(camera: &Camera, like: &TemplateModel, mut patches: Vec<Patch>, start: Pupil) -> (f64, Pupil) {
    let (mut model, mut pupil) = (like.with_pupil(start), start);
    let fit = |patches: &mut [Patch], model: &TemplateModel| {
        let fit = |patch: &mut Patch| patch.fit(camera, model, PLACES);
        patches.par_iter_mut().for_each(fit);
    };
    for _ in 0..STEPS {
        fit(&mut patches, &model);
        let Some(next) = wavefront::step(camera, &model, pupil, &patches) else {
            break;
        };
        pupil = next.pupil.unwrap_or(pupil);
        model = next;
    }
    fit(&mut patches, &model);
    (patches.iter().map(|p| p.chi2).sum(), pupil)
}

/// The wavefront nearest to the parts' (least squares). The image stays the same where all even polynomials change their sign: of all
/// signs of the parts those are taken that a polynomial of the field follows best.
fn join(parts: &[Part], like: Pupil) -> Option<Pupil> {
    let n = parts.len();
    let factors = Mat::from_fn(n, FIELD, |i, c| Pupil::factors(parts[i].place)[c]);
    let normal = factors.transpose() * &factors;
    let solver = ScaledCholesky::new(&normal, DAMPING)?;
    let project = |values: &[f64]| -> Vec<f64> {
        let rhs: Vec<f64> = (0..FIELD)
            .map(|c| values.iter().enumerate().map(|(i, v)| factors[(i, c)] * v).sum())
            .collect();
        solver.solve(&rhs)
    };
    let signed = |signs: usize, k: usize| -> Vec<f64> {
        let sign = |i: usize| match signs >> i & 1 == 1 && Pupil::is_even(k) {
            true => -1.0,
            false => 1.0,
        };
        parts
            .iter()
            .enumerate()
            .map(|(i, part)| sign(i) * part.local[k])
            .collect()
    };
    let left = |signs: &usize| -> f64 {
        let of = |k: usize| {
            let values = signed(*signs, k);
            let coefficients = project(&values);
            let square = |(i, v): (usize, &f64)| {
                let of_field: f64 = (0..FIELD).map(|c| factors[(i, c)] * coefficients[c]).sum();
                (v - of_field).powi(2)
            };
            values.iter().enumerate().map(square).sum::<f64>()
        };
        (1..=ZERNIKES).filter(|k| Pupil::is_even(*k)).map(of).sum()
    };
    // The last part's sign is free.
    let signs = (0..1usize << n.checked_sub(1)?).min_by(|a, b| left(a).total_cmp(&left(b)))?;
    let mut pupil = like;
    // What is the same everywhere is in the mean of the parts.
    for k in (0..Pupil::CHANGES).filter(|k| !(1..=ZERNIKES).contains(k)) {
        pupil.parameters[Pupil::range(k)][0] = parts.iter().map(|part| part.local[k]).sum::<f64>() / n as f64;
    }
    for k in 1..=ZERNIKES {
        pupil.parameters[Pupil::range(k)].copy_from_slice(&project(&signed(signs, k)));
    }
    Some(pupil)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_joined_whatever_their_signs() {
        // Astigmatism of a lens whose axis is off the middle: 0.08 waves times the square of (u + 0.3) + i·(v − 0.4).
        let waves = |[u, v]: [f64; 2]| {
            let (u, v) = (u + 0.3, v - 0.4);
            [0.08 * 2.0 * u * v, 0.08 * (u * u - v * v)]
        };
        let part = |k: usize| {
            let place = [k % PARTS, k / PARTS].map(|t| (t as f64 - 1.0) * 2.0 / 3.0);
            let mut local = [0.0; Pupil::CHANGES];
            local[0] = 2e-3_f64.ln();
            let sign = [1.0, -1.0][k % 2];
            (local[2], local[3]) = (sign * waves(place)[0], sign * waves(place)[1]);
            local[4] = 0.05 * place[1];
            Part { place, local }
        };
        let parts: Vec<Part> = (0..PARTS * PARTS).map(part).collect();
        let like = Pupil {
            parameters: [0.0; Pupil::PARAMETERS],
            varies: true,
            is_cut: false,
        };
        let pupil = join(&parts, like).expect("a wavefront");
        let place = [-0.8, 0.5];
        let local = pupil.local(place);
        let sign = (local[2] / waves(place)[0]).signum();
        for (found, expected) in [local[2], local[3]].iter().zip(waves(place)) {
            assert!((sign * found - expected).abs() < 1e-3, "{found} {expected}");
        }
        assert!((local[4] - 0.05 * place[1]).abs() < 1e-3, "{}", local[4]);
        assert!((local[0] - 2e-3_f64.ln()).abs() < 1e-12);
    }

    #[test]
    fn without_parts_there_is_nothing_to_join() {
        let like = Pupil {
            parameters: [0.0; Pupil::PARAMETERS],
            varies: true,
            is_cut: false,
        };
        assert!(join(&[], like).is_none());
    }
}
