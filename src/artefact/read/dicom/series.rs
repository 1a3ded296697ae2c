//! Which of several series is the stack.

use super::{PlaneOf, Slice};
use crate::read::Error;
use crate::read::volume::{Frame, Placed, line_up};
use crate::write::dicom::encode::uid_of;
use space::{Place, V3, Warning};
use std::cmp::Ordering;

/// Slices whose directions differ by more than this angle (radians) are no stack; printed directions differ by 1e-6.
const SAME_DIRECTION: f64 = 2e-3;

impl PlaneOf {
    fn parallel(&self, other: &Self) -> bool {
        (0..2).all(|a| self.directions[a].angle_to(other.directions[a]) < SAME_DIRECTION)
    }
    /// A key that does not depend on file order or names.
    fn key(&self) -> [f64; 9] {
        let [u, v] = self.directions.map(V3::to_array);
        let o = self.origin.to_array();
        [u[0], u[1], u[2], v[0], v[1], v[2], o[0], o[1], o[2]]
    }
}

impl Slice {
    /// Whether a plan means this slice's series; after de-identifying, the UID is a hash of the one that the user knows.
    fn is_of(&self, name: &str) -> bool {
        let [uid, number] = &self.series;
        uid == name || number == name || *uid == uid_of(name.as_bytes())
    }
}

