//! Every fault of a plan at once: unknown fields with the nearest known name, types, ranges.

use super::Plan;
use serde_json::{Map, Value};
use space::{FaultKind, Faulty, Place};
use std::fmt;

/// Largest plan. A plan of contract.md's form takes 1 kB; a million slice positions are no plan.
const MAX_BYTES: usize = 1 << 20;
/// Deepest nesting; the contract's needs 4.
const MAX_DEPTH: usize = 32;
/// Most faults that are told; more are the same mistake again.
const MAX_FAULTS: usize = 100;
/// Positions beyond 100 m are a mistake of units.
const FAR_MM: f64 = 1e5;
/// Directions may miss unit length and a right angle by this: printed numbers of four decimals do.
const DIRECTION_TOLERANCE: f64 = 1e-3;

/// One thing that is wrong with a plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanFault {
    /// `plan.not_json`, `plan.too_large`, `plan.unknown_field` or `plan.invalid`.
    pub code: &'static str,
    /// Dotted path of the field, such as `segmentation.threshold`; empty for the whole plan.
    pub field: String,
    /// What is wrong and what would be right.
    pub message: String,
}

/// All that is wrong with a plan; never empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanFaults {
    /// In the order of the plan's fields.
    pub faults: Vec<PlanFault>,
}

impl PlanFaults {
    /// A single invalid field.
    pub(crate) fn invalid(field: &str, message: impl Into<String>) -> Self {
        Self { faults: vec![PlanFault { code: "plan.invalid", field: field.to_owned(), message: message.into() }] }
    }
}

impl fmt::Display for PlanFaults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, fault) in self.faults.iter().enumerate() {
            let sep = if i == 0 { "" } else { "; " };
            let field = if fault.field.is_empty() { "the plan" } else { &fault.field };
            write!(f, "{sep}{field}: {}", fault.message)?;
        }
        Ok(())
    }
}

impl std::error::Error for PlanFaults {}

impl Faulty for PlanFaults {
    fn kind(&self) -> FaultKind {
        match self.code() {
            "plan.too_large" => FaultKind::Limit,
            _ => FaultKind::Input,
        }
    }
    fn code(&self) -> &'static str {
        self.faults.first().map_or("plan.invalid", |f| f.code)
    }
    fn place(&self) -> Place {
        match self.faults.first() {
            Some(f) if !f.field.is_empty() => Place::field(&f.field),
            _ => Place::none(),
        }
    }
}

/// What a field may hold.
#[derive(Clone, Copy)]
enum Rule {
    /// A number in a closed range.
    Number(f64, f64),
    /// Two numbers in a closed range.
    Pair(f64, f64),
    /// Two numbers in a closed range, the first smaller than the second.
    Ascending(f64, f64),
    /// Three finite numbers.
    Point,
    /// A list of points.
    Points,
    /// A unit vector.
    Direction,
    /// A list of different numbers.
    Positions,
    /// A whole number from 0.
    Index,
    /// A list of whole numbers.
    Indices,
    /// A whole number from 1 that a sample of 16 bits can hold.
    Label,
    /// A series' number or UID: digits and dots, at most 64.
    Series,
    /// One of some words.
    Word(&'static [&'static str]),
    /// A list of some words.
    Words(&'static [&'static str]),
    /// True or false.
    Flag,
    /// A branch's role or number.
    Branch,
    /// A list of objects; the first field of each is needed.
    Objects(&'static [(&'static str, Rule)]),
    /// An object; with `true` all its fields are needed.
    Object(&'static [(&'static str, Rule)], Presence),
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Presence {
    Optional,
    Required,
}

use Presence::{Optional, Required};
use Rule::*;

/// The contract's plan. Spacings: 0.1 micrometre to 100 mm, between histology and a mistake of units.
const PLAN: &[(&str, Rule)] = &[
    ("geometry", Object(GEOMETRY, Optional)),
    ("series", Series),
    ("segmentation", Object(SEGMENTATION, Optional)),
    ("contours", Object(&[("axis", Word(&["auto", "slice", "row", "column"]))], Optional)),
    (
        "roles",
        Object(&[("graft_mm", Point), ("proximal_mm", Point), ("distal_mm", Point), ("flow_from_mm", Point)], Optional),
    ),
    ("smoothing", Object(&[("max_displacement_px", Number(0.0, 5.0))], Optional)),
    ("surface", Object(&[("max_error_mm", Number(1e-5, 10.0)), ("edge_mm", Ascending(1e-4, 100.0))], Optional)),
    ("ends", Object(&[("extension_diameters", Number(0.0, 100.0)), ("cut_mm", Points)], Optional)),
    (
        "morphometry",
        Object(&[("fit_from_diameters", Number(0.0, 100.0)), ("fit_to_diameters", Number(0.1, 100.0))], Optional),
    ),
    ("outputs", Words(&["surface", "skeleton", "volume", "graphml", "swc", "field", "patches"])),
    ("variant", Object(&[("changes", Objects(CHANGE))], Optional)),
];

