//! The chosen vessel tree as voxels with the local level of its wall.

use crate::candidate::{Candidate, LARGEST_RADIUS_MM, Wanted, candidates, levels};
use crate::level::{Fields, Patch};
use crate::volume::{Volume, median, noise, without_background};
use crate::{Error, Settings, Stack};
use exec::Ctx;
use space::{Aabb, P3, Patient, Place, Warning};

/// A vessel that was considered.
#[derive(Clone, Copy, Debug)]
pub struct Vessel {
    /// Score of the choice (length in mm x roundness^2 x branching x edge x brightness x position); compares within one stack only.
    pub score: f64,
    /// Box around it, LPS mm.
    pub bounds: Aabb<Patient>,
    /// Length of its tree at the level of the choice, mm.
    pub length_mm: f64,
    /// Mean radius there, mm.
    pub radius_mm: f64,
    /// Free ends: 2 for an unbranched vessel.
    pub ends: usize,
}

/// The lumen that was found, in a box of the stack. Voxel (x, y, z) is column, row and slice.
#[derive(Clone, Debug)]
pub struct Segmentation {
    /// First column, row and slice of the box.
    pub low: [usize; 3],
    /// Columns, rows and slices of the box; index = x + size[0] * (y + size[1] * z).
    pub size: [usize; 3],
    /// How each voxel lies to the lumen.
    pub site: Vec<Site>,
    /// Local level of the wall, half-way between lumen and surroundings.
    pub level: Vec<f32>,
    /// Lumen minus surroundings at each voxel.
    pub contrast: Vec<f32>,
    /// Standard error of the local value of the surroundings, grey values: noise, and texture that it does not follow.
    pub outside_error: Vec<f32>,
    /// Noise of the raw grey values, standard deviation.
    pub noise: f64,
    /// The level: the plan's, or the median local level over the lumen.
    pub threshold: f64,
    /// The chosen vessel first, then its runners-up.
    pub candidates: Vec<Vessel>,
    /// Mean radius of the lumen, mm.
    pub radius_mm: f64,
    /// What the reader must know.
    pub warnings: Vec<Warning>,
}

/// How a voxel lies to the lumen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Site {
    /// More than 2 px outside.
    Far,
    /// Outside, near the wall.
    Near,
    /// Inside, near the wall.
    Lumen,
    /// More than 2 px inside.
    Deep,
}

/// Pixels are binned for the search up to this size, mm: a lumen of 2 mm radius is then still 2.2 px.
const SEARCH_MM: f64 = 0.9;
/// A runner-up above this share of the best score makes the choice ambiguous.
const AMBIGUOUS: f64 = 0.6;
/// Room around the lumen for its surroundings and growth: pixels in plane, slices across.
const MARGIN: [usize; 3] = [24, 24, 4];
/// Least contrast of a vessel in raw noise deviations.
const LEAST_CONTRAST: f64 = 3.0;
/// Growth of the volume above which the lumen may have run over into a neighbour.
const LEAK: f64 = 6.0;
/// Boxes tried around a growing lumen: each grows by its margin at least.
const BOXES: usize = 40;
/// Width of the band between near and far, tenths of a pixel.
const BAND: u8 = 20;

/// Finds the vessel tree: the best-scored bright structure (see the crate's candidate search), or the one that the
/// settings mark, grown under its local half-maximum levels. Lumens must be brighter than their surroundings.
///
/// # Errors
/// [`Error::Uniform`], [`Error::NoVessel`], [`Error::SeedOutside`], [`Error::NoSuchSlice`], [`Error::Setting`],
/// [`Error::Mask`], [`Error::Cancelled`].
pub fn segment(stack: &Stack, settings: &Settings, ctx: &Ctx) -> Result<Segmentation, Error> {
    check(stack, settings)?;
    if let Some(mask) = &settings.mask {
        return crate::mask::segmentation(stack, mask, settings, ctx);
    }
    let raw_noise = noise(stack);
    let (smooth, factor) = Volume::denoised(stack, ctx)?;
    ctx.progress(0.1);
    let bin = ((SEARCH_MM / stack.pixel_mm()) as usize).clamp(1, 4);
    let search = if bin > 1 { smooth.binned(bin, ctx)? } else { smooth.clone() };
    let noise = raw_noise * factor;
    let flat = match settings.threshold {
        Some(t) => Volume { data: search.data.iter().map(|v| v - t as f32).collect(), ..search },
        None => without_background(&search, noise, ctx)?,
    };
    ctx.progress(0.2);
    let search_noise = noise.max(spread(&flat, noise));
    let search = Search { flat, bin, noise: search_noise };
    let found = wanted(stack, settings, &search, ctx)?;
    ctx.progress(0.5);
    let Some(best) = found.first() else {
        let reason = format!(
            "no tube of at least 1.5 mm radius and 8 mm length stands out of noise of {raw_noise:.3} grey values"
        );
        return Err(Error::NoVessel { reason });
    };
    let mut out = outlined(stack, settings, (&smooth, [raw_noise, noise]), &search, best, &ctx.part(0.5, 1.0))?;
    accepted(&out)?;
    out.candidates = found.iter().map(|c| vessel(stack, &search.flat, c, bin)).collect();
    ambiguity(&mut out, settings);
    ctx.progress(1.0);
    Ok(out)
}

