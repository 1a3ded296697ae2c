//! From a thinned volume to nodes and edges.
//!
//! Object voxels with one 26-neighbour are ends, with two they belong to a line, with three or more to a junction;
//! 26-connected junction voxels are one junction. Loops stay: a line that returns to its junction is a self-loop, a
//! closed line without a junction gets a base node of its own.

use crate::{BitVolume, Edge, MedialGraph, Node, NodeKind};
use space::{Grid, P3};

type Voxel = [usize; 3];

/// The medial graph of a thinned volume (see [`crate::thin`]). Points are voxel centres, a junction lies at the
/// voxel of its own that is nearest to their centroid; nodes and edges are numbered in the order of their first voxel (x fastest). Radii are not
/// measured yet: they are 0. A component of one voxel becomes an end without edges. A junction of which only two edges
/// are left (a voxel more than a line needs) is merged into one edge.
///
/// Cost: some microseconds per voxel that is left.
pub fn graph(volume: &BitVolume, grid: &Grid) -> MedialGraph {
    let tracer = Tracer::new(volume);
    let mut graph = MedialGraph { nodes: tracer.nodes(grid), edges: Vec::new() };
    let mut traced = vec![false; tracer.voxels.len()];
    for (start, node) in tracer.node_of.iter().enumerate() {
        let Some(node) = *node else { continue };
        for &next in &tracer.near[start] {
            if let Some(chain) = tracer.chain(start, next, &mut traced) {
                graph.edges.push(tracer.edge(node, &chain, &graph.nodes, grid));
            }
        }
    }
    for base in 0..tracer.voxels.len() {
        if tracer.node_of[base].is_none() && !traced[base] {
            closed_line(&tracer, base, &mut traced, &mut graph, grid);
        }
    }
    let mut graph = merge_passages(graph);
    // a clump at the end of a line
    for n in 0..graph.nodes.len() {
        if graph.degree(n) == 1 {
            graph.nodes[n].kind = NodeKind::End;
        }
    }
    graph
}

/// A closed line without a junction: its base node is its first voxel. Three voxels that all touch enclose nothing:
/// they are a lone end.
fn closed_line(tracer: &Tracer, base: usize, traced: &mut [bool], graph: &mut MedialGraph, grid: &Grid) {
    let position = tracer.position(base, grid);
    let node = graph.nodes.len();
    if let &[a, b] = tracer.near[base].as_slice()
        && tracer.near[a].contains(&b)
    {
        [base, a, b].iter().for_each(|&v| traced[v] = true);
        graph.nodes.push(Node { kind: NodeKind::End, position, radius_mm: 0.0, cap: None });
        return;
    }
    graph.nodes.push(Node { kind: NodeKind::Junction, position, radius_mm: 0.0, cap: None });
    traced[base] = true;
    let mut points = vec![position];
    let (mut last, mut at) = (base, tracer.near[base][0]);
    while at != base {
        traced[at] = true;
        points.push(tracer.position(at, grid));
        let next = tracer.other(at, last);
        (last, at) = (at, next);
    }
    points.push(position);
    graph.edges.push(Edge { nodes: [node, node], radius_mm: vec![0.0; points.len()], points });
}

struct Tracer {
    voxels: Vec<Voxel>,
    /// 26-neighbours, by number.
    near: Vec<Vec<usize>>,
    /// The node that a voxel belongs to; `None` for the voxels of lines.
    node_of: Vec<Option<usize>>,
    nodes: usize,
}

impl Tracer {
    fn new(volume: &BitVolume) -> Self {
        let voxels: Vec<Voxel> = volume.voxels().collect();
        let key = |v: &Voxel| [v[2], v[1], v[0]];
        let find = |v: Voxel| voxels.binary_search_by_key(&key(&v), key).ok();
        let around = |v: &Voxel| {
            let steps = (0..27).filter(|&d| d != 13).map(|d| [d % 3, d / 3 % 3, d / 9]);
            steps
                .map(|d| [(v[0] + d[0]).wrapping_sub(1), (v[1] + d[1]).wrapping_sub(1), (v[2] + d[2]).wrapping_sub(1)])
                .filter(|&q| volume.get(q))
                .filter_map(find)
                .collect::<Vec<_>>()
        };
        let near: Vec<Vec<usize>> = voxels.iter().map(around).collect();
        let mut tracer = Self { node_of: vec![None; voxels.len()], voxels, near, nodes: 0 };
        tracer.number_nodes();
        tracer.absorb_corners();
        tracer
    }

