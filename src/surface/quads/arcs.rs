//! The curves at the ends of annuli, cut into the same segments for both neighbours, and which segments face each other.

use super::chart::Chart;
use super::layout::{Layout, fault};
use crate::Error;
use crate::land::{Flat, Tie};
use glam::DVec3;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// A curve from pole to pole, or a closed one.
pub(crate) struct Arc {
    /// Numbers of its vertices; a closed curve names its first again at the end.
    pub(crate) roots: Vec<u32>,
    pub(crate) points: Vec<DVec3>,
    /// Way along it to each vertex, part of the whole.
    way: Vec<f64>,
    pub(crate) length: f64,
    pub(crate) tie: Tie,
    /// Ends of its segments, ascending from 0 to 1.
    pub(crate) cuts: Vec<f64>,
}

/// An arc as a side of an annulus, with the annulus's v at each of its vertices (unwrapped).
#[derive(Clone)]
pub(crate) struct Use {
    pub(crate) arc: usize,
    pub(crate) forward: bool,
    v: Vec<f64>,
}

/// A segment as one end of a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Item {
    pub(crate) arc: usize,
    pub(crate) segment: usize,
    pub(crate) forward: bool,
    /// v at its first point.
    pub(crate) v: f64,
}

/// An annulus with its two ends; the second starts at `anchor` (arc and leading cut), facing the first one's start.
pub(crate) struct Annulus {
    pub(crate) chart: Chart,
    pub(crate) branch: u32,
    pub(crate) ends: [Vec<Use>; 2],
    anchor: (usize, f64),
    /// Ends of its rows, parts of the mean way from the first end to the second.
    pub(crate) rows: Vec<f64>,
    /// u at equal parts of that way.
    pub(crate) level: Vec<f64>,
    pub(crate) length: f64,
}

impl Arc {
    fn new(roots: Vec<u32>, points: Vec<DVec3>, tie: Tie) -> Self {
        let mut way = vec![0.0];
        for w in points.windows(2) {
            way.push(way[way.len() - 1] + w[0].distance(w[1]));
        }
        let length = way[way.len() - 1];
        way.iter_mut().for_each(|w| *w /= length);
        Self { roots, points, way, length, tie, cuts: vec![0.0, 1.0] }
    }

    pub(crate) fn closed(&self) -> bool {
        self.roots.first() == self.roots.last()
    }

    /// The vertex before a part of the way, and the rest as part of the step to the next.
    fn step(&self, part: f64) -> (usize, f64) {
        let i = self.way.partition_point(|&w| w <= part).clamp(1, self.way.len() - 1) - 1;
        (i, ((part - self.way[i]) / (self.way[i + 1] - self.way[i])).clamp(0.0, 1.0))
    }

    pub(crate) fn at(&self, part: f64) -> DVec3 {
        let (i, rest) = self.step(part);
        self.points[i].lerp(self.points[i + 1], rest)
    }

    pub(crate) fn segments(&self) -> usize {
        self.cuts.len() - 1
    }

    /// Equal segments.
    pub(crate) fn divide(&mut self, segments: usize) {
        self.cuts = (0..=segments).map(|k| k as f64 / segments as f64).collect();
    }

    /// Halve a segment.
    pub(crate) fn halve(&mut self, segment: usize) {
        self.cuts.insert(segment + 1, 0.5 * (self.cuts[segment] + self.cuts[segment + 1]));
    }

    fn longest(&self) -> (f64, usize) {
        let mut best = (0.0, 0);
        for (k, w) in self.cuts.windows(2).enumerate() {
            if (w[1] - w[0]) * self.length > best.0 {
                best = ((w[1] - w[0]) * self.length, k);
            }
        }
        best
    }
}

impl Annulus {
    /// Segments of an end in the order of v; those of the second from its anchor, v within half a turn of the first's.
    pub(crate) fn items(&self, end: usize, arcs: &[Arc]) -> Vec<Item> {
        let mut out = Vec::new();
        for u in &self.ends[end] {
            let arc = &arcs[u.arc];
            let n = arc.segments();
            for k in 0..n {
                let segment = if u.forward { k } else { n - 1 - k };
                let part = arc.cuts[if u.forward { segment } else { segment + 1 }];
                let (i, rest) = arc.step(part);
                out.push(Item { arc: u.arc, segment, forward: u.forward, v: u.v[i] + rest * (u.v[i + 1] - u.v[i]) });
            }
        }
        if end == 1 {
            let lead = |i: &Item| arcs[i.arc].cuts[if i.forward { i.segment } else { i.segment + 1 }];
            let start = out.iter().position(|i| i.arc == self.anchor.0 && lead(i) == self.anchor.1).unwrap_or(0);
            out.rotate_left(start);
            let wrapped = out.len() - start;
            let last = out.len();
            out[wrapped.min(last)..].iter_mut().for_each(|i| i.v += 1.0);
        }
        out
    }

