//! RFC 9457 problem details: the form of every error that the API answers with.

use axum::Json;
use axum::body::Body;
use axum::extract::Request;
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::intake::Intake;

const MEDIA_TYPE: HeaderValue = HeaderValue::from_static("application/problem+json");

/// What went wrong, as RFC 9457 problem details.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Problem {
    /// Always "about:blank": the status says what kind of problem it is.
    pub r#type: &'static str,
    pub title: &'static str,
    pub status: u16,
    /// What was expected and what was found.
    pub detail: String,
    /// Claims refused, with reasons, where claims were sent.
    #[serde(flatten)]
    #[schema(ignore)]
    pub intake: Option<Box<Intake>>,
    #[serde(skip)]
    retry_after_s: Option<u64>,
}

/// When there may be room for another user: newcomers make way for each other after ten silent seconds.
const COME_BACK_S: u64 = 10;

impl Problem {
    pub fn new(status: StatusCode, detail: impl Into<String>) -> Self {
        Self {
            r#type: "about:blank",
            title: status.canonical_reason().unwrap_or("Error"),
            status: status.as_u16(),
            detail: detail.into(),
            intake: None,
            retry_after_s: None,
        }
    }

    pub fn not_found(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, detail)
    }

    /// A body of which no claim was taken.
    pub fn refused(status: StatusCode, intake: Intake, detail: String) -> Self {
        Self {
            intake: Some(Box::new(intake)),
            retry_after_s: (status == StatusCode::SERVICE_UNAVAILABLE).then_some(COME_BACK_S),
            ..Self::new(status, detail)
        }
    }

    /// The client is asked to come back after `seconds`.
    pub fn later(status: StatusCode, seconds: u64, detail: impl Into<String>) -> Self {
        Self {
            retry_after_s: Some(seconds),
            ..Self::new(status, detail)
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).expect("made from a StatusCode");
        let retry = self.retry_after_s;
        let mut response = (status, Json(self)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, MEDIA_TYPE);
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        if let Some(seconds) = retry {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

impl From<QueryRejection> for Problem {
    fn from(rejection: QueryRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

impl From<PathRejection> for Problem {
    fn from(rejection: PathRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

impl From<BytesRejection> for Problem {
    fn from(rejection: BytesRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

/// Turns errors that the framework answers by itself (405, 413, 408, …) into problem details.
pub async fn for_every_error(request: Request, next: Next) -> Response {
    let method = request.method().clone();
    let path = request.uri().path().to_owned();
    let encoding = request.headers().get(header::CONTENT_ENCODING).cloned();
    let response = next.run(request).await;
    let status = response.status();
    let plain = status.is_client_error() || status.is_server_error();
    if !plain || response.headers().get(header::CONTENT_TYPE) == Some(&MEDIA_TYPE) {
        return response;
    }
    let detail = match status {
        StatusCode::NOT_FOUND => format!("there is nothing at {path}; /openapi.json lists what there is"),
        StatusCode::METHOD_NOT_ALLOWED => format!("{path} does not take {method}"),
        StatusCode::PAYLOAD_TOO_LARGE => "the body is larger than this server reads".to_owned(),
        StatusCode::UNSUPPORTED_MEDIA_TYPE => {
            format!(
                "Content-Encoding: expected gzip or none, found {:?}",
                encoding.unwrap_or_else(|| HeaderValue::from_static(""))
            )
        }
        StatusCode::REQUEST_TIMEOUT => "the request did not arrive in time".to_owned(),
        _ => status.canonical_reason().unwrap_or("the request failed").to_owned(),
    };
    let (old, _) = response.into_parts();
    let mut response = Problem::new(status, detail).into_response();
    for (name, value) in &old.headers {
        let describes_body = [header::CONTENT_TYPE, header::CONTENT_LENGTH].contains(name);
        if !describes_body {
            response.headers_mut().insert(name, value.clone());
        }
    }
    if method == axum::http::Method::HEAD {
        *response.body_mut() = Body::empty();
    }
    response
}
