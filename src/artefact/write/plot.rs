//! The report's plots, as SVG: angle against fitting distance, radius along each branch.

use super::style::{ANGLE_RGB, role_rgb};
use super::{Error, REPORT_HTML};
use morphometry::{Branch, Junction, Section};
use plotters::prelude::*;

/// Drawn size, user units; the page scales it. The plots are drawn in whole units, so that they must be many.
const SIZE: (u32, u32) = (2080, 990);
const TEXT: u32 = 58;
/// Room above and below the curves, parts of their range.
const MARGIN: f64 = 0.08;

/// A curve; gaps in it are gaps in the drawing.
pub(crate) struct Curve {
    pub points: Vec<Option<(f64, f64)>>,
    pub rgb: [u8; 3],
    pub stroke: Stroke,
}

/// How a curve is drawn.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stroke {
    Solid,
    Thin,
}

/// Change of each angle with the end of the fit window, against its reported value: the angles of a junction lie up to
/// 120 degrees apart, and on one axis a change of a degree would not be seen. `None` when no angle with a value knows its
/// dependence on distance.
///
/// # Errors
/// [`Error::Encode`].
pub(crate) fn angles_by_distance(j: &Junction) -> Result<Option<String>, Error> {
    let curves: Vec<Curve> = j
        .angles
        .iter()
        .enumerate()
        .filter_map(|(i, a)| {
            let (d, reported) = (a.by_distance.as_ref()?, a.value_deg?);
            let points = d.diameters.iter().zip(&d.value_deg).map(|(&x, y)| y.map(|y| (x, y - reported))).collect();
            Some(Curve { points, rgb: ANGLE_RGB[i % ANGLE_RGB.len()], stroke: Stroke::Solid })
        })
        .collect();
    chart(&curves, "end of the fit window, graft diameters", "change, degrees", Floor::Free)
}

/// Area-equivalent (solid) and inscribed radius (thin) along every branch; `None` without sections.
///
/// # Errors
/// [`Error::Encode`].
pub(crate) fn radius_along_branches(branches: &[Branch]) -> Result<Option<String>, Error> {
    let curve = |b: &Branch, value: &dyn Fn(&Section) -> Option<f64>, stroke| Curve {
        points: b.sections.iter().map(|s| value(s).map(|r| (s.abscissa_mm, r))).collect(),
        rgb: role_rgb(b.role),
        stroke,
    };
    let curves: Vec<Curve> = branches
        .iter()
        .flat_map(|b| {
            [
                curve(b, &|s| Some(s.radius_inscribed_mm), Stroke::Thin),
                // within the junction a section cuts more than one branch
                curve(b, &|s| s.radius_area_mm().filter(|_| !s.in_junction), Stroke::Solid),
            ]
        })
        .collect();
    chart(&curves, "distance along the branch, mm", "radius, mm", Floor::Zero)
}

/// Where the vertical axis begins.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Floor {
    Zero,
    Free,
}

fn chart(curves: &[Curve], x_label: &str, y_label: &str, floor: Floor) -> Result<Option<String>, Error> {
    let finite = |&(x, y): &(f64, f64)| x.is_finite() && y.is_finite();
    let all: Vec<(f64, f64)> = curves.iter().flat_map(|c| c.points.iter().flatten().copied()).filter(finite).collect();
    if all.is_empty() {
        return Ok(None);
    }
    let extent = |pick: fn(&(f64, f64)) -> f64| {
        all.iter().map(pick).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
    };
    let ((x0, x1), (y0, y1)) = (extent(|p| p.0), extent(|p| p.1));
    let room = ((y1 - y0) * MARGIN).max(0.5);
    let y = match floor {
        Floor::Zero => 0.0..y1 * (1.0 + MARGIN) + 0.01,
        Floor::Free => (y0 - room)..(y1 + room),
    };
    let mut svg = String::new();
    draw(&mut svg, curves, (x0..x1.max(x0 + 1e-6), y), [x_label, y_label])
        .map_err(|reason| Error::Encode { artefact: REPORT_HTML, reason })?;
    // The page gives the size, so that a plot fills its column.
    Ok(Some(svg.replacen(&format!("width=\"{}\" height=\"{}\" ", SIZE.0, SIZE.1), "", 1)))
}

type Ranges = (std::ops::Range<f64>, std::ops::Range<f64>);

fn draw(svg: &mut String, curves: &[Curve], (x, y): Ranges, labels: [&str; 2]) -> Result<(), String> {
    let text = |e: &dyn std::fmt::Display| e.to_string();
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    let mut chart = ChartBuilder::on(&root)
        .margin(20)
        .margin_right(56)
        .x_label_area_size(165)
        .y_label_area_size(215)
        .build_cartesian_2d(x, y)
        .map_err(|e| text(&e))?;
    chart
        .configure_mesh()
        .x_desc(labels[0])
        .y_desc(labels[1])
        .x_labels(7)
        .y_labels(6)
        .set_all_tick_mark_size(16)
        .max_light_lines(0)
        .bold_line_style(RGBColor(0xe2, 0xe2, 0xe8).stroke_width(3))
        .axis_style(RGBColor(0x55, 0x55, 0x60).stroke_width(3))
        .label_style(("sans-serif", TEXT))
        .axis_desc_style(("sans-serif", TEXT))
        .x_label_formatter(&|v| tick(*v))
        .y_label_formatter(&|v| tick(*v))
        .draw()
        .map_err(|e| text(&e))?;
    for curve in curves {
        let [r, g, b] = curve.rgb;
        let style = match curve.stroke {
            Stroke::Solid => RGBColor(r, g, b).stroke_width(9),
            Stroke::Thin => RGBColor(r, g, b).mix(0.55).stroke_width(5),
        };
        for run in runs(&curve.points) {
            chart.draw_series(LineSeries::new(run, style)).map_err(|e| text(&e))?;
        }
    }
    root.present().map_err(|e| text(&e))
}

/// Stretches without a gap.
fn runs(points: &[Option<(f64, f64)>]) -> Vec<Vec<(f64, f64)>> {
    points
        .split(Option::is_none)
        .map(|run| run.iter().flatten().copied().collect::<Vec<_>>())
        .filter(|r| r.len() > 1)
        .collect()
}

/// A tick's text without trailing zeros.
fn tick(v: f64) -> String {
    let text = format!("{v:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_splits_a_curve_and_a_lone_point_is_no_line() {
        let p = |x: f64| Some((x, x));
        assert_eq!(runs(&[p(0.0), p(1.0), None, p(3.0), None, p(5.0), p(6.0)]).len(), 2);
    }

    #[test]
    fn nothing_to_plot_gives_no_plot() {
        assert!(matches!(chart(&[], "x", "y", Floor::Free), Ok(None)));
    }
}
