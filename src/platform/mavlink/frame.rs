//! MAVLink frames of versions 1 and 2: found in bytes, checked and built (mavlink.io, "Packet Serialization").

use super::refusal::Refusal;

const MAGIC_V1: u8 = 0xfe;
const MAGIC_V2: u8 = 0xfd;
const HEADER_V1: usize = 6;
const HEADER_V2: usize = 10;
const CHECKSUM: usize = 2;
/// Link id, time stamp and signature behind a signed frame.
pub const SIGNATURE: usize = 13;
/// The only incompatibility flag there is. A frame with another must not be read.
const FLAG_SIGNED: u8 = 1;
/// The longest frame there can be.
pub const LONGEST: usize = HEADER_V2 + 255 + CHECKSUM + SIGNATURE;

/// The messages that are read or sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Heartbeat,
    GpsRawInt,
    AttitudeQuaternion,
    GlobalPositionInt,
    GpsGlobalOrigin,
    CommandLong,
    Timesync,
    Odometry,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Heartbeat,
        Self::GpsRawInt,
        Self::AttitudeQuaternion,
        Self::GlobalPositionInt,
        Self::GpsGlobalOrigin,
        Self::CommandLong,
        Self::Timesync,
        Self::Odometry,
    ];

    /// Message id, CRC_EXTRA and length without extension fields, as the dialect `common` defines them.
    pub const fn definition(self) -> (u32, u8, usize) {
        match self {
            Self::Heartbeat => (0, 50, 9),
            Self::GpsRawInt => (24, 24, 30),
            Self::AttitudeQuaternion => (31, 246, 32),
            Self::GlobalPositionInt => (33, 104, 28),
            Self::GpsGlobalOrigin => (49, 39, 12),
            Self::CommandLong => (76, 152, 33),
            Self::Timesync => (111, 34, 16),
            Self::Odometry => (331, 91, 230),
        }
    }

    fn of(id: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.definition().0 == id)
    }
}

/// A frame whose checksum is right.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    pub system: u8,
    pub component: u8,
    pub kind: Kind,
    pub payload: Payload<'a>,
    /// The frame up to its checksum, magic byte included, and the 13 bytes behind it, where it is signed.
    pub signed: Option<(&'a [u8], &'a [u8; SIGNATURE])>,
}

/// Little-endian fields. What a version 2 frame leaves out at the end is zero.
#[derive(Clone, Copy, Debug)]
pub struct Payload<'a>(pub &'a [u8]);

impl Payload<'_> {
    fn bytes<const N: usize>(&self, at: usize) -> [u8; N] {
        std::array::from_fn(|k| self.0.get(at + k).copied().unwrap_or(0))
    }

    pub fn u8(&self, at: usize) -> u8 {
        self.bytes::<1>(at)[0]
    }

    pub fn i16(&self, at: usize) -> i16 {
        i16::from_le_bytes(self.bytes(at))
    }

    pub fn u32(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.bytes(at))
    }

    pub fn i32(&self, at: usize) -> i32 {
        i32::from_le_bytes(self.bytes(at))
    }

    pub fn u64(&self, at: usize) -> u64 {
        u64::from_le_bytes(self.bytes(at))
    }

    pub fn i64(&self, at: usize) -> i64 {
        i64::from_le_bytes(self.bytes(at))
    }

    pub fn f32(&self, at: usize) -> f64 {
        f32::from_le_bytes(self.bytes(at)).into()
    }

    pub fn floats<const N: usize>(&self, at: usize) -> [f64; N] {
        std::array::from_fn(|k| self.f32(at + 4 * k))
    }
}

/// What the beginning of some bytes is.
#[derive(Debug)]
pub enum Found<'a> {
    Frame(Frame<'a>),
    /// A frame of a message that is not read. Its checksum cannot be checked.
    Unread,
    Refused(Refusal),
    /// A frame of which more bytes are to come.
    Incomplete,
}

