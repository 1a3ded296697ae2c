//! How to run: a thread pool, a cancel token and a progress sink in one [`Ctx`], with ordered parallel maps and sums.
//!
//! Numeric crates get all their parallelism through [`Ctx`], so that results do not depend on the number of threads:
//! maps keep their order and sums fold fixed chunks of [`CHUNK`] elements in order, so the bytes are the same for 1 and
//! for 64 threads. `par_iter().sum()` on floats is what this replaces.

mod recall;

pub use recall::{Key, Recall};

use rayon::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Elements per chunk of an ordered sum; fixed, so that rounding does not depend on the thread count.
pub const CHUNK: usize = 4096;

/// The work was cancelled by its caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;

/// The pool could not be made.
#[derive(Debug, thiserror::Error)]
#[error("no thread pool of {threads} threads: {reason}")]
pub struct PoolError {
    threads: usize,
    reason: String,
}

type Sink = Arc<dyn Fn(f64) + Send + Sync>;

/// A pool, a cancel token and a progress sink. Cloning is cheap and shares all three.
#[derive(Clone)]
pub struct Ctx {
    pool: Arc<rayon::ThreadPool>,
    cancel: Arc<AtomicBool>,
    sink: Sink,
    range: (f64, f64),
    recall: Option<Arc<dyn Recall>>,
}

impl Ctx {
    /// A context with `threads` threads (0: one per core), not cancelled, progress to nowhere.
    ///
    /// # Errors
    /// [`PoolError`] when the operating system gives no threads.
    pub fn new(threads: usize) -> Result<Self, PoolError> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|e| PoolError { threads, reason: e.to_string() })?;
        Ok(Self {
            pool: Arc::new(pool),
            cancel: Arc::default(),
            sink: Arc::new(|_| {}),
            range: (0.0, 1.0),
            recall: None,
        })
    }
    /// The same context with another progress sink, which is given the overall fraction, 0 to 1.
    #[must_use]
    pub fn with_progress(mut self, sink: impl Fn(f64) + Send + Sync + 'static) -> Self {
        self.sink = Arc::new(sink);
        self
    }
    /// The same context whose progress 0 to 1 is shown as `from` to `to` of the present range.
    #[must_use]
    pub fn part(&self, from: f64, to: f64) -> Self {
        let (a, b) = self.range;
        Self { range: (a + (b - a) * from, a + (b - a) * to), ..self.clone() }
    }
    /// Report that a fraction 0 to 1 of this context's range is done.
    pub fn progress(&self, fraction: f64) {
        let (a, b) = self.range;
        (self.sink)(a + (b - a) * fraction.clamp(0.0, 1.0));
    }
    /// Number of threads of the pool.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }
    /// Ask all work under this context to stop.
    pub fn cancel(&self) {
        self.cancel.store(true, Ordering::Relaxed);
    }
    /// Whether it was asked to stop.
    pub fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }
    /// # Errors
    /// [`Cancelled`] when it was asked to stop. Call it at least every few milliseconds of work.
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.is_cancelled() { Err(Cancelled) } else { Ok(()) }
    }
    /// Run a closure inside the pool (for faer's fixed logical parallelism).
    pub fn install<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        self.pool.install(f)
    }
    /// `items.map(f)` in parallel, in order.
    ///
    /// # Errors
    /// [`Cancelled`] when asked to stop; the rest of the items is then skipped.
    pub fn map<T: Sync, R: Send>(&self, items: &[T], f: impl Fn(&T) -> R + Sync) -> Result<Vec<R>, Cancelled> {
        self.pool.install(|| items.par_iter().map(|t| self.check().map(|()| f(t))).collect())
    }
    /// `(0..n).map(f)` in parallel, in order.
    ///
    /// # Errors
    /// [`Cancelled`] when asked to stop.
    pub fn map_range<R: Send>(&self, n: usize, f: impl Fn(usize) -> R + Sync) -> Result<Vec<R>, Cancelled> {
        self.pool.install(|| (0..n).into_par_iter().map(|i| self.check().map(|()| f(i))).collect())
    }
    /// Give `f(first index, chunk)` the chunks of `data`, `size` elements each, in parallel.
    ///
    /// # Errors
    /// [`Cancelled`] when asked to stop; some chunks are then untouched.
    pub fn chunks_mut<T: Send>(
        &self,
        data: &mut [T],
        size: usize,
        f: impl Fn(usize, &mut [T]) + Sync,
    ) -> Result<(), Cancelled> {
        let size = size.max(1);
        self.pool.install(|| {
            data.par_chunks_mut(size).enumerate().try_for_each(|(c, chunk)| {
                self.check()?;
                f(c * size, chunk);
                Ok(())
            })
        })
    }
    /// The sum of `f(i)` for i in 0..n: chunks of [`CHUNK`] in parallel, folded in order.
    ///
    /// # Errors
    /// [`Cancelled`] when asked to stop.
    pub fn sum(&self, n: usize, f: impl Fn(usize) -> f64 + Sync) -> Result<f64, Cancelled> {
        let parts =
            self.map_range(n.div_ceil(CHUNK), |c| (c * CHUNK..n.min((c + 1) * CHUNK)).fold(0.0, |s, i| s + f(i)))?;
        Ok(parts.into_iter().fold(0.0, |s, p| s + p))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::sync::Mutex;

    #[test]
    fn a_sum_has_the_same_bits_for_any_thread_count() {
        let sum = |threads| Ctx::new(threads).unwrap().sum(100_003, |i| 1.0 / (i as f64 + 0.1)).unwrap();
        assert_eq!(sum(1).to_bits(), sum(2).to_bits());
        assert_eq!(sum(1).to_bits(), sum(3).to_bits());
    }

    #[test]
    fn a_map_keeps_its_order() {
        let ctx = Ctx::new(3).unwrap();
        let out = ctx.map_range(1000, |i| i * 2).unwrap();
        assert!(out.iter().enumerate().all(|(i, &x)| x == 2 * i));
    }

    #[test]
    fn cancelled_work_says_so() {
        let ctx = Ctx::new(2).unwrap();
        ctx.cancel();
        assert_eq!(ctx.map_range(10, |i| i), Err(Cancelled));
        assert_eq!(ctx.sum(10, |i| i as f64), Err(Cancelled));
    }

    #[test]
    fn parts_map_into_the_whole() {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let s = Arc::clone(&seen);
        let ctx = Ctx::new(1).unwrap().with_progress(move |p| s.lock().unwrap().push(p));
        ctx.part(0.2, 0.6).part(0.5, 1.0).progress(0.5);
        assert!((seen.lock().unwrap()[0] - 0.5).abs() < 1e-12);
    }
}