const CHANGE: &[(&str, Rule)] = &[
    ("branch", Branch),
    ("angle_deg", Number(5.0, 175.0)),
    ("to", Branch),
    ("curvature_factor", Number(0.0, 10.0)),
    ("curvature_per_mm", Number(0.0, 10.0)),
    ("torsion_per_mm", Number(-10.0, 10.0)),
    ("straight", Flag),
    ("planar", Flag),
];

/// Roles that a change may name.
pub const ROLES: &[&str] = &["graft", "proximal", "distal", "host_a", "host_b"];
/// Most changes of a variant.
const MAX_CHANGES: usize = 100;

const GEOMETRY: &[(&str, Rule)] = &[
    ("pixel_spacing_mm", Pair(1e-4, 100.0)),
    ("slice_spacing_mm", Number(1e-4, 100.0)),
    ("slice_positions_mm", Positions),
    ("origin_mm", Point),
    ("row_direction", Direction),
    ("column_direction", Direction),
];

const SEGMENTATION: &[(&str, Rule)] = &[
    ("threshold", Number(-1e30, 1e30)),
    (
        "region",
        Object(&[("slice", Index), ("centre_px", Pair(-1.0, 65536.0)), ("radius_px", Number(0.5, 65536.0))], Required),
    ),
    ("seeds_mm", Points),
    ("exclude_slices", Indices),
    ("psf_sigma_px", Number(0.0, 50.0)),
    ("label", Label),
];

