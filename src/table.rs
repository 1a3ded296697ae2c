//! The angle table for people.

use serde_json::Value;
use std::fmt::Write;

/// The junctions' angles of a result.json as text, with truth and error where a truth is given.
pub(crate) fn angles(result: &Value, truth: Option<&Value>) -> String {
    let mut out = String::new();
    let junctions = result["junctions"].as_array().map(Vec::as_slice).unwrap_or_default();
    if junctions.is_empty() {
        return "no junction: no angles\n".into();
    }
    for junction in junctions {
        let at = &junction["medial_point"];
        let place: Vec<String> = (0..3).map(|i| number(&at[i], 1)).collect();
        let _ = writeln!(out, "junction at LPS ({}) mm", place.join(", "));
        let _ = write!(out, "  {:<24}{:>10}  {:<16}", "angle", "degrees", "95 % band");
        out += if truth.is_some() { "     truth     error\n" } else { "\n" };
        for angle in junction["angles"].as_array().map(Vec::as_slice).unwrap_or_default() {
            let name = angle["name"].as_str().unwrap_or("?");
            let _ = write!(out, "  {name:<24}{:>10}  {:<16}", number(&angle["value"], 2), band(&angle["band95"]));
            if let Some(want) = truth.and_then(|t| t["angles"][name].as_f64()) {
                let error = angle["value"].as_f64().map_or("-".into(), |v| format!("{:+.2}", v - want));
                let _ = write!(out, "{want:>10.2}{error:>10}");
            }
            out.push('\n');
        }
    }
    out
}

fn number(v: &Value, digits: usize) -> String {
    v.as_f64().map_or("-".into(), |x| format!("{x:.digits$}"))
}

fn band(v: &Value) -> String {
    match (v[0].as_f64(), v[1].as_f64()) {
        (Some(a), Some(b)) => format!("{a:.2} .. {b:.2}"),
        _ => "-".into(),
    }
}
