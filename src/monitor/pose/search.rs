//! The search for the displacement that most witnesses agree on.

use nalgebra::Vector2;

use super::displacement::Displacement;
use super::witness::Witness;
use crate::monitor::stats::robust::median_vector;

/// A claim and how far from it its beam was found.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    pub claimed: Vector2<f64>,
    pub offset: Vector2<f64>,
}

/// Largest shift, m, and turn or scale, rad, that are searched for. Larger finds a worse pose and more chance agreement. Not
/// measured.
const SEARCH_M: f64 = 60.0;
const SEARCH_TURN: f64 = 0.15;
/// Witnesses that take part in a search, which costs their fourth power, and pairs of them that propose a turn. More find a pose
/// among more liars; these bound the time of a frame.
const MOST_SEARCHED: usize = 16;
const MOST_PAIRS: usize = 8;
/// Distance below which two claims do not show a turn, m: their errors would. Shorter proposes turns out of noise, longer none
/// for users who stand together. Not measured.
const BASELINE_M: f64 = 10.0;

/// The witnesses that find a beam of their own at `displaced`.
pub fn agreeing(beams: &[Vector2<f64>], witnesses: &[Witness], displaced: &Displacement) -> Vec<Pair> {
    let mut free: Vec<bool> = vec![true; beams.len()];
    let mut pairs = Vec::with_capacity(witnesses.len().min(beams.len()));
    for w in witnesses {
        let expected = w.claimed + displaced.at(w.claimed);
        let nearest = (0..beams.len())
            .filter(|&i| free[i])
            .map(|i| (i, (beams[i] - expected).norm()))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((i, distance)) = nearest
            && distance <= w.reach_m
        {
            free[i] = false;
            pairs.push(Pair {
                claimed: w.claimed,
                offset: beams[i] - w.claimed,
            });
        }
    }
    pairs
}

/// The shift between some beam and some claim that most witnesses agree on; the smallest of equals.
pub fn search(beams: &[Vector2<f64>], witnesses: &[Witness]) -> Option<(Displacement, Vec<Pair>)> {
    let searched = &witnesses[..witnesses.len().min(MOST_SEARCHED)];
    let candidates = searched
        .iter()
        .flat_map(|w| beams.iter().map(move |b| b - w.claimed))
        .filter(|s| s.norm() <= SEARCH_M)
        .map(Displacement::of_shift);
    let best = best(candidates, beams, searched)?;
    // The candidate carries one claim's error; the median of those that agree with it does not.
    let refined = Displacement {
        shift: median_vector(agreeing(beams, searched, &best).iter().map(|p| p.offset)),
        ..best
    };
    Some((refined, agreeing(beams, witnesses, &refined)))
}

/// The same with a turn and a scale, proposed by two claims far apart and two beams.
pub fn search_turned(beams: &[Vector2<f64>], witnesses: &[Witness]) -> Option<(Displacement, Vec<Pair>)> {
    let searched = &witnesses[..witnesses.len().min(MOST_SEARCHED)];
    let mut pairs: Vec<(Vector2<f64>, Vector2<f64>)> = Vec::new();
    for (i, a) in searched.iter().enumerate() {
        pairs.extend(searched[..i].iter().map(|b| (a.claimed, b.claimed)));
    }
    pairs.sort_by(|a, b| (b.0 - b.1).norm().total_cmp(&(a.0 - a.1).norm()));
    pairs.truncate(MOST_PAIRS);
    let mut candidates = Vec::new();
    for (p, q) in pairs {
        for b in beams.iter().filter(|b| (*b - p).norm() <= 2.0 * SEARCH_M) {
            for c in beams.iter().filter(|c| (*c - q).norm() <= 2.0 * SEARCH_M) {
                let found = through((p, b - p), (q, c - q));
                candidates.extend(found.filter(|d| d.shift.norm() <= SEARCH_M && d.scale.hypot(d.turn) <= SEARCH_TURN));
            }
        }
    }
    let best = best(candidates.into_iter(), beams, searched)?;
    let refined = turn_of(&agreeing(beams, searched, &best));
    Some((refined, agreeing(beams, witnesses, &refined)))
}

fn best(
    candidates: impl Iterator<Item = Displacement>,
    beams: &[Vector2<f64>],
    witnesses: &[Witness],
) -> Option<Displacement> {
    let size = |d: &Displacement| d.shift.norm() + 100.0 * d.scale.hypot(d.turn);
    let mut best: Option<(usize, Displacement)> = None;
    for d in candidates {
        let count = agreeing(beams, witnesses, &d).len();
        if best.is_none_or(|(n, b)| count > n || (count == n && size(&d) < size(&b))) {
            best = Some((count, d));
        }
    }
    best.map(|(_, d)| d)
}

/// The displacement with scale and turn that moves two places by two offsets.
fn through(a: (Vector2<f64>, Vector2<f64>), b: (Vector2<f64>, Vector2<f64>)) -> Option<Displacement> {
    let (base, change) = (a.0 - b.0, a.1 - b.1);
    let length2 = base.norm_squared();
    if length2 < BASELINE_M * BASELINE_M {
        return None;
    }
    let mut found = Displacement {
        shift: Vector2::zeros(),
        scale: base.dot(&change) / length2,
        turn: base.perp(&change) / length2,
    };
    found.shift = a.1 - found.at(a.0);
    Some(found)
}

