//! The medial graph: junctions, ends and the medial lines between them.

use space::P3;

/// What a node is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeKind {
    /// Three or more branches meet.
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

/// All medial lines of a vessel tree (which may have loops).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MedialGraph {
    /// Junctions and ends.
    pub nodes: Vec<Node>,
    /// Medial lines.
    pub edges: Vec<Edge>,
}

impl MedialGraph {
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
