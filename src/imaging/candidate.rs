//! Which bright structure is the vessel tree: candidate levels, connected components, a score.
//!
//! After the tissue background is taken off, a geometric series of global levels is tried; at each the largest
//! components are measured and scored:
//!
//! score = length x roundness^2 x branching x edge x brightness x position
//!
//! length: geodesic length of the skeleton-like tree in mm (longest geodesic from one extremity plus the persistence of
//! every further maximum of the geodesic distance); roundness: 2 V / A over the radius of the tube of equal volume and
//! length, 1 for tubes, small for sheets and organs; branching: 2 with at least two ends besides the root, else 1; edge:
//! mean step across the boundary over the mean height inside, largest at half height, so that a level at which
//! neighbours melt together loses; brightness: mean height inside over that of the brightest voxels of the volume, without
//! which the ridges of tissue texture, tangled and long, win against a tube as soon as the noise no longer hides them
//! (SNR 100: 36 against 22); position: 1 in the middle of the volume, .75 in its corners.

use crate::region::{Around, NEIGHBOURS, components};
use crate::volume::{Volume, quantile};
use crate::{Error, Settings};
use exec::Ctx;

/// Levels tried, each a fixed factor above the one before.
const LEVELS: usize = 18;
/// Lowest level in noise deviations of the volume searched. Noise alone, with and without a tissue body, is refused for
/// 40 of 40 scans.
const LEAST_NOISE: f64 = 4.5;
/// Share of the volume that the highest level still leaves (a lumen of 2 mm radius over 20 mm in 10^6 mm3).
const TOP_SHARE: f64 = 2.5e-4;
/// Components measured per level, largest first.
const PER_LEVEL: usize = 6;
/// A component above this share of the volume is the body, not a vessel.
const LARGEST_SHARE: f64 = 0.2;
/// Smallest vessel: a tube of radius 1.5 mm ...
const LEAST_RADIUS_MM: f64 = 1.5;
/// ... and of length 8 mm.
const LEAST_LENGTH_MM: f64 = 8.0;
/// A maximum of the geodesic distance counts as an end when it stands out by this many radii: bumps and the rim of a
/// blunt end stay below 1.
const END_RADII: f64 = 1.8;
/// A tube is at least this many radii long; a ball has 2 to 3.
const LEAST_SLENDERNESS: f64 = 4.0;
/// Largest mean radius of a vessel, mm: twice the largest asked for. A tissue body of 24 mm radius in air is refused by it.
pub(crate) const LARGEST_RADIUS_MM: f64 = 20.0;
/// Least mean step across the boundary, as a share of the mean height inside: a lumen at its half level has .3 to .6,
/// a level set of a bias field only its noise.
const LEAST_EDGE: f64 = 0.12;
/// Below this roundness a component is a sheet or a tangle.
const LEAST_ROUNDNESS: f64 = 0.35;

/// A bright structure at one level.
#[derive(Clone)]
pub(crate) struct Candidate {
    /// Level above the background.
    pub(crate) level: f64,
    pub(crate) voxels: Vec<u32>,
    pub(crate) score: f64,
    pub(crate) length_mm: f64,
    pub(crate) radius_mm: f64,
    /// Ends besides the root.
    pub(crate) ends: usize,
}

impl Candidate {
    /// Whether one of the two contains the other: components of nested level sets are nested or disjoint.
    fn is_nested_with(&self, other: &Self) -> bool {
        let (small, large) = if self.voxels.len() < other.voxels.len() { (self, other) } else { (other, self) };
        small.voxels.first().is_some_and(|v| large.voxels.binary_search(v).is_ok())
    }
}

/// What candidates are wanted.
pub(crate) enum Wanted<'a> {
    /// Any; the best score wins.
    Best,
    /// Those with a voxel in this set (voxel indices, ascending).
    Touching(&'a [u32]),
}

/// The best candidates, best first, one per structure (disjoint); empty when nothing looks like a vessel.
pub(crate) fn candidates(
    v: &Volume,
    noise: f64,
    wanted: &Wanted,
    settings: &Settings,
    ctx: &Ctx,
) -> Result<Vec<Candidate>, Error> {
    let levels = if settings.threshold.is_some() { vec![0.0] } else { levels(v, noise) };
    let least = std::f64::consts::PI * LEAST_RADIUS_MM.powi(2) * LEAST_LENGTH_MM;
    let top = top(v);
    let least = (least / (v.step[0] * v.step[1] * v.step[2])).max(8.0) as usize;
    let found = ctx.map_range(levels.len(), |k| {
        let level = levels[k] as f32;
        let mut open: Vec<bool> = v.data.iter().map(|&x| x > level).collect();
        let mut parts = components(&mut open, v.n, least);
        parts.retain(|p| (p.len() as f64) < LARGEST_SHARE * v.data.len() as f64);
        if let Wanted::Touching(set) = wanted {
            parts.retain(|p| set.iter().any(|i| p.binary_search(i).is_ok()));
        }
        parts.sort_by_key(|p| std::cmp::Reverse(p.len()));
        parts.truncate(PER_LEVEL);
        let strict = matches!(wanted, Wanted::Best);
        let mut slots = vec![u32::MAX; v.data.len()];
        parts.into_iter().filter_map(|p| measured(v, (levels[k], top), p, strict, &mut slots)).collect::<Vec<_>>()
    })?;
    let mut all: Vec<Candidate> = found.into_iter().flatten().collect();
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut best: Vec<Candidate> = Vec::new();
    for c in all {
        if best.len() < PER_LEVEL && !best.iter().any(|b| b.is_nested_with(&c)) {
            best.push(c);
        }
    }
    Ok(best)
}

