//! From a video signal's counts back to counts that are proportional to light.

use serde::{Deserialize, Serialize};

/// How a camera's counts follow from light. A raw sensor's are proportional to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Response {
    pub transfer: Transfer,
    /// Black is 16 and white 235 of 255, as in television.
    pub limited_range: bool,
}

/// A transfer curve.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Transfer {
    #[default]
    Linear,
    /// IEC 61966-2-1.
    Srgb,
    /// ITU-R BT.709.
    Bt709,
}

impl Transfer {
    pub const ALL: [Self; 3] = [Self::Linear, Self::Srgb, Self::Bt709];

    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Srgb => "srgb",
            Self::Bt709 => "bt709",
        }
    }

    /// Light of a signal, black 0 and white 1. Signals below black are mirrored, so that noise keeps its mean.
    pub fn light_of(self, signal: f64) -> f64 {
        let s = signal.abs();
        let light = match self {
            Self::Linear => s,
            // IEC 61966-2-1:1999, 5.2.
            Self::Srgb if s <= 0.04045 => s / 12.92,
            Self::Srgb => ((s + 0.055) / 1.055).powf(2.4),
            // ITU-R BT.709-6, item 1.2, inverted.
            Self::Bt709 if s < 0.081 => s / 4.5,
            Self::Bt709 => ((s + 0.099) / 1.099).powf(1.0 / 0.45),
        };
        light.copysign(signal)
    }
}

impl Response {
    /// Black and white in counts of a full scale.
    pub fn range(self, full_scale: u16) -> (f64, f64) {
        let full = f64::from(full_scale);
        match self.limited_range {
            false => (0.0, full),
            // ITU-R BT.709-6, item 4.6: 16 and 235 at 8 bits, shifted with the depth.
            true => (16.0 * (full + 1.0) / 256.0, 235.0 * (full + 1.0) / 256.0),
        }
    }

    /// For every count the count in proportion to its light, white at full scale; `None` where counts are that already.
    pub fn table(self, full_scale: u16) -> Option<Vec<f64>> {
        if self == Self::default() {
            return None;
        }
        let (black, white) = self.range(full_scale);
        let linear = |count| {
            let signal = (f64::from(count) - black) / (white - black);
            self.transfer.light_of(signal) * f64::from(full_scale)
        };
        Some((0..=full_scale).map(linear).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_meet_where_their_pieces_do_and_end_at_white() {
        for transfer in Transfer::ALL {
            assert!((transfer.light_of(1.0) - 1.0).abs() < 1e-12);
            assert_eq!(transfer.light_of(-0.5), -transfer.light_of(0.5));
            for joint in [0.04045, 0.081] {
                let step = transfer.light_of(joint + 1e-9) - transfer.light_of(joint - 1e-9);
                assert!(step.abs() < 1e-4, "{transfer:?} {joint}: {step}");
            }
        }
        // Mid grey of sRGB (IEC 61966-2-1): 128 is 21.6 % of white.
        let table = Response {
            transfer: Transfer::Srgb,
            limited_range: false,
        }
        .table(255)
        .unwrap();
        assert!((table[128] / 255.0 - 0.2158).abs() < 1e-3);
    }

    #[test]
    fn a_limited_range_is_stretched() {
        let limited = Response {
            transfer: Transfer::Linear,
            limited_range: true,
        };
        let table = limited.table(255).unwrap();
        assert_eq!((table[16], table[235]), (0.0, 255.0));
        assert!(table[0] < 0.0);
        assert_eq!(limited.range(1023), (64.0, 940.0));
        assert!(Response::default().table(255).is_none());
    }
}
