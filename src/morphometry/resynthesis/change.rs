//! Changes of medial lines, one after the other; what lies beyond a changed branch goes with it.

use crate::Error;
use crate::junction::FROM_CROTCH;
use crate::resynthesis::path::{Motion, Path, Step, arc, turned};
use crate::resynthesis::{Change, Model, What, Which};
use space::{DVec3, V3};
use std::ops::Range;

/// A tree whose lines are changed.
pub(crate) struct Changed {
    /// By branch.
    pub(crate) paths: Vec<Path>,
    /// By branch: the sections that are carried along (those with an outline among them).
    pub(crate) carried: Vec<Range<usize>>,
    /// By branch: fitted direction away from the junction.
    directions: Vec<Option<V3>>,
    /// By junction of the model.
    pub(crate) junctions: Vec<DVec3>,
    normals: Vec<Option<V3>>,
}

/// Largest factor of bends, and wanted angles: beyond them no vessel can be.
const FACTOR_MOST: f64 = 10.0;
const ANGLES_DEG: [f64; 2] = [5.0, 175.0];
/// Sine below which two directions span no plane.
const PLANE: f64 = 0.05;

pub(crate) fn applied(model: &Model, changes: &[Change]) -> Result<Changed, Error> {
    let mut changed = Changed {
        paths: model.branches.iter().map(Path::of).collect(),
        carried: model.branches.iter().map(|b| 0..b.sections.len()).collect(),
        directions: model.branches.iter().map(|b| b.direction).collect(),
        junctions: model.junctions.iter().map(|j| j.point.raw()).collect(),
        normals: model.junctions.iter().map(|j| j.plane_normal).collect(),
    };
    for change in changes {
        let branch = model.find(change.branch)?;
        check(change)?;
        changed.change(model, branch, change)?;
    }
    Ok(changed)
}

fn check(change: &Change) -> Result<(), Error> {
    let refuse = |field, value: f64, low, high| {
        let inside = value >= low && value <= high;
        if inside { Ok(()) } else { Err(Error::VariantValue { field, value, low, high }) }
    };
    match change.what {
        What::Angle { deg, .. } => refuse("angle_deg", deg, ANGLES_DEG[0], ANGLES_DEG[1]),
        What::Bend { factor } => refuse("curvature_factor", factor, 0.0, FACTOR_MOST),
        What::Helix { curvature_per_mm, torsion_per_mm } => {
            refuse("curvature_per_mm", curvature_per_mm, 0.0, FACTOR_MOST)?;
            refuse("torsion_per_mm", torsion_per_mm, -FACTOR_MOST, FACTOR_MOST)
        }
        What::Planar => Ok(()),
    }
}

impl Changed {
    fn change(&mut self, model: &Model, b: usize, change: &Change) -> Result<(), Error> {
        let beyond = beyond(model, b)?;
        let before = self.paths[b].clone();
        let first = self.first(model, b).ok_or(Error::VariantSections { branch: model.branches[b].id })?;
        match change.what {
            What::Angle { deg, to } => {
                let motion = self.turn(model, b, deg, to)?;
                self.forget_crotch(model, model.branches[b].nodes[0]);
                self.paths[b].moved(&motion);
                self.directions[b] = self.directions[b].map(|d| V3::from_raw(motion.rotation * d.raw()));
            }
            What::Bend { factor } => self.paths[b].rebuilt(first, |_, step| bent(step, factor)),
            What::Helix { curvature_per_mm, torsion_per_mm } => {
                let phase = self.paths[b].bend_direction(first);
                self.paths[b].rebuilt(first, |s, step| helical(step, curvature_per_mm, phase + torsion_per_mm * s));
            }
            What::Planar => self.press(model, b, first)?,
        }
        let motion = self.paths[b].end_motion(&before);
        for other in beyond.branches {
            self.paths[other].moved(&motion);
            self.directions[other] = self.directions[other].map(|d| V3::from_raw(motion.rotation * d.raw()));
        }
        for j in beyond.junctions {
            self.junctions[j] = motion.point(self.junctions[j]);
            self.normals[j] = self.normals[j].map(|n| V3::from_raw(motion.rotation * n.raw()));
        }
        Ok(())
    }

    /// The first section that is carried along.
    fn first(&self, model: &Model, b: usize) -> Option<usize> {
        self.carried[b].clone().find(|&k| model.branches[b].sections[k].outline.is_some())
    }

    /// Where a branch turns, the crotch is another one: the sections next to it, which it deformed, are not carried along.
    /// With them a graft turned from 45 to 60 degrees was measured back as 60.37.
    fn forget_crotch(&mut self, model: &Model, node: usize) {
        let Some(junction) = model.junctions.iter().find(|j| j.node == node) else { return };
        for (b, branch) in model.branches.iter().enumerate() {
            let clear: Vec<usize> = self.carried[b].clone().filter(|&k| branch.sections[k].outline.is_some()).collect();
            let distance = |k: usize| branch.sections[k].position.distance(junction.point);
            if branch.nodes[0] == node {
                let reach = clear.first().map_or(0.0, |&k| FROM_CROTCH * distance(k));
                self.carried[b].start =
                    clear.iter().copied().find(|&k| distance(k) >= reach).unwrap_or(self.carried[b].start);
            }
            if branch.nodes[1] == node {
                let reach = clear.last().map_or(0.0, |&k| FROM_CROTCH * distance(k));
                let last = clear.iter().copied().rev().find(|&k| distance(k) >= reach);
                self.carried[b].end = last.map_or(self.carried[b].end, |k| k + 1);
            }
        }
    }

