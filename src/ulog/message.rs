//! The numbers of one message, by name.

use std::collections::HashMap;

/// A number of a basic type at an offset.
#[derive(Clone, Copy)]
pub struct Number {
    pub kind: Basic,
    pub at: usize,
}

#[derive(Clone, Copy)]
pub enum Basic {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Basic {
    pub fn of(name: &str) -> Option<Self> {
        Some(match name {
            "uint8_t" | "bool" | "char" => Self::U8,
            "int8_t" => Self::I8,
            "uint16_t" => Self::U16,
            "int16_t" => Self::I16,
            "uint32_t" => Self::U32,
            "int32_t" => Self::I32,
            "uint64_t" => Self::U64,
            "int64_t" => Self::I64,
            "float" => Self::F32,
            "double" => Self::F64,
            _ => return None,
        })
    }

    pub fn size(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }
}

/// A message's data, whose numbers are read by name; one that is not there is NaN.
pub struct Data<'a> {
    pub bytes: &'a [u8],
    pub fields: &'a HashMap<String, Number>,
}

impl Data<'_> {
    pub fn get(&self, name: &str) -> f64 {
        self.integer(name)
            .map_or_else(|| self.float(name).unwrap_or(f64::NAN), |v| v as f64)
    }

    /// The first of these fields that the message has: names differ between PX4's versions.
    pub fn any(&self, names: &[&str]) -> f64 {
        let found = names.iter().map(|name| self.get(name));
        found.into_iter().find(|v| !v.is_nan()).unwrap_or(f64::NAN)
    }

    /// Whether a flag is set; those of older versions are not there and count as set.
    pub fn is_set(&self, name: &str) -> bool {
        self.integer(name) != Some(0)
    }

    /// `timestamp_sample`, when it was measured, or `timestamp`, when it was published.
    pub fn time_us(&self) -> Option<u64> {
        let sample = self.integer("timestamp_sample").filter(|t| *t > 0);
        sample
            .or_else(|| self.integer("timestamp"))
            .and_then(|t| u64::try_from(t).ok())
    }

    pub fn integer(&self, name: &str) -> Option<i64> {
        let Number { kind, at } = *self.fields.get(name)?;
        Some(match kind {
            Basic::U8 => u8::from_le_bytes(self.take(at)?).into(),
            Basic::I8 => i8::from_le_bytes(self.take(at)?).into(),
            Basic::U16 => u16::from_le_bytes(self.take(at)?).into(),
            Basic::I16 => i16::from_le_bytes(self.take(at)?).into(),
            Basic::U32 => u32::from_le_bytes(self.take(at)?).into(),
            Basic::I32 => i32::from_le_bytes(self.take(at)?).into(),
            Basic::U64 => u64::from_le_bytes(self.take(at)?).try_into().ok()?,
            Basic::I64 => i64::from_le_bytes(self.take(at)?),
            Basic::F32 | Basic::F64 => return None,
        })
    }

    fn float(&self, name: &str) -> Option<f64> {
        let Number { kind, at } = *self.fields.get(name)?;
        match kind {
            Basic::F32 => Some(f32::from_le_bytes(self.take(at)?).into()),
            Basic::F64 => Some(f64::from_le_bytes(self.take(at)?)),
            _ => None,
        }
    }

    fn take<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        self.bytes.get(at..)?.first_chunk().copied()
    }
}
