//! Whoever writes claims wants an alert not to come.

use std::time::Instant;

use oapwatch::claims::{Claim, ClaimState};
use oapwatch::monitor::AlertKind::{self, *};
use oapwatch::monitor::{PositionStatus, Severity, TrackedPosition};

use super::stories::{Actor, Story, at, crowd, tell, tell_with};

fn forged(user: &str, made: f64, x_m: f64, y_m: f64) -> Claim {
    Claim {
        time: at(made),
        user: user.into(),
        x_m,
        y_m,
        sigma_m: Some(0.3),
        power_w: None,
        state: ClaimState::Active,
    }
}

/// Six users and an intruder at (20, 10) from 10 s on.
fn intrusion(seed: u64) -> Story {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t >= 10.0).then_some([20.0, 10.0])));
    let mut story = Story::new(seed, actors);
    story.seconds = 15.0;
    story
}

/// When the first alert of `kind` for `user` came, s.
fn first(story: &Story, kind: AlertKind, user: Option<&str>) -> Option<f64> {
    let raised = tell(story).raised();
    let found = raised.iter().find(|(k, u, _)| *k == kind && u.as_deref() == user);
    found.map(|(_, _, t)| *t)
}

#[test]
fn a_flood_of_invented_users_hides_no_intruder_and_holds_nobody_up() {
    let mut story = intrusion(1);
    for k in 0..5000 {
        let (x, y) = (f64::from(k % 71) * 3.4 - 120.0, f64::from(k / 71) * 3.3 - 117.0);
        // Nobody claims to be where the intruder is: that would be another story.
        if (x - 20.0).hypot(y - 10.0) > 20.0 {
            story.forged.push((9.0, forged(&format!("!{k}"), 9.0, x, y)));
        }
    }
    let began = Instant::now();
    let told = tell_with(&story, false);
    // 60 frames with the flood; slow even for a debug build on a busy machine would be a stall of the product.
    assert!(began.elapsed().as_secs_f64() < 30.0, "{:?}", began.elapsed());
    let found = told
        .raised()
        .iter()
        .any(|(kind, _, t)| *kind == UnclaimedEmitter && *t <= 11.0);
    assert!(found, "{} alerts", told.raised().len());
}

/// A grid of names over the whole view, each claimed once a second, in steps of 10 m: an eavesdropper who walks through it is near one of them at any time.
fn carpet(story: &mut Story, from_s: u32) {
    for s in from_s..story.seconds as u32 {
        for k in 0..625 {
            let t = f64::from(s) + 0.001 * f64::from(k);
            let (x, y) = (f64::from(k % 25) * 10.0 - 120.0, f64::from(k / 25) * 10.0 - 120.0);
            story.forged.push((t, forged(&format!("!{k}"), t, x, y)));
        }
    }
}

#[test]
fn a_carpet_of_claims_makes_nobody_of_an_eavesdropper_a_user() {
    let walks: [fn(f64) -> [f64; 2]; 3] = [
        |t| [24.0 + 0.8 * (t - 10.0), 14.0],
        |t| [25.0 + 1.5 * (t - 10.0), 15.0 + 0.5 * (t - 10.0)],
        |_| [25.0, 15.0],
    ];
    for (k, walk) in walks.into_iter().enumerate() {
        let mut actors = crowd();
        actors.push(Actor::intruder(move |t| (t >= 10.0).then(|| walk(t))));
        let mut story = Story::new(20 + k as u64, actors);
        story.seconds = 40.0;
        carpet(&mut story, 4);
        let told = tell(&story);
        let raised = told.raised();
        let alert = raised.iter().find(|(kind, ..)| *kind == UnclaimedEmitter);
        assert!(alert.is_some_and(|(.., t)| *t <= 11.0), "walk {k}: {raised:?}");
        let verified = |r: &oapwatch::monitor::Report| {
            let invented = |e: &&TrackedPosition| e.user.as_ref().is_some_and(|u| u.starts_with('!'));
            r.emitters
                .iter()
                .filter(|e| e.status == PositionStatus::Verified)
                .find(invented)
                .map(|e| e.user.clone())
        };
        let found = told
            .reports
            .iter()
            .find_map(|r| verified(r).map(|user| (r.frame, user)));
        assert_eq!(found, None, "walk {k}");
        // Those who were there before go on as they were.
        for user in 0..6 {
            let user = format!("u-{user}");
            let known = told.reports[60..].iter().filter(|r| {
                let of = r.emitters.iter().find(|e| e.user.as_deref() == Some(user.as_str()));
                of.is_some_and(|e| e.status == PositionStatus::Verified)
            });
            assert!(known.count() > 330, "walk {k}: {user}");
        }
        assert!(
            raised.iter().any(|(kind, ..)| *kind == ClaimsFlooded),
            "walk {k}: {raised:?}"
        );
        let others = raised.iter().filter(|(kind, user, _)| {
            let invented = user.as_ref().is_none_or(|u| u.starts_with('!'));
            !(matches!(kind, UnclaimedEmitter | ClaimsFlooded) || (*kind == UserUnseen && invented))
        });
        assert_eq!(others.count(), 0, "walk {k}: {raised:?}");
    }
}

