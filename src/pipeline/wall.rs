//! The wall of the lumen: f as a 3D image, smoothed within the plan's bound, cut where the data end, meshed, measured.

use crate::ends::Ends;
use crate::mesh_fault::MeshFault;
use artefact::plan::Plan;
use exec::Ctx;
use imaging::Contours;
use implicit::{Field, Sampled, Smoothing, Variational};
use space::{FaultKind, Faulty, P3, Place, Warning};
use surface::{
    Bounded, Displacement, Extension, PolygoniseSettings, Quality, RemeshSettings, Sizing, Topology, TriMesh,
};

/// The surface with all that is known of it.
pub(crate) struct Wall {
    pub(crate) mesh: TriMesh,
    pub(crate) caps: Vec<surface::Cap>,
    /// Caps (face ids) that share a corner of the volume with a larger one: the same vessel ends at both.
    pub(crate) beside: Vec<[u32; 2]>,
    pub(crate) topology: Topology,
    pub(crate) quality: Quality,
    pub(crate) displacement: Displacement,
    /// Hausdorff distance to the unsmoothed wall, both ways, mm.
    pub(crate) hausdorff_mm: f64,
    pub(crate) patches: surface::Patches,
    /// The wall with flow extensions, where they were asked for and have room.
    pub(crate) extended: Option<surface::Extended>,
    /// Why there are none, where they were asked for.
    pub(crate) warnings: Vec<Warning>,
    /// The field on whose zero level it lies, kept where patches are asked for.
    pub(crate) field: Option<Sampled>,
}

/// The function past the data's ends means nothing: close it just outside the cuts.
fn bounded<'a>(field: &'a dyn Field, contours: &Contours) -> Bounded<'a> {
    Bounded::new(field, &contours.cuts, 4.0 * contours.pixel_mm)
}

/// The zero level of f as it was fitted, polygonised at one pixel; its vertices tell where the wall is.
pub(crate) fn raw_surface(f: &Variational, contours: &Contours, ctx: &Ctx) -> Result<TriMesh, surface::Error> {
    let settings = PolygoniseSettings { cell_mm: contours.pixel_mm, ..PolygoniseSettings::default() };
    Ok(surface::polygonise(&bounded(f, contours), f.wall(), &settings, ctx)?.0)
}

/// f as a 3D image, and the same image smoothed within the plan's bound.
pub(crate) fn smoothed(
    f: &Variational,
    raw: &TriMesh,
    contours: &Contours,
    plan: &Plan,
    ctx: &Ctx,
) -> Result<(Sampled, Image), implicit::Error> {
    let smoothing =
        Smoothing { max_displacement_px: plan.smoothing.max_displacement_px, ..Smoothing::new(contours.pixel_mm) };
    let sampled = Sampled::new(f, &raw.vertices, &smoothing.sampling(), &ctx.part(0.0, 0.6))?;
    let inside = within(contours, &raw.vertices);
    // polygons cut corners: only points on the zero level tell how far a filter moves it
    let feet = ctx.map(&inside, |&p| implicit::foot(&sampled, p, contours.pixel_mm))?;
    let kept = feet.into_iter().flatten().collect();
    let image = Image { smoothing, wall: kept, sampled: sampled.clone() };
    Ok((sampled, image))
}

/// What is needed to smooth again with a smaller sigma.
pub(crate) struct Image {
    smoothing: Smoothing,
    wall: Vec<P3>,
    sampled: Sampled,
}

impl Image {
    /// Only wall that is kept tells how far it may be smoothed.
    pub(crate) fn kept(self, ends: &Ends) -> Self {
        let wall = self.wall.into_iter().filter(|&p| ends.keeps(p)).collect();
        Self { wall, ..self }
    }
}

/// Points from which wall and lumen are grown: those of the fit on what is kept.
pub(crate) struct Seeds {
    pub(crate) wall: Vec<P3>,
    pub(crate) inner: Vec<P3>,
}

impl Seeds {
    pub(crate) fn new(f: &Variational, contours: &Contours, ends: &Ends) -> Self {
        let kept = |points: &[P3]| points.iter().copied().filter(|&p| ends.keeps(p)).collect::<Vec<_>>();
        Self { wall: kept(f.wall()), inner: kept(&within(contours, f.inner())) }
    }
}

/// Wall points on the inner side of every cut plane: only there is the wall known.
pub(crate) fn within(contours: &Contours, points: &[P3]) -> Vec<P3> {
    let inside = |p: &&P3| contours.cuts.iter().all(|c| !c.excludes(**p));
    points.iter().filter(inside).copied().collect()
}

