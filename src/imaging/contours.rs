//! The whole of imaging: segment, choose the axis, draw, smooth, correct, find the ends.

use crate::blur::Blur;
use crate::draw::{Drawn, Frame, Outline, axis, drawn, planes};
use crate::march::Line;
use crate::segment::{Segmentation, Site, Vessel, segment};
use crate::shape::{Shape, at_border};
use crate::smooth::{Profile, Smoothed, blur, corrected, smoothed};
use crate::spline::PeriodicSpline;
use crate::track::ends;
use crate::volume::median;
use crate::{Axis, Contours, Curve, Error, Plane, Settings, Stack};
use exec::Ctx;
use space::{Place, Warning};

/// What imaging found on its way.
#[derive(Clone, Debug)]
pub struct Report {
    /// Grey level of the wall: the plan's, or the median of the local levels over the lumen.
    pub threshold: f64,
    /// Point spread (Gaussian sigma, px) that was given or estimated; `None` when neither was possible.
    pub psf_sigma_px: Option<f64>,
    /// Number of contours.
    pub contours: usize,
    /// (plane index, number of lumens) of every plane that shows one.
    pub lumens: Vec<(usize, usize)>,
    /// Axis across which the contours were drawn.
    pub axis: Axis,
    /// The vessel taken, then its runners-up.
    pub candidates: Vec<Vessel>,
    /// Noise of the raw grey values, standard deviation.
    pub noise: f64,
    /// Lines dropped as specks of noise.
    pub specks: usize,
    /// What the reader must know.
    pub warnings: Vec<Warning>,
}

/// The smooth contours of the vessel tree in a stack.
///
/// Segmentation ([`segment`]), contour axis, marching squares on raw grey value minus local level, periodic smoothing
/// splines, half-maximum correction by the point spread, tips and cut planes. The stack must be [`Stack::validated`].
/// Curves are in plane order, numbered within their plane. The outcome has the same bits for any number of threads.
/// Cost: about 10 passes over the stack; memory about 4 copies of it.
///
/// # Errors
/// Those of [`segment`], [`Error::TooFewSlices`], [`Error::NoSuchSlice`], [`Error::TooFewContours`],
/// [`Error::Cancelled`].
pub fn contours(stack: &Stack, settings: &Settings, ctx: &Ctx) -> Result<(Contours, Report), Error> {
    ctx.check()?;
    let last = stack.slices() - 1;
    if let Some(&slice) = settings.exclude_slices.iter().find(|&&k| k > last) {
        return Err(Error::NoSuchSlice { field: "segmentation.exclude_slices", slice, last });
    }
    if settings.exclude_slices.is_empty() {
        return found(stack, settings, ctx);
    }
    let kept = stack.without(&settings.exclude_slices);
    if kept.slices() < 3 {
        return Err(Error::TooFewSlices { slices: kept.slices() });
    }
    // the region names a slice of the whole stack
    let region = settings.region.map(|mut r| {
        r.slice -= (0..r.slice).filter(|k| settings.exclude_slices.contains(k)).count();
        r
    });
    let mask = settings.mask.as_ref().map(|m| m.without(&settings.exclude_slices, stack.rows * stack.columns));
    found(&kept, &Settings { region, mask, exclude_slices: Vec::new(), ..settings.clone() }, ctx)
}

