//! Scene files: what is read and what is refused.

use std::path::{Path, PathBuf};

use oapwatch::scene::{Effect, Fate, Plan, Role, Scene, Status};

fn files() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenes");
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<_> = entries.filter(|p| p.extension().is_some_and(|e| e == "toml")).collect();
    files.sort();
    files
}

fn named(name: &str) -> Plan {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("config/scenes/{name}.toml"));
    Plan::compile(&Scene::load(&file).unwrap_or_else(|e| panic!("{e}")), 3).unwrap()
}

#[test]
fn every_scene_in_the_box_makes_usable_frames_with_truth() {
    assert!(files().len() >= 15);
    for file in files() {
        let scene = Scene::load(&file).unwrap_or_else(|e| panic!("{e}"));
        assert!(!scene.about.is_empty(), "{}", file.display());
        let plan = Plan::compile(&scene, 1).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let frames = plan.frames(0, 12);
        assert!(
            frames.iter().any(|f| !f.truth.emitters.is_empty()),
            "{}",
            file.display()
        );
        for frame in frames {
            let usable = frame.frame.pixels.iter().all(|p| p.is_finite());
            assert_eq!(usable, frame.fate != Fate::Dropped, "{}", file.display());
        }
    }
}

#[test]
fn the_builtin_scene_has_users_that_claim_and_an_eavesdropper_that_comes_and_goes() {
    let plan = Plan::compile(&Scene::builtin(), 0).unwrap();
    let there = |k| plan.frame(k).truth.emitters.iter().any(|e| e.role == Role::Intruder);
    assert!(!there(0) && there(60) && !there(200) && there(360));
    assert_eq!(plan.frame(0).claims.len(), 6);
}

#[test]
fn the_papers_scene_has_five_to_nine_emitters_over_the_area() {
    for name in ["paper", "paper-energy"] {
        let plan = named(name);
        let truths: Vec<_> = plan.frames(0, 400).into_iter().map(|f| f.truth.emitters).collect();
        for count in 5..=9 {
            // 400 draws of five numbers: 80 ± 8 each; six standard deviations.
            let seen = truths.iter().filter(|t| t.len() == count).count();
            assert!((32..=128).contains(&seen), "{count}: {seen}");
        }
        assert!(
            truths
                .iter()
                .flatten()
                .all(|e| e.x_m.abs() <= 125.0 && e.y_m.abs() <= 125.0 && e.in_view)
        );
    }
}

#[test]
fn an_eavesdropper_stays_beside_a_user() {
    let emitters = named("eavesdropper").frame(200).truth.emitters;
    let by = |role| emitters.iter().filter(move |e| e.role == role);
    let gap = |a: &oapwatch::scene::EmitterTruth| {
        by(Role::User)
            .map(|u| (u.x_m - a.x_m).hypot(u.y_m - a.y_m))
            .fold(f64::INFINITY, f64::min)
    };
    assert!(by(Role::Intruder).count() > 0 && by(Role::Intruder).all(|i| gap(i) < 25.0));
}

#[test]
fn a_drifting_user_leaves_the_claim_behind() {
    let plan = named("slow-drift");
    let off = |k: u64| {
        let claim = (0..=k)
            .rev()
            .flat_map(|k| plan.frame(k).claims)
            .find(|c| c.user == "u-2")
            .unwrap();
        let truth = plan
            .frame(k)
            .truth
            .emitters
            .into_iter()
            .find(|e| e.user.as_deref() == Some("u-2"))
            .unwrap();
        (truth.x_m - claim.x_m).hypot(truth.y_m - claim.y_m)
    };
    // The claim itself errs by 0.3 m an axis.
    assert!(off(0) < 1.5);
    assert!(off(1200) > 10.0);
}

#[test]
fn an_impostor_shines_where_an_absent_user_claims_to_be() {
    let plan = named("impersonation");
    let frame = plan.frame(100);
    assert!(frame.truth.emitters.iter().all(|e| e.user.as_deref() != Some("u-9")));
    let impostor = frame.truth.emitters.iter().find(|e| e.role == Role::Intruder).unwrap();
    let claim = (0..=100)
        .rev()
        .flat_map(|k| plan.frame(k).claims)
        .find(|c| c.user == "u-9")
        .unwrap();
    assert!((impostor.x_m - claim.x_m).hypot(impostor.y_m - claim.y_m) < 3.0);
}

#[test]
fn the_blinding_scene_blinds() {
    let plan = named("blinding");
    let level = plan.camera().saturation_j.unwrap();
    let full = |k| {
        let pixels = plan.frame(k).frame.pixels;
        pixels.iter().filter(|p| **p >= level).count() as f64 / pixels.len() as f64
    };
    assert!(full(10) < 0.02, "{}", full(10));
    assert!(full(150) > 0.3, "{}", full(150));
}

