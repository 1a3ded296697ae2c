//! Ends that the plan asks for: cuts across one vessel each, and what of the data lies past them.
//!
//! Medial lines of the whole lumen are drawn first; every point of `ends.cut_mm` goes to the nearest place on them, where a
//! plane normal to the line cuts. The plane reaches only around its vessel, so that the rest of the vessel past it is left
//! standing alone; it is never meshed, because the points from which wall and lumen are grown are taken from what is kept.

use exec::Ctx;
use imaging::{Contours, CutPlane};
use implicit::{Field, Sampled};
use skeleton::{Edge, MedialGraph, NodeKind};
use space::{FaultKind, Faulty, P3, Place, V3};

/// Length of a line for its direction, radii: over two the ends of noisy scans (SNR 12) lean by 2.4 degrees.
const FITTED: f64 = 3.0;
/// Samples of a line for its direction.
const SAMPLES: usize = 17;
/// Rays of a section.
const RAYS: usize = 48;
/// A section may be this many times as wide as its inscribed circle; beyond, it runs into another vessel.
pub(crate) const WIDE: f64 = 1.8;
/// How far past its plane a cut closes the lumen, pixels; twice what `Bounded` leaves standing.
const CLOSED_PX: f64 = 8.0;

/// A cut that cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum EndFault {
    #[error(
        "ends.cut_mm[{index}] lies {distance_mm:.1} mm from the nearest medial line, more than its diameter of {diameter_mm:.1} mm: give a point in the vessel"
    )]
    Far { index: usize, distance_mm: f64, diameter_mm: f64, at: P3 },
    #[error("ends.cut_mm[{index}] lies in a junction, where vessels run into each other: move the cut away from it")]
    Junction { index: usize, at: P3 },
    #[error(
        "ends.cut_mm[{index}] cuts a vessel between two junctions: other vessels hang on what lies past it; cut those, each by itself"
    )]
    Severs { index: usize, at: P3 },
    #[error("ends.cut_mm[{index}] would also cut the vessel beside it: move the cut along the vessel")]
    Beside { index: usize, at: P3 },
}

impl Faulty for EndFault {
    fn kind(&self) -> FaultKind {
        FaultKind::Input
    }
    fn code(&self) -> &'static str {
        match self {
            Self::Far { .. } => "ends.far",
            Self::Junction { .. } => "ends.junction",
            Self::Severs { .. } => "ends.severs",
            Self::Beside { .. } => "ends.beside",
        }
    }
    fn place(&self) -> Place {
        let (Self::Far { index, at, .. }
        | Self::Junction { index, at }
        | Self::Severs { index, at }
        | Self::Beside { index, at }) = self;
        Place { field: Some(format!("ends.cut_mm[{index}]")), ..Place::at(*at) }
    }
}

/// Why no cut can be made across a medial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unfit {
    /// Vessels run into each other there.
    Junction,
    /// Another vessel is too near.
    Beside,
}

impl Unfit {
    pub(crate) fn reason(self) -> &'static str {
        match self {
            Self::Junction => "the place lies in a junction",
            Self::Beside => "the cut would also cut the vessel beside it",
        }
    }
}

/// A place on a medial line.
#[derive(Clone, Copy)]
struct Spot {
    edge: usize,
    /// Arc length from the edge's first node, mm.
    way: f64,
    at: P3,
    distance: f64,
}

/// Cuts across medial lines, and which points lie past them.
pub(crate) struct Ends {
    pub(crate) graph: MedialGraph,
    /// Per cut: edge, and the stretch of it that is kept.
    kept: Vec<(usize, [f64; 2])>,
    pub(crate) cuts: Vec<CutPlane>,
}

impl Ends {
    /// Planes at the wanted points.
    ///
    /// # Errors
    /// [`EndFault`] of the first point at which no cut can be made.
    pub(crate) fn at(
        points: &[[f64; 3]],
        graph: MedialGraph,
        field: &Sampled,
        contours: &Contours,
    ) -> Result<Self, EndFault> {
        let mut ends = Self::new(graph);
        for (index, &[x, y, z]) in points.iter().enumerate() {
            ends.add(index, P3::new(x, y, z), field, contours.pixel_mm)?;
        }
        Ok(ends)
    }

