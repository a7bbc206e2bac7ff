//! What an operator changes while the monitor runs: known lights, zones and maintenance windows.

use jiff::Timestamp;

use super::known_lights::{KnownLight, KnownLightStatus, LightError, LightRecord, Request};
use super::maintenance::{MaintenanceError, Window};
use super::monitor::Monitor;
use super::zones::{Zone, ZoneError, ZoneMap, check_all};

impl Monitor {
    /// Puts the config's zones, known lights and maintenance windows in force in place of those of an earlier config.
    pub fn set_fixed(
        &mut self,
        zones: Vec<Zone>,
        lights: Vec<KnownLight>,
        windows: Vec<Window>,
    ) -> Result<(), ZoneError> {
        let drawn = self.frame.zones.zones().iter().filter(|z| !z.is_fixed).cloned();
        self.put_zones(zones.into_iter().chain(drawn).collect())?;
        self.frame.lights.set_fixed(lights);
        self.frame.maintenance.set_fixed(windows);
        Ok(())
    }

    /// Puts the operator's zones in force in place of those drawn before; those of the config stay.
    pub fn set_zones(&mut self, drawn: Vec<Zone>) -> Result<(), ZoneError> {
        let fixed = self.frame.zones.zones().iter().filter(|z| z.is_fixed).cloned();
        self.put_zones(fixed.chain(drawn).collect())
    }

    fn put_zones(&mut self, zones: Vec<Zone>) -> Result<(), ZoneError> {
        check_all(&zones)?;
        self.frame.zones = ZoneMap::new(zones);
        self.memory.unclaimed.dismiss_ignored(&self.frame);
        Ok(())
    }

    /// The zones in force, those of the config first.
    pub fn zones(&self) -> ZoneMap {
        self.frame.zones.clone()
    }

    /// Takes over the known lights that the journal kept.
    pub fn restore_lights(&mut self, kept: Vec<KnownLight>) {
        self.frame.lights.restore(kept);
        for state in self.frame.lights.iter() {
            if let Some(learned) = state.range.learned() {
                let std = (learned.variance_within + learned.variance_between).sqrt();
                self.memory
                    .co_located
                    .remember_light(&state.light.id, learned.ln_energy, std);
            }
        }
    }

    /// Approves a place or the emitter of an open alert.
    pub fn approve(&mut self, request: Request) -> Result<KnownLight, LightError> {
        let light = self.frame.approve(request)?;
        self.memory.co_located.retain_lights(|id| id != light.id);
        Ok(light)
    }

    /// Ends an approval.
    pub fn revoke(&mut self, id: &str) -> Result<KnownLight, LightError> {
        self.frame.lights.revoke(id)
    }

    pub fn known_lights(&self) -> Vec<KnownLightStatus> {
        self.frame.lights.status(self.frame.config.tolerated_brightening)
    }

    /// What of the known lights the journal must keep since the last call.
    pub fn take_light_records(&mut self) -> Vec<LightRecord> {
        self.frame.lights.take_changed()
    }

    /// Maintenance windows in force and to come.
    pub fn maintenance(&self, now: Timestamp) -> Vec<Window> {
        self.frame.maintenance.windows(now)
    }

    /// Forgets and returns the maintenance windows that have ended.
    pub fn take_ended_maintenance(&mut self, now: Timestamp) -> Vec<Window> {
        self.frame.maintenance.take_ended(now)
    }

    pub fn add_maintenance(&mut self, window: Window) -> Result<(), MaintenanceError> {
        self.frame.maintenance.add(window)
    }

    pub fn end_maintenance(&mut self, id: &str) -> Result<Window, MaintenanceError> {
        self.frame.maintenance.remove(id)
    }
}
