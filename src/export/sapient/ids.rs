//! UUIDs and ULIDs that follow from what they stand for, so that they are the same after a restart.

use jiff::Timestamp;
use sha2::{Digest, Sha256};

/// Crockford's base 32, without I, L, O and U.
const ALPHABET: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";

fn hash(parts: &[&str]) -> [u8; 32] {
    let mut hash = Sha256::new();
    for part in parts {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().into()
}

/// A UUID of version 8 (RFC 9562, section 5.8).
pub(super) fn uuid(parts: &[&str]) -> String {
    let mut b = [0; 16];
    b.copy_from_slice(&hash(parts)[..16]);
    b[6] = b[6] & 0x0f | 0x80;
    b[8] = b[8] & 0x3f | 0x80;
    let hex = |range: std::ops::Range<usize>| b[range].iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    format!(
        "{}-{}-{}-{}-{}",
        hex(0..4),
        hex(4..6),
        hex(6..8),
        hex(8..10),
        hex(10..16)
    )
}

/// A ULID: 48 bits of milliseconds since 1970, and 80 bits that follow from `parts`.
pub(super) fn ulid(at: Timestamp, parts: &[&str]) -> String {
    let ms = u128::try_from(at.as_millisecond()).unwrap_or(0) & ((1 << 48) - 1);
    let mut low = [0; 16];
    low[6..].copy_from_slice(&hash(parts)[..10]);
    let bits = ms << 80 | u128::from_be_bytes(low);
    (0..26)
        .map(|k| char::from(ALPHABET[(bits >> (125 - 5 * k)) as usize & 31]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ulid_begins_with_its_time() {
        // The example of the ULID specification: 01ARZ3NDEK is 1469918176385 ms.
        let at = Timestamp::from_millisecond(1_469_918_176_385).unwrap();
        let ulid = super::ulid(at, &["a"]);
        assert!(ulid.starts_with("01ARYZ6S41") && ulid.len() == 26, "{ulid}");
        assert_eq!(ulid, super::ulid(at, &["a"]));
        assert_ne!(ulid, super::ulid(at, &["b"]));
        assert_ne!(super::ulid(at, &["ab", "c"]), super::ulid(at, &["a", "bc"]));
    }

    #[test]
    fn a_uuid_has_version_and_variant() {
        let uuid = uuid(&["a"]);
        let groups: Vec<usize> = uuid.split('-').map(str::len).collect();
        assert_eq!(groups, [8, 4, 4, 4, 12]);
        assert_eq!(&uuid[14..15], "8");
        assert!("89ab".contains(&uuid[19..20]));
    }
}
