use std::process::ExitCode;

/// Why a command ended without success; decides the exit code.
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

    /// Prints the one message, with its causes, and gives the exit code. A reader that closed our stdout
    /// (`oapwatch locate … | head`) is no failure.
    pub fn report(self) -> ExitCode {
        let (code, error) = match self {
            Self::Config(e) => (64, e),
            Self::Input(e) => (2, e),
            Self::Other(e) => (1, e),
        };
        let reader_left = error
            .downcast_ref::<std::io::Error>()
            .is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe);
        if reader_left {
            return ExitCode::SUCCESS;
        }
        eprintln!("oapwatch: {error:#}");
        ExitCode::from(code)
    }
}