    fn number_nodes(&mut self) {
        for start in 0..self.voxels.len() {
            if self.node_of[start].is_some() || self.near[start].len() == 2 {
                continue;
            }
            let node = Some(self.nodes);
            self.nodes += 1;
            self.node_of[start] = node;
            let mut stack = if self.near[start].len() > 2 { vec![start] } else { Vec::new() };
            while let Some(v) = stack.pop() {
                for &w in &self.near[v] {
                    if self.near[w].len() > 2 && self.node_of[w].is_none() {
                        self.node_of[w] = node;
                        stack.push(w);
                    }
                }
            }
        }
    }

    /// A line voxel between two adjacent voxels of one junction is part of it: no loop of the object passes there.
    fn absorb_corners(&mut self) {
        for v in 0..self.voxels.len() {
            if let (None, &[a, b]) = (self.node_of[v], self.near[v].as_slice())
                && self.node_of[a].is_some()
                && self.node_of[a] == self.node_of[b]
                && self.near[a].contains(&b)
            {
                self.node_of[v] = self.node_of[a];
            }
        }
    }

    fn position(&self, v: usize, grid: &Grid) -> P3 {
        let [i, j, k] = self.voxels[v];
        grid.point(i, j, k)
    }

    fn nodes(&self, grid: &Grid) -> Vec<Node> {
        let mut members: Vec<Vec<usize>> = vec![Vec::new(); self.nodes];
        for (v, node) in self.node_of.iter().enumerate() {
            if let Some(n) = *node {
                members[n].push(v);
            }
        }
        members
            .iter()
            .map(|m| {
                let points: Vec<P3> = m.iter().map(|&v| self.position(v, grid)).collect();
                let kind = if m.iter().any(|&v| self.near[v].len() > 2) { NodeKind::Junction } else { NodeKind::End };
                Node { kind, position: middle(&points), radius_mm: 0.0, cap: None }
            })
            .collect()
    }

    /// The other neighbour of a line voxel.
    fn other(&self, v: usize, than: usize) -> usize {
        if self.near[v][0] == than { self.near[v][1] } else { self.near[v][0] }
    }

    /// The voxels from node voxel `start` by way of its neighbour `next` to the next node voxel; `None` when that is no
    /// edge or was traced from the other side.
    fn chain(&self, start: usize, next: usize, traced: &mut [bool]) -> Option<Vec<usize>> {
        if self.node_of[next].is_some() {
            let other = self.node_of[start] != self.node_of[next] && start < next;
            return other.then(|| vec![start, next]);
        }
        if traced[next] {
            return None;
        }
        let mut chain = vec![start];
        let (mut last, mut at) = (start, next);
        while self.node_of[at].is_none() {
            traced[at] = true;
            chain.push(at);
            let next = self.other(at, last);
            (last, at) = (at, next);
        }
        chain.push(at);
        Some(chain)
    }

    fn edge(&self, from: usize, chain: &[usize], nodes: &[Node], grid: &Grid) -> Edge {
        let to = chain.last().and_then(|&v| self.node_of[v]).unwrap_or(from);
        let mut points = vec![nodes[from].position];
        points.extend(chain.iter().map(|&v| self.position(v, grid)));
        points.push(nodes[to].position);
        points.dedup_by(|a, b| a.distance(*b) < 1e-9);
        Edge { nodes: [from, to], radius_mm: vec![0.0; points.len()], points }
    }
}

/// The point nearest to the centroid of all: the centroid itself may lie in a hole between them.
fn middle(points: &[P3]) -> P3 {
    let centroid = P3::centroid(points).unwrap_or_default();
    let nearest = points.iter().min_by(|a, b| a.distance(centroid).total_cmp(&b.distance(centroid)));
    nearest.copied().unwrap_or_default()
}

/// The graph with every junction of degree two merged into one edge (bases of closed lines excepted).
pub(crate) fn merge_passages(mut graph: MedialGraph) -> MedialGraph {
    for node in 0..graph.nodes.len() {
        let at: Vec<usize> = (0..graph.edges.len()).filter(|&e| graph.edges[e].nodes.contains(&node)).collect();
        let &[a, b] = at.as_slice() else { continue };
        if graph.edges[a].is_loop() || graph.edges[b].is_loop() {
            continue;
        }
        let mut second = graph.edges.remove(b);
        let first = &mut graph.edges[a];
        if first.nodes[1] != node {
            first.reverse();
        }
        if second.nodes[0] != node {
            second.reverse();
        }
        first.nodes[1] = second.nodes[1];
        first.points.extend(second.points.into_iter().skip(1));
        first.radius_mm.extend(second.radius_mm.into_iter().skip(1));
    }
    let bare: Vec<bool> =
        (0..graph.nodes.len()).map(|n| graph.nodes[n].kind == NodeKind::Junction && graph.degree(n) == 0).collect();
    without_nodes(graph, &bare)
}

