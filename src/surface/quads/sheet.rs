//! A triangle mesh with boundary: the wall without its caps, cut open along curves.

use crate::land::{Approach, Tie, land};
use crate::web::{next, prev};
use crate::{TriMesh, WALL};
use glam::DVec3;
use implicit::Field;
use space::P3;
use std::collections::{BTreeMap, BTreeSet};

/// No half-edge on the other side.
pub(crate) const NONE: u32 = u32::MAX;

/// An edge, smaller vertex first.
pub(crate) fn edge(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

/// Triangles with boundary. Half-edge 3 t + k runs from corner k to corner k + 1.
#[derive(Clone, Debug)]
pub(crate) struct Sheet {
    pub(crate) mesh: TriMesh,
    /// Per vertex a number that copies of a vertex on both sides of a curve have in common.
    pub(crate) root: Vec<u32>,
    pub(crate) twin: Vec<u32>,
}

/// Points in which curves cross the edges, and those in which three of them meet.
#[derive(Clone, Debug, Default)]
pub(crate) struct Crossings {
    /// Per crossed edge the way from its smaller vertex, part of it.
    pub(crate) on_edge: BTreeMap<(u32, u32), f64>,
    /// Per triangle with three crossed edges the place of the pole.
    pub(crate) pole: BTreeMap<usize, DVec3>,
}

/// A sheet with curves drawn into it.
pub(crate) struct Drawn {
    pub(crate) sheet: Sheet,
    /// The curves' edges.
    pub(crate) curve: BTreeSet<(u32, u32)>,
    /// The poles' vertices.
    pub(crate) poles: Vec<u32>,
}

impl Sheet {
    pub(crate) fn new(mesh: TriMesh, root: Vec<u32>) -> Self {
        let mut half: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        let mut twin = vec![NONE; 3 * mesh.triangles.len()];
        for (t, tri) in mesh.triangles.iter().enumerate() {
            for k in 0..3 {
                half.insert((tri[k], tri[(k + 1) % 3]), (3 * t + k) as u32);
            }
        }
        for (&(a, b), &h) in &half {
            if let Some(&o) = half.get(&(b, a)) {
                twin[h as usize] = o;
            }
        }
        Self { mesh, root, twin }
    }

    /// The wall faces of a closed mesh.
    pub(crate) fn wall(mesh: &TriMesh) -> Self {
        let mut number = vec![NONE; mesh.vertices.len()];
        let (mut out, mut root) = (TriMesh::default(), Vec::new());
        for (t, _) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id == WALL) {
            out.triangles.push(t.map(|v| {
                if number[v as usize] == NONE {
                    number[v as usize] = root.len() as u32;
                    root.push(v);
                    out.vertices.push(mesh.vertices[v as usize]);
                }
                number[v as usize]
            }));
        }
        out.face_id = vec![WALL; out.triangles.len()];
        Self::new(out, root)
    }

    pub(crate) fn origin(&self, h: u32) -> u32 {
        self.mesh.triangles[h as usize / 3][h as usize % 3]
    }
    pub(crate) fn target(&self, h: u32) -> u32 {
        self.origin(next(h))
    }
    pub(crate) fn place(&self, v: u32) -> DVec3 {
        self.mesh.vertices[v as usize].raw()
    }

    /// Cut open along edges: no vertex is shared across them any more. One sheet per connected piece, in the order of
    /// their first triangles.
    pub(crate) fn opened(&self, curve: &BTreeSet<(u32, u32)>) -> Vec<Self> {
        let joined = |h: u32| {
            let o = self.twin[h as usize];
            (o != NONE && !curve.contains(&edge(self.origin(h), self.target(h)))).then_some(o)
        };
        let mut piece = vec![usize::MAX; self.mesh.triangles.len()];
        let mut sheets = Vec::new();
        for first in 0..piece.len() {
            if piece[first] != usize::MAX {
                continue;
            }
            let mut triangles = vec![first];
            piece[first] = first;
            let mut k = 0;
            while let Some(&t) = triangles.get(k) {
                k += 1;
                for o in (3 * t as u32..3 * t as u32 + 3).filter_map(joined) {
                    if piece[o as usize / 3] == usize::MAX {
                        piece[o as usize / 3] = first;
                        triangles.push(o as usize / 3);
                    }
                }
            }
            triangles.sort_unstable();
            sheets.push(self.part(&triangles, &joined));
        }
        sheets
    }

    /// Some triangles with vertices of their own: one for each fan of corners that hang together.
    fn part(&self, triangles: &[usize], joined: &impl Fn(u32) -> Option<u32>) -> Self {
        let mut number: BTreeMap<u32, u32> = BTreeMap::new();
        let (mut out, mut root) = (TriMesh::default(), Vec::new());
        for &t in triangles {
            let corner = [0, 1, 2].map(|k| {
                let h = 3 * t as u32 + k;
                if let Some(&v) = number.get(&h) {
                    return v;
                }
                let v = root.len() as u32;
                let o = self.origin(h);
                root.push(self.root[o as usize]);
                out.vertices.push(self.mesh.vertices[o as usize]);
                // All corners around, counterclockwise and then clockwise.
                let mut open = vec![h];
                while let Some(s) = open.pop() {
                    if number.insert(s, v).is_none() {
                        open.extend(joined(prev(s)));
                        open.extend(joined(s).map(next));
                    }
                }
                v
            });
            out.triangles.push(corner);
        }
        out.face_id = vec![WALL; out.triangles.len()];
        Self::new(out, root)
    }

    /// Boundary loops, each a cycle of vertices with the sheet on its left, from its smallest vertex.
    pub(crate) fn loops(&self) -> Vec<Vec<u32>> {
        let edges: BTreeMap<u32, u32> = (0..self.twin.len() as u32)
            .filter(|&h| self.twin[h as usize] == NONE)
            .map(|h| (self.origin(h), self.target(h)))
            .collect();
        crate::cut::loops(&edges)
    }

    /// Vertices - edges + triangles.
    pub(crate) fn euler(&self) -> i64 {
        let inner = self.twin.iter().filter(|&&o| o != NONE).count() / 2;
        let border = self.twin.iter().filter(|&&o| o == NONE).count();
        self.mesh.vertices.len() as i64 - (inner + border) as i64 + self.mesh.triangles.len() as i64
    }

    /// Draw curves: crossed triangles are divided. New vertices get roots from `fresh` on.
    pub(crate) fn drawn(&self, crossings: &Crossings, fresh: &mut u32) -> Drawn {
        let (mut mesh, mut root) = (self.mesh.clone(), self.root.clone());
        let mut add = |at: DVec3, mesh: &mut TriMesh| {
            mesh.vertices.push(P3::from_raw(at));
            root.push(*fresh);
            *fresh += 1;
            mesh.vertices.len() as u32 - 1
        };
        let mut on: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        for (&(a, b), &part) in &crossings.on_edge {
            let at = self.place(a).lerp(self.place(b), part);
            on.insert((a, b), add(at, &mut mesh));
        }
        let (mut curve, mut poles) = (BTreeSet::new(), Vec::new());
        mesh.triangles.clear();
        for (t, &c) in self.mesh.triangles.iter().enumerate() {
            let x = [0, 1, 2].map(|k| on.get(&edge(c[k], c[(k + 1) % 3])).copied());
            match (x, crossings.pole.get(&t)) {
                ([Some(x), Some(y), Some(z)], Some(&at)) => {
                    let m = add(at, &mut mesh);
                    poles.push(m);
                    [x, y, z].iter().for_each(|&x| _ = curve.insert(edge(x, m)));
                    mesh.triangles.extend([[c[0], x, m], [x, c[1], m], [c[1], y, m], [y, c[2], m]]);
                    mesh.triangles.extend([[c[2], z, m], [z, c[0], m]]);
                }
                _ => split_in_two(&mut mesh, c, x, &mut curve),
            }
        }
        mesh.face_id = vec![WALL; mesh.triangles.len()];
        Drawn { sheet: Self::new(mesh, root), curve, poles }
    }
}

