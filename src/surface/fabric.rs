//! A mesh being improved: its half-edges, what ties each vertex, wanted sizes, and whether a change is allowed.
//!
//! What a vertex may do follows from the face ids around it, nothing else is stored: one id, and it slides on the wall
//! or in its cap's plane; two ids, and it slides along their common curve (a rim, or the line of two planes); more, and
//! it stays. So rims and corners survive any sequence of operations.

use crate::Error;
use crate::land::{Approach, Flat, Landing, Tie, land};
use crate::web::{GONE, NONE, Web, prev};
use crate::{TriMesh, WALL};
use exec::Ctx;
use glam::DVec3;
use implicit::Field;
use space::P3;

/// Least cosine between a triangle's normal and the surface's that an operation may leave behind, where the old
/// triangles were better: a uniform .5 mm mesh over the acute crotch (radius of curvature .34 mm) needs down to .5.
pub(crate) const FACING: f64 = 0.4;

/// Mark of a vertex that may not move at all.
const FROZEN: u8 = u8::MAX;

/// How a vertex may move.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Seat {
    /// In one surface: the wall or a cap.
    Face(Tie),
    /// Along a curve; the half-edges to its neighbours on the curve.
    Crease(Tie, [u32; 2]),
    /// Not at all.
    Fixed,
}

/// The mesh and what its operations need to know.
pub(crate) struct Fabric<'a> {
    pub(crate) web: Web,
    pub(crate) field: &'a dyn Field,
    /// Plane of face id k + 1.
    pub(crate) planes: Vec<Flat>,
    /// Outward unit normal of the wall at (or very near) each wall vertex.
    pub(crate) normal: Vec<DVec3>,
    /// Wanted edge length at each vertex, mm.
    pub(crate) size: Vec<f64>,
    /// Edges at each vertex across which the face id changes: 0 within a face, 2 on a curve, else a corner. Split, flip
    /// and collapse as they are allowed here never change it for a vertex that stays.
    pub(crate) marks: Vec<u8>,
    /// By face id, whether its triangles may change; all may when empty.
    pub(crate) pliable: Vec<bool>,
    /// Calls of (f, grad f), and of (f, grad f, second derivatives).
    pub(crate) evaluations: usize,
    pub(crate) hessians: usize,
}

/// The cotangents of a triangle's angles, and its unit normal: all that shape and facing need, without a trigonometric
/// function.
pub(crate) fn cotangents(p: [DVec3; 3]) -> ([f64; 3], DVec3) {
    let (a, b, c) = (p[1] - p[0], p[2] - p[1], p[0] - p[2]);
    let doubled = a.cross(-c);
    let inverse = 1.0 / doubled.length().max(f64::MIN_POSITIVE);
    ([-a.dot(c) * inverse, -a.dot(b) * inverse, -b.dot(c) * inverse], doubled * inverse)
}

/// The three angles of a triangle, radians.
pub(crate) fn angles(p: [DVec3; 3]) -> [f64; 3] {
    let doubled = (p[1] - p[0]).cross(p[2] - p[0]).length();
    [0, 1, 2].map(|k| doubled.atan2((p[(k + 1) % 3] - p[k]).dot(p[(k + 2) % 3] - p[k])))
}

/// Worst of some triangles: largest cotangent (the smallest angle's) and smallest cosine to the surface's normal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Worth {
    pub(crate) cot: f64,
    pub(crate) facing: f64,
}

impl Worth {
    pub(crate) const BEST: Self = Self { cot: f64::NEG_INFINITY, facing: f64::INFINITY };
    pub(crate) fn with(self, o: Self) -> Self {
        Self { cot: self.cot.max(o.cot), facing: self.facing.min(o.facing) }
    }
    /// The smallest angle, degrees.
    pub(crate) fn angle_deg(self) -> f64 {
        1_f64.atan2(self.cot).to_degrees()
    }
    /// Whether `self` may follow `before`: not folded (or less than before) and not thinner than both the angle whose
    /// cotangent is `floor` and before.
    pub(crate) fn may_follow(self, before: Self, floor: f64) -> bool {
        self.facing >= FACING.min(before.facing) && self.cot <= floor.max(before.cot)
    }
    /// Whether `self` is better than `before` by a noticeable angle.
    pub(crate) fn improves(self, before: Self) -> bool {
        // d cot = -(1 + cot^2) d angle
        let noticeable = NOTICEABLE * (1.0 + before.cot * before.cot);
        self.facing >= FACING.min(before.facing) && self.cot < before.cot - noticeable
    }
}

