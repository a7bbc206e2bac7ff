//! Known lamps that stay what they are, and headlights that pass: the monitor alone, on synthetic estimates.

use std::collections::BTreeMap;
use std::fmt::Write;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::measured::{Measured, exceptions};
use super::places::{in_force, known, zone};
use crate::monitor::AlertKind::UnclaimedEmitter;
use crate::monitor::zones::{Zone, ZoneKind};
use crate::monitor::{AlertEventKind, AlertKind};
use crate::study::stories::{Actor, Story, crowd, tell_with};

/// Seconds of a story.
const STORY_S: f64 = 180.0;

/// Six users, three of them standing with a reflection each, twenty lamps along both sides of a road (steady, with mains flicker, and
/// swinging), and cars on it.
fn lamp_story(seed: u64) -> Story {
    let place = |k: u32| {
        let side = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
        [-110.0 + 11.5 * f64::from(k), ROAD_M[0] + side * (ROAD_M[1] + 0.5)]
    };
    let mut actors = crowd();
    let mut places: Vec<[f64; 2]> = (0..20).map(place).collect();
    for k in 0..3 {
        let stands = [-80.0 + 80.0 * f64::from(k as u32), -70.0];
        actors[k] = Actor::new(&format!("u-{k}"), move |_| stands);
        let ghost = [stands[0] + 25.0, stands[1] - 12.0];
        let mut reflection = Actor::intruder(move |_| Some(ghost));
        (reflection.reflects, reflection.energy_j) = (Some(k), 0.002);
        actors.push(reflection);
        places.push(ghost);
    }
    for k in 0..20u32 {
        let [x, y] = place(k);
        let phase = f64::from(k) + seed as f64;
        let swings = if k % 3 == 2 { 0.8 } else { 0.0 };
        let mut lamp = Actor::lamp(move |t| Some([x + swings * (1.7 * t + phase).sin(), y]));
        if k % 3 == 1 {
            // The beat of the mains with the frames.
            lamp.glow = Box::new(move |t| 1.0 + 0.15 * (0.4 * t + phase).sin());
        }
        actors.push(lamp);
    }
    actors.extend(cars(seed));
    let mut story = Story::new(seed, actors);
    story.seconds = STORY_S;
    story.operator = in_force(road(), known(&places));
    story
}

/// Twenty known lamps, three known reflections, cars on an ignored road and six users raise nothing.
pub fn lamps(stories: u64, seed: u64) -> Measured {
    let raised: Vec<_> = (seed..seed + stories)
        .into_par_iter()
        .map(|k| (k, tell_with(&lamp_story(k), false).raised()))
        .filter(|(_, raised)| !raised.is_empty())
        .collect();
    let frames = stories as f64 * STORY_S * 10.0;
    let text = format!(
        "{frames} frames of twenty known lamps, three known ghosts, {CARS} cars in three minutes and six users: {} stories with alerts\n{}",
        raised.len(),
        exceptions(&raised)
    );
    let holds = raised.is_empty();
    Measured { text, holds }
}

/// Cars of a story, and how fast they go, m/s.
const CARS: usize = 20;
const SPEED_M_S: [f64; 2] = [8.0, 20.0];
/// The middle of the road, which runs from west to east, and half its width, m.
const ROAD_M: [f64; 2] = [0.0, 6.0];
/// Where a stranger comes in the second half of a story: on the road, and beside it.
const ON_ROAD: [f64; 2] = [-30.0, 2.0];
const BESIDE: [f64; 2] = [-30.0, 20.0];

/// What an operator has said of the road and of the lamps beside it.
#[derive(Clone, Copy)]
struct Setting {
    has_zone: bool,
    has_lamps: bool,
    stranger: Option<[f64; 2]>,
}

/// Cars on the road: each is two lamps 1.4 m apart that an estimate has as one, three times as bright as a beam.
fn cars(seed: u64) -> Vec<Actor> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xca55);
    let car = |k| {
        let speed: f64 = rng.random_range(SPEED_M_S[0]..SPEED_M_S[1]);
        let from = STORY_S * (k as f64 + rng.random::<f64>()) / CARS as f64;
        let is_eastward = rng.random::<bool>();
        let lane = if is_eastward { -2.0 } else { 2.0 };
        let side = if is_eastward { 1.0 } else { -1.0 };
        // Only what is within the view is a detection.
        let mut car =
            Actor::lamp(move |t| (t >= from).then_some([side * (speed * (t - from) - 130.0), ROAD_M[0] + lane]));
        (car.energy_j, car.extent_m2) = (3.0 * car.energy_j, 0.25);
        car
    };
    (0..CARS).map(car).collect()
}