impl Plan {
    /// A plan from JSON.
    ///
    /// # Errors
    /// [`PlanFaults`] with every fault: `plan.not_json` (line and column), `plan.too_large` (1 MiB, depth 32),
    /// `plan.unknown_field` (with the nearest known name), `plan.invalid`.
    pub fn parse(bytes: &[u8]) -> Result<Self, PlanFaults> {
        let whole =
            |code, message: String| PlanFaults { faults: vec![PlanFault { code, field: String::new(), message }] };
        if bytes.len() > MAX_BYTES {
            return Err(whole("plan.too_large", format!("{} bytes; at most {MAX_BYTES} are read", bytes.len())));
        }
        if nesting(bytes) > MAX_DEPTH {
            return Err(whole("plan.too_large", format!("nested deeper than {MAX_DEPTH}")));
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let mut value: Value =
            serde_json::from_slice(text).map_err(|e| whole("plan.not_json", format!("not JSON: {e}")))?;
        let mut faults = Vec::new();
        check("", &value, &Object(PLAN, Optional), &mut faults);
        if faults.is_empty() {
            across(&value, &mut faults);
        }
        if !faults.is_empty() {
            return Err(PlanFaults { faults });
        }
        drop_nulls(&mut value);
        serde_json::from_value(value).map_err(|e| whole("plan.invalid", e.to_string()))
    }
}

/// Deepest nesting of brackets outside strings.
fn nesting(bytes: &[u8]) -> usize {
    let (mut depth, mut deepest, mut string, mut escaped) = (0usize, 0, false, false);
    for &b in bytes {
        match b {
            _ if escaped => escaped = false,
            b'\\' if string => escaped = true,
            b'"' => string = !string,
            b'{' | b'[' if !string => depth += 1,
            b'}' | b']' if !string => depth = depth.saturating_sub(1),
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    deepest
}

fn drop_nulls(value: &mut Value) {
    if let Value::Object(map) = value {
        map.retain(|_, v| !v.is_null());
        map.values_mut().for_each(drop_nulls);
    }
    if let Value::Array(items) = value {
        items.iter_mut().for_each(drop_nulls);
    }
}

fn invalid(path: &str, message: impl Into<String>, faults: &mut Vec<PlanFault>) {
    if faults.len() < MAX_FAULTS {
        faults.push(PlanFault { code: "plan.invalid", field: path.to_owned(), message: message.into() });
    }
}

fn numbers(value: &Value) -> Option<Vec<f64>> {
    value.as_array()?.iter().map(|v| v.as_f64().filter(|x| x.is_finite())).collect()
}

fn is_point(value: &Value) -> bool {
    numbers(value).is_some_and(|p| p.len() == 3 && p.iter().all(|x| x.abs() <= FAR_MM))
}

fn check(path: &str, value: &Value, rule: &Rule, faults: &mut Vec<PlanFault>) {
    if value.is_null() && !path.is_empty() {
        return;
    }
    let within = |x: f64, lo: f64, hi: f64| (lo..=hi).contains(&x);
    let problem = match *rule {
        Object(fields, presence) => return check_object(path, value, fields, presence, faults),
        Objects(fields) => return check_objects(path, value, fields, faults),
        Flag => (!value.is_boolean()).then(|| format!("true or false is wanted, not {}", shown(value))),
        Branch => {
            let right =
                value.as_str().is_some_and(|w| ROLES.contains(&w)) || value.as_u64().is_some_and(|i| i <= 1 << 20);
            (!right)
                .then(|| format!("a branch's number or one of {} is wanted, not {}", ROLES.join(", "), shown(value)))
        }
        Number(lo, hi) => (!value.as_f64().is_some_and(|x| within(x, lo, hi)))
            .then(|| format!("a number from {lo} to {hi} is wanted, not {}", shown(value))),
        Pair(lo, hi) => (!numbers(value).is_some_and(|p| p.len() == 2 && p.iter().all(|x| within(*x, lo, hi))))
            .then(|| format!("two numbers from {lo} to {hi} are wanted, not {}", shown(value))),
        Ascending(lo, hi) => {
            let right = |p: Vec<f64>| p.len() == 2 && p[0] < p[1] && p.iter().all(|x| within(*x, lo, hi));
            (!numbers(value).is_some_and(right))
                .then(|| format!("two numbers from {lo} to {hi}, the smaller first, are wanted, not {}", shown(value)))
        }
        Point => (!is_point(value)).then(|| format!("three coordinates in mm are wanted, not {}", shown(value))),
        Points => (!value.as_array().is_some_and(|a| a.iter().all(is_point)))
            .then(|| format!("a list of points of three coordinates in mm is wanted, not {}", shown(value))),
        Direction => direction(value).err(),
        Positions => {
            let right = |mut p: Vec<f64>| {
                p.sort_by(f64::total_cmp);
                p.iter().all(|x| x.abs() <= FAR_MM) && p.windows(2).all(|w| w[0] < w[1])
            };
            (!numbers(value).is_some_and(right))
                .then(|| format!("a list of different positions in mm is wanted, not {}", shown(value)))
        }
        Index => (value.as_u64().is_none_or(|i| i > 1 << 20))
            .then(|| format!("a whole number from 0 is wanted, not {}", shown(value))),
        Label => (!value.as_u64().is_some_and(|i| (1..=65_535).contains(&i)))
            .then(|| format!("a whole number from 1 to 65535 is wanted, not {}", shown(value))),
        Indices => {
            let right = |a: &Vec<Value>| a.iter().all(|v| v.as_u64().is_some_and(|i| i <= 1 << 20));
            (!value.as_array().is_some_and(right))
                .then(|| format!("a list of whole numbers from 0 is wanted, not {}", shown(value)))
        }
        Series => {
            let right = |t: &str| !t.is_empty() && t.len() <= 64 && t.bytes().all(|b| b.is_ascii_digit() || b == b'.');
            (!value.as_str().is_some_and(right))
                .then(|| format!("a series number or UID in quotes is wanted, not {}", shown(value)))
        }
        Word(words) => (!value.as_str().is_some_and(|w| words.contains(&w)))
            .then(|| format!("one of {} is wanted, not {}", words.join(", "), shown(value))),
        Words(words) => {
            let right = |a: &Vec<Value>| a.iter().all(|v| v.as_str().is_some_and(|w| words.contains(&w)));
            (!value.as_array().is_some_and(right))
                .then(|| format!("a list of {} is wanted, not {}", words.join(", "), shown(value)))
        }
    };
    if let Some(message) = problem {
        invalid(path, message, faults);
    }
}

fn direction(value: &Value) -> Result<(), String> {
    let v = numbers(value).filter(|v| v.len() == 3);
    let v = v.ok_or_else(|| format!("three numbers are wanted, not {}", shown(value)))?;
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (length - 1.0).abs() > DIRECTION_TOLERANCE {
        return Err(format!("a unit vector is wanted, the length is {length:.6}"));
    }
    Ok(())
}

fn check_object(
    path: &str,
    value: &Value,
    fields: &'static [(&'static str, Rule)],
    presence: Presence,
    faults: &mut Vec<PlanFault>,
) {
    let Value::Object(map) = value else {
        return invalid(path, format!("an object is wanted, not {}", shown(value)), faults);
    };
    let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    for (key, inner) in map {
        match fields.iter().find(|(name, _)| name == key) {
            Some((_, rule)) => check(&below(key), inner, rule, faults),
            None if faults.len() < MAX_FAULTS => faults.push(unknown(&below(key), key, fields)),
            None => {}
        }
    }
    for (name, _) in fields.iter().filter(|_| presence == Required) {
        if map.get(*name).is_none_or(Value::is_null) {
            invalid(&below(name), "it is missing", faults);
        }
    }
}

fn check_objects(path: &str, value: &Value, fields: &'static [(&'static str, Rule)], faults: &mut Vec<PlanFault>) {
    let Some(items) = value.as_array().filter(|a| a.len() <= MAX_CHANGES) else {
        return invalid(
            path,
            format!("a list of at most {MAX_CHANGES} objects is wanted, not {}", shown(value)),
            faults,
        );
    };
    for (i, item) in items.iter().enumerate() {
        let at = format!("{path}[{i}]");
        check_object(&at, item, fields, Optional, faults);
        let (needed, _) = fields[0];
        if item.is_object() && item.get(needed).is_none_or(Value::is_null) {
            invalid(&format!("{at}.{needed}"), "it is missing", faults);
        }
    }
}