fn check(stack: &Stack, settings: &Settings) -> Result<(), Error> {
    let first = stack.pixels.first().copied().unwrap_or(0.0);
    if stack.pixels.iter().all(|&p| p == first) {
        return Err(Error::Uniform { value: first });
    }
    let last = stack.slices() - 1;
    if let Some(r) = settings.region {
        if r.slice > last {
            return Err(Error::NoSuchSlice { field: "segmentation.region.slice", slice: r.slice, last });
        }
        if !(r.radius_px > 0.0 && r.radius_px.is_finite()) {
            let (field, reason) = ("segmentation.region.radius_px", "a radius is a positive number of pixels");
            return Err(Error::Setting { field, value: r.radius_px, reason });
        }
    }
    match settings.threshold {
        Some(value) if !value.is_finite() => {
            Err(Error::Setting { field: "segmentation.threshold", value, reason: "it is not finite" })
        }
        _ => Ok(()),
    }
}

/// Spread of the flattened values about their median where there is signal (1.4826 MAD): texture counts as noise, as
/// far as it stays below three times the noise (beyond, it is anatomy and the score's business).
fn spread(flat: &Volume, noise: f64) -> f64 {
    let stride = flat.data.len() / 200_000 + 1;
    let mut values: Vec<f64> = flat.data.iter().step_by(stride).map(|&v| f64::from(v)).collect();
    let middle = median(&mut values);
    let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
    (1.4826 * median(&mut off)).min(3.0 * noise)
}

/// The volume in which the vessel is searched.
struct Search {
    /// Denoised, binned, without its background.
    flat: Volume,
    /// Pixels per cell along each in-plane axis.
    bin: usize,
    /// Noise or texture, standard deviation.
    noise: f64,
}

/// The candidates that the settings ask for, best first.
fn wanted(stack: &Stack, settings: &Settings, search: &Search, ctx: &Ctx) -> Result<Vec<Candidate>, Error> {
    let Search { flat, bin, noise } = search;
    let (bin, noise) = (*bin, *noise);
    let index = |x: f64, y: f64, z: usize| {
        let [x, y] = [x, y].map(|p| ((p + 0.5) / bin as f64 - 0.5).round());
        let inside = x >= 0.0 && y >= 0.0 && x < flat.n[0] as f64 && y < flat.n[1] as f64;
        inside.then(|| (x as usize + flat.n[0] * (y as usize + flat.n[1] * z)) as u32)
    };
    if settings.seeds.is_empty() {
        let Some(r) = settings.region else {
            return candidates(flat, noise, &Wanted::Best, settings, ctx);
        };
        let mut set = Vec::new();
        for y in 0..stack.rows {
            for x in 0..stack.columns {
                let off = (x as f64 - r.centre_px[0]).hypot(y as f64 - r.centre_px[1]);
                set.extend((off <= r.radius_px).then(|| index(x as f64, y as f64, r.slice)).flatten());
            }
        }
        set.sort_unstable();
        set.dedup();
        return candidates(flat, noise, &Wanted::Touching(&set), settings, ctx);
    }
    let least = if settings.threshold.is_some() { 0.0 } else { levels(flat, noise).first().copied().unwrap_or(0.0) };
    let mut set = Vec::new();
    for (seed, &position) in settings.seeds.iter().enumerate() {
        let d = position - stack.origins[0];
        let [x, y] = [d.dot(stack.row_direction), d.dot(stack.column_direction)];
        let (x, y) = (x / stack.pixel_spacing_mm[1], y / stack.pixel_spacing_mm[0]);
        let off = |k: usize| (stack.offset_mm(k) - d.dot(stack.normal())).abs();
        let z = (0..stack.slices()).min_by(|&a, &b| off(a).total_cmp(&off(b))).unwrap_or(0);
        let at = index(x, y, z).filter(|_| off(z) <= stack.slice_spacing_mm());
        let value = at.map_or(f64::NAN, |i| f64::from(flat.data[i as usize]));
        match at {
            Some(i) if value > least => set.push(i),
            _ => return Err(Error::SeedOutside { seed, position, value, needed: least }),
        }
    }
    set.sort_unstable();
    candidates(flat, noise, &Wanted::Touching(&set), settings, ctx)
}

