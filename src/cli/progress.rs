//! Progress bars on stderr.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressStyle};

/// A bar on stderr for `len` things; hidden where stderr is not a terminal.
pub fn bar(len: u64, things: &str) -> ProgressBar {
    styled(
        ProgressBar::new(len),
        &format!("{{bar:40}} {{pos}}/{{len}} {things}, {{per_sec}}, {{eta}} left"),
    )
}

/// A count on stderr for a command that prints results while it runs; hidden where stdout is a terminal.
pub fn count(things: &str) -> ProgressBar {
    match std::io::stdout().is_terminal() {
        true => ProgressBar::hidden(),
        false => styled(
            ProgressBar::new_spinner(),
            &format!("{{spinner}} {{pos}} {things}, {{per_sec}}, {{elapsed}}"),
        ),
    }
}

fn styled(bar: ProgressBar, template: &str) -> ProgressBar {
    bar.with_style(ProgressStyle::with_template(template).expect("a valid template"))
}
