//! The numbers that surgeons compare. Names follow contract.md; angles are degrees, lengths mm.

use space::{P3, V3, Warning};

/// What the user may set.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Start of the fit window in graft diameters; `None`: 1.3 times the crotch distance.
    pub fit_from_diameters: Option<f64>,
    /// End of the fit window in graft diameters.
    pub fit_to_diameters: f64,
    /// Who is who.
    pub roles: Roles,
}

impl Default for Settings {
    fn default() -> Self {
        Self { fit_from_diameters: None, fit_to_diameters: 4.0, roles: Roles::default() }
    }
}

/// A point in or near each branch. Without them: the host is the pair nearest to straight, the graft the third branch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Roles {
    /// In the graft.
    pub graft: Option<P3>,
    /// In the host vessel, proximal to the junction.
    pub proximal: Option<P3>,
    /// In the host vessel, distal to the junction.
    pub distal: Option<P3>,
    /// Where the flow of the host comes from; tells proximal from distal when only the rule chose the host.
    pub flow_from: Option<P3>,
}

/// A branch's role at the junction that it was measured from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// The graft (or the side branch).
    Graft,
    /// Host, upstream.
    Proximal,
    /// Host, downstream.
    Distal,
    /// Host, on the side of the smaller angle to the graft; flow direction unknown.
    HostA,
    /// Host, the other side; flow direction unknown.
    HostB,
    /// A branch of a junction with more than three branches, or between junctions, or of a vessel with no junction.
    Other,
}

impl Role {
    /// The name in result.json.
    pub fn name(self) -> &'static str {
        match self {
            Self::Graft => "graft",
            Self::Proximal => "proximal",
            Self::Distal => "distal",
            Self::HostA => "host_a",
            Self::HostB => "host_b",
            Self::Other => "other",
        }
    }

    /// The inverse of [`Role::name`].
    pub fn named(name: &str) -> Option<Self> {
        [Self::Graft, Self::Proximal, Self::Distal, Self::HostA, Self::HostB, Self::Other]
            .into_iter()
            .find(|r| r.name() == name)
    }
}

/// The wall around a section: rays at even angles within the plane normal to its tangent.
#[derive(Clone, Debug, PartialEq)]
pub struct SectionOutline {
    /// Where the rays start (within 5 % of a radius of the area centroid).
    pub centre: P3,
    /// Unit direction of the first ray; the others follow counterclockwise about the tangent.
    pub first: V3,
    /// Lengths of the rays, mm.
    pub radii_mm: Vec<f64>,
}

/// One cross-section normal to the medial line. `None` where it could not be measured (open, leaking).
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// Arc length from the branch's first node, mm.
    pub abscissa_mm: f64,
    /// Centre (area centroid of the section where it is closed).
    pub position: P3,
    /// Unit tangent, from the first node to the last.
    pub tangent: V3,
    /// Radius of the largest inscribed sphere, mm.
    pub radius_inscribed_mm: f64,
    /// Area, mm2.
    pub area_mm2: Option<f64>,
    /// Perimeter, mm.
    pub perimeter_mm: Option<f64>,
    /// Curvature of the medial line, 1/mm.
    pub curvature_per_mm: Option<f64>,
    /// Ratio of the axes of the ellipse with the same second moments of area, shorter over longer.
    pub shape: Option<f64>,
    /// Standard error of the area from the data's noise and spacing, mm2.
    pub area_error_mm2: Option<f64>,
    /// Standard error of the curvature, 1/mm.
    pub curvature_error_per_mm: Option<f64>,
    /// The wall; `None` where the area is, or where it leaks into another lumen.
    pub outline: Option<SectionOutline>,
    /// The lumens of several branches overlap here.
    pub in_junction: bool,
    /// The section is not closed within the data (near an end).
    pub open: bool,
}

impl Section {
    /// sqrt(area / pi), mm.
    pub fn radius_area_mm(&self) -> Option<f64> {
        self.area_mm2.map(|a| (a / std::f64::consts::PI).sqrt())
    }
    /// 2 area / perimeter, mm.
    pub fn radius_hydraulic_mm(&self) -> Option<f64> {
        Some(2.0 * self.area_mm2? / self.perimeter_mm?)
    }
}

/// Which of the curves of constant curvature and torsion is enough for a line, by the Bayesian information criterion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurveKind {
    /// Straight.
    Line,
    /// A circle's arc: no torsion.
    Arc,
    /// Curvature and torsion.
    Helix,
}

impl CurveKind {
    /// The name in result.json.
    pub fn name(self) -> &'static str {
        match self {
            Self::Line => "line",
            Self::Arc => "arc",
            Self::Helix => "helix",
        }
    }
}

