//! A phantom set into its stack: the vessel in the patient, the unrelated vessels around it, and the truth.

use crate::frame::{Frame, samples};
use crate::kind::vessel;
use crate::random::Stream;
use crate::tissue::Outline;
use crate::truth::plane_normal;
use crate::{
    Angles, Axis, BranchTruth, DistractorTruth, Error, HelixTruth, JunctionTruth, Kind, Role, Settings, Truth, Tube,
    Vessel,
};
use space::{DMat3, DVec3, P3, V3};

/// Voxels of the largest stack that is made: 512 x 512 x 1024, 1 GiB of grey values.
const VOXEL_LIMIT: u128 = 1 << 28;
/// Places tried for one unrelated vessel before it is refused; crowded phantoms of the survey need up to some hundred.
const TRIES: usize = 3000;
/// Radii of the three unrelated vessels, mm.
const DISTRACTOR_RADII_MM: [f64; 3] = [2.8, 2.2, 1.6];
/// Bending radius of the second one, mm.
const ARC_MM: f64 = 150.0;
/// Points of the plan's roles lie this many graft diameters from the junction, or at 80 % of a shorter branch.
const ROLE_DIAMETERS: f64 = 4.0;

/// A phantom in its place.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The vessel in the patient: the exact function for tests.
    pub vessel: Vessel,
    /// What is true of it.
    pub truth: Truth,
    pub(crate) settings: Settings,
    pub(crate) frame: Frame,
    pub(crate) outline: Outline,
    /// The unrelated vessels, which touch neither each other nor the vessel.
    pub(crate) distractors: Vessel,
}

impl Scene {
    /// Place a phantom; no image is made.
    ///
    /// # Errors
    /// [`Error::Settings`] with every fault of the settings; [`Error::TooLarge`]; [`Error::OutsideStack`];
    /// [`Error::NoRoom`] for the unrelated vessels.
    pub fn new(kind: Kind, settings: &Settings) -> Result<Self, Error> {
        let faults = settings.faults();
        if !faults.is_empty() {
            return Err(Error::Settings(faults));
        }
        let voxels = settings.columns as u128 * settings.rows as u128 * settings.slices as u128;
        if voxels > VOXEL_LIMIT {
            return Err(Error::TooLarge { voxels, limit: VOXEL_LIMIT });
        }
        let frame = Frame::of(settings);
        let turn = frame.axes
            * DMat3::from_rotation_z(settings.spin_deg.to_radians())
            * DMat3::from_rotation_y(settings.tilt_deg.to_radians());
        let at = frame.to_patient(DVec3::from_array(settings.shift_mm));
        let (vessel, roles) = vessel(kind, settings, at, turn);
        let branches = branches(&vessel, &roles, frame)?;
        let along = |b: &BranchTruth| {
            let [first, last] = frame.span(&b.axis).unwrap_or_default();
            samples(&b.axis, [first, last], 1.0).into_iter().map(|p| (frame.to_local(p), b.radius_mm)).collect()
        };
        let axes: Vec<(DVec3, f64)> = branches.iter().flat_map(|b| -> Vec<(DVec3, f64)> { along(b) }).collect();
        let outline = Outline::of(settings, &axes);
        let room = Room { settings, frame, outline, vessel: &vessel, host: V3::from_raw(turn.z_axis) };
        let distractors = room.distractors()?;
        let l = &settings.levels;
        let truth = Truth {
            kind: kind.name(),
            junction: junction(at, &branches),
            helix: (kind == Kind::Helix).then(|| helix(settings)),
            branches,
            noise_sigma: settings.snr.map_or(0.0, |snr| (l.lumen - l.tissue) / snr),
            half_level: 0.5 * (l.lumen + l.tissue),
            missing_slices: (0..settings.slices).filter(|k| settings.missing_slices.contains(k)).collect(),
            distractors,
        };
        let distractors = Vessel::new(truth.distractors.iter().map(|d| d.tube).collect());
        Ok(Self { vessel, truth, settings: settings.clone(), frame, outline, distractors })
    }
}

fn branches(vessel: &Vessel, roles: &[Role], frame: Frame) -> Result<Vec<BranchTruth>, Error> {
    let branch = |(i, (tube, &role)): (usize, (&Tube, &Role))| {
        let axis = tube.axis;
        let [first, last] = frame.span(&axis).ok_or(Error::OutsideStack(axis.point(0.0)))?;
        let length_mm = last - first;
        let junction = vessel.tubes().len() > 1;
        Ok(BranchTruth {
            role,
            from: axis.point(first),
            to: axis.point(last),
            direction: axis.tangent(first),
            length_mm,
            radius_mm: tube.radius_mm,
            area_mm2: std::f64::consts::PI * tube.radius_mm * tube.radius_mm,
            circular_from_mm: if junction { vessel.circular_from(i, length_mm) } else { Some(0.0) },
            axis,
        })
    };
    vessel.tubes().iter().zip(roles).enumerate().map(branch).collect()
}

