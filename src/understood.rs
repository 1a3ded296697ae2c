//! What `validate` understood, for people: a few lines within 80 columns (all of it with `--json`).

use crate::table::wrapped;
use serde_json::Value;
use std::fmt::Write;

/// Input, vessel, warnings.
pub(crate) fn words(facts: &Value) -> String {
    let mut out = String::new();
    let input = &facts["input"];
    let mut line = |name: &str, text: String| {
        let _ = writeln!(out, "{name:<14}{text}");
    };
    let missing = numbers(&input["missing_slices"]);
    let missing = if missing.is_empty() { String::new() } else { format!(" (missing: {})", listed(&missing)) };
    line("format", plain(&input["format"]));
    line("slices", format!("{}{missing}", input["slices"]));
    line("pixels", format!("{} rows x {} columns", input["rows"], input["columns"]));
    line("spacing", format!("{} mm (row, column, slice)", listed_floats(&input["spacing_mm"], " x ", 3)));
    if let Some(t) = input["thickness_mm"].as_f64() {
        line("thickness", format!("{} mm", float(t, 3)));
    }
    line("rows run", direction(&input["row_direction"]));
    line("columns run", direction(&input["column_direction"]));
    let corner = |k: usize| listed_floats(&input["corners_mm"][k], ", ", 1);
    line("from", format!("({}) mm LPS", corner(0)));
    line("to", format!("({}) mm LPS", corner(7)));
    if let Some(voxels) = input["mask_voxels"].as_u64() {
        line("mask", format!("{voxels} voxels"));
    }
    let found = &facts["segmentation"];
    if found.is_null() {
        line("vessel", "no contours were found or looked for".to_owned());
    } else {
        line("vessel", format!("{} contours across the {} axis", found["contours"], plain(&found["axis"])));
        line("lumens", lumens(&found["lumens"]));
        let level = found["threshold"].as_f64().map_or("local".to_owned(), |t| float(t, 1));
        line("level", format!("{level} (grey value of the wall)"));
        if let Some(sigma) = found["psf_sigma_px"].as_f64() {
            line("blur", format!("sigma {} pixels", float(sigma, 2)));
        }
    }
    for warning in facts["warnings"].as_array().map(Vec::as_slice).unwrap_or_default() {
        let _ = write!(
            out,
            "warning {}:\n{}",
            plain(&warning["code"]),
            wrapped(warning["message"].as_str().unwrap_or(""), 2)
        );
    }
    out
}

/// Runs of slices with the same number of lumens: `1 in slices 0 to 36, 2 in slices 37 to 59`.
fn lumens(counts: &Value) -> String {
    let mut runs: Vec<(u64, u64, u64)> = Vec::new();
    for one in counts.as_array().map(Vec::as_slice).unwrap_or_default() {
        let (slice, count) = (one["slice"].as_u64().unwrap_or(0), one["count"].as_u64().unwrap_or(0));
        match runs.last_mut() {
            Some((n, _, last)) if *n == count && *last + 1 == slice => *last = slice,
            _ => runs.push((count, slice, slice)),
        }
    }
    let text = |(n, first, last): &(u64, u64, u64)| {
        if first == last { format!("{n} in slice {first}") } else { format!("{n} in slices {first} to {last}") }
    };
    let text: Vec<String> = runs.iter().map(text).collect();
    wrapped(&text.join(", "), 14).trim().to_owned()
}

fn direction(v: &Value) -> String {
    const WAYS: [[&str; 2]; 3] = [["left", "right"], ["posterior", "anterior"], ["superior", "inferior"]];
    let x: Vec<f64> = v.as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    let largest = (0..x.len().min(3)).max_by(|&a, &b| x[a].abs().total_cmp(&x[b].abs()));
    let way = largest.map_or("?", |k| WAYS[k][usize::from(x[k] < 0.0)]);
    format!("towards {way} ({})", listed_floats(v, ", ", 3))
}

fn plain(v: &Value) -> String {
    v.as_str().unwrap_or("?").to_owned()
}

fn numbers(v: &Value) -> Vec<String> {
    v.as_array().into_iter().flatten().map(Value::to_string).collect()
}

fn listed(numbers: &[String]) -> String {
    wrapped(&numbers.join(", "), 14).trim().to_owned()
}

fn listed_floats(v: &Value, between: &str, digits: usize) -> String {
    let all: Vec<String> =
        v.as_array().into_iter().flatten().filter_map(Value::as_f64).map(|x| float(x, digits)).collect();
    all.join(between)
}

/// A number without zeros at its end.
fn float(x: f64, digits: usize) -> String {
    let text = format!("{x:.digits$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_scan_is_told_in_lines_that_fit_a_terminal() {
        let lumens: Vec<Value> = (0..60).map(|k| json!({"slice": k, "count": 1 + k / 37})).collect();
        let facts = json!({
            "input": {"format": "dicom", "slices": 60, "rows": 512, "columns": 512, "missing_slices": [7, 9],
                "spacing_mm": [0.3, 0.3, 1.0], "thickness_mm": 1.0, "row_direction": [1.0, 0.0, 0.0],
                "column_direction": [0.0, -1.0, 0.0], "corners_mm": vec![json!([-59.35, -0.0, 88.75]); 8]},
            "segmentation": {"axis": "slice", "threshold": 614.94, "psf_sigma_px": 0.5995, "contours": 83, "lumens": lumens},
            "warnings": [{"code": "stack.gap", "message": "a slice is missing ".repeat(9)}]});
        let text = words(&facts);
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
        for wanted in [
            "0.3 x 0.3 x 1 mm",
            "60 (missing: 7, 9)",
            "towards anterior",
            "1 in slices 0 to 36, 2 in slices 37 to 59",
            "(-59.4, 0, 88.8) mm",
            "level         614.9",
        ] {
            assert!(text.contains(wanted), "{wanted} in\n{text}");
        }
    }
}
