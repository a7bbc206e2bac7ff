//! Bytes to poses, without a socket: finds frames, checks whose they are and that they are signed, hands them to the vehicle.

use super::clock::Relation;
use super::frame::{self, Found, Kind};
use super::refusal::Refusal;
use super::signing::Signing;
use super::vehicle::{AUTOPILOT_INVALID, Moment, Sample, Update, Vehicle};
use crate::pose::PoseSigmas;

/// Our component id: an on-board computer, the last of the four.
const OUR_COMPONENT: u8 = 194;
/// Our system id as long as no autopilot has been heard.
const OUR_SYSTEM: u8 = 255;
const TYPE_ONBOARD_CONTROLLER: u8 = 18;
const STATE_ACTIVE: u8 = 4;
const SET_MESSAGE_INTERVAL: u16 = 511;

/// What came out of some bytes.
#[derive(Debug, PartialEq)]
pub enum Event {
    Pose(Box<Sample>),
    /// This system and component are listened to from now on.
    Selected([u8; 2]),
    Refused(Refusal),
}

/// Reads one autopilot's bytes, and writes what it is asked.
pub struct Reader {
    vehicle: Vehicle,
    signing: Option<Signing>,
    /// A stream's beginning of a frame.
    rest: Vec<u8>,
    sequence: u8,
}

impl Reader {
    /// Listens to the system `system_id`, or to the first autopilot; with `signing` only to frames signed with its key.
    pub fn new(system_id: Option<u8>, sigmas: PoseSigmas, signing: Option<Signing>) -> Self {
        Self {
            vehicle: Vehicle::new(system_id, sigmas),
            signing,
            rest: Vec::with_capacity(2 * frame::LONGEST),
            sequence: 0,
        }
    }

    /// The system and component that are listened to.
    pub fn id(&self) -> Option<[u8; 2]> {
        self.vehicle.id()
    }

    pub fn relation(&self, now_ns: i64) -> Relation {
        self.vehicle.relation(now_ns)
    }

    /// Takes a datagram: whole frames, one or more. Returns whether one of them is from the autopilot.
    pub fn datagram(&mut self, bytes: &[u8], moment: Moment, on_event: &mut impl FnMut(Event)) -> bool {
        let (read, is_ours) = self.frames(bytes, moment, on_event);
        if read < bytes.len() {
            on_event(Event::Refused(Refusal::Malformed));
        }
        is_ours
    }

    /// Takes the next bytes of a stream. Returns whether a frame from the autopilot was among them.
    pub fn stream(&mut self, bytes: &[u8], moment: Moment, on_event: &mut impl FnMut(Event)) -> bool {
        let mut rest = std::mem::take(&mut self.rest);
        rest.extend_from_slice(bytes);
        let (read, is_ours) = self.frames(&rest, moment, on_event);
        rest.drain(..read);
        self.rest = rest;
        is_ours
    }

    /// Forgets half a frame: another connection begins.
    pub fn reconnected(&mut self) {
        self.rest.clear();
    }

    fn frames(&mut self, bytes: &[u8], moment: Moment, on_event: &mut impl FnMut(Event)) -> (usize, bool) {
        let (mut read, mut is_ours) = (0, false);
        loop {
            let (length, found) = frame::read(&bytes[read..]);
            match found {
                Found::Incomplete => return (read, is_ours),
                Found::Unread => {}
                Found::Refused(why) => on_event(Event::Refused(why)),
                Found::Frame(frame) => match self.frame(&frame, moment) {
                    Ok(what) => {
                        is_ours |= self.vehicle.id() == Some([frame.system, frame.component]);
                        match what {
                            Update::Pose(sample) => on_event(Event::Pose(sample)),
                            Update::Selected(id) => on_event(Event::Selected(id)),
                            Update::Other => {}
                        }
                    }
                    Err(why) => on_event(Event::Refused(why)),
                },
            }
            read += length;
        }
    }

    fn frame(&mut self, frame: &frame::Frame, moment: Moment) -> Result<Update, Refusal> {
        // First what costs least: a flood is another system's, or unsigned.
        if !self.vehicle.may_take(frame) {
            return Err(Refusal::OtherSystem);
        }
        if let Some(signing) = &mut self.signing {
            signing.check(frame, unix_us(moment))?;
        }
        self.vehicle.take(frame, moment)
    }

    /// A question for the autopilot's time.
    pub fn timesync(&mut self, moment: Moment) -> Vec<u8> {
        self.vehicle.clock.requested(moment.now_ns);
        let mut payload = [0; 16];
        payload[8..].copy_from_slice(&moment.now_ns.to_le_bytes());
        self.build(Kind::Timesync, &payload, moment)
    }

    pub fn heartbeat(&mut self, moment: Moment) -> Vec<u8> {
        let payload = [
            0,
            0,
            0,
            0,
            TYPE_ONBOARD_CONTROLLER,
            AUTOPILOT_INVALID,
            0,
            STATE_ACTIVE,
            3,
        ];
        self.build(Kind::Heartbeat, &payload, moment)
    }

    /// Asks the autopilot to send `kind` so often; `None` while none has been heard.
    pub fn request(&mut self, kind: Kind, rate_hz: f64, moment: Moment) -> Option<Vec<u8>> {
        let [system, component] = self.vehicle.id()?;
        let mut payload = [0; 33];
        payload[..4].copy_from_slice(&(kind.definition().0 as f32).to_le_bytes());
        payload[4..8].copy_from_slice(&((1e6 / rate_hz) as f32).to_le_bytes());
        payload[28..30].copy_from_slice(&SET_MESSAGE_INTERVAL.to_le_bytes());
        [payload[30], payload[31]] = [system, component];
        Some(self.build(Kind::CommandLong, &payload, moment))
    }

    fn build(&mut self, kind: Kind, payload: &[u8], moment: Moment) -> Vec<u8> {
        let system = self.vehicle.id().map_or(OUR_SYSTEM, |[system, _]| system);
        self.sequence = self.sequence.wrapping_add(1);
        let from = [system, OUR_COMPONENT];
        let mut frame = frame::build(kind, from, self.sequence, payload, self.signing.is_some());
        if let Some(signing) = &mut self.signing {
            signing.sign(&mut frame, unix_us(moment));
        }
        frame
    }
}

fn unix_us(moment: Moment) -> u64 {
    u64::try_from(moment.unix_ns / 1000).unwrap_or(0)
}
