//! Cursor on Target (MITRE, event schema 2.0): what a TAK client reports of itself, an event a line.

use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};
use serde_json::{Map, Value};

use crate::claim::Claim;
use crate::claims::config::Config;
use crate::claims::line::{self, LineError, number, optional, required, wrong};

/// From here on an error is unknown: the schema writes 9999999.
const UNKNOWN_M: f64 = 9_999_999.0;
const TYPE: &str = "a type that begins with a-: a thing with a place";

/// The user is the event's `uid`, or its callsign where `claims.fields.user` is "callsign".
pub(super) fn parse(line: &[u8], config: &Config) -> Result<Claim, LineError> {
    let object = Value::Object(attributes(line)?);
    let kind = required(&object, "type", TYPE)?;
    if !kind.as_str().is_some_and(|kind| kind.starts_with("a-")) {
        return Err(wrong("type", TYPE, kind));
    }
    let user = match config.fields.user.as_str() {
        "callsign" => "callsign",
        _ => "uid",
    };
    // The schema: where ce is an error it is one standard deviation.
    let sigma_m = match optional(&object, "ce") {
        None => None,
        Some(_) => Some(number(&object, "ce", "metres, zero or more", |ce| ce >= 0.0)?),
    };
    Ok(Claim {
        sigma_m: sigma_m.filter(|ce| *ce < UNKNOWN_M),
        ..Claim::at(
            line::time("time", required(&object, "time", line::TIME)?, config.clock_offset_s)?,
            line::user(user, required(&object, user, line::USER)?)?,
            // Its height is above the ellipsoid, which ours need not be.
            line::place(&object, "lat", "lon", "/none", config)?.0,
        )
    })
}

/// The attributes of `event` and `point` and the callsign of `contact`; those of `point` as numbers.
fn attributes(line: &[u8]) -> Result<Map<String, Value>, LineError> {
    let text = std::str::from_utf8(line).map_err(|e| LineError::NotXml(e.to_string()))?;
    let mut reader = Reader::from_str(text.trim_start_matches('\u{feff}'));
    let mut found = Map::new();
    let (mut depth, mut roots) = (0, 0);
    loop {
        let event = reader.read_event().map_err(|e| LineError::NotXml(e.to_string()))?;
        match event {
            Event::Start(_) | Event::Empty(_) if depth == 0 && roots == 1 => {
                return Err(LineError::NotXml(
                    "expected one event, found another behind it".to_owned(),
                ));
            }
            Event::Start(element) => {
                roots += usize::from(depth == 0);
                take(&element, depth, &mut found)?;
                depth += 1;
            }
            Event::Empty(element) => {
                roots += usize::from(depth == 0);
                take(&element, depth, &mut found)?;
            }
            Event::End(_) => depth -= 1,
            Event::Eof if depth > 0 => return Err(LineError::NotXml("the event does not end".to_owned())),
            Event::Eof => break,
            _ => {}
        }
    }
    match found.contains_key("type") || found.contains_key("uid") {
        true => Ok(found),
        false => Err(LineError::NotXml("expected an <event>, found none".to_owned())),
    }
}

fn take(element: &BytesStart<'_>, depth: usize, found: &mut Map<String, Value>) -> Result<(), LineError> {
    let (names, is_number): (&[&str], bool) = match (depth, element.name().0) {
        (0, "event") => (&["uid", "type", "time"], false),
        (1, "point") => (&["lat", "lon", "ce"], true),
        (2, "contact") => (&["callsign"], false),
        _ => return Ok(()),
    };
    for attribute in element.attributes() {
        let attribute = attribute.map_err(|e| LineError::NotXml(e.to_string()))?;
        let Some(name) = names.iter().find(|name| **name == attribute.key.0) else {
            continue;
        };
        let text = attribute
            .normalized_value(XmlVersion::Implicit1_0)
            .map_err(|e| LineError::NotXml(e.to_string()))?;
        let value = match text.parse::<f64>() {
            Ok(value) if is_number => Value::from(value),
            _ => Value::from(text.as_ref()),
        };
        found.insert((*name).to_owned(), value);
    }
    Ok(())
}
