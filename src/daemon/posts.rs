//! Claims by POST that wait for the compute thread, which places a few of them between two frames.

use std::collections::VecDeque;

use tokio::sync::oneshot;

use crate::claims::Claim;

/// Claims that are placed between two looks for a frame. Each costs about a microsecond, by which a frame may be late.
const A_TURN: usize = 128;
/// Of these, claims of one request before the next one has its turn.
const AT_ONCE: usize = 64;
/// Claims that wait here; further requests wait in their channel, which is bounded.
const MOST_WAITING: usize = 20_000;

/// Requests that wait to be placed, a little of each at a time.
#[derive(Default)]
pub(super) struct Posts {
    waiting: VecDeque<Post>,
    claims: usize,
}

/// A request of whose claims some have yet to be placed.
struct Post {
    claims: std::iter::Enumerate<std::vec::IntoIter<Claim>>,
    refused: Vec<(usize, String)>,
    reply: oneshot::Sender<Vec<(usize, String)>>,
}

impl Posts {
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    pub fn has_room(&self) -> bool {
        self.claims < MOST_WAITING
    }

    /// Takes a request; `reply` gets index and reason of each claim that is refused.
    pub fn add(&mut self, claims: Vec<Claim>, reply: oneshot::Sender<Vec<(usize, String)>>) {
        self.claims += claims.len();
        self.waiting.push_back(Post {
            claims: claims.into_iter().enumerate(),
            refused: Vec::new(),
            reply,
        });
    }

    /// Places one turn's claims with `insert`, which says why it refuses one, and answers the requests that have no more.
    pub fn place(&mut self, mut insert: impl FnMut(Claim) -> Option<&'static str>) {
        let mut left = A_TURN;
        while left > 0
            && let Some(mut post) = self.waiting.pop_front()
        {
            let share = left.min(AT_ONCE);
            let mut placed = 0;
            for (index, claim) in post.claims.by_ref().take(share) {
                placed += 1;
                post.refused
                    .extend(insert(claim).map(|reason| (index, reason.to_owned())));
            }
            self.claims -= placed;
            // A request without claims costs a turn something too.
            left -= placed.max(1);
            if placed < share {
                // A client that has gone away needs no answer.
                let _ = post.reply.send(post.refused);
            } else {
                self.waiting.push_back(post);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claim::ClaimState;

    fn claims(count: usize) -> Vec<Claim> {
        let claim = Claim {
            time: jiff::Timestamp::UNIX_EPOCH,
            user: "u".into(),
            x_m: 0.0,
            y_m: 0.0,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        };
        vec![claim; count]
    }

    #[test]
    fn a_large_request_does_not_keep_a_small_one_waiting() {
        let mut posts = Posts::default();
        let (large, mut large_answer) = oneshot::channel();
        let (small, mut small_answer) = oneshot::channel();
        posts.add(claims(1000), large);
        posts.add(claims(3), small);
        let mut placed = 0;
        posts.place(|_| {
            placed += 1;
            Some("no")
        });
        assert_eq!(placed, A_TURN);
        assert_eq!(small_answer.try_recv().unwrap().len(), 3);
        assert!(large_answer.try_recv().is_err());
        while !posts.is_empty() {
            posts.place(|_| None);
        }
        assert_eq!(large_answer.try_recv().unwrap().len(), A_TURN - 3);
    }
}
