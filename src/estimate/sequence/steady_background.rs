//! Light behind the emitters that stays from frame to frame.

use nalgebra::{Matrix6, Vector6};
use ndarray::Array2;

use crate::estimate::model::hypothesis::BACKGROUND_TERMS;
use crate::stats::median;

/// Frames over which it is averaged. More are more exact, fewer follow a cloud sooner. Not tuned.
const FRAMES: f64 = 32.0;
/// Frames from the first on that all are asked, and then one in so many while there is none: fewer notice later, more make frames slower.
const FIRST: u32 = 32;
const ONE_IN: u32 = 8;
/// Least decrease of the dark pixels' deviance: noise does not bring it, and what brings less makes no emitters.
const LEAST: f64 = 40.0;
/// Least share of pixels that are dark: fewer do not tell what is behind the emitters.
const LEAST_DARK: f64 = 0.2;

/// Standard deviations by which the mean square of what a surface leaves may exceed that of the differences between neighbours: the edge of a
/// shadow does, and so does noise that the pixels of a row share.
const SMOOTH: f64 = 6.0;

/// A second-order surface over the sensor, x and y from −1 to 1, in standard deviations of the noise.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Surface(Vector6<f64>);

impl Surface {
    /// Takes it off pixels whose noise this is.
    pub fn subtract(&self, pixels: &mut Array2<f64>, noise: f64) {
        let (ny, nx) = pixels.dim();
        let of = self.0 * noise;
        for (row, mut values) in pixels.outer_iter_mut().enumerate() {
            let y = from_middle(row, ny);
            let along = [of[0] + y * (of[2] + y * of[5]), of[1] + y * of[4], of[3]];
            for (column, value) in values.iter_mut().enumerate() {
                let x = from_middle(column, nx);
                *value -= along[0] + x * (along[1] + x * along[2]);
            }
        }
    }
}

/// A surface by least squares over the pixels that emitters leave dark, older frames fading.
#[derive(Default)]
pub(crate) struct SteadyBackground {
    information: Matrix6<f64>,
    vector: Vector6<f64>,
    known: Option<Surface>,
    frames: u32,
    /// Frames for which nothing is learned, as lately no surface was behind the emitters.
    rough: u32,
}

impl SteadyBackground {
    /// The background, where it is significant.
    pub fn known(&self) -> Option<&Surface> {
        self.known.as_ref()
    }

    /// Takes what is known off a frame's pixels, in standard deviations of the noise, and what has been added evenly since: clouds are faster
    /// than the mean. `is_lit`: where emitters were a frame ago, where that leaves dark pixels.
    pub fn follow(&mut self, values: &mut Array2<f64>, is_lit: Option<&Array2<bool>>) {
        let Some(surface) = &mut self.known else { return };
        surface.subtract(values, 1.0);
        let Some(is_lit) = is_lit else { return };
        let of_dark = values.iter().zip(is_lit).filter(|(v, lit)| !**lit && !v.is_nan());
        let dark: Vec<f64> = of_dark.map(|(v, _)| *v).collect();
        let count = dark.len() as f64;
        if let Some(middle) = median(dark).filter(|middle| middle * middle * count > LEAST) {
            surface.0[0] += middle;
            values.iter_mut().for_each(|v| *v -= middle);
        }
    }

    /// Whether the newest frame has to be learned from.
    pub fn is_due(&mut self) -> bool {
        self.frames = self.frames.saturating_add(1);
        self.known.is_some() || self.frames <= FIRST || self.frames.is_multiple_of(ONE_IN)
    }

