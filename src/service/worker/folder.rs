//! The working folder of one attempt: `input/`, `plan.json`, and `out/` that the child makes appear whole.

use super::Owner;
use crate::queue::Claim;
use std::path::{Path, PathBuf};

/// The artefact by which a job on the same scan is spared what this one computed.
pub(super) const FIELD: &str = "field.bin";

/// A working folder, removed when dropped.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Makes the folder of an attempt; the name carries the fence, so that no two attempts share one.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub(super) async fn make(owner: &Owner, claim: &Claim) -> std::io::Result<Self> {
        let path = owner.work_dir().join(format!("{}-{}", claim.id, claim.fence));
        tokio::fs::create_dir_all(path.join("input")).await?;
        // The child may run elsewhere: give it names that hold from anywhere.
        Ok(Self { path: std::path::absolute(path)? })
    }

    /// Where the input lies.
    pub(super) fn input(&self) -> PathBuf {
        self.path.join("input")
    }

    /// Where the plan lies.
    pub(super) fn plan(&self) -> PathBuf {
        self.path.join("plan.json")
    }

    /// Where what an earlier job left lies.
    pub(super) fn earlier(&self) -> PathBuf {
        self.path.join(FIELD)
    }

    /// Where the artefacts appear.
    pub(super) fn out(&self) -> PathBuf {
        self.path.join("out")
    }

    /// The folder itself, the child's current folder.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Name and path of every finished artefact, by name.
    ///
    /// # Errors
    /// The out folder is missing or cannot be read.
    pub(super) async fn artefacts(&self) -> std::io::Result<Vec<(String, PathBuf)>> {
        let mut found = Vec::new();
        let mut entries = tokio::fs::read_dir(self.out()).await?;
        while let Some(entry) = entries.next_entry().await? {
            if entry.file_type().await?.is_file() {
                found.push((entry.file_name().to_string_lossy().into_owned(), entry.path()));
            }
        }
        found.sort();
        Ok(found)
    }

    /// Removes the folder without blocking the caller's thread.
    pub(super) async fn remove(self) {
        let path = self.path.clone();
        // A fault shows when Drop tries again.
        let _ = tokio::fs::remove_dir_all(path).await;
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        match std::fs::remove_dir_all(&self.path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                tracing::warn!(%error, "working folder left behind; the sweep at the next start takes it");
            }
            _ => {}
        }
    }
}
