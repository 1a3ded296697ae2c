//! report.html: one self-contained A4 page without script.
//!
//! Pictures are PNG in base64, plots and overlays SVG, the styles inline; nothing is fetched. Warnings come first, since
//! the reader who stops after the first lines must have seen them. A vessel with one junction fits one page; further
//! junctions follow on pages of their own. What does not fit (more than [`WARNINGS`] warnings, [`BRANCHES`] branches,
//! [`FURTHER`] further junctions) is counted and found in result.json. No time and no host is printed, so that the page
//! is the same to the byte from run to run.

use super::render::{Camera, cameras, encode_png, picture};
use super::style::{ANGLE_RGB, angle_words, hex, role_rgb, role_words};
use super::{Error, REPORT_HTML, plot};
use crate::Reconstruction;
use crate::reconstruction::SlicePicture;
use askama::Template;
use image::ExtendedColorType;
use morphometry::{Angle, Branch, Junction, Role};
use space::{P3, V3};
use std::fmt::Write as _;

/// Warnings printed.
const WARNINGS: usize = 5;
/// Branches printed.
const BRANCHES: usize = 6;
/// Junctions printed after the main one.
const FURTHER: usize = 14;
/// Pixels of a picture of the surface: 91 mm wide at 230 dpi.
const PICTURE: [usize; 2] = [824, 470];
/// Smallest side of the part of a slice that is shown, pixels.
const CROP: f64 = 32.0;
/// Side of that part over the extent of the contours.
const CROP_ROOM: f64 = 1.7;

#[derive(Template)]
#[template(path = "report.html")]
struct Page {
    digest: String,
    version: &'static str,
    warnings: Vec<String>,
    more_warnings: usize,
    views: Vec<View>,
    legend: Vec<Swatch>,
    junction: Option<AngleTable>,
    further: Vec<AngleTable>,
    more_junctions: usize,
    angle_plot: Option<String>,
    radius_plot: Option<String>,
    slices: Vec<SliceView>,
    branches: Vec<[String; 6]>,
    more_branches: usize,
    quality: Vec<[String; 2]>,
}

struct View {
    title: String,
    svg: String,
}
struct Swatch {
    words: &'static str,
    colour: String,
}
struct AngleTable {
    title: String,
    rows: Vec<AngleRow>,
}
struct AngleRow {
    colour: String,
    words: String,
    measured: bool,
    value: String,
    band: String,
    window: String,
}
struct SliceView {
    title: String,
    svg: String,
}

/// report.html.
///
/// # Errors
/// [`Error::Mismatch`] for a slice picture whose pixels do not fit its size; [`Error::Encode`].
pub fn report_html(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    super::geometry::checked_mesh(REPORT_HTML, r.surface.mesh)?;
    let warnings = warning_lines(r);
    let main = r.main_junction();
    let others: Vec<&Junction> =
        r.morphometry.junctions.iter().filter(|j| main.is_none_or(|m| !std::ptr::eq(*j, m))).collect();
    let page = Page {
        digest: r.input.digest.clone(),
        version: env!("CARGO_PKG_VERSION"),
        more_warnings: warnings.len().saturating_sub(WARNINGS),
        warnings: warnings.into_iter().take(WARNINGS).collect(),
        views: views(r)?,
        legend: legend(r),
        junction: main.map(angle_table),
        further: others.iter().take(FURTHER).map(|j| angle_table(j)).collect(),
        more_junctions: others.len().saturating_sub(FURTHER),
        angle_plot: main.map_or(Ok(None), plot::angles_by_distance)?,
        radius_plot: plot::radius_along_branches(&r.morphometry.branches)?,
        slices: r.pictures.iter().take(3).map(slice_view).collect::<Result<_, _>>()?,
        branches: branch_rows(r),
        more_branches: r.morphometry.branches.len().saturating_sub(BRANCHES),
        quality: quality(r),
    };
    let text = page.render().map_err(|e| Error::Encode { artefact: REPORT_HTML, reason: e.to_string() })?;
    Ok(text.into_bytes())
}

/// A number or a dash.
fn text(value: Option<f64>, decimals: usize) -> String {
    value.filter(|x| x.is_finite()).map_or("\u{2013}".to_owned(), |x| format!("{x:.decimals$}"))
}

