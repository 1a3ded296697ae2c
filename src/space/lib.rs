//! The vocabulary that every other crate speaks: frames, points, boxes, grids, faults and places.
//!
//! Lengths are millimetres and angles radians unless a name says `_deg`. [`Patient`] is the DICOM patient frame
//! (LPS: x to the left, y to posterior, z to the head). A [`Point`] and a [`Vector`] carry their frame as a type, so
//! that a voxel index and a position in the patient cannot be mixed. This crate depends on nothing of ours.

mod fault;
mod frame;
mod grid;

pub use fault::{FaultKind, Faulty, Place, Warning};
pub use frame::{Affine, Patient, Point, Vector, Voxel};
pub use glam::{DMat3, DVec2, DVec3};
pub use grid::{Aabb, Grid};

/// A position in the patient frame (LPS, mm).
pub type P3 = Point<Patient>;
/// A displacement or direction in the patient frame (LPS, mm).
pub type V3 = Vector<Patient>;
