//! `vasculum phantom`: a simulated scan as files, with its truth.

use crate::arguments::{Image, Phantom};
use anyhow::{Context, Result};
use artefact::plan::{Plan, Roles};
use artefact::write::dicom::{Meta, Numbering};
use exec::Ctx;
use phantom::{Kind, Settings, Truth};
use serde_json::{Map, Value, json};
use space::{P3, V3};
use std::fs;
use std::path::Path;
use std::process::ExitCode;

/// Write the scan as DICOM, PNG + plan and NIfTI, with truth.json and a plan.json that names the branches.
pub(crate) fn write(a: &Phantom) -> ExitCode {
    let outcome = a.kind.parse::<Kind>().map_err(anyhow::Error::from).and_then(|kind| {
        let kind = match (kind, a.image.seed) {
            (Kind::Random(_), Some(seed)) => Kind::Random(seed),
            (kind, _) => kind,
        };
        folder(kind, &settings(kind, &a.image), &a.out)
    });
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("vasculum: {e:#}");
            ExitCode::from(2)
        }
    }
}

/// The kind's defaults with what was asked for.
pub(crate) fn settings(kind: Kind, image: &Image) -> Settings {
    let mut s = Settings::of(kind);
    s.seed = image.seed.unwrap_or(s.seed);
    s.snr = image.snr.or(s.snr);
    s.columns = image.size.unwrap_or(s.columns);
    s.rows = image.size.unwrap_or(s.rows);
    s.slices = image.slices.unwrap_or(s.slices);
    s.pixel_mm = image.pixel.unwrap_or(s.pixel_mm);
    if let Some(spacing) = image.spacing {
        (s.slice_spacing_mm, s.thickness_mm) = (spacing, spacing);
    }
    s.thickness_mm = image.thickness.unwrap_or(s.thickness_mm);
    s.distractors = image.distractors.unwrap_or(s.distractors);
    s.tilt_deg = image.tilt.unwrap_or(s.tilt_deg);
    if !image.missing.is_empty() {
        s.missing_slices.clone_from(&image.missing);
    }
    s
}

/// Simulate and write.
pub(crate) fn folder(kind: Kind, settings: &Settings, out: &Path) -> Result<()> {
    let (stack, truth) = phantom::scan(kind, settings, &Ctx::new(0)?)?;
    let meta = Meta { seed: settings.seed, description: kind.name(), numbering: Numbering::Interleaved };
    write_files(&out.join("dicom"), artefact::write::dicom::slices(&stack, &meta)?)?;
    write_files(&out.join("png"), artefact::write::png::slices(&stack)?)?;
    let mut plan = artefact::write::png::plan(&stack);
    plan.roles = roles(&truth);
    fs::write(out.join("png/plan.json"), plan_json(&plan)?)?;
    fs::write(out.join("scan.nii"), artefact::write::nifti::volume(&stack)?)?;
    fs::write(out.join("scan.mha"), artefact::write::metaimage::volume(&stack)?)?;
    let plan = Plan { roles: roles(&truth), ..Plan::default() };
    fs::write(out.join("plan.json"), plan_json(&plan)?)?;
    let mut told = truth_json(&truth);
    told["scan"] = scan_json(settings);
    fs::write(out.join("truth.json"), format!("{told:#}\n"))?;
    Ok(())
}

/// How the scan was taken: mm, SNR as in the settings, null without noise.
fn scan_json(settings: &Settings) -> Value {
    json!({"pixel_mm": settings.pixel_mm, "slice_spacing_mm": settings.slice_spacing_mm,
           "thickness_mm": settings.thickness_mm, "snr": settings.snr, "psf_sigma_px": settings.psf_sigma_px,
           "distractors": settings.distractors, "seed": settings.seed})
}

fn write_files(folder: &Path, files: Vec<artefact::read::NamedBytes>) -> Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for file in files {
        fs::write(folder.join(&file.name), file.bytes)?;
    }
    Ok(())
}

fn plan_json(plan: &Plan) -> Result<String> {
    Ok(serde_json::to_string_pretty(plan)? + "\n")
}

fn roles(truth: &Truth) -> Roles {
    let Some(j) = &truth.junction else { return Roles::default() };
    Roles {
        graft_mm: Some(j.graft_point.to_array()),
        proximal_mm: Some(j.proximal_point.to_array()),
        distal_mm: Some(j.distal_point.to_array()),
        flow_from_mm: None,
    }
}

/// truth.json: angles in degrees, lengths in mm, LPS.
pub(crate) fn truth_json(truth: &Truth) -> Value {
    let point = |p: P3| json!(p.to_array());
    let vector = |v: V3| json!(v.to_array());
    let branches: Vec<Value> = truth
        .branches
        .iter()
        .map(|b| {
            json!({"role": b.role.name(), "from": point(b.from), "to": point(b.to), "direction": vector(b.direction),
                   "length_mm": b.length_mm, "radius_mm": b.radius_mm, "area_mm2": b.area_mm2,
                   "circular_from_mm": b.circular_from_mm})
        })
        .collect();
    let radii: Map<String, Value> =
        truth.branches.iter().map(|b| (b.role.name().to_owned(), json!(b.radius_mm))).collect();
    let angles: Map<String, Value> = truth
        .junction
        .iter()
        .flat_map(|j| j.angles.named())
        .map(|(name, value)| (name.to_owned(), json!(value)))
        .collect();
    let junction = truth
        .junction
        .as_ref()
        .map(|j| json!({"axes_point": point(j.axes_point), "plane_normal": vector(j.plane_normal)}));
    let helix = truth.helix.as_ref().map(|h| {
        json!({"curvature_per_mm": h.curvature_per_mm, "torsion_per_mm": h.torsion_per_mm, "radius_mm": h.radius_mm,
               "pitch_mm": h.pitch_mm})
    });
    json!({"kind": truth.kind, "frame": "LPS", "angles": angles, "radii_mm": radii, "branches": branches,
           "junction": junction, "helix": helix, "noise_sigma": truth.noise_sigma, "half_level": truth.half_level,
           "missing_slices": truth.missing_slices})
}
