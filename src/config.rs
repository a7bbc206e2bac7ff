//! The configuration file: composes the tables that each module defines, loads and validates them.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::estimate::Learned;
use crate::{
    api, calibrate, claims, estimate, export, fleet, frames, geo, journal, logging, monitor, notify, optics, platform,
    scene, toml_file,
};

/// A config file. Every table may be left out.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub optics: optics::Config,
    pub source: frames::Config,
    pub world: geo::Config,
    pub platform: platform::Config,
    pub record: frames::record::Config,
    pub claims: claims::Config,
    pub estimator: estimate::Config,
    pub monitor: monitor::Config,
    pub zone: Vec<monitor::zones::Config>,
    pub known_light: Vec<monitor::KnownLightConfig>,
    pub maintenance: Vec<monitor::MaintenanceConfig>,
    pub api: api::Config,
    pub journal: journal::Config,
    pub webhook: Vec<notify::Config>,
    pub export: Vec<export::Config>,
    pub fleet: fleet::Config,
    pub log: logging::Config,
    /// Keys that the file sets although the rest of it leaves them without effect; filled in by [`Config::load`].
    #[serde(skip)]
    pub unused: Vec<String>,
}

/// Share of the view from which ignored zones are warned of.
const MUCH_IGNORED: f64 = 0.1;

/// Why a config file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    File(#[from] toml_file::Error),
    #[error("optics.calibration: {0}")]
    Calibration(#[from] calibrate::file::Error),
    #[error("{path}: {source}")]
    Optics { path: PathBuf, source: optics::Error },
    #[error("{path}: {source}")]
    World { path: PathBuf, source: geo::ConfigError },
    #[error("{path}: {source}")]
    Platform {
        path: PathBuf,
        source: platform::ConfigError,
    },
    #[error("{path}: {source}")]
    Frames { path: PathBuf, source: frames::Error },
    #[error(
        "{path}: claims.origin: expected [world] origin = {{ latitude_deg, longitude_deg, height_m, datum }}, which replaces it"
    )]
    ClaimsOrigin { path: PathBuf },
    #[error("{path}: record.folder: expected a folder, since [record] is given; found nothing")]
    NoRecordFolder { path: PathBuf },
}

