//! The study as Markdown.

use std::fmt::Write;

use super::{Noise, Row, Study, of_single_frames};
use crate::estimate::{DEFAULT, Learned};

/// Array sizes, and the mean squared errors that the paper reports there for its hybrid and its U-Net, m².
pub(super) const PAPER: [(usize, f64, f64); 6] = [
    (10, 15.3, 19.7),
    (20, 8.2, 12.5),
    (40, 2.6, 5.4),
    (60, 0.9, 2.3),
    (80, 0.84, 1.7),
    (100, 0.81, 1.3),
];

/// The Pareto front of one cell: estimators that no other beats in both time and OSPA.
pub(super) fn front<'a>(rows: &[&'a Row]) -> Vec<&'a Row> {
    let mut sorted = rows.to_vec();
    sorted.sort_by(|a, b| a.latency_median_us.total_cmp(&b.latency_median_us));
    let mut best = f64::INFINITY;
    sorted
        .into_iter()
        .filter(|r| {
            let is_better = r.ospa_m < best;
            best = best.min(r.ospa_m);
            is_better
        })
        .collect()
}

/// Whether a row's label belongs to the estimator `name`; the name of a network may follow.
fn is_of(label: &str, name: &str) -> bool {
    label.split_whitespace().next() == Some(name)
}

/// Rows by cell, in the study's order.
pub(super) fn cells(study: &Study) -> Vec<Vec<&Row>> {
    let mut cells: Vec<Vec<&Row>> = Vec::new();
    for row in &study.rows {
        match cells.last_mut() {
            Some(rows) if rows[0].cell == row.cell => rows.push(row),
            _ => cells.push(vec![row]),
        }
    }
    cells
}

/// The study as Markdown.
pub(super) fn markdown(study: &Study) -> String {
    let mut text = String::from("# What accuracy costs in time\n\n");
    let number = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.2e}"));
    let share = |v: f64| format!("{:.1} %", 100.0 * v);
    let frames = study.rows.first().map_or(0, |r| r.frames);
    let seed = study.rows.first().map_or(0, |r| r.seed);
    let _ = writeln!(
        text,
        "{frames} frames a cell, seed {seed}; one thread. A cell is the reading of the noise (E energy, P paper), σ_eff in mm, and pixels \
         a side; 5 to 9 emitters unless it says otherwise. Squared errors are over matched pairs, both axes summed; r is the trimmed \
         ratio to the Cramér–Rao bound among resolvable emitters, 1 being at the bound. The bound with powers known is for `map`, over all \
         emitters, and no strict one where positions are hardly known; N right is the share of frames with the \
         number of emitters right, of all and of those where every emitter can be resolved. Bold names are on the Pareto front of time \
         and OSPA (order 2, 25 m). Times depend on the machine and on what else it does; everything else only on the seed.\n"
    );
    let fronts: Vec<Row> = cells(study).iter().flat_map(|rows| front(rows)).cloned().collect();
    let on_front = |name: &str| {
        let of = |rows: &[Row]| rows.iter().filter(|r| is_of(&r.estimator, name)).count();
        format!("on the front in {} of {} cells", of(&fronts), of(&study.rows))
    };
    for spec in of_single_frames() {
        let default = if spec.name == DEFAULT { " (default)" } else { "" };
        let _ = writeln!(
            text,
            "- `{}`{default}: {}; {}",
            spec.name,
            spec.summary,
            on_front(spec.name)
        );
    }
    for learned in Learned::ALL {
        let _ = writeln!(
            text,
            "- `{}`: {}; {}",
            learned.name(),
            learned.summary(),
            on_front(learned.name())
        );
    }
    for rows in cells(study) {
        let front = front(&rows);
        let first = rows[0];
        let _ = writeln!(
            text,
            "\n## {}\n\nBound: median {} m²; with powers known, mean {} m². {} of emitters can be resolved.\n\n\
             | estimator | mean m² | median m² | trimmed m² | r | OSPA m | N right | where resolvable | missed | invented | µs median | µs 99th |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|",
            first.cell.name(),
            number(first.bound_median_m2),
            number(first.known_bound_mean_m2),
            share(first.resolvable)
        );
        for row in &rows {
            let mark = if front.contains(row) { "**" } else { "" };
            let _ = writeln!(
                text,
                "| {mark}{}{mark} | {} | {} | {} | {} | {:.3} | {} | {} | {} | {} | {:.0} | {:.0} |",
                row.estimator,
                number(row.mean_m2),
                number(row.median_m2),
                number(row.trimmed_m2),
                row.bound_ratio.map_or("–".to_owned(), |r| format!("{r:.3}")),
                row.ospa_m,
                share(row.count_right),
                row.count_right_resolvable.map_or("–".to_owned(), share),
                row.missed,
                row.invented,
                row.latency_median_us,
                row.latency_p99_us
            );
        }
    }
    text.push_str("\n## Beside the paper (σ_eff 8 mm, paper reading), mean squared error, m²\n\n");
    beside(&mut text, study, is_paper_cell);
    text.push_str(
        "\nThe paper's errors fall with the array's size because its estimators answer in pixels: its U-Net row is close to pitch²/6 on the \
         ground, the error of naming the right pixel. With a fixed noise per pixel the physical bound rises with the number of pixels.\n",
    );
    let is_energy_cell = |row: &Row| row.cell.noise == Noise::Energy && row.cell.sigma_mm == 1.0 && row.cell.is_plain();
    if study.rows.iter().any(|r| is_energy_cell(r) && r.training.is_some()) {
        text.push_str("\n## The same under the energy reading (σ_eff 1 mm)\n\n");
        beside(&mut text, study, is_energy_cell);
    }
    networks(&mut text, study);
    text
}

