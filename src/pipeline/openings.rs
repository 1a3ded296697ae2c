//! Where vessels leave the data, and the planes that cut them there.
//!
//! The data end in planes that know nothing of vessels. A vessel that leaves one obliquely has no section of its own in it,
//! so it is squared: cut across its medial line at the first place whose section lies in the data whole. Nothing that can
//! be measured is lost, for the sections farther out are open.

use crate::ends::{Ends, WIDE, along, line, outline};
use crate::mesh_fault::MeshFault;
use crate::wall::Wall;
use imaging::CutPlane;
use implicit::Sampled;
use skeleton::{CapHint, MedialGraph, NodeKind};
use space::{P3, Place, V3, Warning};
use surface::{Cap, TriMesh};

/// How far a plane at which the data end is moved inward at once, and at most, mm.
const INWARD_MM: [f64; 2] = [1.0, 4.0];
/// A vessel that leaves the data within so many degrees of their plane's normal stays cut by it: its section is .4 % larger
/// than the one across it.
const SQUARE_DEG: f64 = 5.0;
/// How far inside the data a section must lie to be whole, pixels: the smoothing may move the wall by one.
const MARGIN_PX: f64 = 1.0;
/// Steps along a medial line in search of a whole section, pixels.
const STEP_PX: f64 = 0.25;
/// Ends that are set back by more than so many diameters are told.
const FAR_DIAMETERS: f64 = 2.0;

/// Where planes cut a wall.
pub(crate) struct Openings {
    /// By face id.
    pub(crate) caps: Vec<Cap>,
    /// Caps (face ids) that share a corner of the volume with a larger one: the same vessel ends at both.
    beside: Vec<[u32; 2]>,
}

impl Openings {
    pub(crate) fn new(mesh: &TriMesh, caps: Vec<Cap>) -> Self {
        let beside = beside(mesh, &caps);
        Self { caps, beside }
    }

    /// One hint for each place where a vessel ends.
    pub(crate) fn hints(&self) -> Vec<CapHint> {
        let ends = self.caps.iter().filter(|c| self.end_of(c.face_id) == c.face_id);
        ends.map(|c| CapHint { face_id: c.face_id, centroid: c.centroid, normal: c.plane.outward }).collect()
    }

    /// The cap at which the vessel of a cap ends.
    pub(crate) fn end_of(&self, face_id: u32) -> u32 {
        self.beside.iter().find(|b| b[0] == face_id).map_or(face_id, |b| b[1])
    }

    fn cap(&self, face_id: u32) -> Option<&Cap> {
        self.caps.iter().find(|c| c.face_id == face_id)
    }
}

/// A found end that was squared.
struct Squared {
    /// Face id among the [`Openings`].
    face_id: u32,
    /// Length of medial line between the data's end and the cut, mm.
    set_back_mm: f64,
}

/// The planes that cut the lumen.
pub(crate) struct Planes {
    /// Where the data end.
    data: Vec<CutPlane>,
    /// Ends that the plan asks for.
    given: Ends,
    /// Found ends, squared; one of `squared` for each of its cuts.
    found: Ends,
    squared: Vec<Squared>,
    /// How far each plane of `data` was moved inward, and why.
    inward: Vec<(f64, Place)>,
    warnings: Vec<Warning>,
}

impl Planes {
    pub(crate) fn new(data: &[CutPlane], given: Ends) -> Self {
        Self {
            data: data.to_vec(),
            given,
            found: Ends::new(MedialGraph::default()),
            squared: Vec::new(),
            inward: vec![(0.0, Place::default()); data.len()],
            warnings: Vec::new(),
        }
    }

    /// Planes at which what may be measured ends: the data's own and the plan's.
    pub(crate) fn of_data(&self) -> Vec<CutPlane> {
        self.data.iter().chain(&self.given.cuts).copied().collect()
    }

    /// All planes.
    pub(crate) fn all(&self) -> Vec<CutPlane> {
        self.data.iter().chain(&self.given.cuts).chain(&self.found.cuts).copied().collect()
    }

    /// Whether a point lies on a part of a vessel that is kept.
    pub(crate) fn keeps(&self, p: P3) -> bool {
        self.given.keeps(p) && self.found.keeps(p)
    }

