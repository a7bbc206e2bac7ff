//! GeoTIFF written byte by byte.

/// A field: tag, type, and values as bytes.
pub type Field = (u16, u16, Vec<u8>);

pub fn shorts(tag: u16, values: &[u16]) -> Field {
    (tag, 3, values.iter().flat_map(|v| v.to_le_bytes()).collect())
}

pub fn longs(tag: u16, values: &[u32]) -> Field {
    (tag, 4, values.iter().flat_map(|v| v.to_le_bytes()).collect())
}

pub fn doubles(tag: u16, values: &[f64]) -> Field {
    (tag, 12, values.iter().flat_map(|v| v.to_le_bytes()).collect())
}

pub fn text(tag: u16, value: &str) -> Field {
    (tag, 2, [value.as_bytes(), b"\0"].concat())
}

/// Geo keys with short values.
pub fn keys(keys: &[(u16, u16)]) -> Field {
    let entries = keys.iter().flat_map(|(key, value)| [*key, 0, 1, *value]);
    let all: Vec<u16> = [1, 1, 0, keys.len() as u16].into_iter().chain(entries).collect();
    shorts(34735, &all)
}

/// The tie of the first pixel's corner and the size of pixels, in map coordinates.
pub fn place(west: f64, north: f64, pixel: [f64; 2]) -> [Field; 2] {
    [
        doubles(33550, &[pixel[0], pixel[1], 0.0]),
        doubles(33922, &[0.0, 0.0, 0.0, west, north, 0.0]),
    ]
}

/// How values are stored.
#[derive(Clone, Copy)]
pub enum Kind {
    I16,
    U16,
    F32,
    F64,
}

impl Kind {
    fn bytes(self, value: f64) -> Vec<u8> {
        match self {
            Self::I16 => (value as i16).to_le_bytes().to_vec(),
            Self::U16 => (value as u16).to_le_bytes().to_vec(),
            Self::F32 => (value as f32).to_le_bytes().to_vec(),
            Self::F64 => value.to_le_bytes().to_vec(),
        }
    }

    /// Bits, and the code of the format.
    fn format(self) -> (u16, u16) {
        match self {
            Self::I16 => (16, 2),
            Self::U16 => (16, 1),
            Self::F32 => (32, 3),
            Self::F64 => (64, 3),
        }
    }
}

/// One band of `size` pixels across and down, in tiles of 16 × 16 or in strips of five rows.
pub fn image(
    size: [usize; 2],
    kind: Kind,
    is_tiled: bool,
    fields: &[Field],
    value: impl Fn(usize, usize) -> f64,
) -> Vec<u8> {
    let [width, rows] = size;
    let (across, down) = if is_tiled { (16, 16) } else { (width, 5) };
    let mut chunks = Vec::new();
    for y0 in (0..rows).step_by(down) {
        for x0 in (0..width).step_by(across) {
            // Tiles are whole, the last strip is not.
            let last = if is_tiled { y0 + down } else { (y0 + down).min(rows) };
            let pixels = (y0..last).flat_map(|y| (x0..x0 + across).map(move |x| (x, y)));
            chunks.push(pixels.flat_map(|(x, y)| kind.bytes(value(x, y))).collect::<Vec<_>>());
        }
    }
    let (bits, format) = kind.format();
    let mut at = 8;
    let offsets: Vec<u32> = chunks.iter().map(|c| (at, at += c.len()).0 as u32).collect();
    let sizes: Vec<u32> = chunks.iter().map(|c| c.len() as u32).collect();
    let mut all = vec![
        longs(256, &[width as u32]),
        longs(257, &[rows as u32]),
        shorts(258, &[bits]),
        shorts(259, &[1]),
        shorts(262, &[1]),
        shorts(277, &[1]),
        shorts(339, &[format]),
    ];
    match is_tiled {
        true => all.extend([
            longs(322, &[16]),
            longs(323, &[16]),
            longs(324, &offsets),
            longs(325, &sizes),
        ]),
        false => all.extend([longs(273, &offsets), longs(278, &[5]), longs(279, &sizes)]),
    }
    all.extend_from_slice(fields);
    all.sort_by_key(|field| field.0);
    let mut file = [b"II*\0".as_slice(), &(at as u32).to_le_bytes()].concat();
    file.extend(chunks.concat());
    let mut beyond = at + 2 + 12 * all.len() + 4;
    let mut values = Vec::new();
    file.extend((all.len() as u16).to_le_bytes());
    for (tag, kind, bytes) in &all {
        let unit = [0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8][usize::from(*kind)];
        file.extend(tag.to_le_bytes());
        file.extend(kind.to_le_bytes());
        file.extend(((bytes.len() / unit) as u32).to_le_bytes());
        if bytes.len() <= 4 {
            let mut short = bytes.clone();
            short.resize(4, 0);
            file.extend(short);
        } else {
            file.extend((beyond as u32).to_le_bytes());
            beyond += bytes.len();
            values.extend_from_slice(bytes);
        }
    }
    file.extend([0; 4]);
    file.extend(values);
    file
}
