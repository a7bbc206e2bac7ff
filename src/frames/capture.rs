//! The capture thread: waits for frames of a source and passes them to the slot.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::slot::{Captured, Slot, Taken};
use super::source::{FrameSource, Next};
use crate::metric;

/// Longest wait before the thread checks whether it must stop.
const PATIENCE: Duration = Duration::from_millis(100);

/// A running source. Dropping it stops the thread and waits for it.
#[derive(Debug)]
pub struct Capture {
    slot: Arc<Slot>,
    stop: Arc<AtomicBool>,
    dropped: AtomicU64,
    thread: Option<JoinHandle<()>>,
}

impl Capture {
    /// Starts a thread that empties `source` into a latest-wins slot; a recording waits for its reader.
    pub fn start(source: Box<dyn FrameSource>) -> std::io::Result<Self> {
        let slot = Arc::new(Slot::default());
        let stop = Arc::new(AtomicBool::new(false));
        let thread = std::thread::Builder::new().name("capture".into()).spawn({
            let (slot, stop) = (slot.clone(), stop.clone());
            move || {
                let _closes = CloseOnExit(&slot);
                run(source, &slot, &stop);
            }
        })?;
        Ok(Self {
            slot,
            stop,
            dropped: AtomicU64::new(0),
            thread: Some(thread),
        })
    }

    /// Frames replaced by newer ones so far.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits up to `patience` for the latest frame. Gives `Next::End` once the source has ended.
    pub fn next(&self, patience: Duration) -> Captured {
        match self.slot.take(patience) {
            Taken::Captured(captured, dropped) => {
                if dropped > 0 {
                    metrics::counter!(metric::FRAMES_DROPPED).increment(dropped);
                    self.dropped.fetch_add(dropped, Ordering::Relaxed);
                }
                captured
            }
            Taken::Nothing => Captured::new(Next::Nothing, None),
            Taken::Closed => Captured::new(Next::End, None),
        }
    }
}

impl Drop for Capture {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.slot.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the capture thread ended in a panic");
        }
    }
}

/// Closes the slot when the thread ends, also by a panic, so that the reader does not wait for it.
struct CloseOnExit<'a>(&'a Slot);

impl Drop for CloseOnExit<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

fn run(mut source: Box<dyn FrameSource>, slot: &Slot, stop: &AtomicBool) {
    let mut file: Option<Arc<Path>> = None;
    while !stop.load(Ordering::Relaxed) {
        let next = source.next(PATIENCE);
        match next {
            Next::Nothing => continue,
            Next::End => return,
            Next::Frame(..) | Next::Unusable { .. } => {}
        }
        if source.file() != file.as_deref() {
            file = source.file().map(Arc::from);
        }
        let captured = Captured::new(next, file.clone());
        let open = match source.waits() {
            true => slot.put_when_empty(captured),
            false => slot.put(captured),
        };
        if !open {
            return;
        }
    }
}
