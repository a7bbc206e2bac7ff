use oapwatch::monitor::AlertKind;

/// Exactly these were raised, each within its interval, s, and nothing else. `log`: what to show where that is not so.
#[track_caller]
pub fn expect(
    raised: &[(AlertKind, Option<String>, f64)],
    expected: &[(AlertKind, Option<&str>, f64, f64)],
    log: &str,
) {
    let pairs = || raised.iter().zip(expected);
    let is_in_time = |at: f64, from: f64, to: f64| (from - 1e-9..=to + 1e-9).contains(&at);
    let as_wished = raised.len() == expected.len()
        && pairs().all(|(r, e)| r.0 == e.0 && r.1.as_deref() == e.1 && is_in_time(r.2, e.2, e.3));
    assert!(as_wished, "raised {raised:#?}\nexpected {expected:#?}\n{log}");
}
