//! The local half-maximum level and the growth of the lumen under it.
//!
//! A global level errs wherever coil sensitivity, inflow or the tissue around change: the half-way level between the
//! lumen and its surroundings is taken at every voxel instead. Inside: raw grey values of the mask, weighted by the cube
//! of their depth (up to 3 px), so that the blurred rim does not pull the value down. Outside: raw values 2 to 4 px away
//! from the mask; left out are those within 2 px of other bright structures, those into which the lumen runs on without a
//! wall (docs/adr/0031), and what the mask encloses within a plane, a dim core of a wide lumen. Both are spread by normalised convolution with
//! Gaussians of growing width, so that near data decide where there are any. The mask then grows (or shrinks) to the
//! component above the level within reach, and the levels are taken anew until nothing changes: a vessel is followed as
//! far as its own contrast carries it.

use crate::Error;
use crate::region::{FAR, components, distances, distances_and_sources, reached};
use exec::Ctx;

/// A box of the stack with what the growth needs; index = x + n[0] * (y + n[1] * z).
pub(crate) struct Patch {
    /// First voxel of the box in the stack.
    pub(crate) low: [usize; 3],
    pub(crate) n: [usize; 3],
    /// Steps in mm.
    pub(crate) step: [f64; 3],
    /// In-plane pixel, mm.
    pub(crate) pixel_mm: f64,
    /// Raw and denoised grey values.
    pub(crate) raw: Vec<f32>,
    pub(crate) smooth: Vec<f32>,
}

/// Inside and outside grey values at every voxel of a patch.
pub(crate) struct Fields {
    pub(crate) inside: Vec<f32>,
    pub(crate) outside: Vec<f32>,
    /// Inside values over a wider neighbourhood, which thin or shallow parts do not sway.
    pub(crate) wide: Vec<f32>,
}

/// What counts as lumen and what as surroundings, by voxel.
struct Weights {
    core: Vec<f32>,
    ring: Vec<f32>,
}

impl Fields {
    /// The half-way level of a voxel.
    pub(crate) fn level(&self, i: usize) -> f32 {
        0.5 * (self.inside[i] + self.outside[i])
    }
    /// Whether a denoised value is bright enough to join the lumen.
    fn admits(&self, i: usize, value: f32, least: f32) -> bool {
        let gate = self.outside[i] + GATE * (self.wide[i] - self.outside[i]);
        value > self.level(i) && value > gate && self.contrast(i) > least
    }
    /// Lumen minus surroundings.
    pub(crate) fn contrast(&self, i: usize) -> f32 {
        self.inside[i] - self.outside[i]
    }
}

