//! `oapwatch golden`: writes what this build answers, or compares it with what another build answered.

use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};

use super::{Failure, Outcome, progress};
use crate::study::golden::{Answer, Questions, ask, differences};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Write the answers to this file, one JSON object a line
    #[arg(long, required_unless_present = "against")]
    out: Option<PathBuf>,
    /// Compare with the answers in this file
    #[arg(long)]
    against: Option<PathBuf>,
    /// Share of each position's standard deviation that is taken for equal; 0 asks for the same bits
    #[arg(long, default_value_t = 0.0)]
    tolerance: f64,
    /// Frames of each trade-off cell
    #[arg(long, default_value_t = 20)]
    frames: usize,
    /// Only these estimators, as "ml,map"
    #[arg(long, value_delimiter = ',')]
    estimators: Vec<String>,
    /// Folder of scenes that the monitor is asked about
    #[arg(long, default_value = "config/scenes")]
    scenes: PathBuf,
    /// Frames of each scene; 0 leaves the scenes out
    #[arg(long, default_value_t = 300)]
    scene_frames: u64,
}

/// Differences that are printed.
const SHOWN: usize = 20;

pub fn run(args: Args) -> Outcome {
    let scenes = match args.scene_frames {
        0 => Vec::new(),
        _ => scenes_in(&args.scenes).map_err(Failure::Input)?,
    };
    let mut questions = Questions::all(scenes);
    questions.frames = args.frames;
    questions.scene_frames = args.scene_frames;
    if !args.estimators.is_empty() {
        questions
            .estimators
            .retain(|e| args.estimators.iter().any(|name| name == e));
    }
    let theirs = args.against.as_deref().map(read).transpose().map_err(Failure::Input)?;
    let bar = progress::bar(
        (questions.cells.len() + questions.scenes.len()) as u64,
        "cells and scenes",
    );
    let ours = ask(&questions, &|| bar.inc(1)).map_err(Failure::other)?;
    bar.finish_and_clear();
    if let Some(path) = &args.out {
        write(path, &ours).map_err(Failure::Other)?;
        eprintln!("{} answers in {}", ours.len(), path.display());
    }
    let Some(theirs) = theirs else { return Ok(()) };
    let found = differences(&ours, &theirs, args.tolerance);
    for line in found.iter().take(SHOWN) {
        println!("{line}");
    }
    match found.len() {
        0 => {
            println!("{} answers, all the same", ours.len());
            Ok(())
        }
        n => Err(Failure::other(anyhow!("{n} of {} answers differ", ours.len()))),
    }
}

fn scenes_in(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let in_folder = || folder.display().to_string();
    let mut scenes = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(in_folder)? {
        let path = entry.with_context(in_folder)?.path();
        if path.extension().is_some_and(|e| e == "toml") {
            scenes.push(path);
        }
    }
    scenes.sort();
    Ok(scenes)
}

fn read(path: &Path) -> anyhow::Result<Vec<Answer>> {
    let named = || path.display().to_string();
    let file = BufReader::new(std::fs::File::open(path).with_context(named)?);
    file.lines()
        .enumerate()
        .map(|(k, line)| {
            let line = line.with_context(named)?;
            serde_json::from_str(&line).with_context(|| format!("{}:{}: expected an answer", path.display(), k + 1))
        })
        .collect()
}

fn write(path: &Path, answers: &[Answer]) -> anyhow::Result<()> {
    let named = || path.display().to_string();
    let mut file = BufWriter::new(std::fs::File::create(path).with_context(named)?);
    for answer in answers {
        serde_json::to_writer(&mut file, answer).with_context(named)?;
        file.write_all(b"\n").with_context(named)?;
    }
    file.flush().with_context(named)
}
