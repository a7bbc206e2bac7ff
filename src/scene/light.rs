//! Converts a beam to its spots on the sensor during one exposure.

use super::average::Average;
use super::config::Scene;
use super::effect::Effect;
use super::effects::{Attenuation, Vignetting};
use super::effects::{Pose, Rays, SpotImages, attitude};
use super::error::Error;
use super::exposure::Exposure;
use super::moment::Moment;
use super::platform::{Flight, Sight};
use super::population::{Beam, Population};
use super::render::Spot;
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use crate::optics::{Camera, geometry, psf};
use crate::toml_file::Key;

/// The optical path between a beam and its spots.
#[derive(Debug)]
pub(super) struct Light {
    /// The true camera, which may differ from its data sheet.
    pub lens: Camera,
    /// T_int · η_s · τ · (2/(π w_z²)) · π r_a²: energy per watt of a beam straight below that does not miss, J/W.
    straight_j_per_w: f64,
    attenuation: Option<Attenuation>,
    average: Average,
    flight: Option<Flight>,
    pose: Option<Pose>,
    vignetting: Option<Vignetting>,
    rays: Option<Rays>,
    /// Images of the spots where they are not Gaussian.
    pub images: Option<SpotImages>,
    exposure: Exposure,
}

/// Values that all beams of a frame share, and buffers.
#[derive(Debug, Default)]
pub(super) struct Shot {
    /// From where the camera looks in each sub-frame, or in all; none from a platform that stands.
    sights: Vec<Sight>,
    rotation: attitude::Rotation,
    /// Common shift of the angles in each sub-frame, rad.
    shaken: Vec<[f64; 2]>,
    wandered: Vec<[f64; 2]>,
    factors: Vec<f64>,
}

impl Shot {
    fn middle(&self) -> Option<&Sight> {
        self.sights.get(self.sights.len() / 2)
    }
}

/// The steepest slope of a unit Gaussian, exp(−1/2).
const STEEPEST: f64 = 0.606_530_659_712_633_4;

/// Energy of the brightest pixel that a beam of the scene is likely to leave, J: the strongest beam straight below, unfaded.
pub(super) fn brightest_pixel(scene: &Scene, camera: &Camera) -> f64 {
    let own = scene
        .user
        .iter()
        .map(|u| u.power_w)
        .chain(scene.intruder.iter().map(|i| i.power_w));
    let strongest = own.flatten().fold(scene.link.power_w, f64::max);
    let share = |pitch: f64| psf::pixel_fraction(-0.5 * pitch, 0.5 * pitch, 0.0, camera.spot_sigma_m);
    straight_j_per_w(scene, camera) * strongest * share(camera.x.pitch_m) * share(camera.y.pitch_m)
}

fn straight_j_per_w(scene: &Scene, camera: &Camera) -> f64 {
    let link = &scene.link;
    let flat = crate::optics::radiometry::flat_aperture_fraction(camera.lens_radius_m, link.beam_radius_m, 0.0);
    link.integration_time_s * link.efficiency * link.transmittance * flat
}