    fn add(&mut self, index: usize, wanted: P3, field: &Sampled, pixel_mm: f64) -> Result<(), EndFault> {
        let far = |distance_mm, diameter_mm| EndFault::Far { index, distance_mm, diameter_mm, at: wanted };
        let spot = self.nearest(wanted).ok_or(far(f64::INFINITY, 0.0))?;
        let (_, radius) = line(&self.graph.edges[spot.edge], spot.way).ok_or(far(spot.distance, 0.0))?;
        if spot.distance > 2.0 * radius {
            return Err(far(spot.distance, 2.0 * radius));
        }
        let edge = &self.graph.edges[spot.edge];
        let free = edge.nodes.map(|n| self.graph.nodes[n].kind == NodeKind::End);
        // Of a vessel with two free ends the shorter part goes.
        let side = match free {
            [false, false] => return Err(EndFault::Severs { index, at: spot.at }),
            [true, true] => usize::from(spot.way > 0.5 * edge.length_mm()),
            [_, last] => usize::from(last),
        };
        self.cut((spot.edge, side), spot.way, field, pixel_mm).map_err(|unfit| match unfit {
            Unfit::Junction => EndFault::Junction { index, at: spot.at },
            Unfit::Beside => EndFault::Beside { index, at: spot.at },
        })
    }

    /// Cut an edge across its line at an arc length; what lies towards its node `side` (0 or 1) goes.
    pub(crate) fn cut(
        &mut self,
        (own, side): (usize, usize),
        way: f64,
        field: &Sampled,
        pixel_mm: f64,
    ) -> Result<(), Unfit> {
        let edge = &self.graph.edges[own];
        let length = edge.length_mm();
        let (tangent, radius) = line(edge, way).ok_or(Unfit::Junction)?;
        let (outward, kept) = if side == 1 { (tangent, [0.0, way]) } else { (-tangent, [way, length]) };
        let at = along(edge, way);
        let widest = widest(field, at, tangent, WIDE * radius * 1.01);
        if widest > WIDE * radius {
            return Err(Unfit::Junction);
        }
        let reach = (1.1 * widest).hypot(CLOSED_PX * pixel_mm);
        let cut = CutPlane::new(at, outward).within(reach);
        if let Some(other) = self.beside(own, &cut) {
            let joined = self.graph.edges[other].nodes.iter().any(|n| edge.nodes.contains(n));
            return Err(if joined { Unfit::Junction } else { Unfit::Beside });
        }
        self.kept.push((own, kept));
        self.cuts.push(cut);
        Ok(())
    }

    /// Take one of the cuts back.
    pub(crate) fn drop(&mut self, k: usize) {
        self.kept.remove(k);
        self.cuts.remove(k);
    }

    /// No cuts yet across the lines of a graph.
    pub(crate) fn new(graph: MedialGraph) -> Self {
        Self { graph, kept: Vec::new(), cuts: Vec::new() }
    }

    /// Whether a point lies on what is kept: its nearest place on the medial lines does.
    pub(crate) fn keeps(&self, p: P3) -> bool {
        let within = |s: Spot| self.kept.iter().all(|&(e, [from, to])| e != s.edge || (s.way >= from && s.way <= to));
        self.kept.is_empty() || self.nearest(p).is_none_or(within)
    }