/// Attempts at a sigma whose wall keeps the bound on the finished mesh, which has vertices where the bisection had none.
const ATTEMPTS: usize = 6;
/// Factor on sigma between attempts.
const RETREAT: f64 = 0.75;

/// How far a plane at which the data end is moved inward at once, and at most, mm.
const INWARD_MM: [f64; 2] = [1.0, 4.0];

/// The finished wall. Where the data end in a plane that only grazes a vessel there is no rim to speak of: that plane is
/// moved inward, with a warning; not one of the `given` cuts, which are the last and which the plan asks for.
pub(crate) fn rimmed(
    f: &Variational,
    (seeds, ends): (&mut Seeds, &Ends),
    image: &Image,
    (contours, given): (&mut Contours, usize),
    plan: &Plan,
    ctx: &Ctx,
) -> Result<Wall, MeshFault> {
    let first = contours.cuts.len() - given;
    let mut inward = vec![(0.0, Place::default()); first];
    loop {
        let fault = match wall(f, seeds, image, contours, plan, ctx) {
            Err(MeshFault::Surface(e)) => e,
            Ok(mut wall) => {
                let moved = inward.into_iter().filter(|(mm, _)| *mm > 0.0);
                wall.warnings.extend(moved.map(|(mm, place)| Warning {
                    code: "ends.inward",
                    message: format!(
                        "the data end where a vessel's wall only grazes the plane of their end: all vessels are cut {mm:.0} mm further in there"
                    ),
                    place,
                }));
                return Ok(wall);
            }
            other => return other,
        };
        let room = |plane: &usize| inward.get(*plane).is_some_and(|(mm, _)| *mm < INWARD_MM[1]);
        let Some(plane) = fault.without_rim().filter(room) else { return Err(fault.into()) };
        inward[plane] = (inward[plane].0 + INWARD_MM[0], fault.place());
        let cut = &mut contours.cuts[plane];
        cut.point = cut.point - cut.outward * INWARD_MM[0];
        *seeds = Seeds::new(f, contours, ends);
    }
}

/// The wall: smoothed, cut at the data's ends, capped, remeshed, measured.
fn wall(
    f: &Variational,
    seeds: &Seeds,
    image: &Image,
    contours: &Contours,
    plan: &Plan,
    ctx: &Ctx,
) -> Result<Wall, MeshFault> {
    let mut limit = if image.smoothing.max_displacement_px > 0.0 { f64::INFINITY } else { 0.0 };
    for _ in 0..ATTEMPTS {
        let (field, report) = if limit > 0.0 {
            implicit::smooth(&image.sampled, &image.wall, &image.smoothing, limit, &ctx.part(0.0, 0.3))?
        } else {
            break;
        };
        limit = report.sigma_mm * RETREAT;
        let shell = match shell_of(&field, (f, seeds), contours, plan, &ctx.part(0.3, 0.9)) {
            // two lumens that all but touch: another smoothing parts or joins them
            Err(e) if e.is_unresolved() => continue,
            shell => shell?,
        };
        let moved = shell.displacement.min_mm.abs().max(shell.displacement.max_mm.abs());
        if moved <= image.smoothing.max_displacement_px * contours.pixel_mm {
            let back = TriMesh { vertices: image.wall.clone(), ..TriMesh::default() };
            let back = surface::displacement(&back, &field, contours.pixel_mm, ctx)?;
            let moved = moved.max(back.max_mm.max(-back.min_mm));
            return Ok(measured(shell, field, moved, plan, &ctx.part(0.9, 1.0))?);
        }
    }
    let shell = shell_of(&image.sampled, (f, seeds), contours, plan, &ctx.part(0.0, 0.9))?;
    let moved = shell.displacement.min_mm.abs().max(shell.displacement.max_mm.abs());
    Ok(measured(shell, image.sampled.clone(), moved, plan, &ctx.part(0.9, 1.0))?)
}

/// The capped and remeshed surface and how far it lies from the zero level of f as it was fitted.
struct Shell {
    mesh: TriMesh,
    caps: Vec<surface::Cap>,
    displacement: Displacement,
}

