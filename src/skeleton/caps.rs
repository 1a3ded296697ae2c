//! Ends at the caps of the surface.

use crate::prune::Caps;
use crate::{Lumen, MedialGraph};
use space::{P3, V3};

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
pub fn extend_to_caps(graph: &mut MedialGraph, lumen: &Lumen<'_>, caps: &[CapHint]) {
    let caps = Caps::new(lumen, caps);
    let tips = caps.tips(graph, lumen);
    for ((cap, radius), tip) in caps.hints().zip(tips) {
        let Some(tip) = tip else { continue };
        let Some(e) = graph.edges.iter().position(|e| e.nodes.contains(&tip)) else { continue };
        let edge = &mut graph.edges[e];
        let turned = edge.nodes[1] != tip;
        if turned {
            edge.reverse();
        }
        let near = |p: &P3| p.distance(cap.centroid) < *radius || (*p - cap.centroid).dot(cap.normal) > 0.0;
        while edge.points.len() > 1 && edge.points.last().is_some_and(near) {
            edge.points.pop();
        }
        edge.points.push(cap.centroid);
        edge.radius_mm = vec![0.0; edge.points.len()];
        if turned {
            edge.reverse();
        }
        let node = &mut graph.nodes[tip];
        (node.position, node.radius_mm, node.cap) = (cap.centroid, *radius, Some(cap.face_id));
    }
}
