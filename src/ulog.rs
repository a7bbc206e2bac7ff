//! Flight logs of PX4 (`.ulg`): attitudes, places and GNSS time (docs.px4.io, "ULog File Format").

use std::collections::HashMap;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

const MAGIC: [u8; 7] = *b"ULog\x01\x12\x35";
const HEADER: usize = 16;
/// Bits of the incompatibility flags that are understood: data may be appended, which is only read in order here.
const KNOWN_FLAGS: u8 = 1;
/// Formats hold others; no log nests them deeper than twice.
const DEEPEST: usize = 8;

/// Why a file is no log that can be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: at byte {at}: {message}")]
    Malformed { path: PathBuf, at: u64, message: String },
}

/// The attitude at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attitude {
    /// Since the autopilot started, µs.
    pub time_us: u64,
    /// Body (forward, right, down) to north, east, down: w, x, y, z.
    pub q: [f64; 4],
}

/// The place at a time. What the log does not give or calls invalid is NaN.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    pub time_us: u64,
    pub axes: Axes,
    /// North, east, down of the reference, m.
    pub ned_m: [f64; 3],
    /// Latitude and longitude of the reference, degrees, and its height above mean sea level, m.
    pub reference: [f64; 3],
    /// Standard deviations, horizontal and vertical, m.
    pub sigma_m: [f64; 2],
}

/// Whether places are counted from one reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axes {
    /// They are north, east and down of it.
    Local,
    /// The reference is the place itself.
    None,
}

/// What a log says of where the platform was and how it was turned, in the order of the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Log {
    pub attitudes: Vec<Attitude>,
    /// Of `vehicle_local_position`, or of `vehicle_global_position` where the log has no other.
    pub places: Vec<Place>,
    /// GNSS time since 1970 minus the autopilot's, µs: the median.
    pub utc_minus_boot_us: Option<i64>,
    /// Height of the sea level above the ellipsoid, m, by the GNSS receiver: the median.
    pub undulation_m: Option<f64>,
    /// Whether the file ends in the middle of a message, as it does when the power is cut.
    pub is_cut_off: bool,
}

/// Reads a log.
///
/// # Errors
/// The file cannot be read, or is no log; the message names the byte.
pub fn read(path: &Path) -> Result<Log, Error> {
    let unreadable = |source| Error::Unreadable {
        path: path.to_owned(),
        source,
    };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    read_from(std::io::BufReader::new(file)).map_err(|fault| match fault {
        Fault::Read(source) => unreadable(source),
        Fault::Malformed(at, message) => Error::Malformed {
            path: path.to_owned(),
            at,
            message,
        },
    })
}

/// Why bytes are no log: they cannot be read, or what stands at a byte.
#[derive(Debug)]
pub enum Fault {
    Read(std::io::Error),
    Malformed(u64, String),
}

impl From<std::io::Error> for Fault {
    fn from(error: std::io::Error) -> Self {
        Self::Read(error)
    }
}

/// Reads a log from its first byte.
///
/// # Errors
/// As of [`read`].
pub fn read_from(mut input: impl Read) -> Result<Log, Fault> {
    let mut header = [0; HEADER];
    let length = fill(&mut input, &mut header)?;
    if length < HEADER || header[..7] != MAGIC {
        return Err(Fault::Malformed(
            0,
            "expected a PX4 log (ULog), found something else".to_owned(),
        ));
    }
    let mut at = HEADER as u64;
    let mut parser = Parser::default();
    let mut body = Vec::new();
    loop {
        let mut head = [0; 3];
        let length = fill(&mut input, &mut head)?;
        body.resize(usize::from(u16::from_le_bytes([head[0], head[1]])), 0);
        if length == 0 {
            break;
        }
        if length < head.len() || fill(&mut input, &mut body)? < body.len() {
            parser.log.is_cut_off = true;
            break;
        }
        parser
            .message(head[2], &body)
            .map_err(|message| Fault::Malformed(at, message))?;
        at += (head.len() + body.len()) as u64;
    }
    Ok(parser.finish())
}