fn shell_of(
    field: &Sampled,
    (f, seeds): (&Variational, &Seeds),
    contours: &Contours,
    plan: &Plan,
    ctx: &Ctx,
) -> Result<Shell, surface::Error> {
    let cell = PolygoniseSettings { cell_mm: contours.pixel_mm, ..PolygoniseSettings::default() };
    let settings = RemeshSettings {
        edge_mm: plan.surface.edge_mm,
        max_error_mm: plan.surface.max_error_mm,
        sizing: Sizing::Curvature,
        ..RemeshSettings::default()
    };
    let surface::Shell { mesh, caps, .. } =
        surface::shell(field, &seeds.wall, &contours.cuts, &cell, &settings, &ctx.part(0.0, 0.8))?;
    let displacement = surface::displacement(&mesh, f, contours.pixel_mm, &ctx.part(0.8, 1.0))?;
    Ok(Shell { mesh, caps, displacement })
}

fn measured(shell: Shell, field: Sampled, hausdorff_mm: f64, plan: &Plan, ctx: &Ctx) -> Result<Wall, surface::Error> {
    let Shell { mesh, caps, displacement } = shell;
    let topology = surface::check(&mesh)?;
    let quality = surface::quality(&mesh, &field, ctx)?;
    let ids: Vec<u32> = (0..caps.len() as u32).collect();
    let patches = surface::patches(&mesh, &ids, ctx)?;
    let (extended, mut warnings) = extended(&mesh, &field, caps.len() as u32, plan, ctx)?;
    warnings.extend(missed_tolerance(&quality, plan));
    let beside = beside(&mesh, &caps);
    let field = plan.outputs.iter().any(|o| o == "patches").then_some(field);
    Ok(Wall { mesh, caps, beside, topology, quality, displacement, hausdorff_mm, patches, extended, warnings, field })
}

/// Where triangles stand farther off the wall than the plan allows: its shortest edge forbids shorter ones there.
fn missed_tolerance(quality: &Quality, plan: &Plan) -> Option<Warning> {
    let (off, wanted, shortest) = (quality.face_max_mm, plan.surface.max_error_mm, plan.surface.edge_mm[0]);
    let message = format!(
        "a triangle stands {off:.4} mm off the wall where surface.max_error_mm is {wanted} mm: its edges cannot be shorter; lower the shortest surface.edge_mm of {shortest} mm, or raise the tolerance"
    );
    (off > wanted).then(|| Warning { code: "surface.tolerance", message, place: Place::at(quality.farthest_at) })
}

/// Flow extensions at every cap. They are for solvers: where one has no room the numbers of the scan still stand, so
/// that it is a warning here.
fn extended(
    mesh: &TriMesh,
    field: &Sampled,
    caps: u32,
    plan: &Plan,
    ctx: &Ctx,
) -> Result<(Option<surface::Extended>, Vec<Warning>), surface::Error> {
    let diameters = plan.ends.extension_diameters;
    if diameters <= 0.0 || caps == 0 {
        return Ok((None, Vec::new()));
    }
    let wanted: Vec<Extension> = (1..=caps).map(|face_id| Extension { face_id, diameters }).collect();
    match surface::extend(mesh, field, &wanted, ctx) {
        Ok(e) => Ok((Some(e), Vec::new())),
        Err(e) if e.kind() == FaultKind::Cancelled => Err(e),
        Err(e) => {
            let message = format!("no surface_extended.vtp: {e}");
            Ok((None, vec![Warning { code: e.code(), message, place: e.place() }]))
        }
    }
}

/// Caps that share a rim vertex with a larger one, with the largest such: a vessel that leaves the volume across an edge
/// of it is cut by two planes, and has one end.
fn beside(mesh: &TriMesh, caps: &[surface::Cap]) -> Vec<[u32; 2]> {
    let mut at: Vec<Vec<u32>> = vec![Vec::new(); mesh.vertices.len()];
    for (t, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != surface::WALL) {
        t.iter().for_each(|&v| at[v as usize].push(id));
    }
    let area = |id: u32| caps.iter().find(|c| c.face_id == id).map_or(0.0, |c| c.area_mm2);
    let order = |a: &u32, b: &u32| area(*a).total_cmp(&area(*b)).then(b.cmp(a));
    let larger = |id: u32| at.iter().filter(|ids| ids.contains(&id)).flatten().copied().max_by(order).unwrap_or(id);
    // three planes meet in a corner: the largest may be reached over the middle one
    let largest = |id: u32| (0..3).fold(id, |id, _| larger(id));
    caps.iter().map(|c| [c.face_id, largest(c.face_id)]).filter(|[id, largest]| id != largest).collect()
}
