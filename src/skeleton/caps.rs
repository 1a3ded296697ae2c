//! Ends at the caps of the surface.

use crate::prune::{Caps, inner};
use crate::{Edge, Lumen, MedialGraph, Node, NodeKind};
use space::{P3, Place, V3, Warning};

/// How far a cap may lie from the line of the vessel that it opens, in that vessel's inscribed radii and in its own:
/// thinning leaves no branch when it ends within a radius of the wall of its parent.
const STUB_REACH: [f64; 2] = [1.5, 3.0];

/// Shortest last piece of a line that is cut back, mm.
const LEAST_STEP_MM: f64 = 1e-3;

/// A planar cap of the surface, where a vessel leaves the data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CapHint {
    /// Face id of the cap (1 or more).
    pub face_id: u32,
    /// Area centroid of the lumen's section by the cap's plane.
    pub centroid: P3,
    /// Unit normal out of the lumen.
    pub normal: V3,
}

/// Extend the ends near caps to the caps' centroids and note the cap in [`crate::Node::cap`]. Thinning ends about one
/// radius short of a cap, and its last piece may turn to the cap's rim: points within one inscribed radius of the
/// centroid are replaced by the straight line to it. Each cap takes at most one end, each end at most one cap.
///
/// A cap that no end meets but that the line of a vessel near it sees is a stub, cut so close to its parent that thinning
/// left nothing of it: it gets a junction on that line and a straight branch, and the warning `skeleton.stub`.
pub fn extend_to_caps(graph: &mut MedialGraph, lumen: &Lumen<'_>, caps: &[CapHint]) -> Vec<Warning> {
    let caps = Caps::new(lumen, caps);
    let tips = caps.tips(graph, lumen);
    let mut warnings = Vec::new();
    for ((cap, radius), tip) in caps.hints().zip(&tips) {
        if let Some(tip) = *tip {
            extend(graph, tip, cap, *radius);
        }
    }
    for ((cap, radius), _) in caps.hints().zip(&tips).filter(|(_, tip)| tip.is_none()) {
        warnings.extend(attach_stub(graph, cap, *radius, lumen));
    }
    warnings
}

/// Cut the line that ends at a cap (by [`crate::Node::cap`]) where it passes the cap's plane, when the surface was cut
/// farther in than the lumen that the lines were drawn in. Nothing happens to a line that does not pass it.
pub fn cut_back(graph: &mut MedialGraph, cap: &CapHint) {
    let Some(tip) = graph.nodes.iter().position(|n| n.cap == Some(cap.face_id)) else { return };
    let Some(edge) = graph.edges.iter_mut().find(|e| e.nodes.contains(&tip)) else { return };
    let turned = edge.nodes[1] != tip;
    if turned {
        edge.reverse();
    }
    let height = |p: P3| (p - cap.centroid).dot(cap.normal);
    let kept = edge.points.iter().rposition(|&p| height(p) < -LEAST_STEP_MM).map_or(0, |i| i + 1);
    if kept > 0 && kept < edge.points.len() {
        let [a, b] = [edge.points[kept - 1], edge.points[kept]];
        let part = height(a) / (height(a) - height(b));
        let radius = edge.radius_mm[kept - 1] + part * (edge.radius_mm[kept] - edge.radius_mm[kept - 1]);
        edge.points.truncate(kept);
        edge.radius_mm.truncate(kept);
        edge.points.push(a.lerp(b, part));
        edge.radius_mm.push(radius);
        let node = &mut graph.nodes[tip];
        (node.position, node.radius_mm) = (a.lerp(b, part), radius);
    }
    if turned {
        edge.reverse();
    }
}

/// Replace the last radius of the branch that ends at `tip` by the straight line to the cap.
fn extend(graph: &mut MedialGraph, tip: usize, cap: &CapHint, radius: f64) {
    if let Some(e) = graph.edges.iter().position(|e| e.nodes.contains(&tip)) {
        let edge = &mut graph.edges[e];
        let turned = edge.nodes[1] != tip;
        if turned {
            edge.reverse();
        }
        let near = |p: &P3| p.distance(cap.centroid) < radius || (*p - cap.centroid).dot(cap.normal) > 0.0;
        while edge.points.len() > 1 && edge.points.last().is_some_and(near) {
            edge.points.pop();
        }
        edge.points.push(cap.centroid);
        edge.radius_mm = vec![0.0; edge.points.len()];
        if turned {
            edge.reverse();
        }
        let node = &mut graph.nodes[tip];
        (node.position, node.radius_mm, node.cap) = (cap.centroid, radius, Some(cap.face_id));
    }
}

