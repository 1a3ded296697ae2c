//! Filters on lattices: values to B-spline coefficients, and the twiced Gaussian in a band of rows.
//!
//! The Gaussian is separable, but only the band around the wall is wanted of it. Its three passes therefore run over rows
//! along x with the span that the next pass asks for: the last over the band alone, the one before over rows within the
//! kernel's reach of it along z, the first over rows within reach along y and z.

use crate::Error;
use exec::{Cancelled, Ctx};

/// Planes filtered at once across the slowest axis: bounds the memory of the copies.
const PLANES: usize = 32;
/// Kernel values below this are left out: moves f by less than 1e-8 mm against 1e-12, with a fifth fewer terms.
const CUT: f64 = 1e-9;
/// Rows per parallel task.
const ROWS: usize = 32;

/// Values to tricubic B-spline coefficients, in place.
pub(crate) fn to_coefficients(values: &mut [f64], size: [usize; 3], ctx: &Ctx) -> Result<(), Error> {
    for axis in 0..3 {
        along(values, size, axis, ctx, &|block, width| prefilter(block, width))?;
    }
    Ok(())
}

/// 2 G - G*G of dense coefficients at the spans wanted; G the discrete Gaussian of variance `t` (lattice steps squared).
/// Ends are repeated.
pub(crate) fn twiced(dense: &[f64], size: [usize; 3], band: &Spans, t: f64, ctx: &Ctx) -> Result<Rows, Error> {
    let mut once = gaussian(dense, size, band, &discrete_gaussian(t, CUT), ctx)?;
    let twice = gaussian(dense, size, band, &discrete_gaussian(2.0 * t, CUT), ctx)?;
    once.values.iter_mut().zip(&twice.values).for_each(|(a, b)| *a = 2.0 * *a - b);
    Ok(once)
}

fn gaussian(dense: &[f64], size: [usize; 3], band: &Spans, kernel: &[f64], ctx: &Ctx) -> Result<Rows, Error> {
    let [nx, ny, nz] = size;
    let reach = kernel.len() - 1;
    let before_z = band.dilated(size, 2, reach);
    let before_y = before_z.dilated(size, 1, reach);
    let x = Rows::filled(before_y, ctx, |row, [lo, hi], out| {
        let line = &dense[row * nx..(row + 1) * nx];
        // the line with its ends repeated, so that the sums run over slices
        let padded: Vec<f64> = (lo..hi + 2 * reach).map(|i| line[i.saturating_sub(reach).min(nx - 1)]).collect();
        weighted(out, kernel, |m| (&padded[reach - m..], &padded[reach + m..]));
    })?;
    let y = Rows::filled(before_z, ctx, |row, span, out| {
        let (j, k) = (row % ny, row / ny);
        weighted(out, kernel, |m| {
            (x.part(j.saturating_sub(m) + ny * k, span), x.part((j + m).min(ny - 1) + ny * k, span))
        });
    })?;
    drop(x);
    Ok(Rows::filled(band.clone(), ctx, |row, span, out| {
        let (j, k) = (row % ny, row / ny);
        weighted(out, kernel, |m| {
            (y.part(j + ny * k.saturating_sub(m), span), y.part(j + ny * (k + m).min(nz - 1), span))
        });
    })?)
}

/// out = w_0 a_0 + sum w_m (a_m + b_m), with a and b the inputs m steps before and after.
fn weighted<'a>(out: &mut [f64], kernel: &[f64], inputs: impl Fn(usize) -> (&'a [f64], &'a [f64])) {
    out.iter_mut().zip(inputs(0).0).for_each(|(o, x)| *o = kernel[0] * x);
    for (m, w) in kernel.iter().enumerate().skip(1) {
        let (a, b) = inputs(m);
        for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
            *o += w * (a + b);
        }
    }
}

/// A span [from, to) along x of every row (j, k) of a lattice, j faster; empty where nothing is wanted.
#[derive(Clone, Debug)]
pub(crate) struct Spans(Vec<[u32; 2]>);

impl Spans {
    /// The spans that hold some lattice points (indices with x fastest).
    pub(crate) fn around(points: &[usize], [nx, ny, nz]: [usize; 3]) -> Self {
        let mut spans = vec![[u32::MAX, 0]; ny * nz];
        for &p in points {
            let (i, span) = ((p % nx) as u32, &mut spans[p / nx]);
            *span = [span[0].min(i), span[1].max(i + 1)];
        }
        Self(spans)
    }

    /// The spans that hold every span up to `reach` rows away along an axis, 1 or 2.
    fn dilated(&self, [_, ny, nz]: [usize; 3], axis: usize, reach: usize) -> Self {
        let mut out = vec![[u32::MAX, 0]; ny * nz];
        let (n, stride) = if axis == 1 { (ny, 1) } else { (nz, ny) };
        for (row, span) in self.0.iter().enumerate().filter(|(_, s)| s[0] < s[1]) {
            let at = row / stride % n;
            for other in at.saturating_sub(reach)..=(at + reach).min(n - 1) {
                let to = &mut out[row - at * stride + other * stride];
                *to = [to[0].min(span[0]), to[1].max(span[1])];
            }
        }
        Self(out)
    }
}

