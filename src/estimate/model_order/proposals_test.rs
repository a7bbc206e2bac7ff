//! Proposals on frames where they are the ones that are needed, and each derived quantity against a brute-force fit.

use crate::estimate::config::KnownPower;
use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::map_search::{balance_pair, divide, explore_ill_determined};
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::proposals::{birth, death, merge, merge_all, merge_pairs, relocate_inside, split};
use crate::estimate::model_order::search::Search;
use crate::estimate::rules::Rules;
use crate::estimate::test_frame::{Shown, hypothesis};

const ENERGY: f64 = 300.0;
const STEPS: usize = 100;
/// Six standard deviations of a lone source of `ENERGY`, σ: √(8 π)/(pitch · energy) with pixels of half a σ.
const NEAR: f64 = 0.2;

/// Fits sources at `places` to a frame of `shown`, proposes, and returns whether a proposal was accepted and what then stands. Checks that
/// nothing is accepted without the rule, and that what is accepted scores better.
fn propose(
    rule: &str,
    shown: &Shown,
    places: &[[f64; 2]],
    proposal: impl Fn(&mut Search, &mut Candidate) -> bool,
) -> (bool, Hypothesis) {
    propose_from(rule, shown, places, STEPS, proposal)
}

fn propose_from(
    rule: &str,
    shown: &Shown,
    places: &[[f64; 2]],
    steps: usize,
    proposal: impl Fn(&mut Search, &mut Candidate) -> bool,
) -> (bool, Hypothesis) {
    let mut results = [Rules::without(rule).expect("a rule"), Rules::default()].map(|rules| {
        let mut frame = Shown { rules, ..shown.clone() }.frame();
        let mut budget = WorkBudget::new(&|| false);
        let mut search = frame.space.search(&frame.compressed, &frame.frame, &mut budget);
        let mut candidate = Candidate::from(hypothesis(Nuisances::default(), places));
        fit(&mut search.context, &mut candidate, steps);
        let before = search.score(&candidate);
        let is_accepted = proposal(&mut search, &mut candidate);
        assert_eq!(is_accepted, search.score(&candidate) < before);
        (is_accepted, candidate.into_hypothesis())
    });
    let with = std::mem::replace(&mut results[1], (false, hypothesis(Nuisances::default(), &[])));
    assert!(!results[0].0, "accepted without {rule}");
    with
}

fn assert_near(found: &Hypothesis, expected: &[[f64; 2]], within: f64) {
    assert_eq!(found.sources.len(), expected.len(), "{:?}", found.sources);
    for u in expected {
        let distance = |v: [f64; 2]| (u[0] - v[0]).hypot(u[1] - v[1]);
        assert!(
            found.sources.iter().any(|s| distance(s.u) < within),
            "{u:?} in {:?}",
            found.sources
        );
    }
}

fn showing<'a>(sources: &'a [([f64; 2], f64)]) -> Shown<'a> {
    Shown {
        pixels_per_sigma: 2.0,
        sources,
        noise: Some(11),
        ..Shown::default()
    }
}

#[test]
fn birth_adds_a_source_at_a_residual_peak() {
    let sources = [([-2.0, 1.0], ENERGY), ([2.0, -1.5], ENERGY)];
    let grow = |search: &mut Search, candidate: &mut Candidate| {
        let peaks = search.residual_peaks(candidate);
        birth(search, candidate, &peaks)
    };
    let (is_accepted, found) = propose("birth", &showing(&sources), &[[-2.0, 1.0]], grow);
    assert!(is_accepted);
    assert_near(&found, &[sources[0].0, sources[1].0], NEAR);
}

#[test]
fn split_puts_two_halves_in_the_place_of_a_pair() {
    let sources = [([-0.7, 0.5], ENERGY), ([0.7, 0.5], ENERGY)];
    let (is_accepted, found) = propose("split", &showing(&sources), &[[0.0, 0.5]], split);
    assert!(is_accepted);
    assert_near(&found, &[sources[0].0, sources[1].0], NEAR);
}

#[test]
fn merge_puts_one_source_in_the_place_of_two_that_share_its_light() {
    let lone = [([1.0, 0.5], ENERGY)];
    let (is_accepted, found) = propose_from("merge", &showing(&lone), &[[0.7, 0.5], [1.3, 0.5]], 0, merge);
    assert!(is_accepted);
    assert_near(&found, &[lone[0].0], NEAR);
    // 2 σ apart, a merged source leaves far more than a source's penalty.
    let pair = [([-1.0, 0.5], ENERGY), ([1.0, 0.5], ENERGY)];
    let (is_accepted, found) = propose("merge", &showing(&pair), &pair.map(|(u, _)| u), merge);
    assert!(!is_accepted);
    assert_near(&found, &pair.map(|(u, _)| u), NEAR);
}