fn found(stack: &Stack, settings: &Settings, ctx: &Ctx) -> Result<(Contours, Report), Error> {
    let s = segment(stack, settings, &ctx.part(0.0, 0.7))?;
    let axis = settings.axis.unwrap_or_else(|| axis(stack, &s));
    let planes = planes(stack, axis);
    let mut drawn = drawn(stack, &s, axis, ctx)?;
    let mut warnings = stack.gap_warnings();
    warnings.extend(s.warnings.iter().cloned());
    warnings.extend(Shape::new(stack, axis, &planes, s.low, &drawn).without_pieces(&mut drawn));
    warnings.extend(Shape::new(stack, axis, &planes, s.low, &drawn).warnings(&drawn, ctx)?);
    warnings.extend(at_border(axis, &drawn, &planes));
    ctx.progress(0.8);
    let shown = drawn.iter().filter(|d| !d.outlines.is_empty()).count();
    if shown < 3 {
        return Err(Error::TooFewContours { planes: shown });
    }
    let outlines: Vec<(usize, usize)> =
        drawn.iter().enumerate().flat_map(|(k, d)| (0..d.outlines.len()).map(move |o| (k, o))).collect();
    let smooth = ctx.map(&outlines, |&(k, o)| smoothed(&drawn[k].outlines[o].line))?;
    ctx.progress(0.9);
    let sigma_mm = match settings.psf_sigma_px {
        Some(px) => Some(px * stack.pixel_mm()),
        None => psf(&Sheets { stack, s: &s, axis, drawn: &drawn, planes: &planes }, &outlines, &smooth, ctx)?,
    };
    if sigma_mm.is_none() {
        let message = "the point spread could not be estimated: contours are corrected for pixel and slice thickness \
                       alone, and convex lumens come out too small by kappa/2 sigma^2";
        warnings.push(Warning::new("contours.psf_unknown", message, Place::none()));
    }
    // the pixel and the slice blur whatever the point spread
    let acquired = Some(Blur::of(stack, sigma_mm.unwrap_or(0.0)));
    if acquired.is_some() && stack.thickness_mm.is_none() {
        let spacing = stack.slice_spacing_mm();
        let message = format!(
            "the slice thickness is not known and was taken as the slices' distance, {spacing:.3} mm; where slices overlap \
             or leave gaps, walls oblique to them err by .1 to 2 % of area"
        );
        warnings.push(Warning::new("contours.thickness_unknown", message, Place::none()));
    }
    let mut curves = ctx.map_range(outlines.len(), |i| {
        let (k, o) = outlines[i];
        let outline = &drawn[k].outlines[o];
        let drawn_small = interpolation(stack, axis);
        let variance = acquired.map(|b| b.in_plane(&planes[outline.plane]));
        let level_error_mm = level_error(&s, axis, (outline, &planes[outline.plane]), variance);
        let variance = variance.map(|v| [v[0] + drawn_small[0], v[1] + drawn_small[1]]);
        Curve { level_error_mm, ..curve(outline, &smooth[i], o, variance, stack) }
    })?;
    crate::agreement::widen_errors(&mut curves, &planes);
    let ends = ends(stack, &s, axis, &drawn, &planes);
    warnings.extend(ends.warnings);
    let report = Report {
        threshold: s.threshold,
        psf_sigma_px: sigma_mm.map(|m| m / stack.pixel_mm()),
        contours: curves.len(),
        lumens: lumens(&drawn),
        axis,
        candidates: s.candidates,
        noise: s.noise,
        specks: drawn.iter().map(|d| d.specks).sum(),
        warnings,
    };
    let (pixel_mm, thickness_mm) = (stack.pixel_mm(), stack.thickness_mm);
    let (cuts, tips) = (ends.cuts, ends.tips);
    let contours = Contours { axis, planes, curves, cuts, tips, pixel_mm, thickness_mm, blur: acquired };
    ctx.progress(1.0);
    Ok((contours, report))
}

fn lumens(drawn: &[Drawn]) -> Vec<(usize, usize)> {
    let count = |d: &Drawn| {
        let first = d.outlines.first()?;
        Some((first.plane, d.outlines.iter().filter(|o| !o.hole).count()))
    };
    drawn.iter().filter_map(count).collect()
}

/// Linear interpolation between samples a step h apart draws a convex contour too small by kappa h^2 / 36: at the
/// half-maximum the second derivative along the normal vanishes, so that along a lattice line f_xx = f' kappa sin^2, the
/// crossing errs by t (1 - t) / 2 f_xx / f_x, and the mean over the crossings of all directions is kappa / 36. Written as
/// a blur (kappa / 2 of its variance) that is h^2 / 18. Discs of 5 px at SNR 30 lose .43 % of area without it, .2 % with.
const INTERPOLATION: f64 = 1.0 / 18.0;

/// What is added to the blur variances along the plane's u and v for it, mm2. It is no blur of the acquisition, so the
/// spatial correction leaves it where it is.
fn interpolation(stack: &Stack, axis: Axis) -> [f64; 2] {
    let pixel = stack.pixel_mm().powi(2) * INTERPOLATION;
    let across = stack.slice_spacing_mm().powi(2) * INTERPOLATION;
    match axis {
        Axis::Slice => [pixel, pixel],
        Axis::Row => [across, pixel],
        Axis::Column => [pixel, across],
    }
}

