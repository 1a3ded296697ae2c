//! patches.vtu: the wall as VTK Lagrange quadrilaterals (cell type 70).
//!
//! VTK names the four corners first, then the edges (bottom, right, top, left, each by growing parameter), then the inside
//! row by row. Cell arrays: `PatchId`, the branch as in surface.vtp (beside sections between junctions: after the caps'
//! ids). Neighbouring patches name the same points along their common edge.

use super::error::same_length;
use super::vtp::{Array, section, topology};
use super::{Error, PATCHES_VTU};
use surface::Quads;

/// VTK_LAGRANGE_QUADRILATERAL.
const LAGRANGE_QUADRILATERAL: u8 = 70;

/// VTK's order of the nodes of a quadrilateral, as places in rows of order + 1.
fn order_of_vtk(p: usize) -> Vec<usize> {
    let at = |b: usize, a: usize| b * (p + 1) + a;
    let mut out = vec![at(0, 0), at(0, p), at(p, p), at(p, 0)];
    out.extend((1..p).map(|a| at(0, a)));
    out.extend((1..p).map(|b| at(b, p)));
    out.extend((1..p).map(|a| at(p, a)));
    out.extend((1..p).map(|b| at(b, 0)));
    out.extend((1..p).flat_map(|b| (1..p).map(move |a| at(b, a))));
    out
}

/// patches.vtu.
///
/// # Errors
/// [`Error::Mismatch`] for patches with a wrong number of nodes, [`Error::NotFinite`].
pub fn patches_vtu(quads: &Quads) -> Result<Vec<u8>, Error> {
    let order = order_of_vtk(quads.order);
    let mut cells = Vec::with_capacity(quads.cells.len());
    for c in &quads.cells {
        same_length(PATCHES_VTU, "nodes of a patch", order.len(), c.len())?;
        cells.push(order.iter().map(|&k| c[k] as usize).collect::<Vec<_>>());
    }
    let [connectivity, offsets] = topology(PATCHES_VTU, quads.nodes.len(), cells.iter().map(Vec::as_slice))?;
    let types = Array::byte("types", vec![LAGRANGE_QUADRILATERAL; cells.len()]);
    let points = Array::triple("Points", quads.nodes.iter().map(|p| p.to_array()));
    let patch = Array::id("PatchId", quads.branch.iter().map(|&b| b as usize));
    points.check(PATCHES_VTU, quads.nodes.len())?;
    patch.check(PATCHES_VTU, cells.len())?;
    let (mut xml, mut raw) = (String::new(), Vec::new());
    xml.push_str("<?xml version=\"1.0\"?>\n");
    xml.push_str(
        "<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n",
    );
    xml.push_str("<!-- frame DICOM LPS, lengths in mm -->\n<UnstructuredGrid>\n");
    let (n, m) = (quads.nodes.len(), cells.len());
    xml.push_str(&format!("<Piece NumberOfPoints=\"{n}\" NumberOfCells=\"{m}\">\n"));
    section(&mut xml, &mut raw, "PointData", &[]);
    section(&mut xml, &mut raw, "CellData", &[patch]);
    section(&mut xml, &mut raw, "Points", &[points]);
    section(&mut xml, &mut raw, "Cells", &[connectivity, offsets, types]);
    xml.push_str("</Piece>\n</UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_");
    let mut out = xml.into_bytes();
    out.append(&mut raw);
    out.extend_from_slice(b"\n</AppendedData>\n</VTKFile>\n");
    Ok(out)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::write::vtp::reader::array;
    use space::P3;

    #[test]
    fn corners_come_first_then_edges_then_the_inside() {
        assert_eq!(order_of_vtk(2), [0, 2, 8, 6, 1, 5, 7, 3, 4]);
        let nodes: Vec<P3> = (0..9).map(|k| P3::new(f64::from(k % 3), f64::from(k / 3), 0.0)).collect();
        let quads = Quads { order: 2, nodes, cells: vec![(0..9).collect()], branch: vec![3], ..Quads::default() };
        let bytes = patches_vtu(&quads).unwrap();
        assert_eq!(array(&bytes, "types").unwrap(), ("UInt8".to_owned(), vec![70.0]));
        assert_eq!(array(&bytes, "connectivity").unwrap().1, [0.0, 2.0, 8.0, 6.0, 1.0, 5.0, 7.0, 3.0, 4.0]);
        assert_eq!(array(&bytes, "PatchId").unwrap().1, [3.0]);
        let short = Quads { cells: vec![vec![0; 8]], ..quads };
        assert!(patches_vtu(&short).is_err());
    }
}
