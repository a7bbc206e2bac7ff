//! SRTM tiles: one degree by one, big-endian 16-bit metres above mean sea level (EGM96), rows from the north.

use std::io::{Read, Seek, SeekFrom};

use super::error::Fault;
use super::raster::{Georeference, Projection, Raster, Vertical, Window, height};

const VOID: f64 = -32768.0;
/// Pixels along a side, of three and of one arc second: neighbouring tiles share their edges.
const SIDES: [usize; 2] = [1201, 3601];

/// A tile.
pub struct Hgt<R> {
    reader: R,
    side: usize,
    georeference: Georeference,
}

impl<R: Read + Seek> Hgt<R> {
    /// `name` is the file's, which says where the tile lies.
    pub fn open(mut reader: R, name: &str) -> Result<Self, Fault> {
        let [south_deg, west_deg] = corner(name).ok_or_else(|| {
            Fault::wrong(
                "a name such as N48E011.hgt, which says where the tile lies",
                format!("{name:?}"),
            )
        })?;
        let length = reader.seek(SeekFrom::End(0))?;
        let side = SIDES
            .into_iter()
            .find(|side| (side * side * 2) as u64 == length)
            .ok_or_else(|| {
                Fault::wrong(
                    "2884802 bytes (1201 × 1201) or 25934402 (3601 × 3601)",
                    format!("{length} bytes"),
                )
            })?;
        let step = 1.0 / (side - 1) as f64;
        let georeference = Georeference::new(
            (Projection::Geographic, Vertical::SeaLevel),
            [west_deg, south_deg + 1.0],
            ([step, 0.0], [0.0, -step]),
            [side; 2],
        );
        Ok(Self {
            reader,
            side,
            georeference: georeference.expect("steps are not zero"),
        })
    }
}

impl<R: Read + Seek> Raster for Hgt<R> {
    fn size(&self) -> [usize; 2] {
        [self.side; 2]
    }

    fn georeference(&self) -> &Georeference {
        &self.georeference
    }

    fn read(&mut self, window: Window) -> Result<Vec<f32>, Fault> {
        let ([left, top], [width, rows]) = (window.first, window.size);
        let mut heights = Vec::with_capacity(width * rows);
        let mut row = vec![0; width * 2];
        for y in top..top + rows {
            self.reader.seek(SeekFrom::Start(((y * self.side + left) * 2) as u64))?;
            self.reader.read_exact(&mut row)?;
            let values = row.as_chunks::<2>().0.iter().map(|bytes| i16::from_be_bytes(*bytes));
            heights.extend(values.map(|value| height(value.into(), Some(VOID))));
        }
        Ok(heights)
    }
}

/// Latitude and longitude of the south-west corner, degrees, of a name that begins as N48E011 does.
fn corner(name: &str) -> Option<[f64; 2]> {
    let sign = |letter: &str, plus: &str, minus: &str| match letter.to_ascii_uppercase() {
        l if l == plus => Some(1.0),
        l if l == minus => Some(-1.0),
        _ => None,
    };
    let degrees = |digits: &str, most: f64| {
        let value = digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok());
        value.flatten().filter(|degrees: &f64| *degrees <= most)
    };
    let latitude = sign(name.get(0..1)?, "N", "S")? * degrees(name.get(1..3)?, 90.0)?;
    let longitude = sign(name.get(3..4)?, "E", "W")? * degrees(name.get(4..7)?, 180.0)?;
    let is_end = name.get(7..)?.chars().next().is_none_or(|c| !c.is_ascii_alphanumeric());
    is_end.then_some([latitude, longitude])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_says_where_a_tile_lies() {
        for (name, expected) in [
            ("N48E011.hgt", Some([48.0, 11.0])),
            ("s01w180.HGT", Some([-1.0, -180.0])),
            ("N00E006.SRTMGL1.hgt", Some([0.0, 6.0])),
            ("N48E011b.hgt", None),
            ("N48E01.hgt", None),
            ("N+8E011.hgt", None),
            ("N95E011.hgt", None),
            ("dem.hgt", None),
            ("Ñ48E011.hgt", None),
        ] {
            assert_eq!(corner(name), expected, "{name}");
        }
    }
}
