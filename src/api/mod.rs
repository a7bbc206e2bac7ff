//! Layer 4: REST, WebSocket, server-sent events, metrics and the dashboard.
//!
//! The daemon builds a [`State`], publishes to its [`Feed`], handles [`Command`]s and runs a [`Server`]. No handler can
//! make the compute thread wait.

mod acknowledge;
mod alerts;
mod audit;
mod audit_log;
mod auth;
mod background;
mod claims;
mod client;
mod conditional;
mod config;
mod connection;
mod connection_quota;
mod evidence;
mod evidence_fit;
mod extract;
mod feed;
mod frame;
mod geojson;
mod guard;
mod history;
mod intake;
mod known_lights;
mod listener;
mod maintenance;
mod openapi;
mod page;
mod picture;
mod picture_cache;
mod pose;
mod pose_status;
mod positions;
mod probes;
mod problem;
mod respond;
mod server;
mod snapshot;
mod sse;
mod state;
mod stream;
mod table;
mod tokens;
mod webhooks;
mod websocket;
mod zones;

pub use background::{Background, Error as BackgroundError};
pub use config::{Config, ConfigError};
pub use feed::{Feed, Published};
pub use listener::{Listen, ListenError, Listener};
pub use picture::frame_png;
pub use pose_status::{PoseNow, PoseStatus};
pub use server::{Error, Server};
pub use snapshot::{
    ClaimsStatus, FitStatus, FrameCounts, JournalStatus, Latency, Snapshot, SourceState, SourceStatus, StationPlace,
    StationPose, StationState, StationStatus, Status, ViewStatus,
};
pub use state::{Acknowledged, Command, State, ZonesRefused};
pub use tokens::TokenError;

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{DefaultBodyLimit, MatchedPath, Request};
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::Response;
use axum::routing::get;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::compression::CompressionLayer;
use tower_http::cors::{AllowOrigin, CorsLayer};
use tower_http::decompression::RequestDecompressionLayer;
use tower_http::set_header::SetResponseHeaderLayer;
use tower_http::timeout::TimeoutLayer;

use crate::metric;

/// The largest body read, after decompression: about 20,000 claims.
const MAX_BODY_BYTES: usize = 4 << 20;

/// All routes under all guards, the outermost last.
fn router(state: State, config: &Config, tokens: Arc<tokens::Tokens>, proxies: Arc<client::TrustedProxies>) -> Router {
    let (routes, description) = openapi::router();
    let required = tokens.required();
    let audit = state.audit.clone();
    let origins = Arc::new(guard::Origins::new(config, required, audit.clone()));
    let per_second = NonZeroU32::new(config.requests_per_second).unwrap_or(NonZeroU32::MIN);
    let rates = Arc::new(guard::Rates::new(per_second, audit.clone()));
    let gate = Arc::new(auth::Gate { tokens, audit });
    let routes = routes
        .merge(openapi::serve(description, required))
        .route("/", get(page::index))
        .route("/page/{*path}", get(page::asset))
        .fallback(|| async { StatusCode::NOT_FOUND })
        .layer(DefaultBodyLimit::max(MAX_BODY_BYTES))
        .layer(RequestDecompressionLayer::new())
        .layer(CompressionLayer::new().gzip(true))
        .layer(from_fn_with_state(gate, auth::check))
        .layer(from_fn_with_state(origins, guard::origin))
        .layer(cors(config))
        .layer(from_fn_with_state(rates, guard::rate))
        .layer(from_fn_with_state(proxies, client::identify))
        .layer(TimeoutLayer::with_status_code(
            StatusCode::REQUEST_TIMEOUT,
            config.client_timeout(),
        ))
        .layer(CatchPanicLayer::new())
        .layer(from_fn(problem::for_every_error))
        .layer(fixed(header::X_CONTENT_TYPE_OPTIONS, "nosniff"))
        .layer(fixed(header::X_FRAME_OPTIONS, "DENY"))
        .layer(fixed(header::REFERRER_POLICY, "no-referrer"))
        .layer(fixed(
            HeaderName::from_static("cross-origin-opener-policy"),
            "same-origin",
        ));
    let routes = match config.hsts_max_age_s {
        0 => routes,
        max_age => routes.layer(strict_transport(max_age)),
    };
    routes.layer(from_fn(measure)).with_state(state)
}

/// Makes browsers use TLS only (RFC 6797).
fn strict_transport(max_age_s: u64) -> SetResponseHeaderLayer<HeaderValue> {
    let value = HeaderValue::from_str(&format!("max-age={max_age_s}")).expect("digits");
    SetResponseHeaderLayer::overriding(header::STRICT_TRANSPORT_SECURITY, value)
}

fn fixed(name: HeaderName, value: &'static str) -> SetResponseHeaderLayer<HeaderValue> {
    SetResponseHeaderLayer::if_not_present(name, HeaderValue::from_static(value))
}

/// Off unless origins are listed.
fn cors(config: &Config) -> CorsLayer {
    let origins: Vec<HeaderValue> = config.allowed_origins.iter().filter_map(|o| o.parse().ok()).collect();
    if origins.is_empty() {
        return CorsLayer::new();
    }
    CorsLayer::new()
        .allow_origin(AllowOrigin::list(origins))
        .allow_methods([Method::GET, Method::POST, Method::PUT, Method::DELETE])
        .allow_headers([header::AUTHORIZATION, header::CONTENT_TYPE, header::IF_NONE_MATCH])
        .expose_headers([header::ETAG, header::LINK, header::RETRY_AFTER])
        .max_age(Duration::from_secs(600))
}

/// Counts and times every request by its route's pattern, so that paths made up by clients make no new series.
async fn measure(request: Request, next: Next) -> Response {
    let started = Instant::now();
    let pattern = request.extensions().get::<MatchedPath>().map(|p| p.as_str().to_owned());
    let route = pattern.unwrap_or_else(|| "none".to_owned());
    let method = match *request.method() {
        Method::GET => "GET",
        Method::POST => "POST",
        Method::PUT => "PUT",
        Method::HEAD => "HEAD",
        Method::DELETE => "DELETE",
        _ => "other",
    };
    let response = next.run(request).await;
    let status = response.status().as_u16().to_string();
    metrics::histogram!(metric::HTTP_SECONDS, "route" => route.clone()).record(started.elapsed());
    metrics::counter!(metric::HTTP_REQUESTS, "method" => method, "route" => route, "status" => status).increment(1);
    response
}
