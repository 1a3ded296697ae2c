//! Contours across an axis of the volume: planes, lines, lumens and the axis itself.

use crate::march::{Lattice, Line, zero_lines};
use crate::segment::{Segmentation, Site};
use crate::{Axis, Error, Plane, Stack};
use exec::Ctx;

/// A drawn line of one lumen (or of a hole in it).
pub(crate) struct Outline {
    pub(crate) plane: usize,
    pub(crate) line: Line,
    pub(crate) hole: bool,
    /// Mean level over the lumen.
    pub(crate) level: f64,
}

/// One plane's lines and which lattice points of the segmentation's box they enclose.
pub(crate) struct Drawn {
    pub(crate) outlines: Vec<Outline>,
    /// Lattice points per line of `label`.
    pub(crate) width: usize,
    /// Outlines that bound lumens (indices into `outlines`) have label index + 1; 0 elsewhere.
    pub(crate) label: Vec<u16>,
    /// Lines dropped as specks.
    pub(crate) specks: usize,
}

impl Drawn {
    /// Removes outlines by their numbers; the others are numbered anew.
    pub(crate) fn remove(&mut self, gone: &[usize]) {
        if gone.is_empty() {
            return;
        }
        let mut renamed = vec![0u16; self.outlines.len() + 1];
        let kept = (0..self.outlines.len()).filter(|o| !gone.contains(o));
        for (new, old) in kept.enumerate() {
            renamed[old + 1] = new as u16 + 1;
        }
        for l in &mut self.label {
            *l = renamed[usize::from(*l)];
        }
        let mut number = 0..;
        self.outlines.retain(|_| !number.next().is_some_and(|n| gone.contains(&n)));
    }
}

/// The lattice of an axis: which voxel steps are u, v and the plane's number.
#[derive(Clone, Copy)]
pub(crate) struct Frame {
    pub(crate) axis: Axis,
    /// Voxel axes (0 column, 1 row, 2 slice) of u, v and of the normal.
    pub(crate) of: [usize; 3],
}

impl Frame {
    pub(crate) fn new(axis: Axis) -> Self {
        let of = match axis {
            Axis::Slice => [0, 1, 2],
            Axis::Row => [2, 0, 1],
            Axis::Column => [1, 2, 0],
        };
        Self { axis, of }
    }
    /// Size of the segmentation's box along u, v and the normal.
    pub(crate) fn size(self, s: &Segmentation) -> [usize; 3] {
        self.of.map(|a| s.size[a])
    }
    /// Index in the segmentation's box of lattice point (i, j) of the box's plane k.
    pub(crate) fn index(self, s: &Segmentation, i: usize, j: usize, k: usize) -> usize {
        let mut p = [0; 3];
        (p[self.of[0]], p[self.of[1]], p[self.of[2]]) = (i, j, k);
        p[0] + s.size[0] * (p[1] + s.size[1] * p[2])
    }
    /// Raw grey value at a voxel index of the box.
    pub(crate) fn grey(s: &Segmentation, stack: &Stack, i: usize) -> f32 {
        let p = [i % s.size[0], i / s.size[0] % s.size[1], i / s.size[0] / s.size[1]];
        let [x, y, z] = [0, 1, 2].map(|a| p[a] + s.low[a]);
        stack.pixels[x + stack.columns * (y + stack.rows * z)]
    }
}

/// All planes of an axis, ascending along their normals.
pub(crate) fn planes(stack: &Stack, axis: Axis) -> Vec<Plane> {
    let steps = |n: usize, d: f64| (0..n).map(|i| i as f64 * d).collect::<Vec<f64>>();
    let columns = steps(stack.columns, stack.pixel_spacing_mm[1]);
    let rows = steps(stack.rows, stack.pixel_spacing_mm[0]);
    let slices: Vec<f64> = (0..stack.slices()).map(|k| stack.offset_mm(k)).collect();
    let (r, c, n) = (stack.row_direction, stack.column_direction, stack.normal());
    let plane = |index: usize, origin, u, v, u_mm: &[f64], v_mm: &[f64]| Plane {
        index,
        origin,
        u,
        v,
        u_mm: u_mm.to_vec(),
        v_mm: v_mm.to_vec(),
    };
    match axis {
        Axis::Slice => (0..stack.slices()).map(|k| plane(k, stack.origins[k], r, c, &columns, &rows)).collect(),
        Axis::Row => {
            (0..stack.rows).map(|k| plane(k, stack.position(0, k as f64, 0.0), n, r, &slices, &columns)).collect()
        }
        Axis::Column => {
            (0..stack.columns).map(|k| plane(k, stack.position(0, 0.0, k as f64), c, n, &rows, &slices)).collect()
        }
    }
}

