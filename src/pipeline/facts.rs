//! The stages' reports in the words of the artefacts.

use crate::openings::{Openings, Planes, crossing};
use crate::step::StageTime;
use crate::wall::Wall;
use artefact::read::InputReport;
use artefact::reconstruction::{
    Candidate, CapFacts, ImplicitFacts, InputFacts, Patches, QualityFacts, Range, SegmentationFacts, SurfaceFacts,
};
use imaging::{Axis, Contours};
use morphometry::{Morphometry, Role};
use skeleton::MedialGraph;

pub(crate) fn input(r: &InputReport) -> InputFacts {
    InputFacts {
        slices: r.slices,
        missing_slices: r.missing_slices.clone(),
        spacing_mm: r.spacing_mm,
        digest: r.digest.clone(),
    }
}

pub(crate) fn segmentation(contours: &Contours, r: &imaging::Report) -> SegmentationFacts {
    SegmentationFacts {
        threshold: Some(r.threshold),
        psf_sigma_px: r.psf_sigma_px,
        contours: contours.curves.len(),
        lumens: r.lumens.iter().map(|&(plane, count)| [plane, count]).collect(),
        axis: axis(contours.axis).to_owned(),
        candidates: r
            .candidates
            .iter()
            .enumerate()
            .map(|(i, c)| Candidate { score: c.score, chosen: i == 0 })
            .collect(),
    }
}

/// A re-synthesis has rings across its branches and no pixels.
pub(crate) fn rings(contours: &Contours) -> SegmentationFacts {
    let contours = contours.curves.len();
    SegmentationFacts { contours, axis: "branch".to_owned(), ..SegmentationFacts::default() }
}

fn axis(axis: Axis) -> &'static str {
    match axis {
        Axis::Slice => "slice",
        Axis::Row => "row",
        Axis::Column => "column",
    }
}

pub(crate) fn implicit(r: &implicit::FitReport) -> ImplicitFacts {
    ImplicitFacts {
        constraints: r.constraints,
        smoothing: r.smoothing,
        residual_max_mm: r.residual_max_mm,
        residual_rms_mm: r.residual_rms_mm,
        condition: Some(r.condition),
        offset_mm: r.offset_mm,
    }
}

pub(crate) fn surface(
    wall: &Wall,
    ends: (&Planes, &Openings),
    pixel_mm: f64,
    graph: &MedialGraph,
    morphometry: &Morphometry,
) -> SurfaceFacts {
    let d = &wall.displacement;
    SurfaceFacts {
        min_angle_deg: wall.quality.min_angle_deg,
        max_angle_deg: wall.quality.max_angle_deg,
        watertight: true,
        euler: wall.topology.euler,
        components: wall.topology.components,
        max_error_mm: wall.quality.face_max_mm,
        area_mm2: wall.mesh.area(),
        volume_mm3: wall.mesh.volume(),
        displacement_px: Range { min: d.min_mm / pixel_mm, max: d.max_mm / pixel_mm, rms: d.rms_mm / pixel_mm },
        displacement_mm: Range { min: d.min_mm, max: d.max_mm, rms: d.rms_mm },
        report: QualityFacts {
            mesh: wall.quality.clone(),
            hausdorff_mm: wall.hausdorff_mm,
            volume_change: volume_change(wall),
        },
        caps: caps(wall, ends, graph, morphometry),
    }
}

/// Volume between the wall and the unsmoothed one, to first order in their distance, as part of the enclosed volume.
fn volume_change(wall: &Wall) -> f64 {
    let mesh = &wall.mesh;
    let slab = |t: usize| {
        let moved = mesh.triangles[t].iter().fold(0.0, |s, &v| s + wall.displacement.mm[v as usize] / 3.0);
        0.5 * mesh.area_vector(t).length() * moved
    };
    let walls = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == surface::WALL);
    walls.fold(0.0, |s, t| s + slab(t)) / mesh.volume()
}

