//! Poses between the thread that receives them and the next frame.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::pose::Pose;

/// Poses that wait for a frame; the oldest make way. More than the buffer of poses keeps would be forgotten there.
const CAPACITY: usize = 4096;

/// Poses that wait for the next frame, bounded.
#[derive(Clone, Debug, Default)]
pub struct PoseInbox(Arc<Mutex<VecDeque<Pose>>>);

impl PoseInbox {
    pub fn put(&self, pose: Pose) {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.len() >= CAPACITY {
            waiting.pop_front();
        }
        waiting.push_back(pose);
    }

    /// Those that wait, in the order in which they came.
    pub fn take(&self) -> VecDeque<Pose> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
