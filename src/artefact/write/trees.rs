//! skeleton.graphml and skeleton.swc: the medial graph for programs that know neither VTK nor our JSON. Both are made only
//! when the plan's `outputs` ask for them.
//!
//! GraphML (Brandes et al. 2002; networkx, igraph, Gephi): an undirected multigraph, nodes with `kind`, `x`, `y`, `z`,
//! `radius_mm` and `cap`, edges with `length_mm`, `role` and the line itself in `points` (x y z r, .. as text, since
//! GraphML has no lists). SWC (Cannon et al. 1998): one line per point, `id type x y z radius parent`, mm instead of the
//! usual micrometres; type 0, for the format knows neurons only. A point has one parent, so that SWC holds trees: a graph
//! with a loop is refused, because an SWC file with the loop cut open would look like a tree that the vessel is not.

use super::json::number;
use super::{Error, SKELETON_GRAPHML, SKELETON_SWC};
use crate::Reconstruction;
use skeleton::{Edge, MedialGraph, NodeKind};
use space::P3;
use std::fmt::Write as _;

/// Text of a finite number.
fn text(artefact: &'static str, path: &str, x: f64) -> Result<String, Error> {
    number(x).ok_or_else(|| Error::NotFinite { artefact, path: path.to_owned(), value: x.to_string() })
}

/// x, y, z and a radius, separated by spaces.
fn sphere(artefact: &'static str, path: &str, p: P3, radius: f64) -> Result<String, Error> {
    let [x, y, z] = p.to_array();
    let words = [x, y, z, radius].into_iter().map(|v| text(artefact, path, v)).collect::<Result<Vec<_>, _>>()?;
    Ok(words.join(" "))
}

const KEYS: [(&str, &str, &str); 9] = [
    ("node", "kind", "string"),
    ("node", "x", "double"),
    ("node", "y", "double"),
    ("node", "z", "double"),
    ("node", "radius_mm", "double"),
    ("node", "cap", "int"),
    ("edge", "length_mm", "double"),
    ("edge", "role", "string"),
    ("edge", "points", "string"),
];

/// skeleton.graphml.
///
/// # Errors
/// [`Error::NotFinite`].
pub fn skeleton_graphml(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let mut out = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<graphml xmlns=\"http://graphml.graphdrawing.org/xmlns\">\n",
    );
    for (of, name, kind) in KEYS {
        // writing into a String cannot fail
        let _ = writeln!(out, "<key id=\"{of}_{name}\" for=\"{of}\" attr.name=\"{name}\" attr.type=\"{kind}\"/>");
    }
    out.push_str("<graph id=\"medial\" edgedefault=\"undirected\">\n");
    let data = |of: &str, name: &str, value: &str| format!("<data key=\"{of}_{name}\">{value}</data>");
    for (i, node) in r.graph.nodes.iter().enumerate() {
        let kind = if node.kind == NodeKind::Junction { "junction" } else { "end" };
        let mut members = vec![data("node", "kind", kind)];
        for (name, value) in
            ["x", "y", "z"].into_iter().zip(node.position.to_array()).chain([("radius_mm", node.radius_mm)])
        {
            members.push(data("node", name, &text(SKELETON_GRAPHML, &format!("node {i} {name}"), value)?));
        }
        members.extend(node.cap.map(|c| data("node", "cap", &c.to_string())));
        let _ = writeln!(out, "<node id=\"n{i}\">{}</node>", members.concat());
    }
    for (i, edge) in r.graph.edges.iter().enumerate() {
        let length = text(SKELETON_GRAPHML, &format!("edge {i} length"), edge.length_mm())?;
        let path = format!("edge {i} points");
        let spheres = edge.points.iter().zip(&edge.radius_mm).map(|(p, r)| sphere(SKELETON_GRAPHML, &path, *p, *r));
        let points = spheres.collect::<Result<Vec<_>, _>>()?.join(", ");
        let role = r.role_of_edge(i).map(|role| data("edge", "role", role.name())).unwrap_or_default();
        let [a, b] = edge.nodes;
        let members = data("edge", "length_mm", &length) + &role + &data("edge", "points", &points);
        let _ = writeln!(out, "<edge id=\"e{i}\" source=\"n{a}\" target=\"n{b}\">{members}</edge>");
    }
    out.push_str("</graph>\n</graphml>\n");
    Ok(out.into_bytes())
}

