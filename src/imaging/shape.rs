//! Checks on the drawn lumens as a whole: pieces that hang on nothing, a vessel that breaks apart, neighbours that touch,
//! a junction that lies in a gap of the stack.
//!
//! Lumens of neighbouring planes that overlap are linked. What the links cannot tell is left to the reader with a warning
//! that names the planes: a wrong shape given silently is worse than a warning too many.

use crate::draw::{Drawn, Frame};
use crate::region::{components, distances};
use crate::{Axis, Plane, Stack};
use exec::Ctx;
use space::{Place, Warning};

/// A piece apart from the vessel that is shorter than this many planes is noise or partial volume and is left out.
const LEAST_PLANES: usize = 3;
/// Parts of a merged lumen below this share of its area are side branches at the limit of resolution, not neighbours.
const NEIGHBOUR_SHARE: f64 = 0.2;
/// Two vessels that touch join and part again within this many diameters of the joint lumen; a common trunk is longer.
const TOUCH_DIAMETERS: f64 = 3.0;
/// A waisted section is natural above a crotch: for a branch at 20 degrees over 1.1 diameters. From this many on two
/// vessels run side by side.
const WAIST_DIAMETERS: f64 = 3.0;
/// A waist is narrower than each lobe beside it divided by this.
const LOBE_PER_WAIST: f64 = 1.5;
/// Depths are counted in tenths of the smaller in-plane step.
const TENTHS: f64 = 10.0;

/// One lumen of one plane with its links.
struct Lumen {
    /// Box plane and outline.
    plane: usize,
    outline: usize,
    cells: usize,
    /// Lumens of the plane before and after that overlap it.
    down: Vec<usize>,
    up: Vec<usize>,
}

/// The lumens of all planes and what joins them.
pub(crate) struct Shape<'a> {
    stack: &'a Stack,
    frame: Frame,
    planes: &'a [Plane],
    /// Number of the first box plane.
    low: usize,
    size: [usize; 2],
    lumens: Vec<Lumen>,
    /// Pairs of neighbouring planes that touch by a corner at least.
    near: Vec<[usize; 2]>,
}

impl<'a> Shape<'a> {
    pub(crate) fn new(stack: &'a Stack, axis: Axis, planes: &'a [Plane], low: [usize; 3], drawn: &[Drawn]) -> Self {
        let frame = Frame::new(axis);
        let width = drawn.first().map_or(0, |d| d.width);
        let height = drawn.first().map_or(0, |d| d.label.len() / d.width.max(1));
        let mut lumens = Vec::new();
        let mut number = Vec::new();
        for (plane, d) in drawn.iter().enumerate() {
            let mut of_plane = vec![usize::MAX; d.outlines.len()];
            for outline in (0..d.outlines.len()).filter(|&o| !d.outlines[o].hole) {
                of_plane[outline] = lumens.len();
                let cells = d.label.iter().filter(|&&l| usize::from(l) == outline + 1).count();
                lumens.push(Lumen { plane, outline, cells, down: Vec::new(), up: Vec::new() });
            }
            number.push(of_plane);
        }
        let mut near = Vec::new();
        for k in 1..drawn.len() {
            let (below, above) = (&drawn[k - 1], &drawn[k]);
            let of = |d: &[usize], label: u16| (label > 0).then(|| d[usize::from(label) - 1]);
            for (i, &label) in below.label.iter().enumerate() {
                let Some(a) = of(&number[k - 1], label) else { continue };
                if let Some(b) = of(&number[k], above.label[i])
                    && !lumens[a].up.contains(&b)
                {
                    lumens[a].up.push(b);
                    lumens[b].down.push(a);
                }
                let (x, y) = (i % width, i / width);
                for j in y.saturating_sub(1)..(y + 2).min(height) {
                    for p in (x.saturating_sub(1)..(x + 2).min(width)).map(|x| j * width + x) {
                        if let Some(b) = of(&number[k], above.label[p])
                            && near.last() != Some(&[a, b])
                        {
                            near.push([a, b]);
                        }
                    }
                }
            }
        }
        Self { stack, frame, planes, low: low[frame.of[2]], size: [width, height], lumens, near }
    }

    /// Removes pieces apart from the vessel that are too short to be part of it and warns of these and of longer ones.
    pub(crate) fn without_pieces(&self, drawn: &mut [Drawn]) -> Vec<Warning> {
        let mut pieces = self.pieces();
        pieces.sort_by_key(|p| std::cmp::Reverse(p.iter().map(|&i| self.lumens[i].cells).sum::<usize>()));
        let mut out = Vec::new();
        let mut dropped: Vec<usize> = Vec::new();
        for piece in pieces.iter().skip(1) {
            let planes = self.planes_of(piece);
            if planes[1] + 1 - planes[0] < LEAST_PLANES {
                dropped.extend(piece);
                continue;
            }
            let message = format!(
                "the lumen of {} {} to {} is not joined to the rest: the vessel breaks apart there, or it is another one; \
                 look at the contours",
                self.name(),
                planes[0],
                planes[1]
            );
            out.push(Warning::new("contours.broken", message, self.place(piece[0])));
        }
        if let Some(&first) = dropped.first() {
            let mut numbers: Vec<usize> = dropped.iter().map(|&i| self.low + self.lumens[i].plane).collect();
            numbers.sort_unstable();
            numbers.dedup();
            let message = format!(
                "{} lumens that are not joined to the vessel and shorter than {LEAST_PLANES} planes were left out, in {} \
                 {}",
                dropped.len(),
                self.name(),
                listed(&numbers)
            );
            out.push(Warning::new("contours.piece_left_out", message, self.place(first)));
        }
        for (plane, d) in drawn.iter_mut().enumerate() {
            let gone: Vec<usize> =
                dropped.iter().filter(|&&i| self.lumens[i].plane == plane).map(|&i| self.lumens[i].outline).collect();
            d.remove(&gone);
        }
        out
    }

