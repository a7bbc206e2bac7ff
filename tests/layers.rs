//! Reads the imports of `src/` and holds the layers of ARCHITECTURE.md: imports go down only, and no two files import each other,
//! directly or around a circle.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Modules from the lowest up: each imports only from those before it.
const LAYERS: &[&str] = &[
    "small_file",
    "toml_file",
    "hash",
    "stats",
    "logging",
    "metric",
    "supervisor",
    "time",
    "word",
    "frame",
    "claim",
    "pose",
    "ulog",
    "optics",
    "geo",
    "assign",
    "scene",
    "estimate",
    "calibrate",
    "claims",
    "frames",
    "platform",
    "monitor",
    "journal",
    "notify",
    "api",
    "export",
    "fleet",
    "config",
    "hub",
    "pipeline",
    "study",
    "daemon",
    "cli",
];

/// What must not be imported although it lies below.
const APART: &[(&str, &str)] = &[
    ("estimate", "scene"),
    ("estimate", "claim"),
    ("estimate", "claims"),
    ("scene", "estimate"),
    ("calibrate", "scene"),
];

/// A name that is re-exported more often than this is taken for a mistake of this test.
const MOST_REEXPORTS: usize = 8;

/// A module by its path below the crate: `["estimate", "fit"]`.
type Module = Vec<String>;

struct Source {
    module: Module,
    text: String,
}

#[test]
fn imports_go_down_and_never_in_a_circle() {
    let sources = sources();
    let texts: BTreeMap<Module, &str> = sources.iter().map(|s| (s.module.clone(), s.text.as_str())).collect();
    let reexports: BTreeMap<Module, Vec<Module>> = sources.iter().map(|s| (s.module.clone(), used(s, true))).collect();
    let mut graph: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    for source in &sources {
        let imported = used(source, false).into_iter().chain(inline_paths(source));
        let files = imported.filter_map(|path| definer(&path, &texts, &reexports));
        let others = files.filter(|file| *file != source.module && !file.is_empty());
        graph.entry(source.module.clone()).or_default().extend(others);
    }
    let mut faults = Vec::new();
    for (file, imported) in &graph {
        for other in imported {
            faults.extend(layer_fault(file, other));
        }
    }
    for circle in circles(&graph) {
        let within = circle.iter().flat_map(|file| {
            let others = graph[*file].iter().filter(|other| circle.contains(other));
            others.map(|other| format!("\n    {} imports {}", file.join("::"), other.join("::")))
        });
        faults.push(format!(
            "a circle of {} files:{}",
            circle.len(),
            within.collect::<String>()
        ));
    }
    assert!(
        graph.len() > 100 && graph.values().map(BTreeSet::len).sum::<usize>() > 300,
        "imports were read"
    );
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

fn layer_fault(file: &Module, other: &Module) -> Option<String> {
    let (Some(from), Some(to)) = (file.first(), other.first()) else {
        return None;
    };
    if from == to || from == "main" {
        return None;
    }
    let height = |name: &String| LAYERS.iter().position(|layer| layer == name);
    let (Some(above), Some(below)) = (height(from), height(to)) else {
        return Some(format!("{} or {to}: not in the list of layers", file.join("::")));
    };
    let is_apart = APART.iter().any(|(a, b)| a == from && b == to);
    (below > above || is_apart).then(|| format!("{} must not import {}", file.join("::"), other.join("::")))
}

/// Every file below src/ but main.rs and lib.rs, without what is only built for tests.
fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = Vec::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                let module = module_of(&root, &path);
                if !matches!(module.first().map(String::as_str), None | Some("main" | "lib"))
                    && module.last().unwrap() != "tests"
                {
                    found.push(Source {
                        module,
                        text: code(&path),
                    });
                }
            }
        }
    }
    found
}

fn module_of(root: &Path, path: &Path) -> Module {
    let below = path.strip_prefix(root).unwrap().with_extension("");
    let mut parts: Module = below.iter().map(|p| p.to_str().unwrap().to_owned()).collect();
    parts.pop_if(|last| last == "mod");
    parts
}

/// The file up to its unit tests, without comments.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let end = text.find("#[cfg(test)]\nmod tests").unwrap_or(text.len());
    let lines = text[..end].lines().map(|line| line.split("//").next().unwrap_or(""));
    lines.collect::<Vec<_>>().join("\n")
}

/// Absolute paths that the `use` statements name: those that hand names on (`pub use`), or those that do not.
fn used(source: &Source, public: bool) -> Vec<Module> {
    let mut found = Vec::new();
    let mut rest = source.text.as_str();
    while let Some(at) = rest.find("use ") {
        let line = &rest[rest[..at].rfind('\n').map_or(0, |k| k + 1)..at];
        rest = &rest[at + "use ".len()..];
        let is_statement = if public {
            line.starts_with("pub") && line.ends_with(' ')
        } else {
            line.trim().is_empty()
        };
        if is_statement {
            let end = rest.find(';').unwrap_or(rest.len());
            let tree = rest[..end].split_whitespace().collect::<Vec<_>>().join(" ");
            found.extend(expand(&tree).iter().filter_map(|path| absolute(&source.module, path)));
        }
    }
    found
}

