//! The whole way from f to a finished wall: polygonise, cut, cap, remesh.

use crate::cap::roughen;
use crate::remesh::{THIN, thinned};
use crate::{
    Bounded, Cap, Error, PolygoniseReport, PolygoniseSettings, RemeshReport, RemeshSettings, TriMesh, WALL, cut,
    polygonise,
};
use exec::Ctx;
use imaging::CutPlane;
use implicit::Field;
use space::P3;

/// A finished wall.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shell {
    /// Closed mesh, vertices of the wall on f = 0.
    pub mesh: TriMesh,
    /// Its caps, by face id.
    pub caps: Vec<Cap>,
    /// Times that the lattice's cell was halved.
    pub halvings: i32,
    /// What polygonising did, on the lattice that was taken.
    pub polygonised: PolygoniseReport,
    /// What remeshing did, from that lattice's mesh.
    pub remeshed: RemeshReport,
}

/// Times that the cell is halved where it missed a turn of the wall, as between two arteries that part, or a rim of a few
/// edges, as where a plane clips a vessel's tip: the mesh then joins what f separates, or the reverse, and no remeshing
/// can lay it on f.
const HALVINGS: i32 = 2;
/// A halved cell's mesh has four times the vertices: thinned like others it asks f 6.1 times per final vertex, by this 5.2.
const THIN_HALVED: f64 = 2.0;
/// How far outside the planes the field is closed, cells.
const MARGIN_CELLS: f64 = 4.0;

/// The wall f = 0 around some of its points, cut by planes ([`cut`]), capped and remeshed ([`crate::remesh`]).
///
/// Rims lie in their planes to 1e-12 mm, points inside caps to 1e-10 mm, by intention not better.
///
/// Outside the planes f is not trusted: the field is closed there ([`Bounded`]). Of 402 meshes of random vessels one cell
/// for all leaves three without an answer, halving it there none.
///
/// # Errors
/// Those of [`polygonise`], [`cut`] and [`crate::remesh`]; [`Error::is_unresolved`] where the finest cell does not do.
pub fn shell(
    field: &dyn Field,
    seeds: &[P3],
    cuts: &[CutPlane],
    cell: &PolygoniseSettings,
    settings: &RemeshSettings,
    ctx: &Ctx,
) -> Result<Shell, Error> {
    let bounded = Bounded::new(field, cuts, MARGIN_CELLS * cell.cell_mm);
    let by = |cell: &PolygoniseSettings, halvings: i32| {
        let (closed, caps, polygonised) = closed((field, &bounded), seeds, cuts, cell, &ctx.part(0.0, 0.3))?;
        let thin = if halvings > 0 { THIN_HALVED } else { THIN };
        let (mut mesh, remeshed) = thinned(&closed, field, cuts, settings, thin, &ctx.part(0.3, 1.0))?;
        roughen(&mut mesh, &caps.iter().map(|c| (c.face_id, c.plane.outward)).collect::<Vec<_>>());
        Ok(Shell { mesh, caps, halvings, polygonised, remeshed })
    };
    halving(cell, by)
}

/// The same wall cut and capped, but not remeshed: enough to see where vessels leave it. Gives the mesh and its caps by
/// face id.
///
/// # Errors
/// Those of [`polygonise`] and [`cut`].
pub fn openings(
    field: &dyn Field,
    seeds: &[P3],
    cuts: &[CutPlane],
    cell: &PolygoniseSettings,
    ctx: &Ctx,
) -> Result<(TriMesh, Vec<Cap>), Error> {
    let bounded = Bounded::new(field, cuts, MARGIN_CELLS * cell.cell_mm);
    halving(cell, |cell, _| closed((field, &bounded), seeds, cuts, cell, ctx).map(|(mesh, caps, _)| (mesh, caps)))
}

/// With the cell halved as often as the wall asks for it.
fn halving<T>(
    cell: &PolygoniseSettings,
    by: impl Fn(&PolygoniseSettings, i32) -> Result<T, Error>,
) -> Result<T, Error> {
    let mut found = by(cell, 0);
    for halvings in 1..=HALVINGS {
        if found.as_ref().is_err_and(Error::is_unresolved) {
            let half = PolygoniseSettings { cell_mm: cell.cell_mm * 0.5_f64.powi(halvings), ..cell.clone() };
            found = by(&half, halvings);
        }
    }
    found
}

/// The mesh on one lattice, cut and capped.
fn closed(
    (field, bounded): (&dyn Field, &Bounded<'_>),
    seeds: &[P3],
    cuts: &[CutPlane],
    cell: &PolygoniseSettings,
    ctx: &Ctx,
) -> Result<(TriMesh, Vec<Cap>, PolygoniseReport), Error> {
    let (raw, polygonised) = polygonise(bounded, seeds, cell, &ctx.part(0.0, 0.5))?;
    let (mesh, report) = cut(&raw, field, cuts, &ctx.part(0.5, 1.0))?;
    Ok((mesh, report.caps, polygonised))
}

impl Shell {
    /// Number the caps by a key of theirs, those with the same one as before.
    pub fn number_by(&mut self, key: impl Fn(&Cap) -> u32) {
        self.caps.sort_by_key(|cap| (key(cap), cap.face_id));
        let mut id_of = vec![WALL; self.caps.len() + 1];
        for (cap, id) in self.caps.iter_mut().zip(1..) {
            id_of[cap.face_id as usize] = id;
            cap.face_id = id;
        }
        self.mesh.face_id.iter_mut().for_each(|id| *id = id_of[*id as usize]);
    }
}
