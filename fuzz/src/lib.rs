//! What the targets share: readers that take a path get the fuzzer's bytes as a file in memory.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

static FILE: LazyLock<PathBuf> = LazyLock::new(|| {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    folder.join(format!("oapwatch-fuzz-{}", std::process::id()))
});

/// Runs `target` on a file that holds `bytes`.
pub fn with_file(bytes: &[u8], target: impl FnOnce(&Path)) {
    std::fs::write(&*FILE, bytes).expect("a place to write to");
    target(&FILE);
}
