//! How a delivery reaches a receiver: a webhook here, other systems' formats in `export/`.

use std::error::Error as _;
use std::fmt;
use std::time::Duration;

use futures_util::future::BoxFuture;
use jiff::Timestamp;
use reqwest::StatusCode;

use crate::journal::{self, Recorded};

/// An event on its way to a receiver.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a> {
    /// The same in every attempt.
    pub id: &'a str,
    pub event: &'a Recorded,
    /// An operator tries the receiver: no alert stands behind the event.
    pub is_test: bool,
    /// The wall clock.
    pub now: Timestamp,
}

/// Delivers events in the receiver's format. Several calls may be under way; one is dropped when its time is over.
pub trait Channel: Send + Sync + fmt::Debug {
    /// One attempt.
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict>;
}

/// How an attempt ended.
#[derive(Debug)]
pub enum Verdict {
    /// With the status that an HTTP receiver answered.
    Delivered(Option<StatusCode>),
    /// 410: the receiver wants no more.
    Gone,
    /// The journal no longer holds the event: it was given up while the endpoint was disabled.
    Expired,
    Failed {
        failure: Failure,
        retry_after: Option<Duration>,
    },
}

impl From<Failure> for Verdict {
    fn from(failure: Failure) -> Self {
        Self::Failed {
            failure,
            retry_after: None,
        }
    }
}

/// Why an attempt was no delivery.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    #[error("the receiver answered {0}")]
    Status(StatusCode),
    #[error("the receiver answered {0}, a redirect, which is not followed; put its new address into the config")]
    Redirect(StatusCode),
    #[error("no answer in time")]
    Timeout,
    #[error("the journal cannot be read: {0}")]
    Journal(journal::Error),
    #[error("the request broke off inside oapwatch")]
    Broken,
    #[error("no connection: {0}")]
    Connect(Cause),
    #[error("{0}")]
    Transport(Cause),
    #[error("no connection: {0}")]
    Unreachable(std::io::Error),
    #[error("the connection broke: {0}")]
    Interrupted(std::io::Error),
    /// What the other side's protocol says of it.
    #[error("{0}")]
    Protocol(String),
}

impl Failure {
    /// What an HTTP receiver answered.
    pub(super) fn status(&self) -> Option<StatusCode> {
        match self {
            Self::Status(status) | Self::Redirect(status) => Some(*status),
            _ => None,
        }
    }
}

impl From<reqwest::Error> for Failure {
    fn from(error: reqwest::Error) -> Self {
        let error = error.without_url();
        if error.is_timeout() {
            Self::Timeout
        } else if error.is_connect() {
            Self::Connect(Cause(error))
        } else {
            Self::Transport(Cause(error))
        }
    }
}

/// Prints the innermost causes, which say what happened; the outer ones only say that something did.
#[derive(Debug)]
pub struct Cause(reqwest::Error);

impl From<reqwest::Error> for Cause {
    fn from(error: reqwest::Error) -> Self {
        Self(error)
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut causes = Vec::new();
        let mut source = self.0.source();
        while let Some(cause) = source {
            causes.push(cause.to_string());
            source = cause.source();
        }
        match &causes[..] {
            [] => self.0.fmt(f),
            [cause] => f.write_str(cause),
            [.., outer, inner] => write!(f, "{outer}: {inner}"),
        }
    }
}