impl Light {
    pub fn new(
        scene: &Scene,
        camera: &Camera,
        population: &Population,
        streams: Streams,
        decisions: &mut Decisions,
    ) -> Result<Self, Error> {
        let ledger = Ledger::default();
        let effects = &scene.effects;
        let peak = brightest_pixel(scene, camera);
        let sigma = camera.spot_sigma_m;
        let z = camera.plane_distance_m;
        let corner = camera.x.half_width().hypot(camera.y.half_width());
        // A spot that moves by d changes no pixel by more than the steepest slope of its profile allows.
        let moved = |d: f64| peak * STEEPEST * d / sigma;

        let far = geometry::link_length(camera.altitude_m, camera.to_ground([corner, 0.0]));
        let attenuation = decisions
            .weigh(Effect::Attenuation, &effects.attenuation, |a| {
                peak * (1.0 - a.transmittance(far))
            })
            .cloned();
        if attenuation.is_some() {
            decisions.note(
                Effect::Attenuation,
                Status::On,
                "one exponential an emitter, for its own path",
            );
        }

        let flight = match &scene.platform {
            Some(platform) => Some(Flight::new(
                platform,
                camera.altitude_m,
                &Key::new("platform"),
                streams,
                &ledger,
            )?),
            None => None,
        };
        let exposure = Exposure::new(scene, population, flight.as_ref(), streams, decisions, moved, z)?;
        match &flight {
            Some(_) if exposure.motion_blur => {
                decisions.note(
                    Effect::Platform,
                    Status::On,
                    "one rotation a sub-frame, common to all spots",
                );
            }
            Some(_) => decisions.note(
                Effect::Platform,
                Status::On,
                "one rotation a frame, common to all spots",
            ),
            None => decisions.note(Effect::Platform, Status::Off, "not in the scene"),
        }
        let average = Average::new(scene, camera, exposure.steps, peak, decisions)?;

        let tilted = |angle: f64| moved(z * angle * (1.0 + (corner / z).powi(2)));
        let pose = decisions.weigh(Effect::Attitude, &effects.attitude, |a| {
            let reach = |i: usize| 3.0 * a.tilt_std_rad[i] + a.tilt_bias_rad[i].abs();
            tilted(reach(0).hypot(reach(1))) + moved(corner * (3.0 * a.yaw_std_rad + a.yaw_bias_rad.abs()))
        });
        if pose.is_some() {
            decisions.note(
                Effect::Attitude,
                Status::On,
                "one rotation a frame, common to all spots",
            );
        }
        let pose = pose.map(|a| Pose::new(a, streams, &ledger));

        let mut lens = camera.clone();
        let distortion = decisions.weigh(Effect::Distortion, &effects.distortion, |d| {
            let [x, y] = d
                .lens()
                .project(z, [camera.x.half_width() / z, camera.y.half_width() / z]);
            moved((x - camera.x.half_width()).hypot(y - camera.y.half_width())) + 2.0 * peak * d.spot_growth.abs()
        });
        if let Some(distortion) = distortion {
            lens.distortion = distortion.lens();
            lens.spot_growth = distortion.spot_growth;
            decisions.note(
                Effect::Distortion,
                Status::On,
                "moves the centre of each spot, not its pixels",
            );
        }

        let vignetting = decisions
            .weigh(Effect::Vignetting, &effects.vignetting, |v| peak * v.corner_loss)
            .cloned();
        if vignetting.is_some() {
            decisions.note(
                Effect::Vignetting,
                Status::On,
                "one factor a spot; the background's is in its image",
            );
        }
        let aberrations = decisions.weigh(Effect::Aberrations, &effects.aberrations, |a| {
            peak * a.defocus_share + moved(a.coma_m)
        });
        let rays = aberrations.map(|a| a.rays(sigma));
        if let Some(rays) = &rays {
            decisions.note(Effect::Aberrations, Status::On, format!("{} rays a spot", rays.count()));
        }
        let spot = decisions.weigh(Effect::Spot, &effects.spot, |_| peak);
        let images = match spot {
            Some(spot) => {
                let images = spot.images(camera, &Key::new("effects.spot"))?;
                let (places, numbers) = images.size();
                let reason = format!(
                    "{}: {places} image(s) of {numbers} numbers, computed once; 16 of them a pixel",
                    spot.kind()
                );
                decisions.note(Effect::Spot, Status::On, reason);
                Some(images)
            }
            None => None,
        };
        Ok(Self {
            lens,
            rays,
            images,
            straight_j_per_w: straight_j_per_w(scene, camera),
            attenuation,
            average,
            flight,
            pose,
            vignetting,
            exposure,
        })
    }

    /// Share of the light that the lens passes at a sensor position.
    pub fn passed(&self, sensor: [f64; 2]) -> f64 {
        let ratio = || self.lens.corner_ratio2(sensor);
        self.vignetting.as_ref().map_or(1.0, |v| v.passed(ratio()))
    }

    /// A place on the sensor as seen from the optical axis, over the sensor's half-diagonal.
    fn field(&self, sensor: [f64; 2]) -> [f64; 2] {
        let corner = self.lens.x.half_width().hypot(self.lens.y.half_width());
        let axis = self.lens.distortion.principal_point_m;
        std::array::from_fn(|k| (sensor[k] - axis[k]) / corner)
    }

