//! What becomes of a claim that is shown to the store.

/// What became of a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The user's newest claim now.
    Accepted,
    /// Kept until its own time comes.
    Ahead,
    /// Older than the user's newest claim: kept as history only.
    Late,
    /// Older than the whole history.
    TooLate,
    /// The same claim again.
    Duplicate,
    /// The user already claimed another position for the same time; the first stands.
    Conflicting,
    /// No room for another user, or for another claim ahead of its time.
    Full,
}

/// Why a claim was refused for want of room.
pub const NO_ROOM: &str = "the store of claims is full";

impl Outcome {
    /// Why the claim was refused, where it was.
    pub fn refusal(self) -> Option<&'static str> {
        match self {
            Self::Full => Some(NO_ROOM),
            Self::Conflicting => Some("another position was claimed for this user and time"),
            Self::TooLate => Some("older than all that is kept of this user"),
            Self::Accepted | Self::Ahead | Self::Late | Self::Duplicate => None,
        }
    }
}
