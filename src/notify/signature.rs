//! Standard Webhooks 1.0.0 (standard-webhooks/spec, "Signature scheme"): the signed content is
//! `{id}.{timestamp}.{body}`; `v1` is HMAC-SHA256, `v1a` ed25519; every secret signs, space delimited.

use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use ed25519_dalek::{Signer as _, SigningKey};
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// The least length that the standard asks of an HMAC secret, bytes.
const STRONG: usize = 24;

/// Why a line of a secret file is no secret. Never shows the line.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum SecretError {
    #[error("expected a secret that begins with whsec_ (HMAC-SHA256) or whsk_ (ed25519)")]
    Prefix,
    #[error("a whpk_ key is the receiver's public key; the sender needs the whsk_ key")]
    Public,
    #[error("what follows the prefix is not base64")]
    Base64,
    #[error("the secret is empty")]
    Empty,
    #[error("an ed25519 key has 32 bytes, or 64 with its public half; this one has {0}")]
    KeyLength(usize),
    #[error("the two halves of the ed25519 key do not belong together")]
    KeyPair,
    #[error("expected a secret a line, found none")]
    Missing,
}

enum Secret {
    Hmac(Vec<u8>),
    Ed25519(Box<SigningKey>),
}

/// Signs with each secret of an endpoint. Shows none of them.
pub struct Signer {
    secrets: Vec<Secret>,
}

impl std::fmt::Debug for Signer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Signer({} secrets)", self.secrets.len())
    }
}

impl Signer {
    /// Reads the lines of a secret file; empty ones and those that begin with `#` are skipped. An error comes
    /// with the line's number, from 1.
    pub fn parse(text: &str) -> Result<Self, (usize, SecretError)> {
        let mut secrets = Vec::new();
        for (k, line) in text.lines().enumerate() {
            let line = line.trim();
            if !line.is_empty() && !line.starts_with('#') {
                secrets.push(Secret::parse(line).map_err(|e| (k + 1, e))?);
            }
        }
        match secrets.is_empty() {
            true => Err((1, SecretError::Missing)),
            false => Ok(Self { secrets }),
        }
    }

    /// Whether an HMAC secret is shorter than the standard asks.
    pub fn is_weak(&self) -> bool {
        let weak = |secret: &Secret| matches!(secret, Secret::Hmac(key) if key.len() < STRONG);
        self.secrets.iter().any(weak)
    }

    /// The `webhook-signature` header.
    pub fn sign(&self, id: &str, unix_s: i64, body: &[u8]) -> String {
        let mut content = format!("{id}.{unix_s}.").into_bytes();
        content.extend_from_slice(body);
        let signatures: Vec<String> = self.secrets.iter().map(|secret| secret.sign(&content)).collect();
        signatures.join(" ")
    }
}

impl Secret {
    fn parse(text: &str) -> Result<Self, SecretError> {
        let decode = |base64: &str| BASE64.decode(base64).map_err(|_| SecretError::Base64);
        if let Some(base64) = text.strip_prefix("whsec_") {
            return match decode(base64)? {
                key if key.is_empty() => Err(SecretError::Empty),
                key => Ok(Self::Hmac(key)),
            };
        }
        if let Some(base64) = text.strip_prefix("whsk_") {
            let key = decode(base64)?;
            let key = if let Ok(seed) = <&[u8; 32]>::try_from(&key[..]) {
                SigningKey::from_bytes(seed)
            } else if let Ok(pair) = <&[u8; 64]>::try_from(&key[..]) {
                SigningKey::from_keypair_bytes(pair).map_err(|_| SecretError::KeyPair)?
            } else {
                return Err(SecretError::KeyLength(key.len()));
            };
            return Ok(Self::Ed25519(Box::new(key)));
        }
        Err(match text.starts_with("whpk_") {
            true => SecretError::Public,
            false => SecretError::Prefix,
        })
    }

    fn sign(&self, content: &[u8]) -> String {
        match self {
            Self::Hmac(key) => {
                let mut mac = Hmac::<Sha256>::new_from_slice(key).expect("HMAC takes keys of any length");
                mac.update(content);
                format!("v1,{}", BASE64.encode(mac.finalize().into_bytes()))
            }
            Self::Ed25519(key) => format!("v1a,{}", BASE64.encode(key.sign(content).to_bytes())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: &str = "msg_p5jXN8AQM9LWM0D4loKWxJek";
    const BODY: &[u8] = br#"{"test": 2432232314}"#;

    /// The vectors that the standard's own Go library is tested with (libraries/go, `TestWebhookSign` and
    /// `TestAsymmetricWebhookSign`).
    #[test]
    fn signatures_are_the_standards_own() {
        let signer = Signer::parse(
            "# both at once\nwhsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw\n\nwhsk_VEVTVFNJR05JTkdLRVlET05PVFVTRVRISVNGT1JBTlk=\n",
        )
        .unwrap();
        assert_eq!(
            signer.sign(ID, 1614265330, BODY),
            "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE= \
             v1a,tQ9V2XOqn7jL/DQenEFpqIugdBVtiMmER5mhSkXBNwM0mkATuDe6KYYUuxqtaiHeYGb7KaaBRdM5WqyeFiL8Ag=="
        );
    }

    #[test]
    fn an_ed25519_key_may_carry_its_public_half() {
        let seed = [7u8; 32];
        let pair = SigningKey::from_bytes(&seed).to_keypair_bytes();
        let short = Signer::parse(&format!("whsk_{}", BASE64.encode(seed))).unwrap();
        let long = Signer::parse(&format!("whsk_{}", BASE64.encode(pair))).unwrap();
        assert_eq!(short.sign(ID, 1, BODY), long.sign(ID, 1, BODY));
        let mut torn = pair;
        torn[40] ^= 1;
        let torn = Signer::parse(&format!("whsk_{}", BASE64.encode(torn)));
        assert_eq!(torn.unwrap_err(), (1, SecretError::KeyPair));
    }

    #[test]
    fn what_is_no_secret_is_refused_by_line_and_never_shown() {
        let cases = [
            ("", 1, SecretError::Missing),
            ("# only a comment", 1, SecretError::Missing),
            ("hunter2", 1, SecretError::Prefix),
            ("\nwhsec_", 2, SecretError::Empty),
            ("whsec_&&&&", 1, SecretError::Base64),
            ("whsk_QUJD", 1, SecretError::KeyLength(3)),
            ("whpk_QUJD", 1, SecretError::Public),
        ];
        for (text, line, error) in cases {
            assert_eq!(Signer::parse(text).unwrap_err(), (line, error), "{text:?}");
        }
        let signer = Signer::parse("whsec_aHVudGVyMg").unwrap();
        assert_eq!(format!("{signer:?}"), "Signer(1 secrets)");
        assert!(signer.is_weak());
    }
}
