//! The scene file.

use std::collections::HashSet;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::effect::Effect;
use super::effects::{Effects, SpotEffect};
use super::error::Error;
use super::motion::{Motion, Schedule};
use super::platform::PlatformConfig;
use crate::toml_file::{Key, OutOfRange};
use crate::{optics, toml_file};

/// A scene file. Only `optics` and `link` have default values (the paper's); every other table has an effect only where the file
/// names it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Scene {
    /// Purpose of the scene, one sentence.
    pub about: String,
    pub rate_hz: f64,
    /// Effects that change no pixel by more than this share of σ_n may be left out.
    pub tolerance: f64,
    pub optics: optics::Config,
    pub link: LinkConfig,
    pub random_emitters: Option<RandomEmittersConfig>,
    pub user: Vec<UserConfig>,
    pub intruder: Vec<IntruderConfig>,
    pub claims: ClaimsConfig,
    /// Level over (0, 0) when left out.
    pub platform: Option<PlatformConfig>,
    pub effects: Effects,
}

/// Parameters common to all beams; the paper's values when left out.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkConfig {
    /// P.
    pub power_w: f64,
    /// w_z, the beam's 1/e² radius at the lens.
    pub beam_radius_m: f64,
    /// τ.
    pub transmittance: f64,
    /// η_s.
    pub efficiency: f64,
    /// T_int.
    pub integration_time_s: f64,
    /// T_coh, over which fading and pointing offset are constant.
    pub coherence_time_s: f64,
}

/// Emitters drawn anew for every frame: number and positions, both uniform.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RandomEmittersConfig {
    /// Smallest and largest number.
    pub count: [u32; 2],
    /// Width and height of the area they fall on, centred below the lens.
    pub area_m: [f64; 2],
}

/// A legitimate user: transmits and claims where it is.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UserConfig {
    pub name: String,
    pub motion: Motion,
    /// Claimed position, where it differs from the true one.
    pub claimed: Option<Motion>,
    #[serde(default)]
    pub present: Schedule,
    /// `false`: claims but does not transmit.
    #[serde(default = "yes")]
    pub beam: bool,
    pub power_w: Option<f64>,
}

/// A beam without a claim.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntruderConfig {
    pub name: String,
    pub motion: Motion,
    #[serde(default)]
    pub present: Schedule,
    pub power_w: Option<f64>,
}

/// How the network logs its users.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClaimsConfig {
    /// Time between two claims of a user; the first comes with the session.
    pub period_s: f64,
    /// The standard deviation per axis that a claim states.
    pub sigma_m: Option<f64>,
    /// Standard deviation per axis of the claimed position's error.
    pub noise_m: f64,
    /// A claim reaches the log this long after the time that it states, and up to `delay_spread_s` longer.
    pub delay_s: f64,
    pub delay_spread_s: f64,
    /// Share of claims that never arrive.
    pub lost: f64,
}

fn yes() -> bool {
    true
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            about: String::new(),
            rate_hz: 1.0,
            tolerance: 0.0,
            optics: optics::Config::default(),
            link: LinkConfig::default(),
            random_emitters: None,
            user: Vec::new(),
            intruder: Vec::new(),
            claims: ClaimsConfig::default(),
            platform: None,
            effects: Effects::default(),
        }
    }
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            power_w: 1.0,
            beam_radius_m: 0.6,
            transmittance: 0.9,
            efficiency: 0.9,
            integration_time_s: 1.0,
            coherence_time_s: 0.01,
        }
    }
}

impl Default for ClaimsConfig {
    fn default() -> Self {
        Self {
            period_s: 1.0,
            sigma_m: Some(0.3),
            noise_m: 0.0,
            delay_s: 0.0,
            delay_spread_s: 0.0,
            lost: 0.0,
        }
    }
}

impl Scene {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// The file cannot be read, is not TOML, has an unknown key (the nearest known one is named), or a field is out of
    /// range (the field is named).
    pub fn load(path: &Path) -> Result<Self, Error> {
        let mut scene: Self = toml_file::read(path)?;
        let spot_file = scene.effects.spot.as_mut().and_then(SpotEffect::file_mut);
        if let (Some(file), Some(folder)) = (spot_file, path.parent()) {
            *file = folder.join(&*file);
        }
        let log = scene.platform.as_mut().and_then(|platform| platform.log.as_mut());
        if let (Some(log), Some(folder)) = (log, path.parent()) {
            log.file = folder.join(&log.file);
        }
        match scene.validate() {
            Ok(()) => Ok(scene),
            Err(e) => Err(Error::Scene {
                path: path.to_owned(),
                reason: Box::new(e),
            }),
        }
    }

    /// The built-in scene, used when none is configured.
    pub fn builtin() -> Self {
        toml::from_str(include_str!("../../config/scenes/builtin.toml")).expect("a test reads the embedded scene")
    }

    /// The same scene without `effect`.
    pub fn without(&self, effect: Effect) -> Self {
        let mut scene = self.clone();
        scene.effects.remove(effect);
        if effect == Effect::Saturation {
            scene.optics.saturation_j = None;
        }
        scene
    }

    /// The same scene through a device whose spots are wider by `factor`.
    ///
    /// # Errors
    /// The spot is neither the Gaussian of `[optics] spot_sigma_m` nor a calibration's, or the width is out of range.
    pub fn with_width(&self, factor: f64) -> Result<Self, Error> {
        let mut scene = self.clone();
        let key = Key::new("effects.spot");
        match (&mut scene.effects.spot, &mut scene.optics.spot_sigma_m) {
            (Some(SpotEffect::Calibration { width, .. }), _) => *width *= factor,
            (None, Some(sigma)) => *sigma *= factor,
            (Some(other), _) => return Err(key.refuse("a spot of kind \"calibration\"", other.kind()).into()),
            (None, None) => return Err(Key::new("optics").at("spot_sigma_m").refuse("a width", "none").into()),
        }
        scene.validate().map(|()| scene)
    }

