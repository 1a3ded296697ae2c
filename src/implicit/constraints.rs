//! Curves to constraints: f = 0 on the wall, f = offset inside, f < 0 past the ends.
//!
//! Wall points are spread over each curve by arc length and curvature and shifted from plane to plane, so that the
//! points of neighbouring planes interleave. Interior points lie along the inward normal at min(1 mm, a quarter of the
//! width of the lumen along that normal), which for a circle is half the radius: method section 3 found that the shape
//! collapses beyond twice the radius, and that half the radius is safe. Past every end of the data one exterior point
//! closes the function, which otherwise may run on or meet a neighbour's dome.
//!
//! Giordana et al., section 2.2 (boundary and interior constraints after Turk and O'Brien).

use crate::Settings;
use imaging::{Contours, Curve, Plane};
use space::{P3, V3};

/// Values wanted of f, with the error that each may have.
#[derive(Clone, Debug, Default)]
pub struct Constraints {
    /// Where.
    pub points: Vec<P3>,
    /// Wanted f, mm.
    pub values: Vec<f64>,
    /// Standard error of the wanted value, mm.
    pub sigma_mm: Vec<f64>,
    /// For each wall constraint the error of its contour's level, mm, which neighbours within [`Contours::LEVEL_MM`] share.
    pub level_mm: Vec<f64>,
    /// For each wall constraint its contour's degrees of freedom.
    pub freedom: Vec<f64>,
    /// The first `wall` constraints lie on the wall (value 0).
    pub wall: usize,
    /// For each interior constraint (they follow the wall) the wall point it belongs to and its distance, mm.
    pub interior: Vec<(usize, f64)>,
    /// For each wall constraint the curve it was taken from; `None` for a tip.
    pub curve: Vec<Option<usize>>,
    /// For each wall constraint how far its contour was moved by the planar half-maximum correction, mm outward in the
    /// plane; `None` where no other correction may take its place (tips, end planes, no known blur).
    pub planar_shift: Vec<Option<V3>>,
    /// For each wall constraint how far it lies from where its contour was drawn, mm: the half-maximum correction. Empty in the
    /// first pass, which draws nothing.
    pub correction_mm: Vec<f64>,
}

/// Fewest wall points per curve: a cubic radial basis needs about this many to carry an ellipse.
const LEAST_PER_CURVE: f64 = 10.0;
/// Most wall points per curve: a circle of 48 points is met to 1e-4 of its radius, so that a wide lumen needs no more.
const MOST_PER_CURVE: f64 = 48.0;
/// Golden ratio: shifts the first point from plane to plane so that neighbours interleave.
const GOLDEN: f64 = 0.618_033_988_749_895;
/// Relative error granted to interior values in the first pass, whose normals are only planar: at 45 degrees between
/// vessel and slice the true distance is .7 of the offset.
const PLANAR_NORMAL_ERROR: f64 = 0.2;
/// Relative error granted to interior values once the normals are three-dimensional: what is left is the difference
/// between f and a distance near the medial surface.
const SPATIAL_NORMAL_ERROR: f64 = 0.05;

/// A wall point before the interior points are known.
struct WallPoint {
    position: P3,
    inward: V3,
    width_mm: f64,
    sigma_mm: f64,
    level_mm: f64,
    freedom: f64,
    curve: usize,
    planar_shift: Option<V3>,
}

/// First pass: normals are those of the planar curves.
pub(crate) fn planar(contours: &Contours, settings: &Settings) -> Constraints {
    let wall = wall_points(contours, settings);
    let mut c = Constraints { wall: wall.len(), ..Constraints::default() };
    for w in &wall {
        c.points.push(w.position);
        c.values.push(0.0);
        c.sigma_mm.push(w.sigma_mm);
        c.level_mm.push(w.level_mm);
        c.freedom.push(w.freedom);
        c.curve.push(Some(w.curve));
        c.planar_shift.push(w.planar_shift);
    }
    push_tips(contours, &mut c);
    for (i, w) in wall.iter().enumerate() {
        let offset = offset(w.width_mm, settings);
        c.interior.push((i, offset));
        c.points.push(w.position + w.inward * offset);
        c.values.push(offset);
        c.sigma_mm.push(w.sigma_mm.max(PLANAR_NORMAL_ERROR * offset));
    }
    push_closing(contours, settings, &mut c);
    c
}