/// Another axis is taken only when the mean squared normal component along it is below this share of the slices' one:
/// slices carry square, unresampled pixels. A vessel turned by 45 degrees keeps its slices.
const CLEARLY_BETTER: f64 = 0.6;
/// ... and less where the slices are so far apart that a plane across them shows a lumen by few samples: the share
/// falls with radius / step below this ratio.
const RADIUS_PER_STEP: f64 = 1.5;
/// Where slices lie farther apart than this many pixels ...
const APART_PX: f64 = 1.75;
/// ... another axis is taken only by what lies within the slices, and spans no more than this many of its diameters across them: at 60
/// to 80 degrees its sections across the columns err by a third more, or twice as much, as those of the slices (docs/adr/0030).
const WITHIN_DIAMETERS: f64 = 2.5;

/// The axis that the lumen follows: the one along which its wall's normals have the smallest mean square, slices unless
/// another is clearly better.
pub(crate) fn axis(stack: &Stack, s: &Segmentation) -> Axis {
    let n = s.size;
    let step = [stack.pixel_spacing_mm[1], stack.pixel_spacing_mm[0], stack.slice_spacing_mm()];
    if step[2] > APART_PX * step[0].max(step[1])
        && across_slices(s) as f64 * step[2] > 2.0 * WITHIN_DIAMETERS * s.radius_mm
    {
        return Axis::Slice;
    }
    let inside = |p: [i64; 3]| {
        let q: [usize; 3] = std::array::from_fn(|a| p[a].clamp(0, n[a] as i64 - 1) as usize);
        s.site[q[0] + n[0] * (q[1] + n[1] * q[2])] >= Site::Lumen
    };
    let mut mean = [0.0; 3];
    for i in (0..s.site.len()).filter(|&i| s.site[i] == Site::Lumen) {
        let p = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]].map(|x| x as i64);
        let mut g = [0.0f64; 3];
        for d in crate::region::NEIGHBOURS {
            if inside(std::array::from_fn(|a| p[a] + i64::from(d[a]))) {
                for a in 0..3 {
                    g[a] += f64::from(d[a]) / step[a];
                }
            }
        }
        let length = g.iter().map(|x| x * x).sum::<f64>();
        if length > 0.0 {
            for a in 0..3 {
                mean[a] += g[a] * g[a] / length;
            }
        }
    }
    let share = CLEARLY_BETTER * (s.radius_mm / (RADIUS_PER_STEP * step[2])).min(1.0);
    let (other, axis) = if mean[1] <= mean[0] { (mean[1], Axis::Row) } else { (mean[0], Axis::Column) };
    if other < share * mean[2] { axis } else { Axis::Slice }
}

/// From the first to the last slice that the lumen reaches.
fn across_slices(s: &Segmentation) -> usize {
    let area = s.size[0] * s.size[1];
    let reached = |slice: &[Site]| slice.iter().any(|&site| site >= Site::Lumen);
    let first = s.site.chunks(area).position(reached);
    let last = s.site.chunks(area).rposition(reached);
    first.zip(last).map_or(0, |(first, last)| last - first)
}

/// Smallest lumen, in lattice cells: three quarters of the area of a disc of 1.2 px radius.
const LEAST_CELLS: f64 = 3.5;
/// Smallest hole, in lattice cells: smaller ones are noise.
const LEAST_HOLE_CELLS: f64 = 12.0;
/// Share of the enclosed lattice points that must belong to the segmented lumen.
const OWN_SHARE: f64 = 0.3;

