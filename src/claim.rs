//! A position that the access network asserts for a user. An attacker may write one.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::openapi::schema::{
    ArrayBuilder, KnownFormat, ObjectBuilder, OneOfBuilder, Schema, SchemaFormat, SchemaType, Type,
};

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
    /// Height above the world's origin; on the ground where it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = -1e7, maximum = 1e7)]
    pub z_m: Option<f64>,
    /// Standard deviation per axis of the claimed position.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    pub sigma_m: Option<f64>,
    /// Covariance of the claimed position, in place of `sigma_m`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(schema_with = cov_schema)]
    pub cov_m2: Option<[[f64; 2]; 2]>,
    /// Power that the user reports to send; evidence only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    pub power_w: Option<f64>,
    #[serde(default)]
    #[schema(nullable)]
    pub state: ClaimState,
}

impl Claim {
    /// An active user's claim to be at a place, m, without a word on its error.
    pub fn at(time: Timestamp, user: String, [x_m, y_m]: [f64; 2]) -> Self {
        Self {
            time,
            user,
            x_m,
            y_m,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        }
    }
}

/// Whether the user still transmits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ClaimState {
    #[default]
    Active,
    Ended,
}

/// Characters that a reader does not see or that change how the rest of a line is drawn: general categories Cc, Cf, Zl and
/// Zp, and the other default-ignorable code points (Unicode 16.0, DerivedCoreProperties.txt), with the blanks U+2800 and
/// U+3164. Sorted; both ends belong to a range.
const UNDISPLAYABLE: [(u32, u32); 36] = [
    (0x0000, 0x001f),
    (0x007f, 0x009f),
    (0x00ad, 0x00ad),
    (0x034f, 0x034f),
    (0x0600, 0x0605),
    (0x061c, 0x061c),
    (0x06dd, 0x06dd),
    (0x070f, 0x070f),
    (0x0890, 0x0891),
    (0x08e2, 0x08e2),
    (0x115f, 0x1160),
    (0x17b4, 0x17b5),
    (0x180b, 0x180f),
    (0x200b, 0x200f),
    (0x2028, 0x202e),
    (0x2060, 0x206f),
    (0x2800, 0x2800),
    (0x3164, 0x3164),
    (0xe000, 0xf8ff),
    (0xfe00, 0xfe0f),
    (0xfeff, 0xfeff),
    (0xffa0, 0xffa0),
    (0xfff0, 0xfffb),
    (0xfffe, 0xffff),
    (0x110bd, 0x110bd),
    (0x110cd, 0x110cd),
    (0x13430, 0x1343f),
    (0x1bca0, 0x1bca3),
    (0x1d173, 0x1d17a),
    (0x1fffe, 0x1ffff),
    (0x2fffe, 0x2ffff),
    (0x3fffe, 0x3ffff),
    (0xe0000, 0xe0fff),
    (0xefffe, 0xeffff),
    (0xf0000, 0xfffff),
    (0x100000, 0x10ffff),
];

fn is_displayable(c: char) -> bool {
    let code = u32::from(c);
    let next = UNDISPLAYABLE.partition_point(|(_, last)| *last < code);
    UNDISPLAYABLE.get(next).is_none_or(|(first, _)| code < *first)
}

/// Whether a user name can be told from others by looking at it: something of it is visible, no white space stands at its
/// ends, and it holds no control, format, bidirectional, zero-width or private-use character.
pub fn is_displayable_name(name: &str) -> bool {
    !name.is_empty() && name.trim() == name && name.chars().all(is_displayable)
}

/// `text` for logs and messages: each character that [`is_displayable_name`] refuses anywhere becomes `\u{…}`.
pub fn escape_undisplayable(text: &str) -> std::borrow::Cow<'_, str> {
    if text.chars().all(is_displayable) {
        return text.into();
    }
    let mut escaped = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match is_displayable(c) {
            true => escaped.push(c),
            false => escaped.extend(c.escape_unicode()),
        }
    }
    escaped.into()
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

/// [`is_displayable_name`] as a regular expression. Characters beyond the basic plane stand as they are: the dialects of
/// JSON Schema's readers have no escape for them in common.
fn name_pattern() -> String {
    let write = |code: u32| match char::from_u32(code) {
        Some(c) if code > 0xffff => c.to_string(),
        _ => format!("\\u{code:04x}"),
    };
    let refused: String = UNDISPLAYABLE
        .iter()
        .map(|(first, last)| format!("{}-{}", write(*first), write(*last)))
        .collect();
    format!(r"^(?!\s)[^{refused}]+(?<!\s)$")
}

fn user_schema() -> Schema {
    let text = ObjectBuilder::new()
        .schema_type(Type::String)
        .min_length(Some(1))
        .max_length(Some(256))
        .description(Some(
            "No control, format, bidirectional, zero-width or private-use character; no white space at the ends",
        ))
        .pattern(Some(name_pattern()));
    let either = OneOfBuilder::new().item(text).item(number()).build();
    Schema::OneOf(either)
}

fn cov_schema() -> Schema {
    let two = || ArrayBuilder::new().min_items(Some(2)).max_items(Some(2));
    // What is null counts as left out.
    let rows = two()
        .schema_type(SchemaType::from_iter([Type::Array, Type::Null]))
        .items(two().items(number()));
    Schema::Array(rows.description(Some("Symmetric and not negative, m²")).build())
}

fn number() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::Number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_cannot_be_seen_or_turn_a_line_round_are_refused() {
        for good in ["u-17", "7", "Zoë", "用户-3", "пользователь", "مستخدم", "a b", "🚁1"] {
            assert!(is_displayable_name(good), "{good:?}");
            assert_eq!(escape_undisplayable(good), good);
        }
        for bad in [
            "",
            " ",
            "\u{a0}",
            "\u{2003}",
            "u-1 ",
            " u-1",
            "u\n1",
            "u\u{0}",
            "\u{200b}",
            "u\u{200d}1",
            "u\u{ad}1",
            "u\u{202e}1",
            "u\u{2066}1",
            "u\u{feff}",
            "u\u{2028}1",
            "\u{2800}",
            "\u{3164}",
            "u\u{e0041}",
            "u\u{fe0f}",
            "u\u{e000}",
            "u\u{10fffd}",
        ] {
            assert!(!is_displayable_name(bad), "{bad:?}");
        }
        assert_eq!(escape_undisplayable("u\u{202e}1\n"), "u\\u{202e}1\\u{a}");
    }

    #[test]
    fn the_ranges_are_in_order_and_apart() {
        assert!(UNDISPLAYABLE.iter().all(|(first, last)| first <= last));
        assert!(UNDISPLAYABLE.windows(2).all(|w| w[0].1 < w[1].0));
    }
}
