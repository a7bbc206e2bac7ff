//! `/v1/frame.png`: the latest frame, drawn once for all viewers.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::extract::{Query, within};
use super::picture_cache::Look;
use super::problem::Problem;
use super::state::State;
use super::{conditional, picture, positions};

/// Side of the picture when no scale is asked for, at least.
const DEFAULT_SIDE: usize = 512;
pub(super) const MAX_SIDE: usize = 2048;

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct PictureQuery {
    /// Picture pixels per sensor pixel, fewer where the picture would be larger than 2048 a side; enough for 512 a side
    /// when left out
    #[param(minimum = 1, maximum = 64)]
    scale: Option<usize>,
    /// Whether detections are drawn; true when left out
    detections: Option<bool>,
    /// Whether the model and the residual are drawn beside the frame, each anew for the picture; false when left out
    fit: Option<bool>,
}

/// The latest frame as a picture, +x to the right and +y up, with its detections drawn
///
/// With `fit` the model stands beside it, in the same colours, and the residual: data minus model in standard deviations of a pixel's
/// noise, from -5 (blue) over 0 (black) to 5 (orange).
#[utoipa::path(get, path = "/v1/frame.png", tag = "positions", params(PictureQuery),
    responses(
        (status = 200, description = "The picture", body = Vec<u8>, content_type = "image/png"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "A hub has no frames", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "There is no usable frame", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn frame_png(
    Shared(state): Shared<State>,
    Query(query): Query<PictureQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let latest = positions::latest(&state)?;
    if latest.snapshot.pose.is_none() {
        return Err(Problem::not_found("a hub has no frames: ask a station".to_owned()));
    }
    let none = || {
        Problem::later(
            StatusCode::SERVICE_UNAVAILABLE,
            1,
            "the latest step had no usable frame",
        )
    };
    let frame = latest.snapshot.frame.clone().ok_or_else(none)?;
    let (ny, nx) = frame.pixels.dim();
    let with_fit = query.fit.unwrap_or(false) && latest.snapshot.camera.shape() == (ny, nx);
    let width = if with_fit { 3 * nx } else { nx };
    let side = width.max(ny).max(1);
    let scale = match query.scale {
        Some(scale) => within("scale", scale, 1, 64)?.min((MAX_SIDE / side).max(1)),
        None => picture::scale_for(&frame, DEFAULT_SIDE).min((MAX_SIDE / side).max(1)),
    };
    let look = Look {
        scale,
        detections: query.detections.unwrap_or(true),
        fit: with_fit,
    };
    let (seq, png) = match state.pictures.get(&latest, look) {
        Some(drawn) => drawn,
        None => {
            let published = latest.clone();
            let fitter = state.fitter.clone();
            let draw = move || {
                let snapshot = &published.snapshot;
                let marks = if look.detections {
                    picture::marks_of(snapshot)
                } else {
                    Vec::new()
                };
                let camera = &snapshot.camera;
                let fit = look.fit.then(|| fitter.fit(camera, (*frame).clone()));
                match fit.flatten() {
                    Some(fit) => picture::fit_png(&fit, camera, &marks, look.scale),
                    None => picture::png(&frame, camera, &marks, look.scale),
                }
            };
            let drawn = tokio::task::spawn_blocking(draw).await.expect("drawing does not panic");
            let png = drawn.map_err(|e| Problem::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string()))?;
            let png = Bytes::from(png);
            state.pictures.put(latest.seq, look, png.clone());
            (latest.seq, png)
        }
    };
    Ok(conditional::answer(&headers, seq, || {
        let kind = HeaderValue::from_static("image/png");
        ([(header::CONTENT_TYPE, kind)], png).into_response()
    }))
}
