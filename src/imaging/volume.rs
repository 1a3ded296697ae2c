//! Grey values on a lattice for the search of the vessel: light denoising, binning, noise and the tissue background.
//!
//! Only the segmentation sees these; contours are drawn on the raw grey values.

use crate::{Error, Stack};
use exec::Ctx;

/// Grey values; index = x + n[0] * (y + n[1] * z), x along rows, z across slices.
#[derive(Clone)]
pub(crate) struct Volume {
    pub(crate) n: [usize; 3],
    /// Steps along x, y, z in mm (z: the median slice step).
    pub(crate) step: [f64; 3],
    pub(crate) data: Vec<f32>,
}

/// In-plane Gaussian of the denoised copy, px: lowers white noise to .42 of itself and widens a point spread of .6 px to
/// .92 px, so that lumens of 2 px radius keep 90 % of their contrast.
const DENOISE_PX: f64 = 0.7;
/// Below this sigma (in slice steps) a filter across slices does nothing.
const LEAST_SLICE_SIGMA: f64 = 0.3;

impl Volume {
    pub(crate) fn at(&self, x: usize, y: usize, z: usize) -> f32 {
        self.data[x + self.n[0] * (y + self.n[1] * z)]
    }
    /// The denoised copy of a stack, and the factor by which white noise is lowered in it.
    pub(crate) fn denoised(stack: &Stack, ctx: &Ctx) -> Result<(Self, f64), Error> {
        let n = [stack.columns, stack.rows, stack.slices()];
        let step = [stack.pixel_spacing_mm[1], stack.pixel_spacing_mm[0], stack.slice_spacing_mm()];
        let plane = kernel(DENOISE_PX);
        let across = kernel(DENOISE_PX * stack.pixel_mm() / step[2]);
        let mut data = vec![0.0f32; n[0] * n[1] * n[2]];
        ctx.chunks_mut(&mut data, n[0] * n[1], |first, out| {
            let z = first / (n[0] * n[1]);
            smooth_slice(stack.slice(z), n[0], n[1], &plane, out);
        })?;
        if across.len() > 1 {
            let source = data.clone();
            let r = (across.len() / 2) as isize;
            let area = n[0] * n[1];
            ctx.chunks_mut(&mut data, area, |first, out| {
                let z = (first / area) as isize;
                for (i, o) in out.iter_mut().enumerate() {
                    *o = (-r..=r).fold(0.0, |s, d| {
                        let zz = (z + d).clamp(0, n[2] as isize - 1) as usize;
                        s + across[(d + r) as usize] * source[zz * area + i]
                    });
                }
            })?;
        }
        let energy = |k: &[f32]| k.iter().map(|w| f64::from(w * w)).sum::<f64>();
        Ok((Self { n, step, data }, energy(&plane) * energy(&across).sqrt()))
    }
    /// Means over b x b pixels of every slice.
    pub(crate) fn binned(&self, b: usize, ctx: &Ctx) -> Result<Self, Error> {
        let n = [self.n[0] / b, self.n[1] / b, self.n[2]];
        let step = [self.step[0] * b as f64, self.step[1] * b as f64, self.step[2]];
        let mut data = vec![0.0f32; n[0] * n[1] * n[2]];
        ctx.chunks_mut(&mut data, n[0] * n[1], |first, out| {
            let z = first / (n[0] * n[1]);
            for (i, o) in out.iter_mut().enumerate() {
                let (x, y) = (i % n[0] * b, i / n[0] * b);
                let sum: f32 = (0..b * b).map(|k| self.at(x + k % b, y + k / b, z)).sum();
                *o = sum / (b * b) as f32;
            }
        })?;
        Ok(Self { n, step, data })
    }
}

