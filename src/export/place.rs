//! Where emitters and alerts are on the earth.

use super::words::sigma_m;
use crate::geo::{Datum, LocalAxes, Origin, undulation_m};
use crate::monitor::{Alert, TrackedPosition};

/// The local axes on the earth, for systems that know latitudes only.
#[derive(Clone, Debug)]
pub(super) struct World {
    axes: LocalAxes,
    pub origin: Origin,
}

/// A place on WGS-84 with standard deviations, where they are known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub height_m: f64,
    /// Along the worst direction.
    pub horizontal_sigma_m: Option<f64>,
    pub vertical_sigma_m: Option<f64>,
    /// Along east and north.
    pub axes_sigma_m: Option<[f64; 2]>,
}

impl World {
    pub(super) fn new(origin: Origin) -> Self {
        Self {
            axes: LocalAxes::at(origin.geodetic()),
            origin,
        }
    }

    pub(super) fn is_above_sea_level(&self) -> bool {
        self.origin.datum == Datum::Msl
    }

    /// A place with its height above the ellipsoid.
    pub(super) fn on_ellipsoid(&self, mut place: Place) -> Place {
        if self.is_above_sea_level() {
            place.height_m += undulation_m(place.latitude_deg, place.longitude_deg);
        }
        place
    }

    /// A place in local metres.
    fn at(&self, local_m: [f64; 3]) -> Place {
        let place = self.axes.to_geodetic(local_m);
        Place {
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            height_m: place.height_m,
            horizontal_sigma_m: None,
            vertical_sigma_m: None,
            axes_sigma_m: None,
        }
    }

    pub(super) fn origin(&self) -> Place {
        self.at([0.0; 3])
    }

    pub(super) fn emitter(&self, emitter: &TrackedPosition) -> Place {
        Place {
            horizontal_sigma_m: sigma_m(&emitter.cov_m2),
            axes_sigma_m: axes_sigma_m(&emitter.cov_m2),
            ..self.at([emitter.x_m, emitter.y_m, emitter.z_m])
        }
    }

    /// Where an alert without a place counts as at the origin, with an unknown error.
    pub(super) fn alert(&self, alert: &Alert) -> Place {
        let Some((x, y)) = alert.x_m.zip(alert.y_m) else {
            return self.origin();
        };
        let cov = alert.cov_m2.as_ref();
        Place {
            horizontal_sigma_m: cov.and_then(sigma_m),
            axes_sigma_m: cov.and_then(axes_sigma_m),
            ..self.at([x, y, alert.z_m.unwrap_or(0.0)])
        }
    }
}

fn axes_sigma_m(cov: &[[f64; 2]; 2]) -> Option<[f64; 2]> {
    let sigmas = [cov[0][0], cov[1][1]].map(f64::sqrt);
    sigmas.iter().all(|sigma| sigma.is_finite()).then_some(sigmas)
}
