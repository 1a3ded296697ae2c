//! The medial graph: junctions, ends and the medial lines between them.

use space::P3;

/// What a node is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeKind {
    /// Three or more branches meet; with two, the base point of a closed line that meets no other.
    Junction,
    /// A branch ends.
    End,
}

/// A junction or an end.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    /// What it is.
    pub kind: NodeKind,
    /// LPS mm.
    pub position: P3,
    /// Radius of the largest inscribed sphere there, mm.
    pub radius_mm: f64,
    /// For an end that meets a cap of the surface: that cap's face id (1 or more).
    pub cap: Option<u32>,
}

/// A medial line between two nodes (or from a junction to itself).
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// First and last node.
    pub nodes: [usize; 2],
    /// Points from the first node to the last, both included, LPS mm.
    pub points: Vec<P3>,
    /// Radius of the largest inscribed sphere at each point, mm.
    pub radius_mm: Vec<f64>,
}

impl Edge {
    /// Arc length from the first node at each point, mm.
    pub fn abscissae_mm(&self) -> Vec<f64> {
        abscissae(&self.points)
    }
    /// Length of the line, mm.
    pub fn length_mm(&self) -> f64 {
        self.points.windows(2).fold(0.0, |s, p| s + p[0].distance(p[1]))
    }
    /// Whether it runs from a node to the same node.
    pub fn is_loop(&self) -> bool {
        self.nodes[0] == self.nodes[1]
    }
    /// The same line from its last node to its first.
    pub(crate) fn reverse(&mut self) {
        self.nodes.reverse();
        self.points.reverse();
        self.radius_mm.reverse();
    }
}

/// Arc length along a polyline from its first point, at each point, mm.
pub(crate) fn abscissae(points: &[P3]) -> Vec<f64> {
    let mut s = 0.0;
    let steps = std::iter::once(0.0).chain(points.windows(2).map(|p| p[0].distance(p[1])));
    steps
        .map(|step| {
            s += step;
            s
        })
        .take(points.len())
        .collect()
}

/// All medial lines of a vessel tree (which may have loops).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MedialGraph {
    /// Junctions and ends.
    pub nodes: Vec<Node>,
    /// Medial lines.
    pub edges: Vec<Edge>,
}

impl MedialGraph {
    /// The edges at each node as (edge, which of its two ends), ascending; a self-loop gives both.
    pub fn incidence(&self) -> Vec<Vec<(usize, usize)>> {
        let mut at = vec![Vec::new(); self.nodes.len()];
        for (e, edge) in self.edges.iter().enumerate() {
            at[edge.nodes[0]].push((e, 0));
            at[edge.nodes[1]].push((e, 1));
        }
        at
    }
    /// Edges at a node, a self-loop twice.
    pub fn degree(&self, node: usize) -> usize {
        self.edges.iter().flat_map(|e| e.nodes).filter(|&n| n == node).count()
    }
    /// Number of independent cycles: edges - nodes + components.
    pub fn cycles(&self) -> usize {
        self.edges.len() + self.components() - self.nodes.len()
    }
    /// Number of connected pieces.
    pub fn components(&self) -> usize {
        let mut root: Vec<usize> = (0..self.nodes.len()).collect();
        let find = |root: &mut Vec<usize>, mut i: usize| {
            while root[i] != i {
                root[i] = root[root[i]];
                i = root[i];
            }
            i
        };
        for e in &self.edges {
            let (a, b) = (find(&mut root, e.nodes[0]), find(&mut root, e.nodes[1]));
            root[a] = b;
        }
        (0..root.len()).filter(|&i| root[i] == i).count()
    }
}