/// A sampled, normalised Gaussian of odd length; a single 1 where sigma is too small to matter.
fn kernel(sigma: f64) -> Vec<f32> {
    if sigma < LEAST_SLICE_SIGMA {
        return vec![1.0];
    }
    let r = (3.0 * sigma).ceil() as i32;
    let w: Vec<f64> = (-r..=r).map(|i| (-0.5 * (f64::from(i) / sigma).powi(2)).exp()).collect();
    let sum: f64 = w.iter().sum();
    w.iter().map(|x| (x / sum) as f32).collect()
}

fn smooth_slice(slice: &[f32], w: usize, h: usize, kernel: &[f32], out: &mut [f32]) {
    let r = kernel.len() / 2;
    let mut rows = vec![0.0f32; w * h];
    for y in 0..h {
        let line = &slice[y * w..(y + 1) * w];
        for x in 0..w {
            rows[y * w + x] = if x >= r && x + r < w {
                kernel.iter().zip(&line[x - r..]).map(|(k, v)| k * v).sum()
            } else {
                kernel.iter().enumerate().map(|(i, k)| k * line[(x + i).saturating_sub(r).min(w - 1)]).sum()
            };
        }
    }
    for y in 0..h {
        let line = &mut out[y * w..(y + 1) * w];
        line.fill(0.0);
        for (i, k) in kernel.iter().enumerate() {
            let yy = (y + i).saturating_sub(r).min(h - 1);
            for (o, v) in line.iter_mut().zip(&rows[yy * w..]) {
                *o += k * v;
            }
        }
    }
}

/// Noise of the raw grey values (standard deviation) from second differences along rows, robust: 1.4826 times the
/// median absolute value over the brighter half of the pixels, because a magnitude image has less noise in air.
pub(crate) fn noise(stack: &Stack) -> f64 {
    let n = stack.pixels.len();
    // 200,000 samples give the median to .5 %; the stride is odd so that no column is preferred.
    let stride = (n / 200_000).max(1) | 1;
    let (mut samples, w) = (Vec::new(), stack.columns);
    for i in (0..n).step_by(stride).filter(|i| i % w > 0 && i % w < w - 1) {
        let [a, b, c] = [stack.pixels[i - 1], stack.pixels[i], stack.pixels[i + 1]].map(f64::from);
        samples.push((a + b + c, (b - 0.5 * (a + c)).abs()));
    }
    samples.sort_by(|p, q| p.0.total_cmp(&q.0));
    let mut bright: Vec<f64> = samples.drain(samples.len() / 2..).map(|s| s.1).collect();
    median(&mut bright) * 1.4826 / 1.5_f64.sqrt()
}

/// The middle value; 0 of nothing.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    quantile(values, 0.5)
}

/// The value below which a share `q` of the values lies; 0 of nothing. Reorders the values.
pub(crate) fn quantile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let k = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(k, f64::total_cmp).1
}

/// Edge of a background block, mm: a lumen of 20 mm diameter, the largest asked for, covers half of it.
const BLOCK_MM: f64 = 25.0;
/// Quantile of a block's signal that stands for the tissue: a quarter, so that lumens may fill three quarters.
const TISSUE_QUANTILE: f64 = 0.25;
/// Grey values below this many noise deviations are air (a Rician background has its mean at 1.25, and the denoised
/// one spreads by .3).
const AIR_NOISE: f64 = 2.2;

