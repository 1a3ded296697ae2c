//! Half-edges of a closed triangle mesh, for the operations that change its connectivity.
//!
//! Half-edge h = 3 t + k runs from corner k to corner k + 1 of triangle t. Every mesh here is closed (wall and caps),
//! so each half-edge has a twin and a turn about a vertex always comes round: no boundary case anywhere. Split, flip
//! and collapse keep the mesh a closed oriented 2-manifold; whether they are wise is the caller's to judge.

use crate::{Defect, DefectKind, TriMesh};
use glam::DVec3;
use space::P3;

/// No half-edge: the vertex is gone.
pub(crate) const NONE: u32 = u32::MAX;
/// Face id of a triangle that is gone.
pub(crate) const GONE: u32 = u32::MAX;

/// The next half-edge of the same triangle.
pub(crate) fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}
/// The previous half-edge of the same triangle.
pub(crate) fn prev(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

/// The mesh; see the module's text.
#[derive(Clone, Debug)]
pub(crate) struct Web {
    pub(crate) origin: Vec<u32>,
    pub(crate) twin: Vec<u32>,
    pub(crate) face_id: Vec<u32>,
    /// One half-edge leaving each vertex, or NONE.
    pub(crate) leaving: Vec<u32>,
    /// Number of edges at each vertex.
    pub(crate) degree: Vec<u32>,
    pub(crate) at: Vec<DVec3>,
}

impl Web {
    /// Weave a closed mesh.
    ///
    /// # Errors
    /// The first defect: index, degenerate triangle, open or non-manifold edge, orientation, non-manifold vertex.
    pub(crate) fn weave(mesh: &TriMesh) -> Result<Self, Defect> {
        let at: Vec<DVec3> = mesh.vertices.iter().map(|p| p.raw()).collect();
        let origin = corners(mesh)?;
        let twin = twins(mesh, &origin)?;
        let mut leaving = vec![NONE; at.len()];
        for (h, &v) in origin.iter().enumerate().rev() {
            leaving[v as usize] = h as u32;
        }
        let mut degree = vec![0; at.len()];
        origin.iter().for_each(|&v| degree[v as usize] += 1);
        let web = Self { origin, twin, face_id: mesh.face_id.clone(), leaving, degree, at };
        web.single_fans()?;
        Ok(web)
    }

    /// Every vertex must have one fan of triangles.
    fn single_fans(&self) -> Result<(), Defect> {
        for v in 0..self.at.len() as u32 {
            let h = self.leaving[v as usize];
            if h == NONE || self.spokes(v).count() != self.valence(v) {
                let kind = if h == NONE { DefectKind::LooseVertex } else { DefectKind::NonManifoldVertex };
                return Err(Defect { kind, element: v as usize, at: P3::from_raw(self.at[v as usize]) });
            }
        }
        Ok(())
    }

    /// Back to a mesh: living vertices and triangles in their order.
    pub(crate) fn mesh(&self) -> TriMesh {
        let mut number = vec![NONE; self.at.len()];
        let mut mesh = TriMesh::default();
        for (v, &h) in self.leaving.iter().enumerate() {
            if h != NONE {
                number[v] = mesh.vertices.len() as u32;
                mesh.vertices.push(P3::from_raw(self.at[v]));
            }
        }
        for t in (0..self.face_id.len()).filter(|&t| self.face_id[t] != GONE) {
            mesh.triangles.push([0, 1, 2].map(|k| number[self.origin[3 * t + k] as usize]));
            mesh.face_id.push(self.face_id[t]);
        }
        mesh
    }

    /// Where a half-edge ends.
    pub(crate) fn target(&self, h: u32) -> u32 {
        self.origin[next(h) as usize]
    }
    /// Face id left of a half-edge.
    pub(crate) fn id(&self, h: u32) -> u32 {
        self.face_id[h as usize / 3]
    }
    /// Whether a half-edge belongs to a living triangle.
    pub(crate) fn lives(&self, h: u32) -> bool {
        self.id(h) != GONE
    }
    /// Whether the face id changes across the edge.
    pub(crate) fn is_feature(&self, h: u32) -> bool {
        self.id(h) != self.id(self.twin[h as usize])
    }
    /// Half-edges leaving a vertex, counterclockwise seen from outside.
    pub(crate) fn spokes(&self, v: u32) -> impl Iterator<Item = u32> + '_ {
        let first = self.leaving[v as usize];
        let mut now = first;
        std::iter::from_fn(move || {
            if now == NONE {
                return None;
            }
            let h = now;
            now = self.twin[prev(h) as usize];
            if now == first {
                now = NONE;
            }
            Some(h)
        })
    }
    /// Number of edges at a vertex.
    pub(crate) fn valence(&self, v: u32) -> usize {
        self.degree[v as usize] as usize
    }
    /// The half-edge from a to b, if the edge exists.
    pub(crate) fn between(&self, a: u32, b: u32) -> Option<u32> {
        self.spokes(a).find(|&h| self.target(h) == b)
    }
    /// Corner vertices of a triangle.
    pub(crate) fn corners(&self, t: usize) -> [u32; 3] {
        [0, 1, 2].map(|k| self.origin[3 * t + k])
    }
    /// Length of an edge.
    pub(crate) fn length(&self, h: u32) -> f64 {
        self.at[self.origin[h as usize] as usize].distance(self.at[self.target(h) as usize])
    }

    fn join(&mut self, g: u32, h: u32) {
        self.twin[g as usize] = h;
        self.twin[h as usize] = g;
    }

    /// Split an edge at a point; gives the new vertex. Both triangles are halved and keep their ids.
    pub(crate) fn split(&mut self, h: u32, at: DVec3) -> u32 {
        // a -> b with c on its left (triangle of h) and d on its right (triangle of t).
        let t = self.twin[h as usize];
        let (hn, tp) = (next(h), prev(t));
        let (b, c, d) = (self.target(h), self.origin[prev(h) as usize], self.origin[tp as usize]);
        let m = self.at.len() as u32;
        self.at.push(at);
        let n = self.origin.len() as u32;
        let (outer_bc, outer_db) = (self.twin[hn as usize], self.twin[tp as usize]);
        self.origin.extend([m, b, c, b, m, d]);
        self.twin.extend([NONE; 6]);
        self.face_id.extend([self.id(h), self.id(t)]);
        self.origin[hn as usize] = m;
        self.origin[t as usize] = m;
        self.join(n, n + 3);
        self.join(n + 1, outer_bc);
        self.join(n + 2, hn);
        self.join(n + 4, tp);
        self.join(n + 5, outer_db);
        self.leaving.push(n);
        self.leaving[b as usize] = n + 1;
        self.degree.push(4);
        self.degree[c as usize] += 1;
        self.degree[d as usize] += 1;
        m
    }

    /// Turn an edge to join the two opposite corners. The caller has made sure that they are not yet joined and that
    /// the ids agree.
    pub(crate) fn flip(&mut self, h: u32) {
        let t = self.twin[h as usize];
        let (hn, hp, tn, tp) = (next(h), prev(h), next(t), prev(t));
        let (a, b) = (self.origin[h as usize], self.origin[t as usize]);
        let (c, d) = (self.origin[hp as usize], self.origin[tp as usize]);
        let [x_hn, x_hp, x_tn, x_tp] = [hn, hp, tn, tp].map(|e| self.twin[e as usize]);
        for (e, v) in [(h, d), (hn, c), (hp, a), (t, c), (tn, d), (tp, b)] {
            self.origin[e as usize] = v;
        }
        self.join(hn, x_hp);
        self.join(hp, x_tn);
        self.join(tn, x_tp);
        self.join(tp, x_hn);
        for (v, e) in [(a, hp), (b, tp), (c, hn), (d, tn)] {
            self.leaving[v as usize] = e;
        }
        self.degree[a as usize] -= 1;
        self.degree[b as usize] -= 1;
        self.degree[c as usize] += 1;
        self.degree[d as usize] += 1;
    }

    /// Whether the edge's opposite corners are joined already (then it must not be flipped).
    pub(crate) fn flip_blocked(&self, h: u32) -> bool {
        let (c, d) = (self.origin[prev(h) as usize], self.origin[prev(self.twin[h as usize]) as usize]);
        c == d || self.between(c, d).is_some()
    }

    /// Whether drawing the origin of h into its target would break the 2-manifold (link condition).
    pub(crate) fn collapse_blocked(&self, h: u32) -> bool {
        let (a, b) = (self.origin[h as usize], self.target(h));
        let (c, d) = (self.origin[prev(h) as usize], self.origin[prev(self.twin[h as usize]) as usize]);
        if c == d || self.valence(c) <= 3 || self.valence(d) <= 3 {
            return true;
        }
        self.spokes(a).map(|e| self.target(e)).filter(|&x| x != b && self.between(b, x).is_some()).count() != 2
    }

    /// Draw the origin of h into its target; two triangles and the origin are gone.
    pub(crate) fn collapse(&mut self, h: u32) {
        let t = self.twin[h as usize];
        let (hn, hp, tn, tp) = (next(h), prev(h), next(t), prev(t));
        let (a, b) = (self.origin[h as usize], self.target(h));
        let (c, d) = (self.origin[hp as usize], self.origin[tp as usize]);
        self.degree[b as usize] = self.degree[a as usize] + self.degree[b as usize] - 4;
        self.degree[c as usize] -= 1;
        self.degree[d as usize] -= 1;
        self.degree[a as usize] = 0;
        let spokes: Vec<u32> = self.spokes(a).collect();
        for e in spokes {
            self.origin[e as usize] = b;
        }
        let [x_hn, x_hp, x_tn, x_tp] = [hn, hp, tn, tp].map(|e| self.twin[e as usize]);
        self.join(x_hn, x_hp);
        self.join(x_tn, x_tp);
        self.leaving[b as usize] = x_hp;
        self.leaving[c as usize] = x_hn;
        self.leaving[d as usize] = x_tn;
        self.leaving[a as usize] = NONE;
        self.face_id[h as usize / 3] = GONE;
        self.face_id[t as usize / 3] = GONE;
    }
}

