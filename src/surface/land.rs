//! Landing points on f = 0, and on f = 0 within one or two planes.
//!
//! Newton along the gradient (or along the part of it that the planes leave free) with clamped steps; when a step does
//! not halve the distance and both signs of f have been seen, the bracket is halved instead. On a smooth f three
//! evaluations take a vertex from a tenth of a millimetre to 1e-12 mm.

use crate::{Error, TriMesh};
use exec::Ctx;
use glam::DVec3;
use imaging::CutPlane;
use implicit::Field;
use space::{P3, V3};

/// |f| / |grad f| at which a landing stops, mm. The cubic RBF's cancellation noise is about 2e-11 mm.
pub(crate) const LANDED_MM: f64 = 2e-10;
/// |f| / |grad f| which is promised at wall vertices, mm (bar of the surface's quality).
pub(crate) const PROMISED_MM: f64 = 1e-9;
/// Most evaluations for one landing: Newton needs 3 to 4, a bisection from .1 mm about 30.
const MOST_STEPS: usize = 48;

/// A plane as a point and a unit normal, in raw coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Flat {
    pub(crate) point: DVec3,
    pub(crate) normal: DVec3,
    /// See [`CutPlane::reach_mm`].
    pub(crate) reach: f64,
}

impl Flat {
    pub(crate) fn of(cut: &CutPlane) -> Option<Self> {
        Some(Self { point: cut.point.raw(), normal: cut.outward.normalised()?.raw(), reach: cut.reach_mm })
    }
    pub(crate) fn cut(&self) -> CutPlane {
        CutPlane::new(P3::from_raw(self.point), V3::from_raw(self.normal)).within(self.reach)
    }
    /// Signed distance, positive outward; minus infinity out of reach.
    pub(crate) fn beyond(&self, x: DVec3) -> f64 {
        if self.reach == f64::INFINITY || x.distance(self.point) <= self.reach {
            self.height(x)
        } else {
            f64::NEG_INFINITY
        }
    }
    /// Signed distance, positive outward.
    pub(crate) fn height(&self, x: DVec3) -> f64 {
        (x - self.point).dot(self.normal)
    }
}

/// What a vertex is tied to: the wall or not, and up to two planes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tie {
    pub(crate) wall: bool,
    pub(crate) planes: [Option<Flat>; 2],
}

impl Tie {
    pub(crate) const WALL: Self = Self { wall: true, planes: [None, None] };

    /// The nearest point of the planes (their common line for two).
    pub(crate) fn settle(&self, x: DVec3) -> DVec3 {
        match self.planes {
            [Some(p), Some(q)] => {
                // x + a p.n + b q.n in both planes; twice, for full accuracy.
                let c = p.normal.dot(q.normal);
                let det = 1.0 - c * c;
                (0..2).fold(x, |x, _| {
                    let (hp, hq) = (p.height(x), q.height(x));
                    x - p.normal * ((hp - c * hq) / det) - q.normal * ((hq - c * hp) / det)
                })
            }
            [Some(p), None] | [None, Some(p)] => (0..2).fold(x, |x, _| x - p.normal * p.height(x)),
            [None, None] => x,
        }
    }
    /// The part of a vector that the planes leave free.
    pub(crate) fn free(&self, g: DVec3) -> DVec3 {
        match self.planes {
            [Some(p), Some(q)] => {
                let d = p.normal.cross(q.normal).normalize_or_zero();
                d * d.dot(g)
            }
            [Some(p), None] | [None, Some(p)] => g - p.normal * p.normal.dot(g),
            [None, None] => g,
        }
    }
}

/// Where a point landed.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Landing {
    pub(crate) at: DVec3,
    /// Gradient of f at the last evaluated point (at `at` when `exact`).
    pub(crate) gradient: DVec3,
    /// |f| / |free gradient| at the last evaluated point, mm.
    pub(crate) distance: f64,
    /// Calls of (f, grad f).
    pub(crate) evaluations: usize,
}

