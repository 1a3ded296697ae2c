//! The wall as quadrilaterals of high order, opened where the medial lines say so.

use crate::wall::Wall;
use artefact::reconstruction::Quadrilaterals;
use exec::Ctx;
use imaging::CutPlane;
use skeleton::{Edge, MedialGraph, NodeKind};
use space::{FaultKind, Faulty, P3, V3, Warning};
use surface::{QuadSettings, Quads};

/// A vessel between two junctions gets a section of its own from this many radii of length on; in shorter ones the
/// junctions' walls run into each other, and they are divided as one.
const LONG_RADII: f64 = 4.0;
/// A section reaches this many radii from the medial line.
const REACH_RADII: f64 = 2.5;

/// What was made of the wall, and why not.
#[derive(Default)]
pub(crate) struct Patched {
    asked: bool,
    quads: Option<Quads>,
    pub(crate) warnings: Vec<Warning>,
}

impl Patched {
    pub(crate) fn facts(&self) -> Quadrilaterals<'_> {
        match (&self.quads, self.asked) {
            (Some(q), _) => Quadrilaterals::Made(q),
            (None, true) => Quadrilaterals::Impossible,
            (None, false) => Quadrilaterals::Unasked,
        }
    }
}

/// Quadrilaterals of the wall. A wall that has no such division is a warning: the scan's numbers do not depend on it.
pub(crate) fn patched(
    wall: &Wall,
    cuts: &[CutPlane],
    graph: &MedialGraph,
    ctx: &Ctx,
) -> Result<Patched, surface::Error> {
    let Some(field) = &wall.field else { return Ok(Patched::default()) };
    let made = surface::quads(&wall.mesh, field, cuts, &sections(graph), &QuadSettings::default(), ctx);
    match made {
        Ok(quads) => Ok(Patched { asked: true, quads: Some(quads), warnings: Vec::new() }),
        Err(e) if e.kind() == FaultKind::Cancelled => Err(e),
        Err(e) => {
            let message = format!("no patches.vtu: {e}");
            let warnings = vec![Warning { code: e.code(), message, place: e.place() }];
            Ok(Patched { asked: true, quads: None, warnings })
        }
    }
}

/// One section in the middle of every long vessel between two junctions, and of every vessel that closes a loop.
fn sections(graph: &MedialGraph) -> Vec<CutPlane> {
    let mut tree: Vec<usize> = (0..graph.nodes.len()).collect();
    let between = |e: &&Edge| e.nodes.iter().all(|&n| graph.nodes[n].kind == NodeKind::Junction);
    let mut out = Vec::new();
    for edge in graph.edges.iter().filter(between) {
        let Some((at, along, radius)) = middle(edge) else { continue };
        let [a, b] = edge.nodes.map(|n| tree[n]);
        if a == b || edge.length_mm() >= LONG_RADII * radius {
            out.push(CutPlane::new(at, along).within(REACH_RADII * radius));
        } else {
            tree.iter_mut().filter(|t| **t == b).for_each(|t| *t = a);
        }
    }
    out
}

/// Half-way along an edge: place, direction, radius.
fn middle(edge: &Edge) -> Option<(P3, V3, f64)> {
    let (way, half) = (edge.abscissae_mm(), 0.5 * edge.length_mm());
    let i = way.partition_point(|&w| w < half).clamp(1, way.len().checked_sub(1)?);
    let part = (half - way[i - 1]) / (way[i] - way[i - 1]);
    let near = |from: usize, to: usize| (edge.points[to] - edge.points[from]).normalised();
    let along = near(i.saturating_sub(2), (i + 1).min(way.len() - 1))?;
    let radius = edge.radius_mm[i - 1] + part * (edge.radius_mm[i] - edge.radius_mm[i - 1]);
    Some((edge.points[i - 1].lerp(edge.points[i], part), along, radius))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use skeleton::Node;

    fn line(nodes: [usize; 2], points: &[[f64; 3]]) -> Edge {
        let points: Vec<P3> = points.iter().map(|&[x, y, z]| P3::new(x, y, z)).collect();
        Edge { nodes, radius_mm: vec![1.0; points.len()], points }
    }

    #[test]
    fn long_vessels_and_loops_are_opened_and_short_ones_are_not() {
        let node = |kind, x: f64| Node { kind, position: P3::new(x, 0.0, 0.0), radius_mm: 1.0, cap: None };
        let [j, e] = [NodeKind::Junction, NodeKind::End];
        let nodes = vec![node(j, 0.0), node(j, 2.0), node(j, 12.0), node(e, 20.0)];
        let graph = MedialGraph {
            nodes,
            edges: vec![
                line([0, 1], &[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]),
                line([0, 1], &[[0.0; 3], [1.0, 1.0, 0.0], [2.0, 0.0, 0.0]]),
                line([1, 2], &[[2.0, 0.0, 0.0], [6.0, 0.0, 0.0], [12.0, 0.0, 0.0]]),
                line([2, 3], &[[12.0, 0.0, 0.0], [20.0, 0.0, 0.0]]),
            ],
        };
        let s = sections(&graph);
        // The second edge closes a loop with the first; the third is long; the fourth ends.
        assert_eq!(s.len(), 2);
        assert!(s[1].point.distance(P3::new(7.0, 0.0, 0.0)) < 1e-12 && s[1].outward.x() > 0.99);
    }
}