/// A helix fitted to the medial line of one branch outside the junction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Helix {
    /// Radius of the helix (not of the vessel), mm.
    pub radius_mm: f64,
    /// Pitch: advance per turn, mm.
    pub pitch_mm: f64,
    /// Curvature, 1/mm.
    pub curvature_per_mm: f64,
    /// Torsion, 1/mm, positive right-handed.
    pub torsion_per_mm: f64,
    /// Distance of the medial line from the helix, mm.
    pub rms_mm: f64,
    /// The simplest curve that describes the line as well: see [`CurveKind`].
    pub enough: CurveKind,
    /// 95 % band of the curvature, 1/mm.
    pub curvature_band95: Option<[f64; 2]>,
    /// 95 % band of the torsion, 1/mm.
    pub torsion_band95: Option<[f64; 2]>,
}

/// Where a branch is narrowest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stenosis {
    /// Smallest area over the area expected there from the rest of the branch (a line through the medians of its two
    /// halves): 1 where nothing narrows.
    pub area_ratio: f64,
    /// Arc length from the branch's first node, mm.
    pub abscissa_mm: f64,
}

/// A branch of the medial graph with its measures.
#[derive(Clone, Debug, PartialEq)]
pub struct Branch {
    /// Equals the graph's edge number.
    pub id: usize,
    /// Role at its (first) junction.
    pub role: Role,
    /// Graph node it leaves (the junction, where it has one).
    pub from_node: usize,
    /// Graph node it reaches.
    pub to_node: usize,
    /// Arc length of the medial line, mm.
    pub length_mm: f64,
    /// Arc length over the distance of its ends.
    pub tortuosity: f64,
    /// Unit direction of its fitted line away from the junction.
    pub direction: Option<V3>,
    /// Median area-equivalent diameter outside the junction, mm.
    pub diameter_mm: Option<f64>,
    /// 95 % band of the diameter, mm.
    pub diameter_band95_mm: Option<[f64; 2]>,
    /// The narrowest section outside the junction.
    pub stenosis: Option<Stenosis>,
    /// Cross-sections, ascending abscissa.
    pub sections: Vec<Section>,
    /// Helix fit, where the branch is long enough to tell.
    pub helix: Option<Helix>,
}

/// An angle as a function of where the fit window ends.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ByDistance {
    /// Distance from `axes_point`, in graft diameters.
    pub diameters: Vec<f64>,
    /// The angle there, degrees.
    pub value_deg: Vec<Option<f64>>,
    /// Largest root mean square distance of a leg's line from its samples, mm: grows with the distance where a vessel
    /// is bent and not where it is straight.
    pub residual_mm: Vec<Option<f64>>,
}

/// One angle of a junction.
#[derive(Clone, Debug, PartialEq)]
pub struct Angle {
    /// `graft_proximal`, `graft_distal_planar`, `distal_normal`, `proximal_distal`, `graft_distal` (with `host_a` and
    /// `host_b` in the places of proximal and distal where the flow is unknown).
    pub name: String,
    /// Degrees; `None` with a warning that says why.
    pub value_deg: Option<f64>,
    /// 95 % band, degrees.
    pub band95_deg: Option<[f64; 2]>,
    /// Fit window, in graft diameters from `axes_point`.
    pub window_diameters: Option<[f64; 2]>,
    /// Dependence on the fitting distance.
    pub by_distance: Option<ByDistance>,
}

/// VMTK's bifurcation vectors, under its own convention.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VmtkAngles {
    /// The branch taken as the inlet, on which the angles depend: the proximal one where it is known, else the widest.
    pub inlet: usize,
    /// In-plane angle per branch, degrees, in branch order.
    pub in_plane_deg: Vec<f64>,
    /// Out-of-plane angle per branch, degrees.
    pub out_of_plane_deg: Vec<f64>,
}

/// A junction with its angles.
#[derive(Clone, Debug, PartialEq)]
pub struct Junction {
    /// Graph node.
    pub node: usize,
    /// The graph node's position: where the medial lines meet.
    pub medial_point: P3,
    /// The point nearest to the fitted lines of the branches.
    pub axes_point: Option<P3>,
    /// Unit normal of the reference plane: proximal x graft.
    pub plane_normal: Option<V3>,
    /// Distance from `axes_point` within which the lumens overlap, mm.
    pub crotch_mm: Option<f64>,
    /// Branch numbers that meet here.
    pub branches: Vec<usize>,
    /// The angles.
    pub angles: Vec<Angle>,
    /// VMTK's convention.
    pub vmtk: Option<VmtkAngles>,
}

/// Everything measured on one vessel tree.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Morphometry {
    /// By number.
    pub branches: Vec<Branch>,
    /// By graph node.
    pub junctions: Vec<Junction>,
    /// What the reader must know.
    pub warnings: Vec<Warning>,
}
