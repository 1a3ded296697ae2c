//! VTK XML PolyData (.vtp) with raw appended data and 64 bit headers.
//!
//! Own writer: vtkio is 8-20 times slower and cannot read raw appended data back (docs of the dependency set). Raw
//! appended data is what ParaView itself writes; it costs no base64 and VTK maps it straight into memory. Positions and
//! measures are Float64, because the surface of two input formats must agree to 1e-6 mm; ids are Int32, connectivity is
//! Int64. Byte order little endian. The header of the file is plain XML and readable.

use super::Error;
use super::error::{all_finite, same_length};
use space::P3;

/// Values of an array.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Values {
    /// Float64.
    Real(Vec<f64>),
    /// Int32.
    Id(Vec<i32>),
    /// Int64, for connectivity.
    Index(Vec<i64>),
    /// UInt8, for cell types.
    Byte(Vec<u8>),
}

/// What a missing value in an array means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Gaps {
    /// Every value must be finite.
    Refused,
    /// NaN marks a value that could not be measured (ParaView draws it in its NaN colour).
    Nan,
}

/// A named array on points or cells.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Array {
    name: &'static str,
    components: usize,
    values: Values,
    gaps: Gaps,
}

impl Array {
    /// One real number per point or cell.
    pub(crate) fn real(name: &'static str, values: Vec<f64>) -> Self {
        Self { name, components: 1, values: Values::Real(values), gaps: Gaps::Refused }
    }
    /// One real number per point or cell, NaN where it could not be measured.
    pub(crate) fn real_or_nan(name: &'static str, values: Vec<f64>) -> Self {
        Self { gaps: Gaps::Nan, ..Self::real(name, values) }
    }
    /// A triple per point or cell.
    pub(crate) fn triple(name: &'static str, values: impl IntoIterator<Item = [f64; 3]>) -> Self {
        Self { components: 3, ..Self::real(name, values.into_iter().flatten().collect()) }
    }
    /// One id per point or cell.
    pub(crate) fn id(name: &'static str, values: impl IntoIterator<Item = usize>) -> Self {
        let values = values.into_iter().map(|x| i32::try_from(x).unwrap_or(i32::MAX)).collect();
        Self { name, components: 1, values: Values::Id(values), gaps: Gaps::Refused }
    }
    fn index(name: &'static str, values: Vec<i64>) -> Self {
        Self { name, components: 1, values: Values::Index(values), gaps: Gaps::Refused }
    }
    /// One byte per cell.
    pub(crate) fn byte(name: &'static str, values: Vec<u8>) -> Self {
        Self { name, components: 1, values: Values::Byte(values), gaps: Gaps::Refused }
    }
    fn len(&self) -> usize {
        match &self.values {
            Values::Real(v) => v.len(),
            Values::Id(v) => v.len(),
            Values::Index(v) => v.len(),
            Values::Byte(v) => v.len(),
        }
    }
    fn type_name(&self) -> &'static str {
        match self.values {
            Values::Real(_) => "Float64",
            Values::Id(_) => "Int32",
            Values::Index(_) => "Int64",
            Values::Byte(_) => "UInt8",
        }
    }
    fn append(&self, raw: &mut Vec<u8>) {
        let bytes: Vec<u8> = match &self.values {
            Values::Real(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Values::Id(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Values::Index(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Values::Byte(v) => v.clone(),
        };
        raw.extend_from_slice(&(bytes.len() as u64).to_le_bytes());
        raw.extend_from_slice(&bytes);
    }
    pub(crate) fn check(&self, artefact: &'static str, count: usize) -> Result<(), Error> {
        same_length(artefact, self.name, count * self.components, self.len())?;
        match (&self.values, self.gaps) {
            (Values::Real(v), Gaps::Refused) => all_finite(artefact, self.name, v),
            _ => Ok(()),
        }
    }
}

/// A poly data set: points with either lines or polygons.
#[derive(Clone, Debug, Default)]
pub(crate) struct PolyData {
    pub points: Vec<P3>,
    pub lines: Vec<Vec<usize>>,
    pub polygons: Vec<[u32; 3]>,
    /// Named lists of words that belong to the whole: the k-th word is that of id k.
    pub words: Vec<(&'static str, Vec<String>)>,
    pub point_arrays: Vec<Array>,
    pub cell_arrays: Vec<Array>,
}

impl PolyData {
    /// The file's bytes.
    ///
    /// # Errors
    /// [`Error::Mismatch`] for arrays of the wrong length or indices beyond the points; [`Error::NotFinite`].
    pub(crate) fn write(&self, artefact: &'static str) -> Result<Vec<u8>, Error> {
        let cells = self.lines.len() + self.polygons.len();
        for a in &self.point_arrays {
            a.check(artefact, self.points.len())?;
        }
        for a in &self.cell_arrays {
            a.check(artefact, cells)?;
        }
        let points = Array::triple("Points", self.points.iter().map(|p| p.to_array()));
        points.check(artefact, self.points.len())?;
        let lines = topology(artefact, self.points.len(), self.lines.iter().map(Vec::as_slice))?;
        let polygons: Vec<Vec<usize>> = self.polygons.iter().map(|t| t.map(|v| v as usize).to_vec()).collect();
        let polygons = topology(artefact, self.points.len(), polygons.iter().map(Vec::as_slice))?;

        let (mut xml, mut raw) = (String::new(), Vec::new());
        xml.push_str("<?xml version=\"1.0\"?>\n");
        xml.push_str(
            "<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n",
        );
        xml.push_str("<!-- frame DICOM LPS, lengths in mm -->\n<PolyData>\n");
        for (name, words) in &self.words {
            xml.push_str(&field_words(name, words));
        }
        xml.push_str(&format!(
            "<Piece NumberOfPoints=\"{}\" NumberOfVerts=\"0\" NumberOfLines=\"{}\" NumberOfStrips=\"0\" NumberOfPolys=\"{}\">\n",
            self.points.len(),
            self.lines.len(),
            self.polygons.len()
        ));
        section(&mut xml, &mut raw, "PointData", &self.point_arrays);
        section(&mut xml, &mut raw, "CellData", &self.cell_arrays);
        section(&mut xml, &mut raw, "Points", std::slice::from_ref(&points));
        section(&mut xml, &mut raw, "Lines", &lines);
        section(&mut xml, &mut raw, "Polys", &polygons);
        xml.push_str("</Piece>\n</PolyData>\n<AppendedData encoding=\"raw\">\n_");
        let mut out = xml.into_bytes();
        out.append(&mut raw);
        out.extend_from_slice(b"\n</AppendedData>\n</VTKFile>\n");
        Ok(out)
    }
}

/// Words as VTK's XML has them: the codes of their letters, each word ended by a 0.
fn field_words(name: &str, words: &[String]) -> String {
    let codes: String = words.iter().flat_map(|w| w.bytes().chain([0])).map(|b| format!("{b} ")).collect();
    let n = words.len();
    format!(
        "<FieldData>\n<Array type=\"String\" Name=\"{name}\" NumberOfTuples=\"{n}\" format=\"ascii\">\n{}\n</Array>\n</FieldData>\n",
        codes.trim_end()
    )
}

/// Connectivity and offsets of some cells.
pub(crate) fn topology<'a>(
    artefact: &'static str,
    points: usize,
    cells: impl Iterator<Item = &'a [usize]>,
) -> Result<[Array; 2], Error> {
    let (mut connectivity, mut offsets) = (Vec::new(), Vec::new());
    for cell in cells {
        for &v in cell {
            if v >= points {
                return Err(Error::Mismatch { artefact, what: "vertex index", expected: points, found: v });
            }
            connectivity.push(v as i64);
        }
        offsets.push(connectivity.len() as i64);
    }
    Ok([Array::index("connectivity", connectivity), Array::index("offsets", offsets)])
}

pub(crate) fn section(xml: &mut String, raw: &mut Vec<u8>, tag: &str, arrays: &[Array]) {
    let normals = if arrays.iter().any(|a| a.name == "Normals") { " Normals=\"Normals\"" } else { "" };
    xml.push_str(&format!("<{tag}{normals}>\n"));
    for a in arrays {
        xml.push_str(&format!(
            "<DataArray type=\"{}\" Name=\"{}\" NumberOfComponents=\"{}\" format=\"appended\" offset=\"{}\"/>\n",
            a.type_name(),
            a.name,
            a.components,
            raw.len()
        ));
        a.append(raw);
    }
    xml.push_str(&format!("</{tag}>\n"));
}

/// A mini-parser for the tests: independent of the writer's types.
#[cfg(test)]
pub(crate) mod reader {
    #![allow(clippy::unwrap_used)]

    /// (type, values as f64) of a named array.
    pub(crate) fn array(bytes: &[u8], name: &str) -> Option<(String, Vec<f64>)> {
        let marker = b"<AppendedData encoding=\"raw\">\n_";
        let at = bytes.windows(marker.len()).position(|w| w == marker)?;
        let xml = std::str::from_utf8(&bytes[..at]).ok()?;
        let raw = &bytes[at + marker.len()..];
        let tag = xml.lines().find(|l| l.contains(&format!("Name=\"{name}\"")))?;
        let attribute = |key: &str| {
            let from = tag.find(&format!("{key}=\"")).unwrap() + key.len() + 2;
            tag[from..from + tag[from..].find('"').unwrap()].to_owned()
        };
        let offset: usize = attribute("offset").parse().unwrap();
        let length = u64::from_le_bytes(raw[offset..offset + 8].try_into().unwrap()) as usize;
        let data = &raw[offset + 8..offset + 8 + length];
        let values = match attribute("type").as_str() {
            "Float64" => data.chunks(8).map(|c| f64::from_le_bytes(c.try_into().unwrap())).collect(),
            "Int64" => data.chunks(8).map(|c| i64::from_le_bytes(c.try_into().unwrap()) as f64).collect(),
            "UInt8" => data.iter().map(|&b| f64::from(b)).collect(),
            "Int32" => data.chunks(4).map(|c| f64::from(i32::from_le_bytes(c.try_into().unwrap()))).collect(),
            other => panic!("type {other}"),
        };
        Some((attribute("type"), values))
    }
}
