//! The picture of a learned spot: its template, its change over the field, the residuals, the encircled energy.

use std::path::Path;

use anyhow::Context;
use plotters::coord::Shift;
use plotters::prelude::*;

use crate::calibrate::spot::Learned;
use crate::cli::{Failure, Outcome};
use crate::optics::{Camera, SpotShape};

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Cells a side of a drawn template.
const CELLS: i32 = 41;
/// Half-width of a drawn template, σ.
const REACH: f64 = 6.0;
/// Weakest light that is drawn, share of the peak; colours are logarithmic.
const FAINTEST: f64 = 1e-4;
const FONT: (&str, u32) = ("sans-serif", 15);
/// For a caption that is wider than its chart in [`FONT`].
const SMALL: (&str, u32) = ("sans-serif", 11);

/// Writes the SVG file.
pub fn write(path: &Path, camera: &Camera, learned: &Learned) -> Outcome {
    let svg = draw(camera, learned).map_err(Failure::Other)?;
    std::fs::write(path, svg)
        .with_context(|| path.display().to_string())
        .map_err(Failure::Other)
}

/// An SVG text.
fn draw(camera: &Camera, learned: &Learned) -> anyhow::Result<String> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (960, 660)).into_drawing_area();
        root.fill(&WHITE)?;
        let (left, right) = root.split_horizontally(640);
        let (top, bottom) = left.split_vertically(330);
        let (template, field) = top.split_horizontally(320);
        let sigma = learned.shape.sigma_equivalent_m();
        shape(
            &template,
            &learned.shape,
            [0.0; 2],
            sigma,
            "The spot in the middle (log)",
        )?;
        over_field(&field, camera, &learned.shape, sigma)?;
        let (before, after) = bottom.split_horizontally(320);
        let [a, b] = &learned.residuals;
        let largest = a.iter().chain(b).fold(1e-12f64, |m, v| m.max(v.abs()));
        residual(&before, a, largest, "Mean residual, config")?;
        residual(&after, b, largest, "Mean residual, learned")?;
        let (curve, _) = right.split_vertically(330);
        encircled(&curve, camera, &learned.shape, sigma)?;
        root.present()?;
    }
    Ok(svg)
}

fn shape(area: &Area, shape: &SpotShape, at: [f64; 2], sigma: f64, title: &str) -> anyhow::Result<()> {
    let mut chart = ChartBuilder::on(area)
        .caption(title, FONT)
        .margin(6)
        .build_cartesian_2d(0..CELLS, 0..CELLS)?;
    let peak = shape.density(at, [0.0; 2]);
    let place = |k: i32| REACH * sigma * (2.0 * (f64::from(k) + 0.5) / f64::from(CELLS) - 1.0);
    let cells = (0..CELLS * CELLS).map(|k| (k % CELLS, k / CELLS));
    chart.draw_series(cells.map(|(i, j)| {
        let light = shape.density(at, [place(i), place(j)]) / peak;
        Rectangle::new([(i, j), (i + 1, j + 1)], brightness(light).filled())
    }))?;
    Ok(())
}

fn brightness(light: f64) -> RGBColor {
    let level = 1.0 - light.max(FAINTEST).ln() / FAINTEST.ln();
    let grey = (255.0 * (1.0 - 0.95 * level.clamp(0.0, 1.0))) as u8;
    RGBColor(grey, grey, 255 - (0.6 * f64::from(255 - grey)) as u8)
}

fn over_field(area: &Area, camera: &Camera, learned: &SpotShape, sigma: f64) -> anyhow::Result<()> {
    let area = area.titled("The spot over the field", FONT)?;
    let cells = area.split_evenly((3, 3));
    for (k, cell) in cells.iter().enumerate() {
        let place = |k: usize, half: f64| 0.8 * half * (k as f64 - 1.0);
        let at = [
            place(k % 3, camera.x.half_width()),
            place(2 - k / 3, camera.y.half_width()),
        ];
        shape(cell, learned, at, sigma, "")?;
    }
    Ok(())
}

fn residual(area: &Area, values: &ndarray::Array2<f64>, largest: f64, title: &str) -> anyhow::Result<()> {
    let (ny, nx) = values.dim();
    let caption = format!("{title} (±{:.2} % of the norm)", 100.0 * largest);
    let mut chart = ChartBuilder::on(area)
        .caption(caption, FONT)
        .margin(6)
        .build_cartesian_2d(0..nx as i32, 0..ny as i32)?;
    chart.draw_series(values.indexed_iter().map(|((j, i), value)| {
        let level = (value / largest).clamp(-1.0, 1.0);
        let pale = (255.0 * (1.0 - level.abs())) as u8;
        let colour = if level > 0.0 {
            RGBColor(255, pale, pale)
        } else {
            RGBColor(pale, pale, 255)
        };
        Rectangle::new([(i as i32, j as i32), (i as i32 + 1, j as i32 + 1)], colour.filled())
    }))?;
    Ok(())
}

fn encircled(area: &Area, camera: &Camera, shape: &SpotShape, sigma: f64) -> anyhow::Result<()> {
    const STEPS: i32 = 60;
    let pitch = camera.x.pitch_m;
    let widest = (10.0 * sigma).min(shape.radius_m());
    let mut chart = ChartBuilder::on(area)
        .caption("Encircled energy, share of the learned light (grey: Gaussian)", SMALL)
        .margin(6)
        .x_label_area_size(34)
        .y_label_area_size(40)
        .build_cartesian_2d(0.0..widest / pitch, 0.0..1.02)?;
    chart.configure_mesh().x_desc("radius, pixels").draw()?;
    let radius = |k: i32| widest * f64::from(k) / f64::from(STEPS);
    let gaussian = |r: f64| 1.0 - (-0.5 * (r / sigma).powi(2)).exp();
    let grey = RGBColor(160, 160, 160);
    chart.draw_series(LineSeries::new(
        (0..=STEPS).map(|k| (radius(k) / pitch, gaussian(radius(k)))),
        &grey,
    ))?;
    let learned = (0..=STEPS).map(|k| (radius(k) / pitch, shape.encircled_energy([0.0; 2], radius(k))));
    chart.draw_series(LineSeries::new(learned, RGBColor(20, 60, 160).stroke_width(2)))?;
    Ok(())
}
