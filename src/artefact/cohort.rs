//! The tables of many results together: one row per angle and per branch, medians and spread, and a plot of them.
//!
//! A cohort is made from result.json files alone, so that jobs of different versions and machines can be compared. A value
//! that a result has as null stays out of the sums and is counted; it never becomes a zero.

use serde::Serialize;
use serde_json::Value;

/// `schema` of the cohort's JSON.
pub const COHORT_SCHEMA: &str = "vasculum/cohort/1";

/// The quantity of an angle.
pub const DEGREES: &str = "deg";

/// Numbers of a branch that are compared: name, and where result.json has them.
pub const QUANTITIES: [(&str, &str); 8] = [
    ("diameter_mm", "/diameter_mm"),
    ("length_mm", "/length_mm"),
    ("tortuosity", "/tortuosity"),
    ("area_mm2", ""),
    ("stenosis_area_ratio", "/stenosis/area_ratio"),
    ("helix_curvature_per_mm", "/helix/curvature_per_mm"),
    ("helix_torsion_per_mm", "/helix/torsion_per_mm"),
    ("helix_radius_mm", "/helix/radius_mm"),
];

/// One number of one job.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The job.
    pub job: String,
    /// `angle` or `branch`.
    pub kind: &'static str,
    /// Junction's node or branch's number.
    pub id: u64,
    /// The angle's name or the branch's role.
    pub name: String,
    /// `deg` or the branch's quantity.
    pub quantity: &'static str,
    /// The value; `None` where it could not be had.
    pub value: Option<f64>,
    /// 95 % band, where there is one.
    pub band95: Option<[f64; 2]>,
    /// Warnings of the job's result.
    pub warnings: usize,
}

/// What of a cohort is wanted; an empty list means all.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Names of angles and roles of branches.
    pub names: Vec<String>,
    /// Quantities; angles have `deg`.
    pub quantities: Vec<String>,
    /// `angle` or `branch`.
    pub kinds: Vec<String>,
    /// Numbers of branches; angles belong to no single branch and are left out.
    pub branches: Vec<u64>,
    /// Leave out results with warnings.
    pub without_warnings: bool,
}

/// What a table tells of a result as a whole.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Facts {
    /// The job.
    pub job: String,
    /// RFC 3339, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub created_at: Option<String>,
    /// Whether the vessel was made from a measured one.
    pub variant: bool,
    /// Slices of its scan.
    pub slices: Option<u64>,
    /// Distance between slices, mm.
    pub slice_spacing_mm: Option<f64>,
    /// Lumen within the data's ends, mm^3.
    pub volume_mm3: Option<f64>,
    /// Node of the junction that the report puts first; `null` without one.
    pub main_junction: Option<u64>,
    /// Warnings of the result.
    pub warnings: usize,
}

/// Many results, filled one by one: only their numbers are held.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// One number of one job each, in the order in which the results came.
    pub rows: Vec<Row>,
    /// The results from which some row came.
    pub results: Vec<Facts>,
}

impl Table {
    /// Takes what `filter` wants of one result.
    pub fn add(&mut self, job: &str, created_at: Option<String>, result: &Value, filter: &Filter) {
        let rows = rows(job, result, filter);
        if !rows.is_empty() {
            self.results.push(facts(job, created_at, result));
            self.rows.extend(rows);
        }
    }
}

