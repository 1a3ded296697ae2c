//! Points, vectors and affine maps that carry their frame in the type.

use core::fmt;
use core::marker::PhantomData;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};
use glam::{DMat3, DVec3};

/// The patient frame: DICOM LPS, millimetres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Patient {}

/// A lattice frame: units are lattice steps, (0, 0, 0) is the centre of the first voxel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Voxel {}

/// A position in frame `F`.
pub struct Point<F>(DVec3, PhantomData<fn() -> F>);

/// A displacement in frame `F`.
pub struct Vector<F>(DVec3, PhantomData<fn() -> F>);

macro_rules! common {
    ($t:ident) => {
        impl<F> $t<F> {
            /// From its three coordinates.
            pub const fn new(x: f64, y: f64, z: f64) -> Self {
                Self(DVec3::new(x, y, z), PhantomData)
            }
            /// From a raw triple whose frame the caller vouches for.
            pub const fn from_raw(v: DVec3) -> Self {
                Self(v, PhantomData)
            }
            /// The raw triple, for arithmetic inside one frame.
            pub const fn raw(self) -> DVec3 {
                self.0
            }
            /// First coordinate.
            pub const fn x(self) -> f64 {
                self.0.x
            }
            /// Second coordinate.
            pub const fn y(self) -> f64 {
                self.0.y
            }
            /// Third coordinate.
            pub const fn z(self) -> f64 {
                self.0.z
            }
            /// The three coordinates.
            pub const fn to_array(self) -> [f64; 3] {
                self.0.to_array()
            }
            /// Whether all coordinates are finite.
            pub fn is_finite(self) -> bool {
                self.0.is_finite()
            }
        }
        impl<F> Clone for $t<F> {
            fn clone(&self) -> Self {
                *self
            }
        }
        impl<F> Copy for $t<F> {}
        impl<F> PartialEq for $t<F> {
            fn eq(&self, other: &Self) -> bool {
                self.0 == other.0
            }
        }
        impl<F> fmt::Debug for $t<F> {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "({}, {}, {})", self.0.x, self.0.y, self.0.z)
            }
        }
        impl<F> From<[f64; 3]> for $t<F> {
            fn from(a: [f64; 3]) -> Self {
                Self::from_raw(DVec3::from_array(a))
            }
        }
        impl<F> Default for $t<F> {
            fn default() -> Self {
                Self::from_raw(DVec3::ZERO)
            }
        }
    };
}
common!(Point);
common!(Vector);

impl<F> Point<F> {
    /// The frame's origin.
    pub const ORIGIN: Self = Self(DVec3::ZERO, PhantomData);

    /// Distance to another point of the same frame.
    pub fn distance(self, other: Self) -> f64 {
        self.0.distance(other.0)
    }

    /// The point a fraction `t` of the way to `other`.
    pub fn lerp(self, other: Self, t: f64) -> Self {
        Self::from_raw(self.0 + (other.0 - self.0) * t)
    }

    /// The mean of some points; `None` when there are none.
    pub fn centroid(points: &[Self]) -> Option<Self> {
        let sum = points.iter().fold(DVec3::ZERO, |a, p| a + p.0);
        (!points.is_empty()).then(|| Self::from_raw(sum / points.len() as f64))
    }
}

impl<F> Vector<F> {
    /// The zero vector.
    pub const ZERO: Self = Self(DVec3::ZERO, PhantomData);
    /// Unit vector along the first axis.
    pub const X: Self = Self(DVec3::X, PhantomData);
    /// Unit vector along the second axis.
    pub const Y: Self = Self(DVec3::Y, PhantomData);
    /// Unit vector along the third axis.
    pub const Z: Self = Self(DVec3::Z, PhantomData);

    /// Scalar product.
    pub fn dot(self, other: Self) -> f64 {
        self.0.dot(other.0)
    }
    /// Vector product.
    pub fn cross(self, other: Self) -> Self {
        Self::from_raw(self.0.cross(other.0))
    }
    /// Euclidean length.
    pub fn length(self) -> f64 {
        self.0.length()
    }
    /// Squared length.
    pub fn length_squared(self) -> f64 {
        self.0.length_squared()
    }
    /// The unit vector, or `None` when the length is zero or not finite.
    pub fn normalised(self) -> Option<Self> {
        self.0.try_normalize().map(Self::from_raw)
    }
    /// Some unit vector at a right angle to this one (which must not be zero).
    pub fn any_orthonormal(self) -> Self {
        Self::from_raw(self.0.normalize().any_orthonormal_vector())
    }
    /// The angle to another vector in radians, 0 to pi, accurate also near 0 and pi.
    pub fn angle_to(self, other: Self) -> f64 {
        self.0.cross(other.0).length().atan2(self.0.dot(other.0))
    }
}