/// Distances are counted in tenths of a pixel.
const TENTHS: f64 = 10.0;
/// Depth at which a voxel counts in full, tenths of a pixel.
const DEEP: u8 = 30;
/// The ring of surroundings, tenths of a pixel from the mask's outermost voxels: a point spread of .6 px has let go of
/// 99.9 % of the lumen 2 px from the wall. Some of these voxels lie 1 px inside it, so that levels come out .2 % of the
/// contrast too high; a ring from 2.5 px is free of that and finds no room between neighbours (docs/adr/0033).
const RING: (u8, u8) = (20, 42);
/// The ring from which contours' levels are taken: that one is free of the .2 %. Nearer voxels count where there is nothing else.
const CLEAR: (u8, u8) = (25, 47);
/// Two rings that differ by less than this share of the contrast see the same surroundings, and the clear one is right; where they
/// differ by three times as much, a neighbour's blur fills the gap between two walls, and the level that keeps them apart is that of the
/// near ring. In slices that mix (the second value) a leaning wall reaches into the near ring by itself.
const APART: [f32; 2] = [0.01, 0.02];
/// A voxel of the ring whose height above the surroundings of 10 mm is more than this share of that of the mask's rim beside it is
/// no surroundings: there is no wall in between, the lumen runs on. Across a wall the share is 0 to .2 (the rim is at
/// half height or above), ahead of a front in a fading vessel .8 to 1. Without this the aorta of a coil-faded scan
/// takes its own dim continuation for background (level 360 where the lumen has 320) and breaks up in its last 10 rows.
const RUNS_ON: f32 = 0.7;
/// Slices thicker than this many pixels mix lumen and surroundings beyond the ring's inner edge: the slice next to the mask, which
/// may be half full where the vessel runs within the slices, is 2 px away and in the ring (at 2 px a tube that lay in its slices
/// lost 2.5 % of its area). In the thinner ones of the real angiogram (1.7 px) the ring between two iliac arteries must keep its
/// weight, or they melt together.
const MIXING_PX: f64 = 1.95;
/// Weight of voxels that such a slice fills with both lumen and surroundings: those of the ring above or below which the lumen
/// lies (within 2 px), and those of the lumen above or below which it does not. They count only where nothing else is near. With full weight a tube at 45 degrees in slices of 3 mm gets a level 1.5 % of its contrast too high, one at
/// 60 degrees 5 %, which costs 1.4 and 5 % of its area.
const PARTIAL: f32 = 0.02;
/// Narrowest Gaussian of the inside values, mm: at 3 mm a vessel that fades to .4 within 35 mm comes out 1.4 % too small in area, because the mean is one-sided at its end.
const INSIDE_MM: f64 = 2.0;
/// Narrowest Gaussian of the outside values, mm: tissue on one side of a vessel and air on the other stay apart.
const OUTSIDE_MM: f64 = 2.0;
/// Gaussian of the wide inside values, mm.
const WIDE_MM: f64 = 10.0;
/// A voxel joins the lumen only above this share of the wide contrast. At 0 the aorta of a real coil-faded scan runs
/// over into the bowel through a dim filament; brightness along a vessel changes by far less within 10 mm.
const GATE: f32 = 0.45;
/// Gaussians, each twice as wide as the one before; the widest carries levels over any gap.
const SCALES: usize = 5;
/// Weight of each wider Gaussian against the one before.
const WIDER: f32 = 1e-3;
/// In-plane reach of one growth step, tenths of a pixel.
const REACH: f64 = 50.0;
/// Growth steps at most: 5 px each follow a vessel over 400 px.
const STEPS: usize = 80;
/// Growth ends where the contrast falls below this many noise deviations of the denoised values: half-way between, lumen
/// and surroundings then lie 2 deviations off and every 20th voxel is wrong.
const LEAST_CONTRAST: f64 = 4.0;

impl Patch {
    fn tenths(&self) -> [f64; 3] {
        self.step.map(|s| TENTHS * s / self.pixel_mm)
    }
    /// Distances to a set in tenths of a pixel.
    pub(crate) fn distances(&self, from: &[bool], limit: u8) -> Vec<u8> {
        distances(from, self.n, self.tenths(), limit)
    }
    /// Inside and outside values for a mask; `level` is the present level of every voxel, above which other structures
    /// count as bright.
    pub(crate) fn fields(
        &self,
        mask: &[bool],
        level: impl Fn(usize) -> f32 + Sync,
        ctx: &Ctx,
    ) -> Result<Fields, Error> {
        let Weights { core, ring } = self.weights(RING, mask, level, ctx)?;
        let raw = |i: usize| self.raw[i];
        let inside = self.spread(|i| core[i], raw, INSIDE_MM, ctx)?;
        let outside = self.spread(|i| ring[i], raw, OUTSIDE_MM, ctx)?;
        let wide = self.spread(|i| core[i], raw, WIDE_MM, ctx)?;
        Ok(Fields { inside, outside, wide })
    }