#[test]
fn the_nastiest_scene_calls_for_every_effect_but_the_lens_s() {
    let plan = named("nastiest");
    let missing: Vec<Effect> = plan
        .decisions()
        .iter()
        .filter(|d| d.status == Status::Off && d.effect != Effect::Population)
        // Eighty sub-frames of some hundred rays a spot would take a quarter of a second a frame; a lens's own spots are the lens scenes'.
        .filter(|d| !matches!(d.effect, Effect::Aberrations | Effect::Spot))
        // Of scene flight.
        .filter(|d| !matches!(d.effect, Effect::Platform | Effect::Telemetry))
        .map(|d| d.effect)
        .collect();
    assert_eq!(missing, []);
}

#[test]
fn what_a_scene_tolerates_is_left_out() {
    let status = |plan: &Plan, effect| plan.decisions().iter().find(|d| d.effect == effect).unwrap().status;
    let text = |tolerance: f64| {
        format!("tolerance = {tolerance}\n[effects]\nthermal_noise = {{}}\nshot_noise = {{ wavelength_m = 1.55e-6 }}\n")
    };
    // The strongest pixel holds 3·10⁻⁴ J: a shot noise of 6·10⁻¹² J, 6·10⁻⁶ σ_n.
    assert_eq!(status(&super::plan(&text(0.0)), Effect::ShotNoise), Status::On);
    assert_eq!(status(&super::plan(&text(1e-6)), Effect::ShotNoise), Status::On);
    assert_eq!(
        status(&super::plan(&text(1e-3)), Effect::ShotNoise),
        Status::BelowTolerance
    );
}

#[test]
fn a_bad_scene_is_refused_with_its_field_named() {
    let cases = [
        (
            "[effects]\nfading = { alpha = 4.0 }",
            "effects.fading: expected alpha and beta, or cn2 and wavelength_m, found alpha",
        ),
        (
            "[effects]\nfading = { alpha = 4.0, beta = -2.0 }",
            "effects.fading.beta: expected a positive finite number, found -2.0",
        ),
        (
            "[link]\nintegration_time_s = 1.0\n[optics]\naltitude_m = nan",
            "optics.altitude_m: expected a positive finite number, found NaN",
        ),
        (
            "rate_hz = 10.0",
            "link.integration_time_s: expected at most 1/rate_hz, the time from frame to frame, found 1.0",
        ),
        (
            "[[user]]\nname = \"a\"\nmotion.still = [0, 0]\n[[intruder]]\nname = \"a\"\nmotion.still = [0, 0]",
            "intruder[0].name: expected a name that no other emitter has, found \"a\"",
        ),
        (
            "[[intruder]]\nname = \"a\"\nmotion.beside = { user = \"b\" }",
            "intruder[0].motion.user: expected the name of a [[user]], found \"b\"",
        ),
        (
            "[effects]\nvibration = [{ amplitude_rad = [1e-4, 0], frequency_hz = 400 }]",
            "effects.vibration[0].frequency_hz: expected motion slow enough for 1024 sub-frames an exposure (T_int at most 128 of its times), found 400.0",
        ),
        (
            "[effects]\nquantisation = { bits = 12 }",
            "effects.quantisation.joules_per_count: expected a value here or in optics.joules_per_count, found \"neither\"",
        ),
        (
            "[platform]\nyaw_rate_deg_s = 1.0\nlog = { file = \"flight.ulg\" }",
            "platform.log: expected no law of motion beside a flight log, found \"yaw_rate_deg_s\"",
        ),
        (
            "[platform.telemetry]\nrate_hz = 0.1",
            "platform.telemetry.rate_hz: expected 1 to 1000 (poses per second: from one a second to faster than any autopilot), found 0.1",
        ),
        (
            "[random_emitters]\ncount = [9, 5]\narea_m = [250, 250]",
            "random_emitters.count: expected [smallest, largest], found [9, 5]",
        ),
    ];
    for (text, message) in cases {
        let error = Plan::compile(&super::scene(text), 0).unwrap_err();
        assert_eq!(error.to_string(), message);
    }
}

#[test]
fn an_unknown_key_is_refused_with_the_nearest_known_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.toml");
    std::fs::write(&file, "[effects]\npointing = { jiter_m = 0.1 }\n").unwrap();
    let message = Scene::load(&file).unwrap_err().to_string();
    assert!(
        message.contains("line 2") && message.contains("did you mean `jitter_m`?"),
        "{message}"
    );
}