/// Gain in the smallest angle below which an operation is not worth it (and might cycle), radians: .06 degrees.
const NOTICEABLE: f64 = 1e-3;

impl<'a> Fabric<'a> {
    pub(crate) fn new(mesh: &TriMesh, field: &'a dyn Field, planes: Vec<Flat>) -> Result<Self, Error> {
        let web = Web::weave(mesh)?;
        let n = web.at.len();
        let mut marks = vec![0_u8; n];
        for h in (0..web.origin.len() as u32).filter(|&h| web.is_feature(h)) {
            let mark = &mut marks[web.origin[h as usize] as usize];
            *mark = mark.saturating_add(1);
        }
        let mut fabric = Self {
            web,
            field,
            planes,
            normal: vec![DVec3::ZERO; n],
            size: vec![0.0; n],
            marks,
            pliable: Vec::new(),
            evaluations: 0,
            hessians: 0,
        };
        fabric.mesh_normals();
        Ok(fabric)
    }

    /// Let only the faces of some ids change, and only inside them: every vertex on another id or on a rim is fixed.
    pub(crate) fn freeze(&mut self, pliable: &[bool]) {
        self.pliable = pliable.to_vec();
        for h in 0..self.web.origin.len() {
            if !self.may_change(h as u32) || self.web.is_feature(h as u32) {
                let next = self.web.target(h as u32);
                [self.web.origin[h], next].iter().for_each(|&v| self.marks[v as usize] = FROZEN);
            }
        }
    }

    /// Whether the triangle left of a half-edge may change.
    pub(crate) fn may_change(&self, h: u32) -> bool {
        self.pliable.is_empty() || self.pliable.get(self.web.id(h) as usize) == Some(&true)
    }

    /// Normals of the wall from its triangles, where f has not been asked yet.
    fn mesh_normals(&mut self) {
        for t in (0..self.web.face_id.len()).filter(|&t| self.web.face_id[t] == WALL) {
            let c = self.web.corners(t);
            let p = self.places(c);
            let doubled = (p[1] - p[0]).cross(p[2] - p[0]);
            c.iter().for_each(|&v| self.normal[v as usize] += doubled);
        }
        self.normal.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    }

    /// Split an edge in its middle; gives the new vertex. Inside the wall it is raised by the sagitta of the chord, from
    /// the normals at both ends: (b - a).(n_b - n_a) / 8.
    pub(crate) fn split(&mut self, h: u32) -> u32 {
        let (a, b) = (self.web.origin[h as usize] as usize, self.web.target(h) as usize);
        let crease = self.web.is_feature(h);
        let (p, q, n, m) = (self.web.at[a], self.web.at[b], self.normal[a], self.normal[b]);
        let normal = (n + m).normalize_or_zero();
        let raised = !crease && self.web.id(h) == WALL;
        let sagitta = if raised { (q - p).dot(m - n) / 8.0 } else { 0.0 };
        self.size.push(0.5 * (self.size[a] + self.size[b]));
        self.normal.push(normal);
        self.marks.push(if crease { 2 } else { 0 });
        self.web.split(h, 0.5 * (p + q) + normal * sagitta)
    }

    /// Drop what belongs to vertices that are gone, so that numbers stay dense.
    pub(crate) fn compact(&mut self) -> Result<(), Error> {
        let keep: Vec<usize> = (0..self.web.at.len()).filter(|&v| self.web.leaving[v] != NONE).collect();
        self.normal = keep.iter().map(|&v| self.normal[v]).collect();
        self.size = keep.iter().map(|&v| self.size[v]).collect();
        self.marks = keep.iter().map(|&v| self.marks[v]).collect();
        self.web = Web::weave(&self.web.mesh())?;
        Ok(())
    }

    fn plane(&self, id: u32) -> Option<Flat> {
        self.planes.get((id as usize).wrapping_sub(1)).copied()
    }

