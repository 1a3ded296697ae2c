//! Axis-aligned boxes and regular lattices.

use crate::{Affine, Patient, Point, Vector, Voxel};

/// An axis-aligned box in frame `F`.
#[derive(Debug)]
pub struct Aabb<F> {
    /// Smallest coordinates.
    pub min: Point<F>,
    /// Largest coordinates.
    pub max: Point<F>,
}

impl<F> Clone for Aabb<F> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<F> Copy for Aabb<F> {}

impl<F> Aabb<F> {
    /// The smallest box around some points; `None` when there are none.
    pub fn around(points: impl IntoIterator<Item = Point<F>>) -> Option<Self> {
        let mut points = points.into_iter();
        let first = points.next()?.raw();
        let (lo, hi) = points.fold((first, first), |(lo, hi), p| (lo.min(p.raw()), hi.max(p.raw())));
        Some(Self { min: Point::from_raw(lo), max: Point::from_raw(hi) })
    }
    /// The box grown by `margin` on every side.
    pub fn grown(self, margin: f64) -> Self {
        let m = Vector::new(margin, margin, margin);
        Self { min: self.min - m, max: self.max + m }
    }
    /// Whether a point lies in the closed box.
    pub fn contains(self, p: Point<F>) -> bool {
        p.raw().cmpge(self.min.raw()).all() && p.raw().cmple(self.max.raw()).all()
    }
    /// Edge lengths.
    pub fn size(self) -> Vector<F> {
        self.max - self.min
    }
    /// The middle of the box.
    pub fn centre(self) -> Point<F> {
        self.min.lerp(self.max, 0.5)
    }
}

/// A regular lattice in the patient: `size` points along the three lattice axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Number of lattice points along each axis, each at least 1.
    pub size: [usize; 3],
    /// From lattice steps to LPS mm.
    pub to_patient: Affine<Voxel, Patient>,
}

impl Grid {
    /// A lattice along the patient's axes with equal steps that covers a box (its last points lie at or past `max`).
    pub fn covering(bounds: Aabb<Patient>, spacing_mm: f64) -> Self {
        let s = bounds.size().raw() / spacing_mm;
        let count = |x: f64| x.ceil().max(0.0) as usize + 1;
        let to_patient =
            Affine::from_columns([Vector::X * spacing_mm, Vector::Y * spacing_mm, Vector::Z * spacing_mm], bounds.min);
        Self { size: [count(s.x), count(s.y), count(s.z)], to_patient }
    }
    /// Number of lattice points.
    pub fn len(&self) -> usize {
        self.size.iter().product()
    }
    /// Whether the lattice has no point.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Position of the lattice point (i, j, k).
    pub fn point(&self, i: usize, j: usize, k: usize) -> Point<Patient> {
        self.to_patient.point(Point::new(i as f64, j as f64, k as f64))
    }
    /// Index of (i, j, k) in an array in which i runs fastest.
    pub fn index(&self, i: usize, j: usize, k: usize) -> usize {
        i + self.size[0] * (j + self.size[1] * k)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_covering_grid_reaches_past_the_far_corner() {
        let b = Aabb { min: Point::new(0.0, 0.0, 0.0), max: Point::new(1.0, 2.05, 0.0) };
        let g = Grid::covering(b, 0.5);
        assert_eq!(g.size, [3, 6, 1]);
        assert!(g.point(2, 5, 0).y() >= 2.05);
    }
}