/// How many displacements at least so many witnesses would agree on by chance, if beams lay anywhere among claims and beams. So many `free`
/// witnesses choose a displacement, one for a shift and two for one with a turn; each other one finds a beam within its reach.
pub fn by_chance(beams: &[Vector2<f64>], witnesses: &[Witness], agreeing: usize, free: usize) -> f64 {
    let places = || beams.iter().copied().chain(witnesses.iter().map(|w| w.claimed));
    let low = places().reduce(|a, b| a.inf(&b)).unwrap_or_default();
    let high = places().reduce(|a, b| a.sup(&b)).unwrap_or_default();
    let (n, m) = (witnesses.len() as f64, beams.len() as f64);
    let reach2 = witnesses.iter().map(|w| w.reach_m * w.reach_m).sum::<f64>() / n;
    let found = (m * std::f64::consts::PI * reach2 / (high - low).product()).min(1.0);
    let others = n - free as f64;
    (0..agreeing.saturating_sub(free)).fold((n * m).powi(free as i32), |expected, j| {
        expected * found * (others - j as f64) / (j as f64 + 1.0)
    })
}

/// Shift, scale and turn by repeated medians (Siegel, 1982): over each witness the median of what it gives with each other,
/// then over witnesses.
pub fn turn_of(pairs: &[Pair]) -> Displacement {
    let mut slopes = Vec::with_capacity(pairs.len());
    for (i, a) in pairs.iter().enumerate() {
        let others = pairs.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, b)| {
            let d = through((a.claimed, a.offset), (b.claimed, b.offset))?;
            Some(Vector2::new(d.scale, d.turn))
        });
        let others: Vec<_> = others.collect();
        if !others.is_empty() {
            slopes.push(median_vector(others.into_iter()));
        }
    }
    let middle = median_vector(slopes.into_iter());
    let turned = Displacement {
        shift: Vector2::zeros(),
        scale: middle.x,
        turn: middle.y,
    };
    Displacement {
        shift: median_vector(pairs.iter().map(|p| p.offset - turned.at(p.claimed))),
        ..turned
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn witnesses(claims: &[[f64; 2]]) -> Vec<Witness> {
        claims
            .iter()
            .map(|c| Witness {
                claimed: Vector2::from(*c),
                variance: 0.09,
                reach_m: 1.0,
            })
            .collect()
    }

    fn beams(places: &[[f64; 2]]) -> Vec<Vector2<f64>> {
        places.iter().map(|p| Vector2::from(*p)).collect()
    }

    #[test]
    fn a_beam_agrees_with_one_witness_only() {
        let witnesses = witnesses(&[[0.0, 0.0], [0.5, 0.0], [20.0, 0.0]]);
        let pairs = agreeing(&beams(&[[0.2, 0.0], [22.0, 0.0]]), &witnesses, &Displacement::default());
        assert_eq!(pairs.len(), 1);
        assert_eq!(pairs[0].offset, Vector2::new(0.2, 0.0));
    }

    #[test]
    fn the_shift_that_most_agree_on_is_found() {
        let claims = witnesses(&[[0.0, 0.0], [30.0, 0.0], [0.0, 40.0], [-50.0, 0.0]]);
        let beams = beams(&[[7.0, 1.0], [37.2, 1.0], [6.8, 41.0], [-50.0, 0.0]]);
        let (found, pairs) = search(&beams, &claims).unwrap();
        assert_eq!(pairs.len(), 3);
        // Component-wise median of (7, 1), (7.2, 1) and (6.8, 1).
        assert!((found.shift - Vector2::new(7.0, 1.0)).norm() < 1e-9, "{found:?}");
    }

    #[test]
    fn two_places_and_their_offsets_give_turn_and_scale() {
        let offset = |p: Vector2<f64>| Vector2::new(0.1 * p.x - 0.02 * p.y + 1.0, 0.02 * p.x + 0.1 * p.y - 2.0);
        let (a, b) = (Vector2::new(10.0, 5.0), Vector2::new(-30.0, 20.0));
        let found = through((a, offset(a)), (b, offset(b))).unwrap();
        assert!((found.scale - 0.1).abs() < 1e-12 && (found.turn - 0.02).abs() < 1e-12);
        assert!((found.shift - Vector2::new(1.0, -2.0)).norm() < 1e-12);
        assert!(through((a, offset(a)), (a + Vector2::new(9.0, 0.0), offset(a))).is_none());
    }

    #[test]
    fn a_turn_survives_a_liar_of_five() {
        let truth = Displacement {
            shift: Vector2::new(1.0, 2.0),
            scale: 0.01,
            turn: -0.03,
        };
        let claims = [[0.0, 0.0], [50.0, 0.0], [0.0, 60.0], [-70.0, 10.0], [20.0, -80.0]];
        let mut pairs: Vec<Pair> = claims
            .iter()
            .map(|c| Vector2::from(*c))
            .map(|claimed| Pair {
                claimed,
                offset: truth.at(claimed),
            })
            .collect();
        pairs[0].offset += Vector2::new(30.0, -9.0);
        let found = turn_of(&pairs);
        assert!((found.scale - truth.scale).abs() < 1e-12 && (found.turn - truth.turn).abs() < 1e-12);
        assert!((found.shift - truth.shift).norm() < 1e-9, "{found:?}");
    }
}
