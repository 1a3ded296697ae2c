//! What a run takes from an earlier one on the same scan, and what it leaves for a later one (docs/adr/0073).

use artefact::NamedBytes;
use artefact::field::{self, FIELD_BIN, Results};
use exec::{Key, Recall};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

/// A run that has computed at least so many numbers keeps them (12 MB): one of the demo's size, 5 s of one core, has half
/// as many, one of 512 x 512 x 60 has 1.6 times as many.
const KEPT_FROM: usize = 1_500_000;

/// Results of an earlier run, and those that this one asked for.
#[derive(Default)]
pub(crate) struct Memory {
    earlier: Results,
    asked: Mutex<Results>,
    recalled: AtomicUsize,
}

impl Memory {
    /// What the field.bin at `path` (or in it, for a folder) holds; nothing where there is none of this very program.
    pub(crate) fn of(path: Option<&Path>) -> Self {
        let file = path.map(|p| if p.is_dir() { p.join(FIELD_BIN) } else { p.to_owned() });
        let bytes = file.and_then(|file| std::fs::read(file).ok());
        let earlier = bytes.and_then(|bytes| field::read(program()?, &bytes)).unwrap_or_default();
        Self { earlier, ..Self::default() }
    }

    /// How many results the earlier run gave.
    pub(crate) fn recalled(&self) -> usize {
        self.recalled.load(Ordering::Relaxed)
    }

    /// field.bin for a later run, where it is worth its place or wanted. Its bytes are the same whether the results were
    /// computed or recalled.
    pub(crate) fn artefact(&self, is_wanted: bool) -> Option<NamedBytes> {
        let asked = self.asked.lock().ok()?;
        let numbers: usize = asked.values().map(|values| values.len()).sum();
        let kept = is_wanted || numbers >= KEPT_FROM;
        let program = program().filter(|_| kept)?;
        Some(NamedBytes::new(FIELD_BIN, field::written(program, &asked)))
    }
}

impl Recall for Memory {
    fn key(&self, name: &str, from: &[&[f64]]) -> Key {
        field::key(name, from)
    }

    fn known(&self, key: &Key) -> Option<Vec<f64>> {
        let values = self.earlier.get(key)?;
        self.recalled.fetch_add(1, Ordering::Relaxed);
        if let Ok(mut asked) = self.asked.lock() {
            asked.insert(*key, Arc::clone(values));
        }
        Some(values.to_vec())
    }

    fn learn(&self, key: Key, values: &[f64]) {
        if let Ok(mut asked) = self.asked.lock() {
            asked.insert(key, Arc::new(values.to_vec()));
        }
    }
}

/// The digest of this program: another one may compute other bytes.
fn program() -> Option<&'static [u8; 32]> {
    static PROGRAM: OnceLock<Option<[u8; 32]>> = OnceLock::new();
    let digest = || Some(field::program(&std::fs::read(std::env::current_exe().ok()?).ok()?));
    PROGRAM.get_or_init(digest).as_ref()
}