    /// Warns of neighbours that touch and of junctions within gaps.
    pub(crate) fn warnings(&self, drawn: &[Drawn], ctx: &Ctx) -> Result<Vec<Warning>, exec::Cancelled> {
        let mut out: Vec<Warning> = (0..self.lumens.len()).filter_map(|i| self.touch(i)).collect();
        out.extend((0..self.lumens.len()).filter_map(|i| self.junction_in_gap(i)));
        out.extend(self.side_by_side(drawn, ctx)?);
        Ok(out)
    }

    /// Lumens joined over planes, each piece ascending.
    fn pieces(&self) -> Vec<Vec<usize>> {
        let mut parent: Vec<usize> = (0..self.lumens.len()).collect();
        fn top(parent: &mut [usize], mut i: usize) -> usize {
            while parent[i] != i {
                parent[i] = parent[parent[i]];
                i = parent[i];
            }
            i
        }
        for &[a, b] in &self.near {
            let (a, b) = (top(&mut parent, a), top(&mut parent, b));
            parent[a.max(b)] = a.min(b);
        }
        let mut out: Vec<Vec<usize>> = vec![Vec::new(); self.lumens.len()];
        for i in 0..self.lumens.len() {
            let t = top(&mut parent, i);
            out[t].push(i);
        }
        out.retain(|p| !p.is_empty());
        out
    }

    /// First and last plane number of some lumens.
    fn planes_of(&self, lumens: &[usize]) -> [usize; 2] {
        let numbers = || lumens.iter().map(|&i| self.low + self.lumens[i].plane);
        [numbers().min().unwrap_or(0), numbers().max().unwrap_or(0)]
    }

