//! The medial line to numbers: branches, reference plane, angles, sections, helix.

mod types;

pub use types::{Angle, Branch, ByDistance, Helix, Junction, Morphometry, Role, Roles, Section, Settings, VmtkAngles};
