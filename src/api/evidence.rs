//! `/v1/alerts/{id}/evidence.*`: what was recorded around an alert, as frames, as a picture, as claims and poses.

use std::io::SeekFrom;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};

use super::extract::{Path, Query, within};
use super::problem::Problem;
use super::state::State;
use super::{alerts, conditional, frame, picture, positions, respond};
use crate::claim::Claim;
use crate::estimate::Emitter;
use crate::frame::Frame;
use crate::frames::npy::{self, Header};
use crate::frames::record::{self, EvidenceFrame};
use crate::monitor::Alert;
use crate::pose::{Pose, PoseRecord};

/// Read from the disk at a time.
const CHUNK: usize = 64 << 10;
/// Side of the picture when no scale is asked for, at least.
const DEFAULT_SIDE: usize = 512;

/// What was recorded around an alert, without the pixels.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct AlertEvidence {
    /// The alert's id.
    alert: String,
    #[schema(value_type = String, format = DateTime)]
    raised_at: Timestamp,
    /// Position in `evidence.npy` of the frame that raised the alert, or of the one nearest to it; null where none is usable.
    position: Option<u64>,
    /// What the estimator finds in that frame; null where it cannot be used.
    #[schema(value_type = Option<Vec<Object>>)]
    emitters: Option<Vec<Emitter>>,
    /// Claims that stood when the recording begins, oldest first.
    claims: Vec<Claim>,
    /// The platform's poses until then, of about a second; none where it is fixed.
    #[schema(value_type = Vec<PoseRecord>)]
    poses: Vec<Pose>,
    /// What the monitor was given, in order, with the claims and poses that came with it.
    frames: Vec<EvidenceFrame>,
}

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct EvidenceQuery {
    /// Picture pixels per sensor pixel, fewer where the picture would be larger than 2048 a side; enough for 512 a side
    /// when left out
    #[param(minimum = 1, maximum = 64)]
    scale: Option<usize>,
    /// All of a recorded frame when left out; asked for all, what is not recorded has no picture
    #[param(inline)]
    panels: Option<Panels>,
}

/// What the picture shows, from left to right.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
enum Panels {
    /// The frame.
    Data,
    /// The frame, the model that the estimator explains it by, and the residual in σ.
    All,
}

async fn alert_of(state: &State, id: &str) -> Result<Alert, Problem> {
    let wanted = id.to_owned();
    let alert = alerts::read(state, move |journal| journal.alert(&wanted)).await?;
    alert.ok_or_else(|| alerts::unknown(id))
}

/// The file that holds an alert's evidence: the one it names where that lies in the evidence folder (an alert among many may
/// share another's), else its own. Only the last part of a name is used, so that no alert can name a file elsewhere.
fn file_of(folder: &FilePath, alert: &Alert) -> PathBuf {
    let named = alert.source.file.as_deref().map(FilePath::new);
    let shared = named
        .filter(|file| file.parent() == Some(folder))
        .and_then(FilePath::file_name);
    match shared {
        Some(name) => folder.join(name),
        None => folder.join(record::evidence_file_name(&alert.id)),
    }
}

fn nothing_recorded(state: &State, alert: &Alert) -> Problem {
    let why = match state.evidence {
        None => "this daemon records nothing; [record] folder in the config makes it",
        Some(_) => "nothing was recorded around it, or its recording has made way for newer ones",
    };
    Problem::not_found(format!("there is no evidence of alert {:?}: {why}", alert.id))
}

