//! The pictures of the study (SVG).

use std::path::Path;

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::exposure::{self, EXPOSURES_S};
use super::report::{PAPER, cells, front, is_paper_cell};
use super::{Error, PictureError, Row, Study, of_single_frames};
use crate::estimate::ESTIMATORS;

const SIZE: (u32, u32) = (900, 600);
/// Pixels a side that the axis goes to: beyond 100 there is room for the legend.
const ARRAYS: f64 = 145.0;
const FONT: (&str, i32) = ("sans-serif", 16);
/// Width of a letter and height of a line of it, px.
const LETTER: i32 = 8;
const LINE: i32 = 16;
const CAPTION: (&str, i32) = ("sans-serif", 22);

type Drawn = Result<(), Box<dyn std::error::Error + Send + Sync>>;

/// Draws the three pictures into `out`.
pub(super) fn draw(study: &Study, out: &Path) -> Result<(), Error> {
    type Draw = fn(&Study, &Path) -> Drawn;
    let pictures: [(&str, Draw); 3] = [
        ("accuracy-time.svg", accuracy_against_time),
        ("accuracy-array.svg", accuracy_against_array),
        ("resolvable.svg", resolvable),
    ];
    for (name, draw) in pictures {
        let path = out.join(name);
        draw(study, &path).map_err(|e| Error::Picture {
            path: path.clone(),
            message: PictureError(e),
        })?;
    }
    Ok(())
}

fn range(values: impl Iterator<Item = f64> + Clone) -> std::ops::Range<f64> {
    let usable = values.filter(|v| v.is_finite() && *v > 0.0);
    let lo = usable.clone().fold(f64::INFINITY, f64::min);
    let hi = usable.fold(0.0, f64::max);
    if lo > hi { 0.1..10.0 } else { 0.5 * lo..2.0 * hi }
}

fn colour(index: usize) -> RGBColor {
    let (r, g, b) = Palette99::pick(index).rgb();
    RGBColor(r, g, b)
}

/// The cell that the comparison is drawn for: the paper's hardest at about 60 pixels, or the first there is.
fn subject(study: &Study) -> Vec<&Row> {
    let cells = cells(study);
    let near = |rows: &Vec<&Row>| is_paper_cell(rows[0]).then(|| rows[0].cell.pixels.abs_diff(60));
    let best = cells.iter().filter(|r| near(r).is_some()).min_by_key(|r| near(r));
    best.or(cells.first()).cloned().unwrap_or_default()
}

