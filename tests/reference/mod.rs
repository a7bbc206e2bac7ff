//! Tables that another tool computed, and the error against them as quantiles.

/// Rows of a CSV table of numbers; the header is checked.
pub fn table<const N: usize>(text: &str, header: [&str; N]) -> Vec<[f64; N]> {
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some(header.join(",").as_str()));
    lines
        .map(|line| {
            let row: Vec<f64> = line.split(',').map(|v| v.parse().expect("a number")).collect();
            row.try_into().expect("as many fields as the header")
        })
        .collect()
}

/// How far a set of results is from its reference.
#[derive(Debug)]
pub struct Quantiles {
    pub q75: f64,
    pub q99: f64,
    pub max: f64,
}

/// Quantiles of the errors; printed, so that `cargo test -- --nocapture` states them. A NaN fails.
pub fn quantiles(what: &str, errors: impl Iterator<Item = f64>) -> Quantiles {
    let mut sorted: Vec<f64> = errors.collect();
    assert!(sorted.iter().all(|e| e.is_finite()), "{what}: an error is not finite");
    sorted.sort_by(f64::total_cmp);
    let at = |q: f64| sorted[(q * (sorted.len() - 1) as f64).round() as usize];
    let result = Quantiles {
        q75: at(0.75),
        q99: at(0.99),
        max: at(1.0),
    };
    println!(
        "{what}: {} points, q75 {:.1e}, q99 {:.1e}, max {:.1e}",
        sorted.len(),
        result.q75,
        result.q99,
        result.max
    );
    result
}

#[allow(dead_code, reason = "each test file takes what it needs")]
/// |value − exact|/|exact|, and 0 where both are 0.
pub fn relative(value: f64, exact: f64) -> f64 {
    if value == exact {
        0.0
    } else {
        ((value - exact) / exact).abs()
    }
}
