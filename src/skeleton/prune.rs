//! Spurs: leaf branches that the roughness of the wall grew, and not a vessel.
//!
//! A leaf branch whose tip lies within the inscribed sphere at its junction (times a factor; the straight distance
//! counts, since the length of a voxel line depends on its direction) shows nothing that the
//! sphere does not already fill. Such branches are dropped, the smallest first, and what becomes a passage is joined,
//! until none is left. Loops stay. A tip that meets a cap of the surface stays whatever its length, one for each cap.

use crate::cluster::merge_clusters;
use crate::graph::{merge_passages, without_nodes};
use crate::lumen::Hit;
use crate::pinholes;
use crate::{CapHint, Edge, Error, Lumen, MedialGraph, NodeKind, Settings};
use exec::Ctx;
use space::{P3, Place, Warning};

/// Reach of a cap, in inscribed radii at its centroid, in which a tip belongs to it when it sees the centroid. Thinning
/// ends some one radius short of a flat cap and about two short of one that is cut at 60 degrees; the second round is
/// for ends that a rough wall shortened further.
const REACH: [f64; 2] = [3.0, 6.0];

/// The same as [`Settings::prune_radii`] for tips at a cap that another tip meets better: the rim of a flat cap is
/// sqrt 2 radii from the last inscribed sphere (1.30 was met after thinning).
const RIM_RADII: f64 = 2.0;
/// And in lengths of the cap's longest ray: the rim of an oblique cap reaches farther (at 65 degrees 2.4 radii, and a
/// spur of 2.5 was met in a wall of .35 voxel noise).
const RIM_RAYS: f64 = 1.4;
/// Radius of a tip in the wedge at a cap's rim, and its depth below the cap's plane, in the cap's inscribed radii: .03 to
/// .2 were met (4 of 400 graphs had a fourth end for want of this).
const WEDGE_RADII: f64 = 0.35;
/// A leaf branch whose tip's sphere reaches less far beyond its parent's spheres is a spur, voxels: half a radius of the
/// smallest vessel at the automatic spacing.
const PROTRUSION_VOXELS: f64 = 2.0;
/// And by this share of its parent's radius: at 512^3 (30 voxels per radius) spurs of noise reach farther than 2 voxels,
/// and a vessel that shows less than this outside its parent has no line to measure.
const PROTRUSION_RADII: f64 = 0.2;
/// Rays over a cap, and their reach in inscribed radii: what is farther than an oblique section of 70 degrees belongs to
/// a neighbour.
const CAP_RAYS: usize = 32;
const CAP_REACH_RADII: f64 = 3.0;
/// A piece whose line is shorter than this many of its inscribed radii is a blob: thinning shortens a tube by a radius
/// at each end, so that this is a tube of less than two diameters. A voxelised ball leaves a line of 1.3 radii.
const COMPACT_RADII: f64 = 2.0;

/// What pruning did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PruneReport {
    /// Leaf branches dropped.
    pub spurs: usize,
    /// Loops closed; pieces too compact to have a line, dropped.
    pub warnings: Vec<Warning>,
}

/// Drop spurs from `graph`, one after the other, each time the one that is smallest against the inscribed radius at its
/// junction; loops around pinholes lose their thinner side, each with the warning `skeleton.pinhole`; junctions
/// within each other's spheres become one. Pieces whose line is shorter than two radii (a blob, a lone voxel) are dropped too, each with the warning
/// `skeleton.compact_piece`. Inscribed radii are measured at the nodes.
///
/// # Errors
/// [`Error::Cancelled`]; [`Error::NoLine`] when nothing is left.
pub fn prune(
    mut graph: MedialGraph,
    lumen: &Lumen<'_>,
    caps: &[CapHint],
    settings: &Settings,
    ctx: &Ctx,
) -> Result<(MedialGraph, PruneReport), Error> {
    let radii = ctx.map(&graph.nodes, |n| lumen.inscribed(n.position).unwrap_or(0.0))?;
    for (node, r) in graph.nodes.iter_mut().zip(radii) {
        node.radius_mm = r;
    }
    let caps = Caps::new(lumen, caps);
    let mut report = PruneReport::default();
    loop {
        ctx.check()?;
        if let Some(hole) = pinholes::smallest(&graph, lumen) {
            report.warnings.push(hole.warning());
            graph = without_edge(graph, hole.edge);
        } else if let Some(edge) = smallest_spur(&graph, lumen, &caps, settings) {
            graph = without_edge(graph, edge);
            report.spurs += 1;
        } else {
            break;
        }
    }
    let graph = merge_clusters(without_compact_pieces(graph, lumen, &caps, &mut report));
    if graph.edges.is_empty() {
        return Err(Error::NoLine);
    }
    Ok((graph, report))
}

