//! Scenes from outside: files in, frames with truth out.

use std::path::Path;

use oapwatch::scene::{Effect, Ledger, Plan, Role, Scene};

fn scenes() -> Vec<std::path::PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenes");
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<_> = entries.filter(|p| p.extension().is_some_and(|e| e == "toml")).collect();
    files.sort();
    files
}

#[test]
fn every_scene_in_the_box_makes_finite_frames_with_truth() {
    assert!(!scenes().is_empty());
    for file in scenes() {
        let scene = Scene::load(&file).unwrap_or_else(|e| panic!("{e}"));
        let plan = Plan::compile(&scene, 1).unwrap();
        let seen: usize = (0..40).map(|k| plan.frame(k).truth.emitters.len()).sum();
        assert!(seen > 0, "{}", file.display());
    }
}

#[test]
fn the_builtin_scene_has_users_that_claim_and_an_eavesdropper_that_comes_and_goes() {
    let plan = Plan::compile(&Scene::builtin(), 0).unwrap();
    let there = |k| {
        let frame = plan.frame(k);
        frame.truth.emitters.iter().any(|e| e.role == Role::Intruder)
    };
    assert!(!there(0) && there(60) && !there(200) && there(360));
    let claims = plan.frame(0).claims;
    assert_eq!(claims.len(), 6);
}

#[test]
fn a_frame_needs_no_other_and_the_seed_decides() {
    let plan = Plan::compile(&Scene::builtin(), 7).unwrap();
    let again = Plan::compile(&Scene::builtin(), 7).unwrap();
    for k in 0..5 {
        again.frame(k);
    }
    assert_eq!(plan.frame(5).frame.pixels, again.frame(5).frame.pixels);
    let other = Plan::compile(&Scene::builtin(), 8).unwrap();
    assert_ne!(plan.frame(5).frame.pixels, other.frame(5).frame.pixels);
}

#[test]
fn an_effect_that_is_not_called_for_draws_nothing() {
    let mut scene = Scene::builtin();
    scene.effects.thermal_noise = None;
    let plan = Plan::compile(&scene, 7).unwrap();
    let ledger = Ledger::default();
    plan.frame_counting(5, &ledger);
    assert_eq!(ledger.words(Effect::ThermalNoise), 0);
    assert!(ledger.words(Effect::Fading) > 0);
}
