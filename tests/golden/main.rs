//! Holds this build to stored answers, to a millionth of each position's standard deviation: bits depend on the processor's instructions.
//! `oapwatch golden --frames 1 --estimators ml,map,greedy-fit --scene-frames 150 --out tests/golden/answers.ndjson` writes them anew.

use std::path::Path;

use oapwatch::study::golden::{Answer, Questions, ask, differences};

const TOLERANCE: f64 = 1e-6;

#[test]
fn answers_are_those_stored() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let stored: Vec<Answer> = std::fs::read_to_string(root.join("tests/golden/answers.ndjson"))
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let entries = std::fs::read_dir(root.join("config/scenes")).unwrap();
    let mut scenes: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    scenes.sort();
    let questions = Questions {
        estimators: vec!["ml", "map", "greedy-fit"],
        frames: 1,
        scene_frames: 150,
        ..Questions::all(scenes)
    };
    let ours = ask(&questions, &|| {}).unwrap();
    assert_eq!(ours.len(), stored.len(), "as many answers as are stored");
    let found = differences(&ours, &stored, TOLERANCE);
    assert!(found.is_empty(), "{} differ:\n{}", found.len(), found.join("\n"));
}
