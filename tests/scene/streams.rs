//! Random streams: seeds, threads and independence of effects.

use oapwatch::scene::{Effect, Plan, Scene};

fn nastiest() -> Scene {
    let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenes/nastiest.toml");
    Scene::load(&file).unwrap()
}

#[test]
fn a_frame_needs_no_other_and_the_seed_decides() {
    let plan = Plan::compile(&nastiest(), 7).unwrap();
    let again = Plan::compile(&nastiest(), 7).unwrap();
    let mut maker = again.maker();
    let in_turn = (0..6).map(|k| maker.frame(k)).last().unwrap();
    let alone = plan.frame(5);
    assert_eq!(alone.frame.digest(), in_turn.frame.digest());
    assert_eq!(alone.truth, in_turn.truth);
    assert_eq!(alone.claims, in_turn.claims);
    let other = Plan::compile(&nastiest(), 8).unwrap();
    assert_ne!(plan.frame(5).frame.digest(), other.frame(5).frame.digest());
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let plan = Plan::compile(&nastiest(), 7).unwrap();
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let frames = pool.install(|| plan.frames(0, 24));
        frames.iter().map(|f| f.frame.digest()).collect::<Vec<u64>>()
    };
    let alone = on(1);
    assert_eq!(alone, on(3));
    assert_eq!(alone, on(7));
}

#[test]
fn an_effect_that_is_not_called_for_draws_nothing_and_leaves_the_others_draws_alone() {
    let whole = Plan::compile(&nastiest(), 7).unwrap();
    let mut maker = whole.maker();
    maker.frame(5);
    for &effect in Effect::TABLES {
        let mut scene = nastiest();
        scene.effects.remove(effect);
        let plan = Plan::compile(&scene, 7).unwrap();
        let mut without = plan.maker();
        without.frame(5);
        assert_eq!(without.ledger().words(effect), 0, "{effect:?}");
        for &other in Effect::TABLES.iter().filter(|o| **o != effect) {
            let (before, after) = (maker.ledger().words(other), without.ledger().words(other));
            match (effect, other) {
                // Poisson draws take a number of words that depends on the light, and fewer sub-frames draw less wander.
                (_, Effect::ShotNoise) | (Effect::Vibration, Effect::Wander) => {}
                // With frame loss off another frame's pixels are not looked up.
                (Effect::FrameLoss, _) => {}
                _ => assert_eq!(before, after, "{other:?} without {effect:?}"),
            }
        }
    }
}

#[test]
fn a_scene_without_effects_draws_nothing_at_all() {
    let plan = super::plan("[[user]]\nname = \"u\"\nmotion.still = [10, 20]\n");
    let mut maker = plan.maker();
    maker.frame(3);
    for &effect in Effect::TABLES
        .iter()
        .chain(&[Effect::Population, Effect::Motion, Effect::ClaimLoss])
    {
        assert_eq!(maker.ledger().words(effect), 0, "{effect:?}");
    }
}

#[test]
fn noise_is_the_same_with_and_without_fading() {
    let text = |fading: &str| {
        format!(
            "[[user]]\nname = \"u\"\nmotion.still = [0, 0]\nbeam = false\n[effects]\nthermal_noise = {{}}\n{fading}"
        )
    };
    let (with, without) = (
        super::plan(&text("fading = { alpha = 4, beta = 2 }")),
        super::plan(&text("")),
    );
    assert_eq!(with.frame(2).frame.pixels, without.frame(2).frame.pixels);
}