/// Runs a read of the evidence where blocking is allowed. A file that is not there is no evidence.
async fn read<T: Send + 'static>(
    state: &State,
    alert: &Alert,
    read: impl FnOnce(&FilePath) -> Result<T, crate::frames::Error> + Send + 'static,
) -> Result<T, Problem> {
    let none = || nothing_recorded(state, alert);
    let folder: &Arc<FilePath> = state.evidence.as_ref().ok_or_else(none)?;
    let path = file_of(folder, alert);
    let shown = path.clone();
    let outcome = tokio::task::spawn_blocking(move || match path.try_exists() {
        Ok(false) => None,
        _ => Some(read(&path)),
    });
    let outcome = outcome.await.expect("a read does not panic").ok_or_else(none)?;
    outcome.map_err(|error| {
        tracing::warn!(path = %shown.display(), %error, "evidence cannot be read");
        Problem::later(
            StatusCode::SERVICE_UNAVAILABLE,
            5,
            "the evidence cannot be read at the moment",
        )
    })
}

/// What was recorded around an alert: frames by number and time, claims, poses
#[utoipa::path(get, path = "/v1/alerts/{id}/evidence.json", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id")),
    responses(
        (status = 200, description = "Frames, claims and poses around the alert", body = AlertEvidence),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert, or nothing was recorded around it", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal or the recording cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn json(Shared(state): Shared<State>, Path(id): Path<String>) -> Result<Response, Problem> {
    let alert = alert_of(&state, &id).await?;
    let evidence = read(&state, &alert, record::Evidence::read).await?;
    let frame = recorded_frame(&state, &alert).await?;
    let emitters = match (frame, positions::latest(&state)) {
        (Some(frame), Ok(latest)) => {
            let (fitter, camera) = (state.fitter.clone(), latest.snapshot.camera.clone());
            let fit = move || Some(fitter.fit(&camera, frame)?.emitters);
            tokio::task::spawn_blocking(fit).await.expect("a fit does not panic")
        }
        _ => None,
    };
    Ok(respond::json(&AlertEvidence {
        position: evidence.position_of(alert.source.frame, alert.raised_at),
        emitters,
        raised_at: alert.raised_at,
        alert: alert.id,
        claims: evidence.claims,
        poses: evidence.poses,
        frames: evidence.frames,
    }))
}

/// The frames around an alert, as NumPy's .npy: shape (T, Ny, Nx), joules
#[utoipa::path(get, path = "/v1/alerts/{id}/evidence.npy", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id")),
    responses(
        (status = 200, description = "The recording; while it grows, the frames so far", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert, or nothing was recorded around it", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal or the recording cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn npy(Shared(state): Shared<State>, Path(id): Path<String>) -> Result<Response, Problem> {
    let alert = alert_of(&state, &id).await?;
    let (file, header) = read(&state, &alert, |path| {
        let file = std::fs::File::open(path).map_err(|source| crate::frames::Error::Recording {
            path: path.to_owned(),
            source,
        })?;
        Ok((file, *npy::Reader::open(path, None)?.header()))
    })
    .await?;
    let name = record::evidence_file_name(&alert.id);
    let disposition = HeaderValue::from_str(&format!("attachment; filename=\"{name}\""));
    let mut response = Response::new(frames_so_far(file, header));
    let headers = response.headers_mut();
    let kind = HeaderValue::from_static("application/octet-stream");
    headers.insert(header::CONTENT_TYPE, kind);
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(header.file_bytes()));
    if let Ok(disposition) = disposition {
        headers.insert(header::CONTENT_DISPOSITION, disposition);
    }
    Ok(response)
}

/// A file may grow while it is sent: the header is the one that was read, and as many frames follow as it counts.
fn frames_so_far(file: std::fs::File, header: Header) -> Body {
    let head = Bytes::from(header.bytes());
    let rest = header.file_bytes() - head.len() as u64;
    let file = File::from_std(file);
    let start = head.len() as u64;
    let begin = stream::once(async move { Ok::<_, std::io::Error>(head) });
    let chunks = stream::try_unfold((file, rest, start), |(mut file, rest, seek)| async move {
        if rest == 0 {
            return Ok(None);
        }
        if seek > 0 {
            file.seek(SeekFrom::Start(seek)).await?;
        }
        let mut chunk = vec![0; CHUNK.min(usize::try_from(rest).unwrap_or(CHUNK))];
        let read = file.read(&mut chunk).await?;
        if read == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
        chunk.truncate(read);
        Ok(Some((Bytes::from(chunk), (file, rest - read as u64, 0))))
    });
    Body::from_stream(futures_util::StreamExt::chain(begin, chunks))
}