/// One invented name, claimed at a place for a while: who is nobody's and then walks there is not the one who was claimed.
#[test]
fn a_beam_that_walks_onto_a_claim_stays_nobodys() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| {
        (t >= 10.0).then(|| [(0.8 * (t - 10.0)).min(20.0) + 20.0, 10.0])
    }));
    let mut story = Story::new(23, actors);
    story.seconds = 60.0;
    for s in 5..60 {
        story.forged.push((f64::from(s), forged("!", f64::from(s), 40.0, 10.0)));
    }
    let told = tell(&story);
    let raised = told.raised();
    assert!(
        raised
            .iter()
            .any(|(kind, _, t)| *kind == UnclaimedEmitter && *t <= 11.0),
        "{raised:?}"
    );
    let cleared = told
        .events
        .iter()
        .filter(|e| e.alert.kind == UnclaimedEmitter && e.alert.cleared_at.is_some());
    assert_eq!(cleared.count(), 0);
}

/// What was claimed too late, or wrongly, and then comes to the beam clears the alert as ever.
#[test]
fn a_claim_that_comes_to_the_beam_clears_its_alert() {
    let mut actors = crowd();
    let place = |t: f64| (t >= 10.0).then_some([20.0, 10.0]);
    let claimed = |t: f64| (t >= 5.0).then_some(if t < 20.0 { [60.0, 10.0] } else { [20.0, 10.0] });
    actors.push(Actor::new("late", |_| [20.0, 10.0]).beam(place).claim(claimed));
    let mut story = Story::new(24, actors);
    story.seconds = 40.0;
    let told = tell(&story);
    let open = told.events.iter().rev().find(|e| e.alert.kind == UnclaimedEmitter);
    assert!(open.is_some_and(|e| e.alert.cleared_at.is_some()), "{}", told.ndjson());
    let last = told.reports.last().expect("reports");
    assert!(
        last.emitters.iter().any(|e| e.user.as_deref() == Some("late")),
        "{last:?}"
    );
}

/// Ever new names, more than there is room for, at ever other places: an eavesdropper who comes meanwhile is alerted, the alert of the flood comes and goes.
#[test]
fn a_flood_without_room_is_alerted_and_clears() {
    let mut story = intrusion(25);
    story.seconds = 90.0;
    for k in 0..60_000u32 {
        let t = 5.0 + f64::from(k) / 7000.0;
        let u = |m: u64| (u64::from(k).wrapping_mul(m) >> 11) as f64 / (1u64 << 53) as f64 * 240.0 - 120.0;
        let (x, y) = (u(0x9e37_79b9_7f4a_7c15), u(0xd1b5_4a32_d192_ed03));
        story.forged.push((t, forged(&format!("!{k}"), t, x, y)));
    }
    let told = tell_with(&story, false);
    let raised = told.raised();
    let at = |kind| raised.iter().find(|(k, ..)| *k == kind).map(|(.., t)| *t);
    assert!(at(UnclaimedEmitter).is_some_and(|t| t <= 11.0), "{raised:?}");
    assert!(at(ClaimsFlooded).is_some_and(|t| t < 9.0), "{raised:?}");
    let flood = told
        .events
        .iter()
        .rev()
        .find(|e| e.alert.kind == ClaimsFlooded)
        .expect("an event");
    assert_eq!(flood.alert.severity, Severity::Critical);
    assert!(flood.alert.evidence["claims_lost_per_s"].is_number(), "{flood:?}");
    assert!(flood.alert.cleared_at.is_some(), "{flood:?}");
}

