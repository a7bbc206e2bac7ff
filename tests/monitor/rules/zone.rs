//! Zones: places with rules of their own.

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::zones::{REACH_M, Zone, ZoneMap, load};
use oapwatch::monitor::{AlertEvent, Monitor, PositionStatus, Severity, Window};

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, at, crowd, tell};

/// Zones as a config has them.
fn zones(text: &str) -> Vec<Zone> {
    #[derive(serde::Deserialize)]
    struct File {
        zone: Vec<oapwatch::monitor::zones::Config>,
    }
    load(&toml::from_str::<File>(text).unwrap().zone, None).unwrap()
}

fn in_force(zones: Vec<Zone>) -> impl Fn(f64, &mut Monitor, &[AlertEvent]) + 'static {
    move |t, monitor, _| {
        if t == 0.0 {
            monitor.set_fixed(zones.clone(), Vec::new(), Vec::new()).unwrap();
        }
    }
}

const YARD: &str = "polygon = [[20, -10], [50, -10], [50, 20], [20, 20]]";

#[test]
fn a_beam_in_a_restricted_zone_is_critical_within_three_tenths_of_a_second() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.push(Actor::intruder(|t| (t >= 10.0).then_some([30.0, 5.0])));
        let mut story = Story::new(seed, actors);
        story.detected = 1.0;
        story.operator = Box::new(in_force(zones(&format!(
            "[[zone]]\nname = \"yard\"\nkind = \"restricted\"\n{YARD}"
        ))));
        let told = tell(&story);
        told.expect(&[(UnclaimedEmitter, None, 10.0, 10.31)]);
        assert_eq!(told.events[0].alert.severity, Severity::Critical);
        assert_eq!(told.events[0].alert.zone.as_deref(), Some("yard"));
    }
}

/// A user who walks in at 2 m/s is in the zone at 20 s.
fn walker(user: &str) -> Actor {
    Actor::new(user, |t| [20.0 + 2.0 * (t - 20.0).min(5.0), 5.0])
}

#[test]
fn a_user_who_is_not_listed_is_critical_in_a_restricted_zone() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.extend([walker("guest"), Actor::new("guard-7", |_| [40.0, -2.0])]);
        let mut story = Story::new(seed, actors);
        story.detected = 1.0;
        let text = format!("[[zone]]\nname = \"yard\"\nkind = \"restricted\"\nusers = [\"guard-*\"]\n{YARD}");
        story.operator = Box::new(in_force(zones(&text)));
        let told = tell(&story);
        told.expect(&[(UserOutOfZone, Some("guest"), 20.0, 20.31)]);
        assert_eq!(told.events[0].alert.severity, Severity::Critical);
    }
}

#[test]
fn a_listed_user_outside_of_all_their_zones_is_alerted() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.push(Actor::new("u-9", |t| [30.0, 5.0 + 2.0 * (t - 15.0).max(0.0)]));
        let mut story = Story::new(seed, actors);
        let text = format!("[[zone]]\nname = \"yard\"\nkind = \"watch\"\nusers = [\"u-9\"]\n{YARD}");
        story.operator = Box::new(in_force(zones(&text)));
        // Out at 22.5 s.
        let told = tell(&story);
        told.expect(&[(UserOutOfZone, Some("u-9"), 22.5, 23.2)]);
    }
}

#[test]
fn an_ignored_zone_raises_nothing_and_shows_everything() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.push(Actor::intruder(|_| Some([30.0, 5.0])));
        // At the very edge, and two metres outside.
        actors.push(Actor::intruder(|_| Some([20.0, 15.0])));
        actors.push(Actor::intruder(|t| (t >= 10.0).then_some([18.0, 0.0])));
        let mut story = Story::new(seed, actors);
        story.operator = Box::new(in_force(zones(&format!(
            "[[zone]]\nname = \"road\"\nkind = \"ignore\"\n{YARD}"
        ))));
        let told = tell(&story);
        told.expect(&[(UnclaimedEmitter, None, 10.5, 11.5)]);
        let ignored = |e: &&oapwatch::monitor::TrackedPosition| e.status == PositionStatus::Ignored;
        assert_eq!(told.reports.last().unwrap().emitters.iter().filter(ignored).count(), 2);
    }
}

#[test]
fn a_zone_drawn_about_an_alert_ends_it_and_one_walked_into_does_not() {
    let drawn = zones(&format!("[[zone]]\nname = \"road\"\nkind = \"ignore\"\n{YARD}"));
    let mut actors = crowd();
    actors.push(Actor::intruder(|_| Some([30.0, 5.0])));
    let mut story = Story::new(1, actors);
    let zone = drawn.clone();
    story.operator = Box::new(move |t, monitor, _| {
        if t == 15.0 {
            monitor.set_zones(zone.clone()).unwrap();
        }
    });
    let cleared = tell(&story).cleared();
    assert!(
        cleared.len() == 1 && (15.9..17.0).contains(&cleared[0].2),
        "{cleared:?}"
    );
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| Some([10.0 + t, 5.0])));
    let mut story = Story::new(1, actors);
    story.operator = Box::new(in_force(drawn));
    let told = tell(&story);
    assert_eq!((told.raised().len(), told.cleared().len()), (1, 0));
}

