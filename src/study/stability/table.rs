use super::Row;

/// The study as Markdown tables, one a group.
pub fn markdown(rows: &[Row]) -> String {
    let mut text = String::new();
    let mut group = "";
    for row in rows {
        if row.group != group {
            group = row.group;
            text += &format!(
                "\n### {group}\n\n| case | what makes it hard | promised | happened | holds |\n|---|---|---|---|---|\n"
            );
        }
        let holds = if row.holds { "yes" } else { "**no**" };
        let cells =
            [row.name.as_str(), row.hard, row.expected, row.happened.as_str(), holds].map(|c| c.replace('|', "\\|"));
        text += &format!("| {} |\n", cells.join(" | "));
    }
    text
}
