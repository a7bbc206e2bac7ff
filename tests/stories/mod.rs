//! The stories of `study::stories`, and what a test expects of one.
#![allow(unused_imports, dead_code, reason = "each test file takes what it needs")]

mod expected;

pub use oapwatch::study::stories::*;

pub trait Expect {
    /// Exactly these were raised, each within its interval, and nothing else.
    fn expect(&self, expected: &[(oapwatch::monitor::AlertKind, Option<&str>, f64, f64)]);
}

impl Expect for Told {
    #[track_caller]
    fn expect(&self, expected: &[(oapwatch::monitor::AlertKind, Option<&str>, f64, f64)]) {
        expected::expect(&self.raised(), expected, &self.ndjson());
    }
}
