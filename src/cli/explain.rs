//! `oapwatch explain`: the effects that a scene simulates, the reason, and the cost of each.

use std::fmt::Write;
use std::hint::black_box;
use std::io::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use serde_json::{Value, json};

use super::{Failure, Outcome, picture, progress};
use crate::scene::{Effect, Plan, Scene, Status};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch explain config/scenes/windy.toml\n  oapwatch explain --picture frame.svg --frame 20 config/scenes/windy.toml"
)]
pub struct Args {
    /// A scene file
    scene: PathBuf,
    /// Draw a frame with its truth into this SVG file
    #[arg(long, value_name = "FILE.svg")]
    picture: Option<PathBuf>,
    /// Which frame to draw
    #[arg(long, default_value_t = 0)]
    frame: u64,
    /// Of the frame that is drawn
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// Rounds of timing; the fastest counts.
const ROUNDS: usize = 15;
/// Time that one round gives the whole plan.
const ROUND: Duration = Duration::from_millis(4);

pub fn run(args: Args) -> Outcome {
    let scene = Scene::load(&args.scene).map_err(Failure::config)?;
    let plan = Plan::compile(&scene, args.seed).map_err(Failure::config)?;
    if let Some(path) = &args.picture {
        picture::draw(path, &plan, args.frame).map_err(Failure::Other)?;
    }
    let bar = progress::count("rounds of timing");
    let costs = costs(&scene, &plan, args.seed, &bar).map_err(Failure::config)?;
    bar.finish_and_clear();
    let mut text = match args.json {
        true => format!("{}\n", object(&scene, &plan, &costs)),
        false => table(&scene, &plan, &costs),
    };
    if let Some(path) = args.picture.as_ref().filter(|_| !args.json) {
        let _ = writeln!(text, "\nFrame {} is drawn in {}", args.frame, path.display());
    }
    std::io::stdout().write_all(text.as_bytes()).map_err(Failure::other)
}

/// The table as JSON; an effect without a cost of its own has none.
fn object(scene: &Scene, plan: &Plan, costs: &Costs) -> Value {
    let camera = plan.camera();
    let effects = plan.decisions().iter().map(|decision| {
        let cost = costs.each.iter().find(|c| c.0 == decision.effect).map(|c| c.1.max(0.0));
        json!({
            "effect": decision.effect.name(),
            "status": decision.status.name(),
            "cost_us": cost,
            "reason": decision.reason,
        })
    });
    json!({
        "about": scene.about,
        "pixels": [camera.x.n, camera.y.n],
        "rate_hz": plan.rate_hz(),
        "frame_us": costs.whole,
        "resolution_us": costs.resolution,
        "effects": effects.collect::<Value>(),
    })
}

fn table(scene: &Scene, plan: &Plan, costs: &Costs) -> String {
    let camera = plan.camera();
    let mut text = String::new();
    let about = if scene.about.is_empty() {
        "A scene"
    } else {
        &scene.about
    };
    let _ = writeln!(
        text,
        "{about}: {} × {} pixels, {} frames/s\n",
        camera.x.n,
        camera.y.n,
        plan.rate_hz()
    );
    let _ = writeln!(text, "{:<18} {:<16} {:>12}  why", "effect", "", "µs a frame");
    for decision in plan.decisions() {
        let cost = costs.each.iter().find(|c| c.0 == decision.effect).map(|c| c.1);
        let cost = match (decision.status, cost) {
            (Status::On | Status::Folded, Some(us)) if us < costs.resolution => {
                format!("< {:.1}", costs.resolution)
            }
            (Status::On | Status::Folded, Some(us)) => format!("{us:.1}"),
            (Status::On | Status::Folded, None) => "in the rest".to_owned(),
            (Status::Off | Status::BelowTolerance, _) => "0".to_owned(),
        };
        let (name, status) = (decision.effect.name(), decision.status.name());
        let _ = writeln!(text, "{name:<18} {status:<16} {cost:>12}  {}", decision.reason);
    }
    let _ = writeln!(
        text,
        "\nA whole frame takes {:.1} µs on one thread. An effect's cost is what the frame gets cheaper",
        costs.whole
    );
    let _ = writeln!(
        text,
        "without it (fastest of {ROUNDS} rounds); costs do not add up where effects share work."
    );
    text
}

/// Microseconds a frame.
struct Costs {
    whole: f64,
    each: Vec<(Effect, f64)>,
    /// From the fastest to the lower quartile of the whole frame's times over the rounds, at least 0.1.
    resolution: f64,
}

/// Times the plan against the plans of the scene without one effect each, in turns, so that a slow moment hits all alike.
fn costs(scene: &Scene, plan: &Plan, seed: u64, bar: &ProgressBar) -> Result<Costs, crate::scene::Error> {
    let simulated = plan
        .decisions()
        .iter()
        .filter(|d| matches!(d.status, Status::On | Status::Folded));
    let removable = simulated.map(|d| d.effect).filter(|e| Effect::TABLES.contains(e));
    let without: Vec<(Effect, Plan)> = removable
        .map(|effect| Ok((effect, Plan::compile(&scene.without(effect), seed)?)))
        .collect::<Result<_, crate::scene::Error>>()?;
    let time = |plan: &Plan, frames: u64| {
        let mut maker = plan.maker();
        let start = Instant::now();
        for k in 0..frames {
            black_box(maker.frame(k));
        }
        start.elapsed().as_secs_f64() * 1e6 / frames as f64
    };
    let first = time(plan, 20);
    let frames = (ROUND.as_secs_f64() * 1e6 / first).clamp(2.0, 500.0) as u64;
    // The fastest round is the one that the machine disturbed least.
    let mut whole = vec![time(plan, frames)];
    let mut fastest = vec![f64::INFINITY; without.len()];
    for _ in 0..ROUNDS {
        for (fastest, (_, other)) in fastest.iter_mut().zip(&without) {
            *fastest = fastest.min(time(other, frames));
        }
        whole.push(time(plan, frames));
        bar.inc(1);
    }
    whole.sort_by(f64::total_cmp);
    let best = whole[0];
    Ok(Costs {
        whole: best,
        each: without.iter().zip(fastest).map(|(w, f)| (w.0, best - f)).collect(),
        resolution: (whole[ROUNDS / 4] - best).max(0.1),
    })
}