fn angle_table(j: &Junction) -> AngleTable {
    let row = |(i, a): (usize, &Angle)| AngleRow {
        colour: hex(ANGLE_RGB[i % ANGLE_RGB.len()]),
        words: angle_words(&a.name),
        measured: a.value_deg.is_some(),
        value: text(a.value_deg, 1),
        band: a.band95_deg.map_or(text(None, 1), |b| format!("{:.1} \u{2013} {:.1}", b[0], b[1])),
        window: a.window_diameters.map_or(text(None, 1), |w| format!("{:.1} \u{2013} {:.1}", w[0], w[1])),
    };
    let p = j.axes_point.unwrap_or(j.medial_point);
    AngleTable {
        title: format!("Junction {} at LPS ({:.1}, {:.1}, {:.1}) mm", j.node, p.x(), p.y(), p.z()),
        rows: j.angles.iter().enumerate().map(row).collect(),
    }
}

fn branch_rows(r: &Reconstruction<'_>) -> Vec<[String; 6]> {
    let mut all: Vec<_> = r.morphometry.branches.iter().collect();
    // Those of the junction that is shown before a tree's others.
    let shown = r.main_junction().map_or(&[][..], |j| &j.branches);
    all.sort_by_key(|b| (!shown.contains(&b.id), b.role == Role::Other, b.id));
    all.iter()
        .take(BRANCHES)
        .map(|b| {
            [
                hex(role_rgb(b.role)),
                format!("{} ({})", role_words(b.role), b.id),
                text(Some(b.length_mm), 1),
                text(b.diameter_mm, 2),
                text(Some(b.tortuosity), 3),
                text(b.helix.map(|h| h.torsion_per_mm), 3),
            ]
        })
        .collect()
}

fn quality(r: &Reconstruction<'_>) -> Vec<[String; 2]> {
    let (q, i, f) = (&r.surface.quality, &r.input, &r.implicit);
    let missing = match i.missing_slices.len() {
        0 => String::new(),
        n => format!(", {n} missing"),
    };
    let rows = [
        ("Slices", format!("{}{missing}", i.slices)),
        ("Spacing", format!("{:.3} \u{d7} {:.3} \u{d7} {:.3} mm", i.spacing_mm[0], i.spacing_mm[1], i.spacing_mm[2])),
        ("Contours", format!("{} across the {} axis", r.segmentation.contours, r.segmentation.axis)),
        (
            "Constraints",
            format!("{}; residual {:.3} mm rms, {:.3} max", f.constraints, f.residual_rms_mm, f.residual_max_mm),
        ),
        (
            "Surface",
            format!(
                "{} triangles, {:.0} mm\u{b2}, {:.0} mm\u{b3}",
                r.surface.mesh.triangles.len(),
                q.area_mm2,
                q.volume_mm3
            ),
        ),
        (
            "Topology",
            format!(
                "{}, Euler number {}, {} piece{}",
                if q.watertight { "watertight" } else { "NOT watertight" },
                q.euler,
                q.components,
                if q.components == 1 { "" } else { "s" }
            ),
        ),
        ("Triangle angles", format!("{:.1}\u{b0} to {:.1}\u{b0}", q.min_angle_deg, q.max_angle_deg)),
        ("Mesh error", format!("{:.3} mm, {:.4} rms", q.max_error_mm, q.report.mesh.face_rms_mm)),
        (
            "Smoothing",
            format!(
                "{:+.2} to {:+.2} px, {:.2} rms",
                q.displacement_px.min, q.displacement_px.max, q.displacement_px.rms
            ),
        ),
    ];
    rows.into_iter().map(|(k, v)| [k.to_owned(), v]).collect()
}

fn legend(r: &Reconstruction<'_>) -> Vec<Swatch> {
    let order = [Role::Graft, Role::Proximal, Role::Distal, Role::HostA, Role::HostB, Role::Other];
    let present = |role: &&Role| (0..r.graph.edges.len()).any(|e| r.role_of_edge(e).unwrap_or(Role::Other) == **role);
    let swatch = |&role: &Role| Swatch { words: role_words(role), colour: hex(role_rgb(role)) };
    order.iter().filter(present).map(swatch).collect()
}

fn views(r: &Reconstruction<'_>) -> Result<Vec<View>, Error> {
    let plane = r.main_junction().is_some_and(|j| j.plane_normal.is_some());
    let titles = if plane {
        ["Onto the plane of graft and proximal vessel", "Along that plane"]
    } else {
        ["From anterior", "From the side"]
    };
    let all = cameras(r, PICTURE);
    all.iter()
        .zip(titles)
        .map(|(camera, title)| Ok(View { title: title.to_owned(), svg: view_svg(r, camera, &all)? }))
        .collect()
}

