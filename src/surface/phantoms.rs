// Random vessels for the survey: tori, balls, bifurcations, trifurcations and loops, from a small seeded generator.

use crate::fields::{self, Analytic};
use imaging::CutPlane;
use space::{P3, V3};

/// A small generator (splitmix64), so that the phantoms are the same everywhere.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
    pub(crate) fn between(&mut self, a: f64, b: f64) -> f64 {
        a + (b - a) * self.roll()
    }
}

/// A vessel with what is known of it.
pub(crate) struct Phantom {
    pub(crate) field: Analytic,
    pub(crate) seed: P3,
    pub(crate) cuts: Vec<CutPlane>,
    pub(crate) euler: i64,
    /// Vessels that meet in its junction; 0 without one.
    pub(crate) branches: usize,
    /// Sections that open its loops.
    pub(crate) sections: Vec<CutPlane>,
}

/// Planes across the z axis at plus and minus a height.
fn ends(height: f64) -> Vec<CutPlane> {
    vec![CutPlane::new(P3::new(0.0, 0.0, height), V3::Z), CutPlane::new(P3::new(0.0, 0.0, -height), -V3::Z)]
}

/// The phantom of a number: its kind is `kind % 4`, its measures are rolled.
pub(crate) fn phantom(dice: &mut Dice, kind: usize) -> Phantom {
    match kind % 4 {
        0 => {
            let (ring, tube) = (dice.between(4.0, 5.0), dice.between(1.2, 1.8));
            let sections = vec![CutPlane::new(P3::new(ring, 0.0, 0.0), V3::Y).within(2.0 * tube)];
            let (field, seed) = (fields::torus(ring, tube), P3::new(ring + tube, 0.0, 0.0));
            Phantom { field, seed, cuts: vec![], euler: 0, branches: 0, sections }
        }
        1 => {
            let r = dice.between(2.0, 3.0);
            let field = fields::sphere(P3::ORIGIN, r);
            Phantom { field, seed: P3::new(r, 0.0, 0.0), cuts: vec![], euler: 2, branches: 0, sections: vec![] }
        }
        2 => {
            let (angle, r) = (dice.between(0.6, 1.4), dice.between(1.2, 2.0));
            let branches = vec![
                (V3::Z, 12.0, 1.6),
                (V3::new(0.0, 0.17, -0.985), 12.0, 1.6),
                (V3::new(angle.sin(), 0.0, angle.cos()), 12.0, r),
            ];
            let field = fields::tree(branches, vec![1.0, 1.5]);
            Phantom {
                field,
                seed: P3::new(1.6, 0.85, -4.925),
                cuts: ends(9.0),
                euler: 2,
                branches: 3,
                sections: vec![],
            }
        }
        _ => {
            let (a, b) = (dice.between(0.7, 1.2), dice.between(0.7, 1.2));
            let branches = vec![
                (-V3::Z, 12.0, 1.8),
                (V3::Z, 12.0, dice.between(1.2, 1.6)),
                (V3::new(a.sin(), 0.0, a.cos()), 12.0, dice.between(1.1, 1.6)),
                (V3::new(-b.sin(), 0.1, b.cos()).normalised().unwrap_or(V3::Y), 12.0, dice.between(1.1, 1.6)),
            ];
            let field = fields::tree(branches, vec![1.0, 1.0, 1.5]);
            Phantom { field, seed: P3::new(1.8, 0.0, -5.0), cuts: ends(7.0), euler: 2, branches: 4, sections: vec![] }
        }
    }
}