#[test]
fn forged_claims_for_others_raise_alerts_and_stop_none() {
    // Far off, and always a moment newer than the truth.
    let mut story = intrusion(2);
    for k in 0..300 {
        let t = 0.05 * f64::from(k);
        story.forged.push((t, forged("u-2", t, 80.0, 100.0)));
    }
    assert!(first(&story, UnclaimedEmitter, None).is_some_and(|t| t <= 11.0));
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some());
}

#[test]
fn claims_from_the_future_the_past_and_the_ends_of_the_world_change_nothing() {
    let mut story = intrusion(3);
    for k in 0..200 {
        let t = 0.07 * f64::from(k);
        story.forged.push((t, forged("u-2", t + 1e6, 0.0, 0.0)));
        story.forged.push((t, forged("u-2", t - 1e6, 0.0, 0.0)));
        story.forged.push((t, forged(&"x".repeat(256), t, 1e7, -1e7)));
        let mut odd = forged("odd", t, f64::NAN, f64::INFINITY);
        odd.sigma_m = Some(f64::NAN);
        story.forged.push((t, odd));
    }
    tell(&story).expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
}

/// A stated error of a kilometre must not make a lie about the place pass, nor a claim that is repeated count twice.
#[test]
fn a_huge_sigma_and_repeated_claims_hide_no_lie() {
    let mut story = Story::new(4, crowd());
    story.seconds = 40.0;
    story.actors[2] =
        Actor::new("u-2", |_| [60.0, -50.0]).claim(|t| Some(if t < 10.0 { [60.0, -50.0] } else { [100.0, -50.0] }));
    story.actors[2].sigma_m = 0.3;
    let mut lies: Vec<(f64, Claim)> = Vec::new();
    for k in 0..300 {
        let t = 10.0 + 0.1 * f64::from(k);
        let mut claim = forged("u-2", t, 100.0, -50.0);
        claim.sigma_m = Some(1000.0);
        lies.extend([(t, claim.clone()), (t, claim.clone()), (t, claim)]);
    }
    story.forged = lies;
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some_and(|t| t <= 14.0));
}

/// Claims that end and start again at every turn neither hide the beam nor shake an alert off.
#[test]
fn a_session_that_ends_all_the_time_hides_no_lie() {
    let mut story = Story::new(5, crowd());
    story.seconds = 40.0;
    story.actors[2] = Actor::new("u-2", |_| [60.0, -50.0]).claim(|t| (t < 10.0).then_some([60.0, -50.0]));
    for k in 0..120 {
        let t = 10.0 + 0.25 * f64::from(k);
        let mut claim = forged("u-2", t, 100.0, -50.0);
        if k % 2 == 1 {
            claim.state = ClaimState::Ended;
        }
        story.forged.push((t, claim));
    }
    let raised = tell(&story).raised();
    assert!(
        raised
            .iter()
            .any(|(kind, _, t)| matches!(kind, PositionMismatch | UnclaimedEmitter) && *t <= 16.0),
        "{raised:?}"
    );
}

/// Fewer than a third of the users lie together to shift our own pose.
#[test]
fn liars_in_league_do_not_move_our_pose() {
    let mut actors = crowd();
    actors.push(Actor::new("u-6", |_| [40.0, 0.0]));
    for (k, place) in [(1, [0.0, -50.0]), (4, [0.0, 50.0])] {
        actors[k] = Actor::new(&format!("u-{k}"), move |_| place).claim(move |t| {
            let lie = 0.3 * (t - 10.0).max(0.0);
            Some([place[0] + lie, place[1]])
        });
    }
    let mut story = Story::new(6, actors);
    story.seconds = 60.0;
    let told = tell(&story);
    let mut who: Vec<_> = told.raised().into_iter().map(|(kind, user, _)| (kind, user)).collect();
    who.sort();
    assert_eq!(
        who,
        [
            (PositionMismatch, Some("u-1".into())),
            (PositionMismatch, Some("u-4".into()))
        ],
        "{}",
        told.ndjson()
    );
}

