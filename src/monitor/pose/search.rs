use nalgebra::Vector2;

use crate::monitor::pose::displacement::{Displacement, Witness};

/// A claim and how far from it its beam was found.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    pub claimed: Vector2<f64>,
    pub offset: Vector2<f64>,
}

/// Shifts are searched for up to this, m, and turns up to this, rad.
const SEARCH_M: f64 = 60.0;
const SEARCH_TURN: f64 = 0.15;
/// Witnesses that take part in a search, which costs their fourth power, and pairs of them that propose a turn.
const MOST_SEARCHED: usize = 16;
const MOST_PAIRS: usize = 8;
/// Claims nearer to each other say nothing of a turn, m.
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
        .map(|shift| Displacement {
            shift,
            ..Displacement::default()
        });
    let best = best(candidates, beams, searched)?;
    // The candidate carries one claim's error; the median of those that agree with it does not.
    let refined = Displacement {
        shift: median(agreeing(beams, searched, &best).iter().map(|p| p.offset)),
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

/// Shift, scale and turn by repeated medians (Siegel, 1982): over each witness the median of what it says with each other,
/// then over witnesses.
pub fn turn_of(pairs: &[Pair]) -> Displacement {
    let mut said = Vec::with_capacity(pairs.len());
    for (i, a) in pairs.iter().enumerate() {
        let others = pairs.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, b)| {
            let d = through((a.claimed, a.offset), (b.claimed, b.offset))?;
            Some(Vector2::new(d.scale, d.turn))
        });
        let others: Vec<_> = others.collect();
        if !others.is_empty() {
            said.push(median(others.into_iter()));
        }
    }
    let middle = median(said.into_iter());
    let turned = Displacement {
        shift: Vector2::zeros(),
        scale: middle.x,
        turn: middle.y,
    };
    Displacement {
        shift: median(pairs.iter().map(|p| p.offset - turned.at(p.claimed))),
        ..turned
    }
}

/// Component-wise; zero of none.
pub fn median(offsets: impl Iterator<Item = Vector2<f64>>) -> Vector2<f64> {
    let offsets: Vec<_> = offsets.collect();
    let middle = |axis: usize| {
        let mut values: Vec<f64> = offsets.iter().map(|o| o[axis]).collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        match n {
            0 => 0.0,
            _ if n % 2 == 1 => values[n / 2],
            _ => 0.5 * (values[n / 2 - 1] + values[n / 2]),
        }
    };
    Vector2::new(middle(0), middle(1))
}
