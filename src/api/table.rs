//! JSON as tables for spreadsheets: CSV (RFC 4180) with a header, one row an object.

use axum::body::Body;
use axum::http::{HeaderValue, header};
use axum::response::Response;
use serde_json::Value;

/// Name of each column and where its cell stands in an object (a JSON pointer, RFC 6901).
pub type Columns = [(&'static str, &'static str)];

/// The row of column names.
pub fn head(columns: &Columns) -> Vec<u8> {
    write(|rows| rows.write_record(columns.iter().map(|(name, _)| name)))
}

/// A row for each object.
pub fn rows(columns: &Columns, objects: impl IntoIterator<Item = Value>) -> Vec<u8> {
    write(|rows| {
        for object in objects {
            rows.write_record(columns.iter().map(|(_, place)| cell(object.pointer(place))))?;
        }
        Ok(())
    })
}

fn write(fill: impl FnOnce(&mut csv::Writer<Vec<u8>>) -> csv::Result<()>) -> Vec<u8> {
    let mut rows = csv::WriterBuilder::new()
        .terminator(csv::Terminator::CRLF)
        .from_writer(Vec::new());
    fill(&mut rows).expect("rows of equal length go into memory");
    rows.into_inner().expect("memory takes all")
}

fn cell(value: Option<&Value>) -> String {
    match value {
        None | Some(Value::Null) => String::new(),
        Some(Value::String(text)) => harmless(text),
        Some(other) => other.to_string(),
    }
}

/// Text that a spreadsheet would take for a formula gets an apostrophe in front (OWASP, CSV injection): users name themselves.
fn harmless(text: &str) -> String {
    match text.starts_with(['=', '+', '-', '@', '\t', '\r']) {
        true => format!("'{text}"),
        false => text.to_owned(),
    }
}

/// A table that browsers save as `name`.
pub fn download(name: &str, body: impl Into<Body>) -> Response {
    let mut response = Response::new(body.into());
    let headers = response.headers_mut();
    let kind = HeaderValue::from_static("text/csv; charset=utf-8; header=present");
    headers.insert(header::CONTENT_TYPE, kind);
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    let disposition = format!("attachment; filename=\"{name}\"");
    let disposition = HeaderValue::from_str(&disposition).expect("a plain file name");
    headers.insert(header::CONTENT_DISPOSITION, disposition);
    response
}
