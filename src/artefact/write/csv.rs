//! angles.csv: one tidy table for R and pandas.
//!
//! One row per observation. `kind` is `value` for the reported angle of a junction (with its 95 % band and its fit
//! window) and `by_distance` for the same angle with the fit window ending at `distance_diameters`. Columns:
//!
//! | column | unit | |
//! |---|---|---|
//! | `junction` | | graph node |
//! | `angle` | | name as in result.json |
//! | `kind` | | `value` or `by_distance` |
//! | `distance_diameters` | graft diameters | end of the fit window, from the axes point |
//! | `value_deg` | degrees | empty when it could not be had |
//! | `band95_low_deg`, `band95_high_deg` | degrees | `value` rows only |
//! | `window_from_diameters`, `window_to_diameters` | graft diameters | `value` rows only |
//!
//! Numbers are rounded as in result.json, empty cells are missing values (NA, NaN).

use super::json::number;
use super::{ANGLES_CSV, Error};
use crate::Reconstruction;
use morphometry::Angle;

const HEADER: [&str; 9] = [
    "junction",
    "angle",
    "kind",
    "distance_diameters",
    "value_deg",
    "band95_low_deg",
    "band95_high_deg",
    "window_from_diameters",
    "window_to_diameters",
];

/// angles.csv.
///
/// # Errors
/// [`Error::NotFinite`] with junction, angle and column; [`Error::Mismatch`] when distances and values differ in number.
pub fn angles_csv(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let mut out = csv::Writer::from_writer(Vec::new());
    out.write_record(HEADER).map_err(encode)?;
    for junction in &r.morphometry.junctions {
        for angle in &junction.angles {
            let row = value_row(junction.node, angle)?;
            out.write_record(&row).map_err(encode)?;
            for row in distance_rows(junction.node, angle)? {
                out.write_record(&row).map_err(encode)?;
            }
        }
    }
    out.into_inner().map_err(|e| Error::Encode { artefact: ANGLES_CSV, reason: e.to_string() })
}

fn encode(e: csv::Error) -> Error {
    Error::Encode { artefact: ANGLES_CSV, reason: e.to_string() }
}

/// Text of a cell; empty for a missing value.
fn cell(value: Option<f64>, junction: usize, angle: &str, column: &str) -> Result<String, Error> {
    let Some(x) = value else { return Ok(String::new()) };
    number(x).ok_or_else(|| Error::NotFinite {
        artefact: ANGLES_CSV,
        path: format!("junction {junction}, {angle}, {column}"),
        value: x.to_string(),
    })
}

fn value_row(junction: usize, a: &Angle) -> Result<Vec<String>, Error> {
    let cell = |value, column| cell(value, junction, &a.name, column);
    Ok(vec![
        junction.to_string(),
        a.name.clone(),
        "value".to_owned(),
        cell(a.window_diameters.map(|w| w[1]), HEADER[3])?,
        cell(a.value_deg, HEADER[4])?,
        cell(a.band95_deg.map(|b| b[0]), HEADER[5])?,
        cell(a.band95_deg.map(|b| b[1]), HEADER[6])?,
        cell(a.window_diameters.map(|w| w[0]), HEADER[7])?,
        cell(a.window_diameters.map(|w| w[1]), HEADER[8])?,
    ])
}

fn distance_rows(junction: usize, a: &Angle) -> Result<Vec<Vec<String>>, Error> {
    let Some(d) = &a.by_distance else { return Ok(Vec::new()) };
    super::error::same_length(ANGLES_CSV, "by_distance values", d.diameters.len(), d.value_deg.len())?;
    let cell = |value, column| cell(value, junction, &a.name, column);
    let row = |(&x, &y): (&f64, &Option<f64>)| {
        let mut row = vec![
            junction.to_string(),
            a.name.clone(),
            "by_distance".to_owned(),
            cell(Some(x), HEADER[3])?,
            cell(y, HEADER[4])?,
        ];
        row.resize(HEADER.len(), String::new());
        Ok(row)
    };
    d.diameters.iter().zip(&d.value_deg).map(row).collect()
}