/// Values at the spans of a lattice's rows.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    spans: Spans,
    /// Of the first value of each row.
    offsets: Vec<usize>,
    values: Vec<f64>,
}

impl Rows {
    /// Fills each row by `fill(row, [from, to], values)`, in parallel.
    fn filled(spans: Spans, ctx: &Ctx, fill: impl Fn(usize, [usize; 2], &mut [f64]) + Sync) -> Result<Self, Cancelled> {
        let mut total = 0;
        let length = |s: &[u32; 2]| s[1].saturating_sub(s[0]) as usize;
        let mut offset = |s: &[u32; 2]| {
            total += length(s);
            total - length(s)
        };
        let offsets = spans.0.iter().map(&mut offset).collect();
        let mut values = vec![0.0; total];
        let mut rest = &mut values[..];
        let mut rows = Vec::with_capacity(spans.0.len());
        for span in &spans.0 {
            let (row, after) = rest.split_at_mut(length(span));
            rows.push(row);
            rest = after;
        }
        ctx.chunks_mut(&mut rows, ROWS, |first, rows| {
            for (k, out) in rows.iter_mut().enumerate().filter(|(_, out)| !out.is_empty()) {
                fill(first + k, spans.0[first + k].map(|x| x as usize), out);
            }
        })?;
        drop(rows);
        Ok(Self { spans, offsets, values })
    }

    /// The values of a row from x = lo to x = hi, which its span must hold.
    fn part(&self, row: usize, [lo, hi]: [usize; 2]) -> &[f64] {
        let from = self.offsets[row] + lo - self.spans.0[row][0] as usize;
        &self.values[from..from + hi - lo]
    }

    /// Four values of a row from x = i on, where its span holds them.
    #[inline]
    pub(crate) fn four(&self, row: usize, i: usize) -> Option<&[f64]> {
        let [from, to] = self.spans.0[row].map(|x| x as usize);
        (i >= from && i + 4 <= to).then(|| {
            let at = self.offsets[row] + i - from;
            &self.values[at..at + 4]
        })
    }
}

/// A filter on `width` interleaved lines: element l of line w lies at l * width + w.
type LineFilter<'a> = &'a (dyn Fn(&mut [f64], usize) + Sync);

/// Apply a line filter along one axis of a lattice, in parallel over the other axes.
fn along(data: &mut [f64], size: [usize; 3], axis: usize, ctx: &Ctx, filter: LineFilter<'_>) -> Result<(), Error> {
    let [nx, ny, nz] = size;
    match axis {
        0 => ctx.chunks_mut(data, nx, |_, line| filter(line, 1))?,
        1 => ctx.chunks_mut(data, nx * ny, |_, slab| filter(slab, nx))?,
        _ => {
            for first in (0..ny).step_by(PLANES) {
                let source = &*data;
                let blocks = ctx.map_range(PLANES.min(ny - first), |j| {
                    let row = |k: usize| nx * (first + j + ny * k);
                    let mut block: Vec<f64> = (0..nz).flat_map(|k| &source[row(k)..row(k) + nx]).copied().collect();
                    filter(&mut block, nx);
                    block
                })?;
                ctx.chunks_mut(data, nx * ny, |at, slab| {
                    let k = at / (nx * ny);
                    for (j, block) in blocks.iter().enumerate() {
                        slab[nx * (first + j)..nx * (first + j + 1)].copy_from_slice(&block[k * nx..(k + 1) * nx]);
                    }
                })?;
            }
        }
    }
    Ok(())
}

/// Values to cubic B-spline coefficients along interleaved lines, mirrored at the ends (Unser 1993).
fn prefilter(data: &mut [f64], width: usize) {
    let pole = 3f64.sqrt() - 2.0;
    let gain = (1.0 - pole) * (1.0 - 1.0 / pole);
    let n = data.len() / width;
    // the pole's powers fall below 1e-16 after 28 terms
    let horizon = n.min(28);
    let first: Vec<f64> =
        (0..width).map(|w| (0..horizon).rev().fold(0.0, |s, l| s * pole + gain * data[l * width + w])).collect();
    data.iter_mut().for_each(|x| *x *= gain);
    data[..width].copy_from_slice(&first);
    for l in 1..n {
        let (before, rest) = data.split_at_mut(l * width);
        for (x, b) in rest[..width].iter_mut().zip(&before[(l - 1) * width..]) {
            *x += pole * b;
        }
    }
    let scale = pole / (pole * pole - 1.0);
    for w in 0..width {
        let (a, b) = (data[(n - 1) * width + w], data[(n - 2) * width + w]);
        data[(n - 1) * width + w] = scale * (a + pole * b);
    }
    for l in (0..n - 1).rev() {
        let (before, rest) = data.split_at_mut((l + 1) * width);
        for (x, a) in before[l * width..].iter_mut().zip(&rest[..width]) {
            *x = pole * (a - *x);
        }
    }
}

