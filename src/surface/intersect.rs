//! Does the mesh pass through itself?
//!
//! A bounding-box tree of the triangles (split at the median of the widest axis) gives candidate pairs; the test of a
//! pair is by exact orientation predicates (crate robust). Pairs that share an edge are left to the facing test of the
//! remeshing; exactly coplanar overlaps of others count as intersections only when an edge passes through a face.

use crate::{Error, TriMesh};
use exec::Ctx;
use glam::DVec3;
use robust::{Coord3D, orient3d};

/// Triangles per leaf of the tree.
const LEAF: usize = 8;

struct Node {
    lo: DVec3,
    hi: DVec3,
    range: (usize, usize),
    children: Option<(usize, usize)>,
}

/// All pairs of triangles that pass through each other, ascending; empty for a sound surface. Cost n log n.
///
/// # Errors
/// [`Error::Cancelled`].
pub fn self_intersections(mesh: &TriMesh, ctx: &Ctx) -> Result<Vec<[usize; 2]>, Error> {
    let n = mesh.triangles.len();
    let boxes: Vec<(DVec3, DVec3)> = (0..n)
        .map(|t| {
            let [a, b, c] = mesh.corners(t).map(|p| p.raw());
            (a.min(b).min(c), a.max(b).max(c))
        })
        .collect();
    let mut order: Vec<usize> = (0..n).collect();
    let mut nodes = Vec::new();
    if n > 0 {
        grow(&boxes, &mut order, (0, n), &mut nodes);
    }
    let hits = ctx.map_range(n, |t| {
        let mut found = Vec::new();
        let mut open = if nodes.is_empty() { vec![] } else { vec![0_usize] };
        while let Some(k) = open.pop() {
            let node = &nodes[k];
            if node.lo.cmpgt(boxes[t].1).any() || node.hi.cmplt(boxes[t].0).any() {
                continue;
            }
            match node.children {
                Some((l, r)) => open.extend([l, r]),
                None => found
                    .extend((order[node.range.0..node.range.1].iter().copied()).filter(|&s| s > t && meet(mesh, t, s))),
            }
        }
        found.sort_unstable();
        found
    })?;
    Ok(hits.into_iter().enumerate().flat_map(|(t, s)| s.into_iter().map(move |s| [t, s])).collect())
}

fn grow(boxes: &[(DVec3, DVec3)], order: &mut [usize], range: (usize, usize), nodes: &mut Vec<Node>) -> usize {
    let part = &mut order[range.0..range.1];
    let (lo, hi) = part
        .iter()
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), &t| (lo.min(boxes[t].0), hi.max(boxes[t].1)));
    let me = nodes.len();
    nodes.push(Node { lo, hi, range, children: None });
    if part.len() > LEAF {
        let axis = (0..3).max_by(|&i, &j| (hi - lo)[i].total_cmp(&(hi - lo)[j])).unwrap_or(0);
        let middle = |t: usize| boxes[t].0[axis] + boxes[t].1[axis];
        part.sort_by(|&s, &t| middle(s).total_cmp(&middle(t)).then(s.cmp(&t)));
        let half = range.0 + part.len() / 2;
        let l = grow(boxes, order, (range.0, half), nodes);
        let r = grow(boxes, order, (half, range.1), nodes);
        nodes[me].children = Some((l, r));
    }
    me
}

fn meet(mesh: &TriMesh, s: usize, t: usize) -> bool {
    let (a, b) = (mesh.triangles[s], mesh.triangles[t]);
    let shared = a.iter().filter(|v| b.contains(v)).count();
    if shared >= 2 {
        return false;
    }
    let pierces = |edges: [u32; 3], face: [u32; 3]| {
        (0..3).any(|k| {
            let (p, q) = (edges[k], edges[(k + 1) % 3]);
            !face.contains(&p) && !face.contains(&q) && pierced(mesh, [p, q], face)
        })
    };
    pierces(a, b) || pierces(b, a)
}

/// Whether a segment passes through a triangle (touching counts).
fn pierced(mesh: &TriMesh, [p, q]: [u32; 2], face: [u32; 3]) -> bool {
    let at = |v: u32| {
        let [x, y, z] = mesh.vertices[v as usize].to_array();
        Coord3D { x, y, z }
    };
    let [a, b, c] = face.map(at);
    let (p, q) = (at(p), at(q));
    let (sp, sq) = (orient3d(a, b, c, p), orient3d(a, b, c, q));
    if sp * sq > 0.0 || (sp == 0.0 && sq == 0.0) || (sp > 0.0) == (sq > 0.0) && sp != 0.0 && sq != 0.0 {
        return false;
    }
    let side = [orient3d(p, q, a, b), orient3d(p, q, b, c), orient3d(p, q, c, a)];
    side.iter().all(|&s| s >= 0.0) || side.iter().all(|&s| s <= 0.0)
}
