//! Formats, subscriptions and data in the order of the file → the log.

use std::collections::HashMap;

use super::log::{Attitude, Axes, Log, Place};
use super::message::{Basic, Data, Number};

/// Bits of the incompatibility flags that are understood: data may be appended, which is only read in order here.
const KNOWN_FLAGS: u8 = 1;
/// Formats hold others; no log nests them deeper than twice.
const DEEPEST: usize = 8;

/// The topics that are read.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Topic {
    Attitude,
    Local,
    Global,
    Gps,
}

/// A subscribed message: its topic, and where its numbers lie.
struct Subscription {
    topic: Topic,
    fields: HashMap<String, Number>,
}

/// What the messages so far have said.
#[derive(Default)]
pub struct Parser {
    /// The fields of a message by its name: type, count and name of each.
    formats: HashMap<String, Vec<(String, usize, String)>>,
    subscriptions: HashMap<u16, Subscription>,
    globals: Vec<Place>,
    utc_minus_boot_us: Vec<i64>,
    undulations_m: Vec<f64>,
    pub log: Log,
}

impl Parser {
    pub fn message(&mut self, kind: u8, body: &[u8]) -> Result<(), String> {
        match kind {
            b'B' => {
                let incompatible = body.get(8..16).ok_or("a flags message that is too short")?;
                if incompatible[0] & !KNOWN_FLAGS != 0 || incompatible[1..].iter().any(|b| *b != 0) {
                    return Err("the log needs a newer reader (incompatibility flags)".to_owned());
                }
            }
            b'F' => self.format(body)?,
            b'A' => self.subscribe(body)?,
            b'D' => self.data(body),
            // Parameters, texts, drop-outs and what later versions add.
            _ => {}
        }
        Ok(())
    }

    /// `name:type field;type[n] field;`
    fn format(&mut self, body: &[u8]) -> Result<(), String> {
        let text = std::str::from_utf8(body).map_err(|_| "a format that is not UTF-8")?;
        let (name, fields) = text.split_once(':').ok_or("a format without a name")?;
        let mut read = Vec::new();
        for field in fields.split(';').filter(|f| !f.is_empty()) {
            let (kind, field) = field
                .split_once(' ')
                .ok_or_else(|| format!("format {name}: a field without a type"))?;
            let (kind, count) = match kind.strip_suffix(']').and_then(|k| k.split_once('[')) {
                None => (kind, 1),
                Some((kind, count)) => {
                    let count = count
                        .parse()
                        .map_err(|_| format!("format {name}: expected a count, found {count:?}"))?;
                    (kind, usize::from(u16::min(count, u16::MAX)))
                }
            };
            read.push((kind.to_owned(), count, field.to_owned()));
        }
        self.formats.insert(name.to_owned(), read);
        Ok(())
    }

    /// Of several instances only the first is the one that flies.
    fn subscribe(&mut self, body: &[u8]) -> Result<(), String> {
        let [instance, low, high, ref name @ ..] = *body else {
            return Err("a subscription that is too short".to_owned());
        };
        let topic = match name {
            b"vehicle_attitude" => Topic::Attitude,
            b"vehicle_local_position" => Topic::Local,
            b"vehicle_global_position" => Topic::Global,
            b"vehicle_gps_position" => Topic::Gps,
            _ => return Ok(()),
        };
        if instance > 0 {
            return Ok(());
        }
        let name = String::from_utf8_lossy(name);
        let mut fields = HashMap::new();
        self.lay_out(&name, "", 0, DEEPEST, &mut fields)?;
        self.subscriptions
            .insert(u16::from_le_bytes([low, high]), Subscription { topic, fields });
        Ok(())
    }