    /// How a vertex may move.
    pub(crate) fn seat(&self, v: u32) -> Seat {
        if self.marks[v as usize] == FROZEN {
            return Seat::Fixed;
        }
        if self.marks[v as usize] == 0 {
            return Seat::Face(self.tie([self.web.id(self.web.leaving[v as usize]); 2]));
        }
        let (mut marks, mut ids, mut count) = ([NONE; 2], [WALL; 2], 0);
        for h in self.web.spokes(v) {
            if self.web.is_feature(h) {
                if count < 2 {
                    marks[count] = h;
                    ids[count] = self.web.id(h);
                }
                count += 1;
            }
        }
        match count {
            2 => Seat::Crease(self.tie(ids), marks),
            _ => Seat::Fixed,
        }
    }

    fn tie(&self, ids: [u32; 2]) -> Tie {
        let second = if ids[0] == ids[1] { None } else { self.plane(ids[1]) };
        Tie { wall: ids.contains(&WALL), planes: [self.plane(ids[0]), second] }
    }

    /// Whether a vertex lies on a curve or corner.
    pub(crate) fn on_crease(&self, v: u32) -> bool {
        self.marks[v as usize] != 0
    }

    /// Living vertices.
    pub(crate) fn living(&self) -> Vec<u32> {
        (0..self.web.at.len() as u32).filter(|&v| self.web.leaving[v as usize] != NONE).collect()
    }

