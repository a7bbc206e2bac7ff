//! Pixels that do not follow light, found from frames of one scene.

use ndarray::{Array2, s};

use super::photon_transfer::mean_of;
use crate::stats;

/// Pixels that do not follow light: that never change where others do, or that stand alone above or below all their neighbours, as no
/// spot does. Values are rounded to multiples of `step`, 0 for none.
pub fn bad_pixels(frames: &[Array2<f64>], step: f64) -> Array2<bool> {
    /// In standard deviations of the scatter among neighbours: Gaussian scatter leaves out less than one pixel of any sensor.
    const FACTOR: f64 = 8.0;
    /// Standard deviations of Gaussian scatter in a median of absolute deviations.
    const STD_OF_MEDIAN: f64 = 1.4826;
    /// Share of a bad pixel's rise that its neighbours have at most; those of a spot of σ half a pixel have 13 %.
    const SHARED: f64 = 0.03;
    let median = |values| stats::median(values).expect("an image has pixels");
    let mean = mean_of(frames);
    let (ny, nx) = mean.dim();
    let noise = Array2::from_shape_fn((ny, nx), |at| {
        let steps = frames.windows(2).map(|pair| (pair[1][at] - pair[0][at]).powi(2));
        (steps.sum::<f64>() / (2.0 * (frames.len() - 1).max(1) as f64)).sqrt()
    });
    let usual_noise = median(noise.iter().copied().collect());
    // Median of the neighbourhood, and scatter about it.
    let around = Array2::from_shape_fn((ny, nx), |(y, x)| {
        let window = mean.slice(s![
            y.saturating_sub(2)..(y + 3).min(ny),
            x.saturating_sub(2)..(x + 3).min(nx)
        ]);
        let around = median(window.iter().copied().collect());
        let deviations = window.iter().map(|v| (v - around).abs()).collect();
        (around, STD_OF_MEDIAN * median(deviations))
    });
    // Of 25 pixels some have far less scatter than they should: what the whole image has is the least that any has, be it noise or the
    // sensor's fixed pattern.
    let usual_scatter = median(around.iter().map(|(_, scatter)| *scatter).collect());
    let stands_alone = |(y, x): (usize, usize)| {
        let (around, scatter) = around[[y, x]];
        let rise = mean[[y, x]] - around;
        let beside = [(0, 1), (2, 1), (1, 0), (1, 2)].into_iter().filter_map(|(dy, dx)| {
            let place = [(y + dy).checked_sub(1)?, (x + dx).checked_sub(1)?];
            mean.get(place).map(|v| v - around)
        });
        let shared = beside.map(|v| v / rise).fold(f64::NEG_INFINITY, f64::max);
        let noise = usual_noise / (frames.len() as f64).sqrt();
        rise.abs() > FACTOR * scatter.max(usual_scatter).max(noise) && shared < SHARED
    };
    Array2::from_shape_fn((ny, nx), |at| {
        // Noise below a step leaves pixels of constant value.
        let is_frozen = usual_noise > step && noise[at] == 0.0;
        !mean[at].is_finite() || is_frozen || stands_alone(at)
    })
}

#[cfg(test)]
mod tests {
    use super::super::photon_transfer::tests::Sensor;
    use super::*;

    #[test]
    fn pixels_that_stand_alone_or_never_change_are_bad_and_spots_are_not() {
        let sensor = Sensor {
            gain: 0.5,
            read_std: 4.0,
            dark: 64.0,
            flicker: 0.2,
        };
        let mut frames = sensor.frames(40, 6);
        for frame in &mut frames {
            frame[[3, 60]] += 300.0;
            frame[[21, 40]] = 64.0;
        }
        let bad = bad_pixels(&frames, 1.0);
        let found: Vec<_> = bad.indexed_iter().filter(|(_, b)| **b).map(|(at, _)| at).collect();
        assert_eq!(found, [(3, 60), (21, 40)]);
    }

    #[test]
    fn a_pixel_among_neighbours_that_happen_to_agree_is_not_bad() {
        let sensor = Sensor {
            gain: 0.0,
            read_std: 60.0,
            dark: 1000.0,
            flicker: 0.0,
        };
        let mut pattern = sensor.frames(1, 7).remove(0);
        let mut calm = pattern.slice_mut(s![30..35, 50..55]);
        calm.mapv_inplace(|v| 1000.0 + 0.2 * (v - 1000.0));
        calm[[2, 2]] = 1000.0 + 4.0 * 60.0;
        let bad = bad_pixels(&vec![pattern; 40], 1.0);
        assert_eq!(bad.iter().filter(|b| **b).count(), 0);
    }
}