    /// Let the second end start at the segment that twists the columns least; v of both ends then correspond.
    fn face(&mut self, arcs: &[Arc]) {
        let first = self.items(0, arcs);
        self.anchor = (usize::MAX, 0.0);
        let second = self.items(1, arcs);
        let n = first.len();
        let twist = |shift: usize| {
            let off = |j: usize| {
                let k = j + shift;
                second[k % n].v + (k / n) as f64 - first[j].v
            };
            let turns = (off(0)).round();
            (0..n).fold(0.0, |s, j| s + (off(j) - turns).powi(2))
        };
        let shift = (0..n).min_by(|&a, &b| twist(a).total_cmp(&twist(b))).unwrap_or(0);
        let i = second[shift];
        self.anchor = (i.arc, arcs[i.arc].cuts[if i.forward { i.segment } else { i.segment + 1 }]);
    }
}

/// All arcs and annuli of a layout, with segments that match.
pub(crate) struct Weave {
    pub(crate) arcs: Vec<Arc>,
    pub(crate) annuli: Vec<Annulus>,
}

impl Weave {
    pub(crate) fn new(layout: &Layout, charts: Vec<Chart>, planes: &[Flat]) -> Result<Self, Error> {
        let mut weave = Self { arcs: Vec::new(), annuli: Vec::new() };
        let mut known = BTreeMap::new();
        for (region, chart) in layout.regions.iter().zip(charts) {
            let ends = [0, 1].map(|e| {
                let around: Vec<(u32, DVec3, f64)> = (chart.ends[e].iter())
                    .map(|&(v, x)| (region.sheet.root[v as usize], region.sheet.place(v), x))
                    .collect();
                weave.uses(&around, layout, planes, &mut known)
            });
            let (length, level) = levels(&chart);
            let branch = region.branch;
            weave.annuli.push(Annulus {
                chart,
                branch,
                ends,
                anchor: (usize::MAX, 0.0),
                rows: vec![0.0, 1.0],
                level,
                length,
            });
        }
        weave.start()?;
        Ok(weave)
    }

    /// The arcs of one end, which is named from any vertex; its last is its first again, one turn on.
    fn uses(
        &mut self,
        around: &[(u32, DVec3, f64)],
        layout: &Layout,
        planes: &[Flat],
        known: &mut BTreeMap<u32, usize>,
    ) -> Vec<Use> {
        let n = around.len() - 1;
        let least = (0..n).min_by_key(|&i| around[i].0).unwrap_or(0);
        let start = (0..n).find(|&i| layout.poles.contains(&around[i].0)).unwrap_or(least);
        let at = |i: usize| {
            let (root, x, v) = around[(start + i) % n];
            (root, x, v + ((start + i) / n) as f64)
        };
        let mut breaks: Vec<usize> = (0..=n).filter(|&i| layout.poles.contains(&at(i).0)).collect();
        if breaks.is_empty() {
            breaks = vec![0, n];
        }
        let mut out = Vec::new();
        for w in breaks.windows(2) {
            let run: Vec<_> = (w[0]..=w[1]).map(at).collect();
            let key = run[1..run.len() - 1].iter().map(|r| r.0).min().unwrap_or(run[0].0);
            let arc = *known.entry(key).or_insert_with(|| {
                let (roots, points): (Vec<u32>, Vec<DVec3>) = run.iter().map(|r| (r.0, r.1)).unzip();
                self.arcs.push(Arc::new(roots.clone(), points, tie(&roots, layout, planes)));
                self.arcs.len() - 1
            });
            let forward = self.arcs[arc].roots[1] == run[1].0;
            let mut v: Vec<f64> = run.iter().map(|r| r.2).collect();
            if !forward {
                v.reverse();
            }
            out.push(Use { arc, forward, v });
        }
        out
    }

    /// How many annuli end at each arc.
    fn shared(&self) -> Vec<usize> {
        let mut count = vec![0; self.arcs.len()];
        self.annuli.iter().flat_map(|a| a.ends.iter().flatten()).for_each(|u| count[u.arc] += 1);
        count
    }

    fn count(&self, annulus: usize, end: usize) -> usize {
        self.annuli[annulus].ends[end].iter().map(|u| self.arcs[u.arc].segments()).sum()
    }

