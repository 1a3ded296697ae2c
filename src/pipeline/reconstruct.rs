//! From a scan to all artefacts.

use crate::ends;
use crate::memory::Memory;
use crate::mesh_fault::MeshFault;
use crate::openings::{Openings, Planes, settle};
use crate::patches::{self, Patched};
use crate::step::{Steps, peak_memory_bytes};
use crate::wall::{Seeds, Wall, openings, raw_surface, rimmed, smoothed, within};
use crate::{Failure, Observer, folder};
use crate::{facts, source};
use artefact::plan::Plan;
use artefact::read::{InputReport, Limits};
use artefact::write::{self, NamedBytes, Provenance};
use artefact::{Reconstruction, reconstruction::SurfaceData};
use exec::Ctx;
use imaging::{Contours, Stack};
use implicit::{Draws, Sampled, Variational};
use morphometry::Morphometry;
use serde_json::{Value, json};
use skeleton::MedialGraph;
use space::{FaultKind, Place, Warning};
use std::path::{Path, PathBuf};
use std::sync::Arc;

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
    let (contours, plan) = (source.contours, &source.plan);
    let (f, fit, ensemble) =
        steps.step("fit", |ctx| implicit::fit_with_ensemble(&contours, &fit_settings(), source.draws, ctx))?;
    let raw = steps.step("polygonise", |ctx| raw_surface(&f, &contours, ctx))?;
    let (sampled, image, mut planes) = steps.step("smooth", |ctx| {
        let (sampled, image) = smoothed(&f, &raw, &contours, plan, &ctx.part(0.0, 0.8))?;
        let seeds = within(&contours, f.inner());
        let given = ends::ends(&plan.ends.cut_mm, &sampled, &contours, &seeds, &ctx.part(0.8, 1.0))?;
        Ok::<_, MeshFault>((sampled, image, Planes::new(&contours.cuts, given)))
    })?;
    let (openings, mut graph, medial) = steps.step("skeleton", |ctx| {
        let openings = openings((&f, &sampled), &mut planes, contours.pixel_mm, &ctx.part(0.0, 0.2))?;
        let (graph, medial) = medial_lines(&f, &sampled, (&planes, &openings), &ctx.part(0.2, 1.0))?;
        planes.square(&graph, &openings, &sampled, contours.pixel_mm);
        Ok::<_, MeshFault>((openings, graph, medial))
    })?;
    let of_data = planes.of_data();
    let (wall, patched, lost) = steps.step("mesh", |ctx| {
        let wall = rimmed(&f, &image, (&mut planes, &openings), plan, &ctx.part(0.0, 0.8))?;
        let lost = settle(&mut graph, &wall, (&planes, &openings), &sampled)?;
        let patched = patches::patched(&wall, &planes.all(), &graph, &ctx.part(0.8, 1.0))?;
        Ok::<_, MeshFault>((wall, patched, lost))
    })?;
    let morphometry = steps.step("measure", |ctx| {
        let draws: Option<&dyn Draws> = if source.draws > 0 { Some(&ensemble) } else { None };
        morphometry::measure_with_bands(&graph, &sampled, &of_data, draws, &plan.morphometry(), ctx)
    })?;
    let surface = surface_data(&wall, (&planes, &openings), contours.pixel_mm, &graph, &morphometry, &patched);

    let told = source.warnings.into_iter();
    let warnings: Vec<Warning> = (told.chain(planes.warnings()).chain(wall.warnings.clone()))
        .chain(medial.warnings)
        .chain(lost)
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
            surface,
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

/// Medial lines of the unsmoothed image of f: the numbers come from the data, not from the smoothed wall.
fn medial_lines(
    f: &Variational,
    sampled: &Sampled,
    (planes, openings): (&Planes, &Openings),
    ctx: &Ctx,
) -> Result<(MedialGraph, skeleton::Report), skeleton::Error> {
    let (cuts, seeds) = (planes.of_data(), Seeds::new(f, planes).inner);
    skeleton::medial_graph(sampled, &cuts, &openings.hints(), &seeds, &skeleton::Settings::default(), ctx)
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
    ends: (&Planes, &Openings),
    pixel_mm: f64,
    graph: &MedialGraph,
    morphometry: &Morphometry,
    patched: &'a Patched,
) -> SurfaceData<'a> {
    SurfaceData {
        mesh: &wall.mesh,
        quality: facts::surface(wall, ends, pixel_mm, graph, morphometry),
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