/// The frame that raised an alert as a picture, with its place and the place that was claimed marked
///
/// Beside it the model, in the same colours, and the residual: data minus model in standard deviations of a pixel's noise, from
/// -5 (blue) over 0 (black) to 5 (orange).
#[utoipa::path(get, path = "/v1/alerts/{id}/evidence.png", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id"), EvidenceQuery),
    responses(
        (status = 200, description = "The picture. Where nothing is recorded, alerts of this run have one of 256 pixels a side", body = Vec<u8>, content_type = "image/png"),
        (status = 304, description = "The picture has not changed since the ETag given in If-None-Match"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert, or no picture of it", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal or the recording cannot be read, or no frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn png(
    Shared(state): Shared<State>,
    Path(id): Path<String>,
    Query(query): Query<EvidenceQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let scale = query.scale.map(|scale| within("scale", scale, 1, 64)).transpose()?;
    let alert = alert_of(&state, &id).await?;
    let recorded = match recorded_frame(&state, &alert).await {
        Ok(Some(frame)) => Ok(frame),
        Ok(None) => Err(nothing_recorded(&state, &alert)),
        Err(problem) => Err(problem),
    };
    let kept = state
        .feed
        .picture(&alert.id)
        .filter(|_| query.panels != Some(Panels::All));
    let png = match (recorded, kept) {
        (Ok(frame), _) => {
            // What moves has left the place that the alert has now.
            let events = alerts::read(&state, move |journal| journal.events(&id)).await?;
            let raised = events.into_iter().next().map_or(alert, |first| first.event.alert);
            draw(&state, frame, raised, scale, query.panels.unwrap_or(Panels::All)).await?
        }
        (Err(_), Some(png)) => png,
        (Err(problem), None) => return Err(problem),
    };
    let digest = Sha256::digest(&png);
    let version = u64::from_be_bytes(digest[..8].try_into().expect("eight bytes"));
    Ok(conditional::answer(&headers, version, || {
        let kind = HeaderValue::from_static("image/png");
        ([(header::CONTENT_TYPE, kind)], png).into_response()
    }))
}

async fn recorded_frame(state: &State, alert: &Alert) -> Result<Option<Frame>, Problem> {
    let (index, raised_at) = (alert.source.frame, alert.raised_at);
    read(state, alert, move |path| {
        let position = record::Evidence::read(path)?.position_of(index, raised_at);
        position.map_or(Ok(None), |position| record::frame_at(path, position))
    })
    .await
}

async fn draw(
    state: &State,
    frame: Frame,
    alert: Alert,
    scale: Option<usize>,
    panels: Panels,
) -> Result<Bytes, Problem> {
    let camera = positions::latest(state)?.snapshot.camera.clone();
    let (ny, nx) = frame.pixels.dim();
    let width = match panels {
        Panels::Data => nx,
        Panels::All => 3 * nx,
    };
    let most = (frame::MAX_SIDE / width.max(ny).max(1)).max(1);
    let scale = scale
        .unwrap_or_else(|| picture::scale_for(&frame, DEFAULT_SIDE))
        .min(most);
    let fitter = state.fitter.clone();
    let draw = move || {
        let marks = picture::marks_of_alert(&alert, &camera);
        let fit =
            (panels == Panels::All && camera.shape() == frame.pixels.dim()).then(|| fitter.fit(&camera, frame.clone()));
        match fit.flatten() {
            Some(fit) => picture::fit_png(&fit, &camera, &marks, scale),
            None => picture::png(&frame, &camera, &marks, scale),
        }
    };
    let drawn = tokio::task::spawn_blocking(draw).await.expect("drawing does not panic");
    let png = drawn.map_err(|e| Problem::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string()))?;
    Ok(png.into())
}
