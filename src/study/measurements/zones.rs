//! What known lights and zones hide, and how soon they are left: the monitor alone, on synthetic estimates.

use std::fmt::Write;

use rayon::prelude::*;

use super::measured::{Measured, exceptions};
use crate::monitor::AlertKind::{KnownLightChanged, UnclaimedEmitter, UserOutOfZone};
use crate::monitor::zones::{self, Zone, ZoneKind};
use crate::monitor::{AlertEvent, KnownLight, KnownLightConfig, Monitor, known_lights_of};
use crate::study::stories::{Actor, Story, crowd, tell_with};

/// Where the lamp of the stranger's stories is.
const LAMP: [f64; 2] = [30.0, 5.0];
/// When the stranger comes on, s: the light has been learned.
const COMES_S: f64 = 130.0;
/// How long they stay.
const STAYS_S: f64 = 60.0;
/// Seconds of a story of twenty lamps.
const LAMPS_S: f64 = 180.0;
/// Time within which a restricted zone must be alerted, s.
const RESTRICTED_S: f64 = 0.3;

/// Twenty lamps raise nothing; a restricted zone is alerted at once; and the time to the alert of a stranger by a known light.
pub fn known_lights_and_zones(stories: u64, seed: u64) -> Measured {
    let (lamps, lamps_hold) = lamps(stories, seed);
    let (restricted, restricted_holds) = restricted(stories, seed);
    Measured {
        text: format!("{lamps}\n{restricted}\n{}", strangers(stories, seed)),
        holds: lamps_hold && restricted_holds,
    }
}

fn known(places: &[[f64; 2]]) -> Vec<KnownLight> {
    let config = |[x_m, y_m]: &[f64; 2]| KnownLightConfig {
        x_m: *x_m,
        y_m: *y_m,
        radius_m: 2.0,
        note: None,
        until: None,
    };
    let configs: Vec<_> = places.iter().map(config).collect();
    known_lights_of(&configs).expect("places within the view")
}

type Operator = Box<dyn Fn(f64, &mut Monitor, &[AlertEvent])>;

/// Puts these in force before the first frame.
fn in_force(zones: Vec<Zone>, lights: Vec<KnownLight>) -> Operator {
    Box::new(move |t, monitor, _| {
        if t == 0.0 {
            let put = monitor.set_fixed(zones.clone(), lights.clone(), Vec::new());
            put.expect("one zone at most");
        }
    })
}

/// Six users, three of them standing with a reflection each, and twenty lamps: steady, with mains flicker, and swinging.
fn lamp_story(seed: u64) -> Story {
    let place = |k: u32| {
        [
            -110.0 + 11.5 * f64::from(k),
            if k.is_multiple_of(2) { 5.0 } else { -8.0 },
        ]
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
    let mut story = Story::new(seed, actors);
    story.seconds = LAMPS_S;
    story.operator = in_force(Vec::new(), known(&places));
    story
}

fn lamps(stories: u64, seed: u64) -> (String, bool) {
    let raised: Vec<_> = (seed..seed + stories)
        .into_par_iter()
        .map(|k| (k, tell_with(&lamp_story(k), false).raised()))
        .filter(|(_, raised)| !raised.is_empty())
        .collect();
    let frames = stories as f64 * LAMPS_S * 10.0;
    let text = format!(
        "{frames} frames of twenty known lamps, three known ghosts and six users: {} stories with alerts\n{}",
        raised.len(),
        exceptions(&raised)
    );
    (text, raised.is_empty())
}

fn restricted(stories: u64, seed: u64) -> (String, bool) {
    let yard = zones::Config {
        name: "yard".to_owned(),
        kind: ZoneKind::Restricted,
        polygon: Some(vec![[20.0, -10.0], [50.0, -10.0], [50.0, 20.0], [20.0, 20.0]]),
        geojson: None,
        coordinates: zones::Coordinates::Metres,
        users: Vec::new(),
        tolerated_distance_m: None,
        severity: None,
        webhooks: None,
    };
    let yard = zones::load(&[yard], None).expect("a square");
    let mut late: Vec<f64> = Vec::new();
    let mut all = 0;
    for is_claimed in [false, true] {
        let times: Vec<f64> = (seed..seed + stories)
            .into_par_iter()
            .map(|k| {
                let comes = 10.0;
                let mut actors = crowd();
                actors.push(match is_claimed {
                    true => Actor::new("guest", |_| [35.0, 5.0]).beam(move |t| (t >= comes).then_some([35.0, 5.0])),
                    false => Actor::intruder(move |t| (t >= comes).then_some([35.0, 5.0])),
                });
                let mut story = Story::new(k, actors);
                story.seconds = 12.0;
                story.operator = in_force(yard.clone(), Vec::new());
                let raised = tell_with(&story, false).raised();
                let kind = if is_claimed { UserOutOfZone } else { UnclaimedEmitter };
                let first = raised.iter().find(|(k, ..)| *k == kind);
                first.map_or(f64::INFINITY, |(.., t)| t - comes)
            })
            .collect();
        all += times.len();
        late.extend(times.into_iter().filter(|t| *t > RESTRICTED_S + 1e-9));
    }
    // A beam that one of the first frames misses takes a frame longer.
    let holds = late.len() as f64 <= 0.02 * all as f64;
    let text = format!(
        "{} of {all} beams in a restricted zone alerted within 0.3 s\n",
        all - late.len()
    );
    (text, holds)
}

/// Median and ninth decile of the time to the alert, over stories, for a stranger at a distance and of a share of the lamp's light.
fn strangers(stories: u64, seed: u64) -> String {
    let mut text = "| stranger from the known light | light | alerted within 60 s | median, s | nine in ten, s |\n|---|---|---|---|---|\n".to_owned();
    for away_m in [0.0, 1.0, 2.0, 5.0] {
        for share in [1.0, 0.5, 0.25] {
            let mut times: Vec<f64> = (seed..seed + stories)
                .into_par_iter()
                .filter_map(|k| time_to_alert(k, away_m, share))
                .collect();
            times.sort_by(f64::total_cmp);
            let at = |q: f64| match times.get((q * stories as f64) as usize) {
                Some(t) => format!("{t:.1}"),
                None => "–".to_owned(),
            };
            writeln!(
                text,
                "| {away_m} m | {share} | {} of {stories} | {} | {} |",
                times.len(),
                at(0.5),
                at(0.9)
            )
            .expect("text takes all");
        }
    }
    text
}

fn time_to_alert(seed: u64, away_m: f64, share: f64) -> Option<f64> {
    let mut actors = crowd();
    actors.push(Actor::lamp(|_| Some(LAMP)));
    let mut stranger = Actor::intruder(move |t| (t >= COMES_S).then_some([LAMP[0] + away_m, LAMP[1]]));
    stranger.energy_j *= share;
    actors.push(stranger);
    let mut story = Story::new(seed, actors);
    story.seconds = COMES_S + STAYS_S;
    story.operator = in_force(Vec::new(), known(&[LAMP]));
    let raised = tell_with(&story, false).raised();
    let is_found = |kind| [KnownLightChanged, UnclaimedEmitter].contains(&kind);
    let first = raised.iter().find(|(kind, _, t)| is_found(*kind) && *t >= COMES_S);
    first.map(|(.., t)| t - COMES_S)
}
