//! What one evaluation of each piece of the optics costs.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use oapwatch::optics::fading::GammaGamma;
use oapwatch::optics::psf::{self, PixelResponse};
use oapwatch::optics::{Axis, radiometry};

fn optics(c: &mut Criterion) {
    let axis = Axis::centred(64, 0.03);
    let mut row = [0.0; 64];
    c.bench_function("profile, 64 pixels", |b| {
        b.iter(|| psf::profile(&axis, black_box(1.2e-3), black_box(2e-3), &mut row));
    });
    let zero = PixelResponse {
        fraction: 0.0,
        d_centre: 0.0,
        d_sigma: 0.0,
    };
    let mut response = [zero; 64];
    c.bench_function("profile with derivatives, 64 pixels", |b| {
        b.iter(|| psf::profile_response(&axis, black_box(1.2e-3), black_box(2e-3), &mut response));
    });
    let law = GammaGamma { alpha: 4.0, beta: 2.0 };
    c.bench_function("Gamma-Gamma density", |b| b.iter(|| law.ln_density(black_box(0.7))));
    c.bench_function("power through the aperture", |b| {
        b.iter(|| radiometry::aperture_fraction(black_box(0.05), black_box(0.06), black_box(0.02)));
    });
}

criterion_group!(benches, optics);
criterion_main!(benches);
