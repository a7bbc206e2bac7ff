//! The access network's log of its users: claims that are late, lost, noisy or false as the scene specifies.

use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

use super::config::ClaimsConfig;
use super::effect::Effect;
use super::population::{Actor, Population};
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use super::truth::Role;
use crate::claim::ClaimState;

/// A claim on the clock of the scene.
#[derive(Clone, Debug)]
pub(super) struct Statement {
    /// The time that it states, s.
    pub stated: f64,
    pub actor: usize,
    pub at_m: [f64; 2],
    pub state: ClaimState,
}

#[derive(Debug)]
pub(super) struct Network {
    config: ClaimsConfig,
}

impl Network {
    pub fn new(config: ClaimsConfig, has_users: bool, decisions: &mut Decisions) -> Self {
        let late = config.delay_s > 0.0 || config.delay_spread_s > 0.0;
        for (effect, on) in [
            (Effect::ClaimDelay, late),
            (Effect::ClaimLoss, config.lost > 0.0),
            (Effect::ClaimNoise, config.noise_m > 0.0),
        ] {
            match (on, has_users) {
                (true, true) => decisions.note(effect, Status::On, "one draw a claim"),
                (true, false) => decisions.note(effect, Status::Off, "no user claims a position"),
                (false, _) => decisions.note(effect, Status::Off, "not in the scene"),
            }
        }
        Self { config }
    }

    pub fn sigma_m(&self) -> Option<f64> {
        self.config.sigma_m
    }

    /// Statements that arrive in (`after`, `until`], s, in the order of their arrival.
    pub fn arrivals(
        &self,
        population: &Population,
        after: f64,
        until: f64,
        streams: Streams,
        ledger: &Ledger,
    ) -> Vec<Statement> {
        let latest = self.config.delay_s + self.config.delay_spread_s;
        let mut found: Vec<(f64, Statement)> = Vec::new();
        for (index, actor) in population.actors.iter().enumerate() {
            if actor.role != Role::User {
                continue;
            }
            for (stated, state) in self.statements(actor, after - latest, until) {
                let Some(arrival) = self.arrival(actor, stated, streams, ledger) else {
                    continue;
                };
                if arrival > after && arrival <= until {
                    let at_m = self.logged_position(actor, population.claimed(index, stated), stated, streams, ledger);
                    let statement = Statement {
                        stated,
                        actor: index,
                        at_m,
                        state,
                    };
                    found.push((arrival, statement));
                }
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.actor.cmp(&b.1.actor)));
        found.into_iter().map(|(_, statement)| statement).collect()
    }

    /// Statements of a user in (`after`, `until`], s: positions from the start of each session on, and its end.
    fn statements(&self, actor: &Actor, after: f64, until: f64) -> Vec<(f64, ClaimState)> {
        let period = self.config.period_s;
        let mut found = Vec::new();
        for (start, end) in actor.present.sessions(after, until) {
            let first = ((after - start) / period).floor().max(0.0) as u64;
            let ticks = (first..).map(|n| start + n as f64 * period);
            let active = ticks.take_while(|t| *t <= until && *t < end).filter(|t| *t > after);
            found.extend(active.map(|t| (t, ClaimState::Active)));
            if end > after && end <= until {
                found.push((end, ClaimState::Ended));
            }
        }
        found
    }

    /// Time at which a statement reaches the log, s; none when it is lost.
    fn arrival(&self, actor: &Actor, stated: f64, streams: Streams, ledger: &Ledger) -> Option<f64> {
        let open = |effect| streams.open(effect, actor.entity, stated.to_bits(), ledger);
        if self.config.lost > 0.0 && open(Effect::ClaimLoss).random::<f64>() < self.config.lost {
            return None;
        }
        let mut arrival = stated + self.config.delay_s;
        if self.config.delay_spread_s > 0.0 {
            arrival += self.config.delay_spread_s * open(Effect::ClaimDelay).random::<f64>();
        }
        Some(arrival)
    }

    /// Logged position for a stated one, m.
    fn logged_position(
        &self,
        actor: &Actor,
        at_m: [f64; 2],
        stated: f64,
        streams: Streams,
        ledger: &Ledger,
    ) -> [f64; 2] {
        if self.config.noise_m == 0.0 {
            return at_m;
        }
        let mut stream = streams.open(Effect::ClaimNoise, actor.entity, stated.to_bits(), ledger);
        at_m.map(|p| {
            let z: f64 = StandardNormal.sample(&mut *stream);
            p + self.config.noise_m * z
        })
    }
}
