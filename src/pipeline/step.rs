//! Around every stage: its span, share of the progress, cancel check, wall and CPU time.

use crate::Failure;
use exec::Ctx;
use space::Faulty;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// Progress as it is told to the caller.
#[derive(Clone, Copy, Debug)]
pub struct Event<'a> {
    /// Stage that runs.
    pub stage: &'a str,
    /// Share of the whole that is done, 0 to 1.
    pub progress: f64,
    /// Seconds left, once there is something to tell it from.
    pub eta_s: Option<f64>,
}

/// Receives [`Event`]s; called from worker threads.
pub type Observer<'a> = &'a (dyn Fn(&Event<'_>) + Sync);

/// Time that a stage took.
#[derive(Clone, Debug)]
pub(crate) struct StageTime {
    pub(crate) name: &'static str,
    pub(crate) wall_s: f64,
    pub(crate) cpu_s: f64,
    /// Largest resident size of the process by its end, bytes.
    pub(crate) peak_bytes: u64,
}

/// Runs stages one after the other.
pub(crate) struct Steps<'a> {
    ctx: &'a Ctx,
    observer: Observer<'a>,
    started: Instant,
    done: f64,
    pub(crate) times: Vec<StageTime>,
}

/// Each stage's share of the whole, measured on the demo scan (`cargo xtask bench`).
const SHARES: [(&str, f64); 9] = [
    ("read", 0.02),
    ("contours", 0.10),
    ("fit", 0.28),
    ("polygonise", 0.08),
    ("smooth", 0.12),
    ("skeleton", 0.08),
    ("mesh", 0.20),
    ("measure", 0.07),
    ("write", 0.05),
];

impl<'a> Steps<'a> {
    pub(crate) fn new(ctx: &'a Ctx, observer: Observer<'a>) -> Self {
        Self { ctx, observer, started: Instant::now(), done: 0.0, times: Vec::new() }
    }

    /// Run one stage.
    pub(crate) fn step<T, E: Faulty>(
        &mut self,
        name: &'static str,
        work: impl FnOnce(&Ctx) -> Result<T, E>,
    ) -> Result<T, Failure> {
        let span = tracing::info_span!("stage", name);
        let _entered = span.enter();
        let share = SHARES.iter().find(|s| s.0 == name).map_or(0.0, |s| s.1);
        let (from, to) = (self.done, self.done + share);
        self.tell(name, from);
        let (wall, cpu) = (Instant::now(), cpu_seconds());
        let latest = Arc::new(Mutex::new(0.0_f64));
        let outcome = self.watched(name, (from, to), &latest, work);
        let (wall_s, cpu_s) = (wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
        self.times.push(StageTime { name, wall_s, cpu_s, peak_bytes: peak_memory_bytes() });
        self.done = to;
        outcome.map_err(|e| Failure::of(&e))
    }

    /// The context's sink must be 'static; the observer is not. So the sink writes the fraction down and a scoped
    /// thread, which only forwards it, tells the observer ten times a second.
    fn watched<T, E: Faulty>(
        &self,
        name: &'static str,
        (from, to): (f64, f64),
        latest: &Arc<Mutex<f64>>,
        work: impl FnOnce(&Ctx) -> Result<T, E>,
    ) -> Result<T, E> {
        let sink = Arc::clone(latest);
        let ctx = self.ctx.clone().with_progress(move |p| {
            if let Ok(mut latest) = sink.lock() {
                *latest = latest.max(p);
            }
        });
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                let tick = std::time::Duration::from_millis(100);
                while let Err(std::sync::mpsc::RecvTimeoutError::Timeout) = stopped.recv_timeout(tick) {
                    let p = latest.lock().map_or(0.0, |p| *p);
                    self.tell(name, from + (to - from) * p);
                }
            });
            let outcome = work(&ctx);
            drop(stop);
            outcome
        })
    }

    fn tell(&self, stage: &str, progress: f64) {
        let elapsed = self.started.elapsed().as_secs_f64();
        let eta_s = (progress > 0.05).then(|| elapsed * (1.0 - progress) / progress);
        (self.observer)(&Event { stage, progress, eta_s });
    }
}

/// CPU seconds of this process so far, from the kernel's table (clock ticks are 1/100 s on Linux).
pub(crate) fn cpu_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return 0.0 };
    let after = stat.rsplit(')').next().unwrap_or_default();
    let ticks: f64 =
        after.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).fold(0.0, |a, b| a + b);
    ticks / 100.0
}

/// Largest resident size of this process so far, bytes.
pub(crate) fn peak_memory_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap_or_default();
    line.split_whitespace().next().and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) * 1024
}