/// The first warning of each code, with its place and the number of others like it.
fn warning_lines(r: &Reconstruction<'_>) -> Vec<String> {
    let all = r.all_warnings();
    let mut kinds: Vec<(&str, String, usize)> = Vec::new();
    for w in &all {
        if let Some(kind) = kinds.iter_mut().find(|k| k.0 == w.code) {
            kind.2 += 1;
            continue;
        }
        let line = if w.place.is_none() { w.message.clone() } else { format!("{} ({})", w.message, w.place) };
        kinds.push((w.code, line, 0));
    }
    kinds
        .into_iter()
        .map(|(_, line, more)| if more == 0 { line } else { format!("{line}; {more} more like it") })
        .collect()
}

/// A picture with the names of the branches, the angles that it shows best, a scale bar and the patient's directions.
fn view_svg(r: &Reconstruction<'_>, camera: &Camera, all: &[Camera]) -> Result<String, Error> {
    let [width, height] = camera.size;
    let png = base64(&picture(r, camera).png()?);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"surface with medial lines\"><image width=\"{width}\" height=\"{height}\" href=\"data:image/png;base64,{png}\"/>"
    );
    let main = r.main_junction();
    let mut arcs = main.map_or_else(Vec::new, |j| super::arcs::arcs(r, j));
    arcs.retain(|arc| arc.is_for(camera, all));
    let mut taken: Vec<[f64; 3]> = arcs.iter().flat_map(|arc| arc.room(camera)).collect();
    // Of a tree's many branches those are named whose angles are shown.
    let named = |b: &&Branch| b.role != Role::Other && main.is_none_or(|j| j.branches.contains(&b.id));
    for b in r.morphometry.branches.iter().filter(named) {
        branch_label(&mut svg, r, camera, b, &mut taken);
    }
    for arc in &arcs {
        arc.draw(&mut svg, camera);
    }
    scale_bar(&mut svg, camera);
    directions(&mut svg, camera);
    svg.push_str("</svg>");
    Ok(svg)
}

/// Width of a letter of a label and height of its line, px.
pub(super) const LETTER: [f64; 2] = [14.0, 30.0];
/// Where along a branch its name is tried.
const NAMED_AT: [f64; 4] = [0.67, 0.85, 0.5, 0.33];

/// A branch's name beside the vessel, on the side to which it leans if nothing stands there (`taken`: left, right and base
/// line of what does). A name without room is left out: the legend has its colour.
fn branch_label(svg: &mut String, r: &Reconstruction<'_>, camera: &Camera, b: &Branch, taken: &mut Vec<[f64; 3]>) {
    let Some(e) = r.graph.edges.get(b.id) else { return };
    let words = role_words(b.role);
    let is_free = |&(.., [left, right, y]): &LabelPlace| {
        taken.iter().all(|t: &[f64; 3]| right < t[0] || left > t[1] || (y - t[2]).abs() > LETTER[1])
    };
    let n = e.points.len();
    let found = NAMED_AT.iter().find_map(|part| {
        let k = ((n as f64 * part) as usize).min(n.saturating_sub(1));
        let (k, start) = if e.nodes[1] == b.to_node { (k, 0) } else { (n.saturating_sub(1 + k), n.saturating_sub(1)) };
        let (&p, &start, &radius) = (e.points.get(k)?, e.points.get(start)?, e.radius_mm.get(k)?);
        let finite = p.is_finite() && start.is_finite() && radius.is_finite();
        if finite { label_places(camera, [start, p], radius, words).into_iter().find(is_free) } else { None }
    });
    if let Some((x, y, anchor, extent)) = found {
        taken.push(extent);
        label(svg, [x, y], anchor, &hex(role_rgb(b.role)), words);
    }
}

