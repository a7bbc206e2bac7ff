//! Position and presence of an emitter as functions of time alone.

use serde::{Deserialize, Serialize};

use crate::toml_file::{Key, OutOfRange};

/// How an emitter moves on the ground. Metres, seconds; axes as on the ground, origin below the lens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// Stays at one place.
    Still([f64; 2]),
    /// Walks a closed course at constant speed.
    Walk(Walk),
    /// Stands, then moves away in a straight line.
    Drift(Drift),
    /// Moves about a centre: a stationary Gaussian process per axis.
    Roam(Roam),
    /// Stays at an offset from a user's true position.
    Beside(Beside),
    /// Is at a user's claimed position.
    AtClaimOf(Beside),
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Walk {
    pub through_m: Vec<[f64; 2]>,
    pub speed_m_s: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drift {
    pub from_m: [f64; 2],
    pub velocity_m_s: [f64; 2],
    #[serde(default)]
    pub after_s: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Roam {
    pub home_m: [f64; 2],
    /// Standard deviation per axis.
    pub spread_m: f64,
    /// Correlation time: autocovariance spread²·exp(−τ²/2T²), speed spread/T per axis.
    pub time_s: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Beside {
    pub user: String,
    #[serde(default)]
    pub offset_m: [f64; 2],
}

impl Motion {
    pub(super) fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        match self {
            Self::Still(at) => field.at("still").finite_pair(*at).map(drop),
            Self::Walk(walk) => {
                let field = field.at("walk");
                if walk.through_m.is_empty() {
                    return Err(field.at("through_m").refuse("at least one point", &walk.through_m));
                }
                for (k, point) in walk.through_m.iter().enumerate() {
                    field.item("through_m", k).finite_pair(*point)?;
                }
                field.at("speed_m_s").positive(walk.speed_m_s).map(drop)
            }
            Self::Drift(drift) => {
                let field = field.at("drift");
                field.at("from_m").finite_pair(drift.from_m)?;
                field.at("velocity_m_s").finite_pair(drift.velocity_m_s)?;
                field.at("after_s").finite(drift.after_s).map(drop)
            }
            Self::Roam(roam) => {
                let field = field.at("roam");
                field.at("home_m").finite_pair(roam.home_m)?;
                field.at("spread_m").non_negative(roam.spread_m)?;
                field.at("time_s").positive(roam.time_s).map(drop)
            }
            Self::Beside(beside) => field.at("beside").at("offset_m").finite_pair(beside.offset_m).map(drop),
            Self::AtClaimOf(beside) => field
                .at("at_claim_of")
                .at("offset_m")
                .finite_pair(beside.offset_m)
                .map(drop),
        }
    }
}

impl Walk {
    /// Position after `t` seconds; the course closes from the last point to the first.
    pub(super) fn at(&self, t: f64) -> [f64; 2] {
        let points = &self.through_m;
        let leg = |k: usize| {
            let (a, b) = (points[k], points[(k + 1) % points.len()]);
            (a, b, (b[0] - a[0]).hypot(b[1] - a[1]))
        };
        let round: f64 = (0..points.len()).map(|k| leg(k).2).sum();
        if round == 0.0 {
            return points[0];
        }
        let mut left = (t * self.speed_m_s).rem_euclid(round);
        for k in 0..points.len() {
            let (a, b, length) = leg(k);
            if left <= length && length > 0.0 {
                let s = left / length;
                return [a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])];
            }
            left -= length;
        }
        points[0]
    }
}

impl Drift {
    pub(super) fn at(&self, t: f64) -> [f64; 2] {
        let away = (t - self.after_s).max(0.0);
        [0, 1].map(|i| self.from_m[i] + away * self.velocity_m_s[i])
    }
}

/// When an emitter is present: from `from_s` until `until_s`, and again every `every_s`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Schedule {
    pub from_s: f64,
    /// For ever when left out.
    pub until_s: Option<f64>,
    /// Once when left out.
    pub every_s: Option<f64>,
}

impl Schedule {
    pub(super) fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("from_s").finite(self.from_s)?;
        if let Some(until) = self.until_s {
            field.at("until_s").finite(until)?;
            if until < self.from_s {
                return Err(field.at("until_s").refuse("a time not before from_s", until));
            }
        }
        match (self.every_s, self.until_s) {
            (None, _) => Ok(()),
            (Some(every), Some(until)) => {
                field.at("every_s").positive(every)?;
                if every < until - self.from_s {
                    return Err(field.at("every_s").refuse("at least until_s − from_s", every));
                }
                Ok(())
            }
            (Some(every), None) => Err(field.at("every_s").refuse("an until_s beside it", every)),
        }
    }

    /// Whether it is present at `t` seconds.
    pub fn on(&self, t: f64) -> bool {
        self.session(t).is_some()
    }

    /// Start and end of the session that holds `t`.
    fn session(&self, t: f64) -> Option<(f64, f64)> {
        self.sessions(t, t).find(|(a, b)| (*a..*b).contains(&t))
    }

    /// Start and end of every session that meets the closed span from `a` to `b`, end included.
    pub(super) fn sessions(&self, a: f64, b: f64) -> impl Iterator<Item = (f64, f64)> + use<> {
        let length = self.until_s.map_or(f64::INFINITY, |until| until - self.from_s);
        let from = self.from_s;
        let (first, last, every) = match self.every_s {
            Some(every) => (
                ((a - from - length) / every).ceil().max(0.0),
                ((b - from) / every).floor(),
                every,
            ),
            None => (0.0, 0.0, 0.0),
        };
        let count = (last - first + 1.0).max(0.0) as u64;
        (0..count)
            .map(move |m| from + (first + m as f64) * every)
            .map(move |start| (start, start + length))
            .filter(move |(start, end)| *start <= b && *end >= a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_walk_keeps_its_pace_and_closes() {
        let walk = Walk {
            through_m: vec![[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]],
            speed_m_s: 2.0,
        };
        assert_eq!(walk.at(0.0), [0.0, 0.0]);
        assert_eq!(walk.at(1.5), [3.0, 0.0]);
        assert_eq!(walk.at(2.5), [3.0, 2.0]);
        let round = (walk.at(6.0), walk.at(0.0));
        assert!((round.0[0] - round.1[0]).abs() < 1e-12 && (round.0[1] - round.1[1]).abs() < 1e-12);
    }

    #[test]
    fn a_schedule_repeats() {
        let schedule = Schedule {
            from_s: 3.0,
            until_s: Some(8.0),
            every_s: Some(12.0),
        };
        for (t, on) in [
            (0.0, false),
            (3.0, true),
            (7.9, true),
            (8.0, false),
            (14.9, false),
            (15.0, true),
            (20.0, false),
        ] {
            assert_eq!(schedule.on(t), on, "{t}");
        }
        assert!(Schedule::default().on(1e9));
        assert!(!Schedule::default().on(-1.0));
    }
}