/// Two of seven lie as if we were turned by three degrees; being far out makes their lies large.
#[test]
fn liars_in_league_do_not_turn_us() {
    let mut actors = crowd();
    actors.push(Actor::new("u-6", |_| [40.0, 0.0]));
    for (k, place) in [(0, [-90.0, -60.0]), (5, [90.0, 60.0])] {
        actors[k] = Actor::new(&format!("u-{k}"), move |_| place).claim(move |t| {
            let turn = 0.15 * ((t - 10.0) / 40.0).clamp(0.0, 1.0);
            Some([place[0] + turn * place[1], place[1] - turn * place[0]])
        });
    }
    let mut story = Story::new(7, actors);
    story.seconds = 60.0;
    let told = tell(&story);
    let mut who: Vec<_> = told.raised().into_iter().map(|(kind, user, _)| (kind, user)).collect();
    who.sort();
    let expected = ["u-0", "u-5"].map(|u| (PositionMismatch, Some(u.to_owned())));
    assert_eq!(who, expected, "{}", told.ndjson());
}

/// A user goes off the air without a word. Their last claim is nobody's licence to appear near it.
#[test]
fn a_silent_users_old_claim_covers_for_no_stranger() {
    let mut actors = crowd();
    let there = |t: f64| (t < 10.0).then_some([80.0, -50.0]);
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(there).claim(there);
    actors.push(Actor::intruder(|t| (t >= 22.0).then_some([60.0, -20.0])));
    let told = tell(&Story::new(8, actors));
    let found = told.raised().into_iter().find(|(kind, ..)| *kind == UnclaimedEmitter);
    assert!(
        found.is_some_and(|(_, _, t)| (22.0..=23.0).contains(&t)),
        "{}",
        told.ndjson()
    );
}

/// Claims that were true once are sent again, with their old times and with new ones.
#[test]
fn replayed_claims_hide_no_lie() {
    let mut story = Story::new(9, crowd());
    story.actors[2] = Actor::new("u-2", |_| [80.0, -50.0])
        .beam(|t| Some(if t < 10.0 { [80.0, -50.0] } else { [80.0, -35.0] }))
        .claim(|t| (t < 10.0).then_some([80.0, -50.0]));
    for k in 0..100 {
        let t = 10.0 + 0.2 * f64::from(k);
        story
            .forged
            .push((t, forged("u-2", 9.0 - 0.1 * f64::from(k % 20), 80.0, -50.0)));
        story.forged.push((t, forged("u-2", t, 80.0, -50.0)));
    }
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some_and(|t| t <= 11.0));
}

/// Step by step with a user, never near enough to share the spot for long, never claimed.
#[test]
fn an_eavesdropper_that_follows_a_user_is_one_alert() {
    for (seed, away) in [(10, 2.0), (11, 4.0), (12, 8.0)] {
        let mut actors = crowd();
        let victim = |t: f64| [15.0 * (0.06 * t + 1.0).sin(), -50.0 + 15.0 * (0.05 * t + 2.0).cos()];
        actors.push(Actor::intruder(move |t| {
            let [x, y] = victim((t - 1.0).max(0.0));
            (t >= 10.0).then_some([x + away * (0.2 * t).cos(), y + away * (0.2 * t).sin()])
        }));
        let mut story = Story::new(seed, actors);
        story.seconds = 60.0;
        tell(&story).expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
    }
}

/// A beam that blinks is not an alert a blink: what goes out dies down, and the alert counts how often it came back.
#[test]
fn a_beam_that_blinks_does_not_flood() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| {
        (t >= 10.0 && (t - 10.0) % 5.0 < 2.0).then_some([20.0, 10.0])
    }));
    let mut story = Story::new(13, actors);
    story.seconds = 310.0;
    let told = tell(&story);
    let raised = told.raised();
    assert!(raised.iter().all(|(kind, ..)| *kind == UnclaimedEmitter), "{raised:?}");
    // Held for 1, 2, 4 s: the third time it outlasts the three seconds of dark.
    assert_eq!(raised.len(), 3, "{raised:?}");
    let last = &told.events.last().expect("events").alert;
    assert!(last.evidence["recurrences"].as_u64() >= Some(2), "{last:?}");
}

