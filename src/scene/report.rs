//! Which effects a plan simulates, and why.

use super::effect::Effect;

/// Decision of a plan about one effect.
#[derive(Clone, Debug)]
pub struct Decision {
    pub effect: Effect,
    pub status: Status,
    pub reason: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// Simulated in every frame.
    On,
    /// Not in the scene.
    Off,
    /// Simulated exactly by something that was computed once, when the scene was compiled.
    Folded,
    /// Left out, because its change is within the tolerance of the scene.
    BelowTolerance,
}

impl Status {
    pub fn name(self) -> &'static str {
        match self {
            Self::On => "on",
            Self::Off => "off",
            Self::Folded => "folded",
            Self::BelowTolerance => "below tolerance",
        }
    }
}

/// Decides for each effect whether it is simulated, while a plan is compiled.
#[derive(Debug)]
pub(super) struct Decisions {
    noise_std_j: f64,
    tolerance: f64,
    pub made: Vec<Decision>,
}

impl Decisions {
    pub fn new(noise_std_j: f64, tolerance: f64) -> Self {
        Self {
            noise_std_j,
            tolerance,
            made: Vec::new(),
        }
    }

    pub fn note(&mut self, effect: Effect, status: Status, reason: impl Into<String>) {
        self.made.push(Decision {
            effect,
            status,
            reason: reason.into(),
        });
    }

    /// `table` unless what it changes, at most `size_j` in any pixel, is tolerated.
    pub fn weigh<'t, T>(&mut self, effect: Effect, table: &'t Option<T>, size_j: impl Fn(&T) -> f64) -> Option<&'t T> {
        let Some(table) = table else {
            self.note(effect, Status::Off, "not in the scene");
            return None;
        };
        let share = size_j(table) / self.noise_std_j;
        if share < self.tolerance {
            let reason = format!(
                "changes no pixel by more than {share:.1e} σ_n; tolerance is {:.1e}",
                self.tolerance
            );
            self.note(effect, Status::BelowTolerance, reason);
            return None;
        }
        Some(table)
    }
}
