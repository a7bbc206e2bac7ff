use jiff::{SignedDuration, Timestamp};
use ndarray::Array2;

use super::config::Scene;
use super::effects::{Effects, ThermalNoise};
use super::error::Error;
use super::network::Network;
use super::population::{Beam, Population};
use super::render::{Renderer, Spot};
use super::stream::{Effect, Ledger, Streams};
use super::truth::{EmitterTruth, Role, SimulatedFrame, Truth};
use crate::claim::Claim;
use crate::frame::Frame;
use crate::optics::Camera;

/// A scene compiled, with a seed, into the chain that makes its frames.
#[derive(Debug)]
pub struct Plan {
    camera: Camera,
    rate_hz: f64,
    start: Timestamp,
    streams: Streams,
    population: Population,
    network: Network,
    link: Link,
    noise_std_j: Option<f64>,
}

/// From a beam to the energy of its spot.
#[derive(Debug)]
struct Link {
    /// T_int · η_s · τ · (2/(π w_z²)) · π r_a²: energy per watt of a beam that is straight above and does not miss, J/W.
    straight_j_per_w: f64,
    beam_radius_m: f64,
    /// T_int/T_coh.
    coherence_times: u32,
    effects: Effects,
}

impl Plan {
    /// # Errors
    /// A field of the scene is out of range; it is named.
    pub fn compile(scene: &Scene, seed: u64) -> Result<Self, Error> {
        scene.validate()?;
        let camera = scene.optics.camera()?;
        let streams = Streams { seed };
        let link = &scene.link;
        let thermal = &scene.effects.thermal_noise;
        Ok(Self {
            rate_hz: scene.rate_hz,
            start: Timestamp::UNIX_EPOCH,
            streams,
            population: Population::new(scene, streams, &Ledger::default()),
            network: Network::new(scene.claims.clone()),
            noise_std_j: thermal.as_ref().map(|t| t.std_j.unwrap_or(camera.noise_std_j)),
            link: Link {
                straight_j_per_w: link.integration_time_s
                    * link.efficiency
                    * link.transmittance
                    * 2.0
                    * (camera.lens_radius_m / link.beam_radius_m).powi(2),
                beam_radius_m: link.beam_radius_m,
                coherence_times: (link.integration_time_s / link.coherence_time_s).round().max(1.0) as u32,
                effects: scene.effects.clone(),
            },
            camera,
        })
    }

    /// The same plan with frame 0 at `start` (the Unix epoch otherwise).
    pub fn starting_at(self, start: Timestamp) -> Self {
        Self { start, ..self }
    }

    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Time of frame `k`, the middle of its exposure: start + k/rate.
    pub fn time(&self, k: u64) -> Timestamp {
        self.date(self.seconds(k))
    }

    /// Frame `k` with its truth and the claims that arrived since frame k − 1. Needs no other frame; the same seed gives
    /// the same bits.
    pub fn frame(&self, k: u64) -> SimulatedFrame {
        self.frame_counting(k, &Ledger::default())
    }

    /// [`Plan::frame`], entering in `ledger` how many random words each effect drew.
    pub fn frame_counting(&self, k: u64, ledger: &Ledger) -> SimulatedFrame {
        let t = self.seconds(k);
        let mut beams = Vec::new();
        self.population.beams(k, t, self.streams, ledger, &mut beams);

        let mut pixels = Array2::zeros(self.camera.shape());
        let slice = pixels.as_slice_mut().expect("a fresh array is contiguous");
        let mut renderer = Renderer::new(&self.camera);
        let mut emitters = Vec::with_capacity(beams.len());
        for beam in &beams {
            let energy_j = self.energy(beam, k, ledger);
            let spot = Spot {
                centre: self.camera.to_sensor(beam.ground),
                energy_j,
            };
            renderer.add(&self.camera, spot, slice);
            emitters.push(self.truth(beam, energy_j));
        }
        if let Some(std_j) = self.noise_std_j {
            let mut stream = self.streams.open(Effect::ThermalNoise, 0, k, ledger);
            ThermalNoise::add(std_j, slice, &mut *stream);
        }

        let time = self.time(k);
        SimulatedFrame {
            frame: Frame {
                index: k,
                time,
                pixels,
                masked: None,
            },
            truth: Truth {
                frame: k,
                time,
                emitters,
            },
            claims: self.claims(k),
        }
    }

