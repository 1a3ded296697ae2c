//! From files to a stack with its report: sort the files out, tell their kind, read, digest.

use super::collect::{collect, expand};
use super::detect::{Kind, is_document, is_plan, kind};
use super::fields::companion;
use super::volume::{Placement, Volume};
use super::{Error, Limits, NamedBytes, archive, dicom, metaimage, nifti, nrrd, pictures};
use crate::plan::{Geometry, Plan};
use imaging::Stack;
use sha2::{Digest, Sha256};
use space::{Place, Warning};
use std::path::PathBuf;

/// The kind of image that a stack was read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// DICOM.
    Dicom,
    /// NIfTI.
    Nifti,
    /// MetaImage.
    MetaImage,
    /// NRRD.
    Nrrd,
    /// PNG, PGM, JPEG or TIFF, with the plan's geometry.
    Pictures,
}

impl Format {
    /// The name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dicom => "dicom",
            Self::Nifti => "nifti",
            Self::MetaImage => "metaimage",
            Self::Nrrd => "nrrd",
            Self::Pictures => "pictures",
        }
    }
}

/// What the acquisition states of itself (DICOM allow-list).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Acquisition {
    /// `MR`, `CT`, ...
    pub modality: Option<String>,
    /// Slice thickness, mm; says nothing about spacing.
    pub thickness_mm: Option<f64>,
    /// Echo time, ms.
    pub echo_time_ms: Option<f64>,
    /// Repetition time, ms.
    pub repetition_time_ms: Option<f64>,
    /// Field strength, tesla.
    pub field_strength_t: Option<f64>,
}

/// What was understood of the input.
#[derive(Clone, Debug, PartialEq)]
pub struct InputReport {
    /// Kind of the images.
    pub format: Format,
    /// Slices read.
    pub slices: usize,
    /// Numbers that the missing slices would have had, counting the filled stack from 0 along the normal.
    pub missing_slices: Vec<usize>,
    /// [row step, column step, median slice step], mm.
    pub spacing_mm: [f64; 3],
    /// `sha256:` over geometry and grey values; the order and the names of the files do not matter.
    pub digest: String,
    /// What the acquisition states of itself.
    pub acquisition: Acquisition,
    /// What the reader of the result must know.
    pub warnings: Vec<Warning>,
}

/// The stack behind some paths (a folder, a zip, files), and what was understood of it.
///
/// `plan` lends its geometry to pictures. A `plan.json` beside the images lends its own geometry when `plan` has none.
///
/// # Errors
/// See [`Error`]; each names the file, the slice or the plan's field.
pub fn stack(inputs: &[PathBuf], plan: &Plan, limits: &Limits) -> Result<(Stack, InputReport), Error> {
    stack_of(collect(inputs, limits)?, plan, limits)
}

/// The same for files in memory; archives are opened.
///
/// # Errors
/// As [`stack`].
pub fn stack_of(files: Vec<NamedBytes>, plan: &Plan, limits: &Limits) -> Result<(Stack, InputReport), Error> {
    let sorted = sort(expand(files, limits)?, limits)?;
    let mut warnings = sorted.warnings;
    let geometry = geometry(plan, &sorted.plans, sorted.kind, &mut warnings)?;
    if plan.series.is_some() && sorted.kind != Kind::Dicom {
        let message = "only DICOM has series; that of the plan was not used";
        warnings.push(Warning::new("plan.series_ignored", message, Place::field("series")));
    }
    let images = sorted.images;
    let mut acquisition = Acquisition::default();
    let (format, placement) = match sorted.kind {
        Kind::Dicom => {
            let (placement, facts) = dicom::stack(&images, plan.series.as_deref(), limits)?;
            acquisition = facts;
            (Format::Dicom, placement)
        }
        Kind::Picture => (Format::Pictures, pictures::stack(&images, &geometry, limits)?),
        kind => {
            let [image] = &images[..] else { return Err(several(&images, kind)) };
            let others: Vec<&NamedBytes> = sorted.others.iter().collect();
            let (format, (volume, mut more)): (_, (Volume, Vec<Warning>)) = match kind {
                Kind::Nifti => (Format::Nifti, nifti::volume(image, &others, limits)?),
                Kind::Nrrd => (Format::Nrrd, nrrd::volume(image, &others, limits)?),
                _ => (Format::MetaImage, metaimage::volume(image, &others, limits)?),
            };
            warnings.append(&mut more);
            (format, volume.stack(limits)?)
        }
    };
    let Placement { stack, missing, warnings: more } = placement;
    warnings.extend(more);
    let [row, column] = stack.pixel_spacing_mm;
    let report = InputReport {
        format,
        slices: stack.slices(),
        missing_slices: missing,
        spacing_mm: [row, column, stack.slice_spacing_mm()],
        digest: digest(&stack),
        acquisition,
        warnings,
    };
    Ok((stack, report))
}

fn several(images: &[NamedBytes], kind: Kind) -> Error {
    let name = |i: usize| images.get(i).map(|f| f.name.clone()).unwrap_or_default();
    Error::Mixed { first: name(0), first_kind: kind.name(), second: name(1), second_kind: kind.name() }
}