    /// Other planes after a fault of one of them: where the data end in a plane that only grazes a vessel it moves inward; a
    /// found end that cannot be squared stays as it was; what the plan asks for is not touched. `None` where nothing can be
    /// done.
    pub(crate) fn retreat(&mut self, fault: &surface::Error) -> Option<()> {
        use space::Faulty;
        if let Some(plane) = fault.without_rim().filter(|&k| k < self.data.len()) {
            if self.inward[plane].0 >= INWARD_MM[1] {
                return None;
            }
            self.inward[plane] = (self.inward[plane].0 + INWARD_MM[0], fault.place());
            let cut = &mut self.data[plane];
            cut.point = cut.point - cut.outward * INWARD_MM[0];
            return Some(());
        }
        let k = fault.of_plane()?.checked_sub(self.data.len() + self.given.cuts.len())?;
        let cut = *self.found.cuts.get(k)?;
        self.found.drop(k);
        self.squared.remove(k);
        self.warnings.push(oblique(cut.point, &fault.to_string()));
        Some(())
    }

    /// Square the found ends of a graph that was drawn to the caps of `openings`.
    pub(crate) fn square(&mut self, graph: &MedialGraph, openings: &Openings, field: &Sampled, pixel_mm: f64) {
        self.found = Ends::new(graph.clone());
        let data = self.of_data();
        for (tip, node) in graph.nodes.iter().enumerate().filter(|(_, n)| n.kind == NodeKind::End) {
            // ends that the plan asks for, and those of a re-synthesis, lie across their lines
            let own = |c: &&Cap| c.plane.reach_mm == f64::INFINITY;
            let Some(cap) = node.cap.and_then(|id| openings.cap(id)).filter(own) else { continue };
            let Some(own) = graph.edges.iter().position(|e| e.nodes.contains(&tip) && !e.is_loop()) else { continue };
            let side = usize::from(graph.edges[own].nodes[1] == tip);
            let cornered = openings.beside.iter().any(|b| b[1] == cap.face_id);
            let way = Way { graph, own, side };
            if !cornered && way.angle_deg(cap.plane.outward, cap.area_mm2) < SQUARE_DEG {
                continue;
            }
            let Some(back) = way.whole(field, &data, pixel_mm) else {
                self.warnings
                    .push(oblique(cap.centroid, "no whole section lies between the data's end and a junction"));
                continue;
            };
            if let Err(unfit) = self.found.cut((own, side), way.way_at(back), field, pixel_mm) {
                self.warnings.push(oblique(cap.centroid, unfit.reason()));
                continue;
            }
            self.squared.push(Squared { face_id: cap.face_id, set_back_mm: back });
            let radius = way.outward(back).map_or(0.0, |(_, radius)| radius);
            if back > 2.0 * FAR_DIAMETERS * radius {
                let message = format!(
                    "a vessel leaves the data so obliquely that the first section across it that lies in them whole is {back:.1} mm from their end: the surface and its medial line end there"
                );
                self.warnings.push(Warning { code: "ends.set_back", message, place: Place::at(cap.centroid) });
            }
        }
    }

    /// The opening that a cap of the finished wall stands for.
    pub(crate) fn opening_of(&self, cap: &Cap, openings: &Openings) -> Option<u32> {
        if let Some(k) = cap.cut.checked_sub(self.data.len() + self.given.cuts.len()) {
            return self.squared.get(k).map(|s| s.face_id);
        }
        let distance = |c: &&Cap| c.centroid.distance(cap.centroid);
        let same = openings.caps.iter().filter(|c| c.cut == cap.cut);
        same.min_by(|a, b| distance(a).total_cmp(&distance(b))).map(|c| c.face_id)
    }

    /// How far an opening was set back along its medial line, mm.
    fn set_back_mm(&self, opening: Option<u32>) -> f64 {
        self.squared.iter().find(|s| Some(s.face_id) == opening).map_or(0.0, |s| s.set_back_mm)
    }

    /// What was done to the ends.
    pub(crate) fn warnings(self) -> Vec<Warning> {
        let moved = self.inward.into_iter().filter(|(mm, _)| *mm > 0.0);
        let moved = moved.map(|(mm, place)| Warning {
            code: "ends.inward",
            message: format!(
                "the data end where a vessel's wall only grazes the plane of their end: all vessels are cut {mm:.0} mm further in there"
            ),
            place,
        });
        moved.chain(self.warnings).collect()
    }
}

fn oblique(at: P3, reason: &str) -> Warning {
    let message = format!(
        "a vessel leaves the data obliquely and is cut in the plane of their end, not across its medial line: {reason}"
    );
    Warning { code: "ends.oblique", message, place: Place::at(at) }
}

/// A medial line seen from its end `side` (0 or 1).
struct Way<'a> {
    graph: &'a MedialGraph,
    own: usize,
    side: usize,
}

