//! The child process of one job and its protocol.
//!
//! `EXE exec-job --input DIR --plan FILE --out DIR --threads N [--earlier FILE]`, trace id in `VASCULUM_TRACE_ID`, beside `TMPDIR` the only
//! variable: keys and passwords of the service are not its business. Its stdout carries one JSON object per line: first
//! `{"isolation"}` with the barriers between it and the network, then `{"stage", "progress", "eta_s"}`, and
//! `{"error": {...}}` last on failure; stderr is log text. Exit codes: 0 done, 2 input, 3 limit, 4 numeric, 130 cancelled, 1 our own fault. The child leads a process
//! group of its own, which is killed as one. It ends by itself when its stdin closes: this process holds the pipe
//! open, so that a `kill -9` of the service ends its children too.

use super::folder::Folder;
use crate::config::Config;
use crate::error::Problem;
use crate::queue::Claim;
use axum::http::StatusCode;
use futures::StreamExt as _;
use rustix::process::{Pid, Resource, Rlimit, Signal, kill_process_group, prlimit};
use serde::Deserialize;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::process::{ChildStdin, ChildStdout, Command};
use tokio_util::codec::{FramedRead, LinesCodec};

/// Longest line of the protocol; a problem with every fault of a plan stays far below.
const LONGEST_LINE: usize = 1 << 20;
/// Between the request to end and the kill.
const GRACE: Duration = Duration::from_millis(500);
/// How long the output may stay open after the child's end (a grandchild may hold it).
const DRAIN: Duration = Duration::from_secs(2);

/// A line of progress.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct Step {
    /// Stage that runs.
    pub stage: Option<String>,
    /// 0 to 1 over the whole job.
    pub progress: Option<f64>,
    /// Seconds left.
    pub eta_s: Option<f64>,
    /// The job's problem.
    pub error: Option<Problem>,
    /// What stands between the child and the network.
    pub isolation: Option<String>,
}

/// How the child ended.
#[derive(Debug)]
pub(super) enum Ended {
    /// Exit 0.
    Done,
    /// Exit 2, 3 or 4 (or 1 with a word about it): the job's own problem.
    Problem(Problem),
    /// Ended by a signal, or without a word.
    Crashed(String),
    /// Ended because an allocation was refused.
    OutOfMemory,
    /// Ended because the owner cancelled.
    Cancelled,
    /// Ended because the server stops.
    HandedBack,
}

/// A running child.
#[derive(Debug)]
pub(super) struct Child {
    process: tokio::process::Child,
    group: Option<Pid>,
    lines: FramedRead<ChildStdout, LinesCodec>,
    error: Option<Problem>,
    /// Set when its last words are those of an allocation that failed.
    out_of_memory: Arc<AtomicBool>,
    said: Option<tokio::task::JoinHandle<()>>,
    /// Held open: the child ends when it closes.
    _stdin: Option<ChildStdin>,
}

impl Child {
    /// Starts the child of a claimed job, bound to `memory_mb` of memory.
    ///
    /// # Errors
    /// The program cannot be started.
    pub(super) fn start(config: &Config, folder: &Folder, claim: &Claim, memory_mb: i64) -> anyhow::Result<Self> {
        let mut command = Command::new(&config.executable);
        command.args(&config.executable_args).arg("exec-job");
        command.arg("--input").arg(folder.input()).arg("--plan").arg(folder.plan());
        command.arg("--out").arg(folder.out()).arg("--threads").arg(config.threads.to_string());
        if folder.earlier().exists() {
            command.arg("--earlier").arg(folder.earlier());
        }
        command.env_clear().env("TMPDIR", folder.path()).env("VASCULUM_TRACE_ID", &claim.trace_id);
        command.current_dir(folder.path());
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.process_group(0).kill_on_drop(true);
        let mut process =
            command.spawn().map_err(|e| anyhow::anyhow!("cannot start {}: {e}", config.executable.display()))?;
        let stdout = process.stdout.take().ok_or_else(|| anyhow::anyhow!("the child has no stdout"))?;
        let out_of_memory = Arc::new(AtomicBool::new(false));
        let said = process.stderr.take().map(|stderr| {
            tokio::spawn(log(stderr, claim.id.clone(), claim.trace_id.clone(), Arc::clone(&out_of_memory)))
        });
        let group = process.id().and_then(|id| Pid::from_raw(i32::try_from(id).ok()?));
        bound(group, memory_mb);
        Ok(Self {
            group,
            out_of_memory,
            said,
            _stdin: process.stdin.take(),
            lines: FramedRead::new(stdout, LinesCodec::new_with_max_length(LONGEST_LINE)),
            error: None,
            process,
        })
    }

    /// The next line of progress; `None` when the output ended or the child died. Cancel safe.
    pub(super) async fn next(&mut self) -> Option<Step> {
        loop {
            let line = tokio::select! {
                biased;
                line = self.lines.next() => line?,
                _ = self.process.wait() => return self.rest().await,
            };
            if let Some(step) = self.read(line) {
                return Some(step);
            }
        }
    }

