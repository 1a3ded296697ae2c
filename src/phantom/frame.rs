//! Where the stack lies in the patient, and how far a centre line runs inside it.

use crate::{Axis, Settings};
use space::{DMat3, DVec3, P3, V3};

/// The stack's frame: columns of `axes` are row direction, column direction and normal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frame {
    pub(crate) centre: DVec3,
    pub(crate) axes: DMat3,
    /// From the centre to the outer pixel centres along the three axes, mm.
    pub(crate) half: DVec3,
}

impl Frame {
    pub(crate) fn of(s: &Settings) -> Self {
        let [x, y, z] = s.oblique_deg.map(f64::to_radians);
        let axes = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
        let steps = DVec3::new(s.columns as f64 - 1.0, s.rows as f64 - 1.0, s.slices as f64 - 1.0);
        let half = 0.5 * steps * DVec3::new(s.pixel_mm, s.pixel_mm, s.slice_spacing_mm);
        Self { centre: s.centre_mm.raw(), axes, half }
    }
    pub(crate) fn to_patient(self, local: DVec3) -> P3 {
        P3::from_raw(self.centre + self.axes * local)
    }
    pub(crate) fn to_local(self, p: P3) -> DVec3 {
        self.axes.transpose() * (p.raw() - self.centre)
    }
    pub(crate) fn direction(self, axis: usize) -> V3 {
        V3::from_raw(self.axes.col(axis))
    }
    pub(crate) fn contains(self, p: P3) -> bool {
        self.to_local(p).abs().cmple(self.half + DVec3::splat(1e-9)).all()
    }

    /// The arc lengths between which the axis runs inside the box without a break around s = 0; `None` when s = 0 lies
    /// outside.
    pub(crate) fn span(self, axis: &Axis) -> Option<[f64; 2]> {
        self.contains(axis.point(0.0)).then(|| [self.reach(axis, -1.0), self.reach(axis, 1.0)])
    }

    fn reach(self, axis: &Axis, sign: f64) -> f64 {
        const STEP_MM: f64 = 0.25;
        let [first, last] = axis.range();
        let end = if sign < 0.0 { -first } else { last };
        // No straight line, arc or helix of the phantoms runs longer than this inside a stack.
        let longest = 20.0 * (2.0 * self.half.length() + 1.0);
        let mut inside = 0.0;
        while self.contains(axis.point(sign * (inside + STEP_MM))) {
            inside += STEP_MM;
            if inside >= end || inside > longest {
                return sign * end.min(longest);
            }
        }
        let mut outside = inside + STEP_MM;
        for _ in 0..50 {
            let middle = 0.5 * (inside + outside);
            if self.contains(axis.point(sign * middle)) { inside = middle } else { outside = middle }
        }
        sign * inside.min(end)
    }
}

/// Points of an axis every `step_mm` or less over a span.
pub(crate) fn samples(axis: &Axis, span: [f64; 2], step_mm: f64) -> Vec<P3> {
    let n = ((span[1] - span[0]) / step_mm).ceil().max(1.0) as usize;
    (0..=n).map(|i| axis.point(span[0] + (span[1] - span[0]) * i as f64 / n as f64)).collect()
}
