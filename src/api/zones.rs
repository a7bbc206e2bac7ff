//! `/v1/zones`: places with rules of their own, as GeoJSON.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::Value;

use super::client::Caller;
use super::extract::Query;
use super::geojson::MEDIA_TYPE;
use super::known_lights::{body_of, written};
use super::problem::Problem;
use super::state::{Command, State, ZonesRefused};
use crate::journal::AuditAction;
use crate::monitor::zones::{Coordinates, Zone, ZoneError, ZoneMap, collection, parse};

const LARGEST_BODY: usize = 4 << 20;

impl From<ZoneError> for Problem {
    fn from(error: ZoneError) -> Self {
        Self::new(StatusCode::UNPROCESSABLE_ENTITY, error.to_string())
    }
}

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct ZonesQuery {
    /// What corners are, in what is put and in what is answered: "metres" (east and north, when left out) or "degrees" (longitude and
    /// latitude, as RFC 7946 says), which need `[world] origin`
    #[param(inline)]
    #[serde(default)]
    coordinates: Coordinates,
}

fn answer(map: &ZoneMap, state: &State, coordinates: Coordinates) -> Result<Response, Problem> {
    let mut zones = collection(map.zones().iter());
    coordinates.write(&mut zones, state.axes.as_ref())?;
    let mut response = zones.to_string().into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Ok(tag) = HeaderValue::from_str(&tag(map)) {
        headers.insert(header::ETAG, tag);
    }
    Ok(response)
}

fn tag(map: &ZoneMap) -> String {
    format!("\"{:016x}\"", map.digest())
}

/// The digest that `If-Match` asks for.
fn wanted(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
    let Some(value) = headers.get(header::IF_MATCH) else {
        return Ok(None);
    };
    let text = value.to_str().unwrap_or_default().trim();
    if text == "*" {
        return Ok(None);
    }
    // One that no zones have is a change like any other.
    let digest = u64::from_str_radix(text.trim_matches('"'), 16);
    digest.map(Some).map_err(|_| changed())
}

fn changed() -> Problem {
    let detail = "somebody else has changed the zones since; read them again";
    Problem::new(StatusCode::PRECONDITION_FAILED, detail)
}

/// The zones in force, as a GeoJSON feature collection
///
/// `properties` has `name`, `kind` ("ignore", "restricted" or "watch"), `users`,
/// `tolerated_distance_m`, `severity`, `webhooks`, and `source`, "config" or "api".
#[utoipa::path(get, path = "/v1/zones", tag = "places", params(ZonesQuery),
    responses(
        (status = 200, description = "A feature for each zone; the ETag is for If-Match", body = Object, content_type = "application/geo+json"),
        (status = 400, description = "The query cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Degrees need [world] origin", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn get(Shared(state): Shared<State>, Query(query): Query<ZonesQuery>) -> Result<Response, Problem> {
    let map = state.ask(|reply| Command::Zones { reply }).await?;
    answer(&map, &state, query.coordinates)
}

/// Puts zones in force in place of those put before
///
/// Those of the config stay as they are; features with `"source": "config"` are left out, so that what was read can be changed and
/// put. With `If-Match` only if nobody else has changed them since.
#[utoipa::path(put, path = "/v1/zones", tag = "places",
    params(ZonesQuery, ("If-Match" = Option<String>, Header, description = "The ETag of the zones that were changed")),
    request_body(description = "A feature collection, at most 4 MiB and 1000 zones", content(
        (Object = "application/geo+json"), (Object = "application/json"))),
    responses(
        (status = 200, description = "The zones in force", body = Object, content_type = "application/geo+json"),
        (status = 400, description = "The query cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "This is a hub", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "Somebody else has changed them since", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "The body is not GeoJSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "A zone cannot be used; the detail names it", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn put(
    Shared(state): Shared<State>,
    caller: Caller,
    Query(query): Query<ZonesQuery>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let mut value: Value = body_of(&headers, body, LARGEST_BODY, &[MEDIA_TYPE, "application/json"])?;
    let (coordinates, axes) = (query.coordinates, state.axes);
    let read = move || {
        coordinates.read(&mut value, axes.as_ref())?;
        parse(&value)
    };
    let zones = tokio::task::spawn_blocking(read)
        .await
        .expect("reading zones does not panic")?;
    check_webhooks(&state, &zones)?;
    // Zones that cannot be used are refused as such, whatever was read before.
    let unless_changed = wanted(&headers)?;
    let put = state.ask(|reply| Command::PutZones {
        zones,
        unless_changed,
        reply,
    });
    let map = match put.await? {
        Ok(map) => map,
        Err(ZonesRefused::Bad(error)) => return Err(error.into()),
        Err(ZonesRefused::Changed) => return Err(changed()),
        Err(ZonesRefused::AtHub) => {
            let detail = "a hub has none of its own: set them at the access points";
            return Err(Problem::new(StatusCode::CONFLICT, detail));
        }
    };
    written(&state).await;
    let names: Vec<&str> = map
        .zones()
        .iter()
        .filter(|z| !z.is_fixed)
        .map(|z| z.name.as_str())
        .collect();
    let shown: String = names.join(", ").chars().take(500).collect();
    let detail = format!("{} zones: {shown}", names.len());
    state
        .audit
        .change(AuditAction::PutZones, &caller, "zones", Some(detail));
    answer(&map, &state, coordinates)
}

/// A zone whose webhook does not exist would send its alerts nowhere.
fn check_webhooks(state: &State, zones: &[Zone]) -> Result<(), Problem> {
    let known: Vec<String> = state.notifier.iter().flat_map(|n| n.status()).map(|e| e.name).collect();
    for zone in zones {
        if let Some(name) = zone.webhooks.iter().flatten().find(|name| !known.contains(name)) {
            let detail = format!(
                "zone {:?}: webhooks: expected the name of a webhook, found {name:?}",
                zone.name
            );
            return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, detail));
        }
    }
    Ok(())
}
