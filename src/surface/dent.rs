//! A dented junction under the bounded smoothing (figure 5 of the paper): what one sigma for the whole wall leaves of the
//! dent, and what a sigma of its own would leave at most (docs/adr/0044).

use crate::fields::{self, Analytic};
use crate::{PolygoniseSettings, polygonise};
use exec::Ctx;
use implicit::{Field, Sampled, Smoothing, foot, smooth};
use space::{P3, V3};

const PIXEL_MM: f64 = 0.5;

/// The benchmark anastomosis with a Gaussian dent in the host's wall opposite to the graft, 4 mm from the junction.
fn dented(depth: f64, width: f64) -> (Analytic, P3) {
    let whole = fields::anastomosis();
    let at = P3::new(-3.0, 0.0, 4.0);
    let bounds = whole.bounds;
    let f = move |x: P3| {
        let (f, g) = (whole.f)(x);
        let d = x - at;
        let dent = depth * (-0.5 * d.length_squared() / (width * width)).exp();
        (f - dent, g + d * (dent / (width * width)))
    };
    (Analytic { f: Box::new(f), bounds }, at)
}

/// How far the wall stands in from the undented one, mm.
fn depth(field: &dyn Field, at: P3) -> f64 {
    let floor = foot(field, at + V3::X * 0.1, 1.0).unwrap_or(at);
    floor.x() - at.x()
}

/// Sigma in pixels, the dent's depth before and after, and the largest displacements of dent and crotch, in pixels.
fn smoothed(width: f64, bound_px: f64, ctx: &Ctx) -> Result<[f64; 4], Box<dyn std::error::Error>> {
    let (field, at) = dented(0.4, width);
    let settings = PolygoniseSettings { cell_mm: PIXEL_MM, ..PolygoniseSettings::default() };
    let (raw, _) = polygonise(&field, &[P3::new(0.0, 0.0, 27.0)], &settings, ctx)?;
    let smoothing = Smoothing { max_displacement_px: bound_px, ..Smoothing::new(PIXEL_MM) };
    let sampled = Sampled::new(&field, &raw.vertices, &smoothing.sampling(), ctx)?;
    let wall: Vec<P3> = raw.vertices.iter().filter_map(|&p| foot(&sampled, p, PIXEL_MM)).collect();
    let (out, report) = smooth(&sampled, &wall, &smoothing, f64::INFINITY, ctx)?;
    let moved = report.forward_mm.max(report.backward_mm) / PIXEL_MM;
    Ok([report.sigma_mm / PIXEL_MM, depth(&sampled, at), depth(&out, at), moved])
}

#[test]
fn a_dented_junction_loses_most_of_its_dent_within_the_bound() {
    let ctx = Ctx::new(2).unwrap();
    for width in [0.35, 0.5, 0.7] {
        let [sigma, before, after, moved] = smoothed(width, 1.0, &ctx).unwrap();
        assert!(after.abs() <= 0.4 * before && moved <= 1.0, "{width}: {before} {after} mm, {moved} px");
        // One sigma for the whole wall is not wasted by its crotch: it stands at its own limit.
        assert!(sigma > 1.499, "{sigma}");
    }
    let [sigma, before, after, moved] = smoothed(0.5, 0.5, &ctx).unwrap();
    assert!(after <= 0.4 * before && moved <= 0.5 && sigma < 1.5, "{sigma} px, {before} {after} mm, {moved} px");
}
