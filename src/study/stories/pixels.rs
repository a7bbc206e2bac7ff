//! Scenes rendered by the program's own simulator, pixel by pixel, through estimator, tracks and verdicts.

use super::start;
use crate::config::Config;
use crate::monitor::{AlertEvent, AlertEventKind, AlertKind, Report};
use crate::pipeline::Pipeline;
use crate::platform::Placement;
use crate::scene::{Fate, Plan, Scene, SimulatedFrame, Truth};

pub const RATE_HZ: f64 = 10.0;

/// The paper's optics at σ_eff = 1 mm on 40 × 40 pixels, its fading and pointing, and five honest users.
const COMMON: &str = r#"
rate_hz = 10.0
[optics]
pixels = [40, 40]
spot_sigma_m = 0.001
noise_std_j = 1.0e-6
[link]
integration_time_s = 0.1
[claims]
noise_m = 0.3
sigma_m = 0.3
[effects]
attenuation = { kappa_per_m = 0.001 }
fading = { alpha = 4.0, beta = 2.0 }
pointing = { jitter_m = 0.1 }
thermal_noise = {}
"#;

const USERS: &str = r#"
[[user]]
name = "u-1"
motion.walk = { through_m = [[-80, -60], [-20, -70], [-40, -10]], speed_m_s = 1.4 }
[[user]]
name = "u-2"
motion.still = [60, -50]
[[user]]
name = "u-3"
motion.walk = { through_m = [[40, 60], [90, 70], [70, 20]], speed_m_s = 1.2 }
[[user]]
name = "u-4"
motion.still = [-70, 60]
"#;

/// Four more who mill about within two spot widths.
pub const CROWD: &str = r#"
[[user]]
name = "r-1"
motion.roam = { home_m = [0, 0], spread_m = 12, time_s = 12 }
[[user]]
name = "r-2"
motion.roam = { home_m = [10, 5], spread_m = 12, time_s = 12 }
[[user]]
name = "r-3"
motion.roam = { home_m = [3, 9], spread_m = 12, time_s = 20 }
[[user]]
name = "r-4"
motion.roam = { home_m = [-6, 4], spread_m = 12, time_s = 9 }
"#;

/// Users, strangers and what happens to the frames.
pub struct PixelStory {
    scene: Scene,
    pub seed: u64,
    pub seconds: f64,
    pub config: Config,
    /// What happens to a frame and its claims on their way.
    pub tamper: Box<dyn Fn(f64, &mut SimulatedFrame)>,
}

impl PixelStory {
    /// Four honest users and whoever else `toml` names.
    pub fn with(seed: u64, toml: &str) -> Self {
        Self::of(seed, &format!("{COMMON}{USERS}{toml}"))
    }

    /// Only those whom `toml` names.
    pub fn only(seed: u64, toml: &str) -> Self {
        Self::of(seed, &format!("{COMMON}{toml}"))
    }

    /// A scene file.
    pub fn file(seed: u64, path: &std::path::Path) -> Result<Self, crate::scene::Error> {
        Ok(Self::told_by(seed, Scene::load(path)?))
    }

    pub fn change(&mut self, change: impl FnOnce(&mut Scene)) {
        change(&mut self.scene);
    }

    /// The story's pixels alone.
    pub fn frames(&self) -> Vec<ndarray::Array2<f64>> {
        let plan = Plan::compile(&self.scene, self.seed).expect("a scene that can be simulated");
        let frames = 0..(self.seconds * self.scene.rate_hz) as u64;
        frames.map(|k| plan.frame(k).frame.pixels).collect()
    }

    /// A scene as it stands.
    pub fn of(seed: u64, toml: &str) -> Self {
        Self::told_by(seed, toml::from_str(toml).expect("a scene"))
    }

    /// What makes the frames, and what is told of them.
    pub fn open(&self) -> (Plan, Pipeline) {
        let plan = Plan::compile(&self.scene, self.seed).expect("a scene that can be simulated");
        let plan = plan.starting_at(start());
        let mut config = self.config.clone();
        config.source.rate_hz = Some(self.scene.rate_hz);
        config.adopt_platform(&self.scene);
        let pipeline = Pipeline::new(&config, plan.camera()).expect("a config that describes a pipeline");
        (plan, pipeline)
    }

    fn told_by(seed: u64, scene: Scene) -> Self {
        Self {
            scene,
            seed,
            seconds: 20.0,
            config: Config::default(),
            tamper: Box::new(|_, _| {}),
        }
    }
}

/// What the program said of a story.
pub struct Reviewed {
    pub events: Vec<AlertEvent>,
    pub reports: Vec<Report>,
    pub truths: Vec<Truth>,
    /// How late poses were taken to be, s; where there are none, zero.
    pub delays_s: Vec<f64>,
}

/// Every frame of the story through the daemon's pipeline.
pub fn review(story: &PixelStory) -> Reviewed {
    let (plan, mut pipeline) = story.open();
    let rate_hz = story.scene.rate_hz;
    let mut told = Reviewed {
        events: Vec::new(),
        reports: Vec::new(),
        truths: Vec::new(),
        delays_s: Vec::new(),
    };
    let mut maker = plan.maker();
    for k in 0..(story.seconds * rate_hz) as u64 {
        let mut made = maker.frame(k);
        if made.fate == Fate::Dropped {
            pipeline.claim(made.claims, made.frame.time);
            pipeline.receive_poses(made.poses, made.frame.time);
            continue;
        }
        (story.tamper)(k as f64 / rate_hz, &mut made);
        pipeline.claim(made.claims, made.frame.time);
        pipeline.receive_poses(made.poses, made.frame.time);
        let step = pipeline.step(&made.frame);
        told.delays_s.push(match &step.placement {
            Placement::At { pose, .. } => crate::time::seconds(made.frame.time, pose.pose.time),
            _ => 0.0,
        });
        told.events.extend(step.report.events.iter().cloned());
        told.reports.push(step.report);
        told.truths.push(made.truth);
    }
    told
}

impl Reviewed {
    /// (kind, user, seconds) of every alert raised.
    pub fn raised(&self) -> Vec<(AlertKind, Option<String>, f64)> {
        self.events
            .iter()
            .filter(|e| e.event == AlertEventKind::Raised)
            .map(|e| {
                let at = e.alert.raised_at.duration_since(start()).as_secs_f64();
                (e.alert.kind, e.alert.user.clone(), at)
            })
            .collect()
    }

    /// When alerts were cleared, s.
    pub fn cleared(&self) -> Vec<f64> {
        self.events
            .iter()
            .filter(|e| e.event == AlertEventKind::Cleared)
            .filter_map(|e| e.alert.cleared_at)
            .map(|t| t.duration_since(start()).as_secs_f64())
            .collect()
    }
}
