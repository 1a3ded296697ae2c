//! What may not change f, and degenerate input: a clear fault or a right answer, never a wrong one without a word.

#![allow(clippy::unwrap_used, clippy::panic)]

use exec::Ctx;
use imaging::{Axis, Contours, Curve, PeriodicSpline, Plane};
use implicit::{Error, Field, Method, Settings, Variational, fit, interpolant};
use space::{DMat3, P3, V3};

/// Where and in which unit a scan lies: x -> unit (turn x + shift).
#[derive(Clone, Copy)]
struct Frame {
    turn: DMat3,
    shift: V3,
    unit: f64,
}

const PLAIN: Frame = Frame { turn: DMat3::IDENTITY, shift: V3::ZERO, unit: 1.0 };

impl Frame {
    fn vector(&self, v: V3) -> V3 {
        V3::from_raw(self.turn * v.raw())
    }
    fn point(&self, p: P3) -> P3 {
        P3::ORIGIN + (self.vector(p - P3::ORIGIN) + self.shift) * self.unit
    }
}

/// The section of an oblique, slightly threefold vessel at height z, `wider` mm wider than it is.
fn section(frame: &Frame, (number, z): (usize, f64), wider: f64) -> (Plane, Curve) {
    let points: Vec<[f64; 2]> = (0..60)
        .map(|k| {
            let angle = f64::from(k) / 60.0 * std::f64::consts::TAU;
            let r = 3.0 + wider + 0.2 * (3.0 * angle + 0.1 * z).sin() + 0.02 * z;
            [(r * angle.cos() + 0.4 * z) * frame.unit, (r * angle.sin() + 0.01 * z * z) * frame.unit]
        })
        .collect();
    let plane = Plane {
        index: number,
        origin: frame.point(P3::new(0.0, 0.0, z)),
        u: frame.vector(V3::X),
        v: frame.vector(V3::Y),
        u_mm: vec![0.0],
        v_mm: vec![0.0],
    };
    let curve = Curve {
        plane: number,
        lumen: 0,
        spline: PeriodicSpline::through(&points),
        raw: points,
        level: 0.0,
        standard_error_mm: 0.02 * frame.unit,
        level_error_mm: 0.0,
        freedom: 7.0,
        border: Vec::new(),
        hole: false,
    };
    (plane, curve)
}

/// Contours of the sections at these heights, each this much wider.
fn contours(frame: &Frame, sections: &[(f64, f64)]) -> Contours {
    let drawn = sections.iter().enumerate().map(|(k, &(z, wider))| section(frame, (k, z), wider));
    let (planes, curves) = drawn.unzip();
    Contours {
        axis: Axis::Slice,
        planes,
        curves,
        cuts: Vec::new(),
        tips: Vec::new(),
        pixel_mm: 0.5 * frame.unit,
        thickness_mm: None,
        blur: None,
    }
}

fn sections() -> Vec<(f64, f64)> {
    (0..30).map(|k| (1.5 * f64::from(k), 0.0)).collect()
}

fn settings(frame: &Frame, method: Method) -> Settings {
    Settings { offset_mm: frame.unit, method, ..Settings::default() }
}

/// Points within and around the vessel, away from its open ends.
fn targets() -> Vec<P3> {
    (0..60)
        .map(|i| {
            let z = 6.0 + 0.5 * f64::from(i);
            let angle = 2.4 * f64::from(i);
            let r = 1.5 + 0.04 * f64::from(i);
            P3::new(r * angle.cos() + 0.4 * z, r * angle.sin() + 0.01 * z * z, z)
        })
        .collect()
}

