//! The dashboard's files, embedded in the binary, with their content security policy.

use axum::extract::Path;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use rust_embed::Embed;

use super::problem::Problem;

/// The dashboard: one tree of plain files in the binary.
#[derive(Embed)]
#[folder = "src/api/web"]
struct Files;

/// Nothing but our own files and our own API; nobody may frame the page.
const POLICY: HeaderValue = HeaderValue::from_static(
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
);

pub async fn index(headers: HeaderMap) -> Response {
    file("index.html", &headers)
}

pub async fn asset(Path(path): Path<String>, headers: HeaderMap) -> Response {
    file(&path, &headers)
}

fn file(path: &str, headers: &HeaderMap) -> Response {
    let Some(file) = Files::get(path) else {
        return Problem::not_found(format!("the page has no file {path:?}")).into_response();
    };
    let hash = file.metadata.sha256_hash();
    let version = u64::from_be_bytes(hash[..8].try_into().expect("eight bytes"));
    let body = || {
        let kind = match path.rsplit('.').next() {
            Some("html") => "text/html; charset=utf-8",
            Some("css") => "text/css; charset=utf-8",
            Some("js") => "text/javascript; charset=utf-8",
            Some("svg") => "image/svg+xml",
            Some("webmanifest") => "application/manifest+json",
            _ => "application/octet-stream",
        };
        ([(header::CONTENT_TYPE, HeaderValue::from_static(kind))], file.data).into_response()
    };
    let mut response = super::conditional::answer(headers, version, body);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, POLICY);
    response
}
