//! Files that a config names and that are read at once: keys, tokens, TOML.

use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

/// Largest file, bytes; a calibration's maps of a large sensor are the largest of them.
const LARGEST: u64 = 256 << 20;

/// The text of a file; an error where it has no end, as a device's.
pub fn read(path: &Path) -> Result<String> {
    let mut text = String::new();
    let file = File::open(path)?;
    if file.take(LARGEST + 1).read_to_string(&mut text)? as u64 > LARGEST {
        return Err(Error::new(
            ErrorKind::FileTooLarge,
            format!("expected at most {LARGEST} bytes, found more"),
        ));
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_no_end_is_refused() {
        let found = read(Path::new("/dev/zero")).expect_err("a device");
        assert_eq!(found.kind(), ErrorKind::FileTooLarge);
    }
}
