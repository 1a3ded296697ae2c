//! surface.stl: binary STL in mm, LPS, facet normals out of the lumen. STL holds single precision and no face ids.

use super::{Error, SURFACE_STL};
use surface::TriMesh;

/// surface.stl: an 80 byte header, the count, then 50 bytes per triangle (little endian).
///
/// # Errors
/// [`Error::TooLarge`] beyond 2^32 - 1 triangles; [`Error::Mismatch`], [`Error::NotFinite`].
pub fn surface_stl(mesh: &TriMesh) -> Result<Vec<u8>, Error> {
    super::geometry::checked_mesh(SURFACE_STL, mesh)?;
    let n = mesh.triangles.len();
    let count = u32::try_from(n).map_err(|_| Error::TooLarge {
        artefact: SURFACE_STL,
        bytes: 84 + 50 * n as u64,
        limit: 84 + 50 * u64::from(u32::MAX),
    })?;
    let mut out = Vec::with_capacity(84 + 50 * n);
    // Must not begin with "solid", or readers take the file for ASCII.
    let mut header = [b' '; 80];
    let text = b"vasculum surface, units mm, frame LPS";
    header[..text.len()].copy_from_slice(text);
    out.extend_from_slice(&header);
    out.extend_from_slice(&count.to_le_bytes());
    for t in 0..n {
        let normal = mesh.area_vector(t).normalised().unwrap_or_default();
        let rows = [normal.to_array()].into_iter().chain(mesh.corners(t).map(space::P3::to_array));
        for x in rows.flatten() {
            if !x.is_finite() {
                return Err(Error::NotFinite {
                    artefact: SURFACE_STL,
                    path: format!("triangle {t}"),
                    value: x.to_string(),
                });
            }
            out.extend_from_slice(&(x as f32).to_le_bytes());
        }
        out.extend_from_slice(&0u16.to_le_bytes());
    }
    Ok(out)
}
