//! `/v1/background`: what lies below the page's map.

use std::sync::Arc;

use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};

use super::raster::raster_type;
use super::source::{Background, Shown, Source};
use crate::api::extract::Path;
use crate::api::problem::Problem;
use crate::api::state::State;
use crate::api::{conditional, respond};

/// What lies below the page's map
#[utoipa::path(get, path = "/v1/background", tag = "positions",
    responses((status = 200, description = "A picture with its corners, tiles, or nothing", body = Shown)))]
pub async fn description(Shared(state): Shared<State>) -> Response {
    let shown = state.background.as_ref().map(|background| background.shown.clone());
    respond::json(&shown.unwrap_or_default())
}

/// The picture below the map
#[utoipa::path(get, path = "/v1/background/picture", tag = "positions",
    responses(
        (status = 200, description = "The picture: PNG, JPEG or WebP", body = Vec<u8>, content_type = "image/png"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 404, description = "There is none", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn picture(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let Some(Source::Picture { bytes, kind, version }) = state.background.as_ref().map(|b| &b.source) else {
        return Err(Problem::not_found("no [api.background] picture is configured"));
    };
    Ok(conditional::answer(&headers, *version, || {
        ([(header::CONTENT_TYPE, kind.clone())], bytes.clone()).into_response()
    }))
}

/// A tile of the map below
#[utoipa::path(get, path = "/v1/background/tiles/{zoom}/{column}/{row}", tag = "positions",
    params(
        ("zoom" = u32, Path, description = "Zoom of the XYZ scheme"),
        ("column" = u32, Path, description = "Column, from the west"),
        ("row" = u32, Path, description = "Row, from the north"),
    ),
    responses(
        (status = 200, description = "The tile: PNG, JPEG or WebP", body = Vec<u8>, content_type = "image/png"),
        (status = 400, description = "No number", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such tile", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn tile(
    Shared(state): Shared<State>,
    Path((zoom, column, row)): Path<(u32, u32, u32)>,
) -> Result<Response, Problem> {
    let none = || Problem::not_found(format!("there is no tile {zoom}/{column}/{row}"));
    let background: Arc<Background> = state.background.ok_or_else(none)?;
    let read = move || match &background.source {
        Source::Tiles(tiles) => tiles.read(u8::try_from(zoom).ok()?, column, row),
        Source::Picture { .. } => None,
    };
    let bytes = tokio::task::spawn_blocking(read).await.expect("reading does not panic");
    let bytes = bytes.ok_or_else(none)?;
    let kind = raster_type(&bytes).ok_or_else(none)?;
    let kept = HeaderValue::from_static("private, max-age=3600");
    Ok(([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, kept)], bytes).into_response())
}
