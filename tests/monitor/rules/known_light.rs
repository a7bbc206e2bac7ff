//! Lights that nobody claims and that an operator has approved.

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::{
    AlertEventKind, KnownLightConfig, LightError, LightRequest, Monitor, PositionStatus, known_lights_of,
};

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, at, crowd, tally, tell};

const LAMP: [f64; 2] = [30.0, 5.0];

fn known(places: &[[f64; 2]], radius_m: f64) -> impl Fn(f64, &mut Monitor, &[oapwatch::monitor::AlertEvent]) + 'static {
    let configs: Vec<KnownLightConfig> = places
        .iter()
        .map(|[x_m, y_m]| KnownLightConfig {
            x_m: *x_m,
            y_m: *y_m,
            radius_m: Some(radius_m),
            note: Some("street lamp".into()),
            until: None,
        })
        .collect();
    let lights = known_lights_of(&configs).unwrap();
    move |t, monitor, _| {
        if t == 0.0 {
            monitor.set_fixed(Vec::new(), lights.clone(), Vec::new()).unwrap();
        }
    }
}

fn request(alert: &str, t: f64) -> LightRequest {
    LightRequest {
        place: Err(alert.to_owned()),
        note: Some("mast".into()),
        until: None,
        by: Some("K. Novak".into()),
        at: at(t),
    }
}

/// Six users and a steady lamp that is a known light, with a stranger from 60 s on.
fn lamp_and(seed: u64, stranger: Option<Actor>) -> Story {
    let mut actors = crowd();
    actors.push(Actor::lamp(|_| Some(LAMP)));
    actors.extend(stranger);
    let mut story = Story::new(seed, actors);
    story.seconds = 90.0;
    story.operator = Box::new(known(&[LAMP], 2.0));
    story
}

#[test]
fn twenty_lamps_and_six_users_raise_nothing() {
    for seed in SEEDS {
        let place = |k: u32| {
            [
                -110.0 + 11.5 * f64::from(k),
                if k.is_multiple_of(2) { 5.0 } else { -8.0 },
            ]
        };
        let mut actors = crowd();
        for k in 0..20u32 {
            let [x, y] = place(k);
            let phase = f64::from(k);
            // Steady; mains flicker, whose beat with the frames is slow; swinging.
            let mut lamp = match k % 3 {
                2 => Actor::lamp(move |t| Some([x + 0.8 * (1.7 * t + phase).sin(), y])),
                _ => Actor::lamp(move |_| Some([x, y])),
            };
            if k % 3 == 1 {
                lamp.glow = Box::new(move |t| 1.0 + 0.15 * (0.4 * t + phase).sin());
            }
            actors.push(lamp);
        }
        let mut story = Story::new(seed, actors);
        story.seconds = 180.0;
        story.operator = Box::new(known(&(0..20).map(place).collect::<Vec<_>>(), 2.0));
        let told = tell(&story);
        told.expect(&[]);
        let last = told.reports.last().unwrap();
        let of_status = |status| last.emitters.iter().filter(|e| e.status == status).count();
        assert_eq!(
            of_status(PositionStatus::Known) + of_status(PositionStatus::Verified),
            last.emitters.len()
        );
        assert!(of_status(PositionStatus::Known) >= 18, "tracked and shown all the same");
    }
}

#[test]
fn an_approved_emitter_is_silent_from_then_on() {
    for seed in SEEDS {
        let mut story = lamp_and(seed, None);
        story.operator = Box::new(|t, monitor, events| {
            if t == 10.0 {
                let light = monitor.approve(request(&events[0].alert.id, t)).unwrap();
                assert!((light.x_m - LAMP[0]).hypot(light.y_m - LAMP[1]) < 0.2, "{light:?}");
                assert_eq!(light.by.as_deref(), Some("K. Novak"));
                let again = monitor.approve(request(&events[0].alert.id, t));
                assert_eq!(again, Err(LightError::Taken(light.id)));
            }
        });
        let told = tell(&story);
        told.expect(&[(UnclaimedEmitter, None, 0.5, 2.0)]);
        let cleared = told.cleared();
        assert!(
            cleared.len() == 1 && (10.9..13.0).contains(&cleared[0].2),
            "{cleared:?}"
        );
        let last = told.reports.last().unwrap();
        assert!(
            last.emitters
                .iter()
                .any(|e| e.status == PositionStatus::Known && e.known_light.is_some())
        );
    }
}

