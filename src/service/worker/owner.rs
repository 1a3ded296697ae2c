//! Who holds leases: one lock file per process, so that a dead process is known at once and a living one never robbed.
//!
//! `<data_dir>/owners/<name>` stays locked while its process lives; the kernel lets go at its death, even by
//! `kill -9`. Whoever finds an unlocked file takes back that owner's jobs and removes its working folders. Leases
//! remain the rule for owners on other machines.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use uuid::Uuid;

/// This process as a holder of leases.
#[derive(Debug)]
pub struct Owner {
    name: String,
    data_dir: PathBuf,
    /// Held open for its lock.
    _lock: File,
}

impl Owner {
    /// Registers this process under the data folder.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn register(data_dir: &Path) -> std::io::Result<Self> {
        std::fs::create_dir_all(data_dir.join("owners"))?;
        let name = Uuid::now_v7().to_string();
        let lock = File::create(data_dir.join("owners").join(&name))?;
        lock.lock()?;
        Ok(Self { name, data_dir: data_dir.to_owned(), _lock: lock })
    }

    /// The name in `lease_owner`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The folder in which this process works.
    pub fn work_dir(&self) -> PathBuf {
        self.data_dir.join("work").join(&self.name)
    }

    /// Names of owners of this data folder whose process is dead.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn dead(&self) -> std::io::Result<Vec<String>> {
        let mut dead = Vec::new();
        for entry in std::fs::read_dir(self.data_dir.join("owners"))? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if name != self.name && is_free(&entry.path()) {
                dead.push(name);
            }
        }
        Ok(dead)
    }

    /// Forgets a dead owner: its working folders, then its file. To be called after its jobs were taken back.
    pub fn forget(&self, dead: &str) {
        for gone in [
            std::fs::remove_dir_all(self.data_dir.join("work").join(dead)),
            std::fs::remove_file(self.data_dir.join("owners").join(dead)),
        ] {
            match gone {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    tracing::warn!(%error, "cannot remove what a dead process left");
                }
                _ => {}
            }
        }
    }
}

impl Drop for Owner {
    fn drop(&mut self) {
        self.forget(&self.name);
    }
}

fn is_free(path: &Path) -> bool {
    let Ok(file) = File::open(path) else { return false };
    !matches!(file.try_lock(), Err(TryLockError::WouldBlock | TryLockError::Error(_)))
}