    fn name(&self) -> &'static str {
        match self.frame.axis {
            Axis::Slice => "slices",
            Axis::Row => "rows",
            Axis::Column => "columns",
        }
    }

    fn place(&self, lumen: usize) -> Place {
        let l = &self.lumens[lumen];
        match self.frame.axis {
            Axis::Slice => Place::contour(self.low + l.plane, l.outline),
            _ => Place { contour: Some(l.outline), ..Place::at(self.planes[self.low + l.plane].origin) },
        }
    }

    fn offset_mm(&self, plane: usize) -> f64 {
        let p = &self.planes[self.low + plane];
        (p.origin - self.planes[0].origin).dot(p.normal())
    }

    /// Area of one lattice cell, mm2.
    fn cell_mm2(&self) -> f64 {
        let p = &self.planes[0];
        [&p.u_mm, &p.v_mm].map(|a| a[a.len() - 1] / (a.len() - 1).max(1) as f64).iter().product()
    }

    fn diameter_mm(&self, lumen: usize) -> f64 {
        2.0 * (self.lumens[lumen].cells as f64 * self.cell_mm2() / std::f64::consts::PI).sqrt()
    }

    /// Of these lumens those large enough against `whole` to be vessels of their own.
    fn large(&self, of: &[usize], whole: usize) -> usize {
        let least = NEIGHBOUR_SHARE * self.lumens[whole].cells as f64;
        of.iter().filter(|&&i| self.lumens[i].cells as f64 >= least).count()
    }

    /// Two lumens that join in lumen `i` and part again soon after.
    fn touch(&self, i: usize) -> Option<Warning> {
        if self.large(&self.lumens[i].down, i) < 2 {
            return None;
        }
        let (mut at, start) = (i, self.offset_mm(self.lumens[i].plane));
        let reach = TOUCH_DIAMETERS * self.diameter_mm(i);
        while self.large(&self.lumens[at].up, at) == 1 {
            at = *self.lumens[at].up.iter().max_by_key(|&&j| self.lumens[j].cells)?;
            if self.offset_mm(self.lumens[at].plane) - start > reach {
                return None;
            }
        }
        (self.large(&self.lumens[at].up, at) >= 2).then(|| {
            let [a, b] = self.planes_of(&[i, at]);
            let message = format!(
                "two lumens join in {} {a} to {b} and part again: two vessels that touch there may have been taken for \
                 one; mark the wanted one by a higher threshold or a region, or leave these planes out",
                self.name()
            );
            Warning::new("segmentation.touching", message, self.place(i))
        })
    }

    /// A split or merge across missing slices.
    fn junction_in_gap(&self, i: usize) -> Option<Warning> {
        let l = &self.lumens[i];
        let above = self.low + l.plane + 1;
        let gap = |k: usize| self.frame.axis == Axis::Slice && k < self.stack.slices() && self.stack.gap_before(k);
        let (splits, merges) = (gap(above) && l.up.len() > 1, gap(above - 1) && l.down.len() > 1);
        (splits || merges).then(|| {
            let k = if splits { above } else { above - 1 };
            let message = format!(
                "lumens join between slices {} and {k}, where slices are missing: the junction lies in the gap and its \
                 shape is interpolated",
                k - 1
            );
            Warning::new("contours.junction_in_gap", message, Place::slice(k - 1))
        })
    }

    /// Waisted sections that go on for longer than a crotch does.
    fn side_by_side(&self, drawn: &[Drawn], ctx: &Ctx) -> Result<Vec<Warning>, exec::Cancelled> {
        let lobes = ctx.map(&self.lumens, |l| self.lobe_mm(&drawn[l.plane], l.outline))?;
        let mut out = Vec::new();
        let mut seen = vec![false; lobes.len()];
        for start in 0..lobes.len() {
            if lobes[start].is_none() || seen[start] {
                continue;
            }
            let (mut run, mut at) = (vec![start], start);
            seen[start] = true;
            while let Some(&next) = self.lumens[at].up.iter().find(|&&j| lobes[j].is_some() && !seen[j]) {
                seen[next] = true;
                run.push(next);
                at = next;
            }
            let length = self.offset_mm(self.lumens[at].plane) - self.offset_mm(self.lumens[start].plane);
            let mean = run.iter().filter_map(|&i| lobes[i]).sum::<f64>() / run.len() as f64;
            if length > WAIST_DIAMETERS * mean {
                let [a, b] = self.planes_of(&run);
                let message = format!(
                    "the lumen of {} {a} to {b} has a waist over {length:.1} mm, {:.1} diameters: two vessels that run \
                     side by side may have been taken for one; mark the wanted one by a higher threshold",
                    self.name(),
                    length / mean
                );
                out.push(Warning::new("segmentation.touching", message, self.place(start)));
            }
        }
        Ok(out)
    }

    /// Diameter of the smaller lobe of a waisted lumen, mm; `None` without a waist.
    fn lobe_mm(&self, drawn: &Drawn, outline: usize) -> Option<f64> {
        let [w, h] = self.size;
        let p = &self.planes[0];
        let steps = [&p.u_mm, &p.v_mm].map(|a| a[a.len() - 1] / (a.len() - 1).max(1) as f64);
        let least = steps[0].min(steps[1]);
        let outside: Vec<bool> = drawn.label.iter().map(|&l| usize::from(l) != outline + 1).collect();
        let depth = distances(&outside, [w, h, 1], [TENTHS * steps[0] / least, TENTHS * steps[1] / least, 1.0], 250);
        let deepest = depth.iter().zip(&outside).filter(|(_, o)| !**o).map(|(d, _)| *d).max().unwrap_or(0);
        let mut at = TENTHS as u8;
        while f64::from(at) * LOBE_PER_WAIST <= f64::from(deepest) {
            let mut open: Vec<bool> = depth.iter().zip(&outside).map(|(&d, o)| !o && d > at).collect();
            let parts = components(&mut open, [w, h, 1], 1);
            let tops = parts.iter().map(|part| part.iter().map(|&i| depth[i as usize]).max().unwrap_or(0));
            let mut lobes: Vec<u8> = tops.filter(|&t| f64::from(t) >= LOBE_PER_WAIST * f64::from(at)).collect();
            lobes.sort_unstable();
            if let [.., second, _] = lobes[..] {
                return Some(2.0 * f64::from(second) / TENTHS * least);
            }
            at = at.saturating_add(TENTHS as u8 / 2);
        }
        None
    }
}

/// Numbers in words: at most eight, then how many more.
fn listed(numbers: &[usize]) -> String {
    let shown: Vec<String> = numbers.iter().take(8).map(usize::to_string).collect();
    match numbers.len().saturating_sub(8) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

/// Warns of lumens that meet the image border, where they are cut.
pub(crate) fn at_border(axis: Axis, drawn: &[Drawn], planes: &[Plane]) -> Option<Warning> {
    let meets = |d: &&Drawn| d.outlines.iter().any(|o| o.line.border.contains(&true));
    let mut numbers: Vec<usize> =
        drawn.iter().filter(meets).flat_map(|d| d.outlines.first()).map(|o| o.plane).collect();
    numbers.dedup();
    let &first = numbers.first()?;
    let name = match axis {
        Axis::Slice => "slices",
        Axis::Row => "rows",
        Axis::Column => "columns",
    };
    let message =
        format!("the lumen meets the border of the images in {name} {}: the vessel is cut there", listed(&numbers));
    let place = if axis == Axis::Slice { Place::slice(first) } else { Place::at(planes[first].origin) };
    Some(Warning::new("contours.at_border", message, place))
}
