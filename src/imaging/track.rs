//! Lumens from plane to plane: where they end inside the volume, where the data end.

use crate::draw::{Drawn, Frame};
use crate::region::{FAR, distances};
use crate::segment::Segmentation;
use crate::{Axis, CutPlane, Plane, Stack, Tip};
use space::{Place, Warning};

/// Ends of the lumens.
#[derive(Default)]
pub(crate) struct Ends {
    pub(crate) tips: Vec<Tip>,
    pub(crate) cuts: Vec<CutPlane>,
    pub(crate) warnings: Vec<Warning>,
}

/// Distances are counted in tenths of the smaller in-plane step.
const TENTHS: f64 = 10.0;
/// Tips of one lumen stand at least this share of its half-width apart.
const SPACING: f64 = 1.0;
/// Medial positions shallower than this share of the lumen's half-width are the rim, not the middle.
const SHALLOW: f64 = 0.5;
/// A tip lies strictly between its planes.
const BETWEEN: (f64, f64) = (0.05, 0.95);

/// Tips, cuts and warnings of the drawn lumens. `numbers[k][o]` is the contour number of outline o of box plane k.
pub(crate) fn ends(stack: &Stack, s: &Segmentation, axis: Axis, drawn: &[Drawn], planes: &[Plane]) -> Ends {
    let frame = Frame::new(axis);
    let low = s.low[frame.of[2]];
    let mut out = Ends { cuts: cuts(drawn, planes), ..Ends::default() };
    for k in 0..drawn.len() {
        for up in [false, true] {
            let next = if up { k + 1 } else { k.wrapping_sub(1) };
            let past = if up { low + k + 1 == planes.len() } else { low + k == 0 };
            if past || next >= drawn.len() {
                continue;
            }
            let gap = axis == Axis::Slice && stack.gap_before(low + k.max(next));
            let step = Step { stack, s, frame, drawn, planes, k, next, gap };
            for (o, outline) in drawn[k].outlines.iter().enumerate() {
                if !outline.hole {
                    step.lumen(o, &mut out);
                }
            }
        }
    }
    out
}

/// First and last contour plane where a lumen is present, and image borders that a contour follows.
fn cuts(drawn: &[Drawn], planes: &[Plane]) -> Vec<CutPlane> {
    let mut out = Vec::new();
    let present = |index: usize| drawn.iter().flat_map(|d| &d.outlines).any(|o| o.plane == index);
    if let [first, .., last] = planes {
        if present(first.index) {
            out.push(CutPlane::new(first.origin, -first.normal()));
        }
        if present(last.index) {
            out.push(CutPlane::new(last.origin, last.normal()));
        }
    }
    let Some(plane) = planes.first() else { return out };
    let ends = [plane.u_mm[plane.u_mm.len() - 1], plane.v_mm[plane.v_mm.len() - 1]];
    for (axis, at, outward) in [(0, 0.0, -plane.u), (0, ends[0], plane.u), (1, 0.0, -plane.v), (1, ends[1], plane.v)] {
        let on = |o: &crate::draw::Outline| o.line.points.iter().zip(&o.line.border).any(|(p, &b)| b && p[axis] == at);
        if drawn.iter().flat_map(|d| &d.outlines).any(on) {
            let uv = if axis == 0 { [at, 0.0] } else { [0.0, at] };
            out.push(CutPlane::new(plane.to_patient(uv), outward));
        }
    }
    out
}

struct Step<'a> {
    stack: &'a Stack,
    s: &'a Segmentation,
    frame: Frame,
    drawn: &'a [Drawn],
    planes: &'a [Plane],
    /// Box planes: from and to.
    k: usize,
    next: usize,
    gap: bool,
}