/// The levels tried, ascending.
pub(crate) fn levels(v: &Volume, noise: f64) -> Vec<f64> {
    let top = top(v);
    let low = (LEAST_NOISE * noise).max(0.08 * top);
    if top.is_nan() || top <= low {
        return Vec::new();
    }
    (0..LEVELS).map(|k| low * (top / low).powf(k as f64 / LEVELS as f64)).collect()
}

/// Height of the brightest voxels: the share that the highest level leaves.
fn top(v: &Volume) -> f64 {
    let stride = v.data.len() / 400_000 + 1;
    let mut sample: Vec<f64> = v.data.iter().step_by(stride).map(|&x| f64::from(x)).collect();
    quantile(&mut sample, 1.0 - TOP_SHARE)
}

/// Measures and scores a component (`slots` is all `u32::MAX` before and after); `None` when it is no tube of the least size.
fn measured(
    v: &Volume,
    (level, top): (f64, f64),
    voxels: Vec<u32>,
    strict: bool,
    slots: &mut [u32],
) -> Option<Candidate> {
    for (k, &i) in voxels.iter().enumerate() {
        slots[i as usize] = k as u32;
    }
    let cell = v.step[0] * v.step[1] * v.step[2];
    let volume = voxels.len() as f64 * cell;
    let (area, step, height) = boundary(v, &voxels, slots);
    let radius_mm = 2.0 * volume / area.max(1e-9);
    let unscored = radius_mm > LARGEST_RADIUS_MM || (strict && radius_mm < 0.5 * LEAST_RADIUS_MM);
    let unscored = unscored || (strict && step < LEAST_EDGE * height);
    let (length_mm, ends) = if unscored { (0.0, 0) } else { tree(v, &voxels, slots, END_RADII * radius_mm) };
    for &i in &voxels {
        slots[i as usize] = u32::MAX;
    }
    let tube = (volume / (std::f64::consts::PI * length_mm.max(1e-9))).sqrt();
    let roundness = (radius_mm / tube).min(1.0);
    let slender = length_mm > LEAST_LENGTH_MM && length_mm > LEAST_SLENDERNESS * radius_mm;
    if unscored || (strict && (!slender || roundness < LEAST_ROUNDNESS)) {
        return None;
    }
    let branching = if ends >= 2 { 2.0 } else { 1.0 };
    let brightness = (height / top).clamp(0.0, 1.0).powi(2);
    let score = length_mm * roundness * roundness * branching * (step / height) * brightness * position(v, &voxels);
    Some(Candidate { level, voxels, score, length_mm, radius_mm, ends })
}

/// Boundary area in mm2 (face areas x pi/4, exact on average over directions of a tube), mean step of the grey values
/// from the first voxel inside to the second outside, and mean height inside.
fn boundary(v: &Volume, voxels: &[u32], slots: &[u32]) -> (f64, f64, f64) {
    let face = [v.step[1] * v.step[2], v.step[0] * v.step[2], v.step[0] * v.step[1]];
    let (mut area, mut step, mut height) = (0.0, 0.0, 0.0);
    let around = Around::new(v.n);
    for &i in voxels {
        let i = i as usize;
        height += f64::from(v.data[i]);
        around.visit_faces(i, |a, j| {
            if slots[j] == u32::MAX {
                area += face[a];
                step += face[a] * f64::from(v.data[i] - v.data[j]);
            }
        });
    }
    (area * std::f64::consts::FRAC_PI_4, step / area.max(1e-9), height / voxels.len() as f64)
}

/// 1 where the component's centroid is in the middle of the volume, .75 in a corner.
fn position(v: &Volume, voxels: &[u32]) -> f64 {
    let n = v.n;
    let mut sum = [0.0; 2];
    for &i in voxels {
        sum[0] += (i as usize % n[0]) as f64;
        sum[1] += (i as usize / n[0] % n[1]) as f64;
    }
    let off = |a: usize| (2.0 * sum[a] / voxels.len() as f64 / n[a] as f64 - 1.0).abs();
    1.0 - 0.25 * off(0).hypot(off(1)) / std::f64::consts::SQRT_2
}