fn corners(mesh: &TriMesh) -> Result<Vec<u32>, Defect> {
    let mut origin = Vec::with_capacity(3 * mesh.triangles.len());
    for (t, tri) in mesh.triangles.iter().enumerate() {
        if tri.iter().any(|&v| v as usize >= mesh.vertices.len()) || mesh.face_id.len() != mesh.triangles.len() {
            return Err(Defect { kind: DefectKind::BadIndex, element: t, at: P3::ORIGIN });
        }
        if tri[0] == tri[1] || tri[1] == tri[2] || tri[2] == tri[0] {
            let at = mesh.vertices[tri[0] as usize];
            return Err(Defect { kind: DefectKind::Degenerate, element: t, at });
        }
        origin.extend(tri);
    }
    Ok(origin)
}

fn twins(mesh: &TriMesh, origin: &[u32]) -> Result<Vec<u32>, Defect> {
    let mut edges: Vec<(u32, u32, u32)> = (0..origin.len() as u32)
        .map(|h| {
            let (a, b) = (origin[h as usize], origin[next(h) as usize]);
            (a.min(b), a.max(b), h)
        })
        .collect();
    edges.sort_unstable();
    let mut twin = vec![NONE; origin.len()];
    let mut first = None::<Defect>;
    for run in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        let kind = match run {
            [x, y] if origin[x.2 as usize] != origin[y.2 as usize] => {
                twin[x.2 as usize] = y.2;
                twin[y.2 as usize] = x.2;
                continue;
            }
            [_] => DefectKind::OpenEdge,
            [_, _] => DefectKind::Orientation,
            _ => DefectKind::NonManifoldEdge,
        };
        let element = run[0].2 as usize / 3;
        if first.as_ref().is_none_or(|d| element < d.element) {
            let (a, b) = (mesh.vertices[run[0].0 as usize], mesh.vertices[run[0].1 as usize]);
            first = Some(Defect { kind, element, at: a.lerp(b, 0.5) });
        }
    }
    first.map_or(Ok(twin), Err)
}
