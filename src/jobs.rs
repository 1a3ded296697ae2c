//! `run`, `validate` and `exec-job`: the pipeline in this process.

use crate::arguments::{ExecJob, Run, Validate};
use crate::table;
use artefact::plan::Plan;
use artefact::problem::Problem;
use exec::Ctx;
use indicatif::{ProgressBar, ProgressStyle};
use pipeline::{Event, Failure};
use serde_json::{Value, json};
use space::Faulty;
use std::io::{IsTerminal, Read, Write};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Mutex;

/// The whole reconstruction into a folder.
pub(crate) fn run(a: &Run) -> ExitCode {
    let outcome = plan_of(a.plan.as_deref()).and_then(|plan| {
        let ctx = context(a.threads)?;
        let shown = Shown::new();
        let outcome = pipeline::run(&a.input, &plan, &a.out, &ctx, &|e| shown.show(e));
        shown.finish();
        outcome
    });
    match outcome {
        Ok(result) => {
            print!("{}", if a.json { format!("{result}\n") } else { summary(&result, &a.out) });
            ExitCode::SUCCESS
        }
        Err(failure) => report(&failure, a.json),
    }
}

/// What was understood of a scan and a plan; the input is told even where the segmentation is refused.
pub(crate) fn validate(a: &Validate) -> ExitCode {
    let outcome = plan_of(a.plan.as_deref()).and_then(|plan| match a.pixels {
        Some(_) => pipeline::input(&a.input, &plan),
        None => pipeline::validate(&a.input, &plan, &context(a.threads)?),
    });
    let understood = match outcome {
        Ok(understood) => understood,
        Err(failure) => return report(&failure, a.json),
    };
    if let Some(path) = &a.pixels
        && let Err(failure) = write_pixels(path, &understood)
    {
        return report(&failure, a.json);
    }
    print!("{}", if a.json { format!("{:#}\n", understood.facts) } else { words(&understood.facts, 0) });
    understood.refusal.map_or(ExitCode::SUCCESS, |failure| report(&failure, a.json))
}

/// Grey values, then the mask where there is one, as little-endian singles, slice by slice, row by row: other programs
/// compare them with theirs.
fn write_pixels(path: &Path, read: &pipeline::Understood) -> Result<(), Failure> {
    let mask = read.mask.iter().flat_map(|m| m.inside()).map(|&m| f32::from(u8::from(m)));
    let bytes: Vec<u8> = read.stack.pixels.iter().copied().chain(mask).flat_map(f32::to_le_bytes).collect();
    std::fs::write(path, bytes).map_err(|e| Failure::internal(format!("{} cannot be written: {e}", path.display())))
}

/// One job of a worker: progress as JSON lines on standard output; ends when standard input closes, so that a killed
/// worker leaves no job running.
pub(crate) fn exec(a: &ExecJob) -> ExitCode {
    line(&json!({"isolation": crate::isolation::leave_network()}));
    let outcome = plan_of(Some(&a.plan)).and_then(|plan| {
        let ctx = context(Some(a.threads))?;
        die_with_parent();
        pipeline::run(std::slice::from_ref(&a.input), &plan, &a.out, &ctx, &|e| {
            line(&json!({"stage": e.stage, "progress": e.progress, "eta_s": e.eta_s}));
        })
    });
    match outcome {
        Ok(_) => ExitCode::SUCCESS,
        Err(failure) => {
            line(&json!({"error": problem(&failure)}));
            ExitCode::from(failure.kind.exit_code())
        }
    }
}

/// A closed pipe means that the parent is gone; a line that cannot be written says the same.
fn line(value: &Value) {
    let mut out = std::io::stdout().lock();
    if writeln!(out, "{value}").and_then(|()| out.flush()).is_err() {
        std::process::exit(1);
    }
}

fn die_with_parent() {
    std::thread::spawn(|| {
        let mut byte = [0_u8; 64];
        while std::io::stdin().read(&mut byte).is_ok_and(|n| n > 0) {}
        std::process::exit(1);
    });
}

pub(crate) fn context(threads: Option<usize>) -> Result<Ctx, Failure> {
    Ctx::new(threads.unwrap_or(0)).map_err(Failure::internal)
}

pub(crate) fn plan_of(path: Option<&Path>) -> Result<Plan, Failure> {
    let Some(path) = path else { return Ok(Plan::default()) };
    let bytes = std::fs::read(path).map_err(|e| Failure::unreadable(path, &e))?;
    Plan::parse(&bytes).map_err(Failure::plan)
}

/// The failure with all faults that came with it.
fn problem(failure: &Failure) -> Problem {
    let all = std::iter::once(failure).chain(&failure.others).map(|f| f as &dyn Faulty);
    Problem::of_all(all).unwrap_or_else(|| Problem::of(failure))
}

pub(crate) fn report(failure: &Failure, as_json: bool) -> ExitCode {
    if as_json {
        eprintln!("{}", json!(problem(failure)));
    } else {
        eprint!("vasculum: {}", problem(failure).plain());
    }
    ExitCode::from(failure.kind.exit_code())
}

pub(crate) fn summary(result: &Value, out: &Path) -> String {
    let mut text = table::angles(result, None);
    for warning in result["warnings"].as_array().map(Vec::as_slice).unwrap_or_default() {
        text += &format!(
            "warning {}: {}\n",
            warning["code"].as_str().unwrap_or("?"),
            warning["message"].as_str().unwrap_or("")
        );
    }
    text + &format!("artefacts in {}\n", out.display())
}

/// A JSON object as indented lines.
fn words(value: &Value, depth: usize) -> String {
    let indent = "  ".repeat(depth);
    match value {
        Value::Object(members) => members
            .iter()
            .map(|(name, v)| match v {
                Value::Object(_) => format!("{indent}{name}\n{}", words(v, depth + 1)),
                Value::Array(items) if items.iter().any(Value::is_object) => {
                    let lines: String = items.iter().map(|i| format!("{indent}  - {i}\n")).collect();
                    format!("{indent}{name}\n{lines}")
                }
                _ => format!("{indent}{name}: {v}\n"),
            })
            .collect(),
        other => format!("{indent}{other}\n"),
    }
}

/// A bar on a terminal, one line per stage elsewhere.
pub(crate) struct Shown {
    bar: Option<ProgressBar>,
    stage: Mutex<String>,
}

impl Shown {
    pub(crate) fn new() -> Self {
        let style = ProgressStyle::with_template("{msg:14} {bar:40} {percent:>3} %")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(1000).with_style(style));
        Self { bar, stage: Mutex::default() }
    }
    pub(crate) fn show(&self, e: &Event<'_>) {
        let Ok(mut stage) = self.stage.lock() else { return };
        let is_new = *stage != e.stage;
        if is_new {
            e.stage.clone_into(&mut stage);
        }
        match &self.bar {
            Some(bar) => {
                let left = e.eta_s.map_or(String::new(), |s| format!(" {s:.0} s"));
                bar.set_message(format!("{}{left}", e.stage));
                bar.set_position((e.progress * 1000.0) as u64);
            }
            None if is_new => eprintln!("{}", e.stage),
            None => {}
        }
    }
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