impl<F> Sub for Point<F> {
    type Output = Vector<F>;
    fn sub(self, o: Self) -> Vector<F> {
        Vector::from_raw(self.0 - o.0)
    }
}
impl<F> Add<Vector<F>> for Point<F> {
    type Output = Self;
    fn add(self, o: Vector<F>) -> Self {
        Self::from_raw(self.0 + o.0)
    }
}
impl<F> Sub<Vector<F>> for Point<F> {
    type Output = Self;
    fn sub(self, o: Vector<F>) -> Self {
        Self::from_raw(self.0 - o.0)
    }
}
impl<F> AddAssign<Vector<F>> for Point<F> {
    fn add_assign(&mut self, o: Vector<F>) {
        self.0 += o.0;
    }
}
impl<F> Add for Vector<F> {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Self::from_raw(self.0 + o.0)
    }
}
impl<F> AddAssign for Vector<F> {
    fn add_assign(&mut self, o: Self) {
        self.0 += o.0;
    }
}
impl<F> Sub for Vector<F> {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        Self::from_raw(self.0 - o.0)
    }
}
impl<F> SubAssign for Vector<F> {
    fn sub_assign(&mut self, o: Self) {
        self.0 -= o.0;
    }
}
impl<F> Neg for Vector<F> {
    type Output = Self;
    fn neg(self) -> Self {
        Self::from_raw(-self.0)
    }
}
impl<F> Mul<f64> for Vector<F> {
    type Output = Self;
    fn mul(self, s: f64) -> Self {
        Self::from_raw(self.0 * s)
    }
}
impl<F> Mul<Vector<F>> for f64 {
    type Output = Vector<F>;
    fn mul(self, v: Vector<F>) -> Vector<F> {
        v * self
    }
}
impl<F> Div<f64> for Vector<F> {
    type Output = Self;
    fn div(self, s: f64) -> Self {
        Self::from_raw(self.0 / s)
    }
}

/// An affine map from frame `A` to frame `B`: x -> matrix x + offset.
pub struct Affine<A, B> {
    matrix: DMat3,
    offset: DVec3,
    frames: PhantomData<fn(A) -> B>,
}

impl<A, B> Clone for Affine<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<A, B> Copy for Affine<A, B> {}
impl<A, B> fmt::Debug for Affine<A, B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Affine {{ {:?}, {:?} }}", self.matrix, self.offset)
    }
}
impl<A, B> PartialEq for Affine<A, B> {
    fn eq(&self, o: &Self) -> bool {
        self.matrix == o.matrix && self.offset == o.offset
    }
}

impl<A, B> Affine<A, B> {
    /// From the images of the three unit vectors (the columns) and of the origin.
    pub fn from_columns(columns: [Vector<B>; 3], origin: Point<B>) -> Self {
        let matrix = DMat3::from_cols(columns[0].raw(), columns[1].raw(), columns[2].raw());
        Self { matrix, offset: origin.raw(), frames: PhantomData }
    }
    /// The image of a point.
    pub fn point(&self, p: Point<A>) -> Point<B> {
        Point::from_raw(self.matrix * p.raw() + self.offset)
    }
    /// The image of a vector.
    pub fn vector(&self, v: Vector<A>) -> Vector<B> {
        Vector::from_raw(self.matrix * v.raw())
    }
    /// The inverse map; `None` when the matrix is singular to working precision.
    pub fn inverse(&self) -> Option<Affine<B, A>> {
        let scale = self.matrix.x_axis.length() * self.matrix.y_axis.length() * self.matrix.z_axis.length();
        let det = self.matrix.determinant();
        if !det.is_finite() || det.abs() <= 1e-12 * scale {
            return None;
        }
        let matrix = self.matrix.inverse();
        Some(Affine { matrix, offset: -(matrix * self.offset), frames: PhantomData })
    }
    /// The linear part.
    pub fn matrix(&self) -> DMat3 {
        self.matrix
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn an_affine_map_and_its_inverse_cancel() {
        let a: Affine<Voxel, Patient> = Affine::from_columns(
            [Vector::new(0.5, 0.1, 0.0), Vector::new(0.0, 0.6, 0.2), Vector::new(0.3, 0.0, 1.5)],
            Point::new(10.0, -20.0, 3.0),
        );
        let p = Point::new(3.0, 4.0, 5.0);
        assert!(a.inverse().unwrap().point(a.point(p)).distance(p) < 1e-12);
    }

    #[test]
    fn a_singular_map_has_no_inverse() {
        let a: Affine<Voxel, Patient> = Affine::from_columns([Vector::X, Vector::X, Vector::Z], Point::ORIGIN);
        assert!(a.inverse().is_none());
    }

    #[test]
    fn small_angles_are_accurate() {
        let tiny = 1e-9;
        let angle = Vector::<Patient>::X.angle_to(Vector::new(1.0, tiny, 0.0));
        assert!((angle - tiny).abs() < 1e-20);
    }
}
