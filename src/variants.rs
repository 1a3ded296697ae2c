//! `vary`: one finished reconstruction, a series of variants of it.
//!
//! Every option with several values multiplies the series: `--angle graft=30,60 --straight distal` makes two variants,
//! each with its distal branch straightened.

use crate::arguments::Vary;
use crate::jobs::{Shown, context, plan_of, report, summary};
use crate::terminal::say;
use artefact::plan::{Branch, Plan, ROLES, Variant, VariantChange};
use pipeline::Failure;
use serde_json::json;
use std::path::Path;
use std::process::ExitCode;

/// Most variants of one call.
const MOST: usize = 200;

/// Make all variants; the first failure ends the series, what was made stays.
pub(crate) fn vary(a: &Vary) -> ExitCode {
    match made(a) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => report(&failure, a.json),
    }
}

fn made(a: &Vary) -> Result<(), Failure> {
    let ctx = context(a.threads)?;
    for (name, plan) in planned(a)? {
        let out = a.out.join(&name);
        let shown = Shown::new();
        let outcome = pipeline::run(std::slice::from_ref(&a.source), &plan, &out, &ctx, &|e| shown.show(e));
        shown.finish();
        let result = outcome?;
        let line = json!({"variant": name, "result": result});
        say!("{}", if a.json { format!("{line}\n") } else { format!("{name}\n{}", summary(&result, &out)) });
    }
    Ok(())
}

/// All variants with their names. Every plan is read before the first variant is made; several plans give each of their
/// variants the name of the plan's file.
fn planned(a: &Vary) -> Result<Vec<(String, Plan)>, Failure> {
    let mut plans: Vec<Option<&Path>> = a.plan.iter().map(|file| Some(file.as_path())).collect();
    if plans.is_empty() {
        plans.push(None);
    }
    let mut all: Vec<(String, Plan)> = Vec::new();
    for file in &plans {
        let plan = plan_of(*file)?;
        let stem = file.and_then(Path::file_stem).map(|stem| stem.to_string_lossy().into_owned());
        for (name, variant) in series(a, plan.variant.as_ref())? {
            let name = match &stem {
                Some(stem) if plans.len() > 1 && name == UNCHANGED => stem.clone(),
                Some(stem) if plans.len() > 1 => format!("{stem}_{name}"),
                _ => name,
            };
            if all.iter().any(|(other, _)| *other == name) {
                return Err(refused(&format!(
                    "two variants would be named {name}; give the plans different file names"
                )));
            }
            all.push((name, Plan { variant: Some(variant), ..plan.clone() }));
        }
    }
    if all.len() > MOST {
        return Err(refused(&format!(
            "these plans and options make more than {MOST} variants; make them in several calls"
        )));
    }
    Ok(all)
}

/// The name of a variant that no option changes.
const UNCHANGED: &str = "unchanged";

/// The variants with their names: the product of all options.
fn series(a: &Vary, planned: Option<&Variant>) -> Result<Vec<(String, Variant)>, Failure> {
    let mut series = vec![(Vec::new(), planned.cloned().unwrap_or_default())];
    let by_number = [("angle", &a.angle), ("bend", &a.bend), ("curvature", &a.curvature)];
    for (option, given) in by_number {
        for text in given {
            let (branch, values) = numbers(option, text)?;
            let changed = values.iter().map(|&x| Ok((format!("{option}-{branch}-{x}"), numeric(option, &branch, x)?)));
            series = product(&series, &changed.collect::<Result<Vec<_>, Failure>>()?)?;
        }
    }
    for text in &a.torsion {
        let (branch, values) = numbers("torsion", text)?;
        series = twisted(&series, &branch, &values)?;
    }
    for (option, given) in [("straight", &a.straight), ("planar", &a.planar)] {
        for name in given {
            let mut change = change_of(option, name)?;
            *if option == "straight" { &mut change.straight } else { &mut change.planar } = Some(true);
            series = product(&series, &[(format!("{option}-{name}"), change)])?;
        }
    }
    let named = |(names, variant): (Vec<String>, Variant)| {
        (if names.is_empty() { UNCHANGED.to_owned() } else { names.join("_").replace(':', "-") }, variant)
    };
    Ok(series.into_iter().map(named).collect())
}

type Named = (Vec<String>, Variant);

fn product(series: &[Named], changes: &[(String, VariantChange)]) -> Result<Vec<Named>, Failure> {
    if series.len() * changes.len() > MOST {
        return Err(refused(&format!("these options make more than {MOST} variants; make them in several calls")));
    }
    let with = |(names, variant): &Named, (name, change): &(String, VariantChange)| {
        let (mut names, mut variant) = (names.clone(), variant.clone());
        names.push(name.clone());
        variant.changes.push(change.clone());
        (names, variant)
    };
    Ok(series.iter().flat_map(|s| changes.iter().map(move |c| with(s, c))).collect())
}

/// Torsion belongs to the curvature that was asked for on the same branch.
fn twisted(series: &[Named], branch: &str, values: &[f64]) -> Result<Vec<Named>, Failure> {
    if series.len() * values.len() > MOST {
        return Err(refused(&format!("these options make more than {MOST} variants; make them in several calls")));
    }
    let mut out = Vec::new();
    for (names, variant) in series {
        for &x in values {
            let (mut names, mut variant) = (names.clone(), variant.clone());
            let same = |c: &&mut VariantChange| c.branch == branch_of(branch) && c.curvature_per_mm.is_some();
            let curved = variant.changes.iter_mut().rev().find(same);
            let change = curved
                .ok_or_else(|| refused(&format!("--torsion {branch}=... needs --curvature {branch}=..., too")))?;
            change.torsion_per_mm = Some(x);
            names.push(format!("torsion-{branch}-{x}"));
            out.push((names, variant));
        }
    }
    Ok(out)
}