impl Way<'_> {
    /// Arc length from the line's first point, that from its tip given.
    fn way_at(&self, back: f64) -> f64 {
        if self.side == 1 { self.graph.edges[self.own].length_mm() - back } else { back }
    }

    /// Direction out of the lumen, and inscribed radius.
    fn outward(&self, back: f64) -> Option<(V3, f64)> {
        let (tangent, radius) = line(&self.graph.edges[self.own], self.way_at(back))?;
        Some((if self.side == 1 { tangent } else { -tangent }, radius))
    }

    /// Angle between the line and a plane's normal, degrees, where a section across the line would come free of the plane.
    fn angle_deg(&self, normal: V3, area_mm2: f64) -> f64 {
        let free = |(t, _): (V3, f64)| {
            let cosine = t.dot(normal).abs().min(1.0);
            (area_mm2 * cosine / std::f64::consts::PI).sqrt() * (1.0 - cosine * cosine).sqrt() / cosine
        };
        let back = self.outward(0.0).map_or(0.0, free).min(0.5 * self.graph.edges[self.own].length_mm());
        self.outward(back).map_or(0.0, |(t, _)| t.dot(normal).clamp(-1.0, 1.0).acos().to_degrees())
    }

    /// Length of line from its tip to the first section that lies inside all planes whole.
    fn whole(&self, field: &Sampled, planes: &[CutPlane], pixel_mm: f64) -> Option<f64> {
        let edge = &self.graph.edges[self.own];
        let other = &self.graph.nodes[edge.nodes[1 - self.side]];
        let most = match other.kind {
            NodeKind::End => 0.5 * edge.length_mm(),
            NodeKind::Junction => edge.length_mm() - other.radius_mm,
        };
        let inside = |p: P3| planes.iter().all(|c| c.height(p) < -MARGIN_PX * pixel_mm);
        let whole = |&back: &f64| {
            let Some((tangent, radius)) = self.outward(back) else { return false };
            let at = along(edge, self.way_at(back));
            let limit = WIDE * radius;
            inside(at) && outline(field, at, tangent, limit).all(|p| inside(p) && p.distance(at) < limit)
        };
        let step = STEP_PX * pixel_mm;
        (0..).map(|k| step * f64::from(k)).take_while(|back| *back <= most).find(whole)
    }
}

/// The finished wall's caps and the medial lines brought together: lines end where the wall does, and each end names its
/// cap. Gives warnings of the lines at whose ends the smoothed wall has none.
///
/// # Errors
/// [`MeshFault::Skeleton`] of a cap without an end.
pub(crate) fn settle(
    graph: &mut MedialGraph,
    wall: &Wall,
    (planes, openings): (&Planes, &Openings),
    field: &Sampled,
) -> Result<Vec<Warning>, MeshFault> {
    let hints = wall.ends.hints();
    let of = |face_id: u32| planes.opening_of(wall.ends.cap(face_id)?, openings).map(|id| openings.end_of(id));
    let ends: Vec<Option<u32>> = hints.iter().map(|h| of(h.face_id)).collect();
    let mut lost = Vec::new();
    for (n, node) in graph.nodes.iter_mut().enumerate().filter(|(_, n)| n.cap.is_some()) {
        node.cap = hints.iter().zip(&ends).find(|(_, end)| **end == node.cap).map(|(h, _)| h.face_id);
        if node.cap.is_none() {
            let message = format!("branch end {n} reaches no cap of the smoothed surface");
            let place = Place { element: Some(n), ..Place::at(node.position) };
            lost.push(Warning::new("skeleton.end_without_cap", message, place));
        }
    }
    hints.iter().for_each(|hint| skeleton::cut_back(graph, hint));
    skeleton::check(graph, field, &hints)?;
    Ok(lost)
}

/// Where a cap of the finished wall comes from: angle between its plane's normal and the medial line, degrees, and length
/// of line between the data's end and the cap, mm. `None` where no line ends.
pub(crate) fn crossing(cap: &Cap, graph: &MedialGraph, (planes, openings): (&Planes, &Openings)) -> Option<(f64, f64)> {
    let tip = graph.nodes.iter().position(|n| n.cap == Some(cap.face_id))?;
    let own = graph.edges.iter().position(|e| e.nodes.contains(&tip) && !e.is_loop())?;
    let way = Way { graph, own, side: usize::from(graph.edges[own].nodes[1] == tip) };
    let angle = way.angle_deg(cap.plane.outward, cap.area_mm2);
    Some((angle, planes.set_back_mm(planes.opening_of(cap, openings))))
}

