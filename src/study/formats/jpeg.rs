//! A grey baseline JPEG image (ITU-T T.81), as cameras compress: what motion JPEG costs is measured with it.

use crate::frames::v4l2::{HuffmanTable, USUAL_HUFFMAN_TABLES, usual_tables};

const BLOCK: usize = 8;
/// ITU-T T.81, table K.1: steps of brightness at quality 50.
const STEPS: [u16; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51,
    87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
];

/// Places of a block's coefficients in the order of the file (figure A.6).
fn zigzag() -> [usize; 64] {
    let mut places: [usize; 64] = std::array::from_fn(|k| k);
    places.sort_by_key(|k| {
        let (row, column) = (k / BLOCK, k % BLOCK);
        let diagonal = row + column;
        (diagonal, if diagonal % 2 == 0 { column } else { row })
    });
    places
}

/// Steps at a quality from 1 to 100, by the scale of the Independent JPEG Group.
fn steps(quality: u16) -> [u16; 64] {
    let scale = if quality < 50 {
        5000 / quality
    } else {
        200 - 2 * quality
    };
    STEPS.map(|s| ((s * scale + 50) / 100).clamp(1, 255))
}

/// Compresses an image of `width` × `height`, row by row. Blocks at the edge repeat the last pixels.
pub fn compress(pixels: &[u8], width: usize, height: usize, quality: u16) -> Vec<u8> {
    let (steps, zigzag) = (steps(quality), zigzag());
    let mut file = vec![0xff, 0xd8, 0xff, 0xdb, 0, 67, 0];
    file.extend(zigzag.map(|k| steps[k] as u8));
    let [w1, w0] = (width as u16).to_be_bytes();
    let [h1, h0] = (height as u16).to_be_bytes();
    file.extend([0xff, 0xc0, 0, 11, 8, h1, h0, w1, w0, 1, 1, 0x11, 0]);
    file.extend(usual_tables());
    file.extend([0xff, 0xda, 0, 8, 1, 1, 0x00, 0, 63, 0]);
    let cosine: [[f64; BLOCK]; BLOCK] = std::array::from_fn(|u| {
        let norm = if u == 0 { 0.125f64.sqrt() } else { 0.5 };
        std::array::from_fn(|x| norm * (std::f64::consts::PI * (2 * x + 1) as f64 * u as f64 / 16.0).cos())
    });
    let (means, others) = (Codes::of(&USUAL_HUFFMAN_TABLES[0]), Codes::of(&USUAL_HUFFMAN_TABLES[2]));
    let mut bits = Bits::default();
    let mut last = 0;
    for y0 in (0..height).step_by(BLOCK) {
        for x0 in (0..width).step_by(BLOCK) {
            let at = |y: usize, x: usize| pixels[(y0 + y).min(height - 1) * width + (x0 + x).min(width - 1)];
            // Along x, then along y (A.3.3).
            let half: [[f64; BLOCK]; BLOCK] = std::array::from_fn(|y| {
                std::array::from_fn(|u| (0..BLOCK).map(|x| cosine[u][x] * (f64::from(at(y, x)) - 128.0)).sum())
            });
            let whole = |v: usize, u: usize| -> f64 { (0..BLOCK).map(|y| cosine[v][y] * half[y][u]).sum() };
            let rounded = zigzag.map(|k| (whole(k / BLOCK, k % BLOCK) / f64::from(steps[k])).round() as i32);
            bits.block(&rounded, &mut last, &means, &others);
        }
    }
    file.extend(bits.finish());
    file.extend([0xff, 0xd9]);
    file
}

/// Code and length of each value of a table (annex C).
struct Codes([(u16, u32); 256]);

impl Codes {
    fn of(table: &HuffmanTable) -> Self {
        let mut codes = [(0, 0); 256];
        let (mut code, mut next) = (0u16, 0);
        for (length, count) in (1..).zip(table.lengths) {
            for _ in 0..count {
                codes[usize::from(table.values[next])] = (code, length);
                code += 1;
                next += 1;
            }
            code <<= 1;
        }
        Self(codes)
    }
}

#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    word: u32,
    held: u32,
}

impl Bits {
    fn put(&mut self, (code, length): (u16, u32)) {
        for k in (0..length).rev() {
            self.word = self.word << 1 | u32::from(code >> k & 1);
            self.held += 1;
            if self.held == 8 {
                self.bytes.push(self.word as u8);
                if self.word as u8 == 0xff {
                    self.bytes.push(0);
                }
                (self.word, self.held) = (0, 0);
            }
        }
    }

    /// A number in as many bits as it takes (F.1.2.1); gives their number.
    fn amplitude(value: i32) -> (u16, u32) {
        let size = 32 - value.unsigned_abs().leading_zeros();
        let bits = if value < 0 { value - 1 } else { value };
        (bits as u16, size)
    }

    fn block(&mut self, coefficients: &[i32; 64], last: &mut i32, means: &Codes, others: &Codes) {
        let difference = Self::amplitude(coefficients[0] - std::mem::replace(last, coefficients[0]));
        self.put(means.0[difference.1 as usize]);
        self.put(difference);
        let mut zeros = 0;
        for value in &coefficients[1..] {
            if *value == 0 {
                zeros += 1;
                continue;
            }
            while zeros > 15 {
                self.put(others.0[0xf0]);
                zeros -= 16;
            }
            let amplitude = Self::amplitude(*value);
            self.put(others.0[zeros << 4 | amplitude.1 as usize]);
            self.put(amplitude);
            zeros = 0;
        }
        if zeros > 0 {
            self.put(others.0[0]);
        }
    }

    fn finish(mut self) -> Vec<u8> {
        while self.held != 0 {
            self.put((1, 1));
        }
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::v4l2::{Decoding, Granted, Layout, PixelFormat};

    #[test]
    fn what_is_compressed_finely_is_read_again() {
        let (width, height) = (37, 29);
        let pixels: Vec<u8> = (0..width * height)
            .map(|k| {
                let (x, y) = ((k % width) as f64, (k / width) as f64);
                (20.0 + 200.0 * (-((x - 17.3).powi(2) + (y - 11.0).powi(2)) / 18.0).exp()) as u8
            })
            .collect();
        let granted = Granted {
            format: PixelFormat::MJPG,
            width,
            height,
            stride: 0,
        };
        let decoding = Decoding {
            shape: (height, width),
            ..Decoding::default()
        };
        let layout = Layout::new(granted, &decoding).unwrap();
        let errs = |quality| {
            let file = compress(&pixels, width, height, quality);
            let found = layout.decode(&file).unwrap().counts;
            let most = found.iter().zip(&pixels).map(|(a, b)| (a - f64::from(*b)).abs());
            (most.fold(0.0, f64::max), file.len())
        };
        let (fine, coarse) = (errs(100), errs(50));
        assert!(fine.0 <= 2.0, "{fine:?}");
        assert!(coarse.1 < fine.1 && coarse.0 > fine.0 && coarse.0 < 40.0, "{coarse:?}");
    }
}
