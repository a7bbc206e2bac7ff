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
mod tests {
    use super::*;

    #[test]
    fn paths_lead_from_the_config_s_folder_or_to_a_credential() {
        let base = Path::new("/etc/oapwatch");
        let credentials = Some(Path::new("/run/credentials/oapwatch.service"));
        for (written, credentials, expected) in [
            ("token", credentials, "/etc/oapwatch/token"),
            ("/srv/token", credentials, "/srv/token"),
            (
                "$CREDENTIALS_DIRECTORY/oapwatch_token",
                credentials,
                "/run/credentials/oapwatch.service/oapwatch_token",
            ),
            (
                "$CREDENTIALS_DIRECTORY/oapwatch_token",
                None,
                "$CREDENTIALS_DIRECTORY/oapwatch_token",
            ),
            (
                "$CREDENTIALS_DIRECTORY2/x",
                credentials,
                "/etc/oapwatch/$CREDENTIALS_DIRECTORY2/x",
            ),
        ] {
            assert_eq!(located(base, Path::new(written), credentials), Path::new(expected));
        }
    }

    /// The example with its commented keys and tables in force.
    fn in_full(text: &str) -> String {
        let is_setting = |line: &&str| {
            let rest = line.strip_prefix("# ").unwrap_or(line);
            let key = rest.split(" = ").next().unwrap_or_default();
            let is_key = rest.contains(" = ") && key.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
            is_key || rest.starts_with('[')
        };
        let lines = text.lines().filter(is_setting);
        lines
            .map(|line| line.trim_start_matches("# ").to_owned() + "\n")
            .collect()
    }

    /// The keys that serde expects in a table.
    fn keys_of(table: &str) -> Vec<String> {
        let error = toml::from_str::<Config>(&format!("{table}\nno_such_key = 1\n")).expect_err("an unknown key");
        let names = error.message().split('`').skip(1).step_by(2).skip(1);
        names.map(str::to_owned).collect()
    }

    #[test]
    fn the_example_configs_name_every_key_and_only_such() {
        for text in [
            include_str!("../config/default.toml"),
            include_str!("../deploy/oapwatch.toml"),
        ] {
            toml::from_str::<Config>(text).unwrap();
            let full = in_full(text);
            toml::from_str::<Config>(&full).unwrap_or_else(|e| panic!("{e}\n{full}"));
            let table: toml::Table = toml::from_str(&full).unwrap();
            let mut tables: Vec<(String, toml::Table)> = vec![(String::new(), table)];
            while let Some((name, table)) = tables.pop() {
                let header = match name.as_str() {
                    "" => String::new(),
                    "webhook" | "export" | "zone" | "known_light" | "maintenance" => format!("[[{name}]]"),
                    name => format!("[{name}]"),
                };
                for key in keys_of(&header) {
                    assert!(table.contains_key(&key), "{header} lacks {key}");
                }
                for (key, value) in table {
                    let below = format!("{name}.{key}").trim_start_matches('.').to_owned();
                    match value {
                        toml::Value::Table(inner) => tables.push((below, inner)),
                        toml::Value::Array(list) => {
                            let inner = list.into_iter().filter_map(|v| v.try_into::<toml::Table>().ok());
                            tables.extend(inner.map(|table| (below.clone(), table)));
                        }
                        _ => {}
                    }
                }
            }
        }
    }

    fn loaded(text: &str) -> Result<Config, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("oapwatch.toml");
        std::fs::write(&path, text).unwrap();
        Config::load(&path).map_err(|e| e.to_string())
    }

    #[test]
    fn a_number_out_of_range_is_refused_with_the_reason() {
        for (text, expected) in [
            ("[optics]\nspot_sigma_m = 10", "optics.spot_sigma_m: expected"),
            ("[optics]\naltitude_m = 3e8", "optics.altitude_m: expected"),
            ("[optics]\nsaturation_j = 1e-9", "optics.saturation_j: expected"),
            ("[source]\nrate_hz = -5", "source.rate_hz: expected"),
            ("[source]\nkind = \"replay\"\nspeed = -1", "source.speed: expected"),
            ("[source.v4l2]\nstall_s = 0", "source.v4l2.stall_s: expected"),
            (
                "[world]\norigin = { latitude_deg = 91, longitude_deg = 0, height_m = 0, datum = \"msl\" }",
                "world.origin.latitude_deg: expected",
            ),
            (
                "[platform]\nmount = { yaw_deg = 1000 }",
                "platform.mount.yaw_deg: expected",
            ),
            ("[platform]\nkind = \"replay\"", "platform.poses: expected"),
            ("[platform]\npose_lost_s = 0", "platform.pose_lost_s: expected"),
            ("[record]\nlimit_mb = 10", "record.folder: expected a folder"),
            ("[record]\nfolder = \"r\"\nbefore_s = 1e9", "record.before_s: expected"),
        ] {
            let error = loaded(text).expect_err(text);
            assert!(error.contains(expected) && error.contains("found"), "{text}: {error}");
        }
        let origin = "[claims.origin]\nlatitude_deg = 48\nlongitude_deg = 11";
        assert!(loaded(origin).expect_err("replaced").contains("[world] origin"));
        let undated = "[world]\norigin = { latitude_deg = 48, longitude_deg = 11, height_m = 5 }";
        assert!(loaded(undated).expect_err("no datum").contains("datum"));
        loaded("[optics]\nspot_sigma_m = 0.01\n[record]\nfolder = \"r\"").unwrap();
    }

    #[test]
    fn keys_without_effect_are_named() {
        let config = loaded(
            "[source]\nkind = \"replay\"\nframes = \"f.npy\"\ndevice = \"/dev/video0\"\nseed = 3\n\
             [estimator]\nname = \"ml\"\nnetwork = \"n.onnx\"\n[monitor]\ntolerated_distance_m = 5000",
        );
        let config = config.unwrap();
        let warnings = config.warnings(&config.camera().unwrap());
        let named: Vec<&str> = warnings.iter().filter_map(|w| w.split_whitespace().next()).collect();
        assert_eq!(
            named,
            [
                "source.device",
                "source.seed",
                "estimator.network",
                "monitor.tolerated_distance_m"
            ]
        );
        let plain = loaded("[source]\nseed = 3").unwrap();
        assert_eq!(plain.warnings(&plain.camera().unwrap()), [""; 0]);
    }
}
