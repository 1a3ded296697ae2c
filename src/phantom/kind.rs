//! The shapes that can be asked for.
//!
//! A bifurcation is given as an end-to-side anastomosis is: the host's proximal and distal parts and the graft are half
//! lines from one point, so that its axes, plane and angles are exact by construction.

use crate::random::Stream;
use crate::{Axis, Error, Role, Settings, Tube, Vessel};
use space::{DMat3, DVec3, P3, V3};

/// The kind of phantom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A graft sewn end-to-side to a host, the distal host bent and out of the plane.
    Anastomosis,
    /// A straight tube at any tilt.
    Tube,
    /// A tube along a helix.
    Helix,
    /// An anastomosis with a second, thinner branch from the same point.
    Trifurcation,
    /// A ball: no vessel at all, for tests of closed shapes.
    Sphere,
    /// An anastomosis and a scan of it drawn from a seed (use [`Settings::of`] with it).
    Random(u64),
}

impl Kind {
    /// The name on the command line: `anastomosis`, `tube`, `helix`, `trifurcation`, `sphere`, `random-SEED`.
    pub fn name(self) -> String {
        match self {
            Self::Anastomosis => "anastomosis".into(),
            Self::Tube => "tube".into(),
            Self::Helix => "helix".into(),
            Self::Trifurcation => "trifurcation".into(),
            Self::Sphere => "sphere".into(),
            Self::Random(seed) => format!("random-{seed}"),
        }
    }
}

impl std::str::FromStr for Kind {
    type Err = Error;
    /// The inverse of [`Kind::name`]; `random` alone is `random-1`.
    fn from_str(name: &str) -> Result<Self, Error> {
        match name {
            "anastomosis" => Ok(Self::Anastomosis),
            "tube" => Ok(Self::Tube),
            "helix" => Ok(Self::Helix),
            "trifurcation" => Ok(Self::Trifurcation),
            "sphere" => Ok(Self::Sphere),
            "random" => Ok(Self::Random(1)),
            _ => name
                .strip_prefix("random-")
                .and_then(|s| s.parse().ok())
                .map(Self::Random)
                .ok_or_else(|| Error::UnknownKind(name.into())),
        }
    }
}

/// The shape of an anastomosis, in its own frame: the proximal host along z, the graft in the plane of x and z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bifurcation {
    /// Radius of the host, mm. Default 3.
    pub host_radius_mm: f64,
    /// Radius of the graft, mm. Default 2.5.
    pub graft_radius_mm: f64,
    /// Angle from the proximal host to the graft, degrees, 15..=165. Default 45.
    pub graft_deg: f64,
    /// Angle within the plane from the graft on to the distal host's projection, degrees. Default 123: the host is bent
    /// by 12 degrees in the plane.
    pub distal_planar_deg: f64,
    /// Angle of the distal host out of the plane, towards proximal x graft, degrees. Default 13.
    pub distal_out_deg: f64,
    /// Width of the blend of the two parts of the host, mm. Default 1.5.
    pub host_blend_mm: f64,
    /// Width of the blend of the graft with the host, mm. Default 3.
    pub graft_blend_mm: f64,
}

impl Default for Bifurcation {
    fn default() -> Self {
        Self {
            host_radius_mm: 3.0,
            graft_radius_mm: 2.5,
            graft_deg: 45.0,
            distal_planar_deg: 123.0,
            distal_out_deg: 13.0,
            host_blend_mm: 1.5,
            graft_blend_mm: 3.0,
        }
    }
}

impl Bifurcation {
    /// "anastomosis-45", the shape behind the figures of docs/method: host 3, graft 3.5 mm, 45 degrees, distal straight
    /// in the plane and 10 degrees out of it. See [`Bifurcation::capsules`].
    pub fn benchmark() -> Self {
        Self { graft_radius_mm: 3.5, distal_planar_deg: 135.0, distal_out_deg: 10.0, ..Self::default() }
    }

    /// Radii 2-5 mm (the graft at most 1.15 times the host), graft at 20-90 degrees, the host bent by up to 20 degrees in
    /// the plane and up to 20 degrees out of it.
    pub(crate) fn drawn(seed: u64) -> Self {
        let draw = Stream::new(seed, 0xb1f0);
        let host_radius_mm = draw.between(0, 2.0, 5.0);
        let graft_deg = draw.between(2, 20.0, 90.0);
        Self {
            host_radius_mm,
            graft_radius_mm: draw.between(1, 2.0, (1.15 * host_radius_mm).min(5.0)),
            graft_deg,
            distal_planar_deg: 180.0 - graft_deg - draw.between(3, -20.0, 20.0),
            distal_out_deg: draw.between(4, -20.0, 20.0),
            host_blend_mm: 0.5 * host_radius_mm,
            graft_blend_mm: host_radius_mm,
        }
    }

