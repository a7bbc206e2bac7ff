//! Many names claimed without a beam.

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::{PositionStatus, TrackedPosition};

use crate::hostile::forged;
use crate::stories::{Actor, Expect, Story, crowd, tell};

/// A grid of names over the whole view, each claimed once a second, in steps of 10 m: an eavesdropper who walks through it is near one
/// of them at any time.
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

/// A network whose users are many times those in view: the others claim every ten seconds to be 25 m outside of it. Each may have
/// walked into view since, and none has: claims that cannot be held against a frame for their number would be a flood that never ends.
#[test]
fn a_network_of_many_users_outside_the_view_is_no_flood() {
    let mut story = Story::new(30, crowd());
    story.seconds = 60.0;
    for k in 0..300 {
        let along = f64::from(k % 75) * 4.0 - 150.0;
        let (x, y) = [(along, 150.0), (along, -150.0), (150.0, along), (-150.0, along)][k as usize / 75];
        for s in 0..6 {
            let t = 10.0 * f64::from(s) + 0.03 * f64::from(k);
            story.forged.push((t, forged(&format!("far-{k}"), t, x, y)));
        }
    }
    tell(&story).expect(&[]);
}