    /// The values from which contours are drawn, for a mask that grew under `fields`: the surroundings begin [`CLEAR`] of the wall
    /// where the nearer ring says about the same ([`APART`]).
    pub(crate) fn drawing_fields(&self, mask: &[bool], fields: Fields, ctx: &Ctx) -> Result<Fields, Error> {
        let Weights { ring, .. } = self.weights(CLEAR, mask, |i| fields.level(i), ctx)?;
        let mut outside = self.spread(|i| ring[i], |i| self.raw[i], OUTSIDE_MM, ctx)?;
        let apart = if self.mixing() { APART[1] } else { APART[0] };
        for (i, far) in outside.iter_mut().enumerate() {
            let near = fields.outside[i];
            let share = (near - *far).abs() / (apart * fields.contrast(i).max(f32::MIN_POSITIVE));
            *far += (0.5 * (share - 1.0)).clamp(0.0, 1.0) * (near - *far);
        }
        Ok(Fields { outside, ..fields })
    }

    /// Whether slices mix lumen and surroundings beyond the ring's inner edge.
    fn mixing(&self) -> bool {
        self.step[2] >= MIXING_PX * self.pixel_mm
    }

    /// Standard error of the outside values, by voxel: the noise of a mean over few voxels, N, and the tissue's texture T, which the
    /// mean cannot follow.
    ///
    /// Of two diagonal neighbours, which lie on fields of one colour of the lattice, the mean over the other colour's fields is
    /// subtracted: their product has the expectation T + 2 N, since nothing of their own noise is in it (noise is independent
    /// from pixel to pixel; in interpolated images it counts as texture). The two means differ by 4 N in variance.
    pub(crate) fn outside_error(&self, mask: &[bool], fields: &Fields, ctx: &Ctx) -> Result<Vec<f32>, Error> {
        let Weights { ring, .. } = self.weights(CLEAR, mask, |i| fields.level(i), ctx)?;
        let black = |i: usize| (i % self.n[0] + i / self.n[0]).is_multiple_of(2);
        let field = |i: usize, of: bool| if black(i) == of { ring[i] } else { 0.0 };
        let raw = |i: usize| self.raw[i];
        let halves = [
            self.spread(|i| field(i, true), raw, OUTSIDE_MM, ctx)?,
            self.spread(|i| field(i, false), raw, OUTSIDE_MM, ctx)?,
        ];
        let off = |i: usize| self.raw[i] - halves[usize::from(black(i))][i];
        let next = |i: usize| i + 1 + self.n[0];
        let weight = |i: usize| ring.get(next(i)).map_or(0.0, |w| w.min(ring[i]));
        let square = |i: usize| off(i) * off(next(i)) - 0.25 * (halves[0][i] - halves[1][i]).powi(2);
        let variance = self.spread(weight, square, WIDE_MM, ctx)?;
        Ok(variance.into_iter().map(|v| v.max(0.0).sqrt()).collect())
    }