/// The candidate at full resolution, grown under its local levels.
fn outlined(
    stack: &Stack,
    settings: &Settings,
    (smooth, [raw_noise, noise]): (&Volume, [f64; 2]),
    search: &Search,
    best: &Candidate,
    ctx: &Ctx,
) -> Result<Segmentation, Error> {
    let Search { flat, bin, .. } = search;
    let bin = *bin;
    let mut seed = Vec::with_capacity(best.voxels.len() * bin * bin);
    for &i in &best.voxels {
        let p = position(i as usize, flat.n, bin);
        seed.extend((0..bin * bin).map(|k| [p[0] + k % bin, p[1] + k / bin, p[2]]));
    }
    let started = seed.len();
    let mut warnings = Vec::new();
    // The box is made anew around the grown lumen until the lumen keeps off its walls.
    for round in 1.. {
        ctx.check()?;
        let patch = patch(stack, smooth, &seed);
        let mut mask = vec![false; patch.raw.len()];
        for p in &seed {
            mask[patch_index(&patch, *p)] = true;
        }
        let (mask, fields) = match settings.threshold {
            Some(t) => {
                let fields = patch.fields(&mask, |_| t as f32, ctx)?;
                (mask, fields)
            }
            None => {
                // first level: the candidate's, above the mean background under it
                let first = mean(&best.voxels, |i| search_level(flat, smooth, best, i, bin));
                patch.grown(mask, |_| first as f32, noise, ctx)?
            }
        };
        let grown: Vec<[usize; 3]> = (0..mask.len()).filter(|&i| mask[i]).map(|i| global(&patch, i)).collect();
        let settled = settings.threshold.is_some() || round == BOXES || !touches(&patch, &grown, stack);
        if grown.is_empty() {
            return Err(Error::NoVessel { reason: "the best structure dissolves under its local level".into() });
        }
        if settled {
            if grown.len() as f64 > LEAK * started as f64 {
                warnings.push(leak(started, grown.len()));
            }
            let fields = patch.drawing_fields(&mask, fields, ctx)?;
            let outside_error = patch.outside_error(&mask, &fields, ctx)?;
            return Ok(finished(&patch, settings, &mask, (&fields, outside_error), (raw_noise, warnings)));
        }
        seed = grown;
    }
    Err(Error::NoVessel { reason: "the lumen never settled".into() })
}

fn leak(from: usize, to: usize) -> Warning {
    let message = format!(
        "under its local levels the lumen grew from {from} to {to} voxels: it may have run over into a neighbour; look \
         at the contours or mark the vessel by a threshold or seeds"
    );
    Warning::new("segmentation.leak", message, Place::none())
}

fn mean(voxels: &[u32], f: impl Fn(usize) -> f64) -> f64 {
    voxels.iter().map(|&i| f(i as usize)).sum::<f64>() / voxels.len().max(1) as f64
}

/// Grey value of the candidate's level at one of its voxels: background + level.
fn search_level(flat: &Volume, smooth: &Volume, best: &Candidate, i: usize, bin: usize) -> f64 {
    let p = position(i, flat.n, bin);
    f64::from(smooth.at(p[0], p[1], p[2]) - flat.data[i]) + best.level
}

fn position(i: usize, n: [usize; 3], bin: usize) -> [usize; 3] {
    [i % n[0] * bin, i / n[0] % n[1] * bin, i / n[0] / n[1]]
}

fn global(patch: &Patch, i: usize) -> [usize; 3] {
    let p = position(i, patch.n, 1);
    std::array::from_fn(|a| p[a] + patch.low[a])
}

pub(crate) fn patch_index(patch: &Patch, p: [usize; 3]) -> usize {
    let q: [usize; 3] = std::array::from_fn(|a| p[a] - patch.low[a]);
    q[0] + patch.n[0] * (q[1] + patch.n[1] * q[2])
}

