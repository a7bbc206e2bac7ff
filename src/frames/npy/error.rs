//! Why a frame file cannot be read or written.

use std::path::PathBuf;

use super::dtype::Dtype;

/// Why a frame file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: not an npy file: expected it to begin with \\x93NUMPY and a complete header")]
    NotNpy { path: PathBuf },
    #[error("{path}: npy version {major}.{minor}, expected 1, 2 or 3")]
    Version { path: PathBuf, major: u8, minor: u8 },
    #[error("{path}: npy header of {found} bytes, expected at most {most}")]
    HeaderLength { path: PathBuf, found: usize, most: usize },
    #[error("{path}: npy header: expected a dict of descr, fortran_order and shape, found {found:?}")]
    Header { path: PathBuf, found: String },
    #[error("{path}: dtype: expected f4, f8, u1 or u2, found {found:?}")]
    Dtype { path: PathBuf, found: String },
    #[error("{path}: expected C order, found Fortran order (numpy.ascontiguousarray converts it)")]
    FortranOrder { path: PathBuf },
    #[error("{path}: shape: expected (T, Ny, Nx) or (Ny, Nx), found {} dimensions: {found:?}", found.len())]
    Dimensions { path: PathBuf, found: Vec<u64> },
    #[error("{path}: shape {found:?}: expected at least one frame of one pixel, found none")]
    Empty { path: PathBuf, found: Vec<u64> },
    #[error("{path}: shape {found:?}: expected at most 4096 pixels a side and 8 EiB in all")]
    TooLarge { path: PathBuf, found: Vec<u64> },
    #[error(
        "{path}: integer frames ({}) are counts: expected optics.joules_per_count, found none in the config",
        dtype.descr()
    )]
    NoScale { path: PathBuf, dtype: Dtype },
    #[error(
        "{path}: frame {frame} is truncated: expected {expected} bytes, found {found} ({frame} of {frames} frames are complete)"
    )]
    Truncated {
        path: PathBuf,
        frame: u64,
        frames: u64,
        expected: usize,
        found: usize,
    },
    #[error("{path}: frame {frame}: the file holds frames 0 to {}", frames - 1)]
    NoSuchFrame { path: PathBuf, frame: u64, frames: u64 },
    #[error("{path}: frame of {found_x} × {found_y} pixels, the file holds {expected_x} × {expected_y}")]
    Shape {
        path: PathBuf,
        expected_x: usize,
        expected_y: usize,
        found_x: usize,
        found_y: usize,
    },
}