    fn weights(
        &self,
        band: (u8, u8),
        mask: &[bool],
        level: impl Fn(usize) -> f32 + Sync,
        ctx: &Ctx,
    ) -> Result<Weights, Error> {
        let filled = filled(mask, self.n, ctx)?;
        let other = (0..mask.len()).map(|i| !filled[i] && self.smooth[i] > level(i)).collect();
        let masks = [filled, mask.iter().map(|m| !m).collect(), other];
        let limits = [band.1, DEEP + 5, RING.0];
        let found = ctx.map_range(3, |k| match k {
            0 => distances_and_sources(&masks[0], self.n, self.tenths(), limits[0]),
            _ => (self.distances(&masks[k], limits[k]), Vec::new()),
        })?;
        let d: Vec<&Vec<u8>> = found.iter().map(|f| &f.0).collect();
        let source = &found[0].1;
        let in_ring = |i: usize| (RING.0..=band.1).contains(&d[0][i]) && d[2][i] == FAR;
        let ground = self.spread(|i| f32::from(u8::from(in_ring(i))), |i| self.raw[i], WIDE_MM, ctx)?;
        let runs_on = |i: usize| self.smooth[i] - ground[i] > RUNS_ON * (self.smooth[source[i] as usize] - ground[i]);
        let depth = |i: usize| match d[1][i] {
            0 => 0.0,
            FAR => 1.0,
            // a voxel beside the boundary is half a pixel deep
            t => (f32::from(t.saturating_sub(5).min(DEEP)) / f32::from(DEEP)).powi(3),
        };
        let mixing = self.mixing();
        let within = if mixing {
            distances(&masks[0], self.n, [self.tenths()[0], self.tenths()[1], f64::from(FAR)], RING.0)
        } else {
            Vec::new()
        };
        let beside = |i: usize| mixing && self.neighbours(i).any(|j| within[j] < RING.0);
        let partial = |i: usize| mixing && self.neighbours(i).any(|j| !masks[0][j]);
        let ring = |i: usize| match in_ring(i) && !runs_on(i) {
            false => 0.0,
            true if beside(i) || d[0][i] < band.0 => PARTIAL,
            true => 1.0,
        };
        let core = |i: usize| if partial(i) { PARTIAL * depth(i) } else { depth(i) };
        Ok(Weights { core: (0..mask.len()).map(core).collect(), ring: (0..mask.len()).map(ring).collect() })
    }
    /// The voxels straight above and below one.
    fn neighbours(&self, i: usize) -> impl Iterator<Item = usize> {
        let area = self.n[0] * self.n[1];
        let (below, above) = (i.checked_sub(area), Some(i + area).filter(|j| *j < self.raw.len()));
        below.into_iter().chain(above)
    }
    /// Normalised convolution of values with weights, over coarse cells of about 2/3 of the narrowest sigma.
    fn spread(
        &self,
        weight: impl Fn(usize) -> f32 + Sync,
        value: impl Fn(usize) -> f32 + Sync,
        sigma_mm: f64,
        ctx: &Ctx,
    ) -> Result<Vec<f32>, Error> {
        let per: [usize; 3] = std::array::from_fn(|a| ((0.67 * sigma_mm / self.step[a]).round() as usize).max(1));
        let m: [usize; 3] = std::array::from_fn(|a| self.n[a].div_ceil(per[a]));
        let area = m[0] * m[1];
        let slabs = ctx.map_range(m[2], |c| {
            let mut sums = vec![[0.0f32; 2]; area];
            for z in c * per[2]..((c + 1) * per[2]).min(self.n[2]) {
                for y in 0..self.n[1] {
                    for x in 0..self.n[0] {
                        let i = x + self.n[0] * (y + self.n[1] * z);
                        let w = weight(i);
                        if w > 0.0 {
                            let s = &mut sums[x / per[0] + m[0] * (y / per[1])];
                            s[0] += w * value(i);
                            s[1] += w;
                        }
                    }
                }
            }
            sums
        })?;
        let cells: Vec<[f32; 2]> = slabs.into_iter().flatten().collect();
        let cell_mm: [f64; 3] = std::array::from_fn(|a| self.step[a] * per[a] as f64);
        let total = pyramid(&cells, m, cell_mm.map(|c| sigma_mm / c), SCALES, ctx)?;
        // beyond the reach of all Gaussians: the mean
        let sum = cells.iter().fold([0.0f64; 2], |s, c| [s[0] + f64::from(c[0]), s[1] + f64::from(c[1])]);
        let mean = if sum[1] > 0.0 { (sum[0] / sum[1]) as f32 } else { 0.0 };
        let value: Vec<f32> = total.iter().map(|t| if t[1] > 1e-25 { t[0] / t[1] } else { mean }).collect();
        self.interpolated(&value, per, m, ctx)
    }
    fn interpolated(&self, value: &[f32], per: [usize; 3], m: [usize; 3], ctx: &Ctx) -> Result<Vec<f32>, Error> {
        let place = |p: usize, a: usize| {
            let u = ((p as f32 + 0.5) / per[a] as f32 - 0.5).clamp(0.0, (m[a] - 1) as f32);
            let i = (u as usize).min(m[a].saturating_sub(2));
            (i, (i + 1).min(m[a] - 1), u - i as f32)
        };
        let columns: Vec<_> = (0..self.n[0]).map(|x| place(x, 0)).collect();
        let mut out = vec![0.0f32; self.raw.len()];
        let area = self.n[0] * self.n[1];
        ctx.chunks_mut(&mut out, area, |first, out| {
            let (z0, z1, tz) = place(first / area, 2);
            for y in 0..self.n[1] {
                let (y0, y1, ty) = place(y, 1);
                let line = |x: usize| {
                    let at = |y: usize, z: usize| value[x + m[0] * (y + m[1] * z)];
                    let low = at(y0, z0) * (1.0 - ty) + at(y1, z0) * ty;
                    let high = at(y0, z1) * (1.0 - ty) + at(y1, z1) * ty;
                    low * (1.0 - tz) + high * tz
                };
                let lines: Vec<f32> = (0..m[0]).map(line).collect();
                for (o, &(x0, x1, tx)) in out[y * self.n[0]..].iter_mut().zip(&columns) {
                    *o = lines[x0] * (1.0 - tx) + lines[x1] * tx;
                }
            }
        })?;
        Ok(out)
    }
    /// The mask grown under its own local levels until it is stable, and the levels that belong to it. `noise` is that
    /// of the denoised values.
    pub(crate) fn grown(
        &self,
        mut mask: Vec<bool>,
        first: impl Fn(usize) -> f32 + Sync,
        noise: f64,
        ctx: &Ctx,
    ) -> Result<(Vec<bool>, Fields), Error> {
        let mut fields = self.fields(&mask, first, ctx)?;
        let reach = REACH.max(self.tenths()[2] + 5.0).min(254.0) as u8;
        let mut before = Vec::new();
        for step in 0..STEPS {
            ctx.progress(1.0 - 0.8_f64.powi(step as i32));
            let near = self.distances(&mask, reach);
            let least = (LEAST_CONTRAST * noise) as f32;
            let mut open: Vec<bool> =
                (0..mask.len()).map(|i| near[i] != FAR && fields.admits(i, self.smooth[i], least)).collect();
            let grown = self.largest(&mask, &mut open);
            let changed = grown.iter().zip(&mask).filter(|(a, b)| a != b).count();
            let size = grown.iter().filter(|&&m| m).count();
            // A few voxels may change the levels so that they leave, and be let in again by those without them, for ever.
            let swings = grown == before;
            before = std::mem::replace(&mut mask, grown);
            if size == 0 {
                break;
            }
            fields = self.fields(&mask, |i| fields.level(i), ctx)?;
            // a two-thousandth of the lumen is below the noise of its surface
            if swings || changed * 2000 <= size {
                break;
            }
        }
        Ok((mask, fields))
    }
    /// The component of `open` that holds most of the mask.
    fn largest(&self, mask: &[bool], open: &mut [bool]) -> Vec<bool> {
        let mut best: (usize, Vec<usize>) = (0, Vec::new());
        for i in 0..mask.len() {
            if mask[i] && open[i] {
                let part = reached(vec![i], open, self.n);
                let held = part.iter().filter(|&&j| mask[j]).count();
                if held > best.0 {
                    best = (held, part);
                }
            }
        }
        let mut out = vec![false; mask.len()];
        for i in best.1 {
            out[i] = true;
        }
        out
    }
}

