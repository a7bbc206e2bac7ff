//! Draws a frame of a scene with its truth as SVG.

use std::path::Path;

use anyhow::{Context, bail};
use plotters::prelude::*;

use crate::scene::{Plan, Role};

/// Pixels a side beyond which blocks of them are drawn as one.
const MOST_CELLS: usize = 128;

/// Draws frame `k` into an SVG file: collected energy in colour (asinh, so that faint spots show beside strong ones), a circle
/// of radius 2σ_eff on every emitter, axes in metres on the ground.
pub fn draw(path: &Path, plan: &Plan, k: u64) -> anyhow::Result<()> {
    if path.extension().is_none_or(|e| e != "svg") {
        bail!(
            "--picture: expected a file name that ends in .svg, found {}",
            path.display()
        );
    }
    let mut svg = String::new();
    render(&mut svg, plan, k).with_context(|| format!("drawing frame {k}"))?;
    std::fs::write(path, svg).with_context(|| path.display().to_string())
}

fn render(svg: &mut String, plan: &Plan, k: u64) -> anyhow::Result<()> {
    let simulated = plan.frame(k);
    let camera = plan.camera();
    let scale = camera.ground_scale();
    let (half_x, half_y) = (camera.x.half_width() * scale, camera.y.half_width() * scale);
    let width = 760;
    let height = (f64::from(width) * half_y / half_x) as u32 + 60;
    let root = SVGBackend::with_string(svg, (width, height)).into_drawing_area();
    root.fill(&WHITE)?;
    let caption = format!(
        "Frame {k}, {} in view",
        simulated.truth.emitters.iter().filter(|e| e.in_view).count()
    );
    let mut chart = ChartBuilder::on(&root)
        .caption(caption, ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(-half_x..half_x, -half_y..half_y)?;
    chart
        .configure_mesh()
        .disable_mesh()
        .x_desc("x, m")
        .y_desc("y, m")
        .draw()?;

    let pixels = &simulated.frame.pixels;
    let (ny, nx) = pixels.dim();
    let block = ny.max(nx).div_ceil(MOST_CELLS);
    let noise = camera.noise_std_j;
    let brightest = pixels.iter().copied().filter(|p| p.is_finite()).fold(noise, f64::max);
    let top = (brightest / (3.0 * noise)).asinh();
    let shade = |energy: f64| {
        let level = ((energy / (3.0 * noise)).asinh() / top).clamp(0.0, 1.0);
        let grey = (255.0 * (1.0 - 0.92 * level)) as u8;
        RGBColor(grey, grey, (255.0 * (1.0 - 0.75 * level)) as u8)
    };
    let cells = pixels.exact_chunks((block.min(ny), block.min(nx)));
    let per_row = nx / block.min(nx);
    let rectangles = cells.into_iter().enumerate().map(|(index, cell)| {
        let (row, column) = (index / per_row * block, index % per_row * block);
        let mean = cell.sum() / cell.len() as f64;
        let colour = if mean.is_finite() {
            shade(mean)
        } else {
            RGBColor(230, 200, 200)
        };
        let x = |c: usize| camera.x.edge(c) * scale;
        let y = |r: usize| camera.y.edge(r) * scale;
        let corners = [
            (x(column), y(row)),
            (x((column + block).min(nx)), y((row + block).min(ny))),
        ];
        Rectangle::new(corners, colour.filled())
    });
    chart.draw_series(rectangles)?;

    let radius = (2.0 * camera.spot_sigma_m * scale / (2.0 * half_x) * f64::from(width - 70)).max(5.0) as i32;
    for emitter in &simulated.truth.emitters {
        let colour = match emitter.role {
            Role::Intruder => RGBColor(200, 30, 30),
            Role::User | Role::Random => RGBColor(0, 120, 60),
        };
        let name = emitter.user.as_deref().unwrap_or("");
        let at = (emitter.x_m, emitter.y_m);
        let label = Text::new(
            name.to_owned(),
            (radius + 3, -6),
            ("sans-serif", 14).into_font().color(&colour),
        );
        chart.draw_series([EmptyElement::at(at) + Circle::new((0, 0), radius, colour.stroke_width(2)) + label])?;
    }
    root.present()?;
    drop(chart);
    Ok(())
}
