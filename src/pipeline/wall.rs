//! The wall of the lumen: f as a 3D image, smoothed within the plan's bound, cut where the data end, meshed, measured.

use crate::mesh_fault::MeshFault;
use crate::openings::{Openings, Planes};
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
    pub(crate) ends: Openings,
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

/// Points from which wall and lumen are grown: those of the fit on what is kept.
pub(crate) struct Seeds {
    pub(crate) wall: Vec<P3>,
    pub(crate) inner: Vec<P3>,
}

impl Seeds {
    pub(crate) fn new(f: &Variational, planes: &Planes) -> Self {
        let kept = |points: &[P3]| points.iter().copied().filter(|&p| planes.keeps(p)).collect::<Vec<_>>();
        let (cuts, mut inner) = (planes.all(), kept(f.inner()));
        inner.retain(|&p| cuts.iter().all(|c| !c.excludes(p)));
        Self { wall: kept(f.wall()), inner }
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

/// Where the planes cut the unsmoothed wall; where they only graze it others are taken.
pub(crate) fn openings(
    (f, sampled): (&Variational, &Sampled),
    planes: &mut Planes,
    pixel_mm: f64,
    ctx: &Ctx,
) -> Result<Openings, surface::Error> {
    let cell = PolygoniseSettings { cell_mm: pixel_mm, ..PolygoniseSettings::default() };
    loop {
        let seeds = Seeds::new(f, planes);
        match surface::openings(sampled, &seeds.wall, &planes.of_data(), &cell, ctx) {
            Ok((mesh, caps)) => return Ok(Openings::new(&mesh, caps)),
            Err(fault) => planes.retreat(&fault).ok_or(fault)?,
        }
    }
}

/// The finished wall; where a plane leaves it without a rim others are taken.
pub(crate) fn rimmed(
    f: &Variational,
    image: &Image,
    (planes, openings): (&mut Planes, &Openings),
    plan: &Plan,
    ctx: &Ctx,
) -> Result<Wall, MeshFault> {
    loop {
        match wall(f, image, (planes, openings), plan, ctx) {
            Err(MeshFault::Surface(fault)) => planes.retreat(&fault).ok_or(fault)?,
            other => return other,
        }
    }
}

/// The wall: smoothed, cut by the planes, capped, remeshed, measured.
fn wall(f: &Variational, image: &Image, ends: (&Planes, &Openings), plan: &Plan, ctx: &Ctx) -> Result<Wall, MeshFault> {
    let seeds = Seeds::new(f, ends.0);
    let pixel_mm = image.smoothing.pixel_mm;
    // only wall that is kept tells how far it may be smoothed
    let kept: Vec<P3> = image.wall.iter().copied().filter(|&p| ends.0.keeps(p)).collect();
    let shell_of = |field: &Sampled, ctx: &Ctx| shell_of(field, (f, &seeds, pixel_mm), ends, plan, ctx);
    let mut limit = if image.smoothing.max_displacement_px > 0.0 { f64::INFINITY } else { 0.0 };
    for _ in 0..ATTEMPTS {
        let (field, report) = if limit > 0.0 {
            implicit::smooth(&image.sampled, &kept, &image.smoothing, limit, &ctx.part(0.0, 0.3))?
        } else {
            break;
        };
        limit = report.sigma_mm * RETREAT;
        let shell = match shell_of(&field, &ctx.part(0.3, 0.9)) {
            // two lumens that all but touch: another smoothing parts or joins them
            Err(e) if e.is_unresolved() => continue,
            shell => shell?,
        };
        let moved = shell.displacement.min_mm.abs().max(shell.displacement.max_mm.abs());
        if moved <= image.smoothing.max_displacement_px * pixel_mm {
            let back = TriMesh { vertices: kept, ..TriMesh::default() };
            let back = surface::displacement(&back, &field, pixel_mm, ctx)?;
            let moved = moved.max(back.max_mm.max(-back.min_mm));
            return Ok(measured(shell, field, moved, plan, &ctx.part(0.9, 1.0))?);
        }
    }
    let shell = shell_of(&image.sampled, &ctx.part(0.0, 0.9))?;
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
    (f, seeds, pixel_mm): (&Variational, &Seeds, f64),
    (planes, openings): (&Planes, &Openings),
    plan: &Plan,
    ctx: &Ctx,
) -> Result<Shell, surface::Error> {
    let cell = PolygoniseSettings { cell_mm: pixel_mm, ..PolygoniseSettings::default() };
    let settings = RemeshSettings {
        edge_mm: plan.surface.edge_mm,
        max_error_mm: plan.surface.max_error_mm,
        sizing: Sizing::Curvature,
        ..RemeshSettings::default()
    };
    let mut shell = surface::shell(field, &seeds.wall, &planes.all(), &cell, &settings, &ctx.part(0.0, 0.8))?;
    // by where vessels leave the data: how far an end is set back depends on noise
    shell.number_by(|cap| planes.opening_of(cap, openings).unwrap_or(u32::MAX));
    let surface::Shell { mesh, caps, .. } = shell;
    let displacement = surface::displacement(&mesh, f, pixel_mm, &ctx.part(0.8, 1.0))?;
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
    let ends = Openings::new(&mesh, caps);
    let field = plan.outputs.iter().any(|o| o == "patches").then_some(field);
    Ok(Wall { mesh, ends, topology, quality, displacement, hausdorff_mm, patches, extended, warnings, field })
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
