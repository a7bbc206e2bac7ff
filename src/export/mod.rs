//! Layer 4: alerts and positions in other systems' formats: syslog, Alertmanager, Cursor on Target, SAPIENT.
//!
//! Alert events go through the journal's outbox like webhooks, with the same retries, status and metrics: an export is one more
//! [`Channel`]. What is sent beside them (open alerts again) is the latest only, and never queued.

mod address;
mod alertmanager;
mod cef;
mod config;
mod cot;
mod link;
mod place;
mod sapient;
mod syslog;
mod tls;
mod updates;
mod words;

use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinSet;

use crate::geo;
use crate::notify::{self, Channel, Endpoint};
use address::Address;
use alertmanager::Alertmanager;
use cot::Cot;
use place::World;
use sapient::Sapient;
use syslog::Syslog;

pub use config::{Config, Error, Format, Kind};
pub use updates::{Context, Updates};

/// An `[[export]]` that can be sent to.
#[derive(Debug)]
pub struct Export {
    /// Alert events.
    pub endpoint: Endpoint,
    /// What is sent beside them.
    pub updates: Option<Arc<dyn Updates>>,
}

/// Validates all `[[export]]` tables and reads their files. Names must differ from those of `webhooks` too.
/// `world` places them on the earth, for the kinds that know latitudes only.
pub fn load(configs: &[Config], webhooks: &[Endpoint], world: &geo::Config) -> Result<Vec<Export>, Error> {
    let mut exports: Vec<Export> = Vec::with_capacity(configs.len());
    for (k, config) in configs.iter().enumerate() {
        let index = k + 1;
        let export = Export::load(config, world).map_err(|problem| Error { index, problem })?;
        let name = &export.endpoint.name;
        let mut taken = exports.iter().map(|e| &e.endpoint).chain(webhooks);
        if taken.any(|other| other.name == *name) {
            let problem =
                format!("name: `{name}` is taken by another export or webhook; give one of them another name");
            return Err(Error { index, problem });
        }
        exports.push(export);
    }
    Ok(exports)
}

impl Export {
    fn load(config: &Config, world: &geo::Config) -> Result<Self, String> {
        notify::check_common(
            config.name.as_deref(),
            config.kinds.as_deref(),
            config.timeout_s,
            config.cool_down_s,
        )
        .map_err(|cause| cause.to_string())?;
        config.check_unused()?;
        let address = Address::parse(config)?;
        let kind = config.kind.name();
        let name = config.name.clone();
        let name = name.unwrap_or_else(|| notify::name_of(kind, &address.url));
        let station = config.station()?;
        let world = || {
            let origin = world
                .origin
                .ok_or("kind: expected [world] origin, which places positions on the earth; found none")?;
            Ok::<_, String>(World::new(origin))
        };
        let (channel, updates): (Arc<dyn Channel>, Option<Arc<dyn Updates>>) = match config.kind {
            Kind::Syslog => (Arc::new(Syslog::new(config, &address, station)?), None),
            Kind::Alertmanager => both(Alertmanager::new(config, &address, station)?),
            Kind::Cot => both(Cot::new(config, &address, station, world()?)?),
            Kind::Sapient => both(Sapient::new(config, &address, name.clone(), station, world()?)?),
        };
        let endpoint = Endpoint {
            name,
            kind,
            shown_url: notify::shown_url(&address.url),
            kinds: config.kinds.clone(),
            has_operator_acts: matches!(config.kind, Kind::Syslog | Kind::Sapient),
            cool_down: Duration::from_secs_f64(config.cool_down_s),
            timeout: Duration::from_secs_f64(config.timeout_s),
            channel,
        };
        Ok(Self { endpoint, updates })
    }
}

/// What delivers alert events and sends updates beside them.
fn both<T: Channel + Updates + 'static>(export: T) -> (Arc<dyn Channel>, Option<Arc<dyn Updates>>) {
    let export = Arc::new(export);
    (export.clone(), Some(export))
}

/// The updates under way; dropped, they stop.
pub struct Running {
    tasks: JoinSet<()>,
    context: Context,
}

impl Running {
    pub fn new(context: Context) -> Self {
        Self {
            tasks: JoinSet::new(),
            context,
        }
    }

    /// Sends the updates of these exports from now on, in place of those before. Gives their endpoints.
    pub fn replace(&mut self, exports: Vec<Export>) -> Vec<Endpoint> {
        self.tasks.abort_all();
        for Export { endpoint, updates } in &exports {
            if let Some(updates) = updates.clone() {
                let (name, context) = (endpoint.name.clone(), self.context.clone());
                self.tasks.spawn(updates::run(name, updates, endpoint.timeout, context));
            }
        }
        exports.into_iter().map(|export| export.endpoint).collect()
    }
}