/// The mask with the parts that it encloses within a plane of the lattice (any of the three directions), as far as they
/// are smaller than the mask's own section there: larger ones are loops of the vessel.
fn filled(mask: &[bool], n: [usize; 3], ctx: &Ctx) -> Result<Vec<bool>, Error> {
    let stride = [1, n[0], n[0] * n[1]];
    let mut out = mask.to_vec();
    let inside: Vec<[usize; 3]> =
        (0..mask.len()).filter(|&i| mask[i]).map(|i| [i % n[0], i / n[0] % n[1], i / stride[2]]).collect();
    for [u, v, across] in [[0, 1, 2], [0, 2, 1], [1, 2, 0]] {
        // What a mask encloses lies within its own rectangle: the rest of a plane need not be looked at.
        let mut rectangles = vec![[[usize::MAX, 0]; 2]; n[across]];
        for p in &inside {
            for (side, at) in rectangles[p[across]].iter_mut().zip([p[u], p[v]]) {
                *side = [side[0].min(at), side[1].max(at)];
            }
        }
        let holes = ctx.map_range(n[across], |k| {
            let [[u0, u1], [v0, v1]] = rectangles[k];
            if u0 > u1 {
                return Vec::new();
            }
            let (w, h) = (u1 - u0 + 1, v1 - v0 + 1);
            let index = |p: usize| (u0 + p % w) * stride[u] + (v0 + p / w) * stride[v] + k * stride[across];
            let plane: Vec<bool> = (0..w * h).map(|p| mask[index(p)]).collect();
            enclosed(&plane, w, h).into_iter().map(index).collect()
        })?;
        for i in holes.into_iter().flatten() {
            out[i] = true;
        }
    }
    Ok(out)
}

