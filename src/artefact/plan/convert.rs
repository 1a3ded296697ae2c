//! The plan in the stages' own words.

use super::Plan;
use imaging::Axis;
use space::P3;

impl Plan {
    /// Settings of the segmentation and the contours.
    pub fn imaging(&self) -> imaging::Settings {
        let s = &self.segmentation;
        imaging::Settings {
            threshold: s.threshold,
            region: s.region.as_ref().map(|r| imaging::Region {
                slice: r.slice,
                centre_px: r.centre_px,
                radius_px: r.radius_px,
            }),
            seeds: s.seeds_mm.iter().map(|p| P3::from(*p)).collect(),
            exclude_slices: s.exclude_slices.clone(),
            psf_sigma_px: s.psf_sigma_px,
            mask: None, // comes with the upload, not with the plan
            axis: match self.contours.axis.as_deref() {
                Some("slice") => Some(Axis::Slice),
                Some("row") => Some(Axis::Row),
                Some("column") => Some(Axis::Column),
                _ => None, // "auto": check.rs admits no other word
            },
        }
    }

    /// Settings of the angles.
    pub fn morphometry(&self) -> morphometry::Settings {
        let point = |p: Option<[f64; 3]>| p.map(P3::from);
        morphometry::Settings {
            fit_from_diameters: self.morphometry.fit_from_diameters,
            fit_to_diameters: self.morphometry.fit_to_diameters,
            roles: morphometry::Roles {
                graft: point(self.roles.graft_mm),
                proximal: point(self.roles.proximal_mm),
                distal: point(self.roles.distal_mm),
                flow_from: point(self.roles.flow_from_mm),
            },
        }
    }
}
