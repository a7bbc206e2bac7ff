//! axum's extractors with problem details for what they refuse.

use axum::extract::FromRequestParts;
use axum::http::StatusCode;

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
