//! All described routes and the OpenAPI document generated from the same code.

use axum::Json;
use axum::Router;
use axum::routing::get;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::{Modify, OpenApi};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::state::State;
use super::{
    acknowledge, alerts, audit_log, background, claims, evidence, frame, geojson, known_lights, maintenance, pose,
    positions, probes, sse, webhooks, websocket, zones,
};

#[derive(OpenApi)]
#[openapi(
    info(title = "oapwatch", description = "Positions and alerts of a UAV-mounted optical access point's monitor."),
    modifiers(&Bearer),
    security(("bearer" = [])),
)]
struct Described;

struct Bearer;

impl Modify for Bearer {
    fn modify(&self, openapi: &mut utoipa::openapi::OpenApi) {
        let scheme = HttpBuilder::new()
            .scheme(HttpAuthScheme::Bearer)
            .description(Some(
                "Asked for when token files are configured. Read-only tokens may only GET.",
            ))
            .build();
        let components = openapi.components.get_or_insert_default();
        components.add_security_scheme("bearer", SecurityScheme::Http(scheme));
    }
}

/// The routes, and their description made from the same code.
pub fn router() -> (Router<State>, utoipa::openapi::OpenApi) {
    OpenApiRouter::with_openapi(Described::openapi())
        .routes(routes!(positions::positions))
        .routes(routes!(geojson::positions))
        .routes(routes!(geojson::footprint))
        .routes(routes!(positions::user_position))
        .routes(routes!(positions::history))
        .routes(routes!(positions::history_csv))
        .routes(routes!(positions::status))
        .routes(routes!(pose::pose))
        .routes(routes!(positions::stations))
        .routes(routes!(alerts::list))
        .routes(routes!(alerts::csv))
        .routes(routes!(geojson::alerts))
        .routes(routes!(alerts::get))
        .routes(routes!(acknowledge::acknowledge, acknowledge::unacknowledge))
        .routes(routes!(evidence::npy))
        .routes(routes!(evidence::png))
        .routes(routes!(evidence::json))
        .routes(routes!(claims::post))
        .routes(routes!(known_lights::list, known_lights::approve))
        .routes(routes!(known_lights::revoke))
        .routes(routes!(zones::get, zones::put))
        .routes(routes!(maintenance::list, maintenance::begin))
        .routes(routes!(maintenance::end))
        .routes(routes!(frame::frame_png))
        .routes(routes!(background::routes::description))
        .routes(routes!(background::routes::picture))
        .routes(routes!(background::routes::tile))
        .routes(routes!(websocket::websocket))
        .routes(routes!(sse::events))
        .routes(routes!(webhooks::list))
        .routes(routes!(webhooks::dead_letters))
        .routes(routes!(webhooks::replay))
        .routes(routes!(webhooks::enable))
        .routes(routes!(webhooks::test))
        .routes(routes!(audit_log::list))
        .routes(routes!(probes::healthz))
        .routes(routes!(probes::readyz))
        .routes(routes!(probes::metrics))
        .split_for_parts()
}

/// Serves the description; where no token is asked for, it asks for none.
pub fn serve(mut description: utoipa::openapi::OpenApi, token_required: bool) -> Router<State> {
    if !token_required {
        description.security = None;
    }
    Router::new().route("/openapi.json", get(move || async move { Json(description) }))
}
