//! What known lights and zones hide, and how soon they are left: the monitor alone, on synthetic estimates.

use std::fmt::Write;

use rayon::prelude::*;

use super::measured::Measured;
use super::places::{in_force, known, zone};
use super::zone_cost;
use crate::monitor::AlertKind::{KnownLightChanged, UnclaimedEmitter, UserOutOfZone};
use crate::monitor::zones::ZoneKind;
use crate::study::stories::{Actor, Story, crowd, tell_with};

/// Where the lamp of the stranger's stories is.
const LAMP: [f64; 2] = [30.0, 5.0];
/// When the stranger comes on, s: the light has been learned.
const COMES_S: f64 = 130.0;
/// How long they stay.
const STAYS_S: f64 = 60.0;
/// Time within which a restricted zone must be alerted, s.
const RESTRICTED_S: f64 = 0.3;

/// A restricted zone is alerted at once; a frame costs little more with a thousand zones; and the time to the alert of a stranger by a
/// known light.
pub fn known_lights_and_zones(stories: u64, seed: u64) -> Measured {
    let (restricted, restricted_holds) = restricted(stories, seed);
    let (cost, cost_holds) = zone_cost::thousand_zones(seed);
    Measured {
        text: format!("{restricted}\n{cost}\n{}", strangers(stories, seed)),
        holds: restricted_holds && cost_holds,
    }
}

fn restricted(stories: u64, seed: u64) -> (String, bool) {
    let corners = vec![[20.0, -10.0], [50.0, -10.0], [50.0, 20.0], [20.0, 20.0]];
    let yard = zone("yard", ZoneKind::Restricted, corners);
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
