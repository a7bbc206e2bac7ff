//! Reads and writes the calibration file (TOML); a write replaces the whole file or nothing.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::Array2;
use serde::Deserialize;

use crate::optics::{Calibration, Distortion, PixelMaps, spot};
use crate::toml_file::{Key, OutOfRange};

/// Layout of the file; a reader refuses any other.
const VERSION: u32 = 1;

/// Why a calibration file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    Malformed {
        path: PathBuf,
        source: Box<toml::de::Error>,
    },
    #[error("{path}: version: expected {VERSION}, found {found}")]
    Version { path: PathBuf, found: u32 },
    #[error("{path}: pixels.{map}: row {row} has {found} values, row 0 has {expected}")]
    Ragged {
        path: PathBuf,
        map: &'static str,
        row: usize,
        expected: usize,
        found: usize,
    },
    #[error("{path}: {source}")]
    Shape { path: PathBuf, source: OutOfRange },
    #[error("{path}: pixels.bad: [{x}, {y}] lies outside the {nx} × {ny} map")]
    BadPixelOutside {
        path: PathBuf,
        x: usize,
        y: usize,
        nx: usize,
        ny: usize,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Layout {
    version: u32,
    geometry: Distortion,
    spot: Spot,
    noise: Noise,
    pixels: Option<Pixels>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Spot {
    sigma_m: f64,
    growth: f64,
    error: Option<f64>,
    shape: Option<spot::Layout>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Noise {
    std_j: f64,
    quantum_j: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Pixels {
    gain: Vec<Vec<f64>>,
    dark_j: Vec<Vec<f64>>,
    bad: Vec<[usize; 2]>,
}

/// Reads a calibration file. [`Calibration::applied_to`] checks that it fits a camera.
pub fn read(path: &Path) -> Result<Calibration, Error> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Io {
        path: path.to_owned(),
        source,
    })?;
    let layout: Layout = toml::from_str(&text).map_err(|source| Error::Malformed {
        path: path.to_owned(),
        source: Box::new(source),
    })?;
    if layout.version != VERSION {
        return Err(Error::Version {
            path: path.to_owned(),
            found: layout.version,
        });
    }
    let pixels = layout.pixels.map(|maps| pixel_maps(path, maps)).transpose()?;
    let shape = layout.spot.shape.map(|shape| shape.shape(&Key::new("spot.shape")));
    let shape = shape.transpose().map_err(|source| Error::Shape {
        path: path.to_owned(),
        source,
    })?;
    Ok(Calibration {
        distortion: layout.geometry,
        spot_sigma_m: layout.spot.sigma_m,
        spot_growth: layout.spot.growth,
        spot_shape: shape.map(Arc::new),
        spot_error: layout.spot.error,
        noise_std_j: layout.noise.std_j,
        quantum_j: layout.noise.quantum_j,
        pixels: pixels.map(Arc::new),
    })
}

fn pixel_maps(path: &Path, maps: Pixels) -> Result<PixelMaps, Error> {
    let gain = array(path, "gain", maps.gain)?;
    let dark_j = array(path, "dark_j", maps.dark_j)?;
    let (ny, nx) = gain.dim();
    let mut bad = Array2::from_elem((ny, nx), false);
    for [x, y] in maps.bad {
        *bad.get_mut((y, x)).ok_or(Error::BadPixelOutside {
            path: path.to_owned(),
            x,
            y,
            nx,
            ny,
        })? = true;
    }
    Ok(PixelMaps { gain, dark_j, bad })
}

fn array(path: &Path, map: &'static str, rows: Vec<Vec<f64>>) -> Result<Array2<f64>, Error> {
    let (ny, nx) = (rows.len(), rows.first().map_or(0, Vec::len));
    if let Some((row, found)) = rows.iter().map(Vec::len).enumerate().find(|(_, n)| *n != nx) {
        return Err(Error::Ragged {
            path: path.to_owned(),
            map,
            row,
            expected: nx,
            found,
        });
    }
    Ok(Array2::from_shape_vec((ny, nx), rows.concat()).expect("every row has nx values"))
}

/// The text of the file, with `remarks` as comments at its head, one a line.
pub fn render(calibration: &Calibration, remarks: &[String]) -> String {
    let mut out = String::new();
    for remark in remarks {
        let _ = writeln!(out, "# {remark}");
    }
    let d = &calibration.distortion;
    let list = |values: &[f64]| values.iter().map(|v| format!("{v:e}")).collect::<Vec<_>>().join(", ");
    let _ = write!(
        out,
        "\nversion = {VERSION}\n\n\
         # Sensor position of the direction t = (tan θx, tan θy), r = |t|, behind the lens at distance z:\n\
         # principal_point_m + z·focal_scale·(t·(1 + k1 r² + k2 r⁴ + k3 r⁶) + tangential part of p1, p2).\n\
         [geometry]\nprincipal_point_m = [{}]\nfocal_scale = {:?}\nradial = [{}]\ntangential = [{}]\n\n\
         # σ_eff at a distance d from the principal point: sigma_m·(1 + growth·d²/R²), R the sensor's half-diagonal.\n\
         [spot]\nsigma_m = {:e}\ngrowth = {:e}\n",
        list(&d.principal_point_m),
        d.focal_scale,
        list(&d.radial),
        list(&d.tangential),
        calibration.spot_sigma_m,
        calibration.spot_growth,
    );
    if let Some(error) = calibration.spot_error {
        let _ = write!(
            out,
            "# Share of a spot's light by which it differs from its model.\nerror = {error:e}\n"
        );
    }
    let _ = write!(out, "\n[noise]\nstd_j = {:e}\n", calibration.noise_std_j);
    if let Some(quantum) = calibration.quantum_j {
        let _ = write!(
            out,
            "# Growth of a pixel's variance with a spot's light: shot noise.\nquantum_j = {quantum:e}\n"
        );
    }
    if let Some(shape) = &calibration.spot_shape {
        let _ = write!(
            out,
            "\n# The spot's light is Σ w(u, v)·a(x)·b(y): w polynomials 1, u, v, u², uv, v², … of the place on the sensor over \
             half_sensor_m;\n# a and b cubic B-splines with knots knot_m apart, centred on the spot.\n[spot.shape]\n"
        );
        let layout = spot::Layout::of(shape);
        let _ = write!(
            out,
            "knot_m = {:e}\nhalf_sensor_m = [{}]\n",
            layout.knot_m,
            list(&layout.half_sensor_m)
        );
        if let Some(spot::Beyond { error, from_m }) = layout.beyond {
            let _ = write!(
                out,
                "# Farther from the centre than from_m the shape is not known: spots may differ from it by this share of their light.\n\
                 beyond = {{ error = {error:e}, from_m = {from_m:e} }}\n"
            );
        }
        for term in &layout.term {
            let [field, x, y] = [&term.field, &term.x, &term.y].map(|values| list(values));
            let _ = write!(out, "[[spot.shape.term]]\nfield = [{field}]\nx = [{x}]\ny = [{y}]\n");
        }
    }
    if let Some(maps) = &calibration.pixels {
        let bad: Vec<String> = maps
            .bad
            .indexed_iter()
            .filter(|&(_, &bad)| bad)
            .map(|((y, x), _)| format!("[{x}, {y}]"))
            .collect();
        let _ = write!(
            out,
            "\n# A frame y is corrected to (y - dark_j)/gain; rows from y_min, columns from x_min; bad lists [column, row].\n\
             [pixels]\nbad = [{}]\ngain = [\n",
            bad.join(", ")
        );
        rows(&mut out, &maps.gain, |v| format!("{v:.8}"));
        out.push_str("]\ndark_j = [\n");
        rows(&mut out, &maps.dark_j, |v| {
            if v == 0.0 { "0.0".to_owned() } else { format!("{v:.5e}") }
        });
        out.push_str("]\n");
    }
    out
}

fn rows(out: &mut String, map: &Array2<f64>, number: impl Fn(f64) -> String) {
    for row in map.rows() {
        let values: Vec<String> = row.iter().map(|&v| number(v)).collect();
        let _ = writeln!(out, "  [{}],", values.join(", "));
    }
}

/// Replaces `path` in one step: a reader sees the old file or the new one, whole.
pub fn write(path: &Path, text: &str) -> Result<(), Error> {
    let io = |source| Error::Io {
        path: path.to_owned(),
        source,
    };
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let part = path.with_file_name(name);
    let result = write_synced(&part, text).and_then(|()| std::fs::rename(&part, path));
    if result.is_err() {
        // Best effort: the error that matters is the first one.
        let _ = std::fs::remove_file(&part);
    }
    result.map_err(io)
}

fn write_synced(path: &Path, text: &str) -> std::io::Result<()> {
    use std::io::Write as _;
    let mut file = std::fs::File::create(path)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape() -> spot::SpotShape {
        let field = spot::Field {
            half_sensor_m: [0.015, 0.012],
        };
        let mut template = spot::Template::of_density(field, 5e-4, 4e-3, |x, y| (-1e6 * (x * x + x * y + y * y)).exp());
        let mut astigmatism =
            spot::Template::of_density(field, 5e-4, 4e-3, |x, y| (x - y) * (-2e6 * (x * x + y * y)).exp());
        let mut change = astigmatism.components.remove(0);
        change.field = spot::FieldPolynomial(vec![0.0, 0.3, -0.1]);
        template.components.push(change);
        let beyond = spot::Beyond {
            error: 0.006,
            from_m: 3e-3,
        };
        spot::SpotShape::from_template(&template, 1e-3)
            .unwrap()
            .with_beyond(Some(beyond))
    }

    fn calibration() -> Calibration {
        let mut maps = PixelMaps::ideal((2, 3));
        maps.gain[[1, 2]] = 1.01234567;
        maps.dark_j[[0, 1]] = -2.5e-7;
        maps.bad[[1, 0]] = true;
        Calibration {
            distortion: Distortion {
                principal_point_m: [1.25e-4, -3e-5],
                focal_scale: 1.003,
                radial: [0.12, -0.01, 0.0],
                tangential: [1e-4, -2e-4],
            },
            spot_sigma_m: 1.05e-3,
            spot_growth: 0.03,
            spot_shape: Some(Arc::new(shape())),
            spot_error: Some(0.004),
            noise_std_j: 1.02e-6,
            quantum_j: Some(4.8e-8),
            pixels: Some(Arc::new(maps)),
        }
    }

    #[test]
    fn a_written_file_reads_back_equal() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.toml");
        write(&path, &render(&calibration(), &["fitted in a test".to_owned()])).unwrap();
        assert_eq!(read(&path).unwrap(), calibration());
        assert_eq!(
            std::fs::read_dir(dir.path()).unwrap().count(),
            1,
            "no part file is left behind"
        );
    }

    #[test]
    fn a_damaged_file_is_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.toml");
        let text = render(&calibration(), &[]);
        for (from, to, says) in [
            ("version = 1", "version = 9", "version: expected 1, found 9"),
            ("bad = [[0, 1]]", "bad = [[0, 2]]", "[0, 2] lies outside the 3 × 2 map"),
            (
                "1.00000000, 1.01234567]",
                "1.01234567]",
                "pixels.gain: row 1 has 2 values, row 0 has 3",
            ),
            ("growth", "grwth", "unknown field `grwth`"),
            (
                "knot_m = 5e-4",
                "knot_m = 0.0",
                "spot.shape.knot_m: expected a positive finite number, found 0.0",
            ),
            (
                "error = 6e-3",
                "error = 0.7",
                "spot.shape.beyond.error: expected 0 to 0.5, the share of a spot's light, found 0.7",
            ),
            ("field = [", "field = [1.0, ", "light that adds up to 1"),
        ] {
            assert!(text.contains(from), "{text}");
            std::fs::write(&path, text.replace(from, to)).unwrap();
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains(says) && error.contains("c.toml"), "{error}");
        }
    }
}