/// Files told apart.
pub(crate) struct Sorted {
    pub(crate) kind: Kind,
    pub(crate) images: Vec<NamedBytes>,
    /// Data files of detached headers.
    pub(crate) others: Vec<NamedBytes>,
    pub(crate) plans: Vec<NamedBytes>,
    pub(crate) warnings: Vec<Warning>,
}

/// Tell images, plans, data files and documents apart.
///
/// # Errors
/// [`Error::NoImages`], [`Error::Mixed`], [`Error::Unsupported`] for files that are neither.
pub(crate) fn sort(files: Vec<NamedBytes>, limits: &Limits) -> Result<Sorted, Error> {
    let total = files.len();
    let (mut images, mut others, mut plans, mut warnings) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for mut file in files {
        let mut found = kind(&file.bytes);
        if found == Kind::Gzip {
            let bytes = archive::gunzip(&file.name, &file.bytes, limits)?;
            found = kind(&bytes);
            // a gzip stream of something else may still be the data file of a detached NRRD header
            if found == Kind::Nifti {
                file.bytes = bytes;
            } else {
                found = Kind::Unknown;
            }
        }
        match found {
            _ if is_plan(&file.name) => plans.push(file),
            Kind::Unknown if is_document(&file.name) => {
                let message = format!("{} is no image and was left out", file.name);
                warnings.push(Warning::new("input.ignored", message, Place::file(&file.name)));
            }
            Kind::Unknown | Kind::Zip => others.push(file),
            found => images.push((found, file)),
        }
    }
    let named: Vec<String> = images
        .iter()
        .filter_map(|(kind, file)| match kind {
            Kind::MetaImage => metaimage::data_file(file),
            Kind::Nrrd => nrrd::data_file(file),
            Kind::Nifti => nifti::data_file(file),
            _ => None,
        })
        .collect();
    let stray = others.iter().find(|f: &&NamedBytes| !named.iter().any(|n| companion(&[*f], n).is_some()));
    if let Some(file) = stray {
        let reason = if file.bytes.is_empty() {
            "it is empty; send it again".to_owned()
        } else {
            "it is no image that is read (DICOM, NIfTI, MetaImage, NRRD, PNG, PGM, JPEG, TIFF); leave it out".to_owned()
        };
        return Err(Error::Unsupported { file: file.name.clone(), reason });
    }
    let Some(&(first, _)) = images.first() else { return Err(Error::NoImages { files: total }) };
    if let Some((other, file)) = images.iter().find(|(kind, _)| *kind != first) {
        return Err(Error::Mixed {
            first: images[0].1.name.clone(),
            first_kind: first.name(),
            second: file.name.clone(),
            second_kind: other.name(),
        });
    }
    Ok(Sorted { kind: first, images: images.into_iter().map(|(_, f)| f).collect(), others, plans, warnings })
}

/// The geometry that places pictures: the plan's, else that of a plan beside them.
fn geometry(plan: &Plan, beside: &[NamedBytes], kind: Kind, warnings: &mut Vec<Warning>) -> Result<Geometry, Error> {
    let none = Geometry::default();
    if kind != Kind::Picture {
        if plan.geometry != none {
            let message = "the images carry their own geometry; that of the plan was not used";
            warnings.push(Warning::new("plan.geometry_ignored", message, Place::field("geometry")));
        }
        return Ok(none);
    }
    let [file] = beside else { return Ok(plan.geometry.clone()) };
    if plan.geometry != none {
        return Ok(plan.geometry.clone());
    }
    let found = Plan::parse(&file.bytes)?;
    if (Plan { geometry: none, ..found.clone() }) != Plan::default() {
        let message = "only the geometry of the plan beside the images is used; give the plan itself for the rest";
        warnings.push(Warning::new("plan.sidecar_ignored", message, Place::file(&file.name)));
    }
    Ok(found.geometry)
}

/// SHA-256 over sizes, geometry and grey values, all little endian.
fn digest(stack: &Stack) -> String {
    let mut hash = Sha256::new_with_prefix(b"vasculum/stack/1\0");
    for n in [stack.columns, stack.rows, stack.slices()] {
        hash.update((n as u64).to_le_bytes());
    }
    // + 0.0: minus zero and zero are one number
    let mut number = |x: f64| hash.update((x + 0.0).to_le_bytes());
    stack.pixel_spacing_mm.into_iter().for_each(&mut number);
    stack.row_direction.to_array().into_iter().chain(stack.column_direction.to_array()).for_each(&mut number);
    stack.origins.iter().flat_map(|o| o.to_array()).for_each(&mut number);
    number(stack.thickness_mm.unwrap_or(-1.0));
    for chunk in stack.pixels.chunks(4096) {
        hash.update(chunk.iter().flat_map(|p| (p + 0.0).to_le_bytes()).collect::<Vec<u8>>());
    }
    let hex: String = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
    format!("sha256:{hex}")
}