pub(crate) fn patch(stack: &Stack, smooth: &Volume, voxels: &[[usize; 3]]) -> Patch {
    let mut low = [usize::MAX; 3];
    let mut high = [0; 3];
    for p in voxels {
        for a in 0..3 {
            low[a] = low[a].min(p[a]);
            high[a] = high[a].max(p[a] + 1);
        }
    }
    for a in 0..3 {
        low[a] = low[a].saturating_sub(MARGIN[a]);
        high[a] = (high[a] + MARGIN[a]).min(smooth.n[a]);
    }
    let n: [usize; 3] = std::array::from_fn(|a| high[a] - low[a]);
    let mut patch = Patch { low, n, step: smooth.step, pixel_mm: stack.pixel_mm(), raw: vec![], smooth: vec![] };
    for z in low[2]..high[2] {
        for y in low[1]..high[1] {
            let start = low[0] + smooth.n[0] * (y + smooth.n[1] * z);
            patch.raw.extend_from_slice(&stack.pixels[start..start + n[0]]);
            patch.smooth.extend_from_slice(&smooth.data[start..start + n[0]]);
        }
    }
    patch
}

/// Whether the lumen comes within 6 px (1 slice) of a wall of the box that is not the stack's own.
fn touches(patch: &Patch, voxels: &[[usize; 3]], stack: &Stack) -> bool {
    let whole = [stack.columns, stack.rows, stack.slices()];
    let room = [6, 6, 1];
    voxels.iter().any(|p| {
        (0..3).any(|a| {
            let (low, high) = (patch.low[a], patch.low[a] + patch.n[a]);
            (low > 0 && p[a] < low + room[a]) || (high < whole[a] && p[a] + room[a] >= high)
        })
    })
}

/// The half-way level of a magnitude image (Rician noise): its means lie above the true signal A, sqrt(A^2 + sigma^2) far
/// from zero and 1.25 sigma at zero. The half is taken of the true signals and given its own mean: in black surroundings at
/// SNR 8 the half of the plain means lies 6 % of the contrast too high, which is .1 px of the wall.
fn half_level(inside: f64, outside: f64, sigma: f64) -> f64 {
    // variance of a Rician variable in sigma^2: 2 - pi/2 at A = 0, 1 far from it
    let variance = |a: f64| 1.0 - (std::f64::consts::FRAC_PI_2 - 1.0) * (-0.5 * (a / sigma).powi(2)).exp();
    let signal =
        |mean: f64| (0..5).fold(mean, |a, _| (mean * mean - sigma * sigma * (2.0 - variance(a))).max(0.0).sqrt());
    let half = 0.5 * (signal(inside) + signal(outside));
    (half * half + sigma * sigma * (2.0 - variance(half))).sqrt()
}

/// Noise of a magnitude image within the lumen, where it is Gaussian (second differences along rows); that of the whole
/// stack where the lumen is too small to tell, which in a mostly black image is Rayleigh noise and a third too small. `None`
/// where negative values say that it is no magnitude image.
fn rician(patch: &Patch, deep: &[u8], noise: f64) -> Option<f64> {
    if noise <= 0.0 || patch.raw.iter().any(|&v| v < 0.0) {
        return None;
    }
    let n = patch.n[0];
    let within = |i: usize| deep[i] > ONE_PIXEL;
    let inner = (1..deep.len().saturating_sub(1)).filter(|&i| i % n > 0 && i % n < n - 1);
    let mut off: Vec<f64> = inner
        .filter(|&i| within(i - 1) && within(i) && within(i + 1))
        .map(|i| f64::from(patch.raw[i] - 0.5 * (patch.raw[i - 1] + patch.raw[i + 1])).abs())
        .collect();
    let told = off.len() >= LEAST_INNER;
    Some(if told { median(&mut off) * 1.4826 / 1.5_f64.sqrt() } else { noise })
}

/// Depth within which the blurred rim begins, tenths of a pixel.
const ONE_PIXEL: u8 = 10;
/// Values that tell the noise within the lumen to 10 %.
const LEAST_INNER: usize = 100;