/// A cap is named by the role of the branch that ends there; by the branch's number where several caps have that role,
/// or by its own where no branch ends.
fn caps(wall: &Wall, ends: (&Planes, &Openings), graph: &MedialGraph, morphometry: &Morphometry) -> Vec<CapFacts> {
    let branch = |c: &surface::Cap| {
        let face = wall.ends.end_of(c.face_id);
        let node = graph.nodes.iter().position(|n| n.cap == Some(face))?;
        morphometry.branches.iter().find(|b| b.from_node == node || b.to_node == node).map(|b| (b.role, b.id))
    };
    let branches: Vec<Option<(Role, usize)>> = wall.ends.caps.iter().map(branch).collect();
    let count = |wanted: &dyn Fn((Role, usize)) -> bool| branches.iter().flatten().filter(|b| wanted(**b)).count();
    let name = |i: usize| match branches[i] {
        Some((role, _)) if role != Role::Other && count(&|b| b.0 == role) == 1 => format!("end_{}", role.name()),
        Some((_, id)) if count(&|b| b.1 == id) == 1 => format!("end_branch_{id}"),
        Some((_, id)) => format!("end_branch_{id}_cap_{}", wall.ends.caps[i].face_id),
        None => format!("end_{}", wall.ends.caps[i].face_id),
    };
    let boundary = boundaries(&wall.ends.caps, &branches);
    let crossing: Vec<_> = wall.ends.caps.iter().map(|c| crossing(c, graph, ends)).collect();
    let fact = |(i, c): (usize, &surface::Cap)| CapFacts {
        oblique_deg: crossing[i].map(|c| c.0),
        set_back_mm: crossing[i].map(|c| c.1),
        face_id: c.face_id,
        name: name(i),
        boundary: boundary[i].clone(),
        centroid: c.centroid,
        normal: c.plane.outward,
        area_mm2: c.area_mm2,
    };
    wall.ends.caps.iter().enumerate().map(fact).collect()
}

/// Caps whose area is within this part of the largest count as equally wide: noise must not swap their names.
const AS_WIDE: f64 = 0.9;

/// Blood comes in by the graft and the proximal vessel, and leaves by all others; without those roles it comes in by the
/// widest end (of equally wide ones the first by place). Numbers go by role, then by face id, which goes by place.
fn boundaries(caps: &[surface::Cap], branches: &[Option<(Role, usize)>]) -> Vec<String> {
    let rank = |i: usize| match branches[i].map(|b| b.0) {
        Some(Role::Graft) => 0,
        Some(Role::Proximal) => 1,
        Some(Role::Distal) => 2,
        Some(Role::HostA) => 3,
        Some(Role::HostB) => 4,
        Some(Role::Other) => 5,
        None => 6,
    };
    let widest = caps.iter().map(|c| c.area_mm2).fold(0.0, f64::max);
    let entrance = caps.iter().position(|c| c.area_mm2 >= AS_WIDE * widest);
    let known = (0..caps.len()).any(|i| rank(i) <= 1);
    let enters = |i: usize| if known { rank(i) <= 1 } else { Some(i) == entrance };
    let mut order: Vec<usize> = (0..caps.len()).collect();
    order.sort_by_key(|&i| (rank(i), caps[i].face_id));
    let inlets = order.iter().filter(|&&i| enters(i)).count();
    let mut names = vec![String::new(); caps.len()];
    let (mut into, mut out) = (0, 0);
    for i in order {
        names[i] = if enters(i) {
            into += 1;
            if inlets == 1 { "inlet".to_owned() } else { format!("inlet_{into}") }
        } else {
            out += 1;
            format!("outlet_{out}")
        };
    }
    names
}

pub(crate) fn patches(p: &surface::Patches) -> Patches<'_> {
    Patches { patch_id: &p.patch_id, u: &p.u, v: &p.v }
}

pub(crate) fn stage(t: &StageTime) -> artefact::write::StageTime {
    artefact::write::StageTime {
        stage: t.name.to_owned(),
        wall_s: t.wall_s,
        cpu_s: Some(t.cpu_s),
        peak_bytes: Some(t.peak_bytes),
    }
}

/// The time now as RFC 3339, UTC, to the second.
pub(crate) fn now_utc() -> String {
    let seconds = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // civil date from days since 1970-01-01 (Hinnant 2013, chrono-compatible low-level date algorithms)
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", rest / 3600, rest / 60 % 60, rest % 60)
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::CutPlane;
    use space::{P3, V3};

    fn names(caps: &[(f64, Option<Role>)]) -> Vec<String> {
        let cap = |(k, c): (usize, &(f64, Option<Role>))| surface::Cap {
            face_id: k as u32 + 1,
            plane: CutPlane::new(P3::ORIGIN, V3::Z),
            cut: k,
            centroid: P3::ORIGIN,
            area_mm2: c.0,
            perimeter_mm: 1.0,
        };
        let of: Vec<surface::Cap> = caps.iter().enumerate().map(cap).collect();
        boundaries(&of, &caps.iter().enumerate().map(|(k, c)| c.1.map(|r| (r, k))).collect::<Vec<_>>())
    }

    #[test]
    fn boundaries_are_named_by_role_and_not_by_a_hair_of_area() {
        let known = [(20.0, Some(Role::Distal)), (28.0, Some(Role::Proximal)), (19.0, Some(Role::Graft))];
        assert_eq!(names(&known), ["outlet_1", "inlet_2", "inlet_1"]);
        assert_eq!(names(&[(28.0, Some(Role::HostA)), (28.1, Some(Role::HostB))]), ["inlet", "outlet_1"]);
        let tree = [(9.0, Some(Role::Other)), (80.0, Some(Role::Other)), (9.0, None)];
        assert_eq!(names(&tree), ["outlet_1", "inlet", "outlet_2"]);
    }
}
