//! Results that an earlier run had: a costly result that depends on nothing but numbers is looked up by those numbers, all of them
//! and to the last bit, so that a run with something known gives the bytes of one that computes everything.

use crate::Ctx;
use std::sync::Arc;

/// What a result was computed from, as one number.
pub type Key = [u8; 32];

/// Keeps results for later runs.
pub trait Recall: Send + Sync {
    /// A digest of a result's name and of everything that it depends on.
    fn key(&self, name: &str, from: &[&[f64]]) -> Key;
    /// The result, if an earlier run had it, to the last bit as it was learnt.
    fn known(&self, key: &Key) -> Option<Vec<f64>>;
    /// Takes a result for a later run.
    fn learn(&self, key: Key, values: &[f64]);
}

impl Ctx {
    /// The same context with results of an earlier run.
    #[must_use]
    pub fn with_recall(mut self, recall: Arc<dyn Recall>) -> Self {
        self.recall = Some(recall);
        self
    }

    /// The result `name` of the numbers `from`: known, or computed and learnt. `compute` depends on nothing else.
    ///
    /// # Errors
    /// Those of `compute`.
    pub fn recalled<E>(
        &self,
        name: &str,
        from: &[&[f64]],
        compute: impl FnOnce() -> Result<Vec<f64>, E>,
    ) -> Result<Vec<f64>, E> {
        let Some(recall) = &self.recall else { return compute() };
        let key = recall.key(name, from);
        if let Some(values) = recall.known(&key) {
            return Ok(values);
        }
        let values = compute()?;
        recall.learn(key, &values);
        Ok(values)
    }
}
