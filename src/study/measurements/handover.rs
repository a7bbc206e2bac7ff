//! What a fleet's hub makes of users who walk from one access point's footprint into the next: the monitors of two stations, on
//! synthetic estimates, and the hub's chain.

use std::collections::BTreeSet;
use std::fmt::Write;

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::measured::Measured;
use crate::claim::Claim;
use crate::fleet::message::{AlertMessage, PositionsMessage, VERSION};
use crate::hub::chain::{Chain, Heard, Settings};
use crate::monitor::{AlertEventKind, Config, StationName};
use crate::study::stories::{Actor, Story, Told, at, camera, claims, start, tell};

/// Share of walks whose track must keep its number.
const GOAL: f64 = 0.99;
/// Name of the user who walks.
const WALKER: &str = "walker";
/// How far the walk goes to either side of the border, m.
const REACH_M: f64 = 40.0;
/// Time that the monitors have to learn who is who, s.
const SETTLED_S: f64 = 3.0;
/// Longest way of a message to the hub, s.
const SLOWEST_S: f64 = 0.3;
/// Interval of the hub's pictures, s.
const TICK_S: f64 = 0.1;

/// Walks across footprints that overlap by 50 m and by 10 m, and that touch.
pub fn walks(stories: u64, seed: u64) -> Measured {
    let mut text =
        "| footprints | walks | alerts | number of the track kept | exactly one beam |\n|---|---|---|---|---|\n"
            .to_owned();
    let mut holds = true;
    let mut told = String::new();
    for overlap_m in [50.0, 10.0, 0.0] {
        let walks: Vec<Walk> = (seed..seed + stories)
            .into_par_iter()
            .map(|k| walk(k, overlap_m))
            .collect();
        let alerts: usize = walks.iter().map(|w| w.alerts.len()).sum();
        let kept = walks.iter().filter(|w| w.numbers.len() == 1).count();
        let (one, pictures) = walks.iter().fold((0, 0), |(a, b), w| (a + w.one_beam, b + w.pictures));
        let share = kept as f64 / walks.len() as f64;
        let form = match overlap_m {
            0.0 => "touching".to_owned(),
            m => format!("overlapping by {m} m"),
        };
        writeln!(
            text,
            "| {form} | {} | {alerts} | {:.2} % | {:.2} % of {pictures} pictures |",
            walks.len(),
            100.0 * share,
            100.0 * one as f64 / pictures as f64
        )
        .expect("text takes all");
        for (k, walk) in walks.iter().enumerate().filter(|(_, w)| !w.alerts.is_empty()).take(5) {
            writeln!(told, "{form}, walk {}: {}", seed + k as u64, walk.alerts.join(", ")).expect("text takes all");
        }
        holds &= alerts == 0 && share >= GOAL;
    }
    Measured {
        text: format!("{text}\n{told}"),
        holds,
    }
}

#[derive(Default)]
struct Walk {
    /// Kind and user of each alert that the hub raised.
    alerts: Vec<String>,
    /// The walker's track, by the hub's numbers.
    numbers: BTreeSet<u64>,
    /// Pictures with exactly one beam where the walker is.
    one_beam: u64,
    pictures: u64,
}

fn walk(seed: u64, overlap_m: f64) -> Walk {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x4a2d);
    let half = half_widths_m()[0];
    // Of the second station's origin; the border is in the middle of both.
    let east_m = 2.0 * half - overlap_m;
    let (path, seconds) = way(&mut rng, 0.5 * east_m);
    let stands = |x: f64, y: f64| move |_: f64| [x, y];
    let people = || {
        [
            Actor::new(WALKER, path.clone()),
            Actor::new("west", stands(-60.0, 50.0)),
            Actor::new("east", stands(east_m + 60.0, -50.0)),
        ]
    };
    let mut network = Story::new(seed, people().into());
    network.seconds = seconds;
    let claims = claims(&network);
    let mut heard: Vec<(Timestamp, Heard)> = Vec::new();
    for (k, east) in [0.0, east_m].into_iter().enumerate() {
        let late = SignedDuration::from_secs_f64(rng.random_range(0.0..SLOWEST_S));
        let beams = people().map(|actor| {
            let beam = actor.beam;
            Actor::intruder(move |t| beam(t).map(|[x, y]| [x - east, y]))
        });
        let mut story = Story::new(2 * seed + k as u64, beams.into());
        story.seconds = seconds;
        let local = |claim: &Claim| Claim {
            x_m: claim.x_m - east,
            ..claim.clone()
        };
        story.forged = claims.iter().map(|(comes, claim)| (*comes, local(claim))).collect();
        let name = StationName {
            site: "study".to_owned(),
            station: format!("ap{k}"),
        };
        heard.extend(
            messages(&tell(&story), &name, east)
                .into_iter()
                .map(|(at, heard)| (at + late, heard)),
        );
    }
    let ticks = (0..(seconds / TICK_S) as u64).map(|k| (at(k as f64 * TICK_S), Heard::Tick));
    heard.extend(ticks);
    heard.sort_by_key(|(at, _)| *at);
    judge(heard, &path)
}

/// Of a footprint.
fn half_widths_m() -> [f64; 2] {
    let camera = camera();
    [&camera.x, &camera.y].map(|axis| axis.half_width() * camera.ground_scale())
}

