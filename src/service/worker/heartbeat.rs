//! Beats from an OS thread of their own: leases renewed, progress written, cancels read, dead owners' jobs rescued.
//!
//! The thread has its own small runtime and its own database connection, so that neither a busy async worker nor a
//! long reader can hold a beat back. A holder whose beats fail for a whole lease gives up by itself: by then another
//! worker may hold the job.

use super::child::Step;
use super::owner::Owner;
use crate::queue::{Beat, LEASE_MS, Queue, Verdict};
use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use uuid::Uuid;

/// Between beats when nothing hurries: a cancel from another process is seen within it.
const BEAT: Duration = Duration::from_secs(1);
/// Shortest time between beats, so that a chatty job cannot keep the writer busy.
const SHORTEST: Duration = Duration::from_millis(100);
/// Between looks for leases that ran out and owners that died.
const RESCUE: Duration = Duration::from_millis(500);

#[derive(Debug)]
struct Entry {
    beat: Beat,
    verdict: watch::Sender<Verdict>,
    renewed: Instant,
}

type Entries = Arc<Mutex<BTreeMap<(Uuid, i64), Entry>>>;

enum Call {
    Beat,
    Stop,
}

/// The heartbeat thread. Dropping it stops and joins the thread.
#[derive(Debug)]
pub struct Heartbeat {
    entries: Entries,
    calls: Sender<Call>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// A job that this process holds; beats go on until it is dropped.
#[derive(Debug)]
pub struct Held {
    key: (Uuid, i64),
    entries: Entries,
    calls: Sender<Call>,
    verdict: watch::Receiver<Verdict>,
}

fn locked(entries: &Entries) -> MutexGuard<'_, BTreeMap<(Uuid, i64), Entry>> {
    // Entries are plain values: a panic elsewhere cannot leave one half written.
    entries.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Heartbeat {
    /// Starts the thread on its own connection to the queue's database.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub fn start(queue: &Queue, owner: Arc<Owner>) -> std::io::Result<Self> {
        let entries: Entries = Entries::default();
        let (calls, inbox) = channel();
        let beats = Beats { queue: queue.clone(), owner, entries: Arc::clone(&entries) };
        let thread = std::thread::Builder::new().name("heartbeat".to_owned()).spawn(move || beats.run(&inbox))?;
        Ok(Self { entries, calls, thread: Some(thread) })
    }

    /// Holds a claimed job.
    pub fn hold(&self, id: Uuid, fence: i64) -> Held {
        let (verdict, receiver) = watch::channel(Verdict::Run);
        let entry = Entry { beat: Beat::default(), verdict, renewed: Instant::now() };
        locked(&self.entries).insert((id, fence), entry);
        Held { key: (id, fence), entries: Arc::clone(&self.entries), calls: self.calls.clone(), verdict: receiver }
    }