/// Reads until `buffer` is full or the input ends.
fn fill(input: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match input.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

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

/// A number of a basic type at an offset.
#[derive(Clone, Copy)]
struct Number {
    kind: Basic,
    at: usize,
}

#[derive(Clone, Copy)]
enum Basic {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Basic {
    fn of(name: &str) -> Option<Self> {
        Some(match name {
            "uint8_t" | "bool" | "char" => Self::U8,
            "int8_t" => Self::I8,
            "uint16_t" => Self::U16,
            "int16_t" => Self::I16,
            "uint32_t" => Self::U32,
            "int32_t" => Self::I32,
            "uint64_t" => Self::U64,
            "int64_t" => Self::I64,
            "float" => Self::F32,
            "double" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }
}

/// A message's data, whose numbers are read by name; one that is not there is NaN.
struct Data<'a> {
    bytes: &'a [u8],
    fields: &'a HashMap<String, Number>,
}

impl Data<'_> {
    fn get(&self, name: &str) -> f64 {
        self.integer(name)
            .map_or_else(|| self.float(name).unwrap_or(f64::NAN), |v| v as f64)
    }

    /// The first of these fields that the message has: names differ between PX4's versions.
    fn any(&self, names: &[&str]) -> f64 {
        let found = names.iter().map(|name| self.get(name));
        found.into_iter().find(|v| !v.is_nan()).unwrap_or(f64::NAN)
    }

    /// Whether a flag is set; those of older versions are not there and count as set.
    fn is_set(&self, name: &str) -> bool {
        self.integer(name) != Some(0)
    }

    /// `timestamp_sample`, when it was measured, or `timestamp`, when it was published.
    fn time_us(&self) -> Option<u64> {
        let sample = self.integer("timestamp_sample").filter(|t| *t > 0);
        sample
            .or_else(|| self.integer("timestamp"))
            .and_then(|t| u64::try_from(t).ok())
    }

    fn integer(&self, name: &str) -> Option<i64> {
        let Number { kind, at } = *self.fields.get(name)?;
        Some(match kind {
            Basic::U8 => u8::from_le_bytes(self.take(at)?).into(),
            Basic::I8 => i8::from_le_bytes(self.take(at)?).into(),
            Basic::U16 => u16::from_le_bytes(self.take(at)?).into(),
            Basic::I16 => i16::from_le_bytes(self.take(at)?).into(),
            Basic::U32 => u32::from_le_bytes(self.take(at)?).into(),
            Basic::I32 => i32::from_le_bytes(self.take(at)?).into(),
            Basic::U64 => u64::from_le_bytes(self.take(at)?).try_into().ok()?,
            Basic::I64 => i64::from_le_bytes(self.take(at)?),
            Basic::F32 | Basic::F64 => return None,
        })
    }

    fn float(&self, name: &str) -> Option<f64> {
        let Number { kind, at } = *self.fields.get(name)?;
        match kind {
            Basic::F32 => Some(f32::from_le_bytes(self.take(at)?).into()),
            Basic::F64 => Some(f64::from_le_bytes(self.take(at)?)),
            _ => None,
        }
    }

    fn take<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        self.bytes.get(at..)?.first_chunk().copied()
    }
}

#[derive(Default)]
struct Parser {
    /// The fields of a message by its name: type, count and name of each.
    formats: HashMap<String, Vec<(String, usize, String)>>,
    subscriptions: HashMap<u16, Subscription>,
    globals: Vec<Place>,
    utc_minus_boot_us: Vec<i64>,
    undulations_m: Vec<f64>,
    log: Log,
}

impl Parser {
    fn message(&mut self, kind: u8, body: &[u8]) -> Result<(), String> {
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
                at = match Basic::of(kind) {
                    Some(kind) => {
                        found.insert(name, Number { kind, at });
                        at + kind.size()
                    }
                    None if depth > 0 => self.lay_out(kind, &format!("{name}."), at, depth - 1, found)?,
                    None => return Err(format!("format {format}: nested too deeply")),
                };
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

    fn finish(mut self) -> Log {
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