/// Second pass: the wall at `wall` (moved by the spatial correction), interior points along the three-dimensional normals
/// of the first function.
///
/// `normal(x)` gives the unit inward normal at a wall point, `inside(x)` whether a point is in the lumen.
pub(crate) fn spatial(
    first: &Constraints,
    wall: Vec<P3>,
    normal: impl Fn(P3) -> Option<V3>,
    inside: impl Fn(P3) -> bool,
) -> Constraints {
    let from_drawn = |(i, x): (usize, &P3)| first.planar_shift[i].map_or(0.0, |s| x.distance(first.points[i] - s));
    let mut c = Constraints {
        correction_mm: wall.iter().enumerate().map(from_drawn).collect(),
        points: wall,
        values: first.values[..first.wall].to_vec(),
        sigma_mm: first.sigma_mm[..first.wall].to_vec(),
        level_mm: first.level_mm.clone(),
        freedom: first.freedom.clone(),
        wall: first.wall,
        interior: Vec::new(),
        curve: first.curve.clone(),
        planar_shift: first.planar_shift.clone(),
    };
    for (k, &(i, planar_offset)) in first.interior.iter().enumerate() {
        let x = c.points[i];
        let Some(n) = normal(first.points[i]) else { continue };
        // the inside check: twice the offset must still be lumen, else the offset passes the medial surface
        let mut offset = planar_offset;
        while offset > 0.1 * planar_offset && !inside(x + n * (2.0 * offset)) {
            offset *= 0.5;
        }
        if offset <= 0.1 * planar_offset {
            continue;
        }
        c.interior.push((i, offset));
        c.points.push(x + n * offset);
        c.values.push(offset);
        let planar_sigma = first.sigma_mm[first.wall + k];
        c.sigma_mm.push((SPATIAL_NORMAL_ERROR * offset).min(planar_sigma));
    }
    let closing = first.wall + first.interior.len();
    c.points.extend_from_slice(&first.points[closing..]);
    c.values.extend_from_slice(&first.values[closing..]);
    c.sigma_mm.extend_from_slice(&first.sigma_mm[closing..]);
    c
}

fn offset(width_mm: f64, settings: &Settings) -> f64 {
    settings.offset_mm.min(0.25 * width_mm)
}

/// Wall points of all curves; the step between them grows until all constraints fit under the limit.
fn wall_points(contours: &Contours, settings: &Settings) -> Vec<WallPoint> {
    let finest = settings.step * contours.pixel_mm.max(0.5 * plane_spacing_mm(contours));
    // one interior point per wall point, and room for tips and closing points
    let room = settings.max_constraints.saturating_sub(64 + 2 * contours.tips.len()) / 2;
    let counted = Counted::of(contours);
    let (mut step, mut stride) = (finest, 1);
    let at = |c: &Curve| counted.number(c.plane);
    while counted.kept(contours, stride).map(|(_, c)| count_on(c, step)).sum::<usize>() > room {
        step *= 1.05;
        // beyond that planes are left out instead: their points interleave, so the step along the vessel may grow too
        if step > COARSEST * finest {
            (step, stride) = (finest, stride + 1);
        }
        if stride > contours.planes.len() {
            break;
        }
    }
    // what samples the constraints later on (roughness) goes by their order
    let mut kept: Vec<(usize, &Curve)> = counted.kept(contours, stride).collect();
    kept.sort_by_key(|(_, c)| at(c));
    let phase = |c: &Curve| (GOLDEN * at(c) as f64).fract();
    kept.into_iter().flat_map(|(i, c)| points_on(contours, i, c, step, phase(c))).collect()
}

/// Growth of the step between wall points of a contour before planes are left out.
const COARSEST: f64 = 2.5;

/// Planes counted from the end with more wall, so that slices in the other order give the same points.
struct Counted {
    last: usize,
    from_last: bool,
}

impl Counted {
    fn of(contours: &Contours) -> Self {
        let last = contours.planes.len().saturating_sub(1);
        let turn = |c: &Curve| c.length_mm() * (2.0 * c.plane as f64 - last as f64);
        Self { last, from_last: contours.curves.iter().map(turn).sum::<f64>() > 0.0 }
    }

    fn number(&self, plane: usize) -> usize {
        if self.from_last { self.last - plane } else { plane }
    }

    /// The curves of every `stride`-th plane, and of the first and the last.
    fn kept<'c>(&self, contours: &'c Contours, stride: usize) -> impl Iterator<Item = (usize, &'c Curve)> {
        let is_kept = move |number: usize| number.is_multiple_of(stride) || number == self.last;
        contours.curves.iter().enumerate().filter(move |(_, c)| is_kept(self.number(c.plane)))
    }
}