/// Edges from a pole within which the drawn sheet is relaxed, and rounds of that.
const AROUND: usize = 4;
const ROUNDS: usize = 30;
/// Longest step back onto the wall, mm.
const STEP_MM: f64 = 0.2;

impl Drawn {
    /// Straighten the curves where three of them meet. Labels of vertices tell in which triangle a pole lies, the functions
    /// say where; where the two differ the curves had a kink as long as an edge. Curve vertices move to the middle of
    /// their neighbours on the curve, a pole to that of its three, all others around to that of all their neighbours, and back onto the wall.
    pub(crate) fn relax(&mut self, field: &dyn Field) {
        let n = self.sheet.root.len();
        let (mut beside, mut along) = (vec![Vec::new(); n], vec![Vec::new(); n]);
        let mut border = vec![false; n];
        for h in 0..self.sheet.twin.len() as u32 {
            let (a, b) = (self.sheet.origin(h), self.sheet.target(h));
            if self.sheet.twin[h as usize] == NONE {
                (border[a as usize], border[b as usize]) = (true, true);
            }
            beside[a as usize].push(b);
            if self.curve.contains(&edge(a, b)) {
                along[a as usize].push(b);
            }
        }
        let mut near: BTreeSet<u32> = self.poles.iter().copied().collect();
        for _ in 0..AROUND {
            let more: Vec<u32> = near.iter().flat_map(|&v| beside[v as usize].iter().copied()).collect();
            near.extend(more);
        }
        near.retain(|&v| !border[v as usize]);
        for _ in 0..ROUNDS {
            let middle = |&v: &u32| {
                let of = if along[v as usize].len() > 1 { &along[v as usize] } else { &beside[v as usize] };
                let x = of.iter().fold(DVec3::ZERO, |s, &o| s + self.sheet.place(o)) / of.len() as f64;
                land(field, x, &Tie::WALL, Approach::follow(STEP_MM)).at
            };
            let moved: Vec<DVec3> = near.iter().map(middle).collect();
            near.iter().zip(moved).for_each(|(&v, x)| self.sheet.mesh.vertices[v as usize] = P3::from_raw(x));
        }
    }
}

/// A triangle crossed by one curve (or none): the corner between the two crossed edges is cut off.
fn split_in_two(mesh: &mut TriMesh, c: [u32; 3], x: [Option<u32>; 3], curve: &mut BTreeSet<(u32, u32)>) {
    let corner = (0..3).find(|&k| x[k].is_some() && x[(k + 2) % 3].is_some());
    let Some(k) = corner else {
        mesh.triangles.push(c);
        return;
    };
    let (a, b, d) = (c[k], c[(k + 1) % 3], c[(k + 2) % 3]);
    let (Some(p), Some(q)) = (x[k], x[(k + 2) % 3]) else { return };
    curve.insert(edge(p, q));
    mesh.triangles.push([a, p, q]);
    let long = |u: u32, v: u32| mesh.vertices[u as usize].distance(mesh.vertices[v as usize]);
    if long(p, d) < long(b, q) {
        mesh.triangles.extend([[p, b, d], [p, d, q]]);
    } else {
        mesh.triangles.extend([[p, b, q], [b, d, q]]);
    }
}