/// The paper's errors by array size, and those of every estimator that has a row among the cells that `is_wanted` names.
fn beside(text: &mut String, study: &Study, is_wanted: impl Fn(&Row) -> bool) {
    let rows: Vec<&Row> = study.rows.iter().filter(|r| is_wanted(r)).collect();
    let mut names: Vec<&str> = of_single_frames().map(|r| r.name).collect();
    for row in &rows {
        if !names.contains(&row.estimator.as_str()) {
            names.push(&row.estimator);
        }
    }
    let _ = writeln!(
        text,
        "| array | paper's hybrid | paper's U-Net | {} |\n|---|---|---|{}",
        names.join(" | "),
        "---|".repeat(names.len())
    );
    for (pixels, hybrid, unet) in PAPER {
        let _ = write!(text, "| {pixels}×{pixels} | {hybrid} | {unet} |");
        for name in &names {
            let row = rows.iter().find(|r| r.cell.pixels == pixels && r.estimator == *name);
            let mean = row
                .and_then(|r| r.mean_m2)
                .map_or("–".to_owned(), |m| format!("{m:.3}"));
            let _ = write!(text, " {mean} |");
        }
        text.push('\n');
    }
}

/// What the networks cost to train and what a mean over matched pairs alone hides, with what else was measured in their cells.
fn networks(text: &mut String, study: &Study) {
    let is_learned = |cell| study.rows.iter().any(|r| r.cell == cell && r.training.is_some());
    let rows: Vec<&Row> = study.rows.iter().filter(|r| is_learned(r.cell)).collect();
    if rows.is_empty() {
        return;
    }
    text.push_str(
        "\n## Networks\n\nThe mean's 95 % interval is a bootstrap over frames. Missed and invented are shares of the emitters.\n\n\
         | cell | estimator | samples | trained | frames | mean m² | median m² | missed | invented | OSPA m |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    let number = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.3}"));
    for row in rows {
        let [samples, trained] = match &row.training {
            Some(t) => [t.samples.to_string(), format!("{:.0} s on {}", t.seconds, t.machine)],
            None => ["–".to_owned(), "–".to_owned()],
        };
        let interval = row
            .mean_interval_m2
            .map_or(String::new(), |[low, high]| format!(" ({low:.3} to {high:.3})"));
        let share = |count: usize| 100.0 * count as f64 / row.emitters.max(1) as f64;
        let _ = writeln!(
            text,
            "| {} | {} | {samples} | {trained} | {} | {}{interval} | {} | {:.1} % | {:.1} % | {:.2} |",
            row.cell.name(),
            row.estimator,
            row.frames,
            number(row.mean_m2),
            number(row.median_m2),
            share(row.missed),
            share(row.invented),
            row.ospa_m
        );
    }
}

pub(super) fn is_paper_cell(row: &Row) -> bool {
    row.cell.noise == Noise::Paper && row.cell.sigma_mm == 8.0 && row.cell.is_plain()
}