fn facts(job: &str, created_at: Option<String>, result: &Value) -> Facts {
    let width = |j: &Value| {
        let of = |id: &Value| list(&result["branches"]).iter().find(|b| b["id"] == *id)?["diameter_mm"].as_f64();
        list(&j["branches"]).iter().map(|id| of(id).unwrap_or(0.0)).fold(f64::INFINITY, f64::min)
    };
    let measured = |j: &Value| list(&j["angles"]).iter().any(|a| !a["value"].is_null());
    let node = |j: &Value| j["node"].as_u64().unwrap_or(u64::MAX);
    // measured before others, then the one whose thinnest branch is widest, then the first
    let order = |a: &&Value, b: &&Value| {
        measured(a).cmp(&measured(b)).then(width(a).total_cmp(&width(b))).then(node(b).cmp(&node(a)))
    };
    Facts {
        job: job.to_owned(),
        created_at,
        variant: !result["variant"].is_null(),
        slices: result["input"]["slices"].as_u64(),
        slice_spacing_mm: result["input"]["spacing_mm"][2].as_f64(),
        volume_mm3: result["surface"]["volume_mm3"].as_f64(),
        main_junction: list(&result["junctions"]).iter().max_by(order).and_then(|j| j["node"].as_u64()),
        warnings: list(&result["warnings"]).len(),
    }
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// How the values of one name and quantity spread.
#[derive(Clone, Debug, PartialEq)]
pub struct Spread {
    /// The angle's name or the branch's role.
    pub name: String,
    /// `deg` or the branch's quantity.
    pub quantity: &'static str,
    /// Values, and how many could not be had.
    pub count: usize,
    /// See `count`.
    pub missing: usize,
    /// Smallest, first quartile, median, third quartile, largest (quantiles linear between order statistics).
    pub quantiles: [f64; 5],
    /// Mean.
    pub mean: f64,
    /// Standard deviation of the sample; `None` for a single value.
    pub deviation: Option<f64>,
}

/// Rows of one result, in its own order.
pub fn rows(job: &str, result: &Value, filter: &Filter) -> Vec<Row> {
    let warnings = list(&result["warnings"]).len();
    if filter.without_warnings && warnings > 0 {
        return Vec::new();
    }
    let row = |kind, id: &Value, name: &Value, quantity, value: Option<f64>, band: &Value| Row {
        job: job.to_owned(),
        kind,
        id: id.as_u64().unwrap_or(0),
        name: name.as_str().unwrap_or("?").to_owned(),
        quantity,
        value,
        band95: band[0].as_f64().zip(band[1].as_f64()).map(|(a, b)| [a, b]),
        warnings,
    };
    let mut out = Vec::new();
    for junction in list(&result["junctions"]) {
        for a in list(&junction["angles"]) {
            out.push(row("angle", &junction["node"], &a["name"], DEGREES, a["value"].as_f64(), &a["band95"]));
        }
    }
    for b in list(&result["branches"]) {
        for (quantity, at) in QUANTITIES {
            let (value, band) = match quantity {
                "area_mm2" => (median_area(b), &Value::Null),
                "diameter_mm" => (b["diameter_mm"].as_f64(), &b["diameter_band95"]),
                "helix_torsion_per_mm" => (b.pointer(at).and_then(Value::as_f64), &b["helix"]["torsion_band95"]),
                "helix_curvature_per_mm" => (b.pointer(at).and_then(Value::as_f64), &b["helix"]["curvature_band95"]),
                _ => (b.pointer(at).and_then(Value::as_f64), &Value::Null),
            };
            out.push(row("branch", &b["id"], &b["role"], quantity, value, band));
        }
    }
    let wanted = |list: &[String], name: &str| list.is_empty() || list.iter().any(|w| w == name);
    let branch = |r: &Row| filter.branches.is_empty() || (r.kind == "branch" && filter.branches.contains(&r.id));
    out.retain(|r| {
        wanted(&filter.names, &r.name)
            && wanted(&filter.quantities, r.quantity)
            && wanted(&filter.kinds, r.kind)
            && branch(r)
    });
    out
}

/// Median area of a branch's sections outside junctions that are whole.
fn median_area(branch: &Value) -> Option<f64> {
    let samples = &branch["samples"];
    let flag = |name: &str, k: usize| samples[name][k].as_bool().unwrap_or(false);
    let areas = samples["area_mm2"].as_array()?.iter().enumerate();
    let mut kept: Vec<f64> =
        areas.filter(|(k, _)| !flag("in_junction", *k) && !flag("open", *k)).filter_map(|(_, a)| a.as_f64()).collect();
    kept.sort_by(f64::total_cmp);
    (!kept.is_empty()).then(|| quantile(&kept, 0.5))
}

/// The spread of every name and quantity, in the order in which they first come.
pub fn spreads(rows: &[Row]) -> Vec<Spread> {
    let mut keys: Vec<(&str, &'static str)> = Vec::new();
    for r in rows {
        if !keys.contains(&(r.name.as_str(), r.quantity)) {
            keys.push((&r.name, r.quantity));
        }
    }
    let of = |(name, quantity): (&str, &'static str)| {
        let mine = || rows.iter().filter(|r| r.name == name && r.quantity == quantity);
        let mut values: Vec<f64> = mine().filter_map(|r| r.value).filter(|v| v.is_finite()).collect();
        let missing = mine().count() - values.len();
        values.sort_by(f64::total_cmp);
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().fold(0.0, |s, v| s + v) / count as f64;
        let square = values.iter().fold(0.0, |s, v| s + (v - mean).powi(2));
        Some(Spread {
            name: name.to_owned(),
            quantity,
            count,
            missing,
            quantiles: [0.0, 0.25, 0.5, 0.75, 1.0].map(|p| quantile(&values, p)),
            mean,
            deviation: (count > 1).then(|| (square / (count - 1) as f64).sqrt()),
        })
    };
    keys.into_iter().filter_map(of).collect()
}

/// Linear between order statistics (Hyndman and Fan's type 7, that of numpy and R); `sorted` is not empty.
fn quantile(sorted: &[f64], p: f64) -> f64 {
    let at = p * (sorted.len() - 1) as f64;
    let (i, t) = (at as usize, at.fract());
    sorted[i] + t * (sorted[(i + 1).min(sorted.len() - 1)] - sorted[i])
}

/// The JSON form of a table.
#[derive(Debug, Serialize)]
pub struct Document<'a> {
    schema: &'static str,
    jobs: usize,
    results: &'a [Facts],
    rows: &'a [Row],
    summary: Vec<Summary>,
}

/// The JSON form of a spread.
#[derive(Debug, Serialize)]
struct Summary {
    name: String,
    quantity: &'static str,
    count: usize,
    missing: usize,
    min: f64,
    q1: f64,
    median: f64,
    q3: f64,
    max: f64,
    mean: f64,
    standard_deviation: Option<f64>,
}

impl From<Spread> for Summary {
    fn from(s: Spread) -> Self {
        let [min, q1, median, q3, max] = s.quantiles;
        let (mean, standard_deviation) = (s.mean, s.deviation);
        let Spread { name, quantity, count, missing, .. } = s;
        Self { name, quantity, count, missing, min, q1, median, q3, max, mean, standard_deviation }
    }
}

/// Results, rows and spreads, to be written as JSON.
pub fn document(table: &Table) -> Document<'_> {
    let summary = spreads(&table.rows).into_iter().map(Summary::from).collect();
    Document { schema: COHORT_SCHEMA, jobs: table.results.len(), results: &table.results, rows: &table.rows, summary }
}

