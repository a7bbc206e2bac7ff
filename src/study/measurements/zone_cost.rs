//! What a thousand zones cost a frame.

use super::places::{in_force, zone};
use crate::monitor::zones::{MAX_ZONES, Zone, ZoneKind};
use crate::study::stories::{Actor, Story, crowd, tell_with};

/// What a frame may cost more, µs.
const GOAL_US: f64 = 100.0;
/// Frames of a run, and runs with each number of zones: the cheapest of them is the one that the machine's other work disturbed least.
const FRAMES: f64 = 300.0;
const RUNS: usize = 15;

/// `n` zones in a square grid over the view, each a polygon of 20 corners, so that all limits are used. They watch, so that a frame's
/// alerts are the same whatever their number: what differs is the search.
fn zones(n: usize) -> Vec<Zone> {
    let side = (n as f64).sqrt().ceil() as usize;
    let pitch = 250.0 / side.max(1) as f64;
    let all = (0..n).flat_map(|k| {
        let middle = [k % side, k / side].map(|cell| -125.0 + pitch * (cell as f64 + 0.5));
        let corner = |c: usize| {
            let angle = std::f64::consts::TAU * c as f64 / 20.0;
            [
                middle[0] + 0.45 * pitch * angle.cos(),
                middle[1] + 0.45 * pitch * angle.sin(),
            ]
        };
        zone(&format!("zone-{k}"), ZoneKind::Watch, (0..20).map(corner).collect())
    });
    all.collect()
}

/// This thread's time on a processor, µs; 0 where the kernel does not count it.
fn processor_us() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let ns = text.split(' ').next().and_then(|ns| ns.parse::<f64>().ok());
    ns.unwrap_or(0.0) / 1e3
}

/// Processor time of a frame of six users and twenty lights that nobody claims, µs: the story's own estimates included, which are the
/// same whatever the zones.
fn frame_us(seed: u64, zones: &[Zone]) -> f64 {
    let mut actors = crowd();
    actors.extend((0..20).map(|k| {
        let place = [-110.0 + 11.5 * f64::from(k), 5.0];
        Actor::lamp(move |_| Some(place))
    }));
    let mut story = Story::new(seed, actors);
    story.seconds = FRAMES / story.rate_hz;
    story.operator = in_force(zones.to_vec(), Vec::new());
    let began = processor_us();
    tell_with(&story, false);
    (processor_us() - began) / FRAMES
}

pub fn thousand_zones(seed: u64) -> (String, bool) {
    let counts = [0, 100, MAX_ZONES];
    let sets = counts.map(zones);
    let mut least = [f64::INFINITY; 3];
    for _ in 0..RUNS {
        for (least, zones) in least.iter_mut().zip(&sets) {
            *least = least.min(frame_us(seed, zones));
        }
    }
    let more = least[2] - least[0];
    let text = format!(
        "processor time of a frame of 26 beams: {:.0} µs without zones, {:.0} µs with {}, {:.0} µs with {MAX_ZONES}: {more:.0} µs more\n",
        least[0], least[1], counts[1], least[2]
    );
    (text, least[0] > 0.0 && more <= GOAL_US)
}
