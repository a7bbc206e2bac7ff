//! Pictures of the latest frame, drawn once for all viewers.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use axum::body::Bytes;

use super::feed::Published;

/// A picture is drawn anew at most this often, however many viewers ask.
const REDRAW: Duration = Duration::from_millis(100);

/// What is drawn.
#[derive(Clone, Copy, PartialEq)]
pub struct Look {
    /// Picture pixels a sensor pixel.
    pub scale: usize,
    pub detections: bool,
    /// Whether model and residual stand beside the frame.
    pub fit: bool,
}

/// The pictures of one frame.
#[derive(Default)]
pub struct PictureCache(Mutex<Drawn>);

#[derive(Default)]
struct Drawn {
    seq: u64,
    at: Option<Instant>,
    looks: Vec<(Look, Bytes)>,
}

impl PictureCache {
    /// The number of the frame and its picture, if it is still fresh.
    pub fn get(&self, published: &Published, look: Look) -> Option<(u64, Bytes)> {
        let drawn = self.0.lock().unwrap_or_else(|p| p.into_inner());
        let fresh = drawn.seq == published.seq || drawn.at.is_some_and(|at| at.elapsed() < REDRAW);
        let found = drawn.looks.iter().find(|(l, _)| *l == look).filter(|_| fresh)?;
        Some((drawn.seq, found.1.clone()))
    }

    /// Keeps a picture of frame `seq`.
    pub fn put(&self, seq: u64, look: Look, png: Bytes) {
        let mut drawn = self.0.lock().unwrap_or_else(|p| p.into_inner());
        if drawn.seq != seq {
            *drawn = Drawn {
                seq,
                at: Some(Instant::now()),
                looks: Vec::new(),
            };
        }
        if drawn.looks.len() < 8 {
            drawn.looks.push((look, png));
        }
    }
}
