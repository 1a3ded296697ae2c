//! The medial line to numbers: branches, reference plane, angles, sections, helix.
//!
//! [`measure`] is the whole; its stages are public for tests and studies.

mod angle;
mod bands;
mod crotch;
mod error;
mod fit;
mod helix;
mod junction;
mod line;
mod linear;
mod measure;
mod path;
mod resynthesis;
mod roles;
mod section;
mod track;
mod types;
mod vmtk;

pub use angle::{Undefined, plane_normal};
pub use crotch::crotch_distance;
pub use error::Error;
pub use fit::{FittedLine, fit_line, meeting_point};
pub use helix::fit_helix;
pub use measure::{measure, measure_with_bands};
pub use resynthesis::{
    Change, Model, ModelBranch, ModelJunction, ModelSection, Resynthesis, What, Which, resynthesise,
};
pub use section::{Cut, Lumen, Outline, RAYS};
pub use types::{
    Angle, Branch, ByDistance, CurveKind, Helix, Junction, Morphometry, Role, Roles, Section, SectionOutline, Settings,
    Stenosis, VmtkAngles,
};
