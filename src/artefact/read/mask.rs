//! Label masks: a lumen that another program (or a person) has drawn on the scan.
//!
//! A DICOM segmentation is told by its class, a volume (NIfTI, MetaImage, NRRD) by a word in its name: `mask`, `label`,
//! `labels`, `labelmap`, `seg` or `segmentation` between separators (`scan_seg.nii.gz`). Its lattice may be flipped, turned by quarters
//! or smaller than the scan's, as long as its voxels lie on those of the scan: nothing is resampled. Without a scan the
//! mask is its own image.

use super::Error;
use imaging::{Mask, Stack};
use space::V3;

/// Largest distance of a mask's voxel from the scan's, as a share of a voxel: geometry is printed, or stored in singles.
const OFF_LATTICE: f64 = 0.1;

/// Whether a file's name says that it is a mask.
pub(crate) fn is_named(name: &str) -> bool {
    const WORDS: [&str; 6] = ["mask", "label", "labels", "labelmap", "seg", "segmentation"];
    let base = name.rsplit(['/', '\\']).next().unwrap_or_default().to_ascii_lowercase();
    base.split(|c: char| !c.is_ascii_alphabetic()).any(|word| WORDS.contains(&word))
}

/// The label that is meant: the plan's, else the only one there is.
///
/// # Errors
/// [`Error::Label`] when the plan's is not there, or when it says nothing and there are several.
pub(crate) fn chosen(file: &str, present: &[u16], wanted: Option<u16>) -> Result<u16, Error> {
    let known = || present.iter().map(u16::to_string).collect::<Vec<_>>().join(", ");
    match (wanted, present) {
        (Some(label), _) if present.contains(&label) => Ok(label),
        (None, [only]) => Ok(*only),
        _ => Err(Error::Label { file: file.to_owned(), wanted, known: known() }),
    }
}

/// The labels in a volume of whole numbers, ascending, without the background 0.
///
/// # Errors
/// [`Error::Unsupported`] for values that are no labels.
pub(crate) fn labels(file: &str, labels: &Stack) -> Result<Vec<u16>, Error> {
    let mut present = vec![false; 1 << 16];
    for &p in &labels.pixels {
        if p.fract() != 0.0 || !(0.0..=65_535.0).contains(&p) {
            let reason =
                format!("its name says that it is a mask, but {p} is no label (whole numbers from 0 to 65535)");
            return Err(Error::Unsupported { file: file.to_owned(), reason });
        }
        present[p as usize] = true;
    }
    Ok((1..=u16::MAX).filter(|&l| present[usize::from(l)]).collect())
}

/// The voxels of `image` that have `label` in `labels`; voxels of the image outside the mask's lattice have none.
///
/// # Errors
/// [`Error::MaskGeometry`] when the voxels of the two do not coincide.
pub(crate) fn onto(file: &str, labels: &Stack, label: u16, image: &Stack) -> Result<Mask, Error> {
    let lattice = Lattice::of(labels);
    let mut inside = Vec::with_capacity(image.pixels.len());
    let mut worst: f64 = 0.0;
    for k in 0..image.slices() {
        for r in 0..image.rows {
            for c in 0..image.columns {
                let found = lattice.index(image.position(k, r as f64, c as f64));
                inside.push(found.is_some_and(|(i, off)| {
                    worst = worst.max(off);
                    labels.pixels[i] == f32::from(label)
                }));
            }
        }
    }
    if worst > OFF_LATTICE {
        return Err(Error::MaskGeometry { file: file.to_owned(), off_voxels: worst });
    }
    let (marked, kept) = (labels.pixels.iter().filter(|&&p| p == f32::from(label)).count(), count(&inside));
    // a mask of finer voxels would be thinned out in silence
    if marked != kept {
        let reason = format!("{marked} voxels of the mask are marked and {kept} of them lie on voxels of the scan");
        return Err(Error::Geometry { file: file.to_owned(), reason: format!("{reason}; draw it on this series") });
    }
    Ok(Mask::new(inside))
}

pub(crate) fn count(inside: &[bool]) -> usize {
    inside.iter().filter(|&&m| m).count()
}

/// Patient positions to indices of a stack.
struct Lattice<'a> {
    stack: &'a Stack,
    /// Directions over steps of columns and rows, per mm.
    per_mm: [V3; 2],
    normal: V3,
    offsets: Vec<f64>,
    /// Distance within which a slice counts as reached, mm.
    step: f64,
}

impl<'a> Lattice<'a> {
    fn of(stack: &'a Stack) -> Self {
        let [row, column] = stack.pixel_spacing_mm;
        let offsets: Vec<f64> = (0..stack.slices()).map(|k| stack.offset_mm(k)).collect();
        let step = offsets.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
        let per_mm = [stack.row_direction * column.recip(), stack.column_direction * row.recip()];
        Self { stack, per_mm, normal: stack.normal(), offsets, step }
    }
    /// The nearest voxel and how far off it is, in voxels; `None` half a voxel and more outside.
    fn index(&self, p: space::P3) -> Option<(usize, f64)> {
        let d = p - self.stack.origins[0];
        let nearest = |x: f64, n: usize| {
            let i = x.round();
            (i >= 0.0 && i < n as f64).then_some((i as usize, (x - i).abs()))
        };
        let (column, off_column) = nearest(d.dot(self.per_mm[0]), self.stack.columns)?;
        let (row, off_row) = nearest(d.dot(self.per_mm[1]), self.stack.rows)?;
        let along = d.dot(self.normal);
        let after = self.offsets.partition_point(|&o| o < along - 0.5 * self.step);
        let off_slice = (self.offsets.get(after)? - along).abs() / self.step;
        (off_slice <= 0.5).then(|| {
            ((after * self.stack.rows + row) * self.stack.columns + column, off_column.max(off_row).max(off_slice))
        })
    }
}
