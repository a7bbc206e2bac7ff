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

/// Whether the name begins with one of `only`, in whole words; true where there is none.
pub fn is_named(name: &str, only: &[String]) -> bool {
    let name = name.to_lowercase();
    let begins = |text: &String| {
        let rest = name.strip_prefix(&text.to_lowercase());
        rest.is_some_and(|rest| !rest.starts_with(char::is_alphanumeric))
    };
    only.is_empty() || only.iter().any(begins)
}
