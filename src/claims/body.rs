//! Many claims at once, as a request or a message holds them.

use super::config::{Config, Format};
use super::format::{LineReader, parse_line};
use crate::claim::Claim;

/// Claims taken from one body. More let one message delay the others, fewer refuse the log of a busy minute.
pub const MOST_IN_A_BODY: usize = 20_000;

/// Cuts a body into what may be claims, each with the line that it begins on: lines, or XML events over any number of lines.
fn pieces(body: &[u8], format: Format) -> Vec<(usize, &[u8])> {
    let end: &[u8] = match format {
        Format::Cot => b"</event>",
        _ => b"\n",
    };
    let (mut found, mut rest, mut line) = (Vec::new(), body, 1);
    while !rest.is_empty() {
        let length = rest.windows(end.len()).position(|bytes| bytes == end);
        let length = length.map_or(rest.len(), |at| at + end.len());
        let (piece, after) = rest.split_at(length);
        let blank = piece.iter().take_while(|byte| byte.is_ascii_whitespace());
        let begins = line + blank.filter(|byte| **byte == b'\n').count();
        if !piece.trim_ascii().is_empty() {
            found.push((begins, piece));
        }
        line += piece.iter().filter(|byte| **byte == b'\n').count();
        rest = after;
    }
    found
}

/// Claims of a body with the line each stands on: one JSON object over any number of lines, or one a line, or as the format has
/// it. `refuse` is told the line of each that cannot be taken, and why.
pub fn parse_body(body: &[u8], reading: &Config, mut refuse: impl FnMut(usize, String)) -> Vec<(usize, Claim)> {
    if let Ok(claim) = parse_line(body, reading) {
        return vec![(1, claim)];
    }
    let mut found = Vec::new();
    let mut reader = LineReader::default();
    for (line, piece) in pieces(body, reading.format) {
        if found.len() == MOST_IN_A_BODY {
            refuse(line, format!("more than {MOST_IN_A_BODY} claims in one body"));
            continue;
        }
        match reader.read(piece, reading) {
            Ok(claim) => found.extend(claim.map(|claim| (line, claim))),
            Err(e) => refuse(line, e.to_string()),
        }
    }
    found
}