/// The junction (first) and the tip of an edge that is a leaf branch.
fn leaf(graph: &MedialGraph, degree: &[usize], edge: usize) -> Option<[usize; 2]> {
    let [a, b] = graph.edges[edge].nodes;
    match (degree[a], degree[b]) {
        (d, 1) if d > 2 => Some([a, b]),
        (1, d) if d > 2 => Some([b, a]),
        _ => None,
    }
}

fn smallest_spur(graph: &MedialGraph, lumen: &Lumen<'_>, caps: &Caps, settings: &Settings) -> Option<usize> {
    let degree: Vec<usize> = graph.incidence().iter().map(Vec::len).collect();
    let kept = caps.tips(graph, lumen);
    let size = |e: usize| {
        let [junction, tip] = leaf(graph, &degree, e)?;
        let stretch = graph.nodes[junction].position.distance(graph.nodes[tip].position);
        // at an oblique cap the junction of a rim spur may itself lie in the wedge, where spheres are small
        let rim = caps.near_rim(&graph.nodes[tip], lumen).unwrap_or(0.0);
        let limit = rim.max(settings.prune_radii * graph.nodes[junction].radius_mm);
        let spur =
            |n: usize| stretch < limit || protrusion(graph, e, n, lumen) < PROTRUSION_VOXELS * lumen.spacing_mm();
        (!kept.contains(&Some(tip)) && spur(tip)).then_some((stretch / limit, e))
    };
    (0..graph.edges.len()).filter_map(size).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, e)| e)
}

/// How far the inscribed sphere at a leaf branch's tip reaches beyond those of the lines that the branch leaves (each a
/// fifth larger), mm: the length of a vessel outside its parent. In a merged lumen, which is wider than its spheres, a spur may be longer than
/// their radius and still reach nowhere.
fn protrusion(graph: &MedialGraph, leaf: usize, tip: usize, lumen: &Lumen<'_>) -> f64 {
    let tip = &graph.nodes[tip];
    let beyond = |p: P3| {
        let radius = lumen.inscribed(p).unwrap_or(0.0);
        p.distance(tip.position) + tip.radius_mm - (1.0 + PROTRUSION_RADII) * radius
    };
    let nodes = graph.edges[leaf].nodes;
    let beside = |e: &usize| *e != leaf && graph.edges[*e].nodes.iter().any(|n| nodes.contains(n));
    let reach = 2.0 * graph.edges[leaf].length_mm();
    let points = (0..graph.edges.len()).filter(beside).flat_map(|e| graph.edges[e].points.iter().step_by(2));
    points.filter(|p| p.distance(tip.position) < reach).map(|&p| beyond(p)).fold(f64::INFINITY, f64::min)
}

/// The graph without an edge and the nodes that it leaves bare. A junction that is left with one branch becomes an end.
fn without_edge(mut graph: MedialGraph, edge: usize) -> MedialGraph {
    let nodes = graph.edges.remove(edge).nodes;
    let gone: Vec<bool> = (0..graph.nodes.len()).map(|n| nodes.contains(&n) && graph.degree(n) == 0).collect();
    for node in nodes {
        if graph.degree(node) == 1 {
            graph.nodes[node].kind = NodeKind::End;
        }
    }
    merge_passages(without_nodes(graph, &gone))
}

fn without_compact_pieces(
    mut graph: MedialGraph,
    lumen: &Lumen<'_>,
    caps: &Caps,
    report: &mut PruneReport,
) -> MedialGraph {
    let degree: Vec<usize> = graph.incidence().iter().map(Vec::len).collect();
    let kept = caps.tips(&graph, lumen);
    let compact = |edge: &Edge| {
        let [a, b] = edge.nodes;
        let middle = lumen.inscribed(edge.points[edge.points.len() / 2]).unwrap_or(0.0);
        let radius = middle.max(graph.nodes[a].radius_mm).max(graph.nodes[b].radius_mm);
        let capped = kept.contains(&Some(a)) || kept.contains(&Some(b));
        degree[a] == 1 && degree[b] == 1 && !capped && edge.length_mm() < COMPACT_RADII * radius
    };
    let dropped: Vec<bool> = graph.edges.iter().map(compact).collect();
    let mut keep = dropped.iter().map(|d| !d);
    graph.edges.retain(|_| keep.next().unwrap_or(true));
    let gone: Vec<bool> = graph.incidence().iter().map(Vec::is_empty).collect();
    for (node, _) in graph.nodes.iter().zip(&gone).filter(|(n, g)| **g && n.kind == NodeKind::End) {
        let message = format!(
            "a piece of the lumen of {:.2} mm inscribed radius is a blob without a medial line; it is left out",
            node.radius_mm
        );
        report.warnings.push(Warning::new("skeleton.compact_piece", message, Place::at(node.position)));
    }
    without_nodes(graph, &gone)
}

