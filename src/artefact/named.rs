//! A file in memory.

use sha2::{Digest, Sha256};
use std::fmt::Write as _;

/// A file's bytes with its name inside an upload or in the folder of a result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedBytes {
    /// Name with `/` between folders; never a path of this machine.
    pub name: String,
    /// Content.
    pub bytes: Vec<u8>,
}

impl NamedBytes {
    /// A named file.
    pub fn new(name: impl Into<String>, bytes: impl Into<Vec<u8>>) -> Self {
        Self { name: name.into(), bytes: bytes.into() }
    }
    /// `sha256:` and the hexadecimal digest of the content.
    pub fn digest(&self) -> String {
        let mut out = String::from("sha256:");
        for byte in Sha256::digest(&self.bytes) {
            // Writing into a String cannot fail.
            let _ = write!(out, "{byte:02x}");
        }
        out
    }
}
