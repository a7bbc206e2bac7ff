/// Where the frames come from, as alerts name it.
#[derive(Clone, Debug)]
pub struct Source {
    /// "simulator", "v4l2" or "replay".
    pub kind: String,
    /// The recording, where there is one.
    pub file: Option<String>,
    /// Frames per second, from which thresholds follow.
    pub rate_hz: f64,
}
