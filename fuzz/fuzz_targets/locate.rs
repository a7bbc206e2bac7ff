//! Frames of any bits on small arrays of any shape: no panic, nothing malformed.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::estimate;
use oapwatch::study::stability::trial;

fuzz_target!(|input: (u8, u8, u8, &[u8])| {
    let (nx, ny, sigma, bytes) = input;
    let pixels = [usize::from(nx % 12) + 1, usize::from(ny % 12) + 1];
    let camera = trial::camera(pixels, 1e-5 * 1.06f64.powi(sigma.into()));
    let values = bytes.as_chunks::<4>().0;
    if values.is_empty() {
        return;
    }
    let value = |k: usize| f64::from(f32::from_le_bytes(values[k % values.len()]));
    let shape = camera.shape();
    let frame = trial::frame(ndarray::Array2::from_shape_fn(shape, |(y, x)| value(y * shape.1 + x)));
    let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("the default");
    if let Ok(estimate) = estimator.estimate(&frame) {
        let faults = trial::faults(&estimate);
        assert!(faults.is_empty(), "{faults:?}");
    }
});