    /// How many jobs this process holds.
    pub fn held(&self) -> usize {
        locked(&self.entries).len()
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        // An error means that the thread has ended already.
        let _ = self.calls.send(Call::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Held {
    /// Takes a line of progress over; a new stage asks for a beat at once.
    pub fn step(&self, step: Step) {
        let mut entries = locked(&self.entries);
        let Some(entry) = entries.get_mut(&self.key) else { return };
        let beat = &mut entry.beat;
        let entered = step.stage.filter(|stage| beat.stage.as_deref() != Some(stage));
        if let Some(p) = step.progress.filter(|p| p.is_finite()) {
            let p = p.clamp(0.0, 1.0);
            beat.moved |= p.to_bits() != beat.progress.to_bits();
            beat.progress = p;
        }
        let eta_s = step.eta_s.filter(|s| s.is_finite() && *s >= 0.0);
        beat.moved |= eta_s.map(f64::to_bits) != beat.eta_s.map(f64::to_bits);
        beat.eta_s = eta_s;
        if let Some(stage) = entered {
            beat.moved = true;
            beat.stages.push(stage.clone());
            beat.stage = Some(stage);
            drop(entries);
            self.ask();
        }
    }

    /// Asks for a beat soon.
    pub fn ask(&self) {
        // An error means that the thread has stopped: the lease then runs out.
        let _ = self.calls.send(Call::Beat);
    }

    /// The last verdict.
    pub fn verdict(&self) -> Verdict {
        *self.verdict.borrow()
    }

    /// The verdict after the next beat (or after two beats' time without one).
    pub async fn verdict_now(&self) -> Verdict {
        let mut verdict = self.verdict.clone();
        self.ask();
        // Without a change the last verdict stands.
        let _ = tokio::time::timeout(2 * BEAT, verdict.wait_for(|v| *v != Verdict::Run)).await;
        self.verdict()
    }

    /// Told of every change of the verdict.
    pub fn subscribe(&self) -> watch::Receiver<Verdict> {
        let mut receiver = self.verdict.clone();
        // A verdict that fell before the subscription must wake the subscriber too.
        receiver.mark_changed();
        receiver
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        locked(&self.entries).remove(&self.key);
    }
}

struct Beats {
    queue: Queue,
    owner: Arc<Owner>,
    entries: Entries,
}

impl Beats {
    fn run(self, inbox: &Receiver<Call>) {
        let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
            Ok(runtime) => runtime,
            Err(error) => return tracing::error!(%error, "no runtime for beats"),
        };
        let mut queue = None;
        let mut rescued = Instant::now();
        loop {
            match inbox.recv_timeout(BEAT) {
                Ok(Call::Stop) | Err(RecvTimeoutError::Disconnected) => break,
                Ok(Call::Beat) | Err(RecvTimeoutError::Timeout) => {}
            }
            let begun = Instant::now();
            if queue.is_none() {
                queue = runtime.block_on(self.connect());
            }
            if let Some(queue) = &queue {
                runtime.block_on(self.beat_all(queue));
                if rescued.elapsed() >= RESCUE {
                    runtime.block_on(self.rescue(queue));
                    rescued = Instant::now();
                }
            }
            self.give_up_lost();
            std::thread::sleep(SHORTEST.saturating_sub(begun.elapsed()));
            if inbox.try_iter().any(|call| matches!(call, Call::Stop)) {
                break;
            }
        }
        if let Some(queue) = queue {
            runtime.block_on(queue.db().close());
        }
    }

    async fn connect(&self) -> Option<Queue> {
        match self.queue.db().for_thread().await {
            Ok(db) => Some(self.queue.with_db(db)),
            Err(error) => {
                tracing::warn!(%error, "no database connection for beats");
                None
            }
        }
    }

    async fn beat_all(&self, queue: &Queue) {
        let due: Vec<((Uuid, i64), Beat)> = {
            let mut entries = locked(&self.entries);
            entries
                .iter_mut()
                .map(|(key, entry)| {
                    let beat = entry.beat.clone();
                    entry.beat.stages.clear();
                    entry.beat.moved = false;
                    (*key, beat)
                })
                .collect()
        };
        for ((id, fence), beat) in due {
            match queue.beat(id, fence, &beat).await {
                Ok(verdict) => self.told((id, fence), verdict),
                Err(error) => {
                    tracing::warn!(job = %id, %error, "beat not written");
                    self.keep((id, fence), beat);
                }
            }
        }
    }

    fn told(&self, key: (Uuid, i64), verdict: Verdict) {
        if let Some(entry) = locked(&self.entries).get_mut(&key) {
            entry.renewed = Instant::now();
            entry.verdict.send_if_modified(|now| std::mem::replace(now, verdict) != verdict);
        }
    }

    /// Puts back what a failed beat could not write.
    fn keep(&self, key: (Uuid, i64), mut beat: Beat) {
        if let Some(entry) = locked(&self.entries).get_mut(&key) {
            beat.stages.append(&mut entry.beat.stages);
            entry.beat.stages = beat.stages;
            entry.beat.moved |= beat.moved;
        }
    }

    fn give_up_lost(&self) {
        let lease = Duration::from_millis(LEASE_MS.unsigned_abs());
        for entry in locked(&self.entries).values() {
            if entry.renewed.elapsed() >= lease {
                entry.verdict.send_if_modified(|now| std::mem::replace(now, Verdict::Lost) != Verdict::Lost);
            }
        }
    }

    async fn rescue(&self, queue: &Queue) {
        let dead = self.owner.dead().unwrap_or_default();
        match queue.rescue(&dead).await {
            Ok(jobs) => {
                for job in jobs {
                    tracing::warn!(%job, "taken back from a dead worker");
                }
                dead.iter().for_each(|name| self.owner.forget(name));
            }
            Err(error) => tracing::warn!(%error, "cannot rescue"),
        }
    }
}