    /// The turn about the junction that gives branch `b` an angle with another.
    fn turn(&self, model: &Model, b: usize, deg: f64, to: Which) -> Result<Motion, Error> {
        let other = model.find(to)?;
        let (id, of) = (model.branches[b].id, |b: usize| self.directions[b]);
        let junction = self.junction_of(model, b).ok_or(Error::VariantDirection { branch: id })?;
        let (own, fixed) = of(b).zip(of(other)).ok_or(Error::VariantDirection { branch: id })?;
        let normal = fixed.cross(own);
        if other == b || normal.length() < PLANE {
            return Err(Error::VariantDirection { branch: id });
        }
        let by = deg.to_radians() - fixed.angle_to(own);
        let at = self.junctions[junction];
        Ok(Motion { rotation: turned(normal.raw().normalize() * by), from: at, to: at })
    }

    fn junction_of(&self, model: &Model, b: usize) -> Option<usize> {
        model.junctions.iter().position(|j| j.node == model.branches[b].nodes[0])
    }

    /// Presses a branch into its junction's plane; its first clear point slides into the plane, too.
    fn press(&mut self, model: &Model, b: usize, first: usize) -> Result<(), Error> {
        let id = model.branches[b].id;
        let junction = self.junction_of(model, b).ok_or(Error::VariantDirection { branch: id })?;
        let normal = self.normals[junction].ok_or(Error::VariantDirection { branch: id })?.raw();
        let flat = |v: DVec3| v - normal * v.dot(normal);
        // the whole branch turns about the junction first, so that its first clear point comes to lie in the plane
        let at = self.junctions[junction];
        let lever = self.paths[b].points[first] - at;
        let level = flat(lever).try_normalize().ok_or(Error::VariantDirection { branch: id })?;
        let rotation = arc(lever.normalize(), level);
        self.paths[b].moved(&Motion { rotation, from: at, to: at });
        let path = &mut self.paths[b];
        let old = path.clone();
        for k in first..old.points.len() {
            let tangent = flat(old.frames[k].z_axis);
            if tangent.length() < PLANE {
                return Err(Error::VariantDirection { branch: id });
            }
            path.frames[k] = arc(old.frames[k].z_axis, tangent.normalize()) * old.frames[k];
            if k > first {
                let chord = old.points[k] - old.points[k - 1];
                let along = flat(chord).normalize_or_zero() * chord.length();
                path.points[k] = path.points[k - 1] + along;
            }
        }
        self.directions[b] = self.directions[b].and_then(|d| V3::from_raw(flat(rotation * d.raw())).normalised());
        Ok(())
    }
}

/// What hangs on the far end of a branch.
struct Beyond {
    branches: Vec<usize>,
    junctions: Vec<usize>,
}

fn beyond(model: &Model, b: usize) -> Result<Beyond, Error> {
    let [from, to] = model.branches[b].nodes;
    let mut nodes = vec![to];
    let mut branches: Vec<usize> = Vec::new();
    let mut next = 0;
    while let Some(&node) = nodes.get(next) {
        next += 1;
        for (i, other) in model.branches.iter().enumerate() {
            if i == b || branches.contains(&i) || !other.nodes.contains(&node) {
                continue;
            }
            branches.push(i);
            nodes.extend(other.nodes.iter().filter(|n| !nodes.contains(n)).copied().collect::<Vec<_>>());
        }
    }
    if nodes.contains(&from) {
        return Err(Error::VariantLoop { branch: model.branches[b].id });
    }
    let junctions = (0..model.junctions.len()).filter(|&j| nodes.contains(&model.junctions[j].node)).collect();
    Ok(Beyond { branches, junctions })
}

/// A step whose bend is `factor` times as strong; its length stays.
fn bent(step: Step, factor: f64) -> Step {
    let DVec3 { x, y, .. } = step.forward * factor;
    let across = x * x + y * y;
    let along = (step.forward.length_squared() - across).max(0.0).sqrt();
    Step { forward: DVec3::new(x, y, along), turn: step.turn * factor }
}

/// A step of constant curvature towards the angle `towards` of the frame.
fn helical(step: Step, curvature: f64, towards: f64) -> Step {
    let length = step.forward.length();
    let turn = curvature * length;
    let (sin, cos) = towards.sin_cos();
    // the chord of an arc: (1 - cos) / kappa across, sin / kappa along
    let (across, along) =
        if turn > 1e-9 { ((1.0 - turn.cos()) / curvature, turn.sin() / curvature) } else { (0.0, length) };
    Step { forward: DVec3::new(across * cos, across * sin, along), turn: DVec3::new(-sin, cos, 0.0) * turn }
}

impl Path {
    /// Angle, in the frame at point `first`, towards which the line bends from there on; 0 for a straight one.
    fn bend_direction(&self, first: usize) -> f64 {
        let sum = (first..self.points.len() - 1).fold(DVec3::ZERO, |s, k| s + self.step(k).turn);
        // turn = (-sin, cos) kappa
        if sum.truncate().length() > 1e-9 { (-sum.x).atan2(sum.y) } else { 0.0 }
    }
}