/// Rows as CSV; an empty cell is a value that could not be had.
pub fn csv(rows: &[Row]) -> String {
    let mut out = csv::Writer::from_writer(Vec::new());
    let head = ["job", "kind", "id", "name", "quantity", "value", "band95_low", "band95_high", "warnings"];
    let cell = |x: Option<f64>| x.map_or(String::new(), |x| x.to_string());
    let mut write = |record: [String; 9]| out.write_record(record).is_ok();
    let mut whole = write(head.map(str::to_owned));
    for r in rows {
        let [low, high] = [0, 1].map(|i| r.band95.map(|b| b[i]));
        whole &= write([
            r.job.clone(),
            r.kind.to_owned(),
            r.id.to_string(),
            r.name.clone(),
            r.quantity.to_owned(),
            cell(r.value),
            cell(low),
            cell(high),
            r.warnings.to_string(),
        ]);
    }
    // a writer into memory does not fail
    let bytes = if whole { out.into_inner().unwrap_or_default() } else { Vec::new() };
    String::from_utf8(bytes).unwrap_or_default()
}

/// Box plots of all spreads with every value as a dot, one row each, as SVG.
pub fn plot(rows: &[Row]) -> String {
    const ROW: f64 = 34.0;
    const LEFT: f64 = 250.0;
    const WIDE: f64 = 420.0;
    let all = spreads(rows);
    let height = ROW * (all.len() as f64 + 1.0);
    let mut body = String::new();
    for (k, s) in all.iter().enumerate() {
        let y = ROW * (k as f64 + 1.0);
        let [min, q1, median, q3, max] = s.quantiles;
        let span = (max - min).max(1e-12 * max.abs()).max(f64::MIN_POSITIVE);
        let x = |v: f64| LEFT + WIDE * if max > min { (v - min) / span } else { 0.5 };
        let title = format!("{} {} ({})", s.name, s.quantity, s.count);
        body += &format!(
            "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">{}</text>\
             <line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"#555\"/>\
             <rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"14\" fill=\"#9ecae1\" stroke=\"#3182bd\"/>\
             <line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"#08306b\" stroke-width=\"2\"/>",
            LEFT - 12.0,
            y + 4.0,
            escaped(&title),
            x(min),
            x(max),
            x(q1),
            y - 7.0,
            (x(q3) - x(q1)).max(1.0),
            x(median),
            x(median),
            y - 7.0,
            y + 7.0,
        );
        for v in rows.iter().filter(|r| r.name == s.name && r.quantity == s.quantity).filter_map(|r| r.value) {
            body +=
                &format!("<circle cx=\"{:.1}\" cy=\"{y:.1}\" r=\"2.5\" fill=\"#08306b\" fill-opacity=\".5\"/>", x(v));
        }
        body += &format!(
            "<text x=\"{:.0}\" y=\"{:.0}\">{}</text>",
            LEFT + WIDE + 12.0,
            y + 4.0,
            escaped(&format!("{min:.4} .. {median:.4} .. {max:.4}"))
        );
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {:.0} {height:.0}\" font-family=\"sans-serif\" \
         font-size=\"12\"><rect width=\"100%\" height=\"100%\" fill=\"white\"/>{body}</svg>\n",
        LEFT + WIDE + 240.0
    )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use serde_json::json;

    fn result(graft: f64, angle: Option<f64>, warned: bool) -> Value {
        let warnings = if warned { json!([{"code": "a.b", "message": "", "where": null}]) } else { json!([]) };
        json!({"warnings": warnings,
               "junctions": [{"node": 1, "angles": [{"name": "graft_proximal", "value": angle, "band95": [1.0, 2.0]}]}],
               "branches": [{"id": 0, "role": "graft", "diameter_mm": graft, "length_mm": 9.0, "tortuosity": 1.0,
                 "samples": {"area_mm2": [9.0, 1.0, 3.0, null, 2.0], "in_junction": [true, false, false, false, false],
                             "open": [false, false, false, true, false]}, "helix": null, "stenosis": {"area_ratio": 0.9}}]})
    }

    fn table(filter: &Filter) -> Table {
        let jobs = [
            ("a", result(4.0, Some(40.0), false)),
            ("b", result(6.0, None, true)),
            ("c", result(5.0, Some(50.0), false)),
        ];
        let mut table = Table::default();
        jobs.iter().for_each(|(job, r)| table.add(job, None, r, filter));
        table
    }

    fn cohort(filter: &Filter) -> Vec<Row> {
        table(filter).rows
    }

    #[test]
    fn spreads_are_those_of_the_values_and_nulls_are_counted() {
        let rows = cohort(&Filter::default());
        let all = spreads(&rows);
        let of = |name: &str, quantity: &str| all.iter().find(|s| s.name == name && s.quantity == quantity).unwrap();
        let angle = of("graft_proximal", "deg");
        assert_eq!((angle.count, angle.missing, angle.quantiles[2]), (2, 1, 45.0));
        let diameter = of("graft", "diameter_mm");
        assert_eq!(diameter.quantiles, [4.0, 4.5, 5.0, 5.5, 6.0]);
        assert_eq!((diameter.mean, diameter.deviation), (5.0, Some(1.0)));
        assert_eq!(of("graft", "area_mm2").quantiles[2], 2.0);
        assert!(all.iter().all(|s| s.quantity != "helix_radius_mm"), "nobody has a helix");
    }

    #[test]
    fn filters_keep_what_was_asked_for() {
        let only = Filter {
            names: vec!["graft".into()],
            quantities: vec!["diameter_mm".into()],
            without_warnings: true,
            ..Filter::default()
        };
        let rows = cohort(&only);
        assert_eq!(
            rows.iter().map(|r| (r.job.as_str(), r.value)).collect::<Vec<_>>(),
            [("a", Some(4.0)), ("c", Some(5.0))]
        );
    }

    #[test]
    fn kinds_and_branches_are_filters_too() {
        let kinds = |kind: &str| cohort(&Filter { kinds: vec![kind.into()], ..Filter::default() });
        assert!(kinds("angle").iter().all(|r| r.quantity == DEGREES) && kinds("angle").len() == 3);
        assert_eq!(kinds("branch").len(), 3 * QUANTITIES.len());
        let branch = |id| cohort(&Filter { branches: vec![id], ..Filter::default() });
        assert_eq!((branch(0).len(), branch(1).len()), (3 * QUANTITIES.len(), 0), "an angle's node 1 is no branch");
    }

    #[test]
    fn the_main_junction_is_measured_and_wide() {
        let junction = |node: u64, branches: [u64; 2], value: Option<f64>| json!({"node": node, "branches": branches, "angles": [{"name": "graft_proximal", "value": value}]});
        let branch = |id: u64, wide: f64| json!({"id": id, "role": "other", "diameter_mm": wide});
        let result = json!({
            "branches": [branch(0, 9.0), branch(1, 3.0), branch(2, 5.0)], "warnings": [],
            "junctions": [junction(4, [0, 0], None), junction(5, [0, 1], Some(1.0)), junction(7, [0, 2], Some(1.0)), junction(6, [0, 2], Some(1.0))]});
        assert_eq!(facts("a", None, &result).main_junction, Some(6));
    }

    #[test]
    fn the_table_the_document_and_the_plot_agree() {
        let table = table(&Filter::default());
        let (rows, text) = (&table.rows, csv(&table.rows));
        assert_eq!(text.lines().count(), rows.len() + 1);
        assert!(text.contains("b,angle,1,graft_proximal,deg,,1,2,1"), "{text}");
        let document = serde_json::to_value(document(&table)).unwrap();
        assert_eq!((document["jobs"].as_u64(), document["rows"].as_array().unwrap().len()), (Some(3), rows.len()));
        let dots = plot(rows).matches("<circle").count();
        assert_eq!(dots, rows.iter().filter(|r| r.value.is_some()).count());
    }
}
