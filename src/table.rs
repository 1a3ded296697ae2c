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
        out = out.trim_end().to_owned() + if truth.is_some() { "            truth     error\n" } else { "\n" };
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

/// Angles and warnings within 80 columns.
pub(crate) fn summary(result: &Value) -> String {
    let mut text = angles(result, None);
    for warning in result["warnings"].as_array().map(Vec::as_slice).unwrap_or_default() {
        let (code, message) = (warning["code"].as_str().unwrap_or("?"), warning["message"].as_str().unwrap_or(""));
        text += &format!("warning {code}:\n{}", wrapped(message, 2));
    }
    text
}

/// Words in lines of at most 79 columns, each behind some blanks; a longer word has a line of its own.
pub(crate) fn wrapped(text: &str, indent: usize) -> String {
    let (mut out, mut line) = (String::new(), String::new());
    let blanks = " ".repeat(indent);
    for word in text.split_whitespace() {
        if !line.is_empty() && indent + line.chars().count() + 1 + word.chars().count() > 79 {
            let _ = writeln!(out, "{blanks}{line}");
            line.clear();
        }
        if !line.is_empty() {
            line.push(' ');
        }
        line += word;
    }
    if !line.is_empty() {
        let _ = writeln!(out, "{blanks}{line}");
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn everything_fits_80_columns_and_no_word_is_lost() {
        let message = "the flow direction at junction 1 is not given: ".repeat(5) + &"x".repeat(90);
        let angle = json!({"name": "graft_host_b_planar", "value": 123.061, "band95": [122.91, 123.21]});
        let result = json!({"warnings": [{"code": "roles.flow_unknown", "message": message}],
            "junctions": [{"medial_point": [4.9, -48.8, -117.9], "angles": [angle]}]});
        let text = summary(&result);
        let long: Vec<&str> = text.lines().filter(|line| line.chars().count() > 80).collect();
        assert_eq!(long, [format!("  {}", "x".repeat(90))]);
        let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert!(words(&text).ends_with(&words(&message)));
        let truth = json!({"angles": {"graft_host_b_planar": 120.0}});
        assert!(angles(&result, Some(&truth)).lines().all(|line| line.chars().count() <= 80));
    }
}
