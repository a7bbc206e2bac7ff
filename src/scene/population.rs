//! The emitters present at a time, and their positions.

use rand::RngExt;

use super::config::{RandomEmittersConfig, Scene};
use super::effect::Effect;
use super::motion::{Beside, Motion, Schedule};
use super::process::GaussianProcess;
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use super::truth::Role;
use crate::hash::fnv1a;

/// One beam in one frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Beam {
    pub ground: [f64; 2],
    pub power_w: f64,
    /// Keys its random streams.
    pub entity: u64,
    /// Index into [`Population::actors`].
    pub actor: Option<usize>,
}

/// A user or an intruder.
#[derive(Debug)]
pub(super) struct Actor {
    pub name: String,
    pub role: Role,
    path: Path,
    claimed: Option<Path>,
    pub present: Schedule,
    beam: bool,
    power_w: f64,
    pub entity: u64,
}

/// A motion prepared for evaluation at any time.
#[derive(Debug)]
enum Path {
    Own(Motion),
    Roam {
        home_m: [f64; 2],
        spread_m: f64,
        time_s: f64,
        axes: [GaussianProcess; 2],
    },
    Beside {
        actor: usize,
        offset_m: [f64; 2],
    },
    AtClaimOf {
        actor: usize,
        offset_m: [f64; 2],
    },
}

#[derive(Debug)]
pub(super) struct Population {
    pub actors: Vec<Actor>,
    random: Option<RandomEmittersConfig>,
    default_power_w: f64,
}

impl Population {
    /// Actors in the scene's order, users first.
    pub fn new(scene: &Scene, streams: Streams, ledger: &Ledger) -> Self {
        let power = scene.link.power_w;
        let index = |b: &Beside| {
            let found = scene.user.iter().position(|u| u.name == b.user);
            found.expect("the scene was validated")
        };
        let path = |motion: &Motion, entity: u64| match motion {
            Motion::Roam(roam) => Path::Roam {
                home_m: roam.home_m,
                spread_m: roam.spread_m,
                time_s: roam.time_s,
                axes: [0, 1].map(|axis| {
                    let mut stream = streams.open(Effect::Motion, entity, axis, ledger);
                    GaussianProcess::new(&mut *stream, roam.time_s)
                }),
            },
            Motion::Beside(b) => Path::Beside {
                actor: index(b),
                offset_m: b.offset_m,
            },
            Motion::AtClaimOf(b) => Path::AtClaimOf {
                actor: index(b),
                offset_m: b.offset_m,
            },
            own => Path::Own(own.clone()),
        };
        let users = scene.user.iter().map(|u| {
            let entity = entity(&u.name);
            Actor {
                name: u.name.clone(),
                role: Role::User,
                path: path(&u.motion, entity),
                claimed: u.claimed.as_ref().map(|m| path(m, entity ^ 1)),
                present: u.present,
                beam: u.beam,
                power_w: u.power_w.unwrap_or(power),
                entity,
            }
        });
        let intruders = scene.intruder.iter().map(|i| {
            let entity = entity(&i.name);
            Actor {
                name: i.name.clone(),
                role: Role::Intruder,
                path: path(&i.motion, entity),
                claimed: None,
                present: i.present,
                beam: true,
                power_w: i.power_w.unwrap_or(power),
                entity,
            }
        });
        Self {
            actors: users.chain(intruders).collect(),
            random: scene.random_emitters.clone(),
            default_power_w: power,
        }
    }

