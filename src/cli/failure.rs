//! Errors of commands, their messages and exit codes.

use std::process::ExitCode;

/// Why a command failed; decides the exit code.
#[derive(Debug)]
pub enum Failure {
    /// A config or scene that cannot be used: 64.
    Config(anyhow::Error),
    /// Input that cannot be used: 2.
    Input(anyhow::Error),
    /// Anything else: 1.
    Other(anyhow::Error),
}

pub type Outcome = Result<(), Failure>;

impl Failure {
    pub fn config(e: impl Into<anyhow::Error>) -> Self {
        Self::Config(e.into())
    }

    pub fn input(e: impl Into<anyhow::Error>) -> Self {
        Self::Input(e.into())
    }

    pub fn other(e: impl Into<anyhow::Error>) -> Self {
        Self::Other(e.into())
    }

    fn error(&self) -> &anyhow::Error {
        match self {
            Self::Config(e) | Self::Input(e) | Self::Other(e) => e,
        }
    }

    /// The error with its causes, in one line.
    pub fn message(&self) -> String {
        message(self.error())
    }

    /// Prints one message with its causes and returns the exit code. A reader that closed stdout (`oapwatch locate … | head`) is
    /// not an error.
    pub fn report(self) -> ExitCode {
        let code = match &self {
            Self::Config(_) => 64,
            Self::Input(_) => 2,
            Self::Other(_) => 1,
        };
        let error = self.error();
        let reader_left = error
            .downcast_ref::<std::io::Error>()
            .is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe);
        if reader_left {
            return ExitCode::SUCCESS;
        }
        eprintln!("oapwatch: {}", message(error));
        ExitCode::from(code)
    }
}

/// The error and its causes, without repeating a cause that a message already ends with.
fn message(error: &anyhow::Error) -> String {
    let mut message = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !message.ends_with(&cause) {
            message = format!("{message}: {cause}");
        }
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_named_once() {
        let disk = || std::io::Error::other("disk full");
        let error = anyhow::Error::new(crate::frames::Error::Recording {
            path: "a.npy".into(),
            source: disk(),
        });
        assert_eq!(
            error.to_string(),
            "a.npy: disk full",
            "the error names its cause itself"
        );
        assert_eq!(
            message(&error.context("nothing kept")),
            "nothing kept: a.npy: disk full"
        );
        let silent = anyhow::Error::new(disk()).context("reading").context("starting");
        assert_eq!(message(&silent), "starting: reading: disk full");
    }
}
