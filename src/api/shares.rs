//! How many connections there may be, and how many of them one client may hold.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

/// A client may hold this many times what is still free: three quarters of all if it comes alone. Six
/// such clients in a row are needed to leave nothing to others (Choudhury & Hahne, 1998, dynamic thresholds of a shared memory).
const TIMES_FREE: usize = 3;

/// What counts as one client: an IPv4 address, or the /64 that one IPv6 client has to itself.
pub(super) fn client(address: IpAddr) -> u128 {
    match address.to_canonical() {
        IpAddr::V4(v4) => u128::from(u32::from(v4)),
        IpAddr::V6(v6) => u128::from(v6) >> 64 << 64 | 1,
    }
}

/// The connections that are left. Memory is bounded by their number.
pub(super) struct Shares {
    most: usize,
    held: Mutex<Held>,
}

#[derive(Default)]
struct Held {
    all: usize,
    by_client: HashMap<u128, usize>,
}

/// One connection, given back when dropped.
pub(super) struct Share {
    of: Arc<Shares>,
    client: u128,
}

/// Why a client gets no connection, as the metric names it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Refused {
    Full,
    Greedy,
}

impl Refused {
    pub(super) fn reason(self) -> &'static str {
        match self {
            Self::Full => "connections",
            Self::Greedy => "share",
        }
    }
}

impl Shares {
    pub(super) fn new(most: usize) -> Arc<Self> {
        let held = Mutex::default();
        Arc::new(Self { most, held })
    }

    pub(super) fn take(self: &Arc<Self>, address: IpAddr) -> Result<Share, Refused> {
        let client = client(address);
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.most.saturating_sub(held.all);
        if free == 0 {
            return Err(Refused::Full);
        }
        let own = held.by_client.get(&client).copied().unwrap_or(0);
        if own >= TIMES_FREE * free {
            return Err(Refused::Greedy);
        }
        held.by_client.insert(client, own + 1);
        held.all += 1;
        let of = self.clone();
        Ok(Share { of, client })
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let mut held = self.of.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.all -= 1;
        match held.by_client.get_mut(&self.client) {
            Some(own) if *own > 1 => *own -= 1,
            _ => drop(held.by_client.remove(&self.client)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn as_many_as_it_gets(shares: &Arc<Shares>, address: &str) -> Vec<Share> {
        let address = address.parse().expect("an address");
        std::iter::from_fn(|| shares.take(address).ok()).collect()
    }

    #[test]
    fn greedy_clients_leave_some_for_others() {
        let shares = Shares::new(2048);
        let first = as_many_as_it_gets(&shares, "192.0.2.1");
        assert_eq!(first.len(), 1536);
        let mut others = Vec::new();
        for k in 0..100 {
            let other = as_many_as_it_gets(&shares, &format!("198.51.100.{k}"));
            assert!(!other.is_empty() || k > 4, "client {k}");
            others.extend(other);
        }
        drop(others);
        assert_eq!(as_many_as_it_gets(&shares, "2001:db8::1").len(), 384);
    }

    #[test]
    fn a_network_of_one_client_is_one_client() {
        let shares = Shares::new(8);
        let own = as_many_as_it_gets(&shares, "2001:db8::1");
        let again = shares.take("2001:db8::2".parse().expect("an address"));
        assert_eq!((own.len(), again.err()), (6, Some(Refused::Greedy)));
        let other = as_many_as_it_gets(&shares, "2001:db8:0:1::1");
        assert_eq!(other.len(), 2);
        let last = shares.take("192.0.2.1".parse().expect("an address"));
        assert_eq!(last.err(), Some(Refused::Full));
    }

    #[test]
    fn what_is_given_back_is_there_again() {
        let shares = Shares::new(2);
        let own = as_many_as_it_gets(&shares, "192.0.2.1");
        assert_eq!(own.len(), 2);
        drop(own);
        assert!(shares.held.lock().expect("no panic").by_client.is_empty());
        assert_eq!(as_many_as_it_gets(&shares, "192.0.2.1").len(), 2);
    }
}