    /// Unit directions [proximal, distal, graft] in the shape's own frame.
    pub(crate) fn directions(&self) -> [DVec3; 3] {
        let in_plane = |deg: f64| DVec3::new(deg.to_radians().sin(), 0.0, deg.to_radians().cos());
        let (sin, cos) = self.distal_out_deg.to_radians().sin_cos();
        let distal = in_plane(self.graft_deg + self.distal_planar_deg) * cos + DVec3::Y * sin;
        [DVec3::Z, distal, in_plane(self.graft_deg)]
    }

    /// The closed shape of three capsules of this length from `at`, in the patient's axes: genus 0, for benchmarks.
    pub fn capsules(&self, at: P3, length_mm: f64) -> Vessel {
        self.tubes(at, DMat3::IDENTITY, length_mm)
    }

    fn tubes(&self, at: P3, turn: DMat3, length_mm: f64) -> Vessel {
        let radii = [self.host_radius_mm, self.host_radius_mm, self.graft_radius_mm];
        let blends = [0.0, self.host_blend_mm, self.graft_blend_mm];
        let tube = |i: usize, d: DVec3| Tube {
            axis: Axis::Straight { through: at, direction: V3::from_raw(turn * d), range: [0.0, length_mm] },
            radius_mm: radii[i],
            blend_mm: blends[i],
        };
        Vessel::new(self.directions().into_iter().enumerate().map(|(i, d)| tube(i, d)).collect())
    }

    pub(crate) fn faults(&self, within: &mut impl FnMut(&'static str, f64, f64, f64)) {
        within("bifurcation.host_radius_mm", self.host_radius_mm, 0.2, 50.0);
        within("bifurcation.graft_radius_mm", self.graft_radius_mm, 0.2, 50.0);
        within("bifurcation.graft_deg", self.graft_deg, 15.0, 165.0);
        within("bifurcation.distal_planar_deg", self.distal_planar_deg, 0.0, 345.0);
        within("bifurcation.distal_out_deg", self.distal_out_deg, -89.0, 89.0);
        within("bifurcation.host_blend_mm", self.host_blend_mm, 0.0, 50.0);
        within("bifurcation.graft_blend_mm", self.graft_blend_mm, 0.0, 50.0);
    }
}

/// The vessel at a point of the patient, with the role of each tube. `turn` maps the shape's frame to the patient's.
pub(crate) fn vessel(kind: Kind, settings: &Settings, at: P3, turn: DMat3) -> (Vessel, Vec<Role>) {
    let radius_mm = settings.tube_radius_mm;
    let single = |axis| (Vessel::new(vec![Tube { axis, radius_mm, blend_mm: 0.0 }]), vec![Role::Other]);
    let shape = &settings.bifurcation;
    let roles = vec![Role::Proximal, Role::Distal, Role::Graft];
    match kind {
        Kind::Tube => single(Axis::line(at, V3::from_raw(turn.z_axis))),
        Kind::Sphere => single(Axis::Straight { through: at, direction: V3::from_raw(turn.z_axis), range: [0.0, 0.0] }),
        Kind::Helix => {
            // a = kappa / (kappa^2 + tau^2), b = tau / (kappa^2 + tau^2)
            let [kappa, tau] = settings.helix_per_mm;
            let square = kappa * kappa + tau * tau;
            let [axis, towards] = [turn.z_axis, turn.x_axis].map(V3::from_raw);
            single(Axis::Helix { centre: at, axis, towards, radius_mm: kappa / square, advance_mm: tau / square })
        }
        Kind::Anastomosis | Kind::Random(_) => (shape.tubes(at, turn, f64::INFINITY), roles),
        Kind::Trifurcation => {
            // On the graft's far side, 100 degrees of azimuth away, so that the two grow apart.
            let (polar, azimuth) = (60.0_f64.to_radians(), 100.0_f64.to_radians());
            let d = DVec3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
            let mut tubes = shape.tubes(at, turn, f64::INFINITY).tubes().to_vec();
            tubes.push(Tube {
                axis: Axis::ray(at, V3::from_raw(turn * d)),
                radius_mm: 0.8 * shape.graft_radius_mm,
                blend_mm: shape.graft_blend_mm,
            });
            (Vessel::new(tubes), [roles, vec![Role::Other]].concat())
        }
    }
}