/// Caps that share a rim vertex with a larger one, with the largest such: a vessel that leaves the volume across an edge
/// of it is cut by two planes, and has one end.
fn beside(mesh: &TriMesh, caps: &[Cap]) -> Vec<[u32; 2]> {
    let mut at: Vec<Vec<u32>> = vec![Vec::new(); mesh.vertices.len()];
    for (t, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != surface::WALL) {
        t.iter().for_each(|&v| at[v as usize].push(id));
    }
    let area = |id: u32| caps.iter().find(|c| c.face_id == id).map_or(0.0, |c| c.area_mm2);
    let order = |a: &u32, b: &u32| area(*a).total_cmp(&area(*b)).then(b.cmp(a));
    let larger = |id: u32| at.iter().filter(|ids| ids.contains(&id)).flatten().copied().max_by(order).unwrap_or(id);
    // three planes meet in a corner: the largest may be reached over the middle one
    let largest = |id: u32| (0..3).fold(id, |id, _| larger(id));
    caps.iter().map(|c| [c.face_id, largest(c.face_id)]).filter(|[id, largest]| id != largest).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::ends::tests::tee;

    /// The T of radius 1 with the arm along +x cut at `at` by a plane whose normal leans by `degrees`.
    fn leaning(at: f64, degrees: f64) -> (MedialGraph, Sampled, Openings, Planes) {
        let (mut graph, field) = tee();
        let (sin, cos) = degrees.to_radians().sin_cos();
        let plane = CutPlane::new(P3::new(at, 0.0, 0.0), V3::new(cos, 0.0, sin));
        let cap = Cap {
            face_id: 1,
            plane,
            cut: 0,
            centroid: plane.point,
            area_mm2: std::f64::consts::PI / cos,
            perimeter_mm: 6.0,
        };
        graph.nodes[2].cap = Some(1);
        let end = CapHint { face_id: 1, centroid: plane.point, normal: plane.outward };
        skeleton::cut_back(&mut graph, &end);
        let planes = Planes::new(&[plane], Ends::new(MedialGraph::default()));
        (graph, field, Openings { caps: vec![cap], beside: vec![] }, planes)
    }

    #[test]
    fn an_oblique_end_is_cut_across_its_line_where_the_first_section_is_whole() {
        for degrees in [20.0, 45.0, 75.0] {
            let (graph, field, openings, mut planes) = leaning(16.0, degrees);
            planes.square(&graph, &openings, &field, 0.25);
            assert!(planes.warnings.is_empty() || degrees == 75.0, "{:?}", planes.warnings);
            let cut = planes.all()[1];
            assert!(cut.outward.x() > 1.0 - 1e-6, "{cut:?}");
            let slope: f64 = degrees.to_radians().tan();
            let free = slope + 0.25 * (1.0 + slope * slope).sqrt();
            let back = planes.squared[0].set_back_mm;
            assert!(back >= free - 0.07 && back < free + 0.2, "{degrees}: {back} {free}");
            assert!((cut.point.x() - (16.0 - back)).abs() < 1e-9);
            // what lies past it is left out, the rest kept, and what may be measured is as it was
            assert!(!planes.keeps(P3::new(cut.point.x() + 0.1, 0.9, 0.0)));
            assert!(planes.keeps(P3::new(cut.point.x() - 0.1, 0.9, 0.0)) && planes.keeps(P3::new(-10.0, 0.9, 0.0)));
            assert_eq!(planes.of_data().len(), 1);
            let told = planes.warnings().iter().any(|w| w.code == "ends.set_back");
            assert_eq!(told, back > 4.0);
        }
    }

    #[test]
    fn ends_across_the_line_stay_and_those_too_near_a_junction_are_told() {
        let (graph, field, openings, mut planes) = leaning(16.0, 3.0);
        planes.square(&graph, &openings, &field, 0.25);
        assert_eq!((planes.all().len(), planes.warnings().len()), (1, 0));
        let (graph, field, openings, mut planes) = leaning(3.0, 65.0);
        planes.square(&graph, &openings, &field, 0.25);
        assert_eq!(planes.all().len(), 1);
        assert_eq!(planes.warnings()[0].code, "ends.oblique");
    }

    #[test]
    fn planes_that_fail_move_inward_or_are_given_up() {
        let (graph, field, openings, mut planes) = leaning(16.0, 45.0);
        planes.square(&graph, &openings, &field, 0.25);
        let at = P3::new(13.0, 0.0, 0.0);
        let grazes = |plane| surface::Error::GrazingCut { plane, sine: 0.0, at };
        assert_eq!(planes.retreat(&surface::Error::CutRunsOn { plane: 1, reach_mm: 2.0, at }), Some(()));
        assert_eq!(planes.all().len(), 1);
        for _ in 0..4 {
            assert_eq!(planes.retreat(&grazes(0)), Some(()));
        }
        assert_eq!(planes.retreat(&grazes(0)), None);
        assert!((planes.of_data()[0].point.x() - (16.0 - 4.0 * 0.5_f64.sqrt())).abs() < 1e-9);
        let codes: Vec<&str> = planes.warnings().iter().map(|w| w.code).collect();
        assert_eq!(codes, ["ends.inward", "ends.oblique"]);
    }
}
