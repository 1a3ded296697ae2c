//! Triangle meshes whose faces carry an id.

use space::{P3, V3};

/// Face id of the vessel wall. Caps are numbered from 1.
pub const WALL: u32 = 0;

/// An oriented triangle mesh in the patient frame, mm. Normals point out of the lumen (counterclockwise seen from
/// outside).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Vertex positions.
    pub vertices: Vec<P3>,
    /// Vertex indices of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// For each triangle [`WALL`], or k >= 1 for the k-th cap.
    pub face_id: Vec<u32>,
}

impl TriMesh {
    /// The corners of a triangle.
    pub fn corners(&self, t: usize) -> [P3; 3] {
        self.triangles[t].map(|v| self.vertices[v as usize])
    }
    /// Twice the area times the unit normal of a triangle.
    pub fn area_vector(&self, t: usize) -> V3 {
        let [a, b, c] = self.corners(t);
        (b - a).cross(c - a)
    }
    /// Total area, mm2.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).fold(0.0, |s, t| s + 0.5 * self.area_vector(t).length())
    }
    /// Enclosed volume, mm3 (divergence theorem about the first vertex; meaningful for closed meshes).
    pub fn volume(&self) -> f64 {
        let Some(&o) = self.vertices.first() else { return 0.0 };
        (0..self.triangles.len()).fold(0.0, |s, t| s + (self.corners(t)[0] - o).dot(self.area_vector(t)) / 6.0)
    }
}
