//! The store of claims: it cannot be filled up or lied into.

use oapwatch::claims::{Beam, Bearing, Config, MOST_UNANSWERED, Outcome, Store};

use super::{at, claim};

#[test]
fn the_store_tells_apart_new_late_repeated_and_contradicting_claims() {
    let mut store = Store::new(&Config::default());
    assert_eq!(store.insert(claim("a", 1.0, 1.0), at(1.0)), Outcome::Accepted);
    assert_eq!(store.insert(claim("a", 1.0, 1.0), at(1.1)), Outcome::Duplicate);
    assert_eq!(store.insert(claim("a", 1.0, 50.0), at(1.2)), Outcome::Conflicting);
    assert_eq!(store.insert(claim("a", 3.0, 3.0), at(3.0)), Outcome::Accepted);
    assert_eq!(store.insert(claim("a", 2.0, 4.0), at(3.1)), Outcome::Late);
    assert_eq!(store.user("a").unwrap().claim.x_m, 3.0);
    assert_eq!(store.position_at("a", at(1.5)).unwrap(), [2.5, 0.0]);
    assert_eq!(store.position_at("a", at(9.0)).unwrap(), [3.0, 0.0]);
    assert_eq!(store.position_at("a", at(0.0)).unwrap(), [1.0, 0.0]);
    assert_eq!(store.position_at("nobody", at(0.0)), None);
    let counts = store.counts();
    assert_eq!(
        (counts.accepted, counts.late, counts.duplicate, counts.conflicting),
        (2, 1, 1, 1)
    );
}

#[test]
fn a_claim_from_the_future_waits_for_its_time() {
    let mut store = Store::new(&Config::default());
    assert_eq!(store.insert(claim("a", 5.0, 1.0), at(1.0)), Outcome::Ahead);
    store.advance(at(4.9));
    assert!(store.is_empty());
    store.advance(at(5.0));
    assert_eq!(store.len(), 1);
    // It cannot keep out what is true now.
    store.insert(claim("b", 1e7, 9.0), at(6.0));
    assert_eq!(store.insert(claim("b", 6.0, 2.0), at(6.0)), Outcome::Accepted);
    assert_eq!(store.user("b").unwrap().claim.x_m, 2.0);
}

#[test]
fn a_flood_of_users_pushes_nobody_out() {
    let config = Config {
        max_users: 3,
        ..Config::default()
    };
    let mut store = Store::new(&config);
    for user in ["a", "b", "c"] {
        assert_eq!(store.insert(claim(user, 0.0, 0.0), at(0.0)), Outcome::Accepted);
    }
    assert_eq!(store.insert(claim("flood", 1.0, 0.0), at(1.0)), Outcome::Full);
    assert!(store.user("a").is_some());
    // Users long silent do make room.
    store.insert(claim("b", 1000.0, 0.0), at(1000.0));
    assert_eq!(store.insert(claim("new", 1000.0, 0.0), at(1000.0)), Outcome::Accepted);
    assert!(store.user("b").is_some() && store.len() == 3);
}

fn names(store: &mut Store, range: std::ops::Range<u32>, s: f64) -> usize {
    range
        .filter(|k| store.insert(claim(&format!("!{k}"), s, 0.0), at(s)) == Outcome::Accepted)
        .count()
}

/// Today's cost of one refusal is what a frame can bear, not what a store of 20,000 takes to look through.
#[test]
fn a_full_store_refuses_at_once() {
    let mut store = Store::new(&Config::default());
    assert_eq!(names(&mut store, 0..20_000, 0.0), 20_000);
    let began = std::time::Instant::now();
    assert_eq!(names(&mut store, 20_000..220_000, 1.0), 0);
    let each = began.elapsed() / 200_000;
    assert!(each < std::time::Duration::from_micros(20), "{each:?} a refused claim");
    assert_eq!(store.squeezed(at(1.0)).refused, 200_000);
    assert_eq!(store.squeezed(at(12.0)).refused, 0);
}