/// How far the error of the surroundings' value moves a wall, mm (root mean square along the line): half of it over the slope
/// of a blurred edge at half height, contrast / (sqrt(2 pi) sigma).
fn level_error(s: &Segmentation, axis: Axis, (outline, plane): (&Outline, &Plane), variance: Option<[f64; 2]>) -> f64 {
    let frame = Frame::new(axis);
    let k = outline.plane - s.low[frame.of[2]];
    let nearest = |at: &[f64], low: usize, n: usize, x: f64| {
        let after = at.partition_point(|v| *v < x).clamp(1, at.len() - 1);
        let i = if x - at[after - 1] < at[after] - x { after - 1 } else { after };
        i.clamp(low, low + n - 1) - low
    };
    let [w, h, _] = frame.size(s);
    let square = |p: &[f64; 2]| {
        let i = nearest(&plane.u_mm, s.low[frame.of[0]], w, p[0]);
        let j = nearest(&plane.v_mm, s.low[frame.of[1]], h, p[1]);
        let at = frame.index(s, i, j, k);
        (0.5 * f64::from(s.outside_error[at] / s.contrast[at].max(f32::MIN_POSITIVE))).powi(2)
    };
    let points = &outline.line.points;
    let share = (points.iter().map(square).sum::<f64>() / points.len().max(1) as f64).sqrt();
    let sigma = variance.map_or(0.0, |v| (0.5 * (v[0] + v[1])).sqrt());
    share.min(LARGEST_SHARE) * std::f64::consts::TAU.sqrt() * sigma
}

/// Largest error of a level that is granted, in contrasts.
const LARGEST_SHARE: f64 = 0.25;

fn curve(outline: &Outline, fit: &Smoothed, lumen: usize, variance: Option<[f64; 2]>, stack: &Stack) -> Curve {
    let spline = match variance {
        Some(v) => corrected(&fit.spline, v),
        None => fit.spline.clone(),
    };
    let border = border(&outline.line, &spline, BORDER_MARGIN_PX * stack.pixel_mm());
    Curve {
        plane: outline.plane,
        lumen,
        spline,
        raw: outline.line.points.clone(),
        level: outline.level,
        standard_error_mm: fit.standard_error,
        level_error_mm: 0.0,
        freedom: fit.freedom,
        border,
        hole: outline.hole,
    }
}

/// The spline rounds the corner where wall and border meet: that much of the wall counts as border.
const BORDER_MARGIN_PX: f64 = 1.5;

/// Runs of border points as intervals of arc length, widened by a margin.
fn border(line: &Line, spline: &PeriodicSpline, margin: f64) -> Vec<[f64; 2]> {
    let n = line.points.len();
    let length = spline.length();
    if !line.border.contains(&true) {
        return Vec::new();
    }
    if !line.border.contains(&false) {
        return vec![[0.0, length]];
    }
    let foot = |p: [f64; 2]| {
        let m = 8 * spline.knots();
        let at = |i: usize| spline.derivatives(length * i as f64 / m as f64)[0];
        let off = |i: usize| (at(i)[0] - p[0]).hypot(at(i)[1] - p[1]);
        let best = (0..m).min_by(|&a, &b| off(a).total_cmp(&off(b))).unwrap_or(0);
        length * best as f64 / m as f64
    };
    let starts = (0..n).filter(|&i| line.border[i] && !line.border[(i + n - 1) % n]);
    starts
        .map(|i| {
            let run = (0..n).take_while(|k| line.border[(i + k) % n]).count();
            let [a, b] = [foot(line.points[i]), foot(line.points[(i + run - 1) % n])];
            if (b - a).rem_euclid(length) + 2.0 * margin >= length {
                return [0.0, length];
            }
            [(a - margin).rem_euclid(length), (b + margin).rem_euclid(length)]
        })
        .collect()
}

/// Half-width of the band of pixels that enter an edge profile, px.
const PROFILE_PX: f64 = 3.0;
/// Oblique walls in thick slices are blurred up to three times wider: a quantile somewhat below the median is taken. The
/// lower quartile reads a spread of .60 px as .51 at SNR 16, because single profiles are noisy.
const UPRIGHT_QUANTILE: f64 = 0.4;
/// Curves shorter than this many px have no straight wall to take a profile from.
const LEAST_LENGTH_PX: f64 = 15.0;
/// Fewest profiles for an estimate.
const LEAST_PROFILES: usize = 8;

