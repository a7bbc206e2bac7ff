//! Progress on stderr: bars on a terminal, a line now and then elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Redraws a bar although nothing is finished, so that the time grows.
const TICK: Duration = Duration::from_millis(200);
/// Where stderr is not a terminal, a line is written at most this often.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// A bar on stderr for `len` things; hidden where stderr is not a terminal.
pub fn bar(len: u64, things: &str) -> ProgressBar {
    styled(
        ProgressBar::new(len),
        &format!("{{bar:40}} {{pos}}/{{len}} {things}, {{elapsed}}, {{per_sec}}, {{eta}} left"),
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
    let bar = bar.with_style(ProgressStyle::with_template(template).expect("a valid template"));
    bar.enable_steady_tick(TICK);
    bar
}

/// Steps of a command that takes minutes: also where stderr is a file, it says now and then how far it is.
pub struct Steps {
    bar: ProgressBar,
    total: Option<u64>,
    done: u64,
    said: Instant,
}

impl Steps {
    pub fn new(total: u64) -> Self {
        Self::with(Some(total), "{bar:40} {pos}/{len} {elapsed} (left {eta}) {msg}")
    }

    /// Steps whose number is not known beforehand.
    pub fn unbounded() -> Self {
        Self::with(None, "{spinner} {elapsed} {msg}")
    }

    fn with(total: Option<u64>, template: &str) -> Self {
        Self {
            bar: styled(total.map_or_else(ProgressBar::new_spinner, ProgressBar::new), template),
            total,
            done: 0,
            said: Instant::now(),
        }
    }

    /// A step is done; `message` names it.
    pub fn next(&mut self, message: &str) {
        self.done += 1;
        self.bar.set_message(message.to_owned());
        self.bar.inc(1);
        if !std::io::stderr().is_terminal() && self.said.elapsed() > LINE_EVERY {
            self.said = Instant::now();
            match self.total {
                Some(total) => eprintln!("oapwatch: {} of {total}: {message}", self.done),
                None => eprintln!("oapwatch: {message}"),
            }
        }
    }

    /// Runs something that prints, with the bar out of its way.
    pub fn suspend<T>(&self, print: impl FnOnce() -> T) -> T {
        self.bar.suspend(print)
    }

    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
