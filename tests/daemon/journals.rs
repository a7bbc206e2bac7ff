//! The events in the journals of a station and of the hub.

use std::path::Path;
use std::time::{Duration, Instant};

/// An event of a journal: alert, kind of event, its time on the frames' clock.
pub type Event = (String, String, i64);

/// All events of a journal in their order, but for what the hub adds; `prefix` is what it puts before a station's ids.
pub fn events(journal: &Path, prefix: &str) -> Vec<Event> {
    let db = rusqlite::Connection::open_with_flags(journal, rusqlite::OpenFlags::SQLITE_OPEN_READ_ONLY).unwrap();
    let mut rows = db
        .prepare("SELECT alert, json_extract(body, '$.event'), at_us FROM event ORDER BY seq")
        .unwrap();
    let row = |row: &rusqlite::Row| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?, row.get(2)?));
    let all = rows.query_map([], row).unwrap().map(Result::unwrap);
    let own = all.filter(|(_, event, _)| event != "alert.reported");
    own.filter_map(|(id, event, at)| Some((id.strip_prefix(prefix)?.to_owned(), event, at)))
        .collect()
}

/// Waits until the hub has what `station` of the site `harbour` has, no less, no more, in its order; gives how many events that are.
pub fn agree(dir: &Path, hub: &str, station: &str, within: Duration) -> usize {
    let end = Instant::now() + within;
    loop {
        let here = events(&dir.join(station).join("journal.db"), "");
        let there = events(&dir.join(hub).join("journal.db"), &format!("harbour.{station}."));
        if !here.is_empty() && here == there {
            return here.len();
        }
        if Instant::now() > end {
            let missing: Vec<_> = here.iter().filter(|e| !there.contains(e)).take(10).collect();
            panic!(
                "{} events at the station, {} at the hub; missing {missing:?}",
                here.len(),
                there.len()
            );
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}