/// What was drawn, and on what.
struct Sheets<'a> {
    stack: &'a Stack,
    s: &'a Segmentation,
    axis: Axis,
    drawn: &'a [Drawn],
    planes: &'a [Plane],
}

/// The point spread from edge profiles, mm: pixels within 3 px of a curve by signed distance, heights by the local
/// levels, least squares of the normal distribution per curve and direction (normal nearer to u or to v). `None` when
/// fewer than 8 profiles are usable. Across slices nothing is estimated.
///
/// A wall that leans by an angle a against the slice's normal is blurred by thickness tan a as well. The lean is known from
/// the contours of the neighbouring slices: only nearly upright walls count, and what the thickness still adds is taken
/// off. (A tube at 45 degrees in slices of 3 mm read .60 px as .87.)
fn psf(sheets: &Sheets, outlines: &[(usize, usize)], smooth: &[Smoothed], ctx: &Ctx) -> Result<Option<f64>, Error> {
    for upright_px in UPRIGHT_PX {
        let found = psf_of_walls(sheets, outlines, smooth, upright_px, ctx)?;
        if found.is_some() {
            return Ok(found);
        }
    }
    Ok(None)
}

/// Walls count as upright whose lean adds at most this standard deviation to the blur, px; the second is taken where the
/// first leaves too few.
const UPRIGHT_PX: [f64; 2] = [0.5, 1.5];

fn psf_of_walls(
    sheets: &Sheets,
    outlines: &[(usize, usize)],
    smooth: &[Smoothed],
    upright_px: f64,
    ctx: &Ctx,
) -> Result<Option<f64>, Error> {
    let &Sheets { stack, s, axis, drawn, planes } = sheets;
    let px = stack.pixel_mm();
    let through = stack.thickness_mm.unwrap_or(stack.slice_spacing_mm()).powi(2) / 12.0;
    let found = ctx.map_range(outlines.len(), |i| {
        let (k, o) = outlines[i];
        let outline = &drawn[k].outlines[o];
        let straight = outline.line.border.iter().all(|b| !b);
        if !straight || smooth[i].spline.length() < LEAST_LENGTH_PX * px {
            return Vec::new();
        }
        let lean = if axis == Axis::Slice { lean(drawn, planes, k, o) } else { [0.0; 2] };
        // variance that the slice's thickness adds to a wall with this normal, mm2
        let leaning = |inward: [f64; 2]| through * (inward[0] * lean[0] + inward[1] * lean[1]).powi(2);
        let wall = Wall { k, plane: &planes[outline.plane], spline: &smooth[i].spline };
        let profiles = profiles(stack, s, Frame::new(axis), &wall, &leaning, (upright_px * px).powi(2));
        let in_plane = |d: &usize| match axis {
            Axis::Slice => true,
            Axis::Row => *d == 1,
            Axis::Column => *d == 0,
        };
        let width = |d: usize| {
            let (profile, added) = &profiles[d];
            let width = blur(profile, 0.1 * px, 3.0 * px)?;
            Some((width.powi(2) - added).max(0.0).sqrt())
        };
        (0..2).filter(in_plane).filter_map(width).collect()
    })?;
    let mut widths: Vec<f64> = found.into_iter().flatten().collect();
    if widths.len() < LEAST_PROFILES {
        return Ok(None);
    }
    let upright = crate::volume::quantile(&mut widths, UPRIGHT_QUANTILE);
    // the curves' own error blurs the profile as well
    let mut errors: Vec<f64> = smooth.iter().map(|f| f.standard_error).collect();
    let own = median(&mut errors).powi(2);
    Ok(Some((upright.powi(2) - own - px * px / 12.0).max(0.0).sqrt()))
}

