//! From a scan to all artefacts.

use crate::ends::{self, Ends};
use crate::memory::Memory;
use crate::mesh_fault::MeshFault;
use crate::patches::{self, Patched};
use crate::step::{Steps, peak_memory_bytes};
use crate::{Failure, Observer, folder};
use crate::{facts, source};
use artefact::plan::Plan;
use artefact::read::{InputReport, Limits};
use artefact::write::{self, NamedBytes, Provenance};
use artefact::{Reconstruction, reconstruction::SurfaceData};
use exec::Ctx;
use imaging::{Contours, Stack};
use implicit::{Draws, Field, Sampled, Smoothing, Variational};
use morphometry::Morphometry;
use serde_json::{Value, json};
use skeleton::{CapHint, MedialGraph};
use space::{FaultKind, Faulty, P3, Place, Warning};
use std::path::{Path, PathBuf};
use std::sync::Arc;
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

/// The whole reconstruction: reads `inputs`, writes every artefact into the folder `out`, which appears whole or not at
/// all. Gives back result.json.
///
/// # Errors
/// [`Failure`] of any stage; nothing is left behind.
pub fn run(inputs: &[PathBuf], plan: &Plan, out: &Path, ctx: &Ctx, observer: Observer<'_>) -> Result<Value, Failure> {
    run_after(None, inputs, plan, out, ctx, observer)
}

/// [`run`] after an earlier one on the same scan: what only the scan and the settings in common decide is taken from its
/// field.bin (a file, or the folder that holds it), where there is one of this very program. The artefacts have the same bytes.
///
/// # Errors
/// As [`run`].
pub fn run_after(
    earlier: Option<&Path>,
    inputs: &[PathBuf],
    plan: &Plan,
    out: &Path,
    ctx: &Ctx,
    observer: Observer<'_>,
) -> Result<Value, Failure> {
    folder::refuse_foreign(out)?;
    let memory = Arc::new(Memory::of(earlier));
    let (files, result) = reconstruct(inputs, plan, &memory, &ctx.clone().with_recall(memory.clone()), observer)?;
    folder::publish(out, &files)?;
    observer(&crate::Event { stage: "done", progress: 1.0, eta_s: Some(0.0) });
    Ok(result)
}

/// Section 3 of the paper.
fn reconstruct(
    inputs: &[PathBuf],
    plan: &Plan,
    memory: &Memory,
    ctx: &Ctx,
    observer: Observer<'_>,
) -> Result<(Vec<NamedBytes>, Value), Failure> {
    let started_at = facts::now_utc();
    refuse_unmade(plan)?;
    let mut steps = Steps::new(ctx, observer);

    let source = match &plan.variant {
        None => source::scanned(inputs, plan, &mut steps)?,
        Some(variant) => source::changed(inputs, plan, variant, &mut steps)?,
    };
    let (mut contours, plan) = (source.contours, &source.plan);
    let (f, fit, ensemble) =
        steps.step("fit", |ctx| implicit::fit_with_ensemble(&contours, &fit_settings(), source.draws, ctx))?;
    let raw = steps.step("polygonise", |ctx| raw_surface(&f, &contours, ctx))?;
    let (sampled, image, ends) = steps.step("smooth", |ctx| {
        let (sampled, image) = smoothed(&f, &raw, &contours, plan, &ctx.part(0.0, 0.8))?;
        let seeds = within(&contours, f.inner());
        let ends = ends::ends(&plan.ends.cut_mm, &sampled, &contours, &seeds, &ctx.part(0.8, 1.0))?;
        Ok::<_, MeshFault>((sampled, image.kept(&ends), ends))
    })?;
    contours.cuts.extend(&ends.cuts);
    let mut seeds = Seeds::new(&f, &contours, &ends);
    let wall = steps.step("mesh", |ctx| {
        let given = ends.cuts.len();
        rimmed(&f, (&mut seeds, &ends), &image, (&mut contours, given), plan, ctx)
    })?;
    let contours = contours;
    let (graph, medial, patched) = steps.step("skeleton", |ctx| {
        let (graph, medial) = medial_lines(&sampled, &seeds.inner, &contours, &wall, &ctx.part(0.0, 0.8))?;
        let patched = patches::patched(&wall, &contours, &graph, &ctx.part(0.8, 1.0))?;
        Ok::<_, MeshFault>((graph, medial, patched))
    })?;
    let morphometry = steps.step("measure", |ctx| {
        let draws: Option<&dyn Draws> = if source.draws > 0 { Some(&ensemble) } else { None };
        morphometry::measure_with_bands(&graph, &sampled, &contours.cuts, draws, &plan.morphometry(), ctx)
    })?;

    let told = source.warnings.into_iter();
    let warnings: Vec<Warning> = (told.chain(wall.warnings.clone()).chain(medial.warnings))
        .chain(patched.warnings.clone())
        .chain(between_slices(&morphometry, &contours))
        .collect();
    let digest = source.input.digest.clone();
    let mut files = steps.step("write", |_| {
        let reconstruction = Reconstruction {
            input: source.input,
            segmentation: source.segmentation,
            contours: &contours,
            implicit: facts::implicit(&fit),
            surface: surface_data(&wall, contours.pixel_mm, &graph, &morphometry, &patched),
            graph: &graph,
            morphometry: &morphometry,
            warnings: &warnings,
            pictures: source.pictures,
            atlas: source.atlas,
            variant: plan.variant.clone(),
        };
        let mut files = write::write_all(&reconstruction)?;
        files.extend(write::write_asked(&reconstruction, &plan.outputs)?);
        Ok::<_, write::Error>(files)
    })?;
    files.extend(variants(&wall).map_err(|e| Failure::of(&e))?);
    files.extend(memory.artefact(plan.outputs.iter().any(|o| o == "field")));
    let result = files
        .first()
        .and_then(|f| serde_json::from_slice(&f.bytes).ok())
        .ok_or_else(|| Failure::internal("result.json cannot be read back"))?;
    let provenance = Provenance {
        version: env!("CARGO_PKG_VERSION").into(),
        host_os: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        threads: ctx.threads(),
        started_at,
        finished_at: Some(facts::now_utc()),
        input_digest: digest,
        plan: plan.clone(),
        recalled: memory.recalled(),
        stages: steps.times.iter().map(facts::stage).collect(),
        peak_memory_bytes: Some(peak_memory_bytes()),
    };
    files.push(write::provenance(&provenance, &files).map_err(|e| Failure::of(&e))?);
    Ok((files, result))
}

