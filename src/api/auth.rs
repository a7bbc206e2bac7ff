//! Bearer tokens (RFC 6750): several, read-only or full, from files that may change while the daemon runs.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arc_swap::ArcSwap;
use axum::extract::{Request, State as Shared};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

use super::config::Config;
use super::problem::Problem;
use crate::metric;

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
        source: std::io::Error,
    },
    #[error("api.{field}: {path}: expected a token on a line, found none")]
    Empty { field: &'static str, path: PathBuf },
}

/// The tokens in force. Only digests are kept, so that no comparison and no dump shows a token.
pub struct Tokens {
    files: Vec<(&'static str, PathBuf, Access)>,
    current: ArcSwap<Vec<([u8; 32], Access)>>,
}

fn digest(token: &[u8]) -> [u8; 32] {
    Sha256::digest(token).into()
}

fn read(files: &[(&'static str, PathBuf, Access)]) -> Result<Vec<([u8; 32], Access)>, TokenError> {
    let mut all = Vec::new();
    for (field, path, access) in files {
        let text = std::fs::read_to_string(path).map_err(|source| TokenError::Unreadable {
            field,
            path: path.clone(),
            source,
        })?;
        let lines = text
            .lines()
            .map(str::trim)
            .filter(|l| !l.is_empty() && !l.starts_with('#'));
        let before = all.len();
        all.extend(lines.map(|token| (digest(token.as_bytes()), *access)));
        if all.len() == before {
            return Err(TokenError::Empty {
                field,
                path: path.clone(),
            });
        }
    }
    Ok(all)
}

/// Warns of a secret that other users of the machine can read.
fn warn_of_readers(path: &Path) {
    use std::os::unix::fs::PermissionsExt;
    let Ok(meta) = std::fs::metadata(path) else { return };
    let mode = meta.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        tracing::warn!(
            "{}: mode {mode:03o} lets others read this secret; 600 is right",
            path.display()
        );
    }
}

impl Tokens {
    pub fn load(config: &Config) -> Result<Self, TokenError> {
        let mut files = Vec::new();
        if let Some(path) = &config.token_file {
            files.push(("token_file", path.clone(), Access::Full));
        }
        if let Some(path) = &config.read_token_file {
            files.push(("read_token_file", path.clone(), Access::Read));
        }
        let current = read(&files)?;
        for (_, path, _) in &files {
            warn_of_readers(path);
        }
        Ok(Self {
            files,
            current: ArcSwap::from_pointee(current),
        })
    }

    /// Reads the files again; on an error the tokens in force stay in force. Returns whether they changed.
    pub fn reload(&self) -> Result<bool, TokenError> {
        let fresh = read(&self.files)?;
        let changed = **self.current.load() != fresh;
        if changed {
            self.current.store(Arc::new(fresh));
        }
        Ok(changed)
    }

    /// Whether a token is asked for at all.
    pub fn required(&self) -> bool {
        !self.files.is_empty()
    }

    /// What `token` allows. Takes the same time whichever token is wrong, and wherever.
    fn access(&self, token: &[u8]) -> Option<Access> {
        let given = digest(token);
        let mut best = None;
        for (known, access) in self.current.load().iter() {
            if bool::from(given.ct_eq(known)) {
                best = best.max(Some(*access));
            }
        }
        best
    }
}

/// The token of a request: from the header, or from the subprotocols that a browser's WebSocket offers.
fn presented(headers: &HeaderMap, websocket: bool) -> Option<Vec<u8>> {
    if let Some(value) = headers.get(header::AUTHORIZATION) {
        let (scheme, token) = value.to_str().ok()?.split_once(' ')?;
        return scheme
            .eq_ignore_ascii_case("bearer")
            .then(|| token.trim().as_bytes().to_owned());
    }
    if !websocket {
        return None;
    }
    headers
        .get_all(header::SEC_WEBSOCKET_PROTOCOL)
        .iter()
        .filter_map(|v| v.to_str().ok())
        .flat_map(|v| v.split(','))
        .find_map(|p| BASE64_URL_SAFE_NO_PAD.decode(p.trim().strip_prefix("bearer.")?).ok())
}

/// Lets through who may do what they ask.
pub async fn check(Shared(tokens): Shared<Arc<Tokens>>, request: Request, next: Next) -> Response {
    let path = request.uri().path();
    let guarded = path.starts_with("/v1/") || path == "/metrics";
    if !tokens.required() || !guarded {
        return next.run(request).await;
    }
    let presented = presented(request.headers(), path == "/v1/stream");
    let access = presented.as_deref().and_then(|token| tokens.access(token));
    let reads = [Method::GET, Method::HEAD].contains(request.method());
    let (status, challenge, detail) = match access {
        Some(Access::Full) => return next.run(request).await,
        Some(Access::Read) if reads => return next.run(request).await,
        Some(Access::Read) => (
            StatusCode::FORBIDDEN,
            r#"Bearer realm="oapwatch", error="insufficient_scope""#,
            "this token may look but not change anything",
        ),
        None if presented.is_some() => (
            StatusCode::UNAUTHORIZED,
            r#"Bearer realm="oapwatch", error="invalid_token""#,
            "the token is not known here",
        ),
        None => (
            StatusCode::UNAUTHORIZED,
            r#"Bearer realm="oapwatch""#,
            "expected the header Authorization: Bearer TOKEN",
        ),
    };
    metrics::counter!(metric::HTTP_REFUSED, "reason" => "token").increment(1);
    let mut response = Problem::new(status, detail).into_response();
    response
        .headers_mut()
        .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge));
    response
}
