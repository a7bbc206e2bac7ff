//! Tests over the newest frames in windows of several lengths, and the most significant of them.

/// Windows of newest frames that are tested. Short ones find a strong second beam soon, long ones a weak one late; they share
/// data, and no correction is made for their number (the soaks of docs/verdicts.md hold the rate of false alerts).
pub const WINDOWS: [usize; 4] = [10, 20, 40, 80];

/// Frames since a step from which they are tested: with fewer one odd frame decides.
const MIN_FRAMES: usize = 3;

/// Ratio of what a window shows to what is expected, and −ln p of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WindowExcess {
    pub ratio: f64,
    pub neg_log_p: f64,
}

/// The most significant of all windows; of equals the longest.
pub fn most_significant(test: impl Fn(usize) -> Option<WindowExcess>) -> WindowExcess {
    let tested = WINDOWS.into_iter().filter_map(test);
    tested.fold(WindowExcess::default(), |most, found| {
        if found.neg_log_p >= most.neg_log_p { found } else { most }
    })
}

/// The test of the newest `n` frames, where they are enough.
pub fn of_frames(n: usize, test: impl Fn(usize) -> Option<WindowExcess>) -> WindowExcess {
    let tested = if n >= MIN_FRAMES { test(n) } else { None };
    tested.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_significant_window_is_the_longest_of_equals() {
        let of = |neg_log_p: [f64; 4]| {
            most_significant(|n| {
                let k = WINDOWS.iter().position(|w| *w == n)?;
                (neg_log_p[k] >= 0.0).then_some(WindowExcess {
                    ratio: n as f64,
                    neg_log_p: neg_log_p[k],
                })
            })
        };
        assert_eq!(of([3.0, 7.0, 7.0, 1.0]).ratio, 40.0);
        // Windows that cannot be tested count for nothing.
        assert_eq!(of([3.0, -1.0, -1.0, -1.0]).ratio, 10.0);
        assert_eq!(of([-1.0; 4]), WindowExcess::default());
    }
}
