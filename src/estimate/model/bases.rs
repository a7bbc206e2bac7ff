//! The bases of both axes, with the background's profiles in them.

use crate::estimate::model::measured_components::MeasuredShape;
use crate::estimate::model::svd_basis::Basis;
use crate::optics::Camera;

/// Width of a sensor, σ, up to which one or two spots show no shape beside a width: on narrower ones spots are all core. Smaller takes melted
/// spots of another width for a lens's, larger leaves two spots of a lens on 20 × 20 pixels to invented sources.
const NARROW: f64 = 8.5;
/// Width, σ, up to which the halo of a measured spot is light on most of the sensor. Larger leaves curved daylight through a calibrated lens to
/// invented sources, smaller takes an Airy disc's rings for daylight, and sources to make up for it.
const HALO: f64 = 40.0;

/// What a frame is compressed into and predicted in.
pub(crate) struct Bases {
    pub x: Basis,
    pub y: Basis,
    /// Constant, sloped and curved profiles along each axis.
    pub backgrounds: [[Vec<f64>; 3]; 2],
    /// The PSF where it is measured; without one it is a Gaussian. Only in the pixel bases.
    pub shape: Option<MeasuredShape>,
}

impl Bases {
    pub fn new([x, y]: [Basis; 2]) -> Self {
        Self {
            backgrounds: [background(&x), background(&y)],
            shape: None,
            x,
            y,
        }
    }

    /// Pixel bases with the PSF that the camera was measured to have, if it was.
    pub fn with_shape(mut self, camera: &Camera) -> Self {
        let shape = camera.spot_shape.as_ref().filter(|_| self.are_pixels());
        self.shape = shape.map(|shape| MeasuredShape::new(shape.clone(), camera.spot_sigma_m));
        self
    }

    /// Says where on the sensor the axes' origin is, m, for a PSF that varies over it.
    pub fn set_origin(&mut self, origin_m: [f64; 2]) {
        if let Some(shape) = &mut self.shape {
            shape.origin_m = origin_m;
        }
    }

    pub fn axes(&self) -> [&Basis; 2] {
        [&self.x, &self.y]
    }

    /// Whether coefficients are pixels, so that each may have a weight.
    pub fn are_pixels(&self) -> bool {
        self.x.is_pixels && self.y.is_pixels
    }

    /// Whether spots are all core on this sensor.
    pub fn is_narrow(&self) -> bool {
        self.is_within(NARROW)
    }

    /// Whether a curvature of the light on this sensor is a spot's: its core's, or that of a halo that was measured.
    pub fn is_curved_by_spots(&self) -> bool {
        self.is_within(if self.shape.is_some() { HALO } else { NARROW })
    }

    fn is_within(&self, width: f64) -> bool {
        self.axes().iter().any(|b| b.edges[b.n] - b.edges[0] < width)
    }

    /// The wider pixel pitch of the two axes, σ.
    pub fn pitch(&self) -> f64 {
        self.x.pitch().max(self.y.pitch())
    }

    /// Ranges along each axis within which a fit may place a source, σ.
    pub fn reach(&self) -> [f64; 2] {
        self.axes().map(|b| b.max_position() - b.min_position())
    }
}

/// Constant, sloped and curved profiles along one axis (Legendre polynomials), of about a source's norm, so that the normal equations are well
/// scaled.
fn background(b: &Basis) -> [Vec<f64>; 3] {
    let (half, norm) = (0.5 * b.n as f64, (b.n as f64).sqrt());
    let legendre: [fn(f64) -> f64; 3] = [|_| 1.0, |t| t, |t| 1.5 * t * t - 0.5];
    legendre.map(|of| {
        let mut profile = vec![0.0; b.stride];
        b.compress(
            (0..b.n).map(|k| of((k as f64 + 0.5 - half) / half) / norm),
            &mut profile,
        );
        profile
    })
}
