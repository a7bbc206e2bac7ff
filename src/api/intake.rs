//! The answer to posted claims: how many were taken, and why others were not.

use serde::Serialize;

/// Reasons listed in one answer; the count is exact beyond it.
const MAX_REASONS: usize = 100;

/// What became of the claims in a body.
#[derive(Clone, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct Intake {
    pub accepted: usize,
    pub refused: usize,
    /// Why claims were refused, the first hundred.
    pub reasons: Vec<Refusal>,
}

/// One claim that was not taken.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Refusal {
    /// Line in the body, from 1.
    pub line: usize,
    pub reason: String,
}

impl Intake {
    /// Counts a claim that was not taken.
    pub fn refuse(&mut self, line: usize, reason: String) {
        self.refused += 1;
        if self.reasons.len() < MAX_REASONS {
            self.reasons.push(Refusal { line, reason });
        }
    }
}