/// `a::{b, c::{d, e}}` as `a::b`, `a::c::d`, `a::c::e`.
fn expand(tree: &str) -> Vec<Module> {
    let tree = tree.trim();
    match tree.find('{') {
        None => {
            let name = tree.split(" as ").next().unwrap_or(tree);
            vec![
                name.split("::")
                    .map(|p| p.trim().to_owned())
                    .filter(|p| !p.is_empty())
                    .collect(),
            ]
        }
        Some(open) => {
            let before: Module = tree[..open]
                .split("::")
                .map(|p| p.trim().to_owned())
                .filter(|p| !p.is_empty())
                .collect();
            let inside = &tree[open + 1..tree.rfind('}').unwrap_or(tree.len())];
            let mut parts = Vec::new();
            let (mut depth, mut start) = (0, 0);
            for (k, c) in inside.char_indices() {
                match c {
                    '{' => depth += 1,
                    '}' => depth -= 1,
                    ',' if depth == 0 => {
                        parts.push(&inside[start..k]);
                        start = k + 1;
                    }
                    _ => {}
                }
            }
            parts.push(&inside[start..]);
            let whole = parts.into_iter().filter(|p| !p.trim().is_empty()).flat_map(expand);
            whole
                .map(|rest| {
                    before
                        .iter()
                        .cloned()
                        .chain(rest.into_iter().filter(|p| p != "self"))
                        .collect()
                })
                .collect()
        }
    }
}

/// Paths in the code itself that begin with `crate::` or with a module declared there, without those that only limit visibility.
fn inline_paths(source: &Source) -> Vec<Module> {
    let name = |c: char| c.is_alphanumeric() || c == '_';
    let mut found = Vec::new();
    for (at, _) in source.text.match_indices("::") {
        let before = &source.text[..at];
        let start = before.rfind(|c| !name(c)).map_or(0, |k| k + 1);
        let first = &before[start..];
        let line = &before[before.rfind('\n').map_or(0, |k| k + 1)..start];
        let is_inner = ["::", "in ", "use "].iter().any(|end| line.ends_with(end));
        if is_inner || !(first == "crate" || defines(&source.text, first)) {
            continue;
        }
        let rest = &source.text[at..];
        let end = rest.find(|c| !(name(c) || c == ':')).unwrap_or(rest.len());
        if rest[end..].starts_with('{') {
            continue;
        }
        let tail = rest[..end].split("::").map(str::to_owned).filter(|p| !p.is_empty());
        let base = if first == "crate" {
            Vec::new()
        } else {
            [&source.module[..], &[first.to_owned()]].concat()
        };
        found.push(base.into_iter().chain(tail).collect());
    }
    found
}

/// `None` for what lies outside the crate.
fn absolute(module: &Module, path: &Module) -> Option<Module> {
    let first = path.first()?.as_str();
    match first {
        "crate" => Some(path[1..].to_vec()),
        "self" => Some(module.iter().chain(&path[1..]).cloned().collect()),
        "super" => {
            let ups = path.iter().take_while(|p| *p == "super").count();
            let base = module.len().checked_sub(ups)?;
            Some(module[..base].iter().chain(&path[ups..]).cloned().collect())
        }
        _ => Some(module.iter().chain(path).cloned().collect()),
    }
}

/// The file that defines what a path names: re-exports are followed to where they come from.
fn definer(path: &Module, texts: &BTreeMap<Module, &str>, reexports: &BTreeMap<Module, Vec<Module>>) -> Option<Module> {
    let mut path = path.clone();
    for _ in 0..MOST_REEXPORTS {
        let file = (0..=path.len())
            .rev()
            .map(|n| path[..n].to_vec())
            .find(|p| texts.contains_key(p))?;
        let Some(name) = path.get(file.len()) else {
            return Some(file);
        };
        let is_here = |file: &Module| texts.get(file).is_some_and(|text| defines(text, name));
        let Some(from) = reexports.get(&file).filter(|_| !is_here(&file)) else {
            return Some(file);
        };
        let named = from.iter().find(|p| p.last() == Some(name)).cloned();
        let globs = from
            .iter()
            .filter(|p| p.last().is_some_and(|last| last == "*"))
            .map(|p| &p[..p.len() - 1]);
        let globbed = || {
            let mut holders = globs.map(<[String]>::to_vec);
            let holder = holders.find(|file| is_here(file) || names(reexports, file, name))?;
            Some(holder.into_iter().chain([name.clone()]).collect())
        };
        match named.or_else(globbed) {
            Some(next) => path = next,
            None => return Some(file),
        }
    }
    None
}

fn names(reexports: &BTreeMap<Module, Vec<Module>>, file: &Module, name: &String) -> bool {
    reexports
        .get(file)
        .is_some_and(|from| from.iter().any(|p| p.last() == Some(name)))
}

fn defines(text: &str, name: &str) -> bool {
    [
        "struct",
        "enum",
        "trait",
        "fn",
        "const",
        "static",
        "type",
        "mod",
        "macro_rules!",
    ]
    .iter()
    .any(|kind| {
        let start = format!("{kind} {name}");
        let mut at = text
            .match_indices(&start)
            .map(|(k, _)| text[k + start.len()..].chars().next());
        at.any(|next| next.is_none_or(|c| !(c.is_alphanumeric() || c == '_')))
    })
}

/// Groups of files each of which reaches all others.
fn circles(graph: &BTreeMap<Module, BTreeSet<Module>>) -> BTreeSet<Vec<&Module>> {
    let reached = |start: &Module| {
        let mut seen = BTreeSet::new();
        let mut open: Vec<&Module> = graph[start].iter().collect();
        while let Some(next) = open.pop() {
            if seen.insert(next) {
                open.extend(graph.get(next).into_iter().flatten());
            }
        }
        seen
    };
    let reach: BTreeMap<&Module, BTreeSet<&Module>> = graph.keys().map(|start| (start, reached(start))).collect();
    let is_mutual = |a: &Module, b: &Module| reach[a].contains(b) && reach.get(b).is_some_and(|back| back.contains(a));
    let in_circle = graph.keys().filter(|file| reach[file].contains(file));
    in_circle
        .map(|file| graph.keys().filter(|other| is_mutual(file, other)).collect())
        .collect()
}
