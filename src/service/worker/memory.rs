//! How much memory jobs may take: what a claim may ask for, and the bound of each child.
//!
//! A claim takes only jobs that are expected to fit into what is left; an idle worker takes any job, because waiting
//! would not make the machine larger. The expectation is only for planning; the bound of a child is the worker's share
//! of the whole, so that one that allocates without end meets its own bound before the machine's.

use crate::queue::Room;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

/// The part of free memory that jobs may take when the operator names none: the rest is for the service and the system.
const SHARE: f64 = 0.75;
/// What a job is expected to need beside its input, MiB.
const BASE_MB: u64 = 1024;
/// Bytes of a job per byte of its input: voxels as f32, their level sets and the meshes.
const PER_BYTE: u64 = 16;
/// Least bound of a child, MiB: below it not even a small scan can be read.
const LEAST_MB: i64 = 256;

/// Memory that a job with an input of `bytes` is expected to need, MiB.
pub(crate) fn expected_mb(bytes: u64) -> i64 {
    i64::try_from(BASE_MB + (bytes >> 20) * PER_BYTE).unwrap_or(i64::MAX)
}

/// Memory of a worker process. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Memory {
    all: i64,
    slots: i64,
    taken: Arc<AtomicI64>,
    running: Arc<AtomicI64>,
}

/// The share of a running job, given back when dropped.
#[derive(Debug)]
pub(super) struct Share {
    memory: Memory,
    mb: i64,
}

impl Memory {
    /// `all_mb` for `slots` jobs at the same time; 0 takes three quarters of what is free now.
    pub fn new(all_mb: u64, slots: usize) -> Self {
        let all = if all_mb > 0 { i64::try_from(all_mb).unwrap_or(i64::MAX) } else { free_share() };
        let slots = i64::try_from(slots.max(1)).unwrap_or(i64::MAX);
        Self { all, slots, taken: Arc::default(), running: Arc::default() }
    }

    /// The whole, MiB.
    pub fn all(&self) -> i64 {
        self.all
    }

    /// The bound of each child, MiB.
    pub fn each(&self) -> i64 {
        (self.all / self.slots).max(LEAST_MB)
    }

    /// What a claim may take.
    pub fn room(&self) -> Room {
        if self.running.load(Ordering::Acquire) == 0 {
            return Room::Any;
        }
        Room::Memory((self.all - self.taken.load(Ordering::Acquire)).max(0))
    }

    /// Takes a job's expected memory.
    pub(super) fn take(&self, mb: i64) -> Share {
        self.taken.fetch_add(mb, Ordering::AcqRel);
        self.running.fetch_add(1, Ordering::AcqRel);
        Share { memory: self.clone(), mb }
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.memory.taken.fetch_sub(self.mb, Ordering::AcqRel);
        self.memory.running.fetch_sub(1, Ordering::AcqRel);
    }
}

/// Three quarters of the free memory of the machine, or of the container where it has less, MiB.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, reason = "MiB of any machine are exact in f64")]
fn free_share() -> i64 {
    let machine = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        line.trim().trim_end_matches("kB").trim().parse::<i64>().ok().map(|kb| kb / 1024)
    });
    let container = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok();
    let container = container.and_then(|text| text.trim().parse::<i64>().ok()).map(|bytes| bytes >> 20);
    // Where neither can be read, 4 GiB: what a demo scan is promised to fit into.
    let free = machine.into_iter().chain(container).min().unwrap_or(4096);
    (free as f64 * SHARE) as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_idle_worker_takes_any_job_and_a_busy_one_what_is_left() {
        let memory = Memory::new(8000, 4);
        assert_eq!((memory.room(), memory.each()), (Room::Any, 2000));
        let first = memory.take(3000);
        assert_eq!(memory.room(), Room::Memory(5000));
        let second = memory.take(9000);
        assert_eq!(memory.room(), Room::Memory(0));
        drop((first, second));
        assert_eq!(memory.room(), Room::Any);
        assert!(Memory::new(0, 1).all() > 0);
    }
}
