//! What a beam's present is compared with: the newest frames in full, what is older in blocks.

use std::collections::VecDeque;

use jiff::Timestamp;

/// Frames that are kept in full: the longest window of the tests. Longer finds weaker second beams later and holds a
/// beam's own changes against it for longer.
pub const RECENT_FRAMES: usize = 80;
/// Frames of a block. Longer blocks average more noise out of each mean; shorter ones show drift sooner. Not tuned.
pub const BLOCK_FRAMES: u32 = 30;
/// Blocks that are kept: with 30 frames each two minutes at 10 frames/s. More make the past's mean more exact, fewer let it
/// follow a beam that changes slowly. Not tuned.
pub const MAX_BLOCKS: usize = 40;
/// Blocks from which their scatter shows a beam's slow drift; with fewer an assumed drift is used. Six give a variance to
/// 60 %.
pub const MIN_DRIFT_BLOCKS: usize = 6;

/// The newest `RECENT_FRAMES` values.
#[derive(Clone, Debug)]
pub struct Recent<T>(VecDeque<T>);

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Self(VecDeque::new())
    }
}

impl<T> Recent<T> {
    /// Takes a value; gives the one that is too old for it.
    pub fn push(&mut self, value: T) -> Option<T> {
        self.0.push_back(value);
        (self.0.len() > RECENT_FRAMES).then(|| self.0.pop_front()).flatten()
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Oldest first.
    pub fn iter(&self) -> std::collections::vec_deque::Iter<'_, T> {
        self.0.iter()
    }
}

impl Recent<(Timestamp, f64)> {
    /// Mean of the newest `n` of at least as many.
    pub fn mean_of_newest(&self, n: usize) -> f64 {
        self.0.iter().rev().take(n).map(|(_, v)| v).sum::<f64>() / n as f64
    }

    /// How many values are from `time` or later.
    pub fn count_since(&self, time: Timestamp) -> usize {
        self.0.iter().rev().take_while(|(t, _)| *t >= time).count()
    }
}

/// Everything older, summed up in blocks of `BLOCK_FRAMES` frames each.
#[derive(Clone, Debug, Default)]
pub struct BlockHistory<B> {
    filling: B,
    filled: u32,
    blocks: VecDeque<B>,
}

impl<B: Default> BlockHistory<B> {
    /// A history of `blocks`.
    pub fn of(blocks: impl Iterator<Item = B>) -> Self {
        Self {
            blocks: blocks.collect(),
            ..Self::default()
        }
    }

    /// Adds a frame by `add` to the block that is being filled; says whether that is then full.
    pub fn push(&mut self, add: impl FnOnce(&mut B)) -> bool {
        add(&mut self.filling);
        self.filled += 1;
        let is_full = self.filled == BLOCK_FRAMES;
        if is_full {
            self.blocks.push_back(std::mem::take(&mut self.filling));
            self.filled = 0;
            if self.blocks.len() > MAX_BLOCKS {
                self.blocks.pop_front();
            }
        }
        is_full
    }

    /// Full blocks, oldest first.
    pub fn blocks(&self) -> std::collections::vec_deque::Iter<'_, B> {
        self.blocks.iter()
    }

    pub fn blocks_mut(&mut self) -> std::collections::vec_deque::IterMut<'_, B> {
        self.blocks.iter_mut()
    }

    /// Number of full blocks.
    pub fn len(&self) -> usize {
        self.blocks.len()
    }

    /// The block that is being filled.
    pub fn filling(&self) -> &B {
        &self.filling
    }

    /// Frames in full blocks and in the one that is being filled.
    pub fn frames(&self) -> u32 {
        self.blocks.len() as u32 * BLOCK_FRAMES + self.filled
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_stay_and_the_oldest_is_given_back() {
        let mut recent = Recent::default();
        let at = |k: usize| Timestamp::from_second(k as i64).unwrap();
        for k in 0..RECENT_FRAMES {
            assert_eq!(recent.push((at(k), k as f64)), None);
        }
        assert_eq!(recent.push((at(80), 80.0)), Some((at(0), 0.0)));
        assert_eq!(recent.len(), RECENT_FRAMES);
        assert_eq!(recent.mean_of_newest(3), 79.0);
        assert_eq!(recent.count_since(at(78)), 3);
        assert_eq!(recent.count_since(at(81)), 0);
    }

    #[test]
    fn frames_become_blocks_and_the_oldest_block_goes() {
        let mut history = BlockHistory::<u32>::default();
        for _ in 0..31 {
            history.push(|sum| *sum += 1);
        }
        assert_eq!((history.len(), *history.filling(), history.frames()), (1, 1, 31));
        assert_eq!(history.blocks().copied().collect::<Vec<_>>(), [30]);
        for k in 0..40 * 30 {
            history.push(|sum| *sum += k);
        }
        assert_eq!(history.len(), 40);
        assert!(history.blocks().all(|b| *b != 30));
    }
}
