//! Who may do what: the token of a request against the tokens in force.

use std::sync::Arc;

use axum::extract::{Request, State as Shared};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;

use super::audit::Audit;
use super::client::{Actor, Client};
use super::problem::Problem;
use super::tokens::{Access, Session, Tokens, digest};
use crate::metric;

/// The token of a request: from the header, or from the subprotocols that a browser's WebSocket offers.
fn presented(headers: &HeaderMap, websocket: bool) -> Option<Vec<u8>> {
    if let Some(value) = headers.get(header::AUTHORIZATION) {
        let (scheme, token) = value.to_str().ok()?.split_once(' ')?;
        return scheme
            .eq_ignore_ascii_case("bearer")
            .then(|| token.trim().as_bytes().to_owned());
    }
    if !websocket {
        return None;
    }
    headers
        .get_all(header::SEC_WEBSOCKET_PROTOCOL)
        .iter()
        .filter_map(|v| v.to_str().ok())
        .flat_map(|v| v.split(','))
        .find_map(|p| BASE64_URL_SAFE_NO_PAD.decode(p.trim().strip_prefix("bearer.")?).ok())
}

/// What [`check`] works with.
pub struct Gate {
    pub tokens: Arc<Tokens>,
    pub audit: Audit,
}

/// Whether a read shows what only those may see who may also change things.
fn is_for_full_tokens(path: &str) -> bool {
    path == "/v1/audit"
}

/// Lets through who may do what they ask.
pub async fn check(Shared(gate): Shared<Arc<Gate>>, mut request: Request, next: Next) -> Response {
    let path = request.uri().path();
    let guarded = path.starts_with("/v1/") || path == "/metrics";
    if !gate.tokens.required() || !guarded {
        request.extensions_mut().insert(Actor::default());
        request.extensions_mut().insert(Session(None));
        return next.run(request).await;
    }
    let presented = presented(request.headers(), path == "/v1/stream");
    let digest = presented.as_deref().map(digest);
    let token = digest.and_then(|digest| gate.tokens.find(&digest));
    let reads = [Method::GET, Method::HEAD].contains(request.method()) && !is_for_full_tokens(path);
    let (status, challenge, detail) = match &token {
        Some(token) if reads || token.access == Access::Full => {
            request.extensions_mut().insert(Actor(token.name.clone()));
            let session = digest.map(|digest| (gate.tokens.clone(), digest));
            request.extensions_mut().insert(Session(session));
            return next.run(request).await;
        }
        Some(_) => (
            StatusCode::FORBIDDEN,
            r#"Bearer realm="oapwatch", error="insufficient_scope""#,
            "this token may look but not change anything",
        ),
        None if presented.is_some() => (
            StatusCode::UNAUTHORIZED,
            r#"Bearer realm="oapwatch", error="invalid_token""#,
            "the token is not known here",
        ),
        None => (
            StatusCode::UNAUTHORIZED,
            r#"Bearer realm="oapwatch""#,
            "expected the header Authorization: Bearer TOKEN",
        ),
    };
    let client = request.extensions().get::<Client>().copied();
    let actor = token.and_then(|token| token.name);
    gate.audit.refused(&request, client, actor.as_deref(), detail);
    metrics::counter!(metric::HTTP_REFUSED, "reason" => "token").increment(1);
    let mut response = Problem::new(status, detail).into_response();
    response
        .headers_mut()
        .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge));
    response
}