/// How to land.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Approach {
    /// Longest single step, mm.
    pub(crate) step_mm: f64,
    /// Stop at this |f| / |grad f|, mm.
    pub(crate) tolerance_mm: f64,
    /// Stop after the Newton step from a point this near, mm.
    pub(crate) enough_mm: f64,
    /// Most evaluations; the last one is followed by its Newton step.
    pub(crate) evaluations: usize,
}

impl Approach {
    /// All the way, to [`LANDED_MM`].
    pub(crate) fn exact(step_mm: f64) -> Self {
        Self { step_mm, tolerance_mm: LANDED_MM, enough_mm: 0.0, evaluations: MOST_STEPS }
    }
    /// One evaluation and its Newton step: enough to follow the wall while a mesh is being improved.
    pub(crate) fn follow(step_mm: f64) -> Self {
        Self { step_mm, tolerance_mm: LANDED_MM, enough_mm: 0.0, evaluations: 1 }
    }
}

/// Land one point on what it is tied to.
pub(crate) fn land(field: &dyn Field, x: DVec3, tie: &Tie, approach: Approach) -> Landing {
    let mut now = Landing { at: tie.settle(x), ..Landing::default() };
    if !tie.wall {
        return now;
    }
    let (mut inside, mut outside, mut before) = (None, None, f64::INFINITY);
    while now.evaluations < approach.evaluations {
        let (f, g) = field.gradient(P3::from_raw(now.at));
        let free = tie.free(g.raw());
        let slope = free.length();
        now.evaluations += 1;
        now.gradient = g.raw();
        now.distance = f.abs() / slope;
        if !now.distance.is_finite() || now.distance <= approach.tolerance_mm {
            break;
        }
        *(if f > 0.0 { &mut inside } else { &mut outside }) = Some(now.at);
        let bracket = if now.distance > 0.5 * before { inside.zip(outside) } else { None };
        now.at = tie.settle(match bracket {
            Some((a, b)) => 0.5 * (a + b),
            None => now.at - free * ((f / slope).clamp(-approach.step_mm, approach.step_mm) / slope),
        });
        if now.distance <= approach.enough_mm {
            break;
        }
        before = now.distance;
    }
    now
}

/// What projecting did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProjectReport {
    /// Calls of (f, grad f).
    pub evaluations: usize,
    /// Largest way of a vertex, mm.
    pub moved_max_mm: f64,
}

/// Move every vertex of the mesh along the gradient onto f = 0, to |f| / |grad f| <= 1e-9 mm.
///
/// Meant for the raw mesh of [`crate::polygonise`] (no caps): vertices start within a cell of the wall. Steps are
/// clamped to `step_mm` (the cell), with bisection when Newton stalls. Does not look at triangles: they may get thin.
///
/// # Errors
/// [`Error::Projection`] with the vertex that did not land, [`Error::NotFinite`], [`Error::Cancelled`].
pub fn project(mesh: &mut TriMesh, field: &dyn Field, step_mm: f64, ctx: &Ctx) -> Result<ProjectReport, Error> {
    let landings = ctx.map(&mesh.vertices, |p| land(field, p.raw(), &Tie::WALL, Approach::exact(step_mm)))?;
    let mut report = ProjectReport::default();
    for (v, l) in landings.iter().enumerate() {
        landed(v, l)?;
        report.evaluations += l.evaluations;
        report.moved_max_mm = report.moved_max_mm.max(l.at.distance(mesh.vertices[v].raw()));
        mesh.vertices[v] = P3::from_raw(l.at);
    }
    ctx.progress(1.0);
    Ok(report)
}

/// The fault of a landing that failed.
pub(crate) fn landed(vertex: usize, l: &Landing) -> Result<(), Error> {
    let at = P3::from_raw(l.at);
    if !(l.distance.is_finite() && l.at.is_finite()) {
        return Err(Error::NotFinite { at });
    }
    if l.distance > PROMISED_MM {
        return Err(Error::Projection { vertex, distance_mm: l.distance, at });
    }
    Ok(())
}