    /// Living edges that may change, each by its half-edge of smaller number.
    pub(crate) fn edges(&self) -> impl Iterator<Item = u32> + '_ {
        (0..self.web.origin.len() as u32).filter(|&h| {
            let t = self.web.twin[h as usize];
            self.web.lives(h) && h < t && self.may_change(h) && self.may_change(t)
        })
    }

    /// Mean length of the living edges, mm.
    pub(crate) fn mean_edge(&self) -> f64 {
        let (sum, count) = self.edges().fold((0.0, 0_u32), |(s, n), h| (s + self.web.length(h), n + 1));
        sum / f64::from(count.max(1))
    }

    /// Wanted length of an edge.
    pub(crate) fn wanted(&self, h: u32) -> f64 {
        let (a, b) = (self.web.origin[h as usize] as usize, self.web.target(h) as usize);
        self.size[a].min(self.size[b])
    }

    /// Worth of one triangle with given corners (vertex numbers for the normals, positions).
    pub(crate) fn worth(&self, id: u32, corners: [u32; 3], p: [DVec3; 3]) -> Worth {
        let (cot, normal) = cotangents(p);
        let outward = if id == WALL {
            let [a, b, c] = corners.map(|v| self.normal[v as usize]);
            (a + b + c).normalize_or_zero()
        } else {
            self.plane(id).map_or(normal, |p| p.normal)
        };
        Worth { cot: cot[0].max(cot[1]).max(cot[2]), facing: normal.dot(outward) }
    }

    pub(crate) fn places(&self, corners: [u32; 3]) -> [DVec3; 3] {
        corners.map(|v| self.web.at[v as usize])
    }

    /// Worth of the triangle left of a half-edge.
    pub(crate) fn worth_at(&self, h: u32) -> Worth {
        let t = h as usize / 3;
        let c = self.web.corners(t);
        self.worth(self.web.face_id[t], c, self.places(c))
    }

    /// Worth of all triangles at a vertex.
    pub(crate) fn star(&self, v: u32) -> Worth {
        self.web.spokes(v).fold(Worth::BEST, |w, h| w.with(self.worth_at(h)))
    }

    /// Worth of all triangles at a vertex if it were elsewhere.
    pub(crate) fn star_moved(&self, v: u32, to: DVec3) -> Worth {
        self.web.spokes(v).fold(Worth::BEST, |w, h| {
            let t = h as usize / 3;
            let c = self.web.corners(t);
            let p = c.map(|u| if u == v { to } else { self.web.at[u as usize] });
            w.with(self.worth(self.web.face_id[t], c, p))
        })
    }

    /// Worth before and after a flip; `None` when the flip is forbidden.
    pub(crate) fn flip_worth(&self, h: u32) -> Option<(Worth, Worth)> {
        let t = self.web.twin[h as usize];
        if self.web.is_feature(h) || self.web.flip_blocked(h) {
            return None;
        }
        let (a, b) = (self.web.origin[h as usize], self.web.origin[t as usize]);
        let (c, d) = (self.web.origin[prev(h) as usize], self.web.origin[prev(t) as usize]);
        if self.on_crease(c) && self.on_crease(d) {
            return None; // a chord from rim to rim lies in no surface
        }
        let id = self.web.id(h);
        let one = |k: [u32; 3]| self.worth(id, k, self.places(k));
        Some((self.worth_at(h).with(self.worth_at(t)), one([a, d, c]).with(one([b, c, d]))))
    }

    /// Worth before and after drawing the origin of h into its target; `None` when that is forbidden: features, the
    /// link condition, a chord from rim to rim, or an edge longer than `longest` times its wanted length.
    pub(crate) fn collapse_worth(&self, h: u32, longest: f64) -> Option<(Worth, Worth)> {
        let (a, b) = (self.web.origin[h as usize], self.web.target(h));
        let slides = match self.marks[a as usize] {
            0 => true,
            2 => self.web.is_feature(h),
            _ => false,
        };
        if !slides || self.web.collapse_blocked(h) {
            return None;
        }
        let (c, d) = (self.web.origin[prev(h) as usize], self.web.origin[prev(self.web.twin[h as usize]) as usize]);
        let to = self.web.at[b as usize];
        let b_on_crease = self.on_crease(b);
        let mut after = Worth::BEST;
        let mut before = Worth::BEST;
        for e in self.web.spokes(a) {
            let x = self.web.target(e);
            before = before.with(self.worth_at(e));
            if x != b && x != c && x != d {
                let length = to.distance(self.web.at[x as usize]);
                if length > longest * self.size[b as usize].min(self.size[x as usize]) {
                    return None;
                }
                if b_on_crease && !self.web.is_feature(e) && self.on_crease(x) {
                    return None;
                }
            }
            let k = self.web.corners(e as usize / 3);
            if !k.contains(&b) {
                let moved = k.map(|u| if u == a { b } else { u });
                after = after.with(self.worth(self.web.id(e), moved, self.places(moved)));
            }
        }
        Some((before, after))
    }

    /// Take over a landing.
    pub(crate) fn take(&mut self, v: u32, l: &Landing) {
        self.web.at[v as usize] = l.at;
        self.evaluations += l.evaluations;
        if l.evaluations > 0 {
            self.normal[v as usize] = -l.gradient.normalize_or_zero();
        }
    }

    /// Land some vertices on what they are tied to, in parallel; fixed ones stay.
    ///
    /// Gives each vertex's distance |f| / |grad f| at its last evaluation, mm (0 within caps).
    pub(crate) fn settle(&mut self, vertices: &[u32], approach: Approach, ctx: &Ctx) -> Result<Vec<f64>, Error> {
        let landings = ctx.map(vertices, |&v| {
            let x = self.web.at[v as usize];
            match self.seat(v) {
                Seat::Face(tie) | Seat::Crease(tie, _) => land(self.field, x, &tie, approach),
                Seat::Fixed => {
                    // A corner keeps its place; its gradient is still wanted as a normal.
                    let (f, g) = self.field.gradient(P3::from_raw(x));
                    let gradient = g.raw();
                    let wall = self.web.spokes(v).any(|h| self.web.id(h) == WALL);
                    let distance = if wall { f.abs() / gradient.length() } else { 0.0 };
                    Landing { at: x, gradient, distance, evaluations: 1 }
                }
            }
        })?;
        for (&v, l) in vertices.iter().zip(&landings) {
            if !l.at.is_finite() || (l.evaluations > 0 && !l.gradient.is_finite()) {
                return Err(Error::NotFinite { at: P3::from_raw(self.web.at[v as usize]) });
            }
            self.take(v, l);
        }
        Ok(landings.iter().map(|l| l.distance).collect())
    }

    /// Living triangles.
    pub(crate) fn triangles(&self) -> usize {
        self.web.face_id.iter().filter(|&&id| id != GONE).count()
    }
}
