//! What one evaluation of each piece of the optics costs.

mod timing;

use std::hint::black_box;

use oapwatch::optics::fading::GammaGamma;
use oapwatch::optics::psf::{self, PixelResponse};
use oapwatch::optics::{Axis, radiometry};
use timing::time;

fn main() {
    let axis = Axis::centred(64, 0.03);
    let mut row = [0.0; 64];
    time("profile, 64 pixels", || {
        psf::profile(&axis, black_box(1.2e-3), black_box(2e-3), &mut row);
    });
    let zero = PixelResponse {
        fraction: 0.0,
        d_centre: 0.0,
        d_sigma: 0.0,
    };
    let mut response = [zero; 64];
    time("profile with derivatives, 64 pixels", || {
        psf::profile_response(&axis, black_box(1.2e-3), black_box(2e-3), &mut response);
    });
    let law = GammaGamma { alpha: 4.0, beta: 2.0 };
    time("Gamma-Gamma density", || law.ln_density(black_box(0.7)));
    time("power through the aperture", || {
        radiometry::aperture_fraction(black_box(0.05), black_box(0.06), black_box(0.02))
    });
}