/// The discrete Gaussian exp(-t) I_n(t) of variance t for n = 0.. (Lindeberg 1990): a semigroup on the lattice, so that
/// smoothing twice by t is smoothing once by 2 t exactly, also for t below 1. Cut where it falls below `cut`, and scaled to mass one.
fn discrete_gaussian(t: f64, cut: f64) -> Vec<f64> {
    // downward recurrence I_{n-1} = I_{n+1} + 2 n / t I_n, normalised by I_0 + 2 sum I_n = exp(t)
    if t < 1e-12 {
        return vec![1.0];
    }
    let start = (20.0 + 12.0 * t.sqrt() + t) as usize;
    let mut series = vec![0.0; start + 2];
    series[start] = 1e-290;
    for n in (1..=start).rev() {
        series[n - 1] = series[n + 1] + 2.0 * n as f64 / t * series[n];
        if series[n - 1] > 1e250 {
            series.iter_mut().for_each(|x| *x *= 1e-250);
        }
    }
    let mass = |series: &[f64]| series[0] + 2.0 * series[1..].iter().fold(0.0, |s, x| s + x);
    let total = mass(&series);
    let keep = series.iter().rposition(|&x| x > cut * total).map_or(1, |n| n + 1);
    series.truncate(keep);
    let total = mass(&series);
    series.iter_mut().for_each(|x| *x /= total);
    series
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_discrete_gaussian_has_mass_one_and_variance_t() {
        for t in [0.01, 0.5, 3.0, 40.0] {
            let g = discrete_gaussian(t, CUT);
            let mass = g[0] + 2.0 * g[1..].iter().sum::<f64>();
            let variance = 2.0 * g.iter().enumerate().map(|(n, w)| (n * n) as f64 * w).sum::<f64>();
            assert!((mass - 1.0).abs() < 1e-9, "{t}: {mass}");
            assert!((variance - t).abs() < 1e-6 * t.max(1.0), "{t}: {variance}");
        }
    }

    /// The filter of the whole lattice with the kernel down to 1e-12, as an oracle.
    fn whole(dense: &[f64], size: [usize; 3], t: f64, ctx: &Ctx) -> Vec<f64> {
        let run = |t: f64| {
            let kernel = discrete_gaussian(t, 1e-12);
            let mut data = dense.to_vec();
            for axis in 0..3 {
                along(&mut data, size, axis, ctx, &|block, width| convolve(block, width, &kernel)).unwrap();
            }
            data
        };
        run(t).into_iter().zip(run(2.0 * t)).map(|(a, b)| 2.0 * a - b).collect()
    }

    /// Convolution of interleaved lines with a symmetric kernel, ends repeated.
    fn convolve(data: &mut [f64], width: usize, kernel: &[f64]) {
        let n = data.len() / width;
        let source = data.to_vec();
        let row = |l: isize| {
            let l = l.clamp(0, n as isize - 1) as usize;
            &source[l * width..(l + 1) * width]
        };
        for l in 0..n {
            let out = &mut data[l * width..(l + 1) * width];
            out.iter_mut().zip(row(l as isize)).for_each(|(o, x)| *o = kernel[0] * x);
            for (m, w) in kernel.iter().enumerate().skip(1) {
                let (a, b) = (row(l as isize - m as isize), row(l as isize + m as isize));
                for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
                    *o += w * (a + b);
                }
            }
        }
    }

    #[test]
    fn the_band_is_filtered_as_the_whole_lattice_with_the_same_bits_for_any_thread_count() {
        let size = [61, 57, 70];
        let position = |i: usize| [i % 61, i / 61 % 57, i / (61 * 57)].map(|x| x as f64 - 30.0);
        // a rough tube of radius 12 steps in mm of half a step
        let value = |i: usize| {
            let [x, y, z] = position(i);
            0.5 * (12.0 - x.hypot(y)) + 0.1 * (0.9 * x).sin() * (0.7 * y + 0.4 * z).cos()
        };
        let dense: Vec<f64> = (0..size.iter().product()).map(value).collect();
        let near = |i: &usize| (position(*i)[0].hypot(position(*i)[1]) - 12.0).abs() < 8.0;
        let band: Vec<usize> = (0..dense.len()).filter(near).collect();
        let spans = Spans::around(&band, size);
        for t in [0.3, 2.0, 9.0] {
            let ctx = Ctx::new(2).unwrap();
            let rows = twiced(&dense, size, &spans, t, &ctx).unwrap();
            let all = whole(&dense, size, t, &ctx);
            let at = |rows: &Rows, p: usize| rows.part(p / 61, [p % 61, p % 61 + 1])[0];
            let off = band.iter().fold(0.0_f64, |m, &p| m.max((at(&rows, p) - all[p]).abs()));
            assert!(off < 1e-8, "t = {t}: {off:e}");
            for threads in [1, 3] {
                let other = twiced(&dense, size, &spans, t, &Ctx::new(threads).unwrap()).unwrap();
                assert!(rows.values.iter().zip(&other.values).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
        }
    }
}
