//! What the access network logs about its users.

use super::config::ClaimsConfig;
use super::population::Population;
use super::truth::Role;
use crate::claim::ClaimState;

/// A claim before it has a calendar date.
#[derive(Clone, Debug)]
pub(super) struct Statement {
    /// Arrival in the log, s.
    pub arrival: f64,
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
    pub fn new(config: ClaimsConfig) -> Self {
        Self { config }
    }

    pub fn sigma_m(&self) -> Option<f64> {
        self.config.sigma_m
    }

    /// Statements that arrive after `after` and not after `until` (s), in the order of their arrival.
    pub fn arrivals(&self, population: &Population, after: f64, until: f64) -> Vec<Statement> {
        let mut found = Vec::new();
        for (actor, who) in population.actors.iter().enumerate() {
            if who.role != Role::User {
                continue;
            }
            for (start, end) in who.present.sessions(after, until) {
                let period = self.config.period_s;
                let first = ((after - start) / period).floor().max(0.0) as u64;
                let ticks = (first..)
                    .map(|n| start + n as f64 * period)
                    .take_while(|t| *t <= until && *t < end);
                let active = ticks.map(|t| (t, ClaimState::Active));
                let ended = (end <= until).then_some((end, ClaimState::Ended));
                for (stated, state) in active.chain(ended).filter(|(t, _)| *t > after) {
                    found.push(Statement {
                        arrival: stated,
                        stated,
                        actor,
                        at_m: population.claimed(actor, stated),
                        state,
                    });
                }
            }
        }
        found.sort_by(|a, b| a.arrival.total_cmp(&b.arrival).then(a.actor.cmp(&b.actor)));
        found
    }
}