#[test]
fn a_watched_zone_has_its_own_tolerance_severity_and_webhooks() {
    for seed in SEEDS {
        let mut actors = crowd();
        // Three metres from the claim: tolerated elsewhere.
        for (user, x) in [("in", 30.0), ("out", 60.0)] {
            actors.push(
                Actor::new(user, move |_| [x, 5.0]).beam(move |t| Some([x + if t < 10.0 { 0.0 } else { 3.0 }, 5.0])),
            );
        }
        let mut story = Story::new(seed, actors);
        let own = "tolerated_distance_m = 1.0\nseverity = \"info\"\nwebhooks = [\"yard\"]";
        let text = format!("[[zone]]\nname = \"yard\"\nkind = \"watch\"\n{own}\n{YARD}");
        story.operator = Box::new(in_force(zones(&text)));
        let told = tell(&story);
        told.expect(&[(PositionMismatch, Some("in"), 10.0, 14.0)]);
        let alert = &told.events[0].alert;
        assert_eq!((alert.severity, alert.zone.as_deref()), (Severity::Info, Some("yard")));
        assert_eq!(alert.webhooks, Some(vec!["yard".to_owned()]));
    }
}

/// A maintenance window that is set when it begins, s.
fn maintained(from: f64, until: f64) -> impl Fn(f64, &mut Monitor, &[AlertEvent]) + 'static {
    move |t, monitor, _| {
        if t == from {
            let window = Window {
                id: "mast".into(),
                from: at(from),
                until: at(until),
                by: "K. Novak".into(),
                note: None,
                is_fixed: false,
            };
            monitor.add_maintenance(window).unwrap();
        }
    }
}

#[test]
fn maintenance_keeps_alerts_from_the_webhooks_until_it_ends() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t < 12.0).then_some([30.0, 5.0])));
    actors.push(Actor::intruder(|t| (t >= 8.0).then_some([60.0, 5.0])));
    let mut story = Story::new(4, actors);
    story.operator = Box::new(maintained(0.0, 20.0));
    let told = tell(&story);
    let second = &told.events.last().unwrap().alert;
    for event in &told.events {
        let t = event.alert.cleared_at.unwrap_or(event.alert.raised_at);
        let is_release = event.alert.id == second.id && event.alert.maintenance.is_none();
        assert!(
            is_release || (event.alert.webhooks == Some(vec![]) && t < at(20.0)),
            "{event:?}"
        );
    }
    assert!(second.maintenance.is_none() && second.webhooks.is_none(), "{second:?}");
}

#[test]
fn an_alert_that_was_sent_is_cleared_during_maintenance_as_well() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t < 12.0).then_some([30.0, 5.0])));
    let mut story = Story::new(4, actors);
    story.operator = Box::new(maintained(8.0, 60.0));
    let told = tell(&story);
    assert_eq!((told.raised().len(), told.cleared().len()), (1, 1));
    let cleared = &told.events.last().unwrap().alert;
    assert!(
        cleared.cleared_at > Some(at(8.0)) && cleared.webhooks.is_none(),
        "{cleared:?}"
    );
}

#[test]
fn a_thousand_zones_cost_a_frame_little() {
    let grid: String = (0..1000)
        .map(|k| {
            let (x, y) = (-128.0 + 8.0 * f64::from(k % 32), -128.0 + 8.0 * f64::from(k / 32));
            let (right, top) = (x + 6.0, y + 6.0);
            let kind = ["ignore", "watch", "restricted"][k as usize % 3];
            format!(
                "[[zone]]\nname = \"z{k}\"\nkind = \"{kind}\"\npolygon = [[{x},{y}],[{right},{y}],[{right},{top}],[{x},{top}]]\n"
            )
        })
        .collect();
    let many = zones(&grid);
    assert_eq!(many.len(), 1000);
    let map = ZoneMap::new(many);
    // As many places as a frame has beams. The bound is on the work, not on a clock.
    let places = || (0..50).map(|k: i32| [f64::from(k) * 4.0 - 100.0, f64::from(k % 7) * 30.0 - 100.0]);
    let measured = |reach_m: f64| places().map(|p| map.near(p, reach_m, |_| true).count()).max();
    assert!(measured(REACH_M) <= Some(16));
    assert!(measured(0.0) <= Some(1));
}