/// From one footprint to the other at 0.5 to 2.5 m/s; one in three rests at the border. Gives the way and its length, s.
fn way(rng: &mut ChaCha8Rng, border_m: f64) -> (impl Fn(f64) -> [f64; 2] + Clone + 'static, f64) {
    let speed = rng.random_range(0.5..2.5f64);
    let heading = if rng.random::<bool>() { 1.0 } else { -1.0 };
    let (y0, slope) = (rng.random_range(-80.0..80.0f64), rng.random_range(-0.4..0.4f64));
    let rest_s = if rng.random::<f64>() < 1.0 / 3.0 {
        rng.random_range(2.0..20.0)
    } else {
        0.0
    };
    let rests_at = REACH_M + rng.random_range(-3.0..3.0f64);
    let seconds = 2.0 * REACH_M / speed + rest_s;
    let path = move |t: f64| {
        let before = (speed * t).min(rests_at);
        let after = (speed * (t - rest_s) - rests_at).max(0.0);
        let gone = before + after - REACH_M;
        [border_m + heading * gone, y0 + slope * gone]
    };
    (path, seconds)
}

/// What a station publishes whose origin is `east` of the world's.
fn messages(told: &Told, name: &StationName, east: f64) -> Vec<(Timestamp, Heard)> {
    /// As an access point names the claims in view: up to a quarter of the view's width beyond it.
    const AROUND: f64 = 1.5;
    let [half_x, half_y] = half_widths_m();
    let shifted = |x: f64| x + east;
    let mut messages = Vec::new();
    let mut seq = 0;
    for report in &told.reports {
        for event in &report.events {
            seq += 1;
            let mut event = event.clone();
            event.alert.x_m = event.alert.x_m.map(shifted);
            let message = AlertMessage {
                version: VERSION,
                name: name.clone(),
                journal: "study".to_owned(),
                seq,
                at: report.time,
                event,
            };
            messages.push((report.time, Heard::Alert(Box::new(message))));
        }
        let is_near = |claim: &&Claim| claim.x_m.abs() <= AROUND * half_x && claim.y_m.abs() <= AROUND * half_y;
        let mut message = PositionsMessage {
            version: VERSION,
            name: name.clone(),
            time: report.time,
            frame: report.frame,
            emitters: report.emitters.clone(),
            unseen: report.unseen.clone(),
            claims: report.claims.iter().filter(is_near).cloned().collect(),
            field_of_view_m: [half_x, half_y],
            footprint_m: Vec::new(),
        };
        for emitter in &mut message.emitters {
            emitter.x_m = shifted(emitter.x_m);
        }
        for claim in &mut message.claims {
            claim.x_m = shifted(claim.x_m);
        }
        messages.push((report.time, Heard::Positions(message)));
    }
    messages
}

/// What the hub makes of it.
fn judge(heard: Vec<(Timestamp, Heard)>, path: impl Fn(f64) -> [f64; 2]) -> Walk {
    let tolerated_m = Config::default().tolerated_distance_m;
    let settings = Settings {
        lost_after_s: crate::fleet::Config::default().lost_after_s,
        tolerated_m,
    };
    let mut chain = Chain::new(settings, Vec::new(), Default::default(), start());
    let mut walk = Walk::default();
    for (now, heard) in heard {
        let is_tick = matches!(heard, Heard::Tick);
        for taken in chain.take(heard, now).taken {
            if taken.event.event == AlertEventKind::Raised {
                let alert = &taken.event.alert;
                walk.alerts.push(format!(
                    "{:?} {}",
                    alert.kind,
                    alert.user.as_deref().unwrap_or("nobody")
                ));
            }
        }
        let t = now.duration_since(start()).as_secs_f64();
        if !is_tick {
            continue;
        }
        let picture = chain.picture(now);
        if t < SETTLED_S {
            continue;
        }
        let [x, y] = path(t);
        let near = picture
            .emitters
            .iter()
            .filter(|e| (e.x_m - x).hypot(e.y_m - y) < tolerated_m);
        walk.pictures += 1;
        walk.one_beam += u64::from(near.count() == 1);
        let of_walker = picture.emitters.iter().filter(|e| e.user.as_deref() == Some(WALKER));
        walk.numbers.extend(of_walker.map(|e| e.track));
    }
    walk
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_walk_goes_from_one_side_of_the_border_to_the_other() {
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (path, seconds) = way(&mut rng, 100.0);
            let [from, to] = [path(0.0), path(seconds)].map(|[x, _]| x - 100.0);
            assert!(
                (from + to).abs() < 1e-9 && (from.abs() - REACH_M).abs() < 1e-9,
                "{from} {to}"
            );
        }
    }

    #[test]
    fn a_user_at_two_places_is_no_handover() {
        let mut heard = Vec::new();
        for (k, east) in [0.0, 200.0].into_iter().enumerate() {
            let mut story = Story::new(k as u64, vec![Actor::new(WALKER, |_| [50.0, 0.0])]);
            story.seconds = 6.0;
            let name = StationName {
                site: "study".to_owned(),
                station: format!("ap{k}"),
            };
            heard.extend(messages(&tell(&story), &name, east));
        }
        heard.extend((0..60).map(|k| (at(f64::from(k) * TICK_S), Heard::Tick)));
        heard.sort_by_key(|(at, _)| *at);
        let walk = judge(heard, |_| [50.0, 0.0]);
        assert_eq!(walk.alerts, ["UserInTwoPlaces walker"]);
    }
}