/// The lines of all planes of the segmentation's box.
pub(crate) fn drawn(stack: &Stack, s: &Segmentation, axis: Axis, ctx: &Ctx) -> Result<Vec<Drawn>, Error> {
    let frame = Frame::new(axis);
    let all = planes(stack, axis);
    let low = s.low[frame.of[2]];
    Ok(ctx.map_range(frame.size(s)[2], |k| plane_lines(stack, s, frame, &all[low + k], k))?)
}

fn plane_lines(stack: &Stack, s: &Segmentation, frame: Frame, plane: &Plane, k: usize) -> Drawn {
    let [w, h, _] = frame.size(s);
    let [u0, v0] = [s.low[frame.of[0]], s.low[frame.of[1]]];
    let (xs, ys) = (&plane.u_mm[u0..u0 + w], &plane.v_mm[v0..v0 + h]);
    let mut values = vec![0.0f32; w * h];
    let mut any = false;
    for j in 0..h {
        for i in 0..w {
            let at = frame.index(s, i, j, k);
            let d = Frame::grey(s, stack, at) - s.level[at];
            any |= s.site[at] >= Site::Lumen;
            // Beyond the band round the wall the segmentation decides: noise there draws no specks, and the raw values
            // make no bridge to a neighbour.
            values[j * w + i] = match s.site[at] {
                Site::Far => -d.abs().max(f32::MIN_POSITIVE),
                Site::Deep => d.abs().max(f32::MIN_POSITIVE),
                _ => d,
            };
        }
    }
    let mut out = Drawn { outlines: Vec::new(), width: w, label: vec![0; w * h], specks: 0 };
    if !any {
        return out;
    }
    let cell = (xs[w - 1] - xs[0]) * (ys[h - 1] - ys[0]) / ((w - 1).max(1) * (h - 1).max(1)) as f64;
    for line in zero_lines(&Lattice { xs, ys, values: &values }) {
        let cells = line.area() / cell;
        let points = enclosed(&line, xs, ys);
        let own = points.iter().filter(|&&(i, j)| s.site[frame.index(s, i, j, k)] >= Site::Lumen).count();
        let hole = cells < 0.0;
        let kept = if hole {
            // a hole is real when the segmentation on denoised values has it too
            -cells >= LEAST_HOLE_CELLS && 2 * own <= points.len()
        } else {
            cells >= LEAST_CELLS && own as f64 >= OWN_SHARE * points.len() as f64
        };
        if !kept {
            out.specks += 1;
            continue;
        }
        let sum: f64 = points.iter().map(|&(i, j)| f64::from(s.level[frame.index(s, i, j, k)])).sum();
        let level = sum / points.len().max(1) as f64;
        out.outlines.push(Outline { plane: plane.index, line, hole, level });
        if !hole {
            let label = out.outlines.len() as u16;
            for (i, j) in points {
                out.label[j * w + i] = label;
            }
        }
    }
    out
}

/// Lattice points inside a closed line (even-odd rule, half-open on the lines of the lattice).
fn enclosed(line: &Line, xs: &[f64], ys: &[f64]) -> Vec<(usize, usize)> {
    let n = line.points.len();
    let mut crossings: Vec<Vec<f64>> = vec![Vec::new(); ys.len()];
    for i in 0..n {
        let (p, q) = (line.points[i], line.points[(i + 1) % n]);
        let (lo, hi) = if p[1] <= q[1] { (p, q) } else { (q, p) };
        for j in ys.partition_point(|&y| y < lo[1])..ys.partition_point(|&y| y < hi[1]) {
            crossings[j].push(lo[0] + (hi[0] - lo[0]) * (ys[j] - lo[1]) / (hi[1] - lo[1]));
        }
    }
    let mut out = Vec::new();
    for (j, row) in crossings.iter_mut().enumerate() {
        row.sort_by(f64::total_cmp);
        for pair in row.chunks_exact(2) {
            let range = xs.partition_point(|&x| x < pair[0])..xs.partition_point(|&x| x <= pair[1]);
            out.extend(range.map(|i| (i, j)));
        }
    }
    out
}