    /// Collects the numbers of a format from `at` on, and returns where it ends. Elements of arrays are called `name[k]`.
    fn lay_out(
        &self,
        format: &str,
        prefix: &str,
        mut at: usize,
        depth: usize,
        found: &mut HashMap<String, Number>,
    ) -> Result<usize, String> {
        let fields = self
            .formats
            .get(format)
            .ok_or_else(|| format!("no format of {format}"))?;
        for (kind, count, name) in fields {
            for k in 0..*count {
                let name = match count {
                    1 => format!("{prefix}{name}"),
                    _ => format!("{prefix}{name}[{k}]"),
                };
                let end = match Basic::of(kind) {
                    Some(kind) => {
                        found.insert(name, Number { kind, at });
                        at + kind.size()
                    }
                    None if depth > 0 => self.lay_out(kind, &format!("{name}."), at, depth - 1, found)?,
                    None => return Err(format!("format {format}: nested too deeply")),
                };
                if end == at {
                    return Err(format!("format {kind}: no fields"));
                }
                at = end;
                if at > usize::from(u16::MAX) {
                    return Err(format!("format {format}: longer than a message can be"));
                }
            }
        }
        Ok(at)
    }

    fn data(&mut self, body: &[u8]) {
        let [low, high, ref bytes @ ..] = *body else {
            return;
        };
        let Some(Subscription { topic, fields }) = self.subscriptions.get(&u16::from_le_bytes([low, high])) else {
            return;
        };
        let data = Data { bytes, fields };
        let Some(time_us) = data.time_us() else {
            return;
        };
        match topic {
            Topic::Attitude => {
                let q = ["q[0]", "q[1]", "q[2]", "q[3]"].map(|name| data.get(name));
                self.log.attitudes.push(Attitude { time_us, q });
            }
            Topic::Local => self.log.places.push(local(&data, time_us)),
            Topic::Global => self.globals.push(Place {
                time_us,
                axes: Axes::None,
                ned_m: [0.0; 3],
                reference: [data.get("lat"), data.get("lon"), data.get("alt")],
                sigma_m: [data.get("eph"), data.get("epv")],
            }),
            Topic::Gps => {
                let stamp = data.integer("timestamp").unwrap_or(0);
                if let Some(utc) = data.integer("time_utc_usec").filter(|t| *t > 0) {
                    self.utc_minus_boot_us.push(utc.saturating_sub(stamp));
                }
                // Integers in mm, in newer versions metres.
                let undulation = (data.get("alt_ellipsoid") - data.get("alt")) * 1e-3;
                let newer = data.get("altitude_ellipsoid_m") - data.get("altitude_msl_m");
                let found = if undulation.is_nan() { newer } else { undulation };
                if found != 0.0 && found.abs() < 150.0 {
                    self.undulations_m.push(found);
                }
            }
        }
    }

    pub fn finish(mut self) -> Log {
        if self.log.places.is_empty() {
            self.log.places = self.globals;
        }
        self.utc_minus_boot_us.sort_unstable();
        self.undulations_m.sort_unstable_by(f64::total_cmp);
        self.log.utc_minus_boot_us = self.utc_minus_boot_us.get(self.utc_minus_boot_us.len() / 2).copied();
        self.log.undulation_m = self.undulations_m.get(self.undulations_m.len() / 2).copied();
        self.log
    }
}

fn local(data: &Data, time_us: u64) -> Place {
    let valid = |flag: &str, value: f64| if data.is_set(flag) { value } else { f64::NAN };
    let global = |flag: &str, names: &[&str]| match data.integer(flag) {
        Some(1) => data.any(names),
        _ => f64::NAN,
    };
    Place {
        time_us,
        axes: Axes::Local,
        ned_m: [
            valid("xy_valid", data.get("x")),
            valid("xy_valid", data.get("y")),
            valid("z_valid", data.get("z")),
        ],
        reference: [
            global("xy_global", &["ref_lat"]),
            global("xy_global", &["ref_lon"]),
            global("z_global", &["ref_alt"]),
        ],
        sigma_m: [data.get("eph"), data.get("epv")],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nested_formats_without_a_field_are_refused_at_once() {
        let mut parser = Parser::default();
        for format in ["vehicle_attitude:b[65535] x;", "b:c[65535] y;", "c:"] {
            parser.message(b'F', format.as_bytes()).unwrap();
        }
        let refused = parser.message(b'A', b"\0\x01\0vehicle_attitude").unwrap_err();
        assert_eq!(refused, "format c: no fields");
    }
}