    /// After the child's death: what is still in the pipe. Steps no longer matter, the error does.
    async fn rest(&mut self) -> Option<Step> {
        let drained = tokio::time::timeout(DRAIN, async {
            while let Some(line) = self.lines.next().await {
                self.read(line);
            }
        })
        .await;
        if drained.is_err() {
            tracing::warn!("a process that the job left behind holds its output open");
        }
        None
    }

    fn read(&mut self, line: Result<String, tokio_util::codec::LinesCodecError>) -> Option<Step> {
        let step: Step = match line.map(|text| serde_json::from_str(&text)) {
            Ok(Ok(step)) => step,
            // Anything else on stdout is noise of a library, not the protocol.
            _ => return None,
        };
        if step.error.is_some() {
            self.error = step.error;
            return None;
        }
        Some(step)
    }

    /// Waits for the end after the output ended, and says what it means.
    ///
    /// # Errors
    /// The operating system's.
    pub(super) async fn end(&mut self, job: &str) -> anyhow::Result<Ended> {
        let status = self.process.wait().await?;
        self.signal(Signal::KILL);
        if let Some(said) = self.said.take() {
            // Its last words tell a lack of memory from another crash.
            let _ = tokio::time::timeout(DRAIN, said).await;
        }
        let problem = self.error.take().map(|p| completed(p, job));
        Ok(match (status.code(), problem) {
            (Some(0), _) => Ended::Done,
            (Some(_), Some(problem)) => Ended::Problem(problem),
            (_, None) if self.out_of_memory.load(Ordering::Acquire) => Ended::OutOfMemory,
            (Some(code @ 2..=4), None) => Ended::Problem(unexplained(code)),
            (Some(code), None) => Ended::Crashed(format!("exit code {code}")),
            (None, _) => Ended::Crashed(status.to_string()),
        })
    }

    /// Ends the whole process group: a request, 500 ms of grace, then the kill.
    pub(super) async fn kill(&mut self) {
        self.signal(Signal::TERM);
        if tokio::time::timeout(GRACE, self.process.wait()).await.is_err() {
            self.signal(Signal::KILL);
            // SIGKILL cannot be refused, so this ends.
            let _ = self.process.wait().await;
        }
        self.signal(Signal::KILL);
    }

    fn signal(&self, signal: Signal) {
        if let Some(group) = self.group {
            // An error means that nobody of the group lives any more.
            let _ = kill_process_group(group, signal);
        }
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        // `kill_on_drop` takes the leader only; take what it started too.
        if self.process.id().is_some() {
            self.signal(Signal::KILL);
        }
    }
}

/// A problem with the members that the child need not know.
fn completed(mut problem: Problem, job: &str) -> Problem {
    if problem.code.is_empty() {
        problem.code = "internal".to_owned();
    }
    if problem.status == 0 {
        problem.status = StatusCode::UNPROCESSABLE_ENTITY.as_u16();
    }
    if problem.type_uri.is_empty() {
        problem.type_uri = format!("urn:vasculum:problem:{}", problem.code);
    }
    if problem.title.is_empty() {
        let status = StatusCode::from_u16(problem.status).ok();
        problem.title = status.and_then(|s| s.canonical_reason()).unwrap_or("Error").to_owned();
    }
    problem.instance = format!("/v1/jobs/{job}");
    problem
}

fn unexplained(code: i32) -> Problem {
    let (name, what) = match code {
        2 => ("input", "the scan or the plan is at fault"),
        3 => ("limit", "a limit was met"),
        _ => ("numeric", "the numbers did not work out"),
    };
    Problem::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        &format!("job.{name}"),
        format!("The job ended because {what}, without saying more. Run `vasculum validate` on the scan."),
    )
}

/// Bounds the data of a process (heap and private mappings, not reserved addresses): an allocation beyond it fails.
fn bound(process: Option<Pid>, memory_mb: i64) {
    let bytes = u64::try_from(memory_mb).unwrap_or(0).saturating_mul(1 << 20);
    if let (Some(pid), true) = (process, bytes > 0) {
        let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
        if let Err(error) = prlimit(Some(pid), Resource::Data, limit) {
            tracing::warn!(%error, "the job's memory is not bound");
        }
    }
}

/// What programs say when an allocation is refused.
const MEMORY_WORDS: &[&str] = &["memory allocation of", "MemoryError", "std::bad_alloc", "out of memory"];

async fn log(stderr: tokio::process::ChildStderr, job: String, trace_id: String, out_of_memory: Arc<AtomicBool>) {
    let mut lines = FramedRead::new(stderr, LinesCodec::new_with_max_length(LONGEST_LINE));
    while let Some(line) = lines.next().await {
        match line {
            Ok(text) => {
                out_of_memory.store(MEMORY_WORDS.iter().any(|words| text.contains(words)), Ordering::Release);
                tracing::info!(target: "job", %job, %trace_id, "{text}");
            }
            Err(tokio_util::codec::LinesCodecError::MaxLineLengthExceeded) => {}
            Err(_) => return,
        }
    }
}