/// How far a lumen moves within the plane per mm along the normal, from its own contour and the nearest ones of the
/// neighbouring planes; 0 where there are none.
fn lean(drawn: &[Drawn], planes: &[Plane], k: usize, o: usize) -> [f64; 2] {
    let middle = |outline: &Outline| {
        let n = outline.line.points.len() as f64;
        let sum = outline.line.points.iter().fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
        [sum[0] / n, sum[1] / n]
    };
    let own = &drawn[k].outlines[o];
    let plane = &planes[own.plane];
    let here = middle(own);
    // by the patient: planes need not lie straight above each other
    let seen = |k: usize| {
        let others = drawn.get(k)?.outlines.iter().filter(|o| !o.hole);
        let places = others.map(|o| {
            let p = planes[o.plane].to_patient(middle(o));
            let [u, v] = plane.in_plane(p);
            [u, v, (p - plane.origin).dot(plane.normal())]
        });
        places.min_by(|a, b| {
            let off = |p: &[f64; 3]| (p[0] - here[0]).hypot(p[1] - here[1]);
            off(a).total_cmp(&off(b))
        })
    };
    let below = k.checked_sub(1).and_then(seen).unwrap_or([here[0], here[1], 0.0]);
    let above = seen(k + 1).unwrap_or([here[0], here[1], 0.0]);
    let rise = above[2] - below[2];
    if rise <= 0.0 { [0.0; 2] } else { [0, 1].map(|a| (above[a] - below[a]) / rise) }
}

/// A curve whose edge is looked at.
struct Wall<'a> {
    /// Its number among those drawn.
    k: usize,
    plane: &'a Plane,
    spline: &'a PeriodicSpline,
}

/// Profiles of one curve, for normals nearer to u and nearer to v, with the mean variance that their walls' lean adds;
/// walls that lean by more than `upright` (mm2) are left out.
fn profiles(
    stack: &Stack,
    s: &Segmentation,
    frame: Frame,
    &Wall { k, plane, spline }: &Wall,
    leaning: &impl Fn([f64; 2]) -> f64,
    upright: f64,
) -> [(Profile, f64); 2] {
    let px = stack.pixel_mm();
    let count = (spline.length() / (0.5 * px)).ceil() as usize;
    let samples: Vec<[[f64; 2]; 3]> =
        (0..count).map(|i| spline.derivatives(spline.length() * i as f64 / count as f64)).collect();
    let mut out = [(Vec::new(), 0.0), (Vec::new(), 0.0)];
    let [w, h, _] = frame.size(s);
    let [u0, v0, _] = frame.of.map(|a| s.low[a]);
    let reach = PROFILE_PX * px;
    let low = [0, 1].map(|a| samples.iter().map(|p| p[0][a]).fold(f64::MAX, f64::min) - reach);
    let high = [0, 1].map(|a| samples.iter().map(|p| p[0][a]).fold(f64::MIN, f64::max) + reach);
    for j in (0..h).filter(|j| (low[1]..high[1]).contains(&plane.v_mm[v0 + j])) {
        for i in (0..w).filter(|i| (low[0]..high[0]).contains(&plane.u_mm[u0 + i])) {
            let p = [plane.u_mm[u0 + i], plane.v_mm[v0 + j]];
            let at = frame.index(s, i, j, k);
            if matches!(s.site[at], Site::Far) {
                continue;
            }
            let off = |q: &[[f64; 2]; 3]| (q[0][0] - p[0]).powi(2) + (q[0][1] - p[1]).powi(2);
            let Some(near) = samples.iter().min_by(|a, b| off(a).total_cmp(&off(b))) else { continue };
            if off(near) > reach * reach {
                continue;
            }
            let [q, d, dd] = *near;
            let speed = d[0].hypot(d[1]).max(f64::MIN_POSITIVE);
            let inward = [-d[1] / speed, d[0] / speed];
            let added = leaning(inward);
            if added > upright {
                continue;
            }
            // the sample is up to a quarter of a pixel off the foot: the tangential part is taken out by curvature
            let rel = [p[0] - q[0], p[1] - q[1]];
            let along = (rel[0] * d[0] + rel[1] * d[1]) / speed;
            let kappa = (d[0] * dd[1] - d[1] * dd[0]) / speed.powi(3);
            let distance = rel[0] * inward[0] + rel[1] * inward[1] - 0.5 * kappa * along * along;
            let contrast = f64::from(s.contrast[at]).max(f64::MIN_POSITIVE);
            let height = 0.5 + f64::from(Frame::grey(s, stack, at) - s.level[at]) / contrast;
            let side = &mut out[usize::from(inward[1].abs() > inward[0].abs())];
            side.0.push((distance, height));
            side.1 += added;
        }
    }
    out.map(|(profile, added)| {
        let mean = added / profile.len().max(1) as f64;
        (profile, mean)
    })
}
