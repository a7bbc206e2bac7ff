//! Patches of a skewed spot that changes over the field: derivatives, and what the core leaves out.

use std::sync::Arc;

use crate::estimate::model::bases::Bases;
use crate::estimate::model::halo::Halo;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model::measured_components::{MeasuredComponents, MeasuredShape, OUTSIDE_CORE, Orders};
use crate::estimate::model::svd_basis::Basis;
use crate::optics::Config;
use crate::optics::spot::{Beyond, Component, Field, FieldPolynomial, SpotShape, Template};

/// A skewed spot of 7 σ, the config's σ, whose tail grows over the field, on 24 × 21 pixels.
fn lens() -> (MeasuredShape, [Basis; 2]) {
    let camera = Config {
        pixels: [24, 21],
        ..Config::default()
    }
    .camera()
    .unwrap();
    let sigma = camera.spot_sigma_m;
    let field = Field {
        half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
    };
    let gaussian = |x: f64, y: f64, width: f64| (-0.5 * (x * x + y * y) / (width * sigma).powi(2)).exp();
    let skewed = |x: f64, y: f64| gaussian(x, y, 1.0) + 0.2 * gaussian(x - 0.8 * sigma, y + 0.5 * sigma, 1.5);
    let mut template = Template::of_density(field, 0.2 * sigma, 7.0 * sigma, skewed);
    let tail = Template::of_density(field, 0.2 * sigma, 7.0 * sigma, |x, y| x / sigma * gaussian(x, y, 1.2));
    let [tail] = <[Component; 1]>::try_from(tail.components).unwrap();
    template.components.push(Component {
        field: FieldPolynomial(vec![0.0, 0.3, -0.2]),
        ..tail
    });
    let shape = SpotShape::from_template(&template, 1e-7).unwrap();
    assert!(shape.terms() > 1 && !shape.is_uniform());
    let bases = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma));
    (MeasuredShape::new(Arc::new(shape), sigma), bases)
}

/// An array of the only component as a frame.
fn frame(shape: &MeasuredShape, [x, y]: &[Basis; 2], u: [f64; 2], [a, b]: [usize; 2]) -> Vec<f64> {
    let mut components = MeasuredComponents::default();
    components.clear(x.stride);
    components.push(shape, [x, y], u, [0.3, -0.2], &[(-0.5, 0.4), (0.5, 0.6)]);
    let mut matrix = vec![0.0; x.stride * y.n];
    components.accumulate(0, a, b, 1.0, &mut matrix);
    matrix
}

#[test]
fn a_patch_that_was_kept_shows_what_a_new_one_does() {
    let (mut shape, [x, y]) = lens();
    let parts = [(-0.5, 0.4), (0.5, 0.6)];
    let mut kept = MeasuredComponents::default();
    // Each differs from the one before it in one respect; places come back at once, later, and after they were given up.
    let models = [
        ([0.3, -0.4], [0.0; 2], &parts[..], [0.0; 2]),
        ([0.3, -0.4], [0.3, -0.2], &parts[..], [0.0; 2]),
        ([0.3, -0.4], [0.3, -0.2], &parts[..1], [0.0; 2]),
        ([0.3, -0.4], [0.3, -0.2], &parts[..1], [4e-3, -2e-3]),
        ([-9.0, 6.5], [0.3, -0.2], &parts[..1], [4e-3, -2e-3]),
    ];
    for (u, displacement, parts, origin_m) in (0..4).flat_map(|turn| models.into_iter().cycle().skip(turn).take(7)) {
        shape.origin_m = origin_m;
        let mut new = MeasuredComponents::default();
        let [kept, new] = [&mut kept, &mut new].map(|components| {
            components.clear(x.stride);
            components.push(&shape, [&x, &y], u, displacement, parts);
            let mut light = vec![0.0; x.stride * y.n];
            components.accumulate(0, 1, 0, 1.0, &mut light);
            light
        });
        assert!(kept == new, "{u:?} {displacement:?} {origin_m:?}");
    }
}

