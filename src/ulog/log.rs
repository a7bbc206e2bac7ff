//! What a log holds.

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
