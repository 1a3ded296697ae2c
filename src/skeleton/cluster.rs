//! Junctions that are one: where several branches leave from one place, thinning makes two or three junctions with short
//! lines between them.

use crate::{MedialGraph, NodeKind};

/// Longest line between junctions of one cluster, in the smaller of their inscribed radii: each then lies in the other's
/// sphere. Of the tests' trifurcations from one point every one then has one junction; two side branches a host's radius
/// or more apart keep their own.
const CLUSTER_RADII: f64 = 1.0;
/// The line between them may be this much longer than the straight distance; a longer one runs around something.
const DETOUR: f64 = 1.5;

/// The graph with every cluster of junctions as one, at the place of the one with the largest sphere. Radii of the nodes
/// must be known; those of the lines are reset to 0 where a line changes.
pub(crate) fn merge_clusters(mut graph: MedialGraph) -> MedialGraph {
    while let Some(edge) = shortest_within(&graph) {
        graph = contracted(graph, edge);
    }
    graph
}

fn shortest_within(graph: &MedialGraph) -> Option<usize> {
    let length = |e: usize| {
        let edge = &graph.edges[e];
        let [a, b] = edge.nodes.map(|n| &graph.nodes[n]);
        let reach = CLUSTER_RADII * a.radius_mm.min(b.radius_mm);
        let near = a.position.distance(b.position) <= reach && edge.length_mm() <= DETOUR * reach;
        let junctions = a.kind == NodeKind::Junction && b.kind == NodeKind::Junction;
        (junctions && !edge.is_loop() && near).then(|| (edge.length_mm(), e))
    };
    (0..graph.edges.len()).filter_map(length).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, e)| e)
}

/// The graph without an edge, its nodes made one.
fn contracted(mut graph: MedialGraph, edge: usize) -> MedialGraph {
    let [a, b] = graph.edges.remove(edge).nodes;
    let (keep, gone) = if graph.nodes[b].radius_mm > graph.nodes[a].radius_mm { (b, a) } else { (a, b) };
    let position = graph.nodes[keep].position;
    for line in &mut graph.edges {
        for end in 0..2 {
            if line.nodes[end] == gone {
                line.nodes[end] = keep;
                if end == 0 {
                    line.points.insert(0, position);
                } else {
                    line.points.push(position);
                }
            }
        }
        line.points.dedup_by(|p, q| p.distance(*q) < 1e-9);
        line.radius_mm = vec![0.0; line.points.len()];
    }
    let bare: Vec<bool> = (0..graph.nodes.len()).map(|n| n == gone).collect();
    crate::graph::without_nodes(graph, &bare)
}
