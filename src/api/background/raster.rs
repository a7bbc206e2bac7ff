//! Files that may be pictures: their kind by their first bytes, and reading them within bounds.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use axum::http::HeaderValue;

/// The media type of a picture, by its first bytes.
pub fn raster_type(bytes: &[u8]) -> Option<HeaderValue> {
    let is_webp = bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP");
    let name = match bytes {
        _ if bytes.starts_with(b"\x89PNG\r\n\x1a\n") => "image/png",
        _ if bytes.starts_with(b"\xff\xd8\xff") => "image/jpeg",
        _ if is_webp => "image/webp",
        _ => return None,
    };
    Some(HeaderValue::from_static(name))
}

/// The bytes of a regular file, `None` where there are more than `most`.
pub fn read_bounded(path: &Path, most: u64) -> std::io::Result<Option<Vec<u8>>> {
    let file = File::open(path)?;
    if !file.metadata()?.is_file() {
        return Err(std::io::Error::other("no regular file"));
    }
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= most).then_some(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_one_by_its_first_bytes() {
        assert_eq!(raster_type(b"\x89PNG\r\n\x1a\n").unwrap(), "image/png");
        assert_eq!(raster_type(b"\xff\xd8\xff\xe0").unwrap(), "image/jpeg");
        assert_eq!(raster_type(b"RIFF....WEBPVP8 ").unwrap(), "image/webp");
        assert!(raster_type(b"<svg onload=alert(1)>").is_none() && raster_type(b"").is_none());
    }
}
