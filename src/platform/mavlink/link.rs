//! The thread that holds the connection: opens it again when it ends, reads within a budget, keeps the clocks compared.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use super::endpoint::Endpoint;
use super::frame::Kind;
use super::reader::{Event, Reader};
use super::signing::Signing;
use super::vehicle::Moment;
use crate::pose::PoseSigmas;

/// Longest wait for bytes, so that what is due is sent in time.
const WAIT: Duration = Duration::from_millis(20);
/// What is read within a slot, at most: reads, and bytes. An autopilot sends some hundred messages a second, 30 kB; this allows
/// 25,600 and 1.6 MB, and keeps a flood below a fifth of a core (`a_flood_costs_little_and_stops_nothing`).
const SLOT: Duration = Duration::from_millis(10);
const MOST_READS: usize = 256;
const MOST_BYTES: usize = 16_384;
/// A datagram is cut off here: no link carries more.
const BUFFER: usize = 4096;
/// Ten questions a second, as PX4 itself asks.
const TIMESYNC_EVERY: Duration = Duration::from_millis(100);
const HEARTBEAT_EVERY: Duration = Duration::from_secs(1);
/// Without a word from the autopilot for so long, a connection is opened anew.
const SILENCE: Duration = Duration::from_secs(5);
const FIRST_RETRY: Duration = Duration::from_millis(250);
/// Longest wait between two attempts: so much later an autopilot that is back is heard.
const LAST_RETRY: Duration = Duration::from_secs(2);
const CONNECT: Duration = Duration::from_secs(3);

/// What a link needs to know.
pub struct Settings {
    pub endpoint: Endpoint,
    /// The system id of the autopilot; the first that is heard, without.
    pub system_id: Option<u8>,
    pub signing: Option<Signing>,
    /// Where the autopilot states none.
    pub sigmas: PoseSigmas,
    /// Asks the autopilot for poses at this rate; left out, it sends what it is configured to send.
    pub request_hz: Option<f64>,
}

/// A connection to an autopilot, opened or still to be opened.
pub struct Link {
    settings: Settings,
    reader: Reader,
    transport: Option<Transport>,
    began: Instant,
}

enum Transport {
    Udp {
        socket: UdpSocket,
        peer: Option<SocketAddr>,
        /// Whether the kernel drops what others send.
        is_connected: bool,
    },
    Tcp(TcpStream),
}

impl Link {
    /// Opens a UDP port, or is ready to connect.
    ///
    /// # Errors
    /// The port of `udpin` cannot be had.
    pub fn open(mut settings: Settings) -> std::io::Result<Self> {
        let transport = match &settings.endpoint {
            Endpoint::UdpIn(_) => Some(Transport::open(&settings.endpoint)?),
            Endpoint::UdpOut(_) | Endpoint::Tcp(_) => None,
        };
        let reader = Reader::new(settings.system_id, settings.sigmas, settings.signing.take());
        Ok(Self {
            settings,
            reader,
            transport,
            began: Instant::now(),
        })
    }