/// The slices of the series that the plan names, else of the longest one of one orientation that makes a stack, in an
/// order that does not depend on the files' order.
///
/// # Errors
/// [`Error::GeometryMissing`], [`Error::NoSuchSeries`], [`Error::AmbiguousSeries`]; the longest series' fault when none
/// makes a stack.
pub(super) fn chosen(
    slices: Vec<Slice>,
    named: Option<&str>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Slice>, Error> {
    let total = slices.len();
    let mut slices = placed(slices)?;
    if let Some(name) = named {
        let mut known: Vec<String> = slices.iter().map(|s| s.series[1].clone()).collect();
        slices.retain(|s| s.is_of(name));
        if slices.is_empty() {
            known.sort();
            known.dedup();
            return Err(Error::NoSuchSeries { name: name.to_owned(), known: known.join(", ") });
        }
    }
    let mut groups = groups(slices);
    // stable: groups of one length keep the order of their places
    groups.sort_by_key(|g| std::cmp::Reverse(g.len()));
    let mut faults: Vec<(usize, Error)> = Vec::new();
    let mut best: Option<Vec<Slice>> = None;
    for group in groups {
        match &best {
            Some(taken) if group.len() < taken.len() => break,
            _ => {}
        }
        match (refuse_inconsistent(&group), &best) {
            (Err(e), _) => faults.push((group.len(), e)),
            (Ok(()), None) => best = Some(group),
            (Ok(()), Some(taken)) => {
                let (a, b) = (&taken[0], &group[0]);
                let (first, second, slices) = (a.source.clone(), b.source.clone(), group.len());
                return Err(Error::AmbiguousSeries { first, second, slices });
            }
        }
    }
    let Some(group) = best else {
        let first = faults.into_iter().next().map(|(_, e)| e);
        return Err(first.unwrap_or_else(|| Error::Internal("no group of slices".to_owned())));
    };
    if group.len() < total {
        warnings.push(told(&group, total, &faults));
    }
    Ok(group)
}

fn told(group: &[Slice], total: usize, faults: &[(usize, Error)]) -> Warning {
    let number = &group[0].series[1];
    let name = if number.is_empty() { String::new() } else { format!(" (series {number})") };
    let mut message = format!(
        "{} of {total} images{name} make the stack that was taken; the others were left out: name the series in the plan \
         if another is meant",
        group.len()
    );
    for (length, fault) in faults {
        message += &format!("; {length} images make no stack: {fault}");
    }
    Warning::new("dicom.several_series", message, Place::none())
}

/// The slices with a place, in an order of their places.
fn placed(mut slices: Vec<Slice>) -> Result<Vec<Slice>, Error> {
    let unplaced = slices.iter().filter(|s| s.plane.is_none()).count();
    if 2 * unplaced > slices.len() {
        let file = slices.iter().find(|s| s.plane.is_none()).map(|s| s.source.clone());
        let reason = "the file has no ImagePositionPatient, ImageOrientationPatient or PixelSpacing for every image; \
                      export the original images, not secondary captures or derived series";
        return Err(Error::GeometryMissing { file, field: "geometry.pixel_spacing_mm", reason: reason.to_owned() });
    }
    slices.retain(|s| s.plane.is_some());
    let key = |s: &Slice| s.plane.map_or([0.0; 9], |p| p.key());
    slices.sort_by(|a, b| {
        let order = |x: &[f64; 9], y: &[f64; 9]| {
            x.iter().zip(y).map(|(p, q)| p.total_cmp(q)).find(|o| o.is_ne()).unwrap_or(Ordering::Equal)
        };
        order(&key(a), &key(b)).then_with(|| a.series.cmp(&b.series)).then_with(|| a.source.cmp(&b.source))
    });
    Ok(slices)
}

/// Slices of one series and one orientation each.
fn groups(slices: Vec<Slice>) -> Vec<Vec<Slice>> {
    let mut groups: Vec<Vec<Slice>> = Vec::new();
    for s in slices {
        let same = |g: &&mut Vec<Slice>| {
            g[0].series == s.series && g[0].plane.zip(s.plane).is_some_and(|(a, b)| a.parallel(&b))
        };
        match groups.iter_mut().find(same) {
            Some(group) => group.push(s),
            None => groups.push(vec![s]),
        }
    }
    groups
}

/// The frame of a slice's stack, and the slice's own place.
pub(super) fn frame(slice: &Slice) -> Result<(Frame, PlaneOf), Error> {
    let plane = slice.plane.ok_or_else(|| Error::Internal("a slice without a plane".to_owned()))?;
    let [rows, columns] = slice.size;
    let PlaneOf { spacing, directions, .. } = plane;
    Ok((Frame { columns, rows, spacing, directions, thickness_mm: slice.facts.thickness_mm }, plane))
}

/// Whether slices make one stack: one size, one spacing, distinct positions on one line along the normal.
fn refuse_inconsistent(group: &[Slice]) -> Result<(), Error> {
    refuse_unequal(group)?;
    let (frame, _) = frame(&group[0])?;
    let bare = |s: &Slice| Some(Placed { source: s.source.clone(), origin: s.plane?.origin, pixels: Vec::new() });
    let mut bare: Vec<Placed> = group.iter().filter_map(bare).collect();
    line_up(&mut bare, &frame).map(|_| ())
}

/// All slices have the size and the spacing of the majority.
fn refuse_unequal(group: &[Slice]) -> Result<(), Error> {
    let spacing = |s: &Slice| s.plane.map_or([0.0; 2], |p| p.spacing);
    let same = |a: &Slice, b: &Slice| {
        let (p, q) = (spacing(a), spacing(b));
        // 1e-4: over 512 pixels a twentieth of a pixel
        a.size == b.size && (0..2).all(|i| (p[i] - q[i]).abs() <= 1e-4 * p[i].abs())
    };
    let in_words = |s: &Slice| {
        let [row, column] = spacing(s);
        format!("{} x {}, step {row} x {column}", s.size[0], s.size[1])
    };
    let Some(odd) = group.iter().find(|s| !same(&group[0], s)) else { return Ok(()) };
    let like_first = group.iter().filter(|s| same(&group[0], s)).count();
    let (found, expected) = if 2 * like_first >= group.len() { (odd, &group[0]) } else { (&group[0], odd) };
    Err(Error::UnequalSizes { file: found.source.clone(), found: in_words(found), expected: in_words(expected) })
}
