//! Ends that the plan asks for: cuts across one vessel each, and what of the data lies past them.
//!
//! Medial lines of the whole lumen are drawn first; every point of `ends.cut_mm` goes to the nearest place on them, where a
//! plane normal to the line cuts. The plane reaches only around its vessel, so that the rest of the vessel past it is left
//! standing alone; it is never meshed, because the points from which wall and lumen are grown are taken from what is kept.

use exec::Ctx;
use imaging::{Contours, CutPlane};
use implicit::{Field, Sampled};
use skeleton::{MedialGraph, NodeKind};
use space::{FaultKind, Faulty, P3, Place, V3};

/// Rays of a section.
const RAYS: usize = 48;
/// A section may be this many times as wide as its inscribed circle; beyond, it runs into another vessel.
const WIDE: f64 = 1.8;
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

/// A place on a medial line.
#[derive(Clone, Copy)]
struct Spot {
    edge: usize,
    /// Arc length from the edge's first node, mm.
    way: f64,
    at: P3,
    distance: f64,
}

/// The cuts, and which points lie past them.
pub(crate) struct Ends {
    graph: MedialGraph,
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
        let mut ends = Self { graph, kept: Vec::new(), cuts: Vec::new() };
        for (index, &[x, y, z]) in points.iter().enumerate() {
            ends.add(index, P3::new(x, y, z), field, contours.pixel_mm)?;
        }
        Ok(ends)
    }

    fn add(&mut self, index: usize, wanted: P3, field: &Sampled, pixel_mm: f64) -> Result<(), EndFault> {
        let far = |distance_mm, diameter_mm| EndFault::Far { index, distance_mm, diameter_mm, at: wanted };
        let spot = self.nearest(wanted).ok_or(far(f64::INFINITY, 0.0))?;
        let (tangent, radius) = self.line(spot).ok_or(far(spot.distance, 0.0))?;
        if spot.distance > 2.0 * radius {
            return Err(far(spot.distance, 2.0 * radius));
        }
        let edge = &self.graph.edges[spot.edge];
        let length = edge.length_mm();
        let free = edge.nodes.map(|n| self.graph.nodes[n].kind == NodeKind::End);
        // Of a vessel with two free ends the shorter part goes.
        let to_last = match free {
            [false, false] => return Err(EndFault::Severs { index, at: spot.at }),
            [true, true] => spot.way > 0.5 * length,
            [_, last] => last,
        };
        let (outward, kept) = if to_last { (tangent, [0.0, spot.way]) } else { (-tangent, [spot.way, length]) };
        let widest = widest(field, spot.at, tangent, WIDE * radius * 1.01);
        if widest > WIDE * radius {
            return Err(EndFault::Junction { index, at: spot.at });
        }
        let reach = (1.1 * widest).hypot(CLOSED_PX * pixel_mm);
        let cut = CutPlane::new(spot.at, outward).within(reach);
        if let Some(other) = self.beside(spot.edge, &cut) {
            let joined = self.graph.edges[other].nodes.iter().any(|n| edge.nodes.contains(n));
            let at = spot.at;
            return Err(if joined { EndFault::Junction { index, at } } else { EndFault::Beside { index, at } });
        }
        self.kept.push((spot.edge, kept));
        self.cuts.push(cut);
        Ok(())
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

    /// Direction of the line, and inscribed radius, at a spot; over one radius, so that single steps do not tilt it.
    fn line(&self, spot: Spot) -> Option<(V3, f64)> {
        let edge = &self.graph.edges[spot.edge];
        let way = edge.abscissae_mm();
        let i = way.partition_point(|&w| w <= spot.way).clamp(1, way.len().checked_sub(1)?);
        let radius = edge.radius_mm[i - 1].max(edge.radius_mm[i]);
        let point = |w: f64| {
            let i = way.partition_point(|&x| x <= w).clamp(1, way.len() - 1);
            let part = ((w - way[i - 1]) / (way[i] - way[i - 1]).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            edge.points[i - 1].lerp(edge.points[i], part)
        };
        let length = way[way.len() - 1];
        let [from, to] = [(spot.way - 0.5 * radius).max(0.0), (spot.way + 0.5 * radius).min(length)];
        (point(to) - point(from)).normalised().map(|t| (t, radius))
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

/// Distance from a point to the wall within a plane, the largest of some rays; `limit` where a ray finds none nearer.
fn widest(field: &Sampled, at: P3, normal: V3, limit: f64) -> f64 {
    let (e, g) = normal.raw().any_orthonormal_pair();
    let (e, g) = (V3::from_raw(e), V3::from_raw(g));
    let ray = |k: usize| {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / RAYS as f64).sin_cos();
        let direction = e * cos + g * sin;
        let step = limit / 64.0;
        (1..=64).map(|i| step * i as f64).find(|&s| field.value(at + direction * s) <= 0.0).unwrap_or(limit)
    };
    (0..RAYS).map(ray).fold(0.0, f64::max)
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
        return Ok(Ends { graph, kept: Vec::new(), cuts: Vec::new() });
    }
    let settings = skeleton::Settings::default();
    let (graph, _) = skeleton::medial_graph(field, &contours.cuts, &[], seeds, &settings, ctx)?;
    Ok(Ends::at(points, graph, field, contours)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use implicit::{Sampled, Smoothing};
    use skeleton::{Edge, Node};
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

    fn tee() -> (MedialGraph, Sampled) {
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
    fn cuts_lie_across_the_line_and_keep_what_hangs_on_the_junction() {
        let (graph, field) = tee();
        let mut ends = Ends { graph, kept: vec![], cuts: vec![] };
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
            let mut ends = Ends { graph: graph.clone(), kept: vec![], cuts: vec![] };
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
