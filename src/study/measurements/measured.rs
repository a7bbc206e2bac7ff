//! What a measurement gives.

use crate::monitor::AlertKind;

/// What came of a measurement.
pub struct Measured {
    /// Markdown.
    pub text: String,
    /// Whether the requirement is met.
    pub holds: bool,
}

/// Takes a line of a table as soon as it is measured.
pub type Say<'a> = &'a mut dyn FnMut(&str);

/// Of alerts in the order in which they were raised: the kinds, users and times, s.
pub type Raised = Vec<(AlertKind, Option<String>, f64)>;

/// A line of what was raised in each story that is not as it should be.
pub fn exceptions(stories: &[(u64, Raised)]) -> String {
    let line = |(seed, raised): &(u64, Raised)| format!("story {seed}: {raised:?}\n");
    stories.iter().map(line).collect()
}
