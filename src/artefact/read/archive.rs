//! Zip and gzip in memory, with every promise of their headers checked against what comes out.

use super::detect::{Kind, is_ignored, kind};
use super::{Error, Limits, NamedBytes};
use std::io::{Cursor, Read};

fn refused(file: &str, reason: impl Into<String>) -> Error {
    Error::Archive { file: file.to_owned(), reason: reason.into() }
}

/// Read a stream whose size is at most `limit`.
///
/// # Errors
/// [`Error::TooLarge`] beyond it, [`Error::Malformed`] when the stream is damaged.
fn bounded(file: &str, stream: impl Read, limit: u64) -> Result<Vec<u8>, Error> {
    let mut out = Vec::new();
    stream
        .take(limit.saturating_add(1))
        .read_to_end(&mut out)
        .map_err(|e| Error::Malformed { file: file.to_owned(), reason: format!("its compressed data: {e}") })?;
    if out.len() as u64 > limit {
        let what = "the decompressed size in bytes";
        return Err(Error::TooLarge { file: Some(file.to_owned()), what, value: out.len() as u64, limit });
    }
    Ok(out)
}

/// A gzip stream's content.
///
/// # Errors
/// [`Error::TooLarge`] for more than the ratio or the total of `limits`, [`Error::Malformed`] for damaged streams.
pub(crate) fn gunzip(file: &str, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>, Error> {
    let limit = limits.inflated(bytes.len() as u64);
    // Counted before it is kept: a bomb of 20 MB would otherwise fill 2 GB before it meets its limit.
    let counted = std::io::copy(
        &mut flate2::read::MultiGzDecoder::new(bytes).take(limit.saturating_add(1)),
        &mut std::io::sink(),
    );
    if let Ok(value) = counted
        && value > limit
    {
        let what = "the decompressed size in bytes";
        return Err(Error::TooLarge { file: Some(file.to_owned()), what, value, limit });
    }
    bounded(file, flate2::read::MultiGzDecoder::new(bytes), limits.inflated(bytes.len() as u64))
}

/// A zlib stream's content; `expected` bytes at most.
///
/// # Errors
/// As [`gunzip`].
pub(crate) fn unzlib(file: &str, bytes: &[u8], expected: u64, limits: &Limits) -> Result<Vec<u8>, Error> {
    bounded(file, flate2::read::ZlibDecoder::new(bytes), expected.min(limits.inflated(bytes.len() as u64)))
}

/// A raw deflate stream's content (DICOM's deflated transfer syntax).
///
/// # Errors
/// As [`gunzip`].
pub(crate) fn inflate(file: &str, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>, Error> {
    bounded(file, flate2::read::DeflateDecoder::new(bytes), limits.inflated(bytes.len() as u64))
}

/// The number of entries that the end records of a zip state: the larger of the old one's and zip64's, where there is one.
fn stated_entries(bytes: &[u8]) -> u64 {
    let tail = &bytes[bytes.len().saturating_sub(65_557)..];
    let last = |mark: &[u8; 4], length: usize| {
        (0..(tail.len() + 1).saturating_sub(length)).rev().find(|&i| tail[i..].starts_with(mark)).map(|i| &tail[i..])
    };
    let old = last(b"PK\x05\x06", 22).map_or(0, |end| u64::from(u16::from_le_bytes([end[10], end[11]])));
    let zip64 = last(b"PK\x06\x06", 56).and_then(|end| Some(u64::from_le_bytes(end[32..40].try_into().ok()?)));
    old.max(zip64.unwrap_or(0))
}

/// The files of a zip, sorted as they are stored; system files are left out.
///
/// # Errors
/// [`Error::Archive`] for encrypted entries, archives inside, links and names that lead out of the archive;
/// [`Error::TooLarge`] for too many entries, bytes or too high a ratio.
pub(crate) fn unzip(archive: &NamedBytes, limits: &Limits) -> Result<Vec<NamedBytes>, Error> {
    let name = archive.name.as_str();
    let entries = stated_entries(&archive.bytes);
    if entries > limits.entries as u64 {
        let what = "the number of files in the archive";
        return Err(Error::TooLarge {
            file: Some(name.to_owned()),
            what,
            value: entries,
            limit: limits.entries as u64,
        });
    }
    let damaged =
        |e: zip::result::ZipError| Error::Malformed { file: name.to_owned(), reason: format!("not a whole zip: {e}") };
    let mut zip = zip::ZipArchive::new(Cursor::new(archive.bytes.as_slice())).map_err(damaged)?;
    let mut left = limits.inflated(archive.bytes.len() as u64);
    let mut files = Vec::new();
    for i in 0..zip.len() {
        // by_index_raw: an encrypted entry is described without its key
        let described = {
            let entry = zip.by_index_raw(i).map_err(damaged)?;
            (entry.encrypted(), entry.is_dir(), entry.is_symlink(), entry.size(), entry_name(name, &entry)?)
        };
        let (encrypted, folder, link, size, inner) = described;
        if encrypted {
            return Err(refused(&inner, "it is encrypted; send the archive without a password"));
        }
        if link {
            return Err(refused(&inner, "it is a link; send plain files only"));
        }
        if folder || is_ignored(&inner) {
            continue;
        }
        if size > left {
            let what = "the decompressed size in bytes";
            return Err(Error::TooLarge { file: Some(inner), what, value: size, limit: left });
        }
        let entry = zip.by_index(i).map_err(damaged)?;
        let bytes = bounded(&inner, entry, left)?;
        left -= bytes.len() as u64;
        if kind(&bytes) == Kind::Zip {
            return Err(refused(&inner, "an archive inside an archive is not opened; send one level only"));
        }
        files.push(NamedBytes { name: inner, bytes });
    }
    Ok(files)
}

/// The entry's name with forward slashes; refused when it would lead out of the archive.
fn entry_name<R: Read + ?Sized>(archive: &str, entry: &zip::read::ZipFile<'_, R>) -> Result<String, Error> {
    let raw = String::from_utf8_lossy(entry.name_raw()).replace('\\', "/");
    let bad = raw.contains('\0') || raw.starts_with('/') || raw.contains(':') || raw.split('/').any(|p| p == "..");
    if bad || raw.len() > 1024 {
        return Err(refused(archive, "an entry's name leads out of the archive; pack it again with plain names"));
    }
    Ok(raw)
}