/// Tree length in mm and number of ends besides the root: maxima of the geodesic distance from one extremity whose
/// persistence passes `least`.
fn tree(v: &Volume, voxels: &[u32], slots: &[u32], least: f64) -> (f64, usize) {
    let links = Links::new(v, voxels, slots);
    let far = |d: &[u32]| (0..d.len()).max_by_key(|&i| (d[i], std::cmp::Reverse(i))).unwrap_or(0);
    let root = far(&geodesic(&links, 0));
    let d = geodesic(&links, root);
    let persistence = persistence(&links, &d);
    let ends: Vec<f64> = persistence.iter().map(|p| f64::from(*p) * UNIT_MM).filter(|&p| p > least).collect();
    (ends.iter().sum::<f64>().max(f64::from(d[far(&d)]) * UNIT_MM), ends.len())
}

/// Geodesic distances are integers of this many mm, which keeps them exact and their order fixed.
const UNIT_MM: f64 = 0.05;

/// The 26-neighbours of each voxel within a component, with step lengths in [`UNIT_MM`].
struct Links {
    /// Where each voxel's neighbours begin, and their end.
    first: Vec<u32>,
    /// Neighbour, and in the low [`KIND_BITS`] bits the number of its step's length: half the memory of two numbers, and these
    /// lists are what the search for the vessel reads most.
    steps: Vec<u32>,
    /// Step lengths by number.
    lengths: Vec<u32>,
}

/// A box has seven directions up to sign and order, hence at most seven step lengths.
const KIND_BITS: u32 = 3;

impl Links {
    fn new(v: &Volume, voxels: &[u32], slots: &[u32]) -> Self {
        let weight = NEIGHBOURS.map(|d| {
            let l = (0..3).map(|a| (f64::from(d[a]) * v.step[a]).powi(2)).sum::<f64>().sqrt();
            (l / UNIT_MM).round().max(1.0) as u32
        });
        let mut lengths = weight.to_vec();
        lengths.sort_unstable();
        lengths.dedup();
        let kind = weight.map(|w| lengths.iter().position(|&l| l == w).unwrap_or(0) as u32);
        let around = Around::new(v.n);
        let (mut first, mut steps) = (Vec::with_capacity(voxels.len() + 1), Vec::with_capacity(16 * voxels.len()));
        for &i in voxels {
            first.push(steps.len() as u32);
            around.visit(i as usize, |k, j| {
                if slots[j] != u32::MAX {
                    steps.push(slots[j] << KIND_BITS | kind[k]);
                }
            });
        }
        first.push(steps.len() as u32);
        Self { first, steps, lengths }
    }

    fn len(&self) -> usize {
        self.first.len() - 1
    }

    /// Neighbours of a voxel, with the lengths of the steps there.
    fn of(&self, i: u32) -> impl Iterator<Item = (u32, u32)> {
        let steps = &self.steps[self.first[i as usize] as usize..self.first[i as usize + 1] as usize];
        steps.iter().map(|s| (s >> KIND_BITS, self.lengths[(s & ((1 << KIND_BITS) - 1)) as usize]))
    }

    fn longest(&self) -> usize {
        self.lengths.last().map_or(1, |&l| l as usize)
    }
}

/// Shortest ways from `root` along the links (Dijkstra; steps are small whole numbers, so that a ring of lists by distance
/// takes the place of a heap: Dial 1969).
fn geodesic(links: &Links, root: usize) -> Vec<u32> {
    let mut d = vec![u32::MAX; links.len()];
    let mut ring = vec![Vec::new(); links.longest() + 1];
    let (mut here, mut waiting, mut at) = (vec![root as u32], 1, 0_u32);
    d[root] = 0;
    while waiting > 0 {
        waiting -= here.len();
        for i in here.drain(..) {
            // one that was reached by a shorter way meanwhile has been there already
            if d[i as usize] < at {
                continue;
            }
            for (j, w) in links.of(i) {
                if d[j as usize] > at + w {
                    d[j as usize] = at + w;
                    let then = (at + w) as usize % ring.len();
                    ring[then].push(j);
                    waiting += 1;
                }
            }
        }
        at += 1;
        let next = at as usize % ring.len();
        std::mem::swap(&mut here, &mut ring[next]);
    }
    d
}

/// Persistence of every maximum of `d` (superlevel sets joined in falling order); the highest keeps its whole height.
fn persistence(links: &Links, d: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..d.len() as u32).collect();
    order.sort_unstable_by_key(|&i| (std::cmp::Reverse(d[i as usize]), i));
    let mut parent = vec![u32::MAX; d.len()];
    let mut out = Vec::new();
    fn top(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for i in order {
        parent[i as usize] = i;
        for (j, _) in links.of(i) {
            if parent[j as usize] == u32::MAX {
                continue;
            }
            // the representative of a set is its highest voxel
            let (a, b) = (top(&mut parent, i), top(&mut parent, j));
            if a != b {
                let (high, low) = if d[a as usize] >= d[b as usize] { (a, b) } else { (b, a) };
                if d[low as usize] > d[i as usize] {
                    out.push(d[low as usize] - d[i as usize]);
                }
                parent[low as usize] = high;
            }
        }
    }
    out.extend(d.iter().max());
    out
}