#[test]
fn a_flood_displaces_its_own_kind_and_a_newcomer_who_goes_on_claiming_stays() {
    let config = Config {
        max_users: 1000,
        ..Config::default()
    };
    let mut store = Store::new(&config);
    // One user whom a beam answers, and one whom none does, claimed once a second for a minute.
    for s in 0..60 {
        let s = f64::from(s);
        for user in ["seen", "elsewhere"] {
            store.insert(claim(user, s, 0.0), at(s));
        }
        store.answered("seen", at(s));
        store.advance(at(s));
    }
    let roster = store.roster();
    assert_eq!(
        roster.knows(["seen", "elsewhere", "!0"].into_iter()),
        [true, true, false]
    );
    // A hundred new names every .1 s fill the store within a second; a newcomer claims once a second from then on.
    let mut is_in_since = None;
    for k in 0..600u32 {
        let s = 60.0 + 0.1 * f64::from(k);
        if k >= 20 && k % 10 == 0 {
            store.insert(claim("newcomer", s, 0.0), at(s));
        }
        names(&mut store, 100 * k..100 * (k + 1), s);
        match store.user("newcomer") {
            Some(_) => is_in_since = is_in_since.or(Some(s)),
            None => assert_eq!(is_in_since, None, "forgotten again"),
        }
        assert!(store.len() <= 1000);
    }
    assert!(is_in_since.is_some_and(|s| s < 75.0), "{is_in_since:?}");
    assert!(store.user("seen").is_some() && store.user("elsewhere").is_some());
    assert!(store.squeezed(at(120.0)).forgotten_early > 0);
}

#[test]
fn who_is_claimed_beside_a_beam_that_is_nobodys_is_let_in_first() {
    let config = Config {
        max_users: 100,
        ..Config::default()
    };
    let mut store = Store::new(&config);
    names(&mut store, 0..100, 0.0);
    let beam = Beam {
        position: [40.0, 3.0],
        is_answered: false,
    };
    store.choose(&[beam], |_| Some(Bearing::InView));
    assert_eq!(store.insert(claim("far", 1.0, 70.0), at(1.0)), Outcome::Full);
    assert_eq!(store.insert(claim("beside", 1.0, 38.0), at(1.0)), Outcome::Accepted);
}

/// However many are claimed, a frame is held against a bounded number: of those whom a beam answered all, of the others those at beams.
#[test]
fn a_frame_is_held_against_a_bounded_number_of_claims() {
    let mut store = Store::new(&Config::default());
    for k in 0..15_000u32 {
        let place = [f64::from(k % 150), f64::from(k / 150)];
        let mut claim = claim(&format!("!{k}"), 0.0, place[0]);
        claim.y_m = place[1];
        store.insert(claim, at(0.0));
    }
    store.answered("!9", at(0.0));
    let beam = Beam {
        position: [77.0, 55.2],
        is_answered: false,
    };
    store.choose(&[beam], |_| Some(Bearing::InView));
    let chosen: Vec<String> = store.chosen().map(|s| s.claim.user.clone()).collect();
    assert_eq!(chosen.len(), MOST_UNANSWERED + 1);
    assert_eq!(store.left_out(), 15_000 - chosen.len());
    let nearest = format!("!{}", 55 * 150 + 77);
    assert!(
        chosen.contains(&"!9".to_owned()) && chosen.contains(&nearest),
        "{chosen:?}"
    );
    assert!(chosen.is_sorted(), "by name");
    // Those that bear no more leave.
    for _ in 0..100 {
        store.choose(&[], |s| (s.claim.x_m < 1.0).then_some(Bearing::InView));
    }
    assert_eq!((store.chosen().count(), store.left_out()), (101, 0));
}

/// Claims for years to come keep out none of the next second.
#[test]
fn claims_far_ahead_of_their_time_make_way() {
    let mut store = Store::new(&Config::default());
    store.expect_live_claims();
    for k in 0..5000u32 {
        store.insert(claim(&format!("!{k}"), 1e6 + f64::from(k), 0.0), at(0.0));
    }
    assert_eq!(store.insert(claim("ahead", 0.5, 1.0), at(0.0)), Outcome::Ahead);
    assert_eq!(store.insert(claim("beyond", 1e8, 1.0), at(0.0)), Outcome::Full);
    store.advance(at(1.0));
    assert!(store.user("ahead").is_some());
}