    /// Collected energy of a beam's whole spot in frame `k`, J (`lens_power_user`, integrated over T_int).
    fn energy(&self, beam: &Beam, k: u64, ledger: &Ledger) -> f64 {
        let link = &self.link;
        let h = self.camera.altitude_m;
        let length_m = h.hypot(beam.ground[0].hypot(beam.ground[1]));
        let mut energy = link.straight_j_per_w * beam.power_w * h / length_m;
        if let Some(attenuation) = &link.effects.attenuation {
            energy *= attenuation.transmittance(length_m);
        }
        energy * self.averaged_factor(beam.entity, k, ledger)
    }

    /// Mean over the exposure of ρ·exp(−2‖r_p‖²/w_z²): one factor, because the spot stays where it is meanwhile.
    fn averaged_factor(&self, entity: u64, k: u64, ledger: &Ledger) -> f64 {
        let effects = &self.link.effects;
        let mut fading = effects.fading.as_ref().map(|f| {
            let stream = self.streams.open(Effect::Fading, entity, k, ledger);
            (f.distribution(), stream)
        });
        let mut pointing = effects.pointing.as_ref().map(|p| {
            let stream = self.streams.open(Effect::Pointing, entity, k, ledger);
            (p, stream)
        });
        if fading.is_none() && pointing.is_none() {
            return 1.0;
        }
        let w2 = self.link.beam_radius_m.powi(2);
        let values = (0..self.link.coherence_times).map(|_| {
            let rho = fading.as_mut().map_or(1.0, |(distribution, stream)| {
                rand_distr::Distribution::sample(distribution, &mut **stream)
            });
            let captured = pointing.as_mut().map_or(1.0, |(pointing, stream)| {
                libm::exp(-2.0 * pointing.squared_miss(&mut **stream) / w2)
            });
            rho * captured
        });
        values.sum::<f64>() / f64::from(self.link.coherence_times)
    }

    fn truth(&self, beam: &Beam, energy_j: f64) -> EmitterTruth {
        let actor = beam.actor.map(|a| &self.population.actors[a]);
        EmitterTruth {
            x_m: beam.ground[0],
            y_m: beam.ground[1],
            energy_j,
            user: actor.map(|a| a.name.clone()),
            role: actor.map_or(Role::Random, |a| a.role),
            in_view: self.camera.sees(beam.ground),
        }
    }

    /// The claims that arrived after frame k − 1 and not after frame k.
    pub fn claims(&self, k: u64) -> Vec<Claim> {
        let after = if k == 0 { f64::NEG_INFINITY } else { self.seconds(k - 1) };
        let arrivals = self
            .network
            .arrivals(&self.population, after.max(-1e9), self.seconds(k));
        let claim = |s: super::network::Statement| Claim {
            time: self.date(s.stated),
            user: self.population.actors[s.actor].name.clone(),
            x_m: s.at_m[0],
            y_m: s.at_m[1],
            sigma_m: self.network.sigma_m(),
            state: s.state,
        };
        arrivals.into_iter().map(claim).collect()
    }

    fn seconds(&self, k: u64) -> f64 {
        k as f64 / self.rate_hz
    }

    fn date(&self, seconds: f64) -> Timestamp {
        let since = SignedDuration::try_from_secs_f64(seconds).unwrap_or(SignedDuration::MAX);
        self.start.checked_add(since).unwrap_or(Timestamp::MAX)
    }
}
