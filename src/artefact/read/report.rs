//! From files to a stack with its report: sort the files out, tell their kind, read, digest.

use super::collect::{collect, expand};
use super::detect::{Kind, is_document, is_plan, kind};
use super::fields::companion;
use super::volume::Placement;
use super::{Error, Limits, NamedBytes, archive, dicom, mask, metaimage, nifti, nrrd, pictures};
use crate::plan::{Geometry, Plan};
use imaging::{Mask, Stack};
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
    /// A label mask alone.
    Mask,
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
            Self::Mask => "mask",
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
    /// The lumen where a label mask lay beside the images (or in their place).
    pub mask: Option<Mask>,
    /// What the reader of the result must know.
    pub warnings: Vec<Warning>,
}

impl InputReport {
    /// The plan's settings of the segmentation, with the mask that came with the images. A mask without images is its own
    /// image: what it was drawn on is unknown, and so is the blur to correct for.
    pub fn imaging(&self, plan: &Plan) -> imaging::Settings {
        let settings = plan.imaging();
        let alone = self.format == Format::Mask;
        let psf_sigma_px = settings.psf_sigma_px.or(alone.then_some(0.0));
        imaging::Settings { mask: self.mask.clone(), psf_sigma_px, ..settings }
    }
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
    let drawn = match &sorted.masks[..] {
        [] => None,
        [(kind, file)] => Some((file, labels((*kind, file), &sorted.others, plan.segmentation.label, limits)?)),
        [first, second, ..] => {
            let reason = format!("it is a second mask beside {}; send the one that is meant", first.1.name);
            return Err(Error::Unsupported { file: second.1.name.clone(), reason });
        }
    };
    let mut acquisition = Acquisition::default();
    let (format, placement) = match sorted.kind {
        Kind::Dicom => {
            let (placement, facts) = dicom::stack(&sorted.images, plan.series.as_deref(), limits)?;
            acquisition = facts;
            (Format::Dicom, placement)
        }
        Kind::Picture => (Format::Pictures, pictures::stack(&sorted.images, &geometry, limits)?),
        Kind::Unknown => match &drawn {
            Some((file, (labels, label))) => (Format::Mask, own_image(file, labels, *label)),
            None => return Err(Error::NoImages { files: 0 }),
        },
        kind => {
            let [image] = &sorted.images[..] else { return Err(several(&sorted.images, kind)) };
            volume((kind, image), &sorted.others, limits)?
        }
    };
    let Placement { stack, missing, warnings: more } = placement;
    warnings.extend(more);
    let mask = match drawn {
        None => None,
        Some((file, (labels, label))) => {
            let mask = mask::onto(&file.name, &labels.stack, label, &stack)?;
            warnings.push(used(file, label, &mask));
            Some(mask)
        }
    };
    let [row, column] = stack.pixel_spacing_mm;
    let report = InputReport {
        format,
        slices: stack.slices(),
        missing_slices: missing,
        spacing_mm: [row, column, stack.slice_spacing_mm()],
        digest: digest(&stack, mask.as_ref()),
        acquisition,
        mask,
        warnings,
    };
    Ok((stack, report))
}

fn several(images: &[NamedBytes], kind: Kind) -> Error {
    let name = |i: usize| images.get(i).map(|f| f.name.clone()).unwrap_or_default();
    Error::Mixed { first: name(0), first_kind: kind.name(), second: name(1), second_kind: kind.name() }
}

/// A volume file's stack.
fn volume(
    (kind, file): (Kind, &NamedBytes),
    others: &[NamedBytes],
    limits: &Limits,
) -> Result<(Format, Placement), Error> {
    let others: Vec<&NamedBytes> = others.iter().collect();
    let (format, (volume, mut warnings)) = match kind {
        Kind::Nifti => (Format::Nifti, nifti::volume(file, &others, limits)?),
        Kind::Nrrd => (Format::Nrrd, nrrd::volume(file, &others, limits)?),
        _ => (Format::MetaImage, metaimage::volume(file, &others, limits)?),
    };
    let mut placement = volume.stack(limits)?;
    warnings.append(&mut placement.warnings);
    Ok((format, Placement { warnings, ..placement }))
}

