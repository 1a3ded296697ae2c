//! The plan's `variant`: a re-synthesis in place of a scan.

use super::{Branch, PlanFaults, Variant, VariantChange};
use morphometry::{Change, Role, What, Which};

impl Variant {
    /// The changes in the morphometry's own words.
    ///
    /// # Errors
    /// [`PlanFaults`] for a change that asks for nothing, or for two things at once.
    pub fn changes(&self) -> Result<Vec<Change>, PlanFaults> {
        self.changes.iter().enumerate().map(|(i, c)| c.change(i)).collect()
    }
}

impl VariantChange {
    fn change(&self, number: usize) -> Result<Change, PlanFaults> {
        let field = |name: &str| format!("variant.changes[{number}]{name}");
        let asked = [
            self.angle_deg.is_some(),
            self.curvature_factor.is_some(),
            self.curvature_per_mm.is_some(),
            self.straight == Some(true),
            self.planar == Some(true),
        ];
        let count = asked.iter().filter(|a| **a).count();
        if count != 1 {
            let message = format!(
                "one of angle_deg, curvature_factor, curvature_per_mm (with torsion_per_mm), straight and planar is wanted, not {count}"
            );
            return Err(PlanFaults::invalid(&field(""), message));
        }
        if self.torsion_per_mm.is_some() && self.curvature_per_mm.is_none() {
            let message = "a line without curvature has no torsion: give curvature_per_mm, too";
            return Err(PlanFaults::invalid(&field(".torsion_per_mm"), message));
        }
        let branch = which(&self.branch);
        let what = if let Some(deg) = self.angle_deg {
            let given = self.to.as_ref().map(which);
            let to = given.or_else(|| (branch == Which::Role(Role::Graft)).then_some(Which::Role(Role::Proximal)));
            let missing =
                || PlanFaults::invalid(&field(".to"), "the branch that the angle is measured against is missing");
            What::Angle { deg, to: to.ok_or_else(missing)? }
        } else if let Some(factor) = self.curvature_factor {
            What::Bend { factor }
        } else if let Some(curvature_per_mm) = self.curvature_per_mm {
            What::Helix { curvature_per_mm, torsion_per_mm: self.torsion_per_mm.unwrap_or(0.0) }
        } else if self.planar == Some(true) {
            What::Planar
        } else {
            What::Bend { factor: 0.0 }
        };
        Ok(Change { branch, what })
    }
}

fn which(branch: &Branch) -> Which {
    match branch {
        Branch::Id(id) => Which::Id(*id),
        // check.rs admits no other word
        Branch::Role(name) => Which::Role(Role::named(name).unwrap_or(Role::Other)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]
    use super::*;
    use crate::plan::Plan;
    use space::Faulty;

    fn changes(text: &str) -> Result<Vec<Change>, PlanFaults> {
        let plan = Plan::parse(format!("{{\"variant\": {{\"changes\": [{text}]}}}}").as_bytes())?;
        plan.variant.unwrap().changes()
    }

    #[test]
    fn changes_are_read_in_order() {
        let read = changes(
            r#"{"branch": "graft", "angle_deg": 60}, {"branch": 2, "curvature_per_mm": 0.05, "torsion_per_mm": -0.03},
               {"branch": "distal", "straight": true}, {"branch": "distal", "planar": true}"#,
        )
        .unwrap();
        let proximal = Which::Role(Role::Proximal);
        assert_eq!(read[0].what, What::Angle { deg: 60.0, to: proximal });
        assert_eq!(
            read[1],
            Change { branch: Which::Id(2), what: What::Helix { curvature_per_mm: 0.05, torsion_per_mm: -0.03 } }
        );
        assert_eq!((read[2].what, read[3].what), (What::Bend { factor: 0.0 }, What::Planar));
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_its_field() {
        for (text, field) in [
            (r#"{"branch": "graft"}"#, "variant.changes[0]"),
            (r#"{"branch": "graft", "planar": true, "straight": true}"#, "variant.changes[0]"),
            (r#"{"branch": "graft", "planar": true, "torsion_per_mm": 1}"#, "variant.changes[0].torsion_per_mm"),
            (r#"{"branch": "distal", "angle_deg": 60}"#, "variant.changes[0].to"),
            (r#"{"branch": "grift", "planar": true}"#, "variant.changes[0].branch"),
            (r#"{"planar": true}"#, "variant.changes[0].branch"),
            (r#"{"branch": 1, "angle_deg": 200, "to": 2}"#, "variant.changes[0].angle_deg"),
            (r#"{"branch": 1, "angel_deg": 20, "to": 2}"#, "variant.changes[0].angel_deg"),
        ] {
            let faults = changes(text).unwrap_err();
            assert_eq!(faults.place().field.as_deref(), Some(field), "{text}: {faults}");
        }
    }
}
