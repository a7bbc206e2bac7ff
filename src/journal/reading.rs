//! Answers from memory and disk together.

use std::collections::{BTreeMap, HashSet};

use super::schema;
use super::store::Store;
use super::writer::lock;
use super::{
    AuditRecord, DeadLetter, EndpointRecord, Error, Filter, HISTORY, Journal, Page, READERS, Recorded, Waiting,
};
use crate::monitor::Alert;

impl Journal {
    /// Alerts that are not cleared, oldest first: what the monitor resumes with after a restart.
    pub fn open_alerts(&self) -> Result<Vec<Alert>, Error> {
        let (held, disk) = self.read(|store| store.open_alerts())?;
        let newer = self.held_ids()?;
        let disk = disk.unwrap_or_default().into_iter().filter(|a| !newer.contains(&a.id));
        let mut alerts: Vec<Alert> = disk.chain(held.unwrap_or_default()).collect();
        alerts.sort_by_key(|a| a.raised_at);
        Ok(alerts)
    }

    /// What operators have set of this kind, as [`Journal::keep`] got it; by id.
    pub fn kept(&self, kind: &str) -> Result<Vec<String>, Error> {
        let (held, disk) = self.read(|store| store.kept(kind))?;
        Ok(disk.or(held).unwrap_or_default())
    }

    /// Newest raised first.
    pub fn alerts(&self, filter: &Filter, limit: usize) -> Result<Page, Error> {
        let newer = self.held_ids()?;
        let take = limit.saturating_add(1).saturating_add(newer.len());
        let (held, disk) = self.read(|store| store.alerts(filter, take))?;
        let disk = disk
            .unwrap_or_default()
            .into_iter()
            .filter(|l| !newer.contains(&l.alert.id));
        let mut listed: Vec<_> = disk.chain(held.unwrap_or_default()).collect();
        listed.sort_by_key(|l| std::cmp::Reverse(l.cursor));
        let more = listed.len() > limit;
        listed.truncate(limit);
        Ok(Page {
            next: listed.last().filter(|_| more).map(|l| l.cursor),
            alerts: listed.into_iter().map(|l| l.alert).collect(),
        })
    }

    pub fn alert(&self, id: &str) -> Result<Option<Alert>, Error> {
        let (held, disk) = self.read(|store| store.alert(id))?;
        Ok(held.flatten().or(disk.flatten()))
    }

    /// One alert's life, oldest event first.
    pub fn events(&self, alert: &str) -> Result<Vec<Recorded>, Error> {
        let (held, disk) = self.read(|store| store.events_of(alert, HISTORY))?;
        Ok(in_order(held, disk))
    }

    /// Events of every alert after a sequence number, oldest first.
    pub fn events_after(&self, seq: u64, limit: usize) -> Result<Vec<Recorded>, Error> {
        let (held, disk) = self.read_after(seq, |store| store.events_after(seq, limit))?;
        let mut events = in_order(held, disk);
        events.truncate(limit);
        Ok(events)
    }

    pub fn event(&self, seq: u64) -> Result<Option<Recorded>, Error> {
        let found = self.events_after(seq.saturating_sub(1), 1)?.pop();
        Ok(found.filter(|event| event.seq == seq))
    }

    /// Deliveries to an endpoint that are still to be made, for events after a sequence number.
    pub fn waiting(&self, endpoint: &str, after: u64) -> Result<Vec<Waiting>, Error> {
        self.first_waiting(endpoint, after, i64::MAX as usize)
    }

    /// The first `limit` of [`Journal::waiting`].
    pub fn first_waiting(&self, endpoint: &str, after: u64, limit: usize) -> Result<Vec<Waiting>, Error> {
        let rows = i64::try_from(limit).unwrap_or(i64::MAX);
        let (held, disk) = self.read_after(after, |store| store.waiting(endpoint, after, rows))?;
        let all = disk.into_iter().chain(held).flatten();
        let by_seq: BTreeMap<u64, Waiting> = all.map(|w| (w.seq, w)).collect();
        Ok(by_seq.into_values().take(limit).collect())
    }

    /// Those of [`Journal::waiting`] that memory knows of, without a look at the disk, and whether they are all.
    pub fn waiting_in_memory(&self, endpoint: &str, after: u64) -> Result<(Vec<Waiting>, bool), Error> {
        let overlay = lock(&self.shared.overlay);
        let Some(since) = overlay.since else {
            return Ok((Vec::new(), false));
        };
        Ok((overlay.store.waiting(endpoint, after, i64::MAX)?, since <= after))
    }

