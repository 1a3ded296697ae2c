//! `run`, `validate` and `exec-job`: the pipeline in this process.

use crate::arguments::{ExecJob, Run, Show, Validate};
use crate::terminal::say;
use crate::{table, understood};
use artefact::plan::Plan;
use artefact::problem::Problem;
use artefact::write;
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
        let outcome = pipeline::run_after(a.earlier.as_deref(), &a.input, &plan, &a.out, &ctx, &|e| shown.show(e));
        shown.finish();
        outcome
    });
    match outcome {
        Ok(result) => {
            say!("{}", if a.json { format!("{result}\n") } else { summary(&result, &a.out) });
            ExitCode::SUCCESS
        }
        Err(failure) => report(&failure, a.json),
    }
}

/// The table of a finished reconstruction, as `run` printed it.
pub(crate) fn show(a: &Show) -> ExitCode {
    let file = if a.result.is_dir() { a.result.join(write::RESULT_JSON) } else { a.result.clone() };
    let read = std::fs::read(&file).and_then(|bytes| Ok(serde_json::from_slice::<Value>(&bytes)?));
    match read {
        Ok(result) if a.json => say!("{result:#}\n"),
        Ok(result) => say!("{}", table::summary(&result)),
        Err(e) => return report(&Failure::unreadable(&file, &e), a.json),
    }
    ExitCode::SUCCESS
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
    say!("{}", if a.json { format!("{:#}\n", understood.facts) } else { understood::words(&understood.facts) });
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
        pipeline::run_after(a.earlier.as_deref(), std::slice::from_ref(&a.input), &plan, &a.out, &ctx, &|e| {
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
    let folder = out.display();
    let (report, surface) = (write::REPORT_HTML, write::SURFACE_VTP);
    table::summary(result)
        + &format!("artefacts in {folder}\n  {report} has pictures and plots; {surface} opens in ParaView\n")
}

/// A bar with the stage and the time left, within 80 columns.
pub(crate) fn bar(length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix:<10} {bar:36} {percent:>3} %  {msg}");
    ProgressBar::new(length).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Where a job stands, on a bar of 1000.
pub(crate) fn advance(bar: &ProgressBar, stage: &str, progress: f64, eta_s: Option<f64>) {
    bar.set_prefix(stage.to_owned());
    bar.set_message(eta_s.filter(|s| *s >= 0.5).map_or(String::new(), left));
    bar.set_position((progress * 1000.0) as u64);
}

fn left(seconds: f64) -> String {
    let s = seconds.round() as u64;
    if s < 90 { format!("{s} s left") } else { format!("{} min {:02} s left", s / 60, s % 60) }
}

/// A bar on a terminal, one line per stage elsewhere.
pub(crate) struct Shown {
    bar: Option<ProgressBar>,
    stage: Mutex<String>,
}

impl Shown {
    pub(crate) fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| bar(1000));
        Self { bar, stage: Mutex::default() }
    }
    pub(crate) fn show(&self, e: &Event<'_>) {
        let Ok(mut stage) = self.stage.lock() else { return };
        let is_new = *stage != e.stage;
        if is_new {
            e.stage.clone_into(&mut stage);
        }
        match &self.bar {
            Some(bar) => advance(bar, e.stage, e.progress, e.eta_s),
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
