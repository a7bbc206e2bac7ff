//! Reasons for which a frame, or what it says, is refused.

/// Why a frame or what it says is not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Refusal {
    /// Bytes that are no frame, or a frame that is cut off.
    Malformed,
    Checksum,
    /// Another system's or component's.
    OtherSystem,
    /// Without a signature where a key is given.
    Unsigned,
    Signature,
    /// Signed, but not later than what came before.
    Replayed,
    /// A stamp that is out of order with our clock, or an answer to nothing that was asked.
    Time,
    /// Not a rotation.
    Attitude,
    /// No position, or none that can be.
    Position,
    /// A position in a frame whose axes are unknown.
    Frame,
}

impl Refusal {
    pub const ALL: [Self; 10] = [
        Self::Malformed,
        Self::Checksum,
        Self::OtherSystem,
        Self::Unsigned,
        Self::Signature,
        Self::Replayed,
        Self::Time,
        Self::Attitude,
        Self::Position,
        Self::Frame,
    ];

    /// The value of a metric's label.
    pub fn name(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::Checksum => "checksum",
            Self::OtherSystem => "other_system",
            Self::Unsigned => "unsigned",
            Self::Signature => "signature",
            Self::Replayed => "replayed",
            Self::Time => "time",
            Self::Attitude => "attitude",
            Self::Position => "position",
            Self::Frame => "frame",
        }
    }
}
