//! What operators set over the API: known lights, zones and maintenance windows. The journal keeps it over restarts.

use anyhow::{Context, Result};
use jiff::Timestamp;
use serde::de::DeserializeOwned;

use super::compute::Compute;
use crate::api::{Command, ZonesRefused};
use crate::journal::Journal;
use crate::monitor::zones::{collection, parse};
use crate::monitor::{LightError, LightRecord, Monitor, Window};

/// Kinds under which the journal keeps what was set.
const LIGHT: &str = "known_light";
const ZONES: &str = "zones";
const MAINTENANCE: &str = "maintenance";
/// The id of all drawn zones, which are kept as one.
const DRAWN: &str = "drawn";

/// Puts what the journal has kept in force, but for maintenance that has ended `now`.
pub fn restore(journal: &Journal, monitor: &mut Monitor, now: Timestamp) -> Result<()> {
    monitor.restore_lights(kept(journal, LIGHT)?);
    for drawn in kept::<serde_json::Value>(journal, ZONES)? {
        // The config may have gained zones of the same name, or too many, since.
        let put = parse(&drawn).and_then(|zones| monitor.set_zones(zones));
        put.context("zones drawn over the API, which the journal has kept")?;
    }
    for window in kept::<Window>(journal, MAINTENANCE)? {
        match window.until > now {
            true => monitor.add_maintenance(window)?,
            false => journal.keep(MAINTENANCE, &window.id, None),
        }
    }
    Ok(())
}

fn kept<T: DeserializeOwned>(journal: &Journal, kind: &str) -> Result<Vec<T>> {
    let bodies = journal.kept(kind)?;
    let read = |body: &String| serde_json::from_str(body).with_context(|| format!("the journal's {kind}: {body}"));
    bodies.iter().map(read).collect()
}

fn json<T: serde::Serialize>(value: &T) -> Option<String> {
    Some(serde_json::to_string(value).expect("it holds no maps with keys other than strings"))
}

impl Compute {
    /// Answers a command about known lights, zones or maintenance. A client that has gone away needs no answer.
    pub(super) fn operate(&mut self, command: Command) {
        let now = self.now();
        let monitor = &mut self.pipeline.monitor;
        match command {
            Command::KnownLights { reply } => drop(reply.send(monitor.known_lights())),
            Command::Approve { mut request, reply } => {
                request.at = now;
                let mut approved = monitor.approve(request);
                if let Err(LightError::NoAlert(id)) = &approved
                    && matches!(self.journal.alert(id), Ok(Some(_)))
                {
                    approved = Err(LightError::Cleared(id.clone()));
                }
                self.keep_lights();
                drop(reply.send(approved));
            }
            Command::Revoke { id, reply } => {
                let revoked = monitor.revoke(&id);
                self.keep_lights();
                drop(reply.send(revoked));
            }
            Command::Zones { reply } => drop(reply.send(monitor.zones())),
            Command::PutZones {
                zones,
                unless_changed,
                reply,
            } => {
                let before = monitor.zones().digest();
                let put = match unless_changed.is_some_and(|digest| digest != before) {
                    true => Err(ZonesRefused::Changed),
                    false => monitor
                        .set_zones(zones)
                        .map_err(ZonesRefused::Bad)
                        .map(|()| monitor.zones()),
                };
                if let Ok(map) = &put {
                    let drawn = map.zones().iter().filter(|z| !z.is_fixed);
                    self.journal.keep(ZONES, DRAWN, json(&collection(drawn)));
                }
                drop(reply.send(put));
            }
            Command::Maintenance { reply } => drop(reply.send(monitor.maintenance(now))),
            Command::BeginMaintenance {
                from,
                until,
                by,
                note,
                reply,
            } => {
                let window = Window {
                    id: format!("maintenance-{}", now.as_microsecond()),
                    from: from.unwrap_or(now),
                    until,
                    by,
                    note,
                    is_fixed: false,
                };
                for ended in monitor.take_ended_maintenance(now) {
                    self.journal.keep(MAINTENANCE, &ended.id, None);
                }
                let begun = monitor.add_maintenance(window.clone()).map(|()| window);
                if let Ok(window) = &begun {
                    self.journal.keep(MAINTENANCE, &window.id, json(window));
                }
                drop(reply.send(begun));
            }
            Command::EndMaintenance { id, reply } => {
                let ended = monitor.end_maintenance(&id);
                if ended.is_ok() {
                    self.journal.keep(MAINTENANCE, &id, None);
                }
                drop(reply.send(ended));
            }
            Command::Claims { .. } | Command::Acknowledge { .. } | Command::Unacknowledge { .. } => {}
        }
    }

    /// Hands the journal what has changed of the known lights.
    pub(super) fn keep_lights(&mut self) {
        for record in self.pipeline.monitor.take_light_records() {
            match record {
                LightRecord::Put(light) => self.journal.keep(LIGHT, &light.id, json(&*light)),
                LightRecord::Forgotten(id) => self.journal.keep(LIGHT, &id, None),
            }
        }
    }
}