fn plane_spacing_mm(contours: &Contours) -> f64 {
    let mut d: Vec<f64> =
        contours.planes.windows(2).map(|p| (p[1].origin - p[0].origin).dot(p[0].normal()).abs()).collect();
    d.sort_by(f64::total_cmp);
    d.get(d.len() / 2).copied().unwrap_or(contours.pixel_mm)
}

fn count_on(curve: &Curve, step: f64) -> usize {
    (curve.length_mm() / step).ceil().clamp(LEAST_PER_CURVE, MOST_PER_CURVE) as usize
}

/// Points of one curve, denser where it bends: density = (1 + |kappa| R) / 2 with R = length / 2 pi, so that a circle
/// is sampled evenly.
///
/// `phase` in [0, 1) places the first one.
fn points_on(contours: &Contours, number: usize, curve: &Curve, step: f64, phase: f64) -> Vec<WallPoint> {
    let plane = &contours.planes[curve.plane];
    let length = curve.length_mm();
    let fine = 4 * count_on(curve, step).max(32);
    let radius = length / std::f64::consts::TAU;
    let mut cumulative = vec![0.0];
    for k in 0..fine {
        let p = curve.at(plane, (k as f64 + 0.5) * length / fine as f64);
        let density = 0.5 * (1.0 + (p.curvature_per_mm.abs() * radius).min(4.0));
        cumulative.push(cumulative[k] + density);
    }
    let total = cumulative[fine];
    let count = count_on(curve, step);
    let polygons = polygons(contours, curve.plane);
    // at the end planes the first function already closes: its bend along the vessel is not the wall's
    let at_end = contours.cuts.iter().any(|cut| {
        cut.outward.dot(plane.normal()).abs() > 0.999 && cut.height(plane.origin).abs() < 1e-3 * contours.pixel_mm
    });
    let mut out = Vec::with_capacity(count);
    let mut k = 0;
    for i in 0..count {
        let want = (i as f64 + phase) / count as f64 * total;
        while cumulative[k + 1] < want {
            k += 1;
        }
        let s = (k as f64 + (want - cumulative[k]) / (cumulative[k + 1] - cumulative[k])) * length / fine as f64;
        let p = curve.at(plane, s);
        if p.on_border {
            continue;
        }
        out.push(WallPoint {
            position: p.position,
            inward: p.inward,
            width_mm: width(plane, &polygons, p.position, p.inward).unwrap_or(2.0 * radius),
            sigma_mm: p.standard_error_mm.max(LEAST_SIGMA_PX * contours.pixel_mm),
            level_mm: curve.level_error_mm,
            freedom: curve.freedom,
            curve: number,
            planar_shift: contours.blur.filter(|_| !at_end).map(|b| p.inward * -b.planar_shift_mm(plane, &p)),
        });
    }
    out
}

/// Floor of the standard error in pixels. Without noise the contours of a discretised disc still err by about this much
/// (linear interpolation in marching squares), and a smaller one makes the system needlessly stiff.
const LEAST_SIGMA_PX: f64 = 0.005;

/// All curves of a plane as polygons in its (u, v).
fn polygons(contours: &Contours, plane: usize) -> Vec<Vec<[f64; 2]>> {
    const SIDES: usize = 96;
    let of_plane = contours.curves.iter().filter(|c| c.plane == plane);
    of_plane
        .map(|c| (0..SIDES).map(|k| c.spline.derivatives(k as f64 * c.length_mm() / SIDES as f64)[0]).collect())
        .collect()
}

/// Distance from a wall point along its inward normal to the other side of the lumen, mm.
fn width(plane: &Plane, polygons: &[Vec<[f64; 2]>], from: P3, inward: V3) -> Option<f64> {
    let o = plane.in_plane(from);
    let d = [inward.dot(plane.u), inward.dot(plane.v)];
    let mut best = f64::INFINITY;
    for polygon in polygons {
        for (k, a) in polygon.iter().enumerate() {
            let b = polygon[(k + 1) % polygon.len()];
            if let Some(t) = crossing(o, d, *a, b) {
                // the chord polygon passes within its sagitta of the start: skip it
                if t > 1e-2 * (b[0] - a[0]).hypot(b[1] - a[1]) + 1e-2 && t < best {
                    best = t;
                }
            }
        }
    }
    best.is_finite().then_some(best)
}

