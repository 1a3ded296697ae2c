//! The fitted function: a sum over the cubic kernel, a linear polynomial, and the points that it came from.

use crate::conjugate::Solution;
use crate::hierarchy;
use crate::kernel::Centres;
use crate::system::Scale;
use crate::{Error, Field};
use exec::{Cancelled, Ctx};
use space::{Aabb, DMat3, DVec3, P3, Patient, V3};

/// The fitted function with its constraints.
#[derive(Clone, Debug)]
pub struct Variational {
    pub(crate) centres: Centres,
    pub(crate) polynomial: [f64; 4],
    pub(crate) scale: Scale,
    pub(crate) bounds: Aabb<Patient>,
    pub(crate) wall: Vec<P3>,
    pub(crate) inner: Vec<P3>,
}

impl Variational {
    /// Constraint points on the wall: they seed the polygoniser.
    pub fn wall(&self) -> &[P3] {
        &self.wall
    }
    /// Constraint points inside the lumen: they seed the voxeliser.
    pub fn inner(&self) -> &[P3] {
        &self.inner
    }
}

impl Field for Variational {
    fn value(&self, x: P3) -> f64 {
        let mut out = [0.0];
        self.values(&[x], &mut out);
        out[0]
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let t = self.scale.apply(x);
        let (f, g) = self.centres.gradient(t);
        let b = &self.polynomial;
        (f + self.linear(t), self.scale.gradient([g[0] + b[1], g[1] + b[2], g[2] + b[3]]))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let t = self.scale.apply(x);
        let (f, g, h) = self.centres.hessian(t);
        let b = &self.polynomial;
        let [xx, yy, zz, xy, xz, yz] = h.map(|h| h / (self.scale.length * self.scale.length));
        let matrix = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
        (f + self.linear(t), self.scale.gradient([g[0] + b[1], g[1] + b[2], g[2] + b[3]]), matrix)
    }
    fn values(&self, xs: &[P3], out: &mut [f64]) {
        let targets: Vec<[f64; 3]> = xs.iter().map(|&x| self.scale.apply(x)).collect();
        self.centres.values(&targets, out);
        for (o, t) in out.iter_mut().zip(&targets) {
            *o += self.linear(*t);
        }
    }
    fn values_of_many(&self, xs: &[P3], ctx: &Ctx) -> Result<Vec<f64>, Cancelled> {
        let targets: Vec<[f64; 3]> = xs.iter().map(|&x| self.scale.apply(x)).collect();
        let mut out = hierarchy::sums(&self.centres, &targets, ctx)?;
        for (o, t) in out.iter_mut().zip(&targets) {
            *o += self.linear(*t);
        }
        Ok(out)
    }
    fn numbers(&self) -> Option<Vec<f64>> {
        let mut all = self.scale.numbers().to_vec();
        all.extend(self.polynomial);
        all.extend(self.centres.numbers());
        Some(all)
    }
    fn bounds(&self) -> Aabb<Patient> {
        self.bounds
    }
}

impl Variational {
    /// From a solution at points in patient coordinates, whose scaled coordinates it was found in.
    pub(crate) fn new(points: Vec<P3>, scale: Scale, solution: &Solution) -> Result<Self, Error> {
        let bounds = Aabb::around(points.iter().copied()).ok_or(Error::TooFewPoints { points: 0, least: 1 })?;
        let scaled: Vec<[f64; 3]> = points.iter().map(|&p| scale.apply(p)).collect();
        Ok(Self {
            centres: Centres::new(&scaled, &solution.coefficients),
            polynomial: solution.polynomial,
            scale,
            bounds: bounds.grown(2.0),
            wall: points,
            inner: Vec::new(),
        })
    }
    /// Tells which points lie on the wall (the first `wall`) and which inside (the `inner` after them).
    pub(crate) fn with_constraints(mut self, wall: usize, inner: usize) -> Self {
        self.inner = self.wall[wall..wall + inner].to_vec();
        self.wall.truncate(wall);
        self
    }
    fn linear(&self, t: [f64; 3]) -> f64 {
        let b = &self.polynomial;
        b[0] + b[1] * t[0] + b[2] * t[1] + b[3] * t[2]
    }
}