    /// The port that is listened to.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        match &self.transport {
            Some(Transport::Udp { socket, .. }) => socket.local_addr().ok(),
            Some(Transport::Tcp(stream)) => stream.local_addr().ok(),
            None => None,
        }
    }

    /// Starts the thread that reads until `stop`, and hands on what it reads.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(
        self,
        stop: Arc<AtomicBool>,
        on_event: impl FnMut(Event, Moment, &Reader) + Send + 'static,
    ) -> std::io::Result<std::thread::JoinHandle<()>> {
        let thread = std::thread::Builder::new().name("mavlink".to_owned());
        thread.spawn(move || self.run(&stop, on_event))
    }

    fn run(mut self, stop: &AtomicBool, mut on_event: impl FnMut(Event, Moment, &Reader)) {
        let mut buffer = vec![0; BUFFER];
        let mut retry = FIRST_RETRY;
        let mut told: Option<String> = None;
        let mut heard = Instant::now();
        let mut due = Due::default();
        let mut slot = Slot::new();
        while !stop.load(Ordering::Relaxed) {
            let Some(transport) = &mut self.transport else {
                match Transport::open(&self.settings.endpoint) {
                    Ok(transport) => {
                        self.transport = Some(transport);
                        self.reader.reconnected();
                        (heard, told) = (Instant::now(), None);
                    }
                    Err(error) => {
                        let error = error.to_string();
                        if told.as_ref() != Some(&error) {
                            tracing::warn!("no telemetry: {:?}: {error}; trying again", self.settings.endpoint);
                        }
                        told = Some(error);
                        pause(retry, stop);
                        retry = (retry * 2).min(LAST_RETRY);
                    }
                }
                continue;
            };
            slot.keep();
            let moment = moment(self.began);
            if let Err(error) = due.send(transport, &mut self.reader, self.settings.request_hz, moment) {
                tracing::debug!("telemetry: {error}");
            }
            let outcome = transport.read(&mut buffer);
            // Late frames must not seem late: the time is that after the wait.
            let moment = self::moment(self.began);
            match outcome {
                Ok((count, from)) => {
                    slot.took(count);
                    let mut events = Vec::new();
                    let is_datagram = from.is_some();
                    let is_ours = match is_datagram {
                        true => self
                            .reader
                            .datagram(&buffer[..count], moment, &mut |event| events.push(event)),
                        false => self
                            .reader
                            .stream(&buffer[..count], moment, &mut |event| events.push(event)),
                    };
                    if is_ours {
                        (heard, retry) = (Instant::now(), FIRST_RETRY);
                        transport.adopt(from);
                    }
                    for event in events {
                        if let Event::Selected([system, component]) = event {
                            tracing::info!(
                                "telemetry: listening to system {system}, component {component}, and to no other"
                            );
                        }
                        on_event(event, moment, &self.reader);
                    }
                }
                Err(error) if is_wait(&error) => {}
                Err(error) => {
                    tracing::warn!("telemetry: {:?}: {error}; connecting again", self.settings.endpoint);
                    self.transport = None;
                    pause(retry, stop);
                    retry = (retry * 2).min(LAST_RETRY);
                    continue;
                }
            }
            if heard.elapsed() > SILENCE && transport.is_bound_to_one() {
                tracing::warn!("telemetry: the autopilot is silent; connecting again");
                self.transport = None;
            }
        }
    }
}

impl Transport {
    fn open(endpoint: &Endpoint) -> std::io::Result<Self> {
        let udp = |socket: UdpSocket, peer, is_connected| {
            socket.set_read_timeout(Some(WAIT))?;
            Ok(Self::Udp {
                socket,
                peer,
                is_connected,
            })
        };
        match endpoint {
            Endpoint::UdpIn(address) => udp(UdpSocket::bind(address)?, None, false),
            Endpoint::UdpOut(address) => {
                let address = resolved(address)?;
                let any: SocketAddr = match address.is_ipv4() {
                    true => ([0, 0, 0, 0], 0).into(),
                    false => ([0u16; 8], 0).into(),
                };
                let socket = UdpSocket::bind(any)?;
                socket.connect(address)?;
                udp(socket, Some(address), true)
            }
            Endpoint::Tcp(address) => {
                let stream = TcpStream::connect_timeout(&resolved(address)?, CONNECT)?;
                stream.set_read_timeout(Some(WAIT))?;
                stream.set_write_timeout(Some(WAIT))?;
                stream.set_nodelay(true)?;
                Ok(Self::Tcp(stream))
            }
        }
    }

    /// Bytes, and for a datagram from where.
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<(usize, Option<SocketAddr>)> {
        match self {
            Self::Udp { socket, .. } => socket.recv_from(buffer).map(|(count, from)| (count, Some(from))),
            Self::Tcp(stream) => match stream.read(buffer)? {
                0 => Err(ErrorKind::ConnectionAborted.into()),
                count => Ok((count, None)),
            },
        }
    }

    fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        match self {
            Self::Udp {
                socket,
                is_connected: true,
                ..
            } => socket.send(bytes).map(drop),
            Self::Udp {
                socket,
                peer: Some(peer),
                ..
            } => socket.send_to(bytes, *peer).map(drop),
            Self::Udp { .. } => Ok(()),
            Self::Tcp(stream) => stream.write_all(bytes),
        }
    }

    /// From now on only `from` is listened to: the kernel drops what others send before it costs anything.
    fn adopt(&mut self, from: Option<SocketAddr>) {
        if let Self::Udp {
            socket,
            peer,
            is_connected,
        } = self
            && !*is_connected
            && from.is_some()
        {
            *peer = from;
            *is_connected = from.is_some_and(|from| socket.connect(from).is_ok());
        }
    }

    /// Whether nothing can come but from one peer, so that another one needs a new connection.
    fn is_bound_to_one(&self) -> bool {
        match self {
            Self::Udp { is_connected, .. } => *is_connected,
            Self::Tcp(_) => true,
        }
    }
}

/// What is sent at intervals.
#[derive(Default)]
struct Due {
    timesync: Option<Instant>,
    heartbeat: Option<Instant>,
    requested: bool,
}

impl Due {
    fn send(
        &mut self,
        transport: &mut Transport,
        reader: &mut Reader,
        request_hz: Option<f64>,
        moment: Moment,
    ) -> std::io::Result<()> {
        let now = Instant::now();
        if is_due(&mut self.heartbeat, HEARTBEAT_EVERY, now) {
            transport.write(&reader.heartbeat(moment))?;
            // Asked anew with every heartbeat: an autopilot that restarts forgets it.
            for kind in [Kind::Odometry, Kind::AttitudeQuaternion, Kind::GlobalPositionInt] {
                if let Some(request) = request_hz.and_then(|hz| reader.request(kind, hz, moment)) {
                    transport.write(&request)?;
                    self.requested = true;
                }
            }
        }
        if reader.id().is_some() && is_due(&mut self.timesync, TIMESYNC_EVERY, now) {
            transport.write(&reader.timesync(moment))?;
        }
        Ok(())
    }
}

fn is_due(last: &mut Option<Instant>, every: Duration, now: Instant) -> bool {
    let is_due = last.is_none_or(|last| now.duration_since(last) >= every);
    if is_due {
        *last = Some(now);
    }
    is_due
}

/// Bounds what is read in a stretch of time; what is more waits in the kernel, and is dropped there.
struct Slot {
    began: Instant,
    reads: usize,
    bytes: usize,
}

impl Slot {
    fn new() -> Self {
        Self {
            began: Instant::now(),
            reads: 0,
            bytes: 0,
        }
    }

    fn took(&mut self, bytes: usize) {
        self.reads += 1;
        self.bytes += bytes;
    }

    /// Waits for the end of a slot that is used up.
    fn keep(&mut self) {
        let elapsed = self.began.elapsed();
        if elapsed < SLOT {
            if self.reads < MOST_READS && self.bytes < MOST_BYTES {
                return;
            }
            std::thread::sleep(SLOT - elapsed);
        }
        *self = Self::new();
    }
}

fn moment(began: Instant) -> Moment {
    // A second is added so that no request carries zero, which would make it no answer.
    let now = began.elapsed() + Duration::from_secs(1);
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Moment {
        now_ns: i64::try_from(now.as_nanos()).unwrap_or(i64::MAX),
        unix_ns: i64::try_from(unix.as_nanos()).unwrap_or(i64::MAX),
    }
}

fn resolved(address: &str) -> std::io::Result<SocketAddr> {
    let mut found = address.to_socket_addrs()?;
    found.next().ok_or_else(|| ErrorKind::AddrNotAvailable.into())
}

/// What a socket answers that has nothing to read, and what the peer's absence makes of a datagram.
fn is_wait(error: &std::io::Error) -> bool {
    use ErrorKind::{ConnectionRefused, Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), WouldBlock | TimedOut | Interrupted | ConnectionRefused)
}

fn pause(time: Duration, stop: &AtomicBool) {
    let end = Instant::now() + time;
    while !stop.load(Ordering::Relaxed) && Instant::now() < end {
        std::thread::sleep(WAIT.min(end.saturating_duration_since(Instant::now())));
    }
}