fn unknown(path: &str, key: &str, fields: &[(&str, Rule)]) -> PlanFault {
    let nearest = fields.iter().map(|(name, _)| *name).min_by_key(|name| distance(key, name));
    let names: Vec<&str> = fields.iter().map(|(n, _)| *n).collect();
    let message = match nearest {
        Some(n) if distance(key, n) <= n.len().div_ceil(2) => format!("there is no such field; did you mean {n}?"),
        _ => format!("there is no such field; known here: {}", names.join(", ")),
    };
    let field: String = path.chars().take(200).collect();
    PlanFault { code: "plan.unknown_field", field, message }
}

/// Edit distance (Levenshtein), case ignored; keys longer than 64 characters are cut.
fn distance(a: &str, b: &str) -> usize {
    let letters = |s: &str| -> Vec<char> { s.chars().take(64).map(|c| c.to_ascii_lowercase()).collect() };
    let (a, b) = (letters(a), letters(b));
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let cost = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = cost.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

/// A value in a message: short.
fn shown(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 60 { text } else { text.chars().take(57).chain("...".chars()).collect() }
}

/// What no single field can tell.
fn across(plan: &Value, faults: &mut Vec<PlanFault>) {
    let empty = Map::new();
    let section = |name: &str| plan.get(name).and_then(Value::as_object).unwrap_or(&empty);
    let g = section("geometry");
    let given = |key: &str| g.get(key).filter(|v| !v.is_null());
    match (given("row_direction").and_then(numbers), given("column_direction").and_then(numbers)) {
        (Some(u), Some(v)) => {
            let cosine: f64 = u.iter().zip(&v).map(|(a, b)| a * b).sum();
            if cosine.abs() > DIRECTION_TOLERANCE {
                let angle = cosine.clamp(-1.0, 1.0).acos().to_degrees();
                let message = format!("it must be at a right angle to row_direction; the angle is {angle:.3} degrees");
                invalid("geometry.column_direction", message, faults);
            }
        }
        (Some(_), None) => invalid("geometry.column_direction", "row_direction needs it too", faults),
        (None, Some(_)) => invalid("geometry.row_direction", "column_direction needs it too", faults),
        (None, None) => {}
    }
    if given("slice_spacing_mm").is_some() && given("slice_positions_mm").is_some() {
        invalid("geometry.slice_positions_mm", "give it or slice_spacing_mm, not both", faults);
    }
    let m = section("morphometry");
    let number = |key: &str| m.get(key).and_then(Value::as_f64);
    if let Some(from) = number("fit_from_diameters") {
        let to = number("fit_to_diameters").unwrap_or_else(|| super::Morphometry::default().fit_to_diameters);
        if from >= to {
            let message = format!("{from} must be smaller than fit_to_diameters, {to}");
            invalid("morphometry.fit_from_diameters", message, faults);
        }
    }
}
