//! One separable factor of a spot: a cubic spline with compact support, given through its antiderivative.

/// The value of a spline at a place.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Value {
    /// ∫ of the density from −∞.
    pub cumulative: f64,
    /// 1/m.
    pub density: f64,
    /// Derivative of the density, 1/m².
    pub slope: f64,
}

/// A density Σ_i c_i·B₃((t − t_i)/h)/h on [−R, R], B₃ the cardinal cubic B-spline (de Boor, 1978, ch. IX), t_i = −R + (i + 2)h and
/// R = (n + 3)h/2. Its integral is Σ c_i. Density and slope are continuous and vanish at ±R.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    knot_m: f64,
    radius_m: f64,
    coefficients: Vec<f64>,
    per_knot: f64,
    /// The cumulative as a quartic of s ∈ [0, 1], lowest power first: below the support, in each knot interval, and beyond.
    pieces: Vec<[f64; 5]>,
}

/// Where a coordinate lies between the knots, of every profile that has the same.
#[derive(Clone, Copy, Debug, Default)]
pub struct KnotPlace {
    piece: usize,
    /// Share of the interval.
    s: f64,
}

impl Profile {
    /// `coefficients`: the c_i, dimensionless, at least one; `knot_m`: h > 0.
    pub fn new(knot_m: f64, coefficients: Vec<f64>) -> Self {
        let n = coefficients.len();
        let at = |i: usize, back: usize| match i.checked_sub(back) {
            Some(k) if k < n => coefficients[k],
            _ => 0.0,
        };
        let mut below = 0.0;
        let mut pieces: Vec<_> = (0..n + 3)
            .map(|j| {
                let [c0, c1, c2, c3] = [0, 1, 2, 3].map(|back| at(j, back));
                let piece = [
                    below,
                    (c1 + 4.0 * c2 + c3) / 6.0,
                    (c1 - c3) / 4.0,
                    (c1 - 2.0 * c2 + c3) / 6.0,
                    (c0 - 3.0 * c1 + 3.0 * c2 - c3) / 24.0,
                ];
                below = piece.iter().sum();
                piece
            })
            .collect();
        pieces.insert(0, [0.0; 5]);
        pieces.push([coefficients.iter().sum(), 0.0, 0.0, 0.0, 0.0]);
        Self {
            knot_m,
            radius_m: 0.5 * (n + 3) as f64 * knot_m,
            per_knot: 1.0 / knot_m,
            coefficients,
            pieces,
        }
    }

    /// Half the support, R, m.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    pub fn knot_m(&self) -> f64 {
        self.knot_m
    }

    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients
    }

    /// ∫ over all of the support.
    pub fn total(&self) -> f64 {
        self.coefficients.iter().sum()
    }

    /// Cumulative, density and slope at `t`, m. A pixel from `lo` to `hi` of a spot at `c` collects cumulative(hi − c) −
    /// cumulative(lo − c); the first and second derivatives of that by c are density(lo − c) − density(hi − c) and
    /// slope(hi − c) − slope(lo − c).
    #[inline(always)]
    pub fn value(&self, t: f64) -> Value {
        self.at(self.place(t))
    }

    /// Where `t`, m, lies between the knots.
    #[inline(always)]
    pub fn place(&self, t: f64) -> KnotPlace {
        let from_edge = (t + self.radius_m) * self.per_knot;
        if !(from_edge > 0.0) {
            return KnotPlace::default();
        }
        let interval = from_edge as usize;
        let beyond = self.pieces.len() - 2;
        if interval >= beyond {
            return KnotPlace {
                piece: beyond + 1,
                s: 0.0,
            };
        }
        KnotPlace {
            piece: interval + 1,
            s: from_edge - interval as f64,
        }
    }

    /// [`Self::value`] of a place by this profile's knots.
    #[inline(always)]
    pub fn at(&self, KnotPlace { piece, s }: KnotPlace) -> Value {
        let p = &self.pieces[piece];
        Value {
            cumulative: p[0] + s * (p[1] + s * (p[2] + s * (p[3] + s * p[4]))),
            density: (p[1] + s * (2.0 * p[2] + s * (3.0 * p[3] + s * 4.0 * p[4]))) * self.per_knot,
            slope: (2.0 * p[2] + s * (6.0 * p[3] + s * 12.0 * p[4])) * (self.per_knot * self.per_knot),
        }
    }

    /// ∫ of the density up to `t`; 0 below −R and [`Self::total`] above R.
    pub fn cumulative(&self, t: f64) -> f64 {
        self.value(t).cumulative
    }

    /// The density at `t`, 1/m; zero outside [−R, R].
    pub fn density(&self, t: f64) -> f64 {
        self.value(t).density
    }

    /// Derivative of the density at `t`, 1/m²; zero outside [−R, R].
    pub fn slope(&self, t: f64) -> f64 {
        self.value(t).slope
    }

    /// ∫ a(t)·b(t) dt, 1/m, of two profiles with the same knots.
    pub fn inner_product(&self, other: &Self) -> f64 {
        // Of two cardinal cubic B-splines k knots apart: B₇(k)/h (de Boor, 1978, ch. X).
        const SEPTIC: [f64; 4] = [2416.0 / 5040.0, 1191.0 / 5040.0, 120.0 / 5040.0, 1.0 / 5040.0];
        let mut sum = 0.0;
        for (i, a) in self.coefficients.iter().enumerate() {
            let near = i.saturating_sub(3)..(i + 4).min(other.coefficients.len());
            sum += near
                .map(|j| a * other.coefficients[j] * SEPTIC[i.abs_diff(j)])
                .sum::<f64>();
        }
        sum / self.knot_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn density_and_slope_are_derivatives_of_the_cumulative() {
        let profile = Profile::new(0.3, vec![0.1, -0.4, 1.0, 0.7, 0.2]);
        assert!((profile.radius_m() - 1.2).abs() < 1e-15);
        assert_eq!(profile.cumulative(-1.3), 0.0);
        assert!((profile.cumulative(1.3) - 1.6).abs() < 1e-15);
        let h = 1e-5;
        for k in 0..100 {
            let t = -1.25 + 0.025_3 * f64::from(k);
            let (lo, hi, v) = (profile.value(t - h), profile.value(t + h), profile.value(t));
            // Central differences: h²/6 times a third derivative below 100, cancellation 1e-16/h.
            assert!((v.density - (hi.cumulative - lo.cumulative) / (2.0 * h)).abs() < 1e-7);
            assert!((v.slope - (hi.density - lo.density) / (2.0 * h)).abs() < 1e-3, "{t}");
        }
    }

    #[test]
    fn inner_product_is_the_integral() {
        let a = Profile::new(0.3, vec![0.1, -0.4, 1.0, 0.7, 0.2, 0.3, 0.1]);
        let b = Profile::new(0.3, vec![0.5, 0.4, -1.0, 0.2, 0.2, 0.9, 0.4]);
        let n = 20_000;
        let step = 2.0 * a.radius_m() / f64::from(n);
        let at = |k: i32| -a.radius_m() + step * (f64::from(k) + 0.5);
        let sum: f64 = (0..n).map(|k| a.density(at(k)) * b.density(at(k))).sum();
        assert!((a.inner_product(&b) - sum * step).abs() < 1e-7);
    }
}