    /// The platform's true motion, where it moves.
    /// Duration of an exposure, s, where spots move within it.
    pub fn smears_over_s(&self) -> Option<f64> {
        self.exposure.motion_blur.then_some(self.exposure.time_s)
    }

    pub fn flight(&self) -> Option<&Flight> {
        self.flight.as_ref()
    }

    /// Whether a ground position is imaged onto the array in the frame that `shot` was opened for.
    pub fn sees(&self, ground: [f64; 2], shot: &Shot) -> bool {
        let Some(sight) = shot.middle() else {
            return self.lens.sees(ground);
        };
        let [x, y] = self
            .lens
            .distortion
            .project(self.lens.plane_distance_m, sight.tangents(ground));
        sight.range_m(ground)[1] > 0.0 && x.abs() <= self.lens.x.half_width() && y.abs() <= self.lens.y.half_width()
    }

    /// Computes the values that all beams of a frame share.
    pub fn open(&self, at: Moment<'_>, shot: &mut Shot) {
        if let Some(flight) = &self.flight {
            let steps = if self.exposure.motion_blur {
                self.exposure.steps
            } else {
                1
            };
            shot.sights.clear();
            shot.sights
                .extend((0..steps).map(|s| flight.sight(self.exposure.part(at.t, s, steps))));
        }
        if let Some(pose) = &self.pose {
            shot.rotation = pose.at(at.k, at.t, at.streams, at.ledger);
        }
        if let Some(shaker) = &self.exposure.shaker {
            shot.shaken.clear();
            let times = (0..self.exposure.steps).map(|s| self.exposure.middle(at.t, s));
            shot.shaken.extend(times.map(|t| shaker.at(t)));
        }
    }

    /// Adds the spots of one beam; gives their energy, J (`lens_power_user`, collected over T_int).
    pub fn cast(
        &self,
        beam: &Beam,
        population: &Population,
        at: Moment<'_>,
        shot: &mut Shot,
        out: &mut Vec<Spot>,
    ) -> f64 {
        let [length_m, axial_m] = match shot.middle() {
            Some(sight) => sight.range_m(beam.ground),
            None => [
                geometry::link_length(self.lens.altitude_m, beam.ground),
                self.lens.altitude_m,
            ],
        };
        if axial_m <= 0.0 {
            return 0.0;
        }
        let mut energy = self.straight_j_per_w * beam.power_w * axial_m / length_m;
        if let Some(attenuation) = &self.attenuation {
            energy *= attenuation.transmittance(length_m);
        }
        let steps = self.exposure.steps;
        shot.factors.clear();
        self.average.draw(beam.entity, length_m, steps, at, &mut shot.factors);
        if let Some(wander) = &self.exposure.wander {
            shot.wandered.resize(steps, [0.0; 2]);
            let mut stream = at.streams.open(Effect::Wander, beam.entity, at.k, at.ledger);
            wander.fill(self.exposure.time_s / steps as f64, &mut shot.wandered, &mut *stream);
        }
        let mut total = 0.0;
        for s in 0..steps {
            let ground = match beam.actor {
                Some(actor) if self.exposure.motion_blur => population.position(actor, self.exposure.middle(at.t, s)),
                _ => beam.ground,
            };
            let mut tangents = match shot.sights.get(s).or(shot.sights.first()) {
                Some(sight) => sight.tangents(ground),
                None => self.lens.tangents(ground),
            };
            if self.pose.is_some() {
                tangents = shot.rotation.apply(tangents);
            }
            if self.exposure.shaker.is_some() {
                tangents = attitude::tilt(tangents, shot.shaken[s]);
            }
            if self.exposure.wander.is_some() {
                tangents = attitude::tilt(tangents, shot.wandered[s]);
            }
            let centre = self.lens.distortion.project(self.lens.plane_distance_m, tangents);
            let energy_j = energy * shot.factors[s] / steps as f64 * self.passed(centre);
            total += energy_j;
            let spot = Spot {
                centre,
                sigma_m: self.lens.spot_sigma_at(centre),
                energy_j,
            };
            match &self.rays {
                Some(rays) => rays.cast(&spot, self.field(centre), out),
                None => out.push(spot),
            }
        }
        total
    }
}
