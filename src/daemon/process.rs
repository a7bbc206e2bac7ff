//! The `process_*` metrics that Prometheus clients export, read from /proc/self.

use jiff::Timestamp;
use metrics::{counter, gauge};

use crate::metric;

/// Clock ticks per second of /proc/self/stat: USER_HZ, 100 on every Linux that Rust's tier-1 targets run on.
const TICKS_PER_S: u64 = 100;

/// Sets the metrics. What cannot be read keeps its last value.
pub fn measure(started_at: Timestamp) {
    gauge!(metric::PROCESS_START).set(started_at.as_millisecond() as f64 * 1e-3);
    let read = |name: &str| std::fs::read_to_string(format!("/proc/self/{name}"));
    if let Some(ticks) = read("stat").ok().and_then(|stat| cpu_ticks(&stat)) {
        counter!(metric::PROCESS_CPU).absolute(ticks / TICKS_PER_S);
    }
    if let Ok(status) = read("status") {
        let kilobytes = |key| field(&status, key).map(|kb| kb * 1024.0);
        for (name, value) in [
            (metric::PROCESS_RESIDENT, kilobytes("VmRSS:")),
            (metric::PROCESS_VIRTUAL, kilobytes("VmSize:")),
            (metric::PROCESS_THREADS, field(&status, "Threads:")),
        ] {
            if let Some(value) = value {
                gauge!(name).set(value);
            }
        }
    }
    if let Some(most) = read("limits").ok().and_then(|limits| field(&limits, "Max open files")) {
        gauge!(metric::PROCESS_MAX_FDS).set(most);
    }
    if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
        // One of them is the listing itself.
        gauge!(metric::PROCESS_FDS).set(open.count().saturating_sub(1) as f64);
    }
}

/// User and system time in ticks: fields 14 and 15 (proc_pid_stat(5)). The second field is a name that may hold anything.
fn cpu_ticks(stat: &str) -> Option<u64> {
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<u64>().ok();
    Some(next()? + next()?)
}

/// The first number after `key` at the start of a line.
fn field(text: &str, key: &str) -> Option<f64> {
    let rest = text.lines().find_map(|line| line.strip_prefix(key))?;
    rest.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_read_past_odd_names() {
        let stat = "7 (a) b) S 1 7 7 0 -1 4194304 100 0 0 0 250 30 0 0 20 0 9 0 100 200 300";
        assert_eq!(cpu_ticks(stat), Some(280));
        assert_eq!(cpu_ticks("7 (short) S 1"), None);
        assert_eq!(field("VmPeak:\t 9 kB\nVmRSS:\t  1234 kB\n", "VmRSS:"), Some(1234.0));
        assert_eq!(
            field("Max open files            1024                 4096", "Max open files"),
            Some(1024.0)
        );
        assert_eq!(field("VmRSS:\t\n", "VmRSS:"), None);
    }
}