/// skeleton.swc: a tree per piece, rooted at its first end.
///
/// # Errors
/// [`Error::Loops`] for a graph with loops; [`Error::NotFinite`].
pub fn skeleton_swc(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let graph = r.graph;
    if graph.cycles() > 0 {
        return Err(Error::Loops { artefact: SKELETON_SWC, cycles: graph.cycles() });
    }
    let mut tree =
        Swc { text: String::from("# vasculum medial lines, LPS, mm\n# id type x y z radius parent\n"), points: 0 };
    let mut seen = vec![false; graph.nodes.len()];
    let ends = (0..graph.nodes.len()).filter(|&n| graph.nodes[n].kind == NodeKind::End);
    for root in ends {
        if !seen[root] {
            tree.grow(graph, root, &mut seen)?;
        }
    }
    Ok(tree.text.into_bytes())
}

struct Swc {
    text: String,
    points: usize,
}

impl Swc {
    fn push(&mut self, p: P3, radius: f64, parent: Option<usize>) -> Result<usize, Error> {
        self.points += 1;
        let sphere = sphere(SKELETON_SWC, &format!("point {}", self.points), p, radius)?;
        let parent = parent.map_or("-1".to_owned(), |p| p.to_string());
        let _ = writeln!(self.text, "{} 0 {sphere} {parent}", self.points);
        Ok(self.points)
    }

    /// All branches that a node leads to.
    fn grow(&mut self, graph: &MedialGraph, root: usize, seen: &mut [bool]) -> Result<(), Error> {
        seen[root] = true;
        let first = self.push(graph.nodes[root].position, graph.nodes[root].radius_mm, None)?;
        let mut stack = vec![(root, first)];
        while let Some((node, id)) = stack.pop() {
            let leaving = graph.edges.iter().filter(|e| e.nodes.contains(&node));
            for edge in leaving {
                let reversed = edge.nodes[1] == node;
                let next = edge.nodes[usize::from(!reversed)];
                if seen[next] {
                    continue;
                }
                seen[next] = true;
                let last = self.line(edge, reversed, id)?;
                stack.push((next, last));
            }
        }
        Ok(())
    }

    /// The points of an edge behind its first; the id of the last.
    fn line(&mut self, edge: &Edge, reversed: bool, from: usize) -> Result<usize, Error> {
        let n = edge.points.len();
        let mut parent = from;
        for k in 1..n {
            let i = if reversed { n - 1 - k } else { k };
            parent = self.push(edge.points[i], edge.radius_mm[i], Some(parent))?;
        }
        Ok(parent)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::super::fixture::Fixture;
    use super::*;

    #[test]
    fn swc_holds_every_point_once_with_a_parent_before_it() {
        let f = Fixture::new();
        let text = String::from_utf8(skeleton_swc(&f.reconstruction()).unwrap()).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .filter(|l| !l.starts_with('#'))
            .map(|l| l.split(' ').map(|w| w.parse().unwrap()).collect())
            .collect();
        let graph = f.reconstruction().graph.clone();
        let points: usize = graph.edges.iter().map(|e| e.points.len() - 1).sum();
        assert_eq!(rows.len(), points + 1);
        let mut length = 0.0;
        for (i, row) in rows.iter().enumerate() {
            assert_eq!((row.len(), row[0]), (7, (i + 1) as f64));
            assert!(row[6] < row[0] && (row[6] >= 1.0 || i == 0), "{row:?}");
            if i > 0 {
                let parent = &rows[row[6] as usize - 1];
                length += (0..3).map(|a| (row[2 + a] - parent[2 + a]).powi(2)).sum::<f64>().sqrt();
            }
        }
        let expected: f64 = graph.edges.iter().map(Edge::length_mm).sum();
        assert!((length - expected).abs() < 1e-5 * expected, "{length} {expected}");
    }

    #[test]
    fn a_loop_is_refused_in_swc_and_kept_in_graphml() {
        let f = Fixture::new();
        let mut graph = f.reconstruction().graph.clone();
        let mut again = graph.edges[0].clone();
        again.points[1] += space::V3::X;
        graph.edges.push(again);
        let r = Reconstruction { graph: &graph, ..f.reconstruction() };
        assert_eq!(skeleton_swc(&r), Err(Error::Loops { artefact: SKELETON_SWC, cycles: 1 }));
        let text = String::from_utf8(skeleton_graphml(&r).unwrap()).unwrap();
        assert_eq!(text.matches("<edge ").count(), graph.edges.len());
        assert_eq!(text.matches("<node ").count(), graph.nodes.len());
    }
}