fn junction(axes_point: P3, branches: &[BranchTruth]) -> Option<JunctionTruth> {
    let of = |role| branches.iter().find(|b| b.role == role);
    let (graft, proximal, distal) = (of(Role::Graft)?, of(Role::Proximal)?, of(Role::Distal)?);
    let reach = ROLE_DIAMETERS * 2.0 * graft.radius_mm;
    let point = |b: &BranchTruth| b.axis.point(reach.min(0.8 * b.length_mm));
    Some(JunctionTruth {
        axes_point,
        plane_normal: plane_normal(graft.direction, proximal.direction)?,
        angles: Angles::of(graft.direction, proximal.direction, distal.direction)?,
        graft_point: point(graft),
        proximal_point: point(proximal),
        distal_point: point(distal),
    })
}

fn helix(settings: &Settings) -> HelixTruth {
    let [curvature_per_mm, torsion_per_mm] = settings.helix_per_mm;
    let square = curvature_per_mm * curvature_per_mm + torsion_per_mm * torsion_per_mm;
    HelixTruth {
        curvature_per_mm,
        torsion_per_mm,
        radius_mm: curvature_per_mm / square,
        pitch_mm: std::f64::consts::TAU * torsion_per_mm / square,
    }
}

/// What an unrelated vessel must keep clear of.
struct Room<'a> {
    settings: &'a Settings,
    frame: Frame,
    outline: Outline,
    vessel: &'a Vessel,
    host: V3,
}

impl Room<'_> {
    /// Each at the first of [`TRIES`] drawn places that keeps the asked distance from all before it.
    fn distractors(&self) -> Result<Vec<DistractorTruth>, Error> {
        let mut placed: Vec<DistractorTruth> = Vec::new();
        for number in 0..self.settings.distractors {
            let draw = Stream::new(self.settings.seed, 0xd157 + number as u64);
            let clearance_mm = self.settings.clearance_mm;
            let found = (0..TRIES)
                .filter_map(|t| self.candidate(number, draw, t as u64, &placed))
                .find(|d| d.clearance_mm >= clearance_mm)
                .ok_or(Error::NoRoom { number, clearance_mm, tries: TRIES })?;
            placed.push(found);
        }
        Ok(placed)
    }

    fn candidate(
        &self,
        number: usize,
        draw: Stream,
        attempt: u64,
        placed: &[DistractorTruth],
    ) -> Option<DistractorTruth> {
        let value = |i: u64, low, high| draw.between(8 * attempt + i, low, high);
        let half = self.frame.half;
        let at = DVec3::new(value(0, -0.76, 0.76) * half.x, value(1, -0.76, 0.76) * half.y, 0.0);
        let at = self.frame.to_patient(at);
        let radius_mm = DISTRACTOR_RADII_MM[number.min(2)];
        // Lean at most so far that a long stack does not lead it out of the image.
        let most = (0.5 * half.x.min(half.y) / half.z.max(1.0)).atan().to_degrees();
        let lean = value(2, 15.0, 35.0).min(most).to_radians();
        let azimuth = value(3, 0.0, std::f64::consts::TAU);
        let oblique = DVec3::new(lean.sin() * azimuth.cos(), lean.sin() * azimuth.sin(), lean.cos());
        let oblique = V3::from_raw(self.frame.axes * oblique);
        let axis = match number {
            0 => Axis::line(at, self.host),
            1 => {
                let towards = oblique.any_orthonormal();
                Axis::Circle { centre: at - towards * ARC_MM, towards, tangent: oblique, radius_mm: ARC_MM }
            }
            _ => Axis::line(at, oblique),
        };
        let tube = Tube { axis, radius_mm, blend_mm: 0.0 };
        let span = self.frame.span(&axis)?;
        let clearance_mm = self.clearance(&tube, span, placed)?;
        Some(DistractorTruth { tube, ends: span.map(|s| axis.point(s)), clearance_mm })
    }

    /// Least distance between walls along the span and a little past it; `None` where the body is left.
    fn clearance(&self, tube: &Tube, span: [f64; 2], placed: &[DistractorTruth]) -> Option<f64> {
        let others = Vessel::new(placed.iter().map(|d| d.tube).collect());
        let past = self.settings.thickness_mm + 2.0 * tube.radius_mm;
        let mut least = f64::INFINITY;
        for p in samples(&tube.axis, [span[0] - past, span[1] + past], 0.5) {
            let nearest = self.vessel.distance(p).max(others.distance(p));
            least = least.min(-nearest - tube.radius_mm);
            if least < self.settings.clearance_mm || !self.outline.holds(self.frame.to_local(p), tube.radius_mm) {
                return None;
            }
        }
        Some(least)
    }
}
