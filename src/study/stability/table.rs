//! The study as Markdown tables.

use super::{Options, Row};
use crate::estimate;

/// The study as Markdown tables, one a group; condition numbers and steps are the largest of any frame.
pub fn markdown(rows: &[Row], options: &Options) -> String {
    let estimator = options.estimator.name.as_deref().unwrap_or(estimate::DEFAULT);
    let how = format!(
        "Estimator `{estimator}`, {} frames, seed {}.",
        options.frames, options.seed
    );
    let mut text = String::new();
    let mut group = "";
    for row in rows {
        if row.group != group {
            group = row.group;
            text += &format!(
                "\n### {group}\n\n{how}\n\n| case | what makes it hard | requirement | outcome | condition | steps | holds |\n|---|---|---|---|---|---|---|\n"
            );
        }
        let (condition, steps) = match row.seen.fit {
            Some(fit) => (format!("{:.0e}", fit.condition), fit.steps.to_string()),
            None => Default::default(),
        };
        let holds = if row.seen.holds { "yes" } else { "**no**" };
        let cells = [
            row.name.as_str(),
            row.hard,
            row.expected,
            row.seen.happened.as_str(),
            &condition,
            &steps,
            holds,
        ];
        text += &format!("| {} |\n", cells.map(|c| c.replace('|', "\\|")).join(" | "));
    }
    text
}