/// Ray parameter at which o + t d crosses the segment a-b.
fn crossing(o: [f64; 2], d: [f64; 2], a: [f64; 2], b: [f64; 2]) -> Option<f64> {
    let e = [b[0] - a[0], b[1] - a[1]];
    let w = [a[0] - o[0], a[1] - o[1]];
    let det = d[0] * e[1] - d[1] * e[0];
    if det.abs() < 1e-14 {
        return None;
    }
    let t = (w[0] * e[1] - w[1] * e[0]) / det;
    let q = (w[0] * d[1] - w[1] * d[0]) / det;
    (t > 0.0 && (0.0..1.0).contains(&q)).then_some(t)
}

/// Where a lumen ends inside the volume the wall closes at the tip.
fn push_tips(contours: &Contours, c: &mut Constraints) {
    for tip in &contours.tips {
        c.points.push(tip.position);
        c.values.push(0.0);
        c.sigma_mm.push(0.5 * contours.pixel_mm);
        c.level_mm.push(0.0);
        c.freedom.push(0.0);
        c.curve.push(None);
        c.planar_shift.push(None);
        c.wall += 1;
    }
}

/// A lumen is wide where its centre lies deeper than this many interior offsets.
const WIDE: f64 = 4.0;
/// Value of f wanted at the centre of a wide lumen, against its depth. The function is no distance there: half as much is
/// granted as error.
const MIDDLE: f64 = 0.7;

/// Exterior points past the ends. Their error is granted as their distance to the wall: they tell where outside is, not
/// where the wall is.
///
/// In a wide lumen the wall and the points just inside it leave the middle to extrapolation, which noise on the wall may
/// turn negative (an aorta of 10 mm radius became hollow): its centre is told to lie inside, about as deep as it does.
fn push_closing(contours: &Contours, settings: &Settings, c: &mut Constraints) {
    let mut push = |position: P3, depth: f64| {
        c.points.push(position);
        c.values.push(-depth);
        c.sigma_mm.push(0.5 * depth.abs());
    };
    for tip in &contours.tips {
        push(tip.position + tip.outward * contours.pixel_mm, contours.pixel_mm);
    }
    for curve in contours.curves.iter().filter(|c| !c.hole) {
        let plane = &contours.planes[curve.plane];
        let radius = curve.length_mm() / std::f64::consts::TAU;
        let samples: Vec<P3> = (0..64).map(|k| curve.at(plane, k as f64 / 64.0 * curve.length_mm()).position).collect();
        let Some(centre) = P3::centroid(&samples) else { continue };
        let depth = samples.iter().map(|p| p.distance(centre)).fold(f64::INFINITY, f64::min);
        if depth > WIDE * settings.offset_mm && is_inside(plane, &samples, centre) {
            push(centre, -MIDDLE * depth);
        }
        for cut in &contours.cuts {
            let parallel = cut.outward.dot(plane.normal()).abs() > 0.999;
            let touching = if parallel {
                (cut.height(centre).abs() < 1e-3 * contours.pixel_mm).then_some(centre)
            } else {
                border_middle(curve, plane).filter(|m| cut.height(*m) > -contours.pixel_mm)
            };
            if let Some(at) = touching {
                push(at + cut.outward * (2.0 * radius), radius);
            }
            // what closes the end must not open the middle of a wide lumen, where no wall point speaks
            if parallel && touching.is_some() && is_inside(plane, &samples, centre) {
                push(centre, -0.5 * radius);
            }
        }
    }
}

/// Whether a point of the plane lies within a closed polygon (crossing number).
fn is_inside(plane: &Plane, polygon: &[P3], point: P3) -> bool {
    let o = plane.in_plane(point);
    let corners: Vec<[f64; 2]> = polygon.iter().map(|&p| plane.in_plane(p)).collect();
    let crossings =
        (0..corners.len()).filter(|&k| crossing(o, [1.0, 0.0], corners[k], corners[(k + 1) % corners.len()]).is_some());
    crossings.count() % 2 == 1
}

/// Middle of a curve's parcel along the image border.
fn border_middle(curve: &Curve, plane: &Plane) -> Option<P3> {
    let &[a, b] = curve.border.first()?;
    let length = curve.length_mm();
    Some(curve.at(plane, a + 0.5 * (b - a).rem_euclid(length)).position)
}