#[test]
fn a_stranger_beside_a_known_light_is_an_alert_of_their_own() {
    for seed in SEEDS {
        for away in [2.5, 5.0] {
            let stranger = Actor::intruder(move |t| (t >= 60.0).then_some([LAMP[0] + away, LAMP[1]]));
            tell(&lamp_and(seed, Some(stranger))).expect(&[(UnclaimedEmitter, None, 60.5, 61.5)]);
        }
    }
}

#[test]
fn a_stranger_in_the_spot_of_a_known_light_is_a_change() {
    for seed in SEEDS {
        for (share, within_s) in [(1.0, 4.0), (0.5, 8.0)] {
            let mut stranger = Actor::intruder(move |t| (t >= 60.0).then_some([LAMP[0] + 0.5, LAMP[1]]));
            stranger.energy_j *= share;
            let told = tell(&lamp_and(seed, Some(stranger)));
            told.expect(&[(KnownLightChanged, None, 60.5, 60.5 + within_s)]);
            assert_eq!(told.events[0].alert.evidence["note"], "street lamp");
        }
    }
}

#[test]
fn a_light_that_dims_for_good_is_a_change_and_one_that_goes_out_is_none() {
    for seed in SEEDS {
        let mut story = lamp_and(seed, None);
        story.actors[6].glow = Box::new(|t| if t < 60.0 { 1.0 } else { 0.5 });
        let told = tell(&story);
        told.expect(&[(KnownLightChanged, None, 60.5, 63.0)]);
        let mut story = lamp_and(seed, None);
        story.actors[6].beam = Box::new(|t| (!(60.0..=75.0).contains(&t)).then_some(LAMP));
        tell(&story).expect(&[]);
    }
}

#[test]
fn a_light_that_comes_back_elsewhere_or_as_something_else_is_a_change() {
    for seed in SEEDS {
        for (gone_s, elsewhere) in [(0.0, [50.0, 20.0]), (5.0, [50.0, 20.0]), (5.0, [30.0, 12.0])] {
            let mut story = lamp_and(seed, None);
            story.actors[6].beam = Box::new(move |t| match t {
                t if t < 60.0 => Some(LAMP),
                t if t < 60.0 + gone_s => None,
                _ => Some(elsewhere),
            });
            let from = 60.5 + gone_s;
            let told = tell(&story);
            told.expect(&[(KnownLightChanged, None, from, from + 1.5)]);
            assert_eq!(told.events[0].alert.evidence["came_on_elsewhere"], true);
        }
        // A beam in the lamp's own place: it scintillates.
        let mut story = lamp_and(seed, Some(Actor::intruder(|t| (t >= 62.0).then_some(LAMP))));
        story.actors[6].beam = Box::new(|t| (t < 60.0).then_some(LAMP));
        tell(&story).expect(&[(KnownLightChanged, None, 62.5, 69.0)]);
    }
}

#[test]
fn a_user_who_claims_to_be_at_a_known_light_must_bring_a_beam() {
    for seed in SEEDS {
        let mut liar = Actor::new("liar", |_| LAMP).beam(|_| None);
        liar.phase_s = 60.0;
        let told = tell(&lamp_and(seed, Some(liar)));
        let raised = told.raised();
        assert!(
            raised
                .iter()
                .all(|(kind, user, _)| *kind == UserUnseen && user.as_deref() == Some("liar")),
            "{raised:?}"
        );
    }
}