    fn nearest(&self, p: P3) -> Option<Spot> {
        let mut best: Option<Spot> = None;
        for (edge, e) in self.graph.edges.iter().enumerate() {
            let way = e.abscissae_mm();
            for (i, w) in e.points.windows(2).enumerate() {
                let step = w[1] - w[0];
                let part = ((p - w[0]).dot(step) / step.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
                let at = w[0].lerp(w[1], part);
                let distance = at.distance(p);
                if best.is_none_or(|b| distance < b.distance) {
                    best = Some(Spot { edge, way: way[i] + part * step.length(), at, distance });
                }
            }
        }
        best
    }

    /// Another vessel whose lumen comes within reach of a cut on its outer side.
    fn beside(&self, own: usize, cut: &CutPlane) -> Option<usize> {
        let meets = |(&p, &r): (&P3, &f64)| {
            let height = (p - cut.point).dot(cut.outward);
            height > -r && p.distance(cut.point) < cut.reach_mm + r
        };
        let mut others = self.graph.edges.iter().enumerate().filter(|(k, _)| *k != own);
        others.find(|(_, e)| e.points.iter().zip(&e.radius_mm).any(meets)).map(|(k, _)| k)
    }
}

/// The point of a line at an arc length.
pub(crate) fn along(edge: &Edge, way: f64) -> P3 {
    let ways = edge.abscissae_mm();
    let i = ways.partition_point(|&x| x <= way).clamp(1, ways.len() - 1);
    let part = ((way - ways[i - 1]) / (ways[i] - ways[i - 1]).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    edge.points[i - 1].lerp(edge.points[i], part)
}

/// Direction of a line, and inscribed radius, at an arc length: the slope there of the parabola that fits three radii of it
/// best, so that single steps do not tilt it, nor the bend of a line that ends there.
pub(crate) fn line(edge: &Edge, way: f64) -> Option<(V3, f64)> {
    let ways = edge.abscissae_mm();
    let i = ways.partition_point(|&w| w <= way).clamp(1, ways.len().checked_sub(1)?);
    let radius = edge.radius_mm[i - 1].max(edge.radius_mm[i]);
    let length = ways[ways.len() - 1];
    let from = (way - 0.5 * FITTED * radius).min(length - FITTED * radius).max(0.0);
    let to = (from + FITTED * radius).min(length);
    let [half, middle] = [0.5 * (to - from), 0.5 * (to + from)];
    // slope and bend against t in -1..1, orthogonal over evenly spaced samples
    let samples = || (0..SAMPLES).map(|k| 2.0 * k as f64 / (SAMPLES - 1) as f64 - 1.0);
    let (t2, t4) = samples().fold((0.0, 0.0), |(a, b), t| (a + t * t, b + t.powi(4)));
    let mean = t2 / SAMPLES as f64;
    let zero = V3::X * 0.0;
    let (slope, bend) = samples().fold((zero, zero), |(slope, bend), t| {
        let p = along(edge, middle + half * t) - edge.points[0];
        (slope + p * t, bend + p * (t * t - mean))
    });
    let at = (way - middle) / half;
    let tangent = slope * t2.recip() + bend * (2.0 * at / (t4 - mean * t2));
    tangent.normalised().map(|t| (t, radius))
}

/// The outline of the lumen's section across a line: where rays within the plane meet the wall, `limit` away at most.
pub(crate) fn outline(field: &Sampled, at: P3, normal: V3, limit: f64) -> impl Iterator<Item = P3> {
    let (e, g) = normal.raw().any_orthonormal_pair();
    let (e, g) = (V3::from_raw(e), V3::from_raw(g));
    (0..RAYS).map(move |k| {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / RAYS as f64).sin_cos();
        let direction = e * cos + g * sin;
        let step = limit / 64.0;
        let way = (1..=64).map(|i| step * i as f64).find(|&s| field.value(at + direction * s) <= 0.0).unwrap_or(limit);
        at + direction * way
    })
}

/// Distance from a point to the wall within a plane, the largest of some rays; `limit` where a ray finds none nearer.
fn widest(field: &Sampled, at: P3, normal: V3, limit: f64) -> f64 {
    outline(field, at, normal, limit).fold(0.0, |most, p| most.max(p.distance(at)))
}

/// The cuts that the plan asks for; none without them, and then nothing is computed.
///
/// # Errors
/// [`crate::mesh_fault::MeshFault`] of the medial lines or of a cut.
pub(crate) fn ends(
    points: &[[f64; 3]],
    field: &Sampled,
    contours: &Contours,
    seeds: &[P3],
    ctx: &Ctx,
) -> Result<Ends, crate::mesh_fault::MeshFault> {
    if points.is_empty() {
        let graph = MedialGraph { nodes: Vec::new(), edges: Vec::new() };
        return Ok(Ends::new(graph));
    }
    let settings = skeleton::Settings::default();
    let (graph, _) = skeleton::medial_graph(field, &contours.cuts, &[], seeds, &settings, ctx)?;
    Ok(Ends::at(points, graph, field, contours)?)
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use implicit::{Sampled, Smoothing};
    use skeleton::Node;
    use space::Aabb;

    /// Tubes of radius 1 along the x axis from -20 to 20 and along the y axis from the origin to 20.
    struct Tee;
    impl Field for Tee {
        fn value(&self, x: P3) -> f64 {
            let host = x.y().hypot(x.z());
            let branch = if x.y() > 0.0 { x.x().hypot(x.z()) } else { x.x().hypot(x.y()).hypot(x.z()) };
            1.0 - host.min(branch)
        }
        fn gradient(&self, x: P3) -> (f64, V3) {
            let h = 1e-5;
            let slope = |d: V3| (self.value(x + d * h) - self.value(x - d * h)) / (2.0 * h);
            (self.value(x), V3::new(slope(V3::X), slope(V3::Y), slope(V3::Z)))
        }
        fn hessian(&self, x: P3) -> (f64, V3, space::DMat3) {
            let (f, g) = self.gradient(x);
            (f, g, space::DMat3::ZERO)
        }
        fn bounds(&self) -> Aabb<space::Patient> {
            Aabb { min: P3::new(-20.0, -3.0, -3.0), max: P3::new(20.0, 20.0, 3.0) }
        }
    }

    pub(crate) fn tee() -> (MedialGraph, Sampled) {
        let node = |kind, position| Node { kind, position, radius_mm: 1.0, cap: None };
        let tips = [P3::ORIGIN, P3::new(-20.0, 0.0, 0.0), P3::new(20.0, 0.0, 0.0), P3::new(0.0, 20.0, 0.0)];
        let kinds = [NodeKind::Junction, NodeKind::End, NodeKind::End, NodeKind::End];
        let nodes: Vec<Node> = kinds.into_iter().zip(tips).map(|(k, p)| node(k, p)).collect();
        let line = |k: usize| {
            let points: Vec<P3> = (0..=40).map(|i| tips[0].lerp(tips[k], f64::from(i) / 40.0)).collect();
            Edge { nodes: [0, k], radius_mm: vec![1.0; points.len()], points }
        };
        let wall: Vec<P3> = (0..400)
            .flat_map(|i| (0..12).map(move |k| (i, k)))
            .flat_map(|(i, k)| {
                let (s, c) = (std::f64::consts::TAU * f64::from(k) / 12.0).sin_cos();
                [P3::new(f64::from(i) * 0.1 - 20.0, c, s), P3::new(c, f64::from(i) * 0.05, s)]
            })
            .collect();
        let sampling = Smoothing::new(0.25).sampling();
        let field = Sampled::new(&Tee, &wall, &sampling, &Ctx::new(1).unwrap()).unwrap();
        (MedialGraph { nodes, edges: (1..4).map(line).collect() }, field)
    }

    #[test]
    fn lines_have_the_direction_of_their_bend_up_to_their_ends() {
        let (radius, turn) = (20.0, 1.2);
        let point = |a: f64| P3::new(radius * a.cos(), radius * a.sin(), 0.0);
        let points: Vec<P3> = (0..=60).map(|k| point(turn * f64::from(k) / 60.0)).collect();
        let edge = Edge { nodes: [0, 1], radius_mm: vec![3.0; points.len()], points };
        for way in [0.0, 0.4, 9.0, 23.5, edge.length_mm()] {
            let (direction, _) = line(&edge, way).unwrap();
            let a = way / radius;
            let off = direction.dot(V3::new(-a.sin(), a.cos(), 0.0)).min(1.0).acos().to_degrees();
            // a chord from an end over one radius is off by 4 degrees
            assert!(off < 0.3, "{way} {off}");
        }
    }

    #[test]
    fn cuts_lie_across_the_line_and_keep_what_hangs_on_the_junction() {
        let (graph, field) = tee();
        let mut ends = Ends::new(graph);
        ends.add(0, P3::new(0.4, 9.0, 0.3), &field, 0.25).unwrap();
        let cut = ends.cuts[0];
        assert!(cut.point.distance(P3::new(0.0, 9.0, 0.0)) < 1e-9 && cut.outward.y() > 1.0 - 1e-9);
        assert!(cut.reach_mm < 4.0);
        assert!(ends.keeps(P3::new(0.0, 8.9, 1.0)) && !ends.keeps(P3::new(0.0, 15.0, 1.0)));
        assert!(ends.keeps(P3::new(-15.0, 1.0, 0.0)));
    }

    #[test]
    fn cuts_that_cannot_be_made_say_why_and_where() {
        let (graph, field) = tee();
        let code = |graph: &MedialGraph, p: P3| {
            let mut ends = Ends::new(graph.clone());
            let e = ends.add(3, p, &field, 0.25).unwrap_err();
            assert_eq!(e.place().field.as_deref(), Some("ends.cut_mm[3]"));
            assert!(e.place().position.is_some());
            e.code()
        };
        assert_eq!(code(&graph, P3::new(8.0, 8.0, 0.0)), "ends.far");
        assert_eq!(code(&graph, P3::new(0.0, 0.5, 0.0)), "ends.junction");
        let mut between = graph.clone();
        between.nodes[3].kind = NodeKind::Junction;
        assert_eq!(code(&between, P3::new(0.0, 9.0, 0.0)), "ends.severs");
        // A vessel that runs back alongside.
        let mut beside = graph;
        let [from, to] = [P3::new(2.2, 5.0, 0.0), P3::new(2.2, 15.0, 0.0)];
        let points: Vec<P3> = (0..=20).map(|i| from.lerp(to, f64::from(i) / 20.0)).collect();
        beside.nodes.extend([beside.nodes[1].clone(), beside.nodes[1].clone()]);
        beside.edges.push(Edge { nodes: [4, 5], radius_mm: vec![1.0; points.len()], points });
        assert_eq!(code(&beside, P3::new(-0.5, 9.0, 0.0)), "ends.beside");
    }
}