fn accuracy_against_time(study: &Study, path: &Path) -> Drawn {
    let rows = subject(study);
    let Some(first) = rows.first() else { return Ok(()) };
    let area = SVGBackend::new(path, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let bound = first.bound_median_m2.unwrap_or(f64::NAN);
    let errors = rows.iter().filter_map(|r| r.median_m2).chain([bound]);
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("{}: accuracy against time", first.cell.name()), CAPTION)
        .margin(12)
        .x_label_area_size(45)
        .y_label_area_size(80)
        .build_cartesian_2d(
            range(rows.iter().map(|r| r.latency_median_us)).log_scale(),
            range(errors).log_scale(),
        )?;
    chart
        .configure_mesh()
        .x_desc("median time a frame, µs")
        .y_desc("median squared error, m²")
        .x_label_formatter(&|v| format!("{v:.0}"))
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .label_style(FONT)
        .draw()?;
    let times = range(rows.iter().map(|r| r.latency_median_us));
    chart
        .draw_series(LineSeries::new(
            [(times.start, bound), (times.end, bound)],
            BLACK.stroke_width(1),
        ))?
        .label("Cramér–Rao bound (median)")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], BLACK));
    let edge = front(&rows);
    let line = edge.iter().filter_map(|r| Some((r.latency_median_us, r.median_m2?)));
    chart
        .draw_series(LineSeries::new(line, BLUE.stroke_width(2)))?
        .label("Pareto front (time, OSPA)")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], BLUE));
    // Labels point inwards, each as near to its mark as others leave room, px.
    let middle = (times.start * times.end).sqrt();
    let mut taken: Vec<(std::ops::Range<i32>, i32)> = Vec::new();
    for row in &rows {
        let Some(error) = row.median_m2 else { continue };
        let at = (row.latency_median_us, error);
        let label = format!("{} (OSPA {:.2} m)", row.estimator, row.ospa_m);
        let width = LETTER * label.len() as i32;
        let (x, y) = chart.backend_coord(&at);
        let (side, dx, left) = match at.0 > middle {
            true => (HPos::Right, -10, x - 10 - width),
            false => (HPos::Left, 10, x + 10),
        };
        let is_free = |dy: &i32| {
            let mut beside = taken.iter().filter(|(xs, _)| left < xs.end && xs.start < left + width);
            beside.all(|(_, other)| (other - y - dy).abs() >= LINE)
        };
        let dy = [-10, 10, 26, -26, 42, -42].into_iter().find(is_free).unwrap_or(-10);
        taken.push((left..left + width, y + dy));
        let style = FONT.into_text_style(&area).pos(Pos::new(side, VPos::Center));
        let mark = EmptyElement::at(at) + Circle::new((0, 0), 5, BLUE.filled()) + Text::new(label, (dx, dy), style);
        chart.draw_series([mark])?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .border_style(BLACK)
        .background_style(WHITE)
        .draw()?;
    area.present()?;
    Ok(())
}

