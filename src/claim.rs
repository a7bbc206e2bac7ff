//! A position that the access network asserts for a user. An attacker may write one.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::openapi::schema::{KnownFormat, ObjectBuilder, OneOfBuilder, Schema, SchemaFormat, Type};

/// One line of the network's log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Claim {
    #[schema(schema_with = time_schema)]
    pub time: Timestamp,
    #[schema(schema_with = user_schema)]
    pub user: String,
    #[schema(minimum = -1e7, maximum = 1e7)]
    pub x_m: f64,
    #[schema(minimum = -1e7, maximum = 1e7)]
    pub y_m: f64,
    /// Standard deviation per axis of the claimed position.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    pub sigma_m: Option<f64>,
    /// Power that the user reports to send; evidence only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    pub power_w: Option<f64>,
    #[serde(default)]
    #[schema(nullable)]
    pub state: ClaimState,
}

/// Whether the user still transmits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ClaimState {
    #[default]
    Active,
    Ended,
}

/// Logs have numbers for times and for names too.
fn time_schema() -> Schema {
    let text = ObjectBuilder::new()
        .schema_type(Type::String)
        .format(Some(SchemaFormat::KnownFormat(KnownFormat::DateTime)));
    let seconds = number().description(Some("Seconds since 1970")).minimum(Some(0.0));
    let either = OneOfBuilder::new()
        .item(text)
        .item(seconds.exclusive_maximum(Some(1e11)))
        .build();
    Schema::OneOf(either)
}

fn user_schema() -> Schema {
    let text = ObjectBuilder::new()
        .schema_type(Type::String)
        .min_length(Some(1))
        .max_length(Some(256))
        .pattern(Some(r"^[^\x00-\x1f\x7f-\x9f]+$"));
    let either = OneOfBuilder::new().item(text).item(number()).build();
    Schema::OneOf(either)
}

fn number() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::Number)
}
