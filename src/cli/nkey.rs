//! `oapwatch nkey`: a key pair by which a NATS server knows an access point or the hub.

use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;

use anyhow::anyhow;
use nkeys::KeyPair;

use super::{Failure, Outcome};

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  oapwatch nkey /etc/oapwatch/credentials/nkey")]
pub struct Args {
    /// File for the secret seed, which must not exist: `[fleet] nkey_file`
    file: PathBuf,
}

/// Writes the seed for its owner alone to read, and prints the public key, which the server's config names.
pub fn run(args: Args) -> Outcome {
    let key = KeyPair::new_user();
    let seed = key.seed().map_err(Failure::other)?;
    let name = args.file.display();
    let refused =
        |error: std::io::Error| Failure::input(anyhow!("{name}: expected to write a new file, found: {error}"));
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    let mut file = options.open(&args.file).map_err(refused)?;
    writeln!(file, "{seed}")
        .and_then(|()| file.sync_all())
        .map_err(refused)?;
    writeln!(std::io::stdout(), "{}", key.public_key()).map_err(Failure::other)
}
