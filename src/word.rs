//! Names of variants as they stand in JSON, for the log, metrics, the journal and other systems.

/// A unit variant's name.
pub fn word(variant: impl serde::Serialize) -> String {
    match serde_json::to_value(variant) {
        Ok(serde_json::Value::String(word)) => word,
        other => unreachable!("a unit variant serialises to a string, not {other:?}"),
    }
}
