//! Polling without transfer: ETag and If-None-Match (RFC 9110, 13.1.2).

use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};

/// The answer, tagged with the version of what it was made from; 304 when the client has that version.
/// The tag is weak: the same version may be gzipped or not.
pub fn answer(headers: &HeaderMap, version: u64, make: impl FnOnce() -> Response) -> Response {
    let tag = format!("W/\"{version:x}\"");
    let tag_value = HeaderValue::from_str(&tag).expect("hexadecimal digits");
    let mut response = if matches(headers, &tag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        make()
    };
    response.headers_mut().insert(header::ETAG, tag_value);
    response
        .headers_mut()
        .insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response
}

fn matches(headers: &HeaderMap, tag: &str) -> bool {
    let opaque = |t: &str| t.trim().trim_start_matches("W/").to_owned();
    headers
        .get_all(header::IF_NONE_MATCH)
        .iter()
        .filter_map(|v| v.to_str().ok())
        .flat_map(|v| v.split(','))
        .any(|t| t.trim() == "*" || opaque(t) == opaque(tag))
}
