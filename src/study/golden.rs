//! Golden answers: what every estimator says of the same frames, and the monitor of the same scenes, so that two builds can be
//! compared to the bit or to a share of each position's standard deviation.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::tradeoff::{Candidate, Cell, Plan};
use crate::estimate::{self, Emitter, Flags};
use crate::scene::{self, Fate, Scene};
use crate::{config::Config, pipeline};

/// What to ask.
#[derive(Clone, Debug)]
pub struct Questions {
    pub cells: Vec<Cell>,
    pub estimators: Vec<&'static str>,
    /// Frames a cell.
    pub frames: usize,
    pub scenes: Vec<PathBuf>,
    /// Frames a scene.
    pub scene_frames: u64,
    pub seed: u64,
}

/// One answer and the question it belongs to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// `cell estimator frame`, or `scene event`.
    pub question: String,
    pub said: Said,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Said {
    Emitters(Vec<Located>),
    Error(String),
    Event(Value),
}

/// The part of an emitter that `locate` prints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Located {
    pub x_m: f64,
    pub y_m: f64,
    pub cov_m2: [[f64; 2]; 2],
    pub energy_j: f64,
    pub flags: Flags,
}

/// Why a question could not be asked.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Study(#[from] super::tradeoff::Error),
    #[error(transparent)]
    Estimator(#[from] estimate::ConfigError),
    #[error(transparent)]
    Scene(#[from] scene::Error),
    #[error(transparent)]
    Pipeline(#[from] pipeline::Error),
}

impl From<&Emitter> for Located {
    fn from(e: &Emitter) -> Self {
        Self {
            x_m: e.x_m,
            y_m: e.y_m,
            cov_m2: e.cov_m2,
            energy_j: e.energy_j,
            flags: e.flags,
        }
    }
}

impl Questions {
    /// Every cell of the trade-off with every estimator, and these scenes.
    pub fn all(scenes: Vec<PathBuf>) -> Self {
        let plan = Plan::full();
        Self {
            cells: plan.cells,
            estimators: plan.estimators,
            frames: 20,
            scenes,
            scene_frames: 300,
            seed: 1,
        }
    }
}

/// Asks everything, in the order of the questions. `progress` is told of each cell and scene.
pub fn ask(questions: &Questions, progress: &(dyn Fn() + Sync)) -> Result<Vec<Answer>, Error> {
    let cells = questions.cells.par_iter().map(|cell| {
        let answers = ask_cell(questions, cell);
        progress();
        answers
    });
    let scenes = questions.scenes.par_iter().map(|path| {
        let answers = ask_scene(questions, path);
        progress();
        answers
    });
    let answers: Result<Vec<Vec<Answer>>, Error> = cells.chain(scenes).collect();
    Ok(answers?.into_iter().flatten().collect())
}

fn ask_cell(questions: &Questions, cell: &Cell) -> Result<Vec<Answer>, Error> {
    let camera = cell.camera()?;
    let scenes = cell.scenes(questions.frames, questions.seed)?;
    let mut answers = Vec::new();
    for name in &questions.estimators {
        if Candidate::of(name, cell, &[]).is_empty() {
            continue;
        }
        let config = estimate::Config {
            name: Some((*name).to_owned()),
            known_power: Some(cell.known_power(&camera)),
            ..Default::default()
        };
        let mut estimator = estimate::build(&config, &camera)?;
        for scene in &scenes {
            let said = match estimator.estimate(&scene.frame) {
                Ok(found) => Said::Emitters(found.emitters.iter().map(Located::from).collect()),
                Err(e) => Said::Error(e.to_string()),
            };
            let question = format!("{} {name} {}", cell.name(), scene.frame.index);
            answers.push(Answer { question, said });
        }
    }
    Ok(answers)
}

fn ask_scene(questions: &Questions, path: &Path) -> Result<Vec<Answer>, Error> {
    let scene = Scene::load(path)?;
    let plan = scene::Plan::compile(&scene, questions.seed)?;
    let mut config = Config::default();
    config.source.scene = Some(path.to_owned());
    config.adopt_platform(&scene);
    // A network's arithmetic is the processor's: what begins with it differs from machine to machine.
    config.estimator.rules.network_start = false;
    let mut pipeline = pipeline::Pipeline::new(&config, plan.camera())?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut maker = plan.maker();
    let mut answers = Vec::new();
    for k in 0..questions.scene_frames {
        let made = maker.frame(k);
        pipeline.claim(made.claims, made.frame.time);
        pipeline.receive_poses(made.poses, made.frame.time);
        if made.fate == Fate::Dropped {
            continue;
        }
        for event in &pipeline.step(&made.frame).report.events {
            let mut event = serde_json::to_value(event).expect("an event is plain data");
            // Scenes have flat ground, and answers of builds that state no height stay comparable.
            event["alert"].as_object_mut().and_then(|alert| alert.remove("z_m"));
            answers.push(Answer {
                question: format!("{name} event {}", answers.len()),
                said: Said::Event(event),
            });
        }
    }
    Ok(answers)
}

/// How two lists of answers differ, one line a question. `tolerance`: share of a position's standard deviation (and of any other
/// number's own size) that is taken for equal; zero asks for the same bits. A question that only `theirs` answers is a difference
/// only where `ours` was asked it.
pub fn differences(ours: &[Answer], theirs: &[Answer], tolerance: f64) -> Vec<String> {
    let known: BTreeMap<&str, &Said> = theirs.iter().map(|a| (a.question.as_str(), &a.said)).collect();
    let mut found = Vec::new();
    for Answer { question, said } in ours {
        match known.get(question.as_str()) {
            None => found.push(format!("{question}: not answered by the other build")),
            Some(other) => {
                if let Some(difference) = difference(said, other, tolerance) {
                    found.push(format!("{question}: {difference}"));
                }
            }
        }
    }
    found
}

fn difference(ours: &Said, theirs: &Said, tolerance: f64) -> Option<String> {
    match (ours, theirs) {
        (Said::Emitters(ours), Said::Emitters(theirs)) if ours.len() != theirs.len() => {
            Some(format!("{} emitters, were {}", ours.len(), theirs.len()))
        }
        (Said::Emitters(ours), Said::Emitters(theirs)) => ours
            .iter()
            .zip(theirs)
            .find(|(a, b)| !a.is_close(b, tolerance))
            .map(|(a, b)| format!("{a:?}, was {b:?}")),
        (Said::Event(ours), Said::Event(theirs)) => {
            (!is_close_value(ours, theirs, tolerance)).then(|| format!("{ours}, was {theirs}"))
        }
        _ => (ours != theirs).then(|| format!("{ours:?}, was {theirs:?}")),
    }
}

impl Located {
    fn is_close(&self, other: &Self, tolerance: f64) -> bool {
        if tolerance == 0.0 {
            return self == other;
        }
        let variance = other.cov_m2[0][0] + other.cov_m2[1][1];
        let within = |a: f64, b: f64, scale: f64| (a - b).abs() <= tolerance * scale;
        let has_close_covariance = (self.cov_m2.iter().flatten())
            .zip(other.cov_m2.iter().flatten())
            .all(|(a, b)| within(*a, *b, variance));
        self.flags == other.flags
            && within(self.x_m, other.x_m, variance.sqrt())
            && within(self.y_m, other.y_m, variance.sqrt())
            && within(self.energy_j, other.energy_j, other.energy_j.abs())
            && has_close_covariance
    }
}

fn is_close_value(ours: &Value, theirs: &Value, tolerance: f64) -> bool {
    match (ours, theirs) {
        (Value::Number(a), Value::Number(b)) => match (a.as_f64(), b.as_f64()) {
            (Some(a), Some(b)) => a == b || (a - b).abs() <= tolerance * a.abs().max(b.abs()),
            _ => a == b,
        },
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_close_value(a, b, tolerance))
        }
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len()
                && a.iter()
                    .all(|(key, a)| b.get(key).is_some_and(|b| is_close_value(a, b, tolerance)))
        }
        _ => ours == theirs,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(x_m: f64) -> Vec<Answer> {
        let located = Located {
            x_m,
            y_m: 1.0,
            cov_m2: [[0.02, 0.0], [0.0, 0.02]],
            energy_j: 1e-3,
            flags: Flags::empty(),
        };
        vec![Answer {
            question: "E1/64 ml 0".into(),
            said: Said::Emitters(vec![located]),
        }]
    }

    #[test]
    fn a_bit_counts_unless_a_tolerance_is_given() {
        let moved = 3.0 + 1e-8;
        assert!(differences(&answer(3.0), &answer(3.0), 0.0).is_empty());
        assert_eq!(differences(&answer(moved), &answer(3.0), 0.0).len(), 1);
        assert!(
            differences(&answer(moved), &answer(3.0), 1e-7).is_empty(),
            "5e-8 of σ = 0.2 m"
        );
        assert_eq!(differences(&answer(moved), &answer(3.0), 1e-8).len(), 1);
    }

    #[test]
    fn an_emitter_more_and_a_question_unknown_are_differences() {
        let mut more = answer(3.0);
        let Said::Emitters(list) = &mut more[0].said else {
            unreachable!()
        };
        list.push(list[0].clone());
        assert_eq!(
            differences(&more, &answer(3.0), 1.0),
            ["E1/64 ml 0: 2 emitters, were 1"]
        );
        assert_eq!(differences(&answer(3.0), &[], 1.0).len(), 1);
        assert!(differences(&[], &answer(3.0), 0.0).is_empty());
    }

    #[test]
    fn an_event_is_compared_number_by_number() {
        let event = |x: f64| {
            vec![Answer {
                question: "builtin event 0".into(),
                said: Said::Event(serde_json::json!({"kind": "unclaimed_emitter", "x_m": x, "n": [1, 2]})),
            }]
        };
        assert!(differences(&event(5.0), &event(5.0 + 1e-9), 1e-9).is_empty());
        assert_eq!(differences(&event(5.0), &event(5.0 + 1e-9), 0.0).len(), 1);
    }
}