/// Why there is no camera.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    #[error(transparent)]
    Optics(#[from] optics::Error),
    #[error(transparent)]
    Scene(#[from] scene::Error),
}

impl Config {
    /// The camera of the frames: the scene's for a simulated scene without `[optics]`, else that of `[optics]`.
    pub fn camera(&self) -> Result<optics::Camera, CameraError> {
        let is_simulated = self.source.kind == frames::SourceKind::Simulator;
        let scene = self
            .source
            .scene
            .as_ref()
            .filter(|_| is_simulated && self.optics == optics::Config::default());
        Ok(match scene {
            Some(path) => scene::Scene::load(path)?.optics.camera()?,
            None => self.optics.camera()?,
        })
    }

    /// Names of the tables in which two configs differ.
    pub fn tables_that_differ(&self, other: &Self) -> Vec<String> {
        let tables = |config: &Self| toml::Table::try_from(config).expect("a config is plain TOML");
        let (mine, theirs) = (tables(self), tables(other));
        mine.iter()
            .filter(|(name, table)| theirs.get(*name) != Some(*table))
            .map(|(name, _)| name.clone())
            .collect()
    }

    /// Reads a config; relative paths in it are taken from the file's own folder.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let mut config = Self::load_uncalibrated(path)?;
        if let Some(path) = &config.optics.calibration {
            config.optics.calibrated = Some(calibrate::file::read(path)?);
        }
        Ok(config)
    }

    /// Reads a config without the calibration that it names.
    pub fn load_uncalibrated(path: &Path) -> Result<Self, Error> {
        let given: toml::Table = toml_file::read(path)?;
        if given.get("claims").is_some_and(|claims| claims.get("origin").is_some()) {
            return Err(Error::ClaimsOrigin { path: path.to_owned() });
        }
        let mut config: Self = toml_file::read(path)?;
        let base = path.parent().unwrap_or(Path::new("")).to_owned();
        config.rebase(&base);
        config.validate(path)?;
        config.claims.axes = config.world.axes();
        let scene = config.source.scene.as_ref();
        let scene = scene.filter(|_| config.source.kind == frames::SourceKind::Simulator);
        // A scene that cannot be read is refused where it is used.
        if let Some(scene) = scene.and_then(|path| scene::Scene::load(path).ok()) {
            config.adopt_platform(&scene);
        }
        if given.contains_key("record") && config.record.folder.is_none() {
            return Err(Error::NoRecordFolder { path: path.to_owned() });
        }
        config.unused = config.unused_among(&given);
        Ok(config)
    }

    /// A scene's platform that moves says where it is, unless `[platform]` tells otherwise.
    pub fn adopt_platform(&mut self, scene: &scene::Scene) {
        if let Some(moving) = &scene.platform
            && self.platform == platform::Config::default()
        {
            self.platform.kind = platform::Kind::Frames;
            self.platform.mount = moving.mount;
        }
    }

    /// Checks the numbers of the tables that do not check them where they are used.
    fn validate(&self, path: &Path) -> Result<(), Error> {
        self.optics.validate().map_err(|source| Error::Optics {
            path: path.to_owned(),
            source,
        })?;
        self.world.validate().map_err(|source| Error::World {
            path: path.to_owned(),
            source,
        })?;
        self.platform.validate().map_err(|source| Error::Platform {
            path: path.to_owned(),
            source,
        })?;
        let frames = self.source.validate().and_then(|()| self.record.check());
        frames.map_err(|source| Error::Frames {
            path: path.to_owned(),
            source,
        })
    }

    /// Keys among `given` that the chosen source or estimator does not use, each with the reason.
    fn unused_among(&self, given: &toml::Table) -> Vec<String> {
        let keys = |table: &str| {
            let table = given.get(table).and_then(toml::Value::as_table);
            table.into_iter().flat_map(|t| t.keys().map(String::as_str))
        };
        let kind = self.source.kind.name();
        let source = self.source.unused(keys("source"));
        let mut unused: Vec<String> = source
            .into_iter()
            .map(|key| format!("source.{key} has no effect with source.kind = {kind:?}"))
            .collect();
        let name = self.estimator.name.as_deref().unwrap_or(estimate::DEFAULT);
        let is_learned = Learned::ALL.iter().any(|l| l.name() == name);
        for key in keys("estimator") {
            let is_used = match key {
                "network" => is_learned,
                "known_power" => name == "map",
                "memory_s" => name == "sequence",
                _ => true,
            };
            if !is_used {
                unused.push(format!("estimator.{key} has no effect with estimator.name = {name:?}"));
            }
        }
        unused
    }

    /// What is probably a mistake in a config that can be used.
    pub fn warnings(&self, camera: &optics::Camera) -> Vec<String> {
        let mut warnings = self.unused.clone();
        let corner = camera.to_ground([camera.x.half_width(), camera.y.half_width()]);
        let diagonal = 2.0 * corner[0].hypot(corner[1]);
        let tolerated = self.monitor.tolerated_distance_m;
        if tolerated > diagonal {
            warnings.push(format!(
                "monitor.tolerated_distance_m = {tolerated}: no user in the field of view, {diagonal:.3} m across, can be that far from a claim"
            ));
        }
        warnings.extend(self.ignored_ground(camera));
        warnings
    }

    /// Zones in which a stranger raises nothing, where they are much of the view. A config whose zones cannot be used is refused
    /// elsewhere.
    fn ignored_ground(&self, camera: &optics::Camera) -> Option<String> {
        let zones = monitor::zones::load(&self.zone, self.world.axes().as_ref()).ok()?;
        let half = camera.to_ground([camera.x.half_width(), camera.y.half_width()]);
        let share = monitor::zones::ignored_share(zones, half);
        (share > MUCH_IGNORED).then(|| {
            let percent = (100.0 * share).round();
            format!("zone: those of kind \"ignore\" cover {percent} % of the view; a stranger there raises nothing")
        })
    }

    fn rebase(&mut self, base: &Path) {
        let credentials = std::env::var_os(&CREDENTIALS[1..]).map(PathBuf::from);
        let optional = [
            &mut self.optics.calibration,
            &mut self.estimator.network,
            &mut self.source.scene,
            &mut self.source.frames,
            &mut self.record.folder,
            &mut self.world.terrain,
            &mut self.platform.poses,
            &mut self.platform.signing_key_file,
            &mut self.claims.log,
            &mut self.api.token_file,
            &mut self.api.read_token_file,
            &mut self.api.tls_cert_file,
            &mut self.api.tls_key_file,
            &mut self.api.background.picture,
            &mut self.api.background.tiles,
            &mut self.journal.path,
            &mut self.fleet.ca_file,
            &mut self.fleet.credentials_file,
            &mut self.fleet.nkey_file,
        ];
        for path in optional.into_iter().flatten() {
            *path = located(base, path, credentials.as_deref());
        }
        if let api::Listen::Unix(path) = &mut self.api.listen {
            *path = located(base, path, credentials.as_deref());
        }
        for zone in &mut self.zone {
            if let Some(path) = &mut zone.geojson {
                *path = located(base, path, credentials.as_deref());
            }
        }
        for webhook in &mut self.webhook {
            let files = [Some(&mut webhook.secret_file), webhook.ca_file.as_mut()];
            for path in files.into_iter().flatten() {
                *path = located(base, path, credentials.as_deref());
            }
        }
        for export in &mut self.export {
            let files = [
                &mut export.ca_file,
                &mut export.client_cert_file,
                &mut export.client_key_file,
                &mut export.token_file,
            ];
            for path in files.into_iter().flatten() {
                *path = located(base, path, credentials.as_deref());
            }
        }
    }
}

/// Prefix of a path in a config that names a credential passed by systemd.
const CREDENTIALS: &str = "$CREDENTIALS_DIRECTORY";

/// Resolves a path of a config in the folder `base`. A credential stays as written where systemd passes none, so that the error
/// about the missing file names it.
fn located(base: &Path, path: &Path, credentials: Option<&Path>) -> PathBuf {
    match (path.strip_prefix(CREDENTIALS), credentials) {
        (Ok(name), Some(folder)) => folder.join(name),
        (Ok(_), None) => path.to_owned(),
        (Err(_), _) => base.join(path),
    }
}

#[cfg(test)]
#[path = "config_test.rs"]
mod tests;