#[test]
fn an_approval_that_ends_is_an_unclaimed_emitter_again() {
    let mut story = lamp_and(1, None);
    story.operator = Box::new(|t, monitor, _| {
        if t == 0.0 {
            let place = Ok((LAMP, Some(2.0)));
            let until = Some(at(40.0));
            monitor
                .approve(LightRequest {
                    place,
                    until,
                    ..request("", t)
                })
                .unwrap();
        }
        if t == 41.0 {
            assert!(monitor.known_lights().is_empty());
        }
    });
    tell(&story).expect(&[(UnclaimedEmitter, None, 40.5, 42.0)]);
}

#[test]
fn what_was_learned_outlasts_a_restart() {
    let mut story = lamp_and(2, None);
    story.seconds = 150.0;
    story.restarts_at = Some(140.0);
    story.actors[6].glow = Box::new(|t| if t < 141.0 { 1.0 } else { 2.5 });
    let kept = std::cell::RefCell::new(std::collections::BTreeMap::new());
    let begin = known(&[LAMP], 2.0);
    story.operator = Box::new(move |t, monitor, events| {
        if t == 140.0 {
            begin(0.0, monitor, events);
            let lights: Vec<oapwatch::monitor::KnownLight> = kept.borrow().values().cloned().collect();
            assert!(lights.iter().all(|light| light.learned.is_some()) && lights.len() == 1);
            monitor.restore_lights(lights);
        }
        begin(t, monitor, events);
        for record in monitor.take_light_records() {
            if let oapwatch::monitor::LightRecord::Put(light) = record {
                kept.borrow_mut().insert(light.id.clone(), *light);
            }
        }
    });
    let told = tell(&story);
    told.expect(&[(KnownLightChanged, None, 141.5, 145.0)]);
}

#[test]
fn what_cannot_be_approved_is_named() {
    let mut story = Story::new(3, crowd());
    story.seconds = 0.2;
    story.operator = Box::new(|t, monitor, _| {
        let place = |x: f64, radius_m: f64| LightRequest {
            place: Ok(([x, 0.0], Some(radius_m))),
            ..request("", t)
        };
        assert_eq!(
            monitor.approve(request("none", t)),
            Err(LightError::NoAlert("none".into()))
        );
        assert!(matches!(
            monitor.approve(place(f64::NAN, 1.0)),
            Err(LightError::Value { key: "x_m", .. })
        ));
        assert!(matches!(
            monitor.approve(place(0.0, 0.0)),
            Err(LightError::Value { key: "radius_m", .. })
        ));
        let past = LightRequest {
            until: Some(at(t - 1.0)),
            ..place(0.0, 1.0)
        };
        assert!(matches!(monitor.approve(past), Err(LightError::Past { .. })));
        assert_eq!(monitor.revoke("none"), Err(LightError::Unknown("none".into())));
    });
    let told = tell(&story);
    assert!(tally(&told.events).is_empty() && told.events.iter().all(|e| e.event != AlertEventKind::Raised));
}

/// Two of three users' beams come a second late, while the reflections of all three are there: no displaced camera.
#[test]
fn known_reflections_beside_users_are_no_displacement() {
    let places = [[-80.0, -70.0], [0.0, -70.0], [80.0, -70.0]];
    let ghosts = places.map(|[x, y]| [x + 25.0, y - 12.0]);
    let users = places.iter().enumerate().map(|(k, &place)| {
        let late = if k == 0 { 0.0 } else { 1.0 };
        Actor::new(&format!("u-{k}"), move |_| place).beam(move |t| (t >= late).then_some(place))
    });
    let reflections = ghosts.map(|ghost| Actor::intruder(move |_| Some(ghost)));
    let mut story = Story::new(1, users.chain(reflections).collect());
    story.operator = Box::new(known(&ghosts, 2.0));
    let told = tell(&story);
    assert!(
        told.raised().iter().all(|(kind, ..)| *kind != PoseInconsistent),
        "{:?}",
        tally(&told.events)
    );
}
