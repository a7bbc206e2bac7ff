//! Element types of a frame file.

/// Element type of a frame file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtype {
    F4 { big: bool },
    F8 { big: bool },
    U1,
    U2 { big: bool },
}

impl Dtype {
    /// Little-endian 64-bit floats: joules without any loss.
    pub const JOULES: Self = Self::F8 { big: false };

    /// NumPy's type string.
    pub fn descr(self) -> &'static str {
        match self {
            Self::F4 { big: false } => "<f4",
            Self::F4 { big: true } => ">f4",
            Self::F8 { big: false } => "<f8",
            Self::F8 { big: true } => ">f8",
            Self::U1 => "|u1",
            Self::U2 { big: false } => "<u2",
            Self::U2 { big: true } => ">u2",
        }
    }

    pub(super) fn from_descr(descr: &str) -> Option<Self> {
        let (order, kind) = descr.split_at_checked(1)?;
        let big = match order {
            "<" | "|" => false,
            ">" => true,
            "=" => cfg!(target_endian = "big"),
            _ => return None,
        };
        match kind {
            "f4" => Some(Self::F4 { big }),
            "f8" => Some(Self::F8 { big }),
            "u1" => Some(Self::U1),
            "u2" => Some(Self::U2 { big }),
            _ => None,
        }
    }

    pub fn size(self) -> usize {
        match self {
            Self::U1 => 1,
            Self::U2 { .. } => 2,
            Self::F4 { .. } => 4,
            Self::F8 { .. } => 8,
        }
    }

    pub fn is_counts(self) -> bool {
        matches!(self, Self::U1 | Self::U2 { .. })
    }
}