    /// Notes who is simulated in the plan.
    pub fn explain(&self, decisions: &mut Decisions) {
        match &self.random {
            Some(random) => {
                let [low, high] = random.count;
                let reason = format!("{low} to {high} emitters drawn anew for every frame");
                decisions.note(Effect::Population, Status::On, reason);
            }
            None => decisions.note(Effect::Population, Status::Off, "not in the scene"),
        }
        let roaming = self
            .actors
            .iter()
            .filter(|a| matches!(a.path, Path::Roam { .. }))
            .count();
        let moving = self.actors.iter().filter(|a| self.speed(&a.path) > 0.0).count();
        match (moving, roaming) {
            (0, _) => decisions.note(Effect::Motion, Status::Off, "no emitter moves"),
            (_, 0) => decisions.note(
                Effect::Motion,
                Status::On,
                format!("{moving} move, each a function of time"),
            ),
            _ => {
                let reason = format!("{moving} move, {roaming} of them at random, drawn once");
                decisions.note(Effect::Motion, Status::On, reason);
            }
        }
    }

    /// No actor is faster, m/s; of a roaming one, four standard deviations.
    pub fn top_speed(&self) -> f64 {
        self.actors.iter().map(|a| self.speed(&a.path)).fold(0.0, f64::max)
    }

    fn speed(&self, path: &Path) -> f64 {
        match path {
            Path::Own(Motion::Walk(walk)) if walk.through_m.len() > 1 => walk.speed_m_s,
            Path::Own(Motion::Drift(drift)) => drift.velocity_m_s[0].hypot(drift.velocity_m_s[1]),
            Path::Own(_) => 0.0,
            Path::Roam { spread_m, time_s, .. } => 4.0 * spread_m / time_s,
            Path::Beside { actor, .. } => self.speed(&self.actors[*actor].path),
            Path::AtClaimOf { actor, .. } => {
                let user = &self.actors[*actor];
                self.speed(user.claimed.as_ref().unwrap_or(&user.path))
            }
        }
    }

    /// True position of an actor at `t` seconds, m.
    pub fn position(&self, actor: usize, t: f64) -> [f64; 2] {
        self.along(&self.actors[actor].path, t)
    }

    /// Claimed position of a user at `t` seconds, m.
    pub fn claimed(&self, actor: usize, t: f64) -> [f64; 2] {
        match &self.actors[actor].claimed {
            Some(path) => self.along(path, t),
            None => self.position(actor, t),
        }
    }

    fn along(&self, path: &Path, t: f64) -> [f64; 2] {
        let shifted = |at: [f64; 2], by: [f64; 2]| [at[0] + by[0], at[1] + by[1]];
        match path {
            Path::Own(Motion::Still(at)) => *at,
            Path::Own(Motion::Walk(walk)) => walk.at(t),
            Path::Own(Motion::Drift(drift)) => drift.at(t),
            Path::Own(_) => unreachable!("`new` resolves every other motion"),
            Path::Roam {
                home_m, spread_m, axes, ..
            } => [0, 1].map(|i| home_m[i] + spread_m * axes[i].at(t)),
            Path::Beside { actor, offset_m } => shifted(self.position(*actor, t), *offset_m),
            Path::AtClaimOf { actor, offset_m } => shifted(self.claimed(*actor, t), *offset_m),
        }
    }

    /// The beams of frame `k`, whose exposure is centred on `t` seconds.
    pub fn beams(&self, k: u64, t: f64, streams: Streams, ledger: &Ledger, out: &mut Vec<Beam>) {
        out.clear();
        for (index, actor) in self.actors.iter().enumerate() {
            if actor.beam && actor.present.on(t) {
                out.push(Beam {
                    ground: self.along(&actor.path, t),
                    power_w: actor.power_w,
                    entity: actor.entity,
                    actor: Some(index),
                });
            }
        }
        let Some(random) = &self.random else { return };
        let mut stream = streams.open(Effect::Population, 0, k, ledger);
        let count = stream.random_range(random.count[0]..=random.count[1]);
        for n in 0..count {
            let ground = random.area_m.map(|side| side * (stream.random::<f64>() - 0.5));
            out.push(Beam {
                ground,
                power_w: self.default_power_w,
                entity: u64::from(n),
                actor: None,
            });
        }
    }
}

/// Keys an actor's streams by its name, so that adding another leaves them unchanged.
fn entity(name: &str) -> u64 {
    fnv1a(name.bytes())
}
