//! Where the curves come from: a scan, or the sections of a finished reconstruction on changed lines.

use crate::reconstruct::told;
use crate::step::Steps;
use crate::{Failure, facts};
use artefact::plan::{Plan, Roles, Variant};
use artefact::read::{self, Limits};
use artefact::reconstruction::{InputFacts, SegmentationFacts, SlicePicture};
use artefact::write::{self, SECTIONS_JSON};
use imaging::Contours;
use space::{FaultKind, P3, Place, Warning};
use std::path::{Path, PathBuf};

/// Draws from the fit's posterior for the 95 % bands: their standard deviation is known to 1 / sqrt(2 * 24) = 14 %.
const DRAWS: usize = 24;

/// Curves, with what the artefacts tell of where they came from.
pub(crate) struct Source {
    pub(crate) contours: Contours,
    /// The plan in force: a variant finds its roles by itself.
    pub(crate) plan: Plan,
    pub(crate) input: InputFacts,
    pub(crate) segmentation: SegmentationFacts,
    pub(crate) warnings: Vec<Warning>,
    pub(crate) pictures: Vec<SlicePicture>,
    /// All grey planes for viewers; a variant has none.
    pub(crate) atlas: Option<write::Atlas>,
    /// Draws for the bands: none where there is no noise to draw from.
    pub(crate) draws: usize,
}

/// The contours of a scan.
pub(crate) fn scanned(inputs: &[PathBuf], plan: &Plan, steps: &mut Steps<'_>) -> Result<Source, Failure> {
    let (stack, input) = steps.step("read", |_| read::stack(inputs, plan, &Limits::default()))?;
    let (contours, report) = steps.step("contours", |ctx| imaging::contours(&stack, &input.imaging(plan), ctx))?;
    Ok(Source {
        plan: plan.clone(),
        input: facts::input(&input),
        segmentation: facts::segmentation(&contours, &report),
        warnings: told(&input, Some(&report)).cloned().collect(),
        pictures: write::slice_pictures(&stack, &contours).map_err(|e| Failure::of(&e))?,
        atlas: write::contour_atlas(&stack, &contours).map_err(|e| Failure::of(&e))?,
        contours,
        draws: DRAWS,
    })
}

/// The sections of a finished reconstruction on changed medial lines.
pub(crate) fn changed(
    inputs: &[PathBuf],
    plan: &Plan,
    variant: &Variant,
    steps: &mut Steps<'_>,
) -> Result<Source, Failure> {
    let changes = variant.changes().map_err(Failure::plan)?;
    let file = sections_file(inputs)?;
    let bytes = std::fs::read(&file).map_err(|e| Failure::unreadable(&file, &e))?;
    let (model, input) = steps.step("read", |_| read::sections(SECTIONS_JSON, &bytes))?;
    let made = steps.step("contours", |_| morphometry::resynthesise(&model, &changes))?;
    let point = |p: Option<P3>| p.map(P3::to_array);
    let roles = Roles {
        graft_mm: point(made.roles.graft),
        proximal_mm: point(made.roles.proximal),
        distal_mm: point(made.roles.distal),
        flow_from_mm: None,
    };
    Ok(Source {
        plan: Plan { roles, ..plan.clone() },
        input,
        segmentation: facts::rings(&made.contours),
        warnings: vec![unmeasured()],
        pictures: Vec::new(),
        atlas: None,
        contours: made.contours,
        draws: 0,
    })
}

/// Nobody may take a variant for a patient.
fn unmeasured() -> Warning {
    let message = "this vessel was made from a measured one by changing its medial lines; no patient has it, and its bands are not known";
    Warning::new("variant.synthetic", message, Place::none())
}

/// The one sections.json among the inputs, which may be its folder.
fn sections_file(inputs: &[PathBuf]) -> Result<PathBuf, Failure> {
    let file = |p: &Path| if p.is_dir() { p.join(SECTIONS_JSON) } else { p.to_owned() };
    match inputs {
        [one] if file(one).is_file() => Ok(file(one)),
        _ => {
            let message = "a variant is made from one finished reconstruction: give its folder or its sections.json";
            Err(Failure::new(FaultKind::Input, "variant.source", message.to_owned()))
        }
    }
}