fn values(f: &Variational, frame: &Frame) -> Vec<f64> {
    targets().iter().map(|&x| f.value(frame.point(x)) / frame.unit).collect()
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

fn fitted(frame: &Frame, sections: &[(f64, f64)], method: Method) -> Result<Vec<f64>, Error> {
    let ctx = Ctx::new(2).unwrap();
    fit(&contours(frame, sections), &settings(frame, method), &ctx).map(|(f, _)| values(&f, frame))
}

#[test]
fn a_fit_moves_with_the_scan_and_with_its_unit() {
    let turn = DMat3::from_axis_angle(V3::new(0.3, -0.5, 0.8).normalised().unwrap().raw(), 1.1);
    let shift = V3::new(-180.0, 95.0, 1200.0);
    for method in [Method::BySize, Method::Iterative] {
        let before = fitted(&PLAIN, &sections(), method).unwrap();
        for frame in [Frame { turn, shift, unit: 1.0 }, Frame { unit: 1.0 / 25.4, ..PLAIN }] {
            let off = largest_difference(&before, &fitted(&frame, &sections(), method).unwrap());
            // what the solver leaves is 1e-9 of the unit that it works in
            let bound = 1e-8 / frame.unit;
            assert!(off < bound, "{method:?}, unit {}: {off:e} mm", frame.unit);
        }
    }
}

#[test]
fn slices_from_the_other_end_give_the_same_wall() {
    let mut reversed = sections();
    reversed.reverse();
    for method in [Method::BySize, Method::Iterative] {
        let before = fitted(&PLAIN, &sections(), method).unwrap();
        let off = largest_difference(&before, &fitted(&PLAIN, &reversed, method).unwrap());
        assert!(off < 1e-8, "{method:?}: {off:e} mm");
    }
}

#[test]
fn slices_drawn_twice_give_the_same_wall() {
    let once = fitted(&PLAIN, &sections(), Method::BySize).unwrap();
    for apart in [0.0, 1e-12, 1e-7] {
        let twice: Vec<(f64, f64)> =
            sections().iter().flat_map(|&(z, wider)| [(z, wider), (z + apart, wider)]).collect();
        for method in [Method::BySize, Method::Dense, Method::Iterative] {
            let off = largest_difference(&once, &fitted(&PLAIN, &twice, method).unwrap());
            assert!(off < 0.02, "{method:?}, {apart} mm apart: {off} mm");
        }
    }
}

#[test]
fn one_slice_is_refused_however_often_it_is_drawn() {
    let turned = Frame { turn: DMat3::from_rotation_x(0.7), shift: V3::new(20.0, -300.0, 5.0), unit: 1.0 };
    for frame in [PLAIN, turned] {
        for count in [1, 2, 40] {
            for method in [Method::BySize, Method::Dense, Method::Iterative] {
                let one: Vec<(f64, f64)> = (0..count).map(|k| (7.5, -0.01 * f64::from(k))).collect();
                let outcome = fitted(&frame, &one, method);
                let clear = matches!(outcome, Err(Error::Coplanar { .. } | Error::TooFewPoints { .. }));
                assert!(clear, "{count} times, {method:?}: {outcome:?}");
            }
        }
    }
    let none = fitted(&PLAIN, &[], Method::BySize);
    assert!(matches!(none, Err(Error::TooFewPoints { points: 0, .. })), "{none:?}");
}

/// Points of a vessel's wall and inside it with their values.
fn cloud(n: usize) -> (Vec<P3>, Vec<f64>) {
    (0..n)
        .map(|i| {
            let (angle, inside) = (2.399_963 * (i / 2) as f64, (i % 2) as f64);
            let z = 30.0 * (i / 2) as f64 / (n / 2) as f64;
            let r = 3.0 + 0.2 * (2.0 * angle).sin() - inside;
            (P3::new(r * angle.cos() + 0.3 * z, r * angle.sin(), z), inside)
        })
        .unzip()
}

#[test]
fn coincident_points_without_noise_are_a_fault_or_a_right_answer() {
    let ctx = Ctx::new(2).unwrap();
    let tolerance = 1e-8;
    for n in [600, 1100] {
        for (apart, value) in [(0.0, 0.0), (0.0, 0.5), (1e-13, 0.0), (1e-9, 0.0), (1e-9, 0.5), (1e-5, 0.0)] {
            let (mut points, mut values) = cloud(n);
            for k in [10, 200, 400] {
                points.push(points[k] + V3::new(apart, -apart, apart));
                values.push(values[k] + value);
            }
            let noise = vec![0.0; points.len()];
            for method in [Method::BySize, Method::Dense, Method::Iterative] {
                let outcome = interpolant(&points, (&values, &noise), tolerance, method, &ctx);
                let what = format!("{n} points, {apart} mm and {value} apart, {method:?}");
                match outcome {
                    Err(Error::Singular { .. } | Error::Stalled { .. }) => {}
                    Err(e) => panic!("{what}: {e}"),
                    Ok((f, report)) => {
                        // what it says of itself is true, and it is no worse than that at the points themselves
                        let off = points.iter().zip(&values).fold(0.0_f64, |m, (&x, v)| m.max((f.value(x) - v).abs()));
                        assert!(off <= 1.01 * report.residual_max + 1e-6, "{what}: {off:e}, {:e}", report.residual_max);
                        assert!(value == 0.0 || off > 0.0, "{what}");
                        assert!(report.residual_max < 1e-4, "{what}: {:e}", report.residual_max);
                    }
                }
            }
        }
    }
}

#[test]
fn flat_sets_are_refused_by_every_method() {
    let ctx = Ctx::new(1).unwrap();
    let (points, values) = cloud(1600);
    let noise = vec![1e-6; points.len()];
    let oblique = |p: &P3| P3::new(p.x(), p.y(), 40.0 + 0.3 * p.x() - 2.0 * p.y());
    let line = |p: &P3| P3::new(p.z(), 2.0 * p.z() - 7.0, 0.5 * p.z());
    let point = |_: &P3| P3::new(1.0, 2.0, 3.0);
    for (name, flat) in [("plane", &oblique as &dyn Fn(&P3) -> P3), ("line", &line), ("point", &point)] {
        let flat: Vec<P3> = points.iter().map(flat).collect();
        for method in [Method::BySize, Method::Dense, Method::Iterative] {
            let outcome = interpolant(&flat, (&values, &noise), 1e-8, method, &ctx).map(|(_, r)| r.residual_max);
            assert!(matches!(outcome, Err(Error::Coplanar { points: 1600 })), "{name}, {method:?}: {outcome:?}");
        }
    }
}