#[test]
fn merge_all_merges_two_unresolved_pairs_at_once_and_leaves_one_to_merge() {
    let sources = [([-2.5, 0.0], ENERGY), ([2.5, 0.0], ENERGY)];
    let halves = [[-2.5, -0.2], [-2.5, 0.2], [2.3, 0.0], [2.7, 0.0]];
    let (is_accepted, found) = propose_from("merge_all", &showing(&sources), &halves, 0, merge_all);
    assert!(is_accepted);
    assert_near(&found, &sources.map(|(u, _)| u), NEAR);
    let (is_accepted, found) = propose_from("merge_all", &showing(&sources), &halves[1..], 0, merge_all);
    assert!(!is_accepted && found.sources.len() == 3, "one pair alone");
}

#[test]
fn death_removes_a_source_of_no_light() {
    let lone = [([-2.0, 1.0], ENERGY)];
    let (is_accepted, found) = propose("death", &showing(&lone), &[[-2.0, 1.0], [3.0, -2.0]], death);
    assert!(is_accepted);
    assert_near(&found, &[lone[0].0], NEAR);
}

#[test]
fn relocate_inside_replaces_a_pair_at_the_edge_by_the_source_that_the_edge_cuts() {
    // The sensor ends at 5 σ.
    let lone = [([4.7, 0.0], ENERGY)];
    let (is_accepted, found) = propose(
        "relocate_inside",
        &showing(&lone),
        &[[5.6, 0.3], [4.4, -0.1]],
        relocate_inside,
    );
    assert!(is_accepted);
    assert_near(&found, &[lone[0].0], 0.1);
}

/// A user's beam brings `ENERGY` on average, wherever it comes from.
fn with_known_power(
    shown: &Shown,
    places: &[[f64; 2]],
    proposal: impl Fn(&mut Search, &PowerPrior, &mut Candidate) -> bool,
) -> (bool, Hypothesis) {
    let mut frame = shown.frame();
    let known = KnownPower {
        energies_j: vec![ENERGY * frame.camera.noise_std_j],
        relative_std: 0.05,
        share: 0.95,
        attenuation_per_m: 0.0,
    };
    known.validate().expect("known powers");
    let prior = PowerPrior::new(&known, &frame.camera);
    let mut budget = WorkBudget::new(&|| false);
    let mut search = frame
        .space
        .search(&frame.compressed, &frame.frame, &mut budget)
        .with_prior(&prior);
    let mut candidate = Candidate::from(hypothesis(Nuisances::default(), places));
    let none = Hypothesis::empty(Nuisances::default());
    search.fit_against(&none, &mut candidate);
    let before = search.score(&candidate);
    let is_accepted = proposal(&mut search, &prior, &mut candidate);
    assert_eq!(is_accepted, search.score(&candidate) < before);
    (is_accepted, candidate.into_hypothesis())
}

/// A factor by which the energy at `u` on the sensor is smaller than straight below.
fn users(places: &[[f64; 2]]) -> Vec<([f64; 2], f64)> {
    let frame = showing(&[]).frame();
    let camera = &frame.camera;
    let share = |u: &[f64; 2]| {
        let [x, y] = camera.to_ground(u.map(|v| v * camera.spot_sigma_m));
        let h = camera.altitude_m;
        h / (h * h + x * x + y * y).sqrt()
    };
    places.iter().map(|u| (*u, ENERGY * share(u))).collect()
}

#[test]
fn divide_finds_two_users_in_a_spot_of_twice_the_light() {
    let sources = users(&[[-0.15, 0.0], [0.15, 0.0]]);
    let (is_accepted, found) = with_known_power(&showing(&sources), &[[0.0, 0.0]], divide);
    assert!(is_accepted && found.sources.len() == 2, "{:?}", found.sources);
    assert!(found.sources.iter().all(|s| s.power.is_some()), "both are users");
    assert!(!with_known_power(&showing(&users(&[[0.0, 0.0]])), &[[0.0, 0.0]], divide).0);
}

#[test]
fn balance_pair_makes_three_users_of_a_pair_with_the_light_of_three() {
    let sources = users(&[[-0.6, 0.0], [0.0, 0.0], [0.6, 0.0]]);
    let (is_accepted, found) = with_known_power(&showing(&sources), &[[-0.4, 0.0], [0.4, 0.0]], balance_pair);
    assert!(is_accepted && found.sources.len() == 3, "{:?}", found.sources);
    assert!(found.sources.iter().all(|s| s.power.is_some()), "all are users");
    let pair = users(&[[-0.6, 0.0], [0.6, 0.0]]);
    let (is_accepted, _) = with_known_power(&showing(&pair), &[[-0.6, 0.0], [0.6, 0.0]], balance_pair);
    assert!(!is_accepted, "both of the pair are users");
}

