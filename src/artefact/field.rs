//! field.bin: costly results of a run that a later one on the same scan takes again, each under the digest of all numbers from
//! which it was computed. Made and read by the same program only: its digest stands in the head, and that of all results after
//! it, because a bit that has fallen over would be a wrong number without a word.

use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The artefact.
pub const FIELD_BIN: &str = "field.bin";
const MAGIC: &[u8; 16] = b"vasculum-field-1";

/// Results by the digest of what they depend on.
pub type Results = BTreeMap<[u8; 32], Arc<Vec<f64>>>;

/// The digest of a result's name and of the numbers from which it is computed; lists of other lengths give another one.
pub fn key(name: &str, from: &[&[f64]]) -> [u8; 32] {
    let mut hasher = Sha256::new();
    hasher.update((name.len() as u64).to_le_bytes());
    hasher.update(name.as_bytes());
    for list in from {
        hasher.update((list.len() as u64).to_le_bytes());
        for some in list.chunks(1024) {
            let bytes: Vec<u8> = some.iter().flat_map(|x| x.to_le_bytes()).collect();
            hasher.update(&bytes);
        }
    }
    hasher.finalize().into()
}

/// The digest of a program's file.
pub fn program(bytes: &[u8]) -> [u8; 32] {
    Sha256::digest(bytes).into()
}

/// field.bin: magic, the program's digest, that of what follows, then for each result its key, its length and its numbers,
/// little-endian, by key.
pub fn written(program: &[u8; 32], results: &Results) -> Vec<u8> {
    let mut out = [&MAGIC[..], program, &[0; 32]].concat();
    let head = out.len();
    for (key, values) in results {
        out.extend(key);
        out.extend((values.len() as u64).to_le_bytes());
        out.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    }
    let digest = Sha256::digest(&out[head..]);
    out[head - 32..head].copy_from_slice(&digest);
    out
}

/// The results of a field.bin that this very program made; `None` of another one's, or where the file is not as it was
/// written.
pub fn read(program: &[u8; 32], bytes: &[u8]) -> Option<Results> {
    let (digest, mut rest) = bytes.strip_prefix(MAGIC)?.strip_prefix(program)?.split_first_chunk::<32>()?;
    if Sha256::digest(rest).as_slice() != digest {
        return None;
    }
    let mut results = Results::new();
    while !rest.is_empty() {
        let (key, more) = rest.split_first_chunk::<32>()?;
        let (count, more) = more.split_first_chunk::<8>()?;
        let size = usize::try_from(u64::from_le_bytes(*count)).ok()?.checked_mul(8)?;
        let (values, more) = more.split_at_checked(size)?;
        let (eights, _) = values.as_chunks::<8>();
        results.insert(*key, Arc::new(eights.iter().map(|x| f64::from_le_bytes(*x)).collect()));
        rest = more;
    }
    Some(results)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn what_is_written_is_read_by_the_same_program_and_by_no_other() {
        let (a, b) = (key("fit", &[&[1.0, -0.0], &[2.0]]), key("fit", &[&[1.0], &[-0.0, 2.0]]));
        assert!(a != b && a != key("fit", &[&[1.0, 0.0], &[2.0]]), "a key tells lists and signs apart");
        let results: Results = [(a, Arc::new(vec![0.1, f64::MAX])), (b, Arc::new(Vec::new()))].into();
        let me = program(b"me");
        let bytes = written(&me, &results);
        assert_eq!(read(&me, &bytes).unwrap(), results);
        assert!(read(&program(b"other"), &bytes).is_none());
        for cut in [0, 20, 50, bytes.len() - 1] {
            assert!(read(&me, &bytes[..cut]).is_none(), "{cut}");
        }
        for bit in [48, 80, 112, bytes.len() - 1] {
            let mut fallen = bytes.clone();
            fallen[bit] ^= 1;
            assert!(read(&me, &fallen).is_none(), "a bit fell over at {bit}");
        }
    }
}