/// Pixels of a rectangle that its mask encloses, in parts smaller than the mask.
fn enclosed(mask: &[bool], w: usize, h: usize) -> Vec<usize> {
    let own = mask.iter().filter(|&&m| m).count();
    let mut open: Vec<bool> = mask.iter().map(|m| !m).collect();
    let on_border = |p: u32| {
        let (x, y) = (p as usize % w, p as usize / w);
        x == 0 || y == 0 || x + 1 == w || y + 1 == h
    };
    let parts = components(&mut open, [w, h, 1], 1);
    let kept = parts.into_iter().filter(|part| part.len() < own && !part.iter().any(|&p| on_border(p)));
    kept.flatten().map(|p| p as usize).collect()
}

/// Gaussian sums of `scales` widths, each twice the one before and weighted by [`WIDER`]; wider ones over cells twice as
/// coarse, so that their cost falls instead of growing.
fn pyramid(
    cells: &[[f32; 2]],
    m: [usize; 3],
    sigma: [f64; 3],
    scales: usize,
    ctx: &Ctx,
) -> Result<Vec<[f32; 2]>, Error> {
    let mut total = blurred(cells.to_vec(), m, sigma, ctx)?;
    if scales > 1 {
        let half = m.map(|n| n.div_ceil(2));
        let mut coarse = vec![[0.0f32; 2]; half[0] * half[1] * half[2]];
        for (i, c) in cells.iter().enumerate() {
            let p = [i % m[0] / 2, i / m[0] % m[1] / 2, i / m[0] / m[1] / 2];
            let o = &mut coarse[p[0] + half[0] * (p[1] + half[1] * p[2])];
            o[0] += c[0];
            o[1] += c[1];
        }
        let wider = pyramid(&coarse, half, sigma, scales - 1, ctx)?;
        ctx.chunks_mut(&mut total, m[0], |first, out| {
            for (x, t) in out.iter_mut().enumerate() {
                let w = linear(&wider, half, [x, first / m[0] % m[1], first / m[0] / m[1]]);
                t[0] += WIDER * w[0];
                t[1] += WIDER * w[1];
            }
        })?;
    }
    Ok(total)
}

/// The value at fine cell `p` of sums over cells twice as coarse, linear between their centres.
fn linear(coarse: &[[f32; 2]], m: [usize; 3], p: [usize; 3]) -> [f32; 2] {
    let mut out = [0.0; 2];
    for corner in 0..8usize {
        let (mut weight, mut i, mut stride) = (1.0, 0, 1);
        for a in 0..3 {
            // the nearer centre counts 3/4, the one on the fine cell's side 1/4
            let side = if p[a].is_multiple_of(2) { (p[a] / 2).saturating_sub(1) } else { (p[a] / 2 + 1).min(m[a] - 1) };
            let (at, w) = if corner >> a & 1 == 0 { (p[a] / 2, 0.75) } else { (side, 0.25) };
            i += stride * at;
            stride *= m[a];
            weight *= w;
        }
        out[0] += weight * coarse[i][0];
        out[1] += weight * coarse[i][1];
    }
    out
}