/// Reads what `bytes` begin with, and says how many of them it takes up (none where it is incomplete).
///
/// After a frame that cannot be used the search goes on one byte later: what looked like a frame may have been noise with a
/// frame in it.
pub fn read(bytes: &[u8]) -> (usize, Found<'_>) {
    let noise = |count| (count, Found::Refused(Refusal::Malformed));
    let Some(&magic) = bytes.first() else {
        return (0, Found::Incomplete);
    };
    if magic != MAGIC_V1 && magic != MAGIC_V2 {
        let next = bytes.iter().position(|b| *b == MAGIC_V1 || *b == MAGIC_V2);
        return noise(next.unwrap_or(bytes.len()));
    }
    let is_v2 = magic == MAGIC_V2;
    let header = if is_v2 { HEADER_V2 } else { HEADER_V1 };
    let Some(head) = bytes.get(..header) else {
        return (0, Found::Incomplete);
    };
    let is_signed = is_v2 && head[2] & FLAG_SIGNED != 0;
    if is_v2 && head[2] & !FLAG_SIGNED != 0 {
        return noise(1);
    }
    let body = header + usize::from(head[1]);
    let end = body + CHECKSUM + if is_signed { SIGNATURE } else { 0 };
    let Some(whole) = bytes.get(..end) else {
        return (0, Found::Incomplete);
    };
    let (system, component, id) = match is_v2 {
        true => (head[5], head[6], u32::from_le_bytes([head[7], head[8], head[9], 0])),
        false => (head[3], head[4], head[5].into()),
    };
    let Some(kind) = Kind::of(id) else {
        // Where no frame follows, this was hardly one.
        let is_followed = bytes.get(end).is_none_or(|b| *b == MAGIC_V1 || *b == MAGIC_V2);
        return if is_followed { (end, Found::Unread) } else { noise(1) };
    };
    let (_, extra, length) = kind.definition();
    let found = u16::from_le_bytes([whole[body], whole[body + 1]]);
    if checksum(&whole[1..body], extra) != found {
        return (1, Found::Refused(Refusal::Checksum));
    }
    // Version 1 has no extensions and leaves nothing out.
    if !is_v2 && body - header != length {
        return (end, Found::Refused(Refusal::Malformed));
    }
    let (message, rest) = whole.split_at(body + CHECKSUM);
    let frame = Frame {
        system,
        component,
        kind,
        payload: Payload(&whole[header..body]),
        signed: rest
            .first_chunk()
            .filter(|_| is_signed)
            .map(|signature| (message, signature)),
    };
    (end, Found::Frame(frame))
}

/// Builds an unsigned version 2 frame. `is_signed` sets the flag; the signature itself is to be put behind it.
pub fn build(kind: Kind, [system, component]: [u8; 2], sequence: u8, payload: &[u8], is_signed: bool) -> Vec<u8> {
    // Zeros at the end are left out, but not the first byte.
    let length = payload.iter().rposition(|b| *b != 0).map_or(1, |last| last + 1);
    let payload = &payload[..length.min(payload.len())];
    let (id, extra, _) = kind.definition();
    let id = id.to_le_bytes();
    let flags = if is_signed { FLAG_SIGNED } else { 0 };
    let mut frame = vec![
        MAGIC_V2,
        payload.len() as u8,
        flags,
        0,
        sequence,
        system,
        component,
        id[0],
        id[1],
        id[2],
    ];
    frame.extend_from_slice(payload);
    let check = checksum(&frame[1..], extra);
    frame.extend_from_slice(&check.to_le_bytes());
    frame
}

/// CRC-16/MCRF4XX over the frame without its magic byte, and over CRC_EXTRA, which stands for the message's definition.
fn checksum(bytes: &[u8], extra: u8) -> u16 {
    bytes.iter().chain([&extra]).fold(0xffff, |crc: u16, byte| {
        let mut low = byte ^ crc as u8;
        low ^= low << 4;
        let wide = u16::from(low);
        (crc >> 8) ^ (wide << 8) ^ (wide << 3) ^ (wide >> 4)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_the_catalogue() {
        // The check value of CRC-16/MCRF4XX is 0x6f91 for "123456789" (the catalogue of parametrised CRC algorithms).
        assert_eq!(checksum(b"12345678", b'9'), 0x6f91);
    }

    #[test]
    fn what_is_built_is_read() {
        let frame = build(
            Kind::Timesync,
            [7, 1],
            3,
            &[0, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0],
            false,
        );
        assert_eq!(frame.len(), HEADER_V2 + 9 + CHECKSUM, "zeros at the end are left out");
        let (length, Found::Frame(read)) = read(&frame) else {
            panic!("a frame");
        };
        assert_eq!(
            (length, read.system, read.component, read.kind),
            (frame.len(), 7, 1, Kind::Timesync)
        );
        assert_eq!((read.payload.i64(0), read.payload.i64(8)), (0, 5));
    }

    #[test]
    fn a_frame_in_noise_is_found_and_a_cut_one_is_waited_for() {
        let frame = build(Kind::Heartbeat, [1, 1], 0, &[1; 9], false);
        let noisy = [&[0x00, 0x55, MAGIC_V2, 0x01][..], &frame].concat();
        let mut rest = &noisy[..];
        let mut frames = 0;
        while let (count @ 1.., found) = read(rest) {
            frames += usize::from(matches!(found, Found::Frame(_)));
            rest = &rest[count..];
        }
        assert_eq!(frames, 1);
        for cut in 1..frame.len() {
            assert!(matches!(read(&frame[..cut]), (0, Found::Incomplete)), "{cut}");
        }
    }

    #[test]
    fn every_flipped_bit_of_a_heartbeat_is_noticed() {
        let frame = build(Kind::Heartbeat, [1, 1], 0, &[1, 2, 3, 4, 5, 6, 7, 8, 9], false);
        for bit in 0..frame.len() * 8 {
            let mut wrong = frame.clone();
            wrong[bit / 8] ^= 1 << (bit % 8);
            assert!(!matches!(read(&wrong).1, Found::Frame(_)), "bit {bit}");
        }
    }
}
