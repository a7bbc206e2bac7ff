//! Which claims bear on a frame, and how far.

use super::*;
use crate::claims;
use crate::optics;

fn at(s: i64) -> Timestamp {
    Timestamp::from_second(s).unwrap()
}

/// The active claims at `now` s after these claims of one user at (t, x), s and m.
fn active(made: &[(i64, f64)], state: ClaimState, now: i64, clock_offset_s: f64, followed: bool) -> Vec<ActiveClaim> {
    let mut store = Store::new(&claims::Config::default());
    for (t, x) in made {
        let claim = Claim {
            time: at(*t),
            user: "a".into(),
            x_m: *x,
            y_m: 0.0,
            z_m: None,
            sigma_m: Some(1000.0),
            cov_m2: None,
            power_w: None,
            state,
        };
        store.insert(claim, at(*t));
    }
    if followed {
        store.answered("a", at(now));
    }
    let scope = Scope {
        config: &Config::default(),
        view: &View::level(&optics::Config::default().camera().unwrap()),
        default_sigma_m: 1.0,
        clock_offset_s,
    };
    let user = UserTrack {
        track: Some(7),
        ..UserTrack::default()
    };
    active_claims(
        &mut store,
        at(now),
        scope,
        &[],
        |_| Some(user),
        |track| followed && track == 7,
    )
}

#[test]
fn a_claim_ages_and_its_stated_error_is_bounded() {
    let active = active(&[(10, 0.0), (12, 4.0)], ClaimState::Active, 15, 0.0, false);
    let claim = &active[0];
    assert_eq!((claim.age_s, claim.variance, claim.period_s), (3.0, 25.0, Some(2.0)));
    // A walk of 3 m/s: claims that may be off by a kilometre show no pace.
    assert_eq!(claim.slack_m, 9.0);
}

#[test]
fn a_clock_ahead_of_ours_makes_claims_older_and_none_is_from_the_future() {
    let age = |offset: f64| active(&[(10, 0.0)], ClaimState::Active, 11, offset, false)[0].age_s;
    assert_eq!(age(0.5), 1.5);
    assert_eq!(age(-5.0), 0.0);
}

#[test]
fn claims_out_of_view_bear_on_nothing_unless_their_beam_is_followed() {
    // The default view reaches 125 m; errors of 5 m count five times.
    let of = |x: f64, followed: bool| active(&[(10, x)], ClaimState::Active, 10, 0.0, followed);
    assert!(of(100.0, false)[0].expected);
    assert!(!of(130.0, false)[0].expected);
    assert!(of(400.0, false).is_empty());
    assert_eq!(of(400.0, true).len(), 1);
}

#[test]
fn a_claim_is_in_view_within_what_is_tolerated_and_beyond_it_by_its_age() {
    let scope = Scope {
        config: &Config::default(),
        view: &View::level(&optics::Config::default().camera().unwrap()),
        default_sigma_m: 0.2,
        clock_offset_s: 0.0,
    };
    let bearing = |x_m: f64, age_s: i64| {
        let claim = Claim {
            x_m,
            sigma_m: None,
            ..fixture::active_claim("a", 0.0, 0.0).claim
        };
        let standing = Standing {
            claim: &claim,
            came: at(0),
            pace_m_s: 0.0,
            period_s: None,
        };
        scope.bearing(&standing, &Reach::of(&standing, at(age_s), &scope))
    };
    // The default view reaches 125 m; 5 m are tolerated, and five times 0.2 m.
    assert_eq!(bearing(130.9, 0), Some(Bearing::InView));
    assert_eq!(bearing(131.1, 0), Some(Bearing::Beyond));
    // In 50 s a user walks 150 m.
    assert_eq!(
        [0, 50].map(|age_s| bearing(270.0, age_s)),
        [None, Some(Bearing::Beyond)]
    );
    assert_eq!(bearing(0.0, 61), None);
}

#[test]
fn who_claimed_to_be_in_view_may_have_left_it_since() {
    // 25 m inside the edge: 15 m of error are believed, and 3 m/s.
    let after = |s: i64| {
        let claim = &active(&[(10, 85.0)], ClaimState::Active, 10 + s, 0.0, false)[0];
        (claim.expected, claim.may_have_left)
    };
    assert_eq!([after(0), after(20)], [(true, false), (false, true)]);
    let beyond = &active(&[(10, 130.0)], ClaimState::Active, 10, 0.0, false)[0];
    assert!(!beyond.expected && !beyond.may_have_left);
}

#[test]
fn an_ended_claim_bears_for_its_grace() {
    let of = |now: i64| active(&[(10, 0.0)], ClaimState::Ended, now, 0.0, true);
    assert!(of(13)[0].ended && !of(13)[0].expected);
    assert!(of(14).is_empty());
}

#[test]
fn the_association_widens_with_age_up_to_a_bound() {
    let mut claim = fixture::active_claim("a", 0.0, 0.0);
    let variance = |claim: &ActiveClaim| claim.association_cov(4.0, claim.slack_m)[(0, 0)];
    assert!((variance(&claim) - 4.09).abs() < 1e-12);
    claim.slack_m = 6.0;
    assert!((variance(&claim) - 13.09).abs() < 1e-12);
    claim.slack_m = 1e9;
    assert!((variance(&claim) - 904.09).abs() < 1e-9);
}
