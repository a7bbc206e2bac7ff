//! FNV-1a (Fowler, Noll and Vo), 64 bit: the same on every platform and in every version, for the keys of random streams.

/// Hash of some bytes.
pub fn fnv1a(bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes.into_iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    /// Test vectors of the authors (draft-eastlake-fnv).
    #[test]
    fn published_hashes_are_reproduced() {
        for (text, hash) in [
            ("", 0xcbf2_9ce4_8422_2325),
            ("a", 0xaf63_dc4c_8601_ec8c),
            ("foobar", 0x8594_4171_f739_67e8),
        ] {
            assert_eq!(super::fnv1a(text.bytes()), hash, "{text:?}");
        }
    }
}