    /// Learns from a frame's pixels (ny, nx) without what is known, in standard deviations of the noise, NaN where they are not usable.
    pub fn learn(&mut self, values: &Array2<f64>, is_lit: &Array2<bool>) {
        let (ny, nx) = values.dim();
        let (mut moments, mut vector) = ([[0.0; 5]; 5], Vector6::zeros());
        let (mut square, mut differences, mut pairs) = (0.0, 0.0, 0.0);
        for (row, (values, lit)) in values.outer_iter().zip(is_lit.outer_iter()).enumerate() {
            let (mut of_places, mut of_values, mut before) = ([0.0; 5], [0.0; 3], f64::NAN);
            for (column, (value, lit)) in values.iter().zip(&lit).enumerate() {
                if *lit || value.is_nan() {
                    before = f64::NAN;
                    continue;
                }
                square += value * value;
                if !before.is_nan() {
                    differences += (value - before).powi(2);
                    pairs += 1.0;
                }
                before = *value;
                let mut power = 1.0;
                for k in 0..5 {
                    of_places[k] += power;
                    if k < 3 {
                        of_values[k] += power * value;
                    }
                    power *= from_middle(column, nx);
                }
            }
            let y = from_middle(row, ny);
            for (of_place, moments) in of_places.iter().zip(&mut moments) {
                let mut power = 1.0;
                for moment in moments {
                    *moment += of_place * power;
                    power *= y;
                }
            }
            for (k, [a, b]) in BACKGROUND_TERMS.iter().enumerate() {
                vector[k] += of_values[*a] * y.powi(*b as i32);
            }
        }
        let dark = moments[0][0];
        if dark < LEAST_DARK * values.len() as f64 {
            return;
        }
        let information = Matrix6::from_fn(|r, c| {
            let [a, b] = [0, 1].map(|axis| BACKGROUND_TERMS[r][axis] + BACKGROUND_TERMS[c][axis]);
            moments[a][b]
        });
        let Some(factor) = information.cholesky() else { return };
        let change = factor.solve(&vector).dot(&vector);
        let noise = 0.5 * differences / f64::max(pairs, 1.0);
        if square - change > dark * noise * (1.0 + SMOOTH * (3.0 / dark).sqrt()) {
            *self = Self {
                frames: self.frames,
                rough: FRAMES as u32,
                ..Self::default()
            };
        }
        if self.rough > 0 {
            self.rough -= 1;
            return;
        }
        // Where this frame alone contradicts what is known, that is of another time.
        let keep = if change > LEAST { 0.0 } else { 1.0 - 1.0 / FRAMES };
        self.information = self.information * keep + information;
        let known = self.known.map_or_else(Vector6::zeros, |surface| surface.0);
        self.vector = self.vector * keep + vector + information * known;
        let surface = self.information.cholesky().map(|factor| factor.solve(&self.vector));
        self.known = surface.filter(|found| found.dot(&self.vector) > LEAST).map(Surface);
    }
}

/// Where the middle of a pixel is, −1 to 1.
fn from_middle(pixel: usize, of: usize) -> f64 {
    (2 * pixel + 1) as f64 / of as f64 - 1.0
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const PIXELS: usize = 40;

    /// What is left, rms, of a background after so many frames of noise and of a spot that counts as lit; none where nothing was found.
    fn left(background: impl Fn(f64, f64) -> f64, frames: usize) -> Option<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let place = |k: usize| from_middle(k, PIXELS);
        let shape = (PIXELS, PIXELS);
        let behind = Array2::from_shape_fn(shape, |(y, x)| background(place(x), place(y)));
        let is_lit = Array2::from_shape_fn(shape, |(y, x)| y < 12 && x < 12);
        let mut found = SteadyBackground::default();
        for _ in 0..frames {
            let noise: Array2<f64> = Array2::from_shape_simple_fn(shape, || StandardNormal.sample(&mut rng));
            let spot = is_lit.mapv(|lit| if lit { 50.0 } else { 0.0 });
            let mut values = noise + spot + &behind;
            if let Some(surface) = found.known() {
                surface.subtract(&mut values, 1.0);
            }
            found.learn(&values, &is_lit);
        }
        let mut rest = behind;
        found.known()?.subtract(&mut rest, 1.0);
        Some((rest.iter().map(|v| v * v).sum::<f64>() / rest.len() as f64).sqrt())
    }

    #[test]
    fn a_background_that_no_frame_shows_is_found_and_noise_is_none() {
        assert_eq!(left(|_, _| 0.0, 100), None);
        for background in [|_: f64, _: f64| 0.3, |x: f64, y: f64| 20.0 + 5.0 * x - 3.0 * x * y] {
            let left = left(background, 20).expect("significant");
            assert!(left < 0.05, "{left}");
        }
    }
}