/// Subtracts the tissue background, so that a bias field or uneven tissue leaves lumens as the bright rest: block
/// quantiles over pixels with signal (air excluded), medians over 3 x 3 blocks, trilinear between block centres.
/// Without any tissue signal the background is the median grey value.
pub(crate) fn without_background(v: &Volume, noise: f64, ctx: &Ctx) -> Result<Volume, Error> {
    let air = AIR_NOISE * noise;
    let blocks: [usize; 3] =
        std::array::from_fn(|a| ((v.n[a] as f64 * v.step[a] / BLOCK_MM).round() as usize).clamp(1, v.n[a]));
    let count = blocks[0] * blocks[1] * blocks[2];
    let range = |a: usize, b: usize| (b * v.n[a] / blocks[a], (b + 1) * v.n[a] / blocks[a]);
    let tissue = ctx.map_range(count, |k| {
        let b = [k % blocks[0], k / blocks[0] % blocks[1], k / blocks[0] / blocks[1]];
        let [(x0, x1), (y0, y1), (z0, z1)] = [0, 1, 2].map(|a| range(a, b[a]));
        let mut values: Vec<f64> = Vec::with_capacity((x1 - x0) * (y1 - y0) * (z1 - z0));
        for z in z0..z1 {
            for y in y0..y1 {
                values.extend((x0..x1).map(|x| f64::from(v.at(x, y, z))).filter(|&s| s > air));
            }
        }
        // A block with less than a twentieth of signal says nothing of tissue.
        let enough = values.len() * 20 > (x1 - x0) * (y1 - y0) * (z1 - z0);
        enough.then(|| quantile(&mut values, TISSUE_QUANTILE))
    })?;
    let mut all: Vec<f64> = v.data.iter().step_by(v.data.len() / 100_000 + 1).map(|&x| f64::from(x)).collect();
    let level = smoothed_blocks(&tissue, blocks, median(&mut all));
    let mut data = vec![0.0f32; v.data.len()];
    let area = v.n[0] * v.n[1];
    ctx.chunks_mut(&mut data, area, |first, out| {
        let z = first / area;
        for y in 0..v.n[1] {
            for x in 0..v.n[0] {
                let i = y * v.n[0] + x;
                out[i] = v.data[first + i] - interpolated(&level, blocks, [x, y, z], v.n);
            }
        }
    })?;
    Ok(Volume { data, ..*v })
}

/// Medians over 3 x 3 x 3 known blocks; unknown ones take their neighbours', step by step.
fn smoothed_blocks(tissue: &[Option<f64>], n: [usize; 3], fallback: f64) -> Vec<f32> {
    let mut known = tissue.to_vec();
    for _ in 0..1 + n[0] + n[1] + n[2] {
        let before = known.clone();
        for (k, out) in known.iter_mut().enumerate() {
            let (x, y, z) = (k % n[0], k / n[0] % n[1], k / n[0] / n[1]);
            let mut around = Vec::new();
            for c in z.saturating_sub(1)..(z + 2).min(n[2]) {
                for b in y.saturating_sub(1)..(y + 2).min(n[1]) {
                    for a in x.saturating_sub(1)..(x + 2).min(n[0]) {
                        around.extend(before[a + n[0] * (b + n[1] * c)]);
                    }
                }
            }
            if out.is_none() && !around.is_empty() {
                *out = Some(median(&mut around));
            }
        }
        if known.iter().all(Option::is_some) || known.iter().all(Option::is_none) {
            break;
        }
    }
    known.iter().map(|v| v.unwrap_or(fallback) as f32).collect()
}

fn interpolated(level: &[f32], blocks: [usize; 3], p: [usize; 3], n: [usize; 3]) -> f32 {
    let mut lo = [0; 3];
    let mut t = [0.0f32; 3];
    for a in 0..3 {
        let u = ((p[a] as f32 + 0.5) * blocks[a] as f32 / n[a] as f32 - 0.5).clamp(0.0, blocks[a] as f32 - 1.0);
        lo[a] = (u as usize).min(blocks[a].saturating_sub(2));
        t[a] = u - lo[a] as f32;
    }
    let mut sum = 0.0;
    for c in 0..8usize {
        let bit = |a: usize| c >> a & 1;
        let w = (0..3).fold(1.0, |w, a| w * if bit(a) == 1 { t[a] } else { 1.0 - t[a] });
        if w > 0.0 {
            sum += w * level[lo[0] + bit(0) + blocks[0] * (lo[1] + bit(1) + blocks[1] * (lo[2] + bit(2)))];
        }
    }
    sum
}