fn accuracy_against_array(study: &Study, path: &Path) -> Drawn {
    let rows: Vec<&Row> = study.rows.iter().filter(|r| is_paper_cell(r)).collect();
    let area = SVGBackend::new(path, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let errors = rows
        .iter()
        .flat_map(|r| [r.mean_m2, r.bound_median_m2])
        .flatten()
        .chain(PAPER.iter().flat_map(|p| [p.1, p.2]));
    let mut chart = ChartBuilder::on(&area)
        .caption("σ_eff 8 mm, paper reading: accuracy against array size", CAPTION)
        .margin(12)
        .x_label_area_size(45)
        .y_label_area_size(80)
        .build_cartesian_2d(0.0..ARRAYS, range(errors).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("pixels a side")
        .y_desc("mean squared error, m²")
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .label_style(FONT)
        .draw()?;
    let mut lines: Vec<(String, Vec<(f64, f64)>)> = of_single_frames()
        .map(|spec| {
            let own = rows.iter().filter(|r| r.estimator == spec.name);
            (
                spec.name.to_owned(),
                own.filter_map(|r| Some((r.cell.pixels as f64, r.mean_m2?))).collect(),
            )
        })
        .collect();
    let hybrid = PAPER.iter().map(|p| (p.0 as f64, p.1)).collect();
    let unet = PAPER.iter().map(|p| (p.0 as f64, p.2)).collect();
    lines.push(("the paper's hybrid".into(), hybrid));
    lines.push(("the paper's U-Net".into(), unet));
    let bound = rows.iter().filter(|r| r.estimator == ESTIMATORS[0].name);
    let bound = bound
        .filter_map(|r| Some((r.cell.pixels as f64, r.bound_median_m2?)))
        .collect();
    lines.push(("Cramér–Rao bound (median)".into(), bound));
    for (index, (name, mut points)) in lines.into_iter().enumerate() {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let style = colour(index).stroke_width(2);
        chart
            .draw_series(LineSeries::new(points, style).point_size(3))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .border_style(BLACK)
        .background_style(WHITE)
        .draw()?;
    area.present()?;
    Ok(())
}

fn resolvable(study: &Study, path: &Path) -> Drawn {
    let cells: Vec<&Row> = cells(study)
        .into_iter()
        .map(|r| r[0])
        .filter(|r| r.cell.is_plain())
        .collect();
    let area = SVGBackend::new(path, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .caption("Share of emitters that any estimator can resolve", CAPTION)
        .margin(12)
        .x_label_area_size(45)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..11.0, 0.0..1.05)?;
    chart
        .configure_mesh()
        .x_desc("σ_eff, mm")
        .y_desc("share")
        .label_style(FONT)
        .draw()?;
    for (index, (noise, name)) in [
        (super::Noise::Energy, "energy reading"),
        (super::Noise::Paper, "paper reading"),
    ]
    .into_iter()
    .enumerate()
    {
        let style = colour(index).filled();
        let points = cells.iter().filter(|r| r.cell.noise == noise);
        chart
            .draw_series(
                points
                    .clone()
                    .map(|r| Circle::new((r.cell.sigma_mm, r.resolvable), 5, style)),
            )?
            .label(name)
            .legend(move |(x, y)| Circle::new((x + 9, y), 5, style));
        chart.draw_series(points.map(|r| {
            Text::new(
                format!("  {0}×{0}", r.cell.pixels),
                (r.cell.sigma_mm, r.resolvable),
                FONT.into_font(),
            )
        }))?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .border_style(BLACK)
        .background_style(WHITE)
        .draw()?;
    area.present()?;
    Ok(())
}

/// Draws the accuracy in the paper's hardest scene against the time of observation to `path`.
pub(super) fn draw_exposures(rows: &[exposure::Row], path: &Path) -> Result<(), Error> {
    accuracy_against_observation(rows, path).map_err(|e| Error::Picture {
        path: path.to_owned(),
        message: PictureError(e),
    })
}

fn accuracy_against_observation(rows: &[exposure::Row], path: &Path) -> Drawn {
    let hardest = rows.iter().map(|r| r.cell.sigma_mm).fold(0.0, f64::max);
    let rows: Vec<_> = rows
        .iter()
        .filter(|r| r.cell.sigma_mm == hardest && !r.is_read_noise)
        .collect();
    let Some(first) = rows.first() else { return Ok(()) };
    let outcomes = rows.iter().flat_map(|r| r.outcomes.iter().flatten());
    let errors = outcomes.flat_map(|o| [Some(o.bound_m2), o.error_m2]).flatten();
    let area = SVGBackend::new(path, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .caption(
            format!(
                "{}: accuracy against observation time, at equal light",
                first.cell.name()
            ),
            CAPTION,
        )
        .margin(12)
        .x_label_area_size(45)
        .y_label_area_size(80)
        .build_cartesian_2d(
            range(rows.iter().map(|r| r.observed_s)).log_scale(),
            range(errors).log_scale(),
        )?;
    chart
        .configure_mesh()
        .x_desc("observation time, s")
        .y_desc("median squared error, m²")
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .label_style(FONT)
        .draw()?;
    for (index, exposure_s) in EXPOSURES_S.into_iter().enumerate() {
        let style = colour(index).stroke_width(2);
        let of = rows
            .iter()
            .filter_map(|r| Some((r.observed_s, r.outcomes[index].as_ref()?)));
        let bounds = of.clone().map(|(t, o)| (t, o.bound_m2));
        chart
            .draw_series(LineSeries::new(bounds, style).point_size(3))?
            .label(format!("bound, frames of {exposure_s} s"))
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
        let measured = of.filter_map(|(t, o)| Some((t, o.error_m2?)));
        chart.draw_series(measured.map(|at| TriangleMarker::new(at, 7, style)))?;
    }
    chart
        .draw_series(std::iter::empty::<Circle<(f64, f64), i32>>())?
        .label("`sequence`, in the colour of its frames")
        .legend(|(x, y)| TriangleMarker::new((x + 9, y), 7, BLACK));
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerLeft)
        .border_style(BLACK)
        .background_style(WHITE)
        .draw()?;
    area.present()?;
    Ok(())
}