/// The surface in its other forms: open, and with flow extensions.
fn variants(wall: &Wall) -> Result<Vec<NamedBytes>, write::Error> {
    let mut files = vec![write::mesh_vtp(write::SURFACE_OPEN_VTP, &surface::open(&wall.mesh))?];
    if let Some(e) = &wall.extended {
        files.push(write::mesh_vtp(write::SURFACE_EXTENDED_VTP, &e.mesh)?);
    }
    Ok(files)
}

/// Most constraints of a fit. Every value of f costs a sum over all of them: with the 36,000 of an aorta whose planes
/// lie .9 mm apart the image of f takes five times as long as with 8,000 (docs/adr/0022).
const MOST_CONSTRAINTS: usize = 12_000;

fn fit_settings() -> implicit::Settings {
    implicit::Settings { max_constraints: MOST_CONSTRAINTS, ..implicit::Settings::default() }
}

/// What this version cannot make is refused, not left out in silence.
fn refuse_unmade(plan: &Plan) -> Result<(), Failure> {
    let refuse = |field: &str, message: &str| {
        let mut failure = Failure::new(FaultKind::Input, "plan.unsupported", message.to_owned());
        failure.place = space::Place::field(field);
        Err(failure)
    };
    if plan.outputs.iter().any(|o| o == "volume") {
        return refuse("outputs", "this version makes no volume mesh: leave `volume` out of the plan's outputs");
    }
    Ok(())
}

/// The function past the data's ends means nothing: close it just outside the cuts.
fn bounded<'a>(field: &'a dyn Field, contours: &Contours) -> Bounded<'a> {
    Bounded::new(field, &contours.cuts, 4.0 * contours.pixel_mm)
}

/// The zero level of f as it was fitted, polygonised at one pixel; its vertices tell where the wall is.
fn raw_surface(f: &Variational, contours: &Contours, ctx: &Ctx) -> Result<TriMesh, surface::Error> {
    let settings = PolygoniseSettings { cell_mm: contours.pixel_mm, ..PolygoniseSettings::default() };
    Ok(surface::polygonise(&bounded(f, contours), f.wall(), &settings, ctx)?.0)
}