/// A hundred and twenty users who are nowhere, claimed for twenty seconds: some alerts of their own, one for the rest, and a user
/// whose beam goes off meanwhile is told of as ever.
#[test]
fn invented_users_share_an_alert_and_bury_no_other() {
    let mut actors = crowd();
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(|t| (t < 20.0).then_some([80.0, -50.0]));
    let mut story = Story::new(14, actors);
    story.seconds = 60.0;
    for k in 0..120 {
        let place = [f64::from(k % 20) * 10.0 - 95.0, f64::from(k / 20) * 10.0 - 70.0];
        for t in 10..30 {
            let t = f64::from(t) + 0.003 * f64::from(k);
            story.forged.push((t, forged(&format!("!{k}"), t, place[0], place[1])));
        }
    }
    let told = tell(&story);
    let raised = told.raised();
    assert!(raised.iter().all(|(kind, ..)| *kind == UserUnseen), "{raised:?}");
    let (common, own): (Vec<_>, Vec<_>) = raised.iter().partition(|(_, user, _)| user.is_none());
    assert_eq!(common.len(), 1, "{raised:?}");
    let invented = own.iter().filter(|(_, user, _)| user.as_deref() != Some("u-2"));
    assert_eq!(invented.count(), 10, "{raised:?}");
    let real: Vec<f64> = own
        .iter()
        .filter(|(_, user, _)| user.as_deref() == Some("u-2"))
        .map(|(.., t)| *t)
        .collect();
    // One alert; a claim made after the beam went off is waited for, as ever.
    assert!(matches!(real[..], [t] if (21.0..=22.5).contains(&t)), "{raised:?}");
    // All of them are listed as unseen, and the alert says how many share it.
    let busy = told.reports.iter().max_by_key(|r| r.unseen.len()).expect("reports");
    assert_eq!(busy.unseen.len(), 121);
    let shared = told
        .events
        .iter()
        .rev()
        .find(|e| e.alert.user.is_none())
        .expect("an event");
    // A few of them are claimed where a user's beam passes.
    let sharing = shared.alert.evidence["users_never_seen"].as_u64();
    assert!((100..=110).contains(&sharing.unwrap_or(0)), "{shared:?}");
    assert_eq!(shared.alert.severity, Severity::Critical);
}

/// New names in every claim: the alerts do not grow with the names.
#[test]
fn ever_new_names_raise_a_bounded_number_of_alerts() {
    let mut story = Story::new(15, crowd());
    story.seconds = 60.0;
    for k in 0..400 {
        let t = 5.0 + 0.1 * f64::from(k);
        let name = format!("!{k}");
        let (x, y) = (f64::from(k % 20) * 10.0 - 95.0, f64::from(k / 20) * 10.0 - 95.0);
        story.forged.push((t, forged(&name, t, x, y)));
        let mut over = forged(&name, t + 3.0, x, y);
        over.state = ClaimState::Ended;
        story.forged.push((t + 3.0, over));
    }
    let told = tell_with(&story, false);
    // Ten within a minute, and one for all others.
    assert_eq!(told.raised().len(), 11, "{:?}", told.raised());
}

#[test]
fn light_that_does_not_fit_the_reported_power_is_evidence() {
    let mut actors = crowd();
    // u-1 reports half of the others' power and sends it; who answers u-0's claim from 20 m off is a sixth as bright as u-0 reports.
    actors.iter_mut().for_each(|a| a.reports_w = Some(1.0));
    actors[1].reports_w = Some(0.5);
    actors[1].energy_j *= 0.5;
    actors[0] =
        Actor::new("u-0", |_| [-80.0, -50.0]).beam(|t| Some(if t < 10.0 { [-80.0, -50.0] } else { [-80.0, -30.0] }));
    actors[0].reports_w = Some(6.0);
    let mut story = Story::new(3, actors);
    story.seconds = 15.0;
    let told = tell(&story);
    let alert = &told.events[0].alert;
    assert_eq!((alert.kind, alert.user.as_deref()), (PositionMismatch, Some("u-0")));
    let power = &alert.evidence["power_against_reported"];
    assert_eq!(power["reported_w"], 6.0);
    let ratio = power["ratio"].as_f64().unwrap();
    assert!((0.08..0.35).contains(&ratio), "{ratio}");
    assert!(power["likelihood_ratio"].as_f64().unwrap() > 10.0, "{power}");
}