/// The caps with the inscribed radius at their centroids.
pub(crate) struct Caps {
    caps: Vec<(CapHint, f64)>,
    /// How long a spur to the cap's rim may be, mm.
    rims: Vec<f64>,
}

impl Caps {
    pub(crate) fn new(lumen: &Lumen<'_>, caps: &[CapHint]) -> Self {
        let radius = |c: &CapHint| lumen.inscribed(c.centroid).unwrap_or(2.0 * lumen.spacing_mm());
        let caps: Vec<(CapHint, f64)> = caps.iter().map(|c| (*c, radius(c))).collect();
        let rims = caps.iter().map(|(cap, r)| (RIM_RADII * r).max(RIM_RAYS * longest_ray(cap, *r, lumen))).collect();
        Self { caps, rims }
    }

    pub(crate) fn hints(&self) -> impl Iterator<Item = &(CapHint, f64)> {
        self.caps.iter()
    }

    /// Longest spur to the rim of a cap in whose first reach the tip lies and that it sees, mm; the largest of several.
    /// Twice as long where the tip itself lies in the wedge between the wall and the cap's plane: nothing but a rim has
    /// so small a sphere there, for thinning ends a vessel a radius short of its end.
    fn near_rim(&self, tip: &crate::Node, lumen: &Lumen<'_>) -> Option<f64> {
        let slack = 2.0 * lumen.spacing_mm();
        let rim = |((cap, radius), rim): (&(CapHint, f64), &f64)| {
            let depth = (cap.centroid - tip.position).dot(cap.normal);
            let wedge = tip.radius_mm < WEDGE_RADII * radius && depth < WEDGE_RADII * radius + slack;
            let reach = if wedge { REACH[1] } else { REACH[0] };
            let near = tip.position.distance(cap.centroid) <= reach * radius + slack;
            (near && lumen.sees(tip.position, inner(cap, lumen))).then_some(if wedge { 2.0 * rim } else { *rim })
        };
        self.caps.iter().zip(&self.rims).filter_map(rim).max_by(f64::total_cmp)
    }

    /// For each cap the end node that meets it: greedily the pair whose inscribed sphere comes nearest to the centroid,
    /// first among tips within three radii of a cap, then, for caps without a tip, within six.
    pub(crate) fn tips(&self, graph: &MedialGraph, lumen: &Lumen<'_>) -> Vec<Option<usize>> {
        let mut tip_of: Vec<Option<usize>> = vec![None; self.caps.len()];
        for reach in REACH {
            let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
            for (c, (cap, radius)) in self.caps.iter().enumerate().filter(|(c, _)| tip_of[*c].is_none()) {
                let slack = 2.0 * lumen.spacing_mm();
                for (n, node) in graph.nodes.iter().enumerate().filter(|(_, n)| n.kind == NodeKind::End) {
                    let d = node.position.distance(cap.centroid);
                    if d <= reach * radius + slack && lumen.sees(node.position, inner(cap, lumen)) {
                        pairs.push((d - node.radius_mm, c, n));
                    }
                }
            }
            pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
            for (_, c, n) in pairs {
                if tip_of[c].is_none() && !tip_of.contains(&Some(n)) {
                    tip_of[c] = Some(n);
                }
            }
        }
        tip_of
    }
}

/// The longest ray from a cap's centroid to its rim, mm.
fn longest_ray(cap: &CapHint, radius: f64, lumen: &Lumen<'_>) -> f64 {
    let (from, u) = (inner(cap, lumen), cap.normal.any_orthonormal());
    let v = cap.normal.cross(u);
    let length = |k: usize| {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / CAP_RAYS as f64).sin_cos();
        match lumen.ray(from, u * cos + v * sin, CAP_REACH_RADII * radius) {
            Hit::Wall(t) => t,
            Hit::Open => 0.0,
        }
    };
    (0..CAP_RAYS).map(length).fold(0.0, f64::max)
}

/// A point one voxel inside a cap's centroid: the cap itself lies on the border of the lumen.
pub(crate) fn inner(cap: &CapHint, lumen: &Lumen<'_>) -> P3 {
    cap.centroid - cap.normal * lumen.spacing_mm()
}