    /// First segments: a quarter of the vessel's girth each, as many at both ends of every annulus.
    fn start(&mut self) -> Result<(), Error> {
        let shared = self.shared();
        let girth = self.arcs.iter().filter(|a| a.closed()).map(|a| a.length).fold(f64::INFINITY, f64::min);
        for (arc, _) in self.arcs.iter_mut().zip(&shared) {
            let most = if arc.closed() { 4.0 } else { (4.0 * arc.length / girth).round() };
            arc.divide(most.clamp(1.0, 6.0) as usize);
        }
        let free = |a: &Annulus, e: usize, arcs: &[Arc]| matches!(&a.ends[e][..], [u] if arcs[u.arc].closed() && shared[u.arc] == 1);
        for _ in 0..200 {
            let uneven = (0..self.annuli.len()).find(|&a| self.count(a, 0) != self.count(a, 1));
            let Some(a) = uneven else {
                for k in 0..self.annuli.len() {
                    let mut annulus = self.annuli.swap_remove(k);
                    annulus.face(&self.arcs);
                    self.annuli.push(annulus);
                    let last = self.annuli.len() - 1;
                    self.annuli.swap(k, last);
                }
                return Ok(());
            };
            let counts = [self.count(a, 0), self.count(a, 1)];
            let few = usize::from(counts[1] < counts[0]);
            if let Some(e) = (0..2).find(|&e| free(&self.annuli[a], e, &self.arcs)) {
                let arc = self.annuli[a].ends[e][0].arc;
                self.arcs[arc].divide(counts[1 - e]);
            } else {
                let of = |u: &Use| (self.arcs[u.arc].longest(), u.arc);
                let widest = self.annuli[a].ends[few].iter().map(of).max_by(|x, y| x.0.0.total_cmp(&y.0.0));
                if let Some(((_, segment), arc)) = widest {
                    self.arcs[arc].halve(segment);
                }
            }
        }
        let at = self.arcs[0].points[0];
        Err(fault("the columns of neighbouring branches cannot be made to match".to_owned(), at))
    }

    /// Halve columns (annulus, number) and all that they run into.
    pub(crate) fn split_columns(&mut self, columns: &BTreeSet<(usize, usize)>) {
        let items: Vec<[Vec<Item>; 2]> = self.annuli.iter().map(|a| [0, 1].map(|e| a.items(e, &self.arcs))).collect();
        let mut beside: BTreeMap<(usize, usize), Vec<(usize, usize)>> = BTreeMap::new();
        for (a, ends) in items.iter().enumerate() {
            for (j, i) in ends.iter().flat_map(|e| e.iter().enumerate()) {
                beside.entry((i.arc, i.segment)).or_default().push((a, j));
            }
        }
        let mut open: VecDeque<(usize, usize)> = columns.iter().copied().collect();
        let (mut done, mut halved) = (BTreeSet::new(), BTreeSet::new());
        while let Some((a, j)) = open.pop_front() {
            if !done.insert((a, j)) {
                continue;
            }
            for i in [items[a][0][j], items[a][1][j]] {
                halved.insert((i.arc, i.segment));
                open.extend(&beside[&(i.arc, i.segment)]);
            }
        }
        // From the last segment on, so that the numbers before stay.
        halved.iter().rev().for_each(|&(arc, segment)| self.arcs[arc].halve(segment));
    }

    pub(crate) fn patches(&self) -> usize {
        (0..self.annuli.len()).map(|a| self.count(a, 0) * (self.annuli[a].rows.len() - 1)).sum()
    }

    pub(crate) fn split_rows(&mut self, rows: &BTreeSet<(usize, usize)>) {
        for &(a, r) in rows.iter().rev() {
            let rows = &mut self.annuli[a].rows;
            rows.insert(r + 1, 0.5 * (rows[r] + rows[r + 1]));
        }
    }
}

/// A rim lies in its cap's plane as well as on the wall; the rim of two caps only on the wall.
fn tie(roots: &[u32], layout: &Layout, planes: &[Flat]) -> Tie {
    let mut ids: Vec<Option<u32>> = roots.iter().map(|r| layout.rim.get(r).copied()).collect();
    ids.dedup();
    match ids[..] {
        [Some(id)] => Tie { wall: true, planes: [planes.get(id as usize - 1).copied(), None] },
        _ => Tie::WALL,
    }
}

/// Lines along which the way is measured, and steps of each.
const LINES: usize = 12;
const STEPS: usize = 96;

/// Mean way from the first end to the second, mm, and u at equal parts of it.
fn levels(chart: &Chart) -> (f64, Vec<f64>) {
    let line = |k: usize| -> Vec<DVec3> {
        (0..=STEPS).map(|i| chart.point(i as f64 / STEPS as f64, k as f64 / LINES as f64)).collect()
    };
    let mut way = vec![0.0; STEPS + 1];
    for points in (0..LINES).map(line) {
        let mut sum = 0.0;
        for i in 1..=STEPS {
            sum += points[i].distance(points[i - 1]);
            way[i] += sum / LINES as f64;
        }
    }
    let length = way[STEPS];
    let level = (0..=STEPS).map(|k| {
        let want = length * k as f64 / STEPS as f64;
        let i = way.partition_point(|&w| w <= want).clamp(1, STEPS) - 1;
        let rest = if way[i + 1] > way[i] { (want - way[i]) / (way[i + 1] - way[i]) } else { 0.0 };
        ((i as f64 + rest) / STEPS as f64).clamp(0.0, 1.0)
    });
    (length, level.collect())
}