/// Base point, anchor, and left, right and base line of a text.
type LabelPlace = (f64, f64, &'static str, [f64; 3]);

/// The two places beside a vessel that comes from `start` to `p`, the better first.
fn label_places(camera: &Camera, [start, p]: [P3; 2], radius: f64, words: &str) -> [LabelPlace; 2] {
    let ([x, y, _], [x0, y0, _]) = (camera.project(p), camera.project(start));
    let length = (x - x0).hypot(y - y0).max(1e-9);
    let (dx, dy) = ((x - x0) / length, (y - y0) / length);
    let off = 1.15 * radius / camera.mm_per_px + 14.0;
    let [width, height] = camera.size.map(|n| n as f64);
    let wide = LETTER[0] * words.len() as f64;
    let place = |side: f64| {
        let (nx, ny) = if dy.abs() > 0.3 { (side * dy.abs(), side * -dx * dy.signum()) } else { (0.0, side) };
        let y = (y + ny * (off + 8.0) + 8.0).clamp(30.0, height - 60.0);
        if nx == 0.0 {
            let x = x.clamp(60.0, width - 60.0);
            (x, y, "middle", [x - 0.5 * wide, x + 0.5 * wide, y])
        } else if nx > 0.0 {
            let x = (x + nx * off).min(width - 110.0);
            (x, y, "start", [x, x + wide, y])
        } else {
            let x = (x + nx * off).max(110.0);
            (x, y, "end", [x - wide, x, y])
        }
    };
    // To the right of a branch that leans right, to the left of any other, under a level one.
    let first = if dx > 0.02 || dy.abs() <= 0.3 { 1.0 } else { -1.0 };
    [place(first), place(-first)]
}

pub(super) fn label(svg: &mut String, at: [f64; 2], anchor: &str, colour: &str, words: &str) {
    // Writing into a String cannot fail.
    let _ = write!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\" stroke=\"#fff\" stroke-width=\"6\" paint-order=\"stroke\" stroke-linejoin=\"round\" font-size=\"26\" font-weight=\"600\">{words}</text>",
        at[0], at[1]
    );
}

/// The largest 1, 2 or 5 times a power of ten mm that takes at most a quarter of the width, bottom left.
fn scale_bar(svg: &mut String, camera: &Camera) {
    let limit = 0.25 * camera.size[0] as f64 * camera.mm_per_px;
    let decade = 10f64.powf(limit.log10().floor());
    let mm = [5.0, 2.0, 1.0].into_iter().map(|k| k * decade).find(|&x| x <= limit).unwrap_or(decade);
    let (x, y) = (16.0, camera.size[1] as f64 - 16.0);
    let end = x + mm / camera.mm_per_px;
    let _ = write!(
        svg,
        "<path d=\"M{x:.1} {a:.1}V{y:.1}H{end:.1}V{a:.1}\" fill=\"none\" stroke=\"#222\" stroke-width=\"3\"/>",
        a = y - 10.0
    );
    label(svg, [0.5 * (x + end), y - 14.0], "middle", "#222", &format!("{mm} mm"));
}

/// Patient directions that lie in the picture, bottom right.
fn directions(svg: &mut String, camera: &Camera) {
    let (cx, cy, arm) = (camera.size[0] as f64 - 64.0, camera.size[1] as f64 - 64.0, 34.0);
    for (axis, name) in [(V3::X, "L"), (V3::Y, "P"), (-V3::Y, "A"), (V3::Z, "H")] {
        let (dx, dy) = (axis.dot(camera.right), -axis.dot(camera.up));
        // P and A share a line: the one that points up or right is drawn; short arms say nothing.
        let twin = axis.y() != 0.0 && (dx < -1e-9 || (dx.abs() <= 1e-9 && dy > 0.0));
        if twin || dx.hypot(dy) < 0.35 {
            continue;
        }
        let (x, y) = (cx + arm * dx, cy + arm * dy);
        let _ = write!(svg, "<path d=\"M{cx:.1} {cy:.1}L{x:.1} {y:.1}\" stroke=\"#222\" stroke-width=\"3\"/>");
        let gap = 17.0 / dx.hypot(dy);
        label(svg, [x + gap * dx, y + gap * dy + 8.0], "middle", "#222", name);
    }
}

