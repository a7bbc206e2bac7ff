//! Signed MAVLink frames (mavlink.io, "Message Signing"): who holds the key wrote them, and none is taken twice.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

use super::frame::{Frame, SIGNATURE};
use super::refusal::Refusal;

/// Seconds from 1970 to the beginning of the signatures' clock, 2015-01-01.
const EPOCH_S: u64 = 1_420_070_400;
/// The clock's steps in a second.
const STEPS: u64 = 100_000;
/// A first frame this much older than now is taken for a recorded one, s: the protocol's own figure.
const OLDEST_S: u64 = 60;
/// The link id of what we send.
const LINK: u8 = 0;

/// Why a key file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: expected a key of 32 bytes, or of 64 hexadecimal digits, found {found} bytes of another kind")]
    Malformed { path: PathBuf, found: usize },
}

/// Checks and writes signatures.
pub struct Signing {
    key: [u8; 32],
    /// The last time stamp of each system, component and link. Only whoever holds the key adds to it.
    last: HashMap<[u8; 3], u64>,
    sent: u64,
}

impl Signing {
    pub fn new(key: [u8; 32]) -> Self {
        Self {
            key,
            last: HashMap::new(),
            sent: 0,
        }
    }

    /// Reads a key: 32 bytes as they are, or 64 hexadecimal digits.
    pub fn from_file(path: &Path) -> Result<Self, KeyError> {
        let bytes = std::fs::read(path).map_err(|source| KeyError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let key = <[u8; 32]>::try_from(&bytes[..])
            .ok()
            .or_else(|| from_hex(bytes.trim_ascii()));
        key.map(Self::new).ok_or_else(|| KeyError::Malformed {
            path: path.to_owned(),
            found: bytes.len(),
        })
    }

    /// Refuses a frame without a signature, with a wrong one, or that is not later than the last of its link. `unix_us` is now.
    pub fn check(&mut self, frame: &Frame, unix_us: u64) -> Result<(), Refusal> {
        let (message, signature) = frame.signed.ok_or(Refusal::Unsigned)?;
        let (stamped, found) = signature.split_at(7);
        if !bool::from(self.signature(message, stamped).ct_eq(found)) {
            return Err(Refusal::Signature);
        }
        let time = stamped[1..]
            .iter()
            .rev()
            .fold(0, |sum, byte| sum << 8 | u64::from(*byte));
        let link = [frame.system, frame.component, stamped[0]];
        let earliest = match self.last.get(&link) {
            Some(last) => last + 1,
            None => steps(unix_us).saturating_sub(OLDEST_S * STEPS),
        };
        if time < earliest {
            return Err(Refusal::Replayed);
        }
        self.last.insert(link, time);
        Ok(())
    }

    /// Puts a signature behind a frame that was built for one.
    pub fn sign(&mut self, frame: &mut Vec<u8>, unix_us: u64) {
        self.sent = steps(unix_us).max(self.sent + 1);
        let mut stamped = [LINK; 7];
        stamped[1..].copy_from_slice(&self.sent.to_le_bytes()[..6]);
        let signature = self.signature(frame, &stamped);
        frame.extend_from_slice(&stamped);
        frame.extend_from_slice(&signature);
    }

    /// The first 48 bits of SHA-256 over key, frame, link id and time stamp.
    fn signature(&self, message: &[u8], stamped: &[u8]) -> [u8; SIGNATURE - 7] {
        let hash = Sha256::new()
            .chain_update(self.key)
            .chain_update(message)
            .chain_update(stamped);
        let hash = hash.finalize();
        std::array::from_fn(|k| hash[k])
    }
}

fn steps(unix_us: u64) -> u64 {
    (unix_us / (1_000_000 / STEPS)).saturating_sub(EPOCH_S * STEPS)
}

fn from_hex(text: &[u8]) -> Option<[u8; 32]> {
    let digits: &[u8; 64] = text.try_into().ok()?;
    let digit = |k: usize| char::from(digits[k]).to_digit(16);
    let mut key = [0; 32];
    for (k, byte) in key.iter_mut().enumerate() {
        *byte = (digit(2 * k)? << 4 | digit(2 * k + 1)?) as u8;
    }
    Some(key)
}

#[cfg(test)]
mod tests {
    use super::super::frame::{Found, Kind, build, read};
    use super::*;

    const NOW_US: u64 = 1_780_000_000_000_000;

    fn check(signing: &mut Signing, bytes: &[u8], unix_us: u64) -> Result<(), Refusal> {
        match read(bytes).1 {
            Found::Frame(frame) => signing.check(&frame, unix_us),
            other => panic!("{other:?}"),
        }
    }

    fn signed(signing: &mut Signing, unix_us: u64) -> Vec<u8> {
        let mut frame = build(Kind::Heartbeat, [1, 1], 0, &[1; 9], true);
        signing.sign(&mut frame, unix_us);
        frame
    }

    #[test]
    fn a_signed_frame_is_taken_once_and_only_with_the_key() {
        let mut sender = Signing::new([7; 32]);
        let mut receiver = Signing::new([7; 32]);
        let first = signed(&mut sender, NOW_US);
        let second = signed(&mut sender, NOW_US);
        assert_eq!(check(&mut receiver, &first, NOW_US), Ok(()));
        assert_eq!(check(&mut receiver, &first, NOW_US), Err(Refusal::Replayed));
        assert_eq!(check(&mut receiver, &second, NOW_US), Ok(()));
        assert_eq!(check(&mut receiver, &first, NOW_US), Err(Refusal::Replayed));
        assert_eq!(
            check(&mut Signing::new([8; 32]), &second, NOW_US),
            Err(Refusal::Signature)
        );
        let plain = build(Kind::Heartbeat, [1, 1], 0, &[1; 9], false);
        assert_eq!(check(&mut receiver, &plain, NOW_US), Err(Refusal::Unsigned));
    }

    #[test]
    fn a_recording_of_yesterday_is_refused_by_who_starts_today() {
        let old = signed(&mut Signing::new([7; 32]), NOW_US - 86_400_000_000);
        assert_eq!(check(&mut Signing::new([7; 32]), &old, NOW_US), Err(Refusal::Replayed));
    }
}
