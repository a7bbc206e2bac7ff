//! A random stream of its own for every effect, emitter and frame.
//!
//! ChaCha8 is keyed by (seed, effect, entity) and its stream number is the frame, so that any frame can be made without
//! its predecessors, on any thread, and switching an effect on or off leaves the draws of all others as they were.

use std::cell::Cell;
use std::ops::{Deref, DerefMut};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::effect::Effect;

/// How many 32-bit words each effect has drawn.
#[derive(Debug, Default)]
pub struct Ledger([Cell<u64>; Effect::SLOTS]);

impl Ledger {
    /// 32-bit random words that `effect` has drawn.
    pub fn words(&self, effect: Effect) -> u64 {
        self.0[effect as usize].get()
    }
}

/// Opens streams for one seed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Streams {
    pub seed: u64,
}

impl Streams {
    pub fn open<'a>(&self, effect: Effect, entity: u64, frame: u64, ledger: &'a Ledger) -> Stream<'a> {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&self.seed.to_le_bytes());
        key[8..16].copy_from_slice(&(effect as u64).to_le_bytes());
        key[16..24].copy_from_slice(&entity.to_le_bytes());
        key[24..].copy_from_slice(b"oapwatch");
        let mut rng = ChaCha8Rng::from_seed(key);
        rng.set_stream(frame);
        Stream {
            rng,
            drawn: &ledger.0[effect as usize],
        }
    }
}

/// A random generator that records its number of draws in the ledger when dropped.
pub(super) struct Stream<'a> {
    rng: ChaCha8Rng,
    drawn: &'a Cell<u64>,
}

impl Deref for Stream<'_> {
    type Target = ChaCha8Rng;

    fn deref(&self) -> &ChaCha8Rng {
        &self.rng
    }
}

impl DerefMut for Stream<'_> {
    fn deref_mut(&mut self) -> &mut ChaCha8Rng {
        &mut self.rng
    }
}

impl Drop for Stream<'_> {
    fn drop(&mut self) {
        self.drawn.set(self.drawn.get() + self.rng.get_word_pos() as u64);
    }
}
