//! A medial line with rotation-minimising frames, and its bends.

use crate::resynthesis::ModelBranch;
use space::{DMat3, DVec3, V3};

/// Points with frames (columns: two normals and the tangent).
#[derive(Clone, Debug)]
pub(crate) struct Path {
    pub(crate) points: Vec<DVec3>,
    pub(crate) frames: Vec<DMat3>,
}

/// A step along a line in its own frame: where the next point lies, and the vector by which the frame turns.
#[derive(Clone, Copy)]
pub(crate) struct Step {
    pub(crate) forward: DVec3,
    pub(crate) turn: DVec3,
}

/// A rotation about a point, then a shift of it.
#[derive(Clone, Copy)]
pub(crate) struct Motion {
    pub(crate) rotation: DMat3,
    pub(crate) from: DVec3,
    pub(crate) to: DVec3,
}

impl Motion {
    pub(crate) fn point(&self, x: DVec3) -> DVec3 {
        self.to + self.rotation * (x - self.from)
    }
}

impl Path {
    /// The branch's line, through the centres of its outlines where it has them.
    pub(crate) fn of(branch: &ModelBranch) -> Self {
        let points =
            branch.sections.iter().map(|s| s.outline.as_ref().map_or(s.position, |o| o.centre).raw()).collect();
        let mut frames: Vec<DMat3> = Vec::with_capacity(branch.sections.len());
        for s in &branch.sections {
            let t = s.tangent.raw();
            frames.push(match frames.last() {
                Some(f) => arc(f.z_axis, t) * *f,
                None => {
                    let u = V3::from_raw(t).any_orthonormal().raw();
                    DMat3::from_cols(u, t.cross(u), t)
                }
            });
        }
        Self { points, frames }
    }

    pub(crate) fn moved(&mut self, motion: &Motion) {
        self.points.iter_mut().for_each(|p| *p = motion.point(*p));
        self.frames.iter_mut().for_each(|f| *f = motion.rotation * *f);
    }

    /// The step from point k to the next.
    pub(crate) fn step(&self, k: usize) -> Step {
        let inverse = self.frames[k].transpose();
        let (from, to) = (self.frames[k].z_axis, self.frames[k + 1].z_axis);
        let turn = from.cross(to).normalize_or_zero() * from.angle_between(to);
        Step { forward: inverse * (self.points[k + 1] - self.points[k]), turn: inverse * turn }
    }

    /// The line with its steps from point `first` on replaced; `step` gets the distance from there to the step's middle.
    pub(crate) fn rebuilt(&mut self, first: usize, step: impl Fn(f64, Step) -> Step) {
        let old: Vec<Step> = (first..self.points.len() - 1).map(|k| self.step(k)).collect();
        let mut along = 0.0;
        for (k, old) in (first..).zip(old) {
            let length = old.forward.length();
            let new = step(along + 0.5 * length, old);
            along += length;
            self.points[k + 1] = self.points[k] + self.frames[k] * new.forward;
            self.frames[k + 1] = turned(self.frames[k] * new.turn) * self.frames[k];
        }
    }

    /// What moved the frame at the last point from there to here.
    pub(crate) fn end_motion(&self, before: &Self) -> Motion {
        let k = self.points.len() - 1;
        Motion { rotation: self.frames[k] * before.frames[k].transpose(), from: before.points[k], to: self.points[k] }
    }
}

/// The smallest rotation that takes unit vector `a` to unit vector `b`.
pub(crate) fn arc(a: DVec3, b: DVec3) -> DMat3 {
    turned(a.cross(b).normalize_or_zero() * a.angle_between(b))
}

/// Rotation about a vector by its length, radians.
pub(crate) fn turned(vector: DVec3) -> DMat3 {
    let angle = vector.length();
    vector.try_normalize().map_or(DMat3::IDENTITY, |axis| DMat3::from_axis_angle(axis, angle))
}
