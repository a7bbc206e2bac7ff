//! All described routes and the OpenAPI document generated from the same code.

use axum::Json;
use axum::Router;
use axum::routing::get;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::openapi::{ContentBuilder, Ref, Response, ResponseBuilder};
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
    let (routes, mut description) = OpenApiRouter::with_openapi(Described::openapi())
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
        .split_for_parts();
    describe_refusals(&mut description);
    (routes, description)
}

/// Adds to every operation what the guards before it answer.
fn describe_refusals(description: &mut utoipa::openapi::OpenApi) {
    for (path, item) in &mut description.paths.paths {
        let is_probe = matches!(path.as_str(), "/healthz" | "/readyz");
        let operations = [
            (&mut item.get, false),
            (&mut item.put, true),
            (&mut item.post, true),
            (&mut item.delete, true),
        ];
        for (operation, changes) in operations {
            let refusals = [
                (
                    "401",
                    "A token is asked for, and none that is known was sent",
                    !is_probe,
                ),
                ("403", "The token may only look", changes),
                ("421", "The name in Host is not the monitor's", true),
                (
                    "429",
                    "Too many requests of one client; Retry-After says how long to wait",
                    !is_probe,
                ),
            ];
            for (status, meaning, _) in refusals.into_iter().filter(|r| r.2) {
                if let Some(operation) = operation {
                    let responses = &mut operation.responses.responses;
                    responses
                        .entry(status.to_owned())
                        .or_insert_with(|| problem(meaning).into());
                }
            }
        }
    }
}

fn problem(meaning: &str) -> Response {
    let body = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem")));
    ResponseBuilder::new()
        .description(meaning)
        .content("application/problem+json", body.build())
        .build()
}

/// Serves the description; where no token is asked for, it asks for none.
pub fn serve(mut description: utoipa::openapi::OpenApi, token_required: bool) -> Router<State> {
    if !token_required {
        description.security = None;
    }
    Router::new().route("/openapi.json", get(move || async move { Json(description) }))
}