/// The part of a slice around its contours, with the contours on it.
fn slice_view(s: &SlicePicture) -> Result<SliceView, Error> {
    super::error::same_length(REPORT_HTML, "pixels of a slice picture", s.columns * s.rows, s.pixels.len())?;
    let [x0, y0, width, height] = crop(s);
    let pixels: Vec<u8> =
        (y0..y0 + height).flat_map(|y| s.pixels[y * s.columns + x0..][..width].iter().copied()).collect();
    let png = base64(&encode_png(&pixels, [width, height], ExtendedColorType::L8)?);
    let aspect = if s.pixel_aspect.is_finite() && s.pixel_aspect > 0.0 { s.pixel_aspect } else { 1.0 };
    let tall = height as f64 * aspect;
    let mut svg = format!(
        "<svg viewBox=\"0 0 {width} {tall:.3}\" role=\"img\" aria-label=\"slice with contours\"><g transform=\"scale(1 {aspect:.6})\"><image width=\"{width}\" height=\"{height}\" preserveAspectRatio=\"none\" href=\"data:image/png;base64,{png}\"/>"
    );
    for line in s.polylines.iter().filter(|l| l.len() > 1) {
        svg.push_str("<path d=\"");
        for (i, [x, y]) in line.iter().enumerate() {
            // Pixel centres lie at half units of the picture.
            let (x, y) = (x - x0 as f64 + 0.5, y - y0 as f64 + 0.5);
            let _ = write!(svg, "{}{x:.2} {y:.2}", if i == 0 { "M" } else { "L" });
        }
        svg.push_str(
            "Z\" fill=\"none\" stroke=\"#ffb000\" stroke-width=\"1.6\" vector-effect=\"non-scaling-stroke\"/>",
        );
    }
    svg.push_str("</g></svg>");
    Ok(SliceView { title: s.title.clone(), svg })
}

/// [first column, first row, columns, rows] of the part that is shown: a square (in mm) around the contours, moved
/// inside the slice; the whole slice without contours.
fn crop(s: &SlicePicture) -> [usize; 4] {
    let points: Vec<[f64; 2]> =
        s.polylines.iter().flatten().copied().filter(|p| p[0].is_finite() && p[1].is_finite()).collect();
    if points.is_empty() {
        return [0, 0, s.columns, s.rows];
    }
    let extent =
        |k: usize| points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p[k]), b.max(p[k])));
    let aspect = if s.pixel_aspect > 0.0 { s.pixel_aspect } else { 1.0 };
    let (x, y) = (extent(0), extent(1));
    let side = ((x.1 - x.0).max((y.1 - y.0) * aspect) * CROP_ROOM).max(CROP);
    let axis = |(low, high): (f64, f64), side: f64, n: usize| {
        let length = (side.round() as usize).clamp(1, n.max(1)).min(n);
        let start = (0.5 * (low + high) - 0.5 * length as f64 + 0.5).round().max(0.0) as usize;
        (start.min(n - length), length)
    };
    let ((x0, width), (y0, height)) = (axis(x, side, s.columns), axis(y, side / aspect, s.rows));
    [x0, y0, width, height]
}

/// Base64 with padding (RFC 4648).
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().enumerate().fold(0u32, |w, (i, &b)| w | u32::from(b) << (16 - 8 * i));
        for i in 0..4 {
            let letter = ALPHABET[(word >> (18 - 6 * i)) as usize & 63];
            out.push(if i <= chunk.len() { char::from(letter) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::fixture::Fixture;
    use super::*;

    #[test]
    fn a_name_stands_on_nothing_or_is_left_out() {
        let f = Fixture::new();
        let r = f.reconstruction();
        let free = |taken: &[[f64; 3]]| {
            let apart = |a: &[f64; 3], b: &[f64; 3]| a[1] < b[0] || a[0] > b[1] || (a[2] - b[2]).abs() > LETTER[1];
            taken.iter().enumerate().all(|(i, a)| taken[..i].iter().all(|b| apart(a, b)))
        };
        let times = 2 * NAMED_AT.len() + 1;
        for camera in cameras(&r, PICTURE) {
            for b in &r.morphometry.branches {
                let (mut svg, mut taken) = (String::new(), Vec::new());
                (0..times).for_each(|_| branch_label(&mut svg, &r, &camera, b, &mut taken));
                assert!((1..times).contains(&taken.len()), "{} names of {times}", taken.len());
                assert_eq!(svg.matches("<text").count(), taken.len());
                assert!(free(&taken));
            }
        }
    }

    #[test]
    fn base64_of_rfc_4648() {
        let cases =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("foobar", "Zm9vYmFy")];
        for (plain, coded) in cases {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }

    #[test]
    fn a_crop_stays_inside_the_slice() {
        let corner = SlicePicture {
            columns: 100,
            rows: 60,
            pixel_aspect: 2.0,
            pixels: vec![0; 6000],
            polylines: vec![vec![[95.0, 1.0], [99.0, 3.0]]],
            ..SlicePicture::default()
        };
        assert_eq!(crop(&corner), [68, 0, 32, 16]);
        assert_eq!(crop(&SlicePicture { polylines: vec![], ..corner }), [0, 0, 100, 60]);
    }
}