/// The graph without some nodes (which have no edges), renumbered.
pub(crate) fn without_nodes(graph: MedialGraph, gone: &[bool]) -> MedialGraph {
    let mut number = 0;
    let renumbered: Vec<usize> = gone
        .iter()
        .map(|&g| {
            number += usize::from(!g);
            number.saturating_sub(1)
        })
        .collect();
    let nodes = graph.nodes.into_iter().zip(gone).filter(|(_, g)| !**g).map(|(n, _)| n).collect();
    let edges = graph.edges.into_iter().map(|e| Edge { nodes: e.nodes.map(|n| renumbered[n]), ..e }).collect();
    MedialGraph { nodes, edges }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use space::{Affine, V3};

    fn unit_grid(size: [usize; 3]) -> Grid {
        Grid { size, to_patient: Affine::from_columns([V3::X, V3::Y, V3::Z], P3::ORIGIN) }
    }

    fn of(voxels: &[Voxel]) -> MedialGraph {
        let mut v = BitVolume::new([20, 20, 20]);
        voxels.iter().for_each(|&p| v.set(p));
        graph(&v, &unit_grid([20, 20, 20]))
    }

    fn degrees(g: &MedialGraph) -> Vec<usize> {
        let mut d: Vec<usize> = (0..g.nodes.len()).map(|n| g.degree(n)).collect();
        d.sort_unstable();
        d
    }

    #[test]
    fn a_line_has_two_ends_and_all_its_points_in_order() {
        let g = of(&[[3, 3, 3], [4, 4, 3], [5, 4, 4], [6, 4, 4]]);
        assert_eq!((g.nodes.len(), g.edges.len(), g.cycles()), (2, 1, 0));
        assert_eq!(g.edges[0].points.len(), 4);
        assert!((g.edges[0].length_mm() - (2.0 * 2.0_f64.sqrt() + 1.0)).abs() < 1e-12);
    }

    #[test]
    fn three_arms_meet_in_one_junction() {
        let mut voxels = vec![[10, 10, 10]];
        for i in 1..6 {
            voxels.extend([[10 + i, 10, 10], [10 - i, 10, 10], [10, 10 + i, 10]]);
        }
        let g = of(&voxels);
        assert_eq!(degrees(&g), [1, 1, 1, 3]);
        assert_eq!((g.edges.len(), g.cycles(), g.components()), (3, 0, 1));
    }

    #[test]
    fn a_closed_line_is_a_loop_and_a_lone_voxel_a_node() {
        let diamond = [[5, 3, 5], [6, 4, 5], [7, 5, 5], [6, 6, 5], [5, 7, 5], [4, 6, 5], [3, 5, 5], [4, 4, 5]];
        let g = of(&diamond);
        assert_eq!((g.nodes.len(), g.edges.len(), g.cycles()), (1, 1, 1));
        assert_eq!(g.edges[0].points.len(), 9);
        let lone = of(&[[1, 1, 1]]);
        assert_eq!((lone.nodes.len(), lone.edges.len(), lone.components()), (1, 0, 1));
    }

    #[test]
    fn a_loop_on_a_stalk_keeps_its_junction_and_its_cycle() {
        let diamond = [[5, 3, 5], [6, 4, 5], [7, 5, 5], [6, 6, 5], [5, 7, 5], [4, 6, 5], [3, 5, 5], [4, 4, 5]];
        let stalk: Vec<Voxel> = (8..14).map(|x| [x, 5, 5]).collect();
        let g = of(&[&diamond[..], &stalk].concat());
        assert_eq!(g.cycles(), 1);
        assert_eq!(degrees(&g), [1, 3]);
        assert!(g.edges.iter().any(Edge::is_loop));
    }

    #[test]
    fn a_double_corner_is_a_passage_and_no_node() {
        let g = of(&[[1, 1, 1], [2, 1, 1], [3, 1, 1], [3, 2, 1], [3, 3, 1], [3, 4, 1]]);
        assert_eq!((g.nodes.len(), g.edges.len(), g.cycles()), (2, 1, 0));
    }
}