    /// Checks every field that the optics do not check themselves.
    pub fn validate(&self) -> Result<(), Error> {
        let root = Key::new("");
        root.at("rate_hz").positive(self.rate_hz)?;
        root.at("tolerance").non_negative(self.tolerance)?;
        self.optics.camera()?;
        self.link.validate(&root.at("link"), self.rate_hz)?;
        if let Some(random) = &self.random_emitters {
            random.validate(&root.at("random_emitters"))?;
        }
        self.claims.validate(&root.at("claims"))?;
        self.validate_names(&root)?;
        for (k, user) in self.user.iter().enumerate() {
            user.validate(&root.item("user", k))?;
        }
        for (k, intruder) in self.intruder.iter().enumerate() {
            self.validate_intruder(intruder, &root.item("intruder", k))?;
        }
        if let Some(platform) = &self.platform {
            platform.validate(&root.at("platform"))?;
        }
        let effects = root.at("effects");
        if let (Some(spot), Some(_)) = (&self.effects.spot, &self.effects.aberrations) {
            let expected = "no [effects.aberrations] beside it: a spot has one shape";
            return Err(effects.at("spot").refuse(expected, spot.kind()).into());
        }
        Ok(self.effects.validate(&effects)?)
    }

    fn validate_names(&self, root: &Key) -> Result<(), OutOfRange> {
        let mut seen = HashSet::new();
        let users = self.user.iter().enumerate().map(|(k, u)| ("user", k, &u.name));
        let intruders = self.intruder.iter().enumerate().map(|(k, i)| ("intruder", k, &i.name));
        for (table, k, name) in users.chain(intruders) {
            if name.is_empty() || !seen.insert(name) {
                return Err(root
                    .item(table, k)
                    .at("name")
                    .refuse("a name that no other emitter has", name));
            }
        }
        Ok(())
    }

    fn validate_intruder(&self, intruder: &IntruderConfig, field: &Key) -> Result<(), OutOfRange> {
        let motion = field.at("motion");
        intruder.motion.validate(&motion)?;
        if let Motion::Beside(beside) | Motion::AtClaimOf(beside) = &intruder.motion
            && !self.user.iter().any(|u| u.name == beside.user)
        {
            return Err(motion.at("user").refuse("the name of a [[user]]", &beside.user));
        }
        intruder.present.validate(&field.at("present"))?;
        validate_power(intruder.power_w, field)
    }
}

impl UserConfig {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        for (name, motion) in [("motion", Some(&self.motion)), ("claimed", self.claimed.as_ref())] {
            let Some(motion) = motion else { continue };
            let field = field.at(name);
            if let Motion::Beside(_) | Motion::AtClaimOf(_) = motion {
                return Err(field.refuse("a motion of its own (only an intruder can follow a user)", motion));
            }
            motion.validate(&field)?;
        }
        self.present.validate(&field.at("present"))?;
        validate_power(self.power_w, field)
    }
}

fn validate_power(power_w: Option<f64>, field: &Key) -> Result<(), OutOfRange> {
    power_w.map_or(Ok(()), |p| field.at("power_w").positive(p).map(drop))
}

impl LinkConfig {
    /// T_int/T_coh, rounded, at least 1.
    pub(super) fn coherence_times(&self) -> u32 {
        (self.integration_time_s / self.coherence_time_s).round().max(1.0) as u32
    }

    fn validate(&self, field: &Key, rate_hz: f64) -> Result<(), OutOfRange> {
        field.at("power_w").positive(self.power_w)?;
        field.at("beam_radius_m").positive(self.beam_radius_m)?;
        field.at("transmittance").fraction(self.transmittance)?;
        field.at("efficiency").fraction(self.efficiency)?;
        let coherence = field.at("coherence_time_s").positive(self.coherence_time_s)?;
        let exposure = field.at("integration_time_s").positive(self.integration_time_s)?;
        if exposure / coherence > 1e4 {
            return Err(field
                .at("coherence_time_s")
                .refuse("at least integration_time_s/10000", coherence));
        }
        if exposure * rate_hz > 1.0 + 1e-9 {
            return Err(field
                .at("integration_time_s")
                .refuse("at most 1/rate_hz, the time from frame to frame", exposure));
        }
        Ok(())
    }
}

impl ClaimsConfig {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("period_s").positive(self.period_s)?;
        if let Some(sigma) = self.sigma_m {
            field.at("sigma_m").positive(sigma)?;
        }
        field.at("noise_m").non_negative(self.noise_m)?;
        for (name, delay) in [("delay_s", self.delay_s), ("delay_spread_s", self.delay_spread_s)] {
            if field.at(name).non_negative(delay)? > 1000.0 * self.period_s {
                return Err(field.at(name).refuse("at most 1000 periods", delay));
            }
        }
        field.at("lost").fraction(self.lost).map(drop)
    }
}

impl RandomEmittersConfig {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        if self.count[0] > self.count[1] {
            return Err(field.at("count").refuse("[smallest, largest]", self.count));
        }
        if self.count[1] > 10_000 {
            return Err(field.at("count").refuse("at most 10000 emitters", self.count));
        }
        for side in self.area_m {
            field.at("area_m").positive(side)?;
        }
        Ok(())
    }
}