/// f as a 3D image, and the same image smoothed within the plan's bound.
fn smoothed(
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
struct Image {
    smoothing: Smoothing,
    wall: Vec<P3>,
    sampled: Sampled,
}

impl Image {
    /// Only wall that is kept tells how far it may be smoothed.
    fn kept(self, ends: &Ends) -> Self {
        let wall = self.wall.into_iter().filter(|&p| ends.keeps(p)).collect();
        Self { wall, ..self }
    }
}

/// Points from which wall and lumen are grown: those of the fit on what is kept.
struct Seeds {
    wall: Vec<P3>,
    inner: Vec<P3>,
}

impl Seeds {
    fn new(f: &Variational, contours: &Contours, ends: &Ends) -> Self {
        let kept = |points: &[P3]| points.iter().copied().filter(|&p| ends.keeps(p)).collect::<Vec<_>>();
        Self { wall: kept(f.wall()), inner: kept(&within(contours, f.inner())) }
    }
}

/// Wall points on the inner side of every cut plane: only there is the wall known.
fn within(contours: &Contours, points: &[P3]) -> Vec<P3> {
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
fn rimmed(
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

/// Medial lines of the unsmoothed image of f: the numbers come from the data, not from the smoothed wall.
fn medial_lines(
    sampled: &Sampled,
    seeds: &[P3],
    contours: &Contours,
    wall: &Wall,
    ctx: &Ctx,
) -> Result<(MedialGraph, skeleton::Report), skeleton::Error> {
    let caps: Vec<CapHint> = wall
        .caps
        .iter()
        .filter(|c| wall.beside.iter().all(|&[small, _]| small != c.face_id))
        .map(|c| CapHint { face_id: c.face_id, centroid: c.centroid, normal: c.plane.outward })
        .collect();
    skeleton::medial_graph(sampled, &contours.cuts, &caps, seeds, &skeleton::Settings::default(), ctx)
}

/// A vessel more than so many degrees from the normal of the contours' planes ...
const ALONG_PLANES_DEG: f64 = 60.0;
/// ... and narrower than so many of their distances is seen by too few of them: grafts of 4.2 to 4.9 mm at 78 to 81 degrees to slices
/// 2.8 mm apart have areas 5 to 7.5 % too large, beyond their bands.
const PLANES_ACROSS: f64 = 2.0;

/// Branches that run within the slices and are hardly wider than the slices are apart.
fn between_slices(morphometry: &Morphometry, contours: &Contours) -> Vec<Warning> {
    let [Some(first), Some(last)] = [contours.planes.first(), contours.planes.last()] else { return Vec::new() };
    let normal = first.normal();
    let apart = (last.origin - first.origin).dot(normal).abs() / (contours.planes.len().max(2) - 1) as f64;
    let thin = |b: &morphometry::Branch| {
        let mut along: Vec<f64> = b.sections.iter().map(|s| s.tangent.dot(normal).abs()).collect();
        along.sort_by(f64::total_cmp);
        let angle_deg = along.get(along.len() / 2)?.min(1.0).acos().to_degrees();
        let diameter = b.diameter_mm.filter(|d| angle_deg > ALONG_PLANES_DEG && *d < PLANES_ACROSS * apart)?;
        let message = format!(
            "branch {} runs at {angle_deg:.0} degrees to the slices' normal and is {diameter:.1} mm wide, where slices are {apart:.1} mm apart: too few of them cross it, its areas may be 8 % too large and its angles some degrees off; take thinner slices or slices across it",
            b.id
        );
        Some(Warning { code: "sections.between_slices", message, place: Place::element(b.id) })
    };
    morphometry.branches.iter().filter_map(thin).collect()
}

fn surface_data<'a>(
    wall: &'a Wall,
    pixel_mm: f64,
    graph: &MedialGraph,
    morphometry: &Morphometry,
    patched: &'a Patched,
) -> SurfaceData<'a> {
    SurfaceData {
        mesh: &wall.mesh,
        quality: facts::surface(wall, pixel_mm, graph, morphometry),
        displacement_mm: &wall.displacement.mm,
        displacement_px: &wall.displacement.px,
        patches: Some(facts::patches(&wall.patches)),
        quads: patched.facts(),
    }
}

/// What is understood of a scan and a plan.
pub struct Understood {
    /// Input, segmentation (null where it was refused) and warnings, as `validate --json` prints them.
    pub facts: Value,
    /// Why no contours were found in a scan that could be read.
    pub refusal: Option<Failure>,
    /// The stack as it was read.
    pub stack: Stack,
    /// The label mask that came with it.
    pub mask: Option<imaging::Mask>,
    /// The contours, where they were looked for and found.
    pub contours: Option<Contours>,
}

/// What is understood of a scan and a plan, without a reconstruction: slices, spacing, orientation, lumens found. A scan
/// that is read but shows no vessel still has its input told, so that geometry can be checked without one.
///
/// # Errors
/// [`Failure`] of the plan or of reading.
pub fn validate(inputs: &[PathBuf], plan: &Plan, ctx: &Ctx) -> Result<Understood, Failure> {
    refuse_unmade(plan)?;
    if plan.variant.is_some() {
        let message = "a variant is checked when it is made: leave `variant` out to have a scan checked";
        let mut failure = Failure::new(FaultKind::Input, "plan.unsupported", message.to_owned());
        failure.place = space::Place::field("variant");
        return Err(failure);
    }
    let (stack, input) = artefact::read::stack(inputs, plan, &Limits::default()).map_err(|e| Failure::of(&e))?;
    Ok(segmented(stack, input, plan, ctx))
}

fn segmented(stack: Stack, input: InputReport, plan: &Plan, ctx: &Ctx) -> Understood {
    let outcome = imaging::contours(&stack, &input.imaging(plan), ctx);
    let facts = understood(&stack, &input, outcome.as_ref().ok());
    let (contours, refusal) = match outcome {
        Ok((contours, _)) => (Some(contours), None),
        Err(e) => (None, Some(Failure::of(&e))),
    };
    Understood { facts, refusal, stack, mask: input.mask, contours }
}

/// Most pixels of a scan whose contours are looked for before it is sent: some seconds on one thread.
const MOST_SEGMENTED: usize = 24 << 20;

/// As [`validate`], for files in memory; a scan of more than [`MOST_SEGMENTED`] pixels is only read.
///
/// # Errors
/// [`Failure`] of the plan or of reading.
pub fn understand(files: Vec<NamedBytes>, plan: &Plan, limits: &Limits, ctx: &Ctx) -> Result<Understood, Failure> {
    refuse_unmade(plan)?;
    let (stack, input) = artefact::read::stack_of(files, plan, limits).map_err(|e| Failure::of(&e))?;
    if stack.pixels.len() > MOST_SEGMENTED {
        let facts = understood(&stack, &input, None);
        return Ok(Understood { facts, refusal: None, stack, mask: input.mask, contours: None });
    }
    Ok(segmented(stack, input, plan, ctx))
}

/// As [`validate`], but nothing is segmented: the input alone, for comparison with other programs' readers.
///
/// # Errors
/// [`Failure`] of reading.
pub fn input(inputs: &[PathBuf], plan: &Plan) -> Result<Understood, Failure> {
    let (stack, input) = artefact::read::stack(inputs, plan, &Limits::default()).map_err(|e| Failure::of(&e))?;
    Ok(Understood { facts: understood(&stack, &input, None), refusal: None, stack, mask: input.mask, contours: None })
}

fn understood(stack: &Stack, input: &InputReport, found: Option<&(Contours, imaging::Report)>) -> Value {
    let segmentation = found.map(|(contours, report)| {
        let facts = facts::segmentation(contours, report);
        json!({
            "axis": facts.axis, "threshold": facts.threshold, "psf_sigma_px": facts.psf_sigma_px,
            "contours": facts.contours,
            "lumens": facts.lumens.iter().map(|[s, n]| json!({"slice": s, "count": n})).collect::<Vec<_>>(),
        })
    });
    let warnings: Vec<Value> = told(input, found.map(|(_, report)| report))
        .map(|w| json!({"code": w.code, "message": w.message, "where": artefact::problem::Where::of(&w.place)}))
        .collect();
    json!({
        "input": {
            "format": input.format.name(), "slices": input.slices, "rows": stack.rows, "columns": stack.columns,
            "missing_slices": input.missing_slices, "spacing_mm": input.spacing_mm, "digest": input.digest,
            "corners_mm": corners(stack),
            "row_direction": stack.row_direction.to_array(), "column_direction": stack.column_direction.to_array(),
            "thickness_mm": stack.thickness_mm,
            "mask_voxels": input.mask.as_ref().map(|m| m.inside().iter().filter(|&&i| i).count()),
        },
        "segmentation": segmentation,
        "warnings": warnings,
    })
}

/// The reader's and the segmentation's warnings. Both tell gaps: the segmentation knows also those of slices that the plan
/// leaves out, so that its word is the one to keep.
pub(crate) fn told<'a>(
    input: &'a InputReport,
    found: Option<&'a imaging::Report>,
) -> impl Iterator<Item = &'a Warning> {
    let later = found.map_or(&[][..], |r| &r.warnings);
    let again = move |w: &&Warning| w.code == "stack.gap" && later.iter().any(|l| l.code == w.code);
    input.warnings.iter().filter(move |w| !again(w)).chain(later)
}

/// Centres of the eight corner voxels, LPS mm: first and last slice, in each first and last row, in each first and last
/// column.
fn corners(stack: &Stack) -> Vec<[f64; 3]> {
    let ends = |n: usize| [0, n.saturating_sub(1)];
    let of_row = |k: usize, r: usize| ends(stack.columns).map(|c| stack.position(k, r as f64, c as f64).to_array());
    let of_slice = |k: usize| ends(stack.rows).into_iter().flat_map(move |r| of_row(k, r));
    ends(stack.slices()).into_iter().flat_map(of_slice).collect()
}
