//! Universal Transverse Mercator on WGS-84: Krüger's series (Karney 2011, eq. 7 to 11, 35) to the fourth order of the third
//! flattening, 1 µm within a zone and its neighbours.

/// Semi-major axis, m, and third flattening of WGS-84.
const A: f64 = 6_378_137.0;
const F: f64 = 1.0 / 298.257_223_563;
const N: f64 = F / (2.0 - F);
const SCALE: f64 = 0.9996;
const FALSE_EASTING_M: f64 = 500_000.0;
const FALSE_NORTHING_SOUTH_M: f64 = 10_000_000.0;

/// A zone, 1 to 60, north or south.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Zone {
    number: u16,
    is_south: bool,
}

impl Zone {
    /// That of an EPSG code.
    pub fn of_epsg(code: u16) -> Option<Self> {
        match code {
            32601..=32660 => Some((code - 32600, false)),
            32701..=32760 => Some((code - 32700, true)),
            _ => None,
        }
        .map(|(number, is_south)| Self { number, is_south })
    }

    /// Easting and northing, m.
    pub fn project(self, latitude_deg: f64, longitude_deg: f64) -> [f64; 2] {
        const N2: f64 = N * N;
        const N3: f64 = N2 * N;
        const N4: f64 = N2 * N2;
        const ALPHA: [f64; 4] = [
            N / 2.0 - 2.0 / 3.0 * N2 + 5.0 / 16.0 * N3 + 41.0 / 180.0 * N4,
            13.0 / 48.0 * N2 - 3.0 / 5.0 * N3 + 557.0 / 1440.0 * N4,
            61.0 / 240.0 * N3 - 103.0 / 140.0 * N4,
            49561.0 / 161_280.0 * N4,
        ];
        const RECTIFYING_M: f64 = A / (1.0 + N) * (1.0 + N2 / 4.0 + N4 / 64.0);
        let central_deg = 6.0 * f64::from(self.number) - 183.0;
        let away_deg = longitude_deg - central_deg;
        let (sin_away, cos_away) = (away_deg - 360.0 * (away_deg / 360.0).round()).to_radians().sin_cos();
        let sin = latitude_deg.to_radians().sin();
        let e = (F * (2.0 - F)).sqrt();
        let conformal = (sin.atanh() - e * (e * sin).atanh()).sinh();
        let xi = conformal.atan2(cos_away);
        let eta = (sin_away / conformal.hypot(cos_away)).asinh();
        let (mut east, mut north) = (eta, xi);
        for (k, alpha) in ALPHA.into_iter().enumerate() {
            let twice = 2.0 * (k as f64 + 1.0);
            east += alpha * (twice * xi).cos() * (twice * eta).sinh();
            north += alpha * (twice * xi).sin() * (twice * eta).cosh();
        }
        let south = if self.is_south { FALSE_NORTHING_SOUTH_M } else { 0.0 };
        [
            FALSE_EASTING_M + SCALE * RECTIFYING_M * east,
            south + SCALE * RECTIFYING_M * north,
        ]
    }
}
