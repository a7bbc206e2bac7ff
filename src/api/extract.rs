//! What requests hold, with problem details for what is refused.

use axum::extract::FromRequestParts;
use axum::http::{HeaderMap, StatusCode, header};

use super::problem::Problem;

#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Query), rejection(Problem))]
pub struct Query<T>(pub T);

#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Path), rejection(Problem))]
pub struct Path<T>(pub T);

/// A query parameter that has limits.
pub fn within(name: &str, value: usize, min: usize, max: usize) -> Result<usize, Problem> {
    if (min..=max).contains(&value) {
        return Ok(value);
    }
    Err(Problem::new(
        StatusCode::BAD_REQUEST,
        format!("{name}: expected {min} to {max}, found {value}"),
    ))
}

/// Refuses a body of another media type than those `taken`. Clients that name none, or no more than curl does by itself, are
/// believed.
pub fn check_media_type(headers: &HeaderMap, taken: &[&str]) -> Result<(), Problem> {
    let Some(value) = headers.get(header::CONTENT_TYPE) else {
        return Ok(());
    };
    let named = value.to_str().unwrap_or_default();
    let essence = named.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    if essence == "application/x-www-form-urlencoded" || taken.contains(&essence.as_str()) {
        return Ok(());
    }
    Err(Problem::new(
        StatusCode::UNSUPPORTED_MEDIA_TYPE,
        format!("Content-Type: expected {}, found {named:?}", taken.join(" or ")),
    ))
}