/// A junction on the nearest line that sees the cap, and a straight branch from it to the cap.
fn attach_stub(graph: &mut MedialGraph, cap: &CapHint, radius: f64, lumen: &Lumen<'_>) -> Option<Warning> {
    let slack = 2.0 * lumen.spacing_mm();
    let mut points: Vec<(f64, usize, usize)> = Vec::new();
    for (e, edge) in graph.edges.iter().enumerate() {
        let inside = 1..edge.points.len().saturating_sub(1);
        points.extend(inside.map(|i| (edge.points[i].distance(cap.centroid), e, i)));
    }
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (_, e, i) = points.into_iter().find(|&(_, e, i)| lumen.sees(graph.edges[e].points[i], inner(cap, lumen)))?;
    let from = graph.edges[e].points[i];
    let parent = lumen.inscribed(from)?;
    let length = from.distance(cap.centroid);
    if length > STUB_REACH[0] * parent + STUB_REACH[1] * radius + slack {
        return None;
    }
    let (junction, end) = (graph.nodes.len(), graph.nodes.len() + 1);
    graph.nodes.push(Node { kind: NodeKind::Junction, position: from, radius_mm: parent, cap: None });
    let tip = Node { kind: NodeKind::End, position: cap.centroid, radius_mm: radius, cap: Some(cap.face_id) };
    graph.nodes.push(tip);
    split(graph, e, i, junction);
    graph.edges.push(Edge { nodes: [junction, end], points: vec![from, cap.centroid], radius_mm: vec![0.0; 2] });
    let message = format!(
        "cap {} lies {length:.2} mm from its parent's line, whose inscribed radius is {parent:.2} mm there: too near for a \
         medial line of its own; a straight line stands for the branch and its direction means nothing",
        cap.face_id
    );
    Some(Warning::new("skeleton.stub", message, Place::at(cap.centroid)))
}

/// Cut edge `e` at its point `i`, where node `at` lies.
fn split(graph: &mut MedialGraph, e: usize, i: usize, at: usize) {
    let edge = &mut graph.edges[e];
    let points = edge.points.split_off(i);
    let radius_mm = edge.radius_mm.split_off(i);
    edge.points.push(points[0]);
    edge.radius_mm.push(0.0);
    let last = std::mem::replace(&mut edge.nodes[1], at);
    graph.edges.push(Edge { nodes: [at, last], points, radius_mm });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_cut_back_to_the_plane_from_whichever_end() {
        let points: Vec<P3> = (0..=10).map(|k| P3::new(f64::from(k), 0.0, 0.0)).collect();
        let radius_mm: Vec<f64> = (0..=10).map(|k| 2.0 + 0.1 * f64::from(k)).collect();
        let node = |x: f64, cap| Node { kind: NodeKind::End, position: P3::new(x, 0.0, 0.0), radius_mm: 2.0, cap };
        let nodes = vec![node(0.0, Some(1)), node(10.0, Some(2))];
        let mut graph = MedialGraph { nodes, edges: vec![Edge { nodes: [0, 1], points, radius_mm }] };
        let cap = |face_id, x: f64, normal| CapHint { face_id, centroid: P3::new(x, 0.3, 0.0), normal };
        cut_back(&mut graph, &cap(1, 2.5, -V3::X));
        cut_back(&mut graph, &cap(2, 8.0, V3::X));
        cut_back(&mut graph, &cap(2, 9.0, V3::X));
        cut_back(&mut graph, &cap(3, 5.0, V3::X));
        let edge = &graph.edges[0];
        assert_eq!(edge.nodes, [0, 1]);
        let ends = [edge.points[0], edge.points[edge.points.len() - 1]];
        assert!(ends[0].distance(P3::new(2.5, 0.0, 0.0)) < 1e-12 && ends[1].distance(P3::new(8.0, 0.0, 0.0)) < 1e-12);
        assert_eq!(ends, [graph.nodes[0].position, graph.nodes[1].position]);
        assert_eq!((edge.points.len(), edge.radius_mm.len()), (7, 7));
        assert!((graph.nodes[0].radius_mm - 2.25).abs() < 1e-12 && (edge.radius_mm[6] - 2.8).abs() < 1e-12);
    }
}
