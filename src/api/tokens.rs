//! Bearer tokens (RFC 6750): several, named or not, read-only or full, from files that may change while the daemon runs.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arc_swap::ArcSwap;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use tokio::sync::watch;

use super::config::Config;
use crate::small_file;

/// A shorter token can be guessed within the request limit; it is refused.
const SHORTEST_TOKEN: usize = 6;
/// A shorter token is weak; the log says so.
const STRONG_TOKEN: usize = 16;
const LONGEST_NAME: usize = 64;

/// What a token allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Access {
    Read,
    Full,
}

/// Why the tokens cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    #[error("api.{field}: {path}: {source}")]
    Unreadable {
        field: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    #[error("api.{field}: {path}: expected a token on a line, found none")]
    Empty { field: &'static str, path: PathBuf },
    #[error(
        "api.{field}: {path}: line {line}: expected a token of at least {SHORTEST_TOKEN} characters, found {found}"
    )]
    Short {
        field: &'static str,
        path: PathBuf,
        line: usize,
        found: usize,
    },
}

/// One token. Only digests are kept, so that no comparison and no dump shows a token.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Token {
    digest: [u8; 32],
    /// Of a line `name:token`, the whole line: a plain token may hold a colon.
    line_digest: Option<[u8; 32]>,
    pub name: Option<Arc<str>>,
    pub access: Access,
    is_weak: bool,
}

/// A file of tokens and what was read from it last.
#[derive(Clone, Debug)]
struct TokenFile {
    field: &'static str,
    path: PathBuf,
    access: Access,
    tokens: Vec<Token>,
}

/// The tokens in force.
pub struct Tokens {
    files: ArcSwap<Vec<TokenFile>>,
    /// Counts changes, for streams to ask again whether their token is still in force.
    changes: watch::Sender<u64>,
}

/// That a request's token is in force, for as long as it is.
#[derive(Clone)]
pub struct Session(pub(super) Option<(Arc<Tokens>, [u8; 32])>);

pub(super) fn digest(token: &[u8]) -> [u8; 32] {
    Sha256::digest(token).into()
}

/// The name and the token of a line.
fn split_name(line: &str) -> (Option<&str>, &str) {
    let is_name = |name: &str| {
        (1..=LONGEST_NAME).contains(&name.len())
            && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"_-.@".contains(&b))
    };
    match line.split_once(':') {
        Some((name, token)) if is_name(name) => (Some(name), token.trim()),
        _ => (None, line),
    }
}

impl TokenFile {
    /// Tokens of the file's lines, and the lines that hold none, with the reason.
    fn parse(&self, text: &str) -> (Vec<Token>, Vec<TokenError>) {
        let (mut tokens, mut wrong) = (Vec::new(), Vec::new());
        for (k, line) in text.lines().map(str::trim).enumerate() {
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let (name, token) = split_name(line);
            if token.len() < SHORTEST_TOKEN {
                wrong.push(TokenError::Short {
                    field: self.field,
                    path: self.path.clone(),
                    line: k + 1,
                    found: token.len(),
                });
                continue;
            }
            tokens.push(Token {
                is_weak: token.len() < STRONG_TOKEN,
                digest: digest(token.as_bytes()),
                line_digest: name.map(|_| digest(line.as_bytes())),
                name: name.map(Arc::from),
                access: self.access,
            });
        }
        (tokens, wrong)
    }

    /// At the start a file must be there and every line must be right.
    fn load(&mut self) -> Result<(), TokenError> {
        let text = small_file::read(&self.path).map_err(|source| TokenError::Unreadable {
            field: self.field,
            path: self.path.clone(),
            source,
        })?;
        let (tokens, wrong) = self.parse(&text);
        if let Some(first) = wrong.into_iter().next() {
            return Err(first);
        }
        if tokens.is_empty() {
            return Err(TokenError::Empty {
                field: self.field,
                path: self.path.clone(),
            });
        }
        self.replace(tokens);
        Ok(())
    }

    fn replace(&mut self, tokens: Vec<Token>) {
        if tokens == self.tokens {
            return;
        }
        let weak = tokens.iter().filter(|token| token.is_weak).count();
        if weak > 0 {
            tracing::warn!(
                path = %self.path.display(),
                weak,
                "tokens of fewer than {STRONG_TOKEN} characters are weak; `openssl rand -hex 32` makes a strong one"
            );
        }
        self.tokens = tokens;
    }

    /// Later a file that is gone or empty has no tokens, and a wrong line is passed over: what was taken out of the file must
    /// not stay in force. Only a file that cannot be read for another reason keeps its tokens.
    fn reload(&mut self) -> Vec<TokenError> {
        let (field, path) = (self.field, self.path.clone());
        let unreadable = |source| TokenError::Unreadable { field, path, source };
        match small_file::read(&self.path) {
            Ok(text) => {
                let (tokens, wrong) = self.parse(&text);
                self.replace(tokens);
                wrong
            }
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                let gone = unreadable(error);
                self.tokens.clear();
                vec![gone]
            }
            Err(error) => vec![unreadable(error)],
        }
    }
}