/// The road as a zone of kind `ignore`.
fn road() -> Vec<Zone> {
    let [middle, half] = ROAD_M;
    let corners = vec![
        [-140.0, middle - half],
        [140.0, middle - half],
        [140.0, middle + half],
        [-140.0, middle + half],
    ];
    zone("road", ZoneKind::Ignore, corners)
}

/// Six users, and cars on a road.
fn road_story(seed: u64, set: Setting) -> Story {
    let mut actors = crowd();
    actors.extend(cars(seed));
    let lamps: Vec<[f64; 2]> = (0..8)
        .map(|k| [-105.0 + 30.0 * f64::from(k), ROAD_M[0] + 5.0])
        .collect();
    if set.has_lamps {
        actors.extend(lamps.iter().map(|place| {
            let place = *place;
            Actor::lamp(move |_| Some(place))
        }));
    }
    if let Some(place) = set.stranger {
        actors.push(Actor::intruder(move |t| (t >= STORY_S / 2.0).then_some(place)));
    }
    let zones = if set.has_zone { road() } else { Vec::new() };
    let lights = if set.has_lamps { known(&lamps) } else { Vec::new() };
    let mut story = Story::new(seed, actors);
    story.seconds = STORY_S;
    story.operator = in_force(zones, lights);
    story
}

/// What headlights that pass raise, before and after the road is a zone of kind `ignore`, and what a stranger gains by that.
pub fn headlights(stories: u64, seed: u64) -> Measured {
    let mut text = format!(
        "{stories} stories of {CARS} cars at {} to {} m/s, six users, {STORY_S} s each.\n\n\
         | zone on the road | known lamps beside it | stranger | alerts | of the cars, 100 cars | stranger alerted |\n|---|---|---|---|---|---|\n",
        SPEED_M_S[0], SPEED_M_S[1]
    );
    let mut holds = true;
    for (has_zone, has_lamps, place) in [
        (false, false, None),
        (false, true, None),
        (true, false, None),
        (true, true, None),
        (true, true, Some(("on the road", ON_ROAD))),
        (true, true, Some(("14 m beside it", BESIDE))),
    ] {
        let set = Setting {
            has_zone,
            has_lamps,
            stranger: place.map(|(_, place)| place),
        };
        let raised: Vec<_> = (seed..seed + stories)
            .into_par_iter()
            .map(|k| tell_with(&road_story(k, set), false).events)
            .collect();
        let (mut kinds, mut cars, mut found) = (BTreeMap::<AlertKind, u64>::new(), 0, 0);
        for events in &raised {
            let raised = events.iter().filter(|e| e.event == AlertEventKind::Raised);
            let mut is_found = false;
            for alert in raised.map(|e| &e.alert) {
                *kinds.entry(alert.kind).or_default() += 1;
                let is_there = |[x, y]: [f64; 2]| {
                    let at = alert.x_m.zip(alert.y_m);
                    at.is_some_and(|(a, b)| (a - x).hypot(b - y) < 2.0)
                };
                match set.stranger {
                    Some(place) if alert.kind == UnclaimedEmitter && is_there(place) => is_found = true,
                    _ => cars += 1,
                }
            }
            found += u64::from(is_found);
        }
        let yes = |is| if is { "yes" } else { "no" };
        let kinds: Vec<String> = kinds.iter().map(|(kind, n)| format!("{n} {kind:?}")).collect();
        let (stranger, alerted) = match place {
            Some((name, _)) => (name, format!("{found} of {stories}")),
            None => ("–", "–".to_owned()),
        };
        writeln!(
            text,
            "| {} | {} | {stranger} | {} | {:.1} | {alerted} |",
            yes(has_zone),
            yes(has_lamps),
            if kinds.is_empty() {
                "none".to_owned()
            } else {
                kinds.join(", ")
            },
            100.0 * f64::from(cars) / (stories as f64 * CARS as f64),
        )
        .expect("text takes all");
        holds &= !has_zone || cars == 0;
        holds &= place.is_none_or(|(_, at)| at != BESIDE) || found == stories;
    }
    Measured { text, holds }
}
