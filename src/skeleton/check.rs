//! The graph's own test: the first thing that is wrong, as a fault with its place.

use crate::{CapHint, Error, MedialGraph, Node, NodeKind};
use implicit::Field;

/// Whether a finished graph can be measured: every cap has exactly one end; every end has one branch, every junction
/// three or more (or is the base of a closed line); every line runs from its first node to its last with growing arc
/// length and f > 0 at its points and halfway between; every inscribed radius is positive.
///
/// # Errors
/// The first offence: [`Error::CapWithoutEnd`], [`Error::CapShared`], [`Error::Degree`], [`Error::Line`],
/// [`Error::Abscissa`], [`Error::Outside`], [`Error::Radius`].
pub fn check(graph: &MedialGraph, field: &dyn Field, caps: &[CapHint]) -> Result<(), Error> {
    for cap in caps {
        let count = graph.nodes.iter().filter(|n| n.cap == Some(cap.face_id)).count();
        match count {
            0 => return Err(Error::CapWithoutEnd { face_id: cap.face_id, at: cap.centroid }),
            1 => {}
            _ => return Err(Error::CapShared { face_id: cap.face_id, count, at: cap.centroid }),
        }
    }
    if let Some(edge) = (0..graph.edges.len()).find(|&e| graph.edges[e].nodes.iter().any(|&n| n >= graph.nodes.len())) {
        return Err(Error::Line { edge, reason: "it names a node that does not exist", at: space::P3::ORIGIN });
    }
    for (n, (node, at)) in graph.nodes.iter().zip(graph.incidence()).enumerate() {
        check_degree(graph, n, node, &at)?;
    }
    (0..graph.edges.len()).try_for_each(|e| check_line(graph, field, e))
}

fn check_degree(graph: &MedialGraph, node: usize, of: &Node, at: &[(usize, usize)]) -> Result<(), Error> {
    let closed = at.len() == 2 && graph.edges[at[0].0].is_loop();
    let fits = match of.kind {
        NodeKind::End => at.len() == 1,
        NodeKind::Junction => at.len() >= 3 || closed,
    };
    if fits { Ok(()) } else { Err(Error::Degree { node, degree: at.len(), at: of.position }) }
}

fn check_line(graph: &MedialGraph, field: &dyn Field, edge: usize) -> Result<(), Error> {
    let line = &graph.edges[edge];
    let ends = line.nodes.map(|n| graph.nodes[n].position);
    let (Some(&first), Some(&last)) = (line.points.first(), line.points.last()) else {
        return Err(Error::Line { edge, reason: "it has no points", at: ends[0] });
    };
    if line.points.len() < 2 || line.radius_mm.len() != line.points.len() {
        return Err(Error::Line { edge, reason: "it has too few points or radii", at: first });
    }
    if first != ends[0] || last != ends[1] {
        return Err(Error::Line { edge, reason: "its points do not run from node to node", at: first });
    }
    for (i, pair) in line.points.windows(2).enumerate() {
        let step = pair[0].distance(pair[1]);
        if !(step.is_finite() && step > 0.0) {
            return Err(Error::Abscissa { edge, point: i + 1, at: pair[1] });
        }
        for at in [pair[0], pair[0].lerp(pair[1], 0.5), pair[1]] {
            let value = field.value(at);
            if value.is_nan() || value <= 0.0 {
                return Err(Error::Outside { edge, value, at });
            }
        }
    }
    match (0..line.points.len()).find(|&i| !(line.radius_mm[i].is_finite() && line.radius_mm[i] > 0.0)) {
        Some(i) => Err(Error::Radius { edge, radius_mm: line.radius_mm[i], at: line.points[i] }),
        None => Ok(()),
    }
}
