//! Reads known positions: NDJSON, one object a frame.
//!
//! Accepted: `{"frame":0,"emitters":[{"x_m":1,"y_m":2},…]}` (what `simulate` writes), `{"frame":0,"positions":[[1,2],…]}`,
//! `{"frame":0,"xy_m":[[1,2],…]}`, `{"frame":0,"x_m":1,"y_m":2}` (one beacon a line, several lines a frame). Without
//! `frame`, the n-th line belongs to the n-th frame. Frames and emitters without a surveyed position may be left out.

use std::io::BufRead;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// A surveyed position. It may be wrong: the fit rejects outliers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beacon {
    /// Frame number in the recording.
    pub frame: usize,
    /// Ground position, m.
    pub ground_m: [f64; 2],
    /// Line of the truth file, from 1.
    pub line: usize,
}

/// Why a truth file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}, line {line}: not JSON: {source}")]
    NotJson {
        path: PathBuf,
        line: usize,
        source: serde_json::Error,
    },
    #[error("{path}, line {line}, {field}: expected {expected}, found {found}")]
    Malformed {
        path: PathBuf,
        line: usize,
        field: &'static str,
        expected: &'static str,
        found: Value,
    },
    #[error("{path}: no positions in it; expected one JSON object a frame, such as {example}")]
    Empty { path: PathBuf, example: &'static str },
}

/// A field with an unexpected value; the reader adds file and line.
struct Wrong {
    field: &'static str,
    expected: &'static str,
    found: Value,
}

const EXAMPLE: &str = r#"{"frame":0,"emitters":[{"x_m":1.0,"y_m":2.0}]}"#;
const LISTS: [&str; 4] = ["emitters", "positions", "xy_m", "beacons"];

/// Reads a truth file, beacons in the file's order.
pub fn read(path: &Path) -> Result<Vec<Beacon>, Error> {
    let unreadable = |source| Error::Unreadable {
        path: path.to_owned(),
        source,
    };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut beacons = Vec::new();
    let mut rows = 0;
    for (k, text) in std::io::BufReader::new(file).lines().enumerate() {
        let text = text.map_err(unreadable)?;
        let line = k + 1;
        if text.trim().is_empty() {
            continue;
        }
        let row: Value = serde_json::from_str(&text).map_err(|source| Error::NotJson {
            path: path.to_owned(),
            line,
            source,
        })?;
        parse_row(&row, rows, line, &mut beacons).map_err(|wrong| Error::Malformed {
            path: path.to_owned(),
            line,
            field: wrong.field,
            expected: wrong.expected,
            found: wrong.found,
        })?;
        rows += 1;
    }
    if beacons.is_empty() {
        return Err(Error::Empty {
            path: path.to_owned(),
            example: EXAMPLE,
        });
    }
    Ok(beacons)
}

fn parse_row(row: &Value, rows_before: usize, line: usize, out: &mut Vec<Beacon>) -> Result<(), Wrong> {
    let wrong = |field, expected, found: &Value| Wrong {
        field,
        expected,
        found: found.clone(),
    };
    let Some(object) = row.as_object() else {
        return Err(wrong("the line", "a JSON object", row));
    };
    if let Some(frames) = object.get("frames") {
        // A whole recording in one object.
        let Some(frames) = frames.as_array() else {
            return Err(wrong("frames", "a list of objects", frames));
        };
        return frames
            .iter()
            .enumerate()
            .try_for_each(|(k, frame)| parse_row(frame, k, line, out));
    }
    let frame = match object.get("frame") {
        None if object.contains_key("time") => {
            return Err(wrong(
                "frame",
                "a frame number; a line with a time and none, such as a claim, belongs to no frame",
                row,
            ));
        }
        None => rows_before,
        Some(value) => value
            .as_u64()
            .and_then(|n| usize::try_from(n).ok())
            .ok_or_else(|| wrong("frame", "a frame number from 0", value))?,
    };
    let mut push = |ground_m| out.push(Beacon { frame, ground_m, line });
    let mut named = LISTS.into_iter().filter_map(|key| Some((key, object.get(key)?)));
    if let Some((field, list)) = named.next() {
        let Some(list) = list.as_array() else {
            return Err(wrong(field, "a list of positions", list));
        };
        for item in list {
            push(position(item).ok_or_else(|| wrong(field, "{\"x_m\":…,\"y_m\":…} or [x, y] in metres", item))?);
        }
        Ok(())
    } else if let Some(ground_m) = position(row) {
        push(ground_m);
        Ok(())
    } else {
        Err(wrong(
            "the line",
            "a list \"emitters\", \"positions\" or \"xy_m\", or \"x_m\" and \"y_m\"",
            row,
        ))
    }
}

fn position(value: &Value) -> Option<[f64; 2]> {
    let (x, y) = match value {
        Value::Array(pair) if pair.len() == 2 => (&pair[0], &pair[1]),
        Value::Object(object) => (object.get("x_m")?, object.get("y_m")?),
        _ => return None,
    };
    Some([x.as_f64()?, y.as_f64()?])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<(usize, [f64; 2])>, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("truth.ndjson");
        std::fs::write(&path, text).unwrap();
        read(&path)
            .map(|b| b.iter().map(|b| (b.frame, b.ground_m)).collect())
            .map_err(|e| e.to_string().replace(&dir.path().display().to_string(), ""))
    }

    #[test]
    fn every_accepted_form_is_read() {
        let all = [
            r#"{"frame":3,"emitters":[{"x_m":1,"y_m":2,"energy_j":0.1},{"x_m":3,"y_m":4}]}"#,
            r#"{"frame":3,"positions":[[1,2],[3,4]]}"#,
            r#"{"frame":3,"xy_m":[[1.0,2.0],[3.0,4.0]]}"#,
            "{\"frame\":3,\"x_m\":1,\"y_m\":2}\n\n{\"frame\":3,\"x_m\":3,\"y_m\":4}",
        ];
        for text in all {
            assert_eq!(parse(text).unwrap(), [(3, [1.0, 2.0]), (3, [3.0, 4.0])], "{text}");
        }
        let numbered = "{\"xy_m\":[[1,2]]}\n{\"xy_m\":[]}\n{\"xy_m\":[[3,4]]}";
        assert_eq!(parse(numbered).unwrap(), [(0, [1.0, 2.0]), (2, [3.0, 4.0])]);
        let whole = r#"{"pixels":64,"frames":[{"xy_m":[[1,2]]},{"xy_m":[[3,4]]}]}"#;
        assert_eq!(parse(whole).unwrap(), [(0, [1.0, 2.0]), (1, [3.0, 4.0])]);
    }

    #[test]
    fn a_bad_line_is_named_with_what_was_found() {
        let error = parse("{\"frame\":0,\"xy_m\":[[1,2]]}\n{\"frame\":1,\"xy_m\":[[1,null]]}").unwrap_err();
        assert!(
            error.contains("line 2, xy_m") && error.ends_with("found [1,null]"),
            "{error}"
        );
        assert!(
            parse("{\"frame\":-1,\"xy_m\":[]}")
                .unwrap_err()
                .contains("line 1, frame")
        );
        let claim = r#"{"time":"2026-01-01T00:00:00Z","user":"u-1","x_m":1,"y_m":2,"sigma_m":0.3,"state":"active"}"#;
        assert!(parse(claim).unwrap_err().contains("line 1, frame"));
        assert!(parse("{\"frame\":0").unwrap_err().contains("line 1: not JSON"));
        assert!(parse("\n").unwrap_err().contains("no positions"));
    }
}