/// A mask's labels at their places, and the label that is meant.
fn labels(
    (kind, file): (Kind, &NamedBytes),
    others: &[NamedBytes],
    wanted: Option<u16>,
    limits: &Limits,
) -> Result<(Placement, u16), Error> {
    if kind == Kind::Dicom {
        return dicom::labels(file, wanted, limits);
    }
    let (_, placement) = volume((kind, file), others, limits)?;
    let label = mask::chosen(&file.name, &mask::labels(&file.name, &placement.stack)?, wanted)?;
    Ok((placement, label))
}

fn used(file: &NamedBytes, label: u16, mask: &Mask) -> Warning {
    let voxels = mask::count(mask.inside());
    let message = format!("the lumen is label {label} of {}, {voxels} voxels; nothing was searched for", file.name);
    Warning::new("mask.used", message, Place::file(&file.name))
}

/// A mask that came without its images, as its own image: 1 in the lumen, 0 outside.
fn own_image(file: &NamedBytes, labels: &Placement, label: u16) -> Placement {
    let message = "the mask came without its images: the wall is known to a third of a pixel at best, and how the mask was \
                   drawn is unknown; send the images with it";
    let mut warnings = labels.warnings.clone();
    warnings.push(Warning::new("mask.alone", message, Place::file(&file.name)));
    let pixels = labels.stack.pixels.iter().map(|&p| f32::from(u8::from(p == f32::from(label)))).collect();
    let stack = Stack { pixels, ..labels.stack.clone() };
    Placement { stack, missing: labels.missing.clone(), warnings }
}

/// Files told apart.
pub(crate) struct Sorted {
    /// Kind of the images; unknown when there is a mask alone.
    pub(crate) kind: Kind,
    pub(crate) images: Vec<NamedBytes>,
    /// Label masks with their kinds.
    pub(crate) masks: Vec<(Kind, NamedBytes)>,
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
    let (mut images, mut masks) = (Vec::new(), Vec::new());
    let (mut others, mut plans, mut warnings) = (Vec::new(), Vec::new(), Vec::new());
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
            found if is_mask(found, &file) => masks.push((found, file)),
            found => images.push((found, file)),
        }
    }
    let named: Vec<String> = images
        .iter()
        .chain(&masks)
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
    let first = match (images.first(), masks.is_empty()) {
        (Some(&(first, _)), _) => first,
        (None, false) => Kind::Unknown,
        (None, true) => return Err(Error::NoImages { files: total }),
    };
    if let Some((other, file)) = images.iter().find(|(kind, _)| *kind != first) {
        return Err(Error::Mixed {
            first: images[0].1.name.clone(),
            first_kind: first.name(),
            second: file.name.clone(),
            second_kind: other.name(),
        });
    }
    Ok(Sorted { kind: first, images: images.into_iter().map(|(_, f)| f).collect(), masks, others, plans, warnings })
}

fn is_mask(kind: Kind, file: &NamedBytes) -> bool {
    match kind {
        Kind::Dicom => dicom::is_segmentation(&file.bytes),
        Kind::Nifti | Kind::MetaImage | Kind::Nrrd => mask::is_named(&file.name),
        _ => false,
    }
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

/// SHA-256 over sizes, geometry, grey values and the mask where there is one, all little endian.
fn digest(stack: &Stack, mask: Option<&Mask>) -> String {
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
    if let Some(mask) = mask {
        hash.update(b"mask");
        hash.update(mask.inside().iter().map(|&m| u8::from(m)).collect::<Vec<u8>>());
    }
    let hex: String = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
    format!("sha256:{hex}")
}