/// Warns of a secret that other users of the machine can read.
pub(super) fn warn_of_readers(path: &Path) {
    use std::os::unix::fs::PermissionsExt;
    let Ok(meta) = std::fs::metadata(path) else { return };
    let mode = meta.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        tracing::warn!(
            "{}: mode {mode:03o} lets other users read this secret; 600 is right",
            path.display()
        );
    }
}

impl Tokens {
    /// Reads the token files that the config names.
    pub fn load(config: &Config) -> Result<Self, TokenError> {
        let named = [
            ("token_file", &config.token_file, Access::Full),
            ("read_token_file", &config.read_token_file, Access::Read),
        ];
        let mut files = Vec::new();
        for (field, path, access) in named {
            let Some(path) = path.clone() else { continue };
            let tokens = Vec::new();
            let mut file = TokenFile {
                field,
                path,
                access,
                tokens,
            };
            file.load()?;
            warn_of_readers(&file.path);
            files.push(file);
        }
        Ok(Self {
            files: ArcSwap::from_pointee(files),
            changes: watch::Sender::new(0),
        })
    }

    /// Reads the files again. Gives whether the tokens changed, and what is wrong with the files.
    pub fn reload(&self) -> (bool, Vec<TokenError>) {
        let before = self.files.load();
        let mut files = (**before).clone();
        let wrong = files.iter_mut().flat_map(TokenFile::reload).collect();
        let has_changed = files
            .iter()
            .zip(before.iter())
            .any(|(new, old)| new.tokens != old.tokens);
        if has_changed {
            self.files.store(Arc::new(files));
            self.changes.send_modify(|n| *n += 1);
        }
        (has_changed, wrong)
    }

    /// Whether a token is asked for at all; true also when all have been revoked.
    pub fn required(&self) -> bool {
        !self.files.load().is_empty()
    }

    /// The token with this digest. Takes the same time whichever token is wrong, and wherever.
    pub(super) fn find(&self, given: &[u8; 32]) -> Option<Token> {
        let mut best: Option<Token> = None;
        for token in self.files.load().iter().flat_map(|file| &file.tokens) {
            let is_line = token.line_digest.is_some_and(|line| bool::from(given.ct_eq(&line)));
            let is_token = bool::from(given.ct_eq(&token.digest));
            if (is_line || is_token) && best.as_ref().is_none_or(|b| b.access < token.access) {
                best = Some(token.clone());
            }
        }
        best
    }
}

impl Session {
    /// Completes when the token is revoked; never where none is asked for.
    pub async fn revoked(&self) {
        let Some((tokens, digest)) = &self.0 else {
            return std::future::pending().await;
        };
        let mut changes = tokens.changes.subscribe();
        // The sender lives in `tokens`.
        let _ = changes.wait_for(|_| tokens.find(digest).is_none()).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_stands_before_a_colon_and_plain_tokens_may_hold_one() {
        for (line, expected) in [
            ("s3cret-token", (None, "s3cret-token")),
            ("anna:s3cret-token", (Some("anna"), "s3cret-token")),
            ("ops.b@example.org: s3cret", (Some("ops.b@example.org"), "s3cret")),
            ("two words:s3cret", (None, "two words:s3cret")),
            (":s3cret", (None, ":s3cret")),
            ("a:b:c", (Some("a"), "b:c")),
        ] {
            assert_eq!(split_name(line), expected, "{line}");
        }
    }

    /// Collects what is logged.
    #[derive(Clone, Default)]
    struct Log(Arc<std::sync::Mutex<Vec<u8>>>);

    impl io::Write for Log {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().expect("no panic").extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn logged(act: impl FnOnce()) -> String {
        let log = Log::default();
        let writer = log.clone();
        let subscriber = tracing_subscriber::fmt().with_writer(move || writer.clone()).finish();
        tracing::subscriber::with_default(subscriber, act);
        let bytes = log.0.lock().expect("no panic").clone();
        String::from_utf8(bytes).expect("text")
    }

    #[test]
    fn a_key_that_others_can_read_is_warned_of() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().expect("a folder");
        let tls = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/api/tls/first");
        let key = dir.path().join("key.pem");
        std::fs::copy(format!("{tls}.key.pem"), &key).expect("the key");
        let config = Config {
            tls_cert_file: Some(format!("{tls}.cert.pem").into()),
            tls_key_file: Some(key.clone()),
            ..Config::default()
        };
        for (mode, expected) in [(0o600, false), (0o640, true), (0o604, true)] {
            std::fs::set_permissions(&key, std::fs::Permissions::from_mode(mode)).expect("its owner");
            let log = logged(|| drop(crate::api::Server::new(config.clone()).expect("a server")));
            let is_warned = log.contains("key.pem") && log.contains("lets other users read");
            assert_eq!(is_warned, expected, "{mode:o}: {log}");
        }
    }
}