fn finished(
    patch: &Patch,
    settings: &Settings,
    mask: &[bool],
    (fields, outside_error): (&Fields, Vec<f32>),
    (noise, warnings): (f64, Vec<Warning>),
) -> Segmentation {
    let outside: Vec<bool> = mask.iter().map(|m| !m).collect();
    let near = patch.distances(mask, BAND);
    let deep = patch.distances(&outside, BAND);
    let rician = rician(patch, &deep, noise);
    let site = (0..mask.len())
        .map(|i| match (mask[i], near[i] <= BAND, deep[i] <= BAND) {
            (true, _, false) => Site::Deep,
            (true, ..) => Site::Lumen,
            (false, true, _) => Site::Near,
            (false, false, _) => Site::Far,
        })
        .collect();
    let level: Vec<f32> = match settings.threshold {
        Some(t) => vec![t as f32; mask.len()],
        None => (0..mask.len())
            .map(|i| match rician {
                Some(sigma) if mask[i] || near[i] <= BAND => {
                    half_level(f64::from(fields.inside[i]), f64::from(fields.outside[i]), sigma) as f32
                }
                _ => fields.level(i),
            })
            .collect(),
    };
    let contrast = (0..mask.len()).map(|i| fields.contrast(i)).collect();
    let mut levels: Vec<f64> = (0..mask.len()).filter(|&i| mask[i]).map(|i| f64::from(level[i])).collect();
    let threshold = settings.threshold.unwrap_or_else(|| median(&mut levels));
    Segmentation {
        low: patch.low,
        size: patch.n,
        site,
        level,
        contrast,
        outside_error,
        noise,
        threshold,
        candidates: Vec::new(),
        radius_mm: radius(patch, mask),
        warnings,
    }
}

/// 2 V / A with face areas x pi/4.
pub(crate) fn radius(patch: &Patch, mask: &[bool]) -> f64 {
    let [a, b, c] = patch.step;
    let face = [b * c, a * c, a * b];
    let stride = [1, patch.n[0], patch.n[0] * patch.n[1]];
    let (mut volume, mut area) = (0.0, 0.0);
    for i in (0..mask.len()).filter(|&i| mask[i]) {
        volume += a * b * c;
        for k in 0..3 {
            let at = i / stride[k] % patch.n[k];
            area += if at > 0 && !mask[i - stride[k]] { face[k] } else { 0.0 };
            area += if at + 1 < patch.n[k] && !mask[i + stride[k]] { face[k] } else { 0.0 };
        }
    }
    2.0 * volume / (area * std::f64::consts::FRAC_PI_4).max(1e-9)
}

/// Refuses what has no contrast over the noise.
fn accepted(s: &Segmentation) -> Result<(), Error> {
    let mut contrast: Vec<f64> =
        (0..s.site.len()).filter(|&i| s.site[i] >= Site::Lumen).map(|i| f64::from(s.contrast[i])).collect();
    let contrast = median(&mut contrast);
    if contrast < LEAST_CONTRAST * s.noise {
        let reason = format!("the best structure has a contrast of {contrast:.2} where the noise is {:.2}", s.noise);
        return Err(Error::NoVessel { reason });
    }
    if s.radius_mm > LARGEST_RADIUS_MM {
        let reason = format!("the best structure has a mean radius of {:.1} mm, too wide for a vessel", s.radius_mm);
        return Err(Error::NoVessel { reason });
    }
    Ok(())
}

fn vessel(stack: &Stack, flat: &Volume, c: &Candidate, bin: usize) -> Vessel {
    let corner = |i: &u32| -> P3 {
        let p = position(*i as usize, flat.n, bin);
        let middle = (bin as f64 - 1.0) / 2.0;
        stack.position(p[2], p[1] as f64 + middle, p[0] as f64 + middle)
    };
    let bounds = Aabb::around(c.voxels.iter().map(corner));
    let bounds = bounds.unwrap_or(Aabb { min: stack.origins[0], max: stack.origins[0] });
    Vessel { score: c.score, bounds, length_mm: c.length_mm, radius_mm: c.radius_mm, ends: c.ends + 1 }
}

/// Warns when a runner-up comes close and nothing in the settings says which is meant.
fn ambiguity(s: &mut Segmentation, settings: &Settings) {
    let free = settings.seeds.is_empty() && settings.region.is_none();
    if let [best, second, ..] = s.candidates.as_slice()
        && free
        && second.score > AMBIGUOUS * best.score
    {
        let message = format!(
            "two vessels are alike: scores {:.0} (taken, {} ends, {:.0} mm) and {:.0} ({} ends, {:.0} mm); mark the \
             wanted one by a region or a seed",
            best.score, best.ends, best.length_mm, second.score, second.ends, second.length_mm
        );
        s.warnings.push(Warning::new("segmentation.ambiguous", message, Place::at(second.bounds.centre())));
    }
}
