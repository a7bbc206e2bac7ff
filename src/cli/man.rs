//! `oapwatch man`: writes the manual pages.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Command, CommandFactory};
use clap_mangen::Man;

use super::{Failure, Outcome};

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  oapwatch man /usr/local/share/man/man1")]
pub struct Args {
    /// Folder for oapwatch.1 and one page a command
    out: PathBuf,
}

/// Exit codes of every command.
const EXIT_STATUS: [(&str, &str); 4] = [
    ("0", "Done. A reader that closes stdout early is no failure."),
    (
        "1",
        "Failed, such as on a full disk, or a result that must not be used.",
    ),
    (
        "2",
        "The input or the command line cannot be used; the message names the file, line or field.",
    ),
    ("64", "The config or scene cannot be used; the message names the key."),
];

/// Files and variables that the daemon uses.
const FILES: [(&str, &str); 4] = [
    (
        "/etc/oapwatch/oapwatch.toml",
        "Config of the service; every key is commented in it.",
    ),
    (
        "/etc/oapwatch/credentials/",
        "Tokens and secrets, handed to the service by systemd.",
    ),
    ("/var/lib/oapwatch/", "Journal and recordings of the service."),
    ("/usr/share/oapwatch/", "Scenes and trained networks."),
];

const ENVIRONMENT: [(&str, &str); 1] = [("OAPWATCH_LOG", "Log level or filter; wins over [log] level.")];

const SIGNALS: [(&str, &str); 2] = [
    (
        "SIGHUP",
        "Loads [monitor], [claims], [[webhook]] and [log] again, all or, where the file is bad, nothing.",
    ),
    ("SIGTERM, SIGINT", "Stop within two seconds."),
];

/// Writes one page for the program and one for each command.
pub fn run(args: Args) -> Outcome {
    write_pages(&args.out).map_err(Failure::Other)
}

fn write_pages(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let mut program = super::Cli::command().disable_help_subcommand(true);
    program.build();
    let commands: Vec<Command> = program
        .get_subcommands()
        .filter(|c| !c.is_hide_set())
        .cloned()
        .collect();
    for command in std::iter::once(program).chain(commands) {
        let name = command.get_display_name().unwrap_or(command.get_name()).to_owned();
        let path = folder.join(format!("{name}.1"));
        let write = || -> io::Result<()> {
            let mut out = BufWriter::new(File::create(&path)?);
            page(&mut out, command.clone(), name == "oapwatch")?;
            out.flush()
        };
        write().with_context(|| path.display().to_string())?;
    }
    Ok(())
}

/// One page: what clap knows of the command, then examples, exit status and files.
fn page(out: &mut dyn Write, command: Command, is_program: bool) -> io::Result<()> {
    let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let examples = help.strip_prefix("Examples:").unwrap_or_default().to_owned();
    let is_daemon = command.get_name() == "run";
    let has_version = command.get_version().is_some();
    let man = Man::new(command);
    man.render_title(out)?;
    man.render_name_section(out)?;
    man.render_synopsis_section(out)?;
    man.render_description_section(out)?;
    man.render_options_section(out)?;
    if is_program {
        man.render_subcommands_section(out)?;
    }
    if !examples.is_empty() {
        writeln!(out, ".SH EXAMPLES\n.nf")?;
        for line in examples.lines().filter(|l| !l.is_empty()) {
            writeln!(out, "{}", escaped(line.trim_start()))?;
        }
        writeln!(out, ".fi")?;
    }
    section(out, "EXIT STATUS", &EXIT_STATUS)?;
    if is_daemon {
        section(out, "SIGNALS", &SIGNALS)?;
    }
    section(out, "ENVIRONMENT", &ENVIRONMENT)?;
    section(out, "FILES", &FILES)?;
    if !is_program {
        writeln!(out, ".SH \"SEE ALSO\"\n.BR oapwatch (1)")?;
    }
    match has_version {
        true => man.render_version_section(out),
        false => Ok(()),
    }
}

fn section(out: &mut dyn Write, title: &str, entries: &[(&str, &str)]) -> io::Result<()> {
    writeln!(out, ".SH \"{title}\"")?;
    entries
        .iter()
        .try_for_each(|(term, text)| writeln!(out, ".TP\n\\fB{}\\fR\n{}", escaped(term), escaped(text)))
}

/// Text as roff prints it: no escapes, no requests, and hyphens that can be copied.
fn escaped(text: &str) -> String {
    let text = text.replace('\\', "\\e").replace('-', "\\-");
    match text.starts_with(['.', '\'']) {
        true => format!("\\&{text}"),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn every_command_has_a_page_with_examples_and_exit_status() {
        let dir = tempfile::tempdir().unwrap();
        super::write_pages(dir.path()).unwrap();
        let page = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        for command in ["run", "locate", "review", "simulate", "check", "training-data"] {
            let page = page(&format!("oapwatch-{command}.1"));
            for expected in [".SH EXAMPLES\n.nf\noapwatch", "EXIT STATUS", "FILES", "oapwatch.toml"] {
                assert!(page.contains(expected), "{command}: {expected}: {page}");
            }
        }
        assert!(page("oapwatch.1").contains("SUBCOMMANDS"));
        assert!(page("oapwatch-run.1").contains("SIGHUP"));
        assert_eq!(super::escaped(".a\\b-c"), "\\&.a\\eb\\-c");
    }
}
