//! `/v1/positions.geojson`, `/v1/alerts.geojson` and `/v1/footprint.geojson`: positions, alerts and what the camera sees of the ground as
//! features on the earth (RFC 7946).

use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use jiff::Timestamp;
use serde::Serialize;

use super::alerts::{self, ListQuery, Page};
use super::extract::Query;
use super::problem::Problem;
use super::snapshot::ViewStatus;
use super::state::State;
use super::{conditional, positions, respond};
use crate::geo::{Geodetic, LocalAxes};
use crate::monitor::{Alert, Report, TrackedPosition};

pub(super) const MEDIA_TYPE: &str = "application/geo+json";

#[derive(Debug, Serialize, utoipa::ToSchema)]
enum FeatureCollection {
    FeatureCollection,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
enum FeatureType {
    Feature,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
enum PointType {
    Point,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Point {
    r#type: PointType,
    /// Longitude and latitude, degrees, and the height above the datum of `[world] origin`, m
    coordinates: [f64; 3],
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
enum PolygonType {
    Polygon,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Polygon {
    r#type: PolygonType,
    /// One ring, closed, counter-clockwise: longitude, latitude, degrees, and the height above the datum of `[world] origin`, m
    coordinates: [Vec<[f64; 3]>; 1],
}

/// What the camera sees of the ground in the latest frame.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Footprint {
    r#type: FeatureType,
    /// Null where less than a triangle is seen
    geometry: Option<Polygon>,
    properties: FootprintProperties,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct FootprintProperties {
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// Of the platform, clockwise from north
    heading_deg: f64,
    pose_age_s: f64,
}

/// The footprint as the only feature; none as long as no pose has come.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct FootprintFeatures {
    r#type: FeatureCollection,
    features: Vec<Footprint>,
}

impl Footprint {
    fn new(view: &ViewStatus, time: Timestamp, axes: &LocalAxes) -> Self {
        let points = view.footprint_m.iter().zip(&view.footprint_z_m);
        let mut ring: Vec<[f64; 3]> = points
            .map(|([x, y], z)| {
                let place = axes.to_geodetic([*x, *y, *z]);
                [place.longitude_deg, place.latitude_deg, place.height_m]
            })
            .collect();
        let is_area = ring.len() >= 3;
        ring.extend(ring.first().copied());
        Self {
            r#type: FeatureType::Feature,
            geometry: is_area.then_some(Polygon {
                r#type: PolygonType::Polygon,
                coordinates: [ring],
            }),
            properties: FootprintProperties {
                time,
                heading_deg: view.heading_deg,
                pose_age_s: view.pose_age_s,
            },
        }
    }
}

/// A track's number or an alert's id.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[serde(untagged)]
enum FeatureId {
    Track(u64),
    Alert(String),
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Feature<T> {
    r#type: FeatureType,
    id: FeatureId,
    /// Null where the place on the earth is not known
    geometry: Option<Point>,
    properties: T,
}

/// Beams as features, each with the properties that it has in `/v1/positions`.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct PositionFeatures {
    r#type: FeatureCollection,
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    frame: u64,
    features: Vec<Feature<TrackedPosition>>,
    unseen: Vec<String>,
}

/// A page of alerts as features, each with the properties that it has in `/v1/alerts`.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct AlertFeatures {
    r#type: FeatureCollection,
    /// Newest first.
    features: Vec<Feature<Alert>>,
    /// What to give as `cursor` for the next page; null on the last.
    next_cursor: Option<String>,
}

impl<T> Feature<T> {
    fn new(id: FeatureId, place: Option<Geodetic>, properties: T) -> Self {
        let point = |place: Geodetic| Point {
            r#type: PointType::Point,
            coordinates: [place.longitude_deg, place.latitude_deg, place.height_m],
        };
        Self {
            r#type: FeatureType::Feature,
            id,
            geometry: place.map(point),
            properties,
        }
    }
}

impl PositionFeatures {
    fn of(report: &Report) -> Self {
        let feature = |e: &TrackedPosition| Feature::new(FeatureId::Track(e.track), e.geodetic, e.clone());
        Self {
            r#type: FeatureCollection::FeatureCollection,
            time: report.time,
            frame: report.frame,
            features: report.emitters.iter().map(feature).collect(),
            unseen: report.unseen.clone(),
        }
    }
}

impl From<Page> for AlertFeatures {
    fn from(page: Page) -> Self {
        let feature = |alert: Alert| Feature::new(FeatureId::Alert(alert.id.clone()), alert.geodetic, alert);
        Self {
            r#type: FeatureCollection::FeatureCollection,
            features: page.alerts.into_iter().map(feature).collect(),
            next_cursor: page.next_cursor,
        }
    }
}

/// Refuses where no place is known on the earth.
fn check_origin(state: &State) -> Result<(), Problem> {
    let detail =
        "places are local metres only: GeoJSON has latitudes and longitudes, which need [world] origin in the config";
    state
        .has_latitudes
        .then_some(())
        .ok_or_else(|| Problem::not_found(detail))
}

fn respond<T: Serialize>(features: &T) -> Response {
    let mut response = respond::json(features);
    let media_type = HeaderValue::from_static(MEDIA_TYPE);
    response.headers_mut().insert(header::CONTENT_TYPE, media_type);
    response
}

/// Every beam of the latest frame as GeoJSON (RFC 7946)
///
/// Coordinates are longitude, latitude and height. `properties` are those of `/v1/positions`; at a hub `geometry` is null for a
/// beam whose access point has no origin.
#[utoipa::path(get, path = "/v1/positions.geojson", tag = "positions",
    responses(
        (status = 200, description = "A point for each beam", body = PositionFeatures, content_type = "application/geo+json"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 404, description = "The config has no [world] origin", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn positions(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    check_origin(&state)?;
    let latest = positions::latest(&state)?;
    Ok(conditional::answer(&headers, latest.seq, || {
        respond(&PositionFeatures::of(&latest.snapshot.report))
    }))
}

/// What the camera sees of the ground in the latest frame, as GeoJSON (RFC 7946)
#[utoipa::path(get, path = "/v1/footprint.geojson", tag = "positions",
    responses(
        (status = 200, description = "A polygon; none as long as no pose has come", body = FootprintFeatures, content_type = "application/geo+json"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 404, description = "The config has no [world] origin, or this is a hub", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn footprint(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    check_origin(&state)?;
    let axes = state.axes;
    let axes = axes.ok_or_else(|| Problem::not_found("a hub has no camera: ask a station"))?;
    let latest = positions::latest(&state)?;
    let view = latest.snapshot.status.view.as_ref();
    let features = view.map(|view| Footprint::new(view, latest.snapshot.report.time, &axes));
    Ok(conditional::answer(&headers, latest.seq, || {
        respond(&FootprintFeatures {
            r#type: FeatureCollection::FeatureCollection,
            features: features.into_iter().collect(),
        })
    }))
}

/// Alerts as GeoJSON (RFC 7946), newest first
///
/// Pages and filters are those of `/v1/alerts`. `geometry` is null for an alert that states no place.
#[utoipa::path(get, path = "/v1/alerts.geojson", tag = "alerts", params(ListQuery),
    responses(
        (status = 200, description = "A point for each alert; a Link header leads to the next page", body = AlertFeatures, content_type = "application/geo+json"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "The config has no [world] origin", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn alerts(
    Shared(state): Shared<State>,
    Query(query): Query<ListQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    check_origin(&state)?;
    let answer = |page: Page| respond(&AlertFeatures::from(page));
    alerts::page(&state, &query, "/v1/alerts.geojson", &headers, answer).await
}