    pub fn dead_letters(&self, endpoint: &str, limit: usize) -> Result<Vec<DeadLetter>, Error> {
        let (held, disk) = self.read(|store| store.dead_letters(endpoint, limit))?;
        Ok(disk.into_iter().chain(held).flatten().collect())
    }

    /// The audit log, newest first; `before` is the id of the last row of the page before.
    pub fn audit_log(&self, before: Option<u64>, limit: usize) -> Result<Vec<AuditRecord>, Error> {
        let (held, disk) = self.read(|store| store.audit(before, limit))?;
        let by_id: BTreeMap<u64, AuditRecord> = disk
            .into_iter()
            .chain(held)
            .flatten()
            .map(|record| (record.id, record))
            .collect();
        Ok(by_id.into_values().rev().take(limit).collect())
    }

    /// The last event taken over from each other journal, by its name.
    pub fn origins(&self) -> Result<BTreeMap<String, u64>, Error> {
        let (held, disk) = self.read(|store| store.origins())?;
        let mut origins = disk.unwrap_or_default();
        for (source, seq) in held.into_iter().flatten() {
            let last = origins.entry(source).or_default();
            *last = seq.max(*last);
        }
        Ok(origins)
    }

    pub fn endpoint(&self, id: &str) -> Result<EndpointRecord, Error> {
        self.endpoint_until(id, i64::MAX as u64)
    }

    /// [`Journal::endpoint`] without the deliveries of events after a sequence number among those sent or given up.
    pub fn endpoint_until(&self, id: &str, seq: u64) -> Result<EndpointRecord, Error> {
        let until = i64::try_from(seq).unwrap_or(i64::MAX);
        let (held, disk) = self.read(|store| store.endpoint(id, until))?;
        Ok(disk.or(held).unwrap_or_default())
    }

    fn held_ids(&self) -> Result<HashSet<String>, Error> {
        let overlay = lock(&self.shared.overlay);
        match overlay.since {
            Some(_) => Ok(overlay.store.alert_ids()?),
            None => Ok(Default::default()),
        }
    }

    /// Asks the memory first and the disk after it: a record that moves from one to the other in between is then
    /// seen twice, never missed. A disk that cannot even be read leaves what memory holds.
    fn read<T>(&self, ask: impl Fn(&Store) -> Result<T, rusqlite::Error>) -> Result<(Option<T>, Option<T>), Error> {
        let held = {
            let overlay = lock(&self.shared.overlay);
            overlay.since.map(|_| ask(&overlay.store)).transpose()?
        };
        match self.read_disk(ask) {
            Err(error) if held.is_some() => {
                tracing::warn!(%error, "the journal's disk cannot be read; only what memory holds is shown");
                Ok((held, None))
            }
            disk => Ok((held, disk?)),
        }
    }

    /// As [`Journal::read`], for what came after an event. Memory answers alone where it holds all of that, so that a disk that
    /// hangs delays no reader. Elsewhere a disk that cannot be read is an error, not a gap.
    fn read_after<T>(
        &self,
        seq: u64,
        ask: impl Fn(&Store) -> Result<T, rusqlite::Error>,
    ) -> Result<(Option<T>, Option<T>), Error> {
        let held = {
            let overlay = lock(&self.shared.overlay);
            let held = overlay.since.map(|_| ask(&overlay.store)).transpose()?;
            if overlay.since.is_some_and(|since| since <= seq) {
                return Ok((held, None));
            }
            held
        };
        Ok((held, self.read_disk(ask)?))
    }

    /// `None` for a journal in memory, and where the disk has none yet.
    fn read_disk<T>(&self, ask: impl Fn(&Store) -> Result<T, rusqlite::Error>) -> Result<Option<T>, Error> {
        let Some(path) = &self.shared.path else {
            return Ok(None);
        };
        let reader = lock(&self.readers).pop();
        let reader = match reader {
            Some(reader) => reader,
            None => Store::open_readable(path)?,
        };
        if schema::is_blank(&reader.db)? {
            return Ok(None);
        }
        let found = ask(&reader)?;
        let mut readers = lock(&self.readers);
        if reader.sees_changes && readers.len() < READERS {
            readers.push(reader);
        }
        Ok(Some(found))
    }
}

fn in_order(held: Option<Vec<Recorded>>, disk: Option<Vec<Recorded>>) -> Vec<Recorded> {
    let all = disk.into_iter().chain(held).flatten();
    let by_seq: BTreeMap<u64, Recorded> = all.map(|e| (e.seq, e)).collect();
    by_seq.into_values().collect()
}