#[test]
fn explore_ill_determined_leaves_a_saddle_that_the_symmetry_of_a_frame_holds_a_fit_on() {
    // Without noise a pair along x and a hypothesis along y are symmetric in both axes: no step has a component along x.
    let sources = users(&[[-0.4, 0.0], [0.4, 0.0]]);
    let shown = Shown {
        noise: None,
        ..showing(&sources)
    };
    let start = [[0.0, -0.4], [0.0, 0.4]];
    let (_, held) = with_known_power(&shown, &start, |_, _, _| false);
    assert!(held.sources.iter().all(|s| s.u[0].abs() < 1e-3), "{:?}", held.sources);
    let explore = |search: &mut Search, prior: &PowerPrior, candidate: &mut Candidate| {
        let before = search.score(candidate);
        explore_ill_determined(search, prior, candidate);
        search.score(candidate) < before
    };
    let (is_accepted, found) = with_known_power(&shown, &start, explore);
    assert!(is_accepted);
    assert_near(&found, &sources.iter().map(|s| s.0).collect::<Vec<_>>(), 0.05);
}

#[test]
fn the_score_test_predicts_what_a_second_fit_gains() {
    // Without noise: the gain is the pair's alone.
    for (sources, along) in [
        ([([-0.25, 0.0], 400.0), ([0.25, 0.0], 400.0)], [1.0, 0.0]),
        ([([0.1, -0.2], 400.0), ([0.1, 0.3], 400.0)], [0.0, 1.0]),
    ] {
        let mut frame = Shown {
            noise: None,
            ..showing(&sources)
        }
        .frame();
        let mut budget = WorkBudget::new(&|| false);
        let mut search = frame.space.search(&frame.compressed, &frame.frame, &mut budget);
        let mut one = Candidate::from(hypothesis(Nuisances::default(), &[[0.0, 0.0]]));
        fit(&mut search.context, &mut one, STEPS);
        let predicted = one.split_proposals(&mut search.context)[0];
        let mut two = hypothesis(Nuisances::default(), &[[-0.3, -0.3], [0.3, 0.3]]);
        for (source, (u, _)) in two.sources.iter_mut().zip(sources) {
            source.u = u;
        }
        fit(&mut search.context, &mut two, STEPS);
        let gained = one.deviance - two.deviance;
        let ratio = predicted.gain / gained;
        assert!(
            (0.8..1.25).contains(&ratio),
            "{} predicted, {gained} gained",
            predicted.gain
        );
        let cosine = predicted.direction[0] * along[0] + predicted.direction[1] * along[1];
        assert!(cosine.abs() > 0.99, "{:?}", predicted.direction);
        // Halves of a pair 0.5 σ apart stand 0.25 σ from its middle.
        assert!((predicted.distance - 0.25).abs() < 0.05, "{}", predicted.distance);
    }
}

#[test]
fn the_predicted_rise_of_a_merge_is_what_a_merged_fit_loses() {
    let sources = [([-0.3, 0.0], 400.0), ([0.3, 0.1], 400.0)];
    let mut frame = showing(&sources).frame();
    let mut budget = WorkBudget::new(&|| false);
    let mut search = frame.space.search(&frame.compressed, &frame.frame, &mut budget);
    let mut two = Candidate::from(hypothesis(Nuisances::default(), &[[-0.3, 0.0], [0.3, 0.1]]));
    fit(&mut search.context, &mut two, STEPS);
    let predicted = two.merge_deviance_rise(&mut search.context, 1, 0);
    let mut one = merge_pairs(&two, &[(1, 0)]);
    fit(&mut search.context, &mut one, STEPS);
    let risen = one.deviance - two.deviance;
    // To second order in a distance of 0.6 σ.
    assert!(
        (predicted / risen - 1.0).abs() < 0.5,
        "{predicted} predicted, {risen} risen"
    );
}

#[test]
fn what_is_derived_is_dropped_with_every_change() {
    let mut frame = showing(&[([0.0, 0.0], ENERGY)]).frame();
    let mut budget = WorkBudget::new(&|| false);
    let mut search = frame.space.search(&frame.compressed, &frame.frame, &mut budget);
    let mut candidate = Candidate::from(hypothesis(Nuisances::default(), &[[0.0, 0.0]]));
    fit(&mut search.context, &mut candidate, STEPS);
    let before = candidate.wald_statistics(&mut search.context)[0];
    // (energy · ‖spot‖)²: the square of a Gaussian of σ = 2 pixels sums to 1/(16 π).
    let expected = ENERGY * ENERGY / (16.0 * std::f64::consts::PI);
    assert!((before / expected - 1.0).abs() < 0.1, "{before}, {expected}");
    candidate.sources[0].u[0] = 40.0;
    assert!(
        candidate.wald_statistics(&mut search.context)[0] < 1.0,
        "no light beyond the edge"
    );
}