impl Step<'_> {
    /// What becomes of lumen `o` of plane k on the way to the next plane.
    fn lumen(&self, o: usize, out: &mut Ends) {
        let (here, there) = (&self.drawn[self.k], &self.drawn[self.next]);
        let label = o as u16 + 1;
        let inside: Vec<bool> = here.label.iter().map(|&l| l == label).collect();
        let overlap = inside.iter().zip(&there.label).any(|(&a, &b)| a && b != 0);
        let covered: Vec<bool> = there.label.iter().map(|&l| l != 0).collect();
        let outside: Vec<bool> = inside.iter().map(|m| !m).collect();
        let [w, h, _] = self.frame.size(self.s);
        let [du, dv] = self.steps();
        let n = [w, h, 1];
        let step = [TENTHS * du / du.min(dv), TENTHS * dv / du.min(dv), 1.0];
        let depth = distances(&outside, n, step, FAR - 1);
        let away = distances(&covered, n, step, FAR - 1);
        let half_width = inside.iter().zip(&depth).filter(|(m, _)| **m).map(|(_, d)| *d).max().unwrap_or(0);
        let low = self.s.low[self.frame.of[2]];
        if !overlap {
            let place = self.place(low + self.k, o);
            if let Some(message) = self.continuation(&inside, &away, half_width) {
                // the way down meets the same pair again
                if self.next > self.k {
                    out.warnings.push(Warning::new("contours.no_overlap", message, place));
                }
                return;
            }
            if self.gap {
                let message = format!("a lumen of plane {} is not seen again beyond the gap", low + self.k);
                out.warnings.push(Warning::new("contours.ends_in_gap", message, place));
                return;
            }
        }
        if self.gap {
            return;
        }
        for i in medial(&inside, &depth, &away, half_width, [w, step[0] as usize, step[1] as usize]) {
            out.tips.push(self.tip(i, o));
        }
    }
    fn place(&self, plane: usize, contour: usize) -> Place {
        match self.frame.axis {
            Axis::Slice => Place::contour(plane, contour),
            _ => Place { contour: Some(contour), ..Place::at(self.planes[plane].origin) },
        }
    }
    /// Mean in-plane steps, mm.
    fn steps(&self) -> [f64; 2] {
        let p = &self.planes[0];
        [&p.u_mm, &p.v_mm].map(|a| a[a.len() - 1] / (a.len() - 1) as f64)
    }
    /// A lumen of the next plane without forerunner, close enough to be this one displaced: the message of the warning.
    fn continuation(&self, inside: &[bool], away: &[u8], half_width: u8) -> Option<String> {
        let (here, there) = (&self.drawn[self.k], &self.drawn[self.next]);
        let orphan = (0..there.outlines.len()).any(|o| {
            let mine = |i: usize| there.label[i] == o as u16 + 1;
            !there.outlines[o].hole && (0..here.label.len()).all(|i| !mine(i) || here.label[i] == 0)
        });
        let nearest = inside.iter().zip(away).filter(|(m, _)| **m).map(|(_, d)| *d).min().unwrap_or(FAR);
        let low = self.s.low[self.frame.of[2]];
        (orphan && nearest <= 2 * half_width.min(FAR / 2)).then(|| {
            format!(
                "the lumens of planes {} and {} do not overlap although they belong to one vessel: the vessel runs \
                 too obliquely for this slice distance and may break apart there",
                low + self.k,
                low + self.next
            )
        })
    }
    /// Where the wall closes at lattice point i: between the two planes, interpolated on grey value minus level.
    fn tip(&self, i: usize, o: usize) -> Tip {
        let [w, h, _] = self.frame.size(self.s);
        let (x, y) = (i % w, i / w);
        let height = |k: usize| {
            let (mut sum, mut count) = (0.0, 0.0);
            for b in y.saturating_sub(1)..(y + 2).min(h) {
                for a in x.saturating_sub(1)..(x + 2).min(w) {
                    let at = self.frame.index(self.s, a, b, k);
                    sum += f64::from(Frame::grey(self.s, self.stack, at) - self.s.level[at]);
                    count += 1.0;
                }
            }
            sum / count
        };
        let (from, to) = (height(self.k), height(self.next));
        let t = if from > 0.0 && to < 0.0 {
            from / (from - to)
        } else if from > 0.0 {
            BETWEEN.1
        } else {
            BETWEEN.0
        };
        let [u0, v0, low] = self.frame.of.map(|a| self.s.low[a]);
        let (plane, beyond) = (&self.planes[low + self.k], &self.planes[low + self.next]);
        let uv = [plane.u_mm[u0 + x], plane.v_mm[v0 + y]];
        let a = plane.to_patient(uv);
        let outward = if self.next > self.k { plane.normal() } else { -plane.normal() };
        Tip {
            plane: low + self.k,
            lumen: o,
            position: a.lerp(beyond.to_patient(uv), t.clamp(BETWEEN.0, BETWEEN.1)),
            outward,
        }
    }
}

/// Medial points of a lumen whose inscribed disc does not touch the next plane's lumens: deepest first, each at least a
/// half-width from the others.
fn medial(inside: &[bool], depth: &[u8], away: &[u8], half_width: u8, [w, du, dv]: [usize; 3]) -> Vec<usize> {
    let mut open: Vec<usize> = (0..inside.len())
        .filter(|&i| inside[i] && away[i] > depth[i] && f64::from(depth[i]) >= SHALLOW * f64::from(half_width))
        .collect();
    open.sort_by_key(|&i| (std::cmp::Reverse(depth[i]), i));
    let mut out: Vec<usize> = Vec::new();
    for i in open {
        let clear = |&j: &usize| {
            let dx = (i % w).abs_diff(j % w) * du;
            let dy = (i / w).abs_diff(j / w) * dv;
            (dx as f64).hypot(dy as f64) >= SPACING * f64::from(depth[j].max(10))
        };
        if out.iter().all(clear) {
            out.push(i);
        }
    }
    out
}
