//! Why a `[[webhook]]` cannot be used, or an operator's request not be met.

use std::path::PathBuf;

use super::channel::Cause;
use super::signature::SecretError;
use crate::journal;

/// Why a `[[webhook]]` cannot be used. `index` counts the tables from 1.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("[[webhook]] {index}: url: {cause}")]
    Url { index: usize, cause: url::ParseError },
    #[error("[[webhook]] {index}: url: expected https:// or http://, found {scheme}://")]
    Scheme { index: usize, scheme: String },
    #[error(
        "[[webhook]] {index}: url: http:// to {host} would show alerts to anyone on the way; use https://, or set allow_http = true"
    )]
    Plain { index: usize, host: String },
    #[error("[[webhook]] {index}: secret_file: {path}: {cause}")]
    Unreadable {
        index: usize,
        path: PathBuf,
        cause: std::io::Error,
    },
    #[error("[[webhook]] {index}: secret_file: {path}: line {line}: {cause}")]
    Secret {
        index: usize,
        path: PathBuf,
        line: usize,
        cause: SecretError,
    },
    #[error("[[webhook]] {index}: ca_file: {path}: {cause}")]
    Authority {
        index: usize,
        path: PathBuf,
        cause: AuthorityError,
    },
    #[error("[[webhook]] {index}: `{name}` is taken by [[webhook]] {earlier}; give one of them another name")]
    Twice { index: usize, earlier: usize, name: String },
    #[error("[[webhook]] {index}: {cause}")]
    Common { index: usize, cause: CommonError },
    #[error(
        "[[webhook]] {index}: url: expected certificate authorities on this host to check an https receiver by, found: {cause}; install ca-certificates"
    )]
    Client { index: usize, cause: Cause },
}

/// Why keys that `[[webhook]]` and `[[export]]` have in common cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CommonError {
    #[error("timeout_s: expected 1 to 120, found {0}")]
    Timeout(f64),
    #[error("cool_down_s: expected 0 to 86400, found {0}")]
    CoolDown(f64),
    #[error("name: expected 1 to 64 letters, digits, '-' or '_', found `{0}`")]
    Name(String),
    #[error("kinds: an empty list would send nothing; leave it out to send all")]
    NoKinds,
}

/// Why a `ca_file` cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityError {
    #[error(transparent)]
    Unreadable(#[from] std::io::Error),
    #[error("not PEM certificates: {0}")]
    Malformed(#[from] reqwest::Error),
    #[error("holds no certificate")]
    Empty,
}

/// Why a request of the operator cannot be met.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    #[error("there is no webhook `{0}`")]
    Unknown(String),
    #[error("the journal cannot be written now; dead letters stay where they are")]
    ReadOnly,
    #[error("a test event was sent a moment ago; come back in {0} s")]
    TooSoon(u64),
    #[error("the daemon is stopping")]
    Stopping,
    #[error(transparent)]
    Journal(#[from] journal::Error),
}
