//! Is the mesh what it claims to be: closed, 2-manifold, consistently oriented? And what is its shape as a topologist
//! sees it?

use crate::TriMesh;
use crate::web::Web;
use space::P3;
use std::fmt;

/// What is wrong with an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DefectKind {
    /// A corner index beyond the vertices, or face ids that do not fit the triangles.
    BadIndex,
    /// A triangle with two equal corners or no area.
    Degenerate,
    /// An edge with one triangle.
    OpenEdge,
    /// An edge with three or more triangles.
    NonManifoldEdge,
    /// Two triangles that run along their edge in the same direction.
    Orientation,
    /// A vertex where two fans of triangles touch.
    NonManifoldVertex,
    /// A vertex without triangles.
    LooseVertex,
    /// Two triangles with the same three corners.
    Duplicate,
}

/// The first offending element of a mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct Defect {
    /// What is wrong.
    pub kind: DefectKind,
    /// Triangle number, or vertex number for [`DefectKind::NonManifoldVertex`] and [`DefectKind::LooseVertex`].
    pub element: usize,
    /// Where it lies, LPS mm.
    pub at: P3,
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.kind {
            DefectKind::BadIndex => "bad corner index in triangle",
            DefectKind::Degenerate => "degenerate triangle",
            DefectKind::OpenEdge => "open edge at triangle",
            DefectKind::NonManifoldEdge => "edge with more than two triangles at triangle",
            DefectKind::Orientation => "inconsistent orientation at triangle",
            DefectKind::NonManifoldVertex => "non-manifold vertex",
            DefectKind::LooseVertex => "vertex without triangles",
            DefectKind::Duplicate => "duplicate triangle",
        };
        write!(f, "{what} {}", self.element)
    }
}

impl std::error::Error for Defect {}

/// The shape of a closed mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topology {
    /// Vertices - edges + triangles.
    pub euler: i64,
    /// Connected pieces.
    pub components: usize,
    /// Sum of the pieces' genera: components - euler / 2.
    pub genus: i64,
}

/// Check that a mesh is a closed, consistently oriented 2-manifold whose triangles all have an area, and give its Euler
/// number. Cost: two sorts. Holds for the meshes of [`crate::remesh`]; raw ones of [`crate::polygonise`] and
/// [`crate::cut`] may hold flat triangles where the lattice is aligned with the wall: see [`topology`].
///
/// # Errors
/// The first offending element.
pub fn check(mesh: &TriMesh) -> Result<Topology, Defect> {
    let topology = topology(mesh)?;
    for t in 0..mesh.triangles.len() {
        let area = mesh.area_vector(t).length();
        if !(area.is_finite() && area > 0.0) {
            return Err(Defect { kind: DefectKind::Degenerate, element: t, at: mesh.corners(t)[0] });
        }
    }
    Ok(topology)
}

/// As [`check`], by connectivity alone.
///
/// # Errors
/// The first offending element.
pub fn topology(mesh: &TriMesh) -> Result<Topology, Defect> {
    duplicates(mesh)?;
    let web = Web::weave(mesh)?;
    let components = pieces(&web).1;
    let (v, t) = (mesh.vertices.len() as i64, mesh.triangles.len() as i64);
    // A closed triangle mesh has 3 t / 2 edges.
    let euler = v - 3 * t / 2 + t;
    Ok(Topology { euler, components, genus: components as i64 - euler / 2 })
}

fn duplicates(mesh: &TriMesh) -> Result<(), Defect> {
    let mut keys: Vec<([u32; 3], usize)> = (mesh.triangles.iter().enumerate())
        .map(|(t, tri)| {
            let mut key = *tri;
            key.sort_unstable();
            (key, t)
        })
        .collect();
    keys.sort_unstable();
    let twice = keys.windows(2).filter(|w| w[0].0 == w[1].0).map(|w| w[1].1).min();
    twice.map_or(Ok(()), |t| {
        let at = mesh.vertices.get(mesh.triangles[t][0] as usize).copied().unwrap_or_default();
        Err(Defect { kind: DefectKind::Duplicate, element: t, at })
    })
}

/// The connected piece of every triangle, numbered by first triangle, and their number.
pub(crate) fn pieces(web: &Web) -> (Vec<usize>, usize) {
    regions(web, |_| true)
}

/// Regions of triangles joined across the half-edges that `joins` accepts, numbered by first triangle.
pub(crate) fn regions(web: &Web, joins: impl Fn(u32) -> bool) -> (Vec<usize>, usize) {
    let mut piece = vec![usize::MAX; web.face_id.len()];
    let mut count = 0;
    let mut open = Vec::new();
    for t in 0..piece.len() {
        if piece[t] != usize::MAX || web.face_id[t] == crate::web::GONE {
            continue;
        }
        piece[t] = count;
        open.push(t);
        while let Some(s) = open.pop() {
            for h in 3 * s..3 * s + 3 {
                let o = web.twin[h] as usize / 3;
                if piece[o] == usize::MAX && joins(h as u32) {
                    piece[o] = count;
                    open.push(o);
                }
            }
        }
        count += 1;
    }
    (piece, count)
}