/// Separable Gaussian, zero outside, sigma in cells per axis.
fn blurred(mut cells: Vec<[f32; 2]>, m: [usize; 3], sigma: [f64; 3], ctx: &Ctx) -> Result<Vec<[f32; 2]>, Error> {
    let stride = [1, m[0], m[0] * m[1]];
    for a in 0..3 {
        let r = ((3.0 * sigma[a]).ceil() as usize).min(m[a].saturating_sub(1));
        let w: Vec<f32> = (0..=r).map(|i| (-0.5 * (i as f64 / sigma[a]).powi(2)).exp() as f32).collect();
        let source = cells.clone();
        ctx.chunks_mut(&mut cells, m[0], |first, out| {
            for (k, o) in out.iter_mut().enumerate() {
                let i = first + k;
                let at = i / stride[a] % m[a];
                *o = [0.0; 2];
                for j in at.saturating_sub(r)..(at + r + 1).min(m[a]) {
                    let s = source[i + j * stride[a] - at * stride[a]];
                    let w = w[at.abs_diff(j)];
                    o[0] += w * s[0];
                    o[1] += w * s[1];
                }
            }
        })?;
    }
    Ok(cells)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A vertical tube of 6 px in tissue of 230 with waves of 6 mm of this amplitude across it, all with noise of standard
    /// deviation 30 (uniform numbers by splitmix64); its mask and the tissue without noise.
    fn tube(seed: u64, amplitude: f32) -> (Patch, Vec<bool>, Vec<f32>) {
        let (n, mut state) = ([48, 48, 12], seed.wrapping_mul(0x2545_f491_4f6c_dd1d));
        let mut uniform = || {
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = state;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            ((z ^ (z >> 31)) >> 11) as f32 / (1_u64 << 53) as f32
        };
        let inside = |i: usize| ((i % 48) as f64 - 23.7).hypot((i / 48 % 48) as f64 - 24.2) < 6.0;
        let mask: Vec<bool> = (0..48 * 48 * 12).map(inside).collect();
        let wave = |i: usize| (std::f32::consts::TAU * (i % 48) as f32 / 12.0 + seed as f32).sin();
        let tissue: Vec<f32> = (0..mask.len()).map(|i| 230.0 + amplitude * wave(i)).collect();
        let mut noise = || 30.0 * 12.0_f32.sqrt() * (uniform() - 0.5);
        let raw: Vec<f32> = mask.iter().zip(&tissue).map(|(m, t)| if *m { 1000.0 } else { *t } + noise()).collect();
        (Patch { low: [0; 3], n, step: [0.5, 0.5, 1.5], pixel_mm: 0.5, smooth: raw.clone(), raw }, mask, tissue)
    }

    /// Vertical tubes of 6 px about (x, 24.2) in tissue of 230, lumens of 1000, blurred by .6 px; the mask of the first.
    fn blurred_tubes(x: &[f64]) -> (Patch, Vec<bool>) {
        let n = [64, 48, 12];
        let off = |i: usize, x: f64| ((i % 64) as f64 - x).hypot((i / 64 % 48) as f64 - 24.2) - 6.0;
        let edge = |d: f64| {
            // the normal distribution's tail (Abramowitz and Stegun 7.1.26, 1e-7)
            let x = d.abs() / (0.6 * std::f64::consts::SQRT_2);
            let t = 1.0 / (1.0 + 0.3275911 * x);
            let series = [1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592];
            let tail = 0.5 * series.iter().fold(0.0, |s, a| (s + a) * t) * (-x * x).exp();
            if d > 0.0 { tail } else { 1.0 - tail }
        };
        let value = |i: usize| 230.0 + 770.0 * x.iter().map(|&x| edge(off(i, x))).sum::<f64>();
        let raw: Vec<f32> = (0..64 * 48 * 12).map(|i| value(i) as f32).collect();
        let mask = (0..raw.len()).map(|i| off(i, x[0]) < 0.0).collect();
        (Patch { low: [0; 3], n, step: [0.5, 0.5, 0.5], pixel_mm: 0.5, smooth: raw.clone(), raw }, mask)
    }

    #[test]
    fn levels_of_drawing_are_clear_of_the_blur_and_keep_to_the_gap_between_two_walls() {
        let ctx = Ctx::new(1).unwrap();
        let mean = |f: &Fields, of: &[usize]| of.iter().map(|&i| f.outside[i]).sum::<f32>() / of.len() as f32;
        let beside = |patch: &Patch, mask: &[bool]| -> Vec<usize> {
            let near = patch.distances(mask, 10);
            (0..mask.len()).filter(|&i| !mask[i] && near[i] <= 10).collect()
        };
        let (patch, mask) = blurred_tubes(&[20.0]);
        let near = patch.fields(&mask, |_| 615.0, &ctx).unwrap();
        let rim = beside(&patch, &mask);
        let of_ring = mean(&near, &rim);
        let drawn = mean(&patch.drawing_fields(&mask, near, &ctx).unwrap(), &rim);
        let biases = [of_ring, drawn].map(|outside| (outside - 230.0) / 770.0);
        assert!(biases[0] > 0.002 && biases[1].abs() < 0.2 * biases[0], "{biases:?}");

        // between two walls that lie 4.5 px apart tissue is brighter: the far ring, which has no room there, does not see it
        let (mut patch, mut mask) = blurred_tubes(&[20.0, 36.5]);
        let between = |i: usize| (26..31).contains(&(i % 64)) && (20..29).contains(&(i / 64 % 48));
        for (i, raw) in patch.raw.iter_mut().enumerate() {
            mask[i] = mask[i] || *raw > 615.0;
            *raw += if between(i) { 150.0 * (1.0 - (*raw - 230.0) / 770.0) } else { 0.0 };
        }
        patch.smooth.clone_from(&patch.raw);
        let near = patch.fields(&mask, |_| 615.0, &ctx).unwrap();
        let gap: Vec<usize> = beside(&patch, &mask).into_iter().filter(|&i| between(i)).collect();
        let of_ring = mean(&near, &gap);
        let drawn = mean(&patch.drawing_fields(&mask, near, &ctx).unwrap(), &gap);
        let seen = [of_ring, drawn].map(|outside| (outside - 230.0) / 770.0);
        assert!(seen[0] > 0.03 && seen[1] > 0.9 * seen[0], "{seen:?}");
    }

    /// Mean squares over the voxels beside the tube: tissue less its local mean, and the error stated for it.
    fn squares(amplitude: f32) -> [f64; 2] {
        let ctx = Ctx::new(1).unwrap();
        let (mut sums, mut count) = ([0.0; 2], 0.0);
        for seed in 1..21 {
            let (patch, mask, tissue) = tube(seed, amplitude);
            let fields = patch.fields(&mask, |_| 615.0, &ctx).unwrap();
            let error = patch.outside_error(&mask, &fields, &ctx).unwrap();
            let beside = patch.distances(&mask, RING.1);
            for i in (0..mask.len()).filter(|&i| (RING.0..=RING.1).contains(&beside[i])) {
                sums[0] += f64::from(tissue[i] - fields.outside[i]).powi(2);
                sums[1] += f64::from(error[i]).powi(2);
                count += 1.0;
            }
        }
        sums.map(|s| s / count)
    }

    #[test]
    fn the_stated_error_of_the_surroundings_is_their_texture_and_little_of_the_noise() {
        let [seen, stated] = squares(40.0);
        // waves of 6 mm lose a seventh of their product between diagonal neighbours
        assert!((0.7..1.1).contains(&(stated / seen)), "{stated} {seen}");
        let [seen, stated] = squares(0.0);
        // the mean of some 200 pixels with noise of 30; what scatters below zero is cut off
        assert!(seen < 10.0 && stated < 40.0, "{stated} {seen}");
    }
}