/// BRANCH=NUMBER[,NUMBER...]
fn numbers(option: &str, text: &str) -> Result<(String, Vec<f64>), Failure> {
    let wrong =
        || refused(&format!("--{option} {text}: BRANCH=NUMBER[,NUMBER...] is wanted, as in --{option} graft=30,60"));
    let (branch, values) = text.split_once('=').ok_or_else(wrong)?;
    let values: Vec<f64> =
        values.split(',').map(|v| v.trim().parse()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    Ok((branch.trim().to_owned(), values))
}

fn numeric(option: &str, branch: &str, x: f64) -> Result<VariantChange, Failure> {
    let (name, to) = branch.split_once(':').map_or((branch, None), |(b, t)| (b, Some(t)));
    let mut change = change_of(option, name)?;
    change.to = to.map(|t| change_of(option, t)).transpose()?.map(|c| c.branch);
    match option {
        "angle" => change.angle_deg = Some(x),
        "bend" => change.curvature_factor = Some(x),
        _ => change.curvature_per_mm = Some(x),
    }
    Ok(change)
}

fn branch_of(name: &str) -> Branch {
    name.parse().map_or_else(|_| Branch::Role(name.to_owned()), Branch::Id)
}

fn change_of(option: &str, name: &str) -> Result<VariantChange, Failure> {
    let branch = branch_of(name);
    if let Branch::Role(role) = &branch
        && !ROLES.contains(&role.as_str())
    {
        return Err(refused(&format!(
            "--{option} {name}: no such branch; give graft, proximal, distal, host_a, host_b or a number"
        )));
    }
    Ok(VariantChange {
        branch,
        angle_deg: None,
        to: None,
        curvature_factor: None,
        curvature_per_mm: None,
        torsion_per_mm: None,
        straight: None,
        planar: None,
    })
}

fn refused(message: &str) -> Failure {
    Failure::plan(artefact::plan::PlanFaults {
        faults: vec![artefact::plan::PlanFault {
            code: "plan.invalid",
            field: "variant".to_owned(),
            message: message.to_owned(),
        }],
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::arguments::{Arguments, Command};
    use clap::Parser;

    fn of(options: &[&str]) -> Result<Vec<(String, Variant)>, Failure> {
        let line = ["vasculum", "vary", "job", "--out", "out"].iter().chain(options);
        match Arguments::try_parse_from(line).unwrap().command {
            Command::Vary(a) => series(&a, None),
            _ => Ok(Vec::new()),
        }
    }

    #[test]
    fn values_multiply_and_torsion_joins_its_curvature() {
        let made = of(&["--angle", "graft=30,60", "--curvature", "2=0.05", "--torsion", "2=-0.03,0.03"]).unwrap();
        assert_eq!(made.len(), 4);
        assert_eq!(made[1].0, "angle-graft-30_curvature-2-0.05_torsion-2-0.03");
        assert_eq!(made[2].1.changes[1].torsion_per_mm, Some(-0.03));
        assert_eq!(made[3].1.changes[0].angle_deg, Some(60.0));
        assert_eq!(of(&[]).unwrap()[0].0, "unchanged");
        let to = of(&["--angle", "distal:proximal=160"]).unwrap();
        assert_eq!(to[0].1.changes[0].to, Some(Branch::Role("proximal".into())));
    }

    #[test]
    fn several_plans_make_several_series_with_names_of_their_own() {
        let folder = tempfile::TempDir::new().unwrap();
        let file = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            path.to_string_lossy().into_owned()
        };
        let flat = file("flat.json", r#"{"variant": {"changes": [{"branch": "distal", "planar": true}]}}"#);
        let plain = file("plain.json", "{}");
        let of = |options: &[&str]| {
            let line = ["vasculum", "vary", "job", "--out", "out"].iter().chain(options);
            match Arguments::try_parse_from(line).unwrap().command {
                Command::Vary(a) => planned(&a),
                _ => Ok(Vec::new()),
            }
        };
        let made = of(&["--plan", &flat, "--plan", &plain, "--angle", "graft=30,60"]).unwrap();
        let names: Vec<&str> = made.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(
            names,
            ["flat_angle-graft-30", "flat_angle-graft-60", "plain_angle-graft-30", "plain_angle-graft-60"]
        );
        let changes = |k: usize| made[k].1.variant.as_ref().unwrap().changes.len();
        assert_eq!((changes(0), changes(2)), (2, 1), "the plan's change goes before the option's");
        assert_eq!(of(&["--plan", &flat]).unwrap()[0].0, "unchanged");
        assert!(of(&["--plan", &flat, "--plan", &flat]).is_err(), "two variants of one name");
    }

    #[test]
    fn what_cannot_be_read_is_refused() {
        for options in [["--angle", "graft"], ["--angle", "graft=x"], ["--torsion", "graft=0.1"], ["--planar", "leg"]] {
            assert!(of(&options).is_err(), "{options:?}");
        }
    }
}