#[test]
fn a_spot_error_grows_beyond_what_is_known_of_a_spot() {
    let mut camera = Config::default().camera().unwrap();
    let sigma = camera.spot_sigma_m;
    let field = Field {
        half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
    };
    let gaussian = |x: f64, y: f64| (-0.5 * (x * x + y * y) / (sigma * sigma)).exp();
    let shape =
        SpotShape::from_template(&Template::of_density(field, 0.5 * sigma, 6.0 * sigma, gaussian), 1e-6).unwrap();
    let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma));
    let centre = [0, 1].map(|k| 0.5 * (pixels[k].edges[10] + pixels[k].edges[11]));
    let beyond = Beyond {
        error: 0.3,
        from_m: 1.1 * sigma,
    };
    let mut variances = |beyond: Option<Beyond>| {
        camera.spot_shape = Some(Arc::new(shape.clone().with_beyond(beyond)));
        let bases = Bases::new(pixels.clone()).with_shape(&camera);
        Halo::new(&bases, &[PointSource::new(centre, 100.0)], 0.1).variance
    };
    let (two, one) = (variances(Some(beyond)), variances(None));
    let (columns, pitch) = (pixels[0].n, pixels[0].pitch());
    for (k, (two, one)) in two.iter().zip(&one).enumerate() {
        let distance = pitch * ((k % columns) as f64 - 10.0).hypot((k / columns) as f64 - 10.0);
        let expected = if distance < 1.1 { 1.0 } else { 9.0 };
        assert!((two / one - expected).abs() < 1e-9, "{distance}: {}", two / one);
    }
}

#[test]
fn derivatives_agree_with_finite_differences() {
    let (shape, bases) = lens();
    let h = 1e-4;
    for u in [[0.3, -0.4], [-9.0, 6.5]] {
        for (orders, along) in [([0, 0], 0), ([0, 0], 1), ([1, 0], 0), ([1, 0], 1), ([0, 1], 1)] {
            let mut moved = [u; 2];
            moved[0][along] += h;
            moved[1][along] -= h;
            let [after, before] = moved.map(|u| frame(&shape, &bases, u, orders));
            let mut higher = orders;
            higher[along] += 1;
            let derivative = frame(&shape, &bases, u, higher);
            let largest = derivative.iter().fold(0.0f64, |m, d| m.max(d.abs()));
            for ((after, before), d) in after.iter().zip(&before).zip(&derivative) {
                // Second derivatives are taken for zero outside the core: the root of its thousandth, times how much steeper they are.
                let is_outside = *d == 0.0 && higher[0] + higher[1] == 2;
                let tolerance = if is_outside { 0.1 } else { 1e-3 };
                let slope = (after - before) / (2.0 * h);
                assert!(
                    (slope - d).abs() < tolerance * largest,
                    "{u:?} {higher:?}: {slope} against {d}"
                );
            }
        }
    }
}

#[test]
fn the_core_holds_all_but_a_thousandth_of_the_products() {
    let (shape, bases) = lens();
    let [x, y] = &bases;
    assert!(shape.radii[1] < 0.8 * shape.radii[0], "{:?}", shape.radii);
    let mut components = MeasuredComponents::default();
    components.clear(x.stride);
    for u in [[0.3, -0.4], [1.9, 0.8]] {
        components.push(&shape, [x, y], u, [0.0; 2], &[(0.0, 1.0)]);
    }
    components.push_profiles([x, y], [&vec![1.0; x.n], &vec![1.0; y.n]]);
    let weights: Vec<f64> = (0..x.stride * y.n).map(|k| 1.0 + 0.3 * (k as f64).sin()).collect();
    const ORDERS: Orders = [[1, 0], [0, 1], [0, 0]];
    for (i, j) in [(0, 0), (0, 1), (1, 0)] {
        let block = components.inner_products(i, ORDERS, j, ORDERS, &weights);
        for r in 0..3 {
            for c in 0..3 {
                let whole = components.inner_product(i, ORDERS[r], j, ORDERS[c], &weights);
                let own = |k: usize, a: [usize; 2]| components.inner_product(k, a, k, a, &weights);
                let scale = (own(i, ORDERS[r]) * own(j, ORDERS[c])).sqrt();
                assert!(
                    (block[3 * r + c] - whole).abs() < 2.0 * OUTSIDE_CORE * scale,
                    "{i} {j} {r} {c}"
                );
            }
        }
    }
    // What a position's variance grows by with a background: the square of their correlation.
    let block = components.inner_products(0, ORDERS, 2, ORDERS, &weights);
    for r in 0..2 {
        let of = |i: usize, a: [usize; 2], j: usize, b: [usize; 2]| components.inner_product(i, a, j, b, &weights);
        let scale = of(0, ORDERS[r], 0, ORDERS[r]) * of(2, [0, 0], 2, [0, 0]);
        let [cut, whole] = [block[3 * r + 2], of(0, ORDERS[r], 2, [0, 0])].map(|c| c * c / scale);
        assert!((cut - whole).abs() < OUTSIDE_CORE, "{r}: {cut} {whole}");
    }
}
