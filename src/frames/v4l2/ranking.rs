//! Ranks what a device offers by the information it carries.

use std::cmp::Reverse;

use super::format::{Light, PixelFormat};

/// A format and size that a device offers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Offer {
    pub format: PixelFormat,
    /// Width and height.
    pub size: [u32; 2],
    /// The highest frame rate; `None` where the device does not list it.
    pub rate_hz: Option<f64>,
}

/// A rate counts as kept from this share of the one asked for on: 29.97 Hz keeps 30.
const KEPT: f64 = 0.99;

impl Offer {
    pub fn keeps(&self, rate_hz: f64) -> bool {
        self.rate_hz.is_none_or(|rate| rate >= KEPT * rate_hz)
    }

    /// What the offer keeps of the light, in words.
    pub fn says(&self, asked_hz: f64) -> String {
        let format = self.format.says();
        match self.rate_hz {
            None => format!("{format}; rate not listed"),
            Some(rate) if self.keeps(asked_hz) => format!("{format}; up to {rate:.0} Hz"),
            Some(rate) => format!("{format}; only {rate:.1} of {asked_hz:.0} Hz"),
        }
    }
}

/// Sorts offers, the best first. In this order: a rate that is kept, because a frame that is not taken carries nothing; no
/// compression, which takes from faint spots what no depth brings back; bits; all light before one colour's before a video
/// signal's; pixels; rate. The order of formats is that of the table of `oapwatch study formats`.
pub fn rank(offers: &mut [Offer], asked_hz: f64) {
    offers.sort_by_key(|offer| key(offer, asked_hz));
}

fn key(offer: &Offer, asked_hz: f64) -> impl Ord + use<> {
    let light = match offer.format.light() {
        Light::Grey => 0,
        Light::Bayer => 1,
        Light::Luma => 2,
    };
    let pixels = u64::from(offer.size[0]) * u64::from(offer.size[1]);
    let millihertz = offer.rate_hz.map_or(0, |rate| (1e3 * rate) as u64);
    (
        !offer.keeps(asked_hz),
        offer.format.is_compressed(),
        Reverse(offer.format.bits()),
        light,
        Reverse(pixels),
        Reverse(millihertz),
    )
}

/// Why the first of two ranked offers is before the second.
pub fn why(best: &Offer, next: &Offer, asked_hz: f64) -> String {
    let (a, b) = (best.format, next.format);
    let name = b.name();
    if best.keeps(asked_hz) != next.keeps(asked_hz) {
        format!("{name} does not keep {asked_hz:.0} Hz")
    } else if a.is_compressed() != b.is_compressed() {
        format!("{name} is compressed")
    } else if a.bits() != b.bits() {
        format!("{name} has {} bits", b.bits())
    } else if a.light() != b.light() {
        let less = match b.light() {
            Light::Luma => "is a video signal",
            _ => "has a colour filter",
        };
        format!("{name} {less}")
    } else if best.size != next.size {
        format!("{name} {} × {} has fewer pixels", next.size[0], next.size[1])
    } else {
        format!("{name} {} × {} has no more to give", next.size[0], next.size[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(format: PixelFormat, size: [u32; 2], rate_hz: f64) -> Offer {
        Offer {
            format,
            size,
            rate_hz: Some(rate_hz),
        }
    }

    #[test]
    fn the_order_is_that_of_information() {
        const HD: [u32; 2] = [1920, 1080];
        const VGA: [u32; 2] = [640, 480];
        let best_first = [
            offer(PixelFormat::Y12, VGA, 60.0),
            offer(PixelFormat::RG12, HD, 30.0),
            offer(PixelFormat::Y10P, HD, 30.0),
            offer(PixelFormat::GREY, HD, 30.0),
            offer(PixelFormat::RGGB, HD, 30.0),
            offer(PixelFormat::NV12, HD, 30.0),
            offer(PixelFormat::YUYV, VGA, 60.0),
            offer(PixelFormat::YUYV, VGA, 30.0),
            offer(PixelFormat::MJPG, HD, 30.0),
            offer(PixelFormat::YUYV, HD, 5.0),
        ];
        let mut ranked = best_first;
        ranked.reverse();
        rank(&mut ranked, 10.0);
        assert_eq!(ranked, best_first);
        assert_eq!(why(&ranked[0], &ranked[1], 10.0), "RG12 has a colour filter");
        assert_eq!(why(&ranked[8], &ranked[9], 10.0), "YUYV does not keep 10 Hz");
        // Asked for little enough, the slow but uncompressed image is better.
        rank(&mut ranked, 5.0);
        assert_eq!(ranked[9].format, PixelFormat::MJPG);
    }

    #[test]
    fn a_rate_that_is_not_listed_is_taken_as_kept() {
        let unlisted = Offer {
            rate_hz: None,
            ..offer(PixelFormat::GREY, [8, 8], 0.0)
        };
        assert!(unlisted.keeps(1000.0));
        assert!(offer(PixelFormat::GREY, [8, 8], 29.97).keeps(30.0));
    }
}
