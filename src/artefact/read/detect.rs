//! What a file is, by its content; its name is used only to tell damaged images from stray documents.

/// The kinds of file that an upload may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// DICOM, with or without preamble.
    Dicom,
    /// NIfTI, possibly gzipped.
    Nifti,
    /// MetaImage header, with or without its pixels.
    MetaImage,
    /// NRRD header, with or without its pixels.
    Nrrd,
    /// PNG, PGM, JPEG or TIFF.
    Picture,
    /// Zip archive.
    Zip,
    /// gzip stream of whatever.
    Gzip,
    /// None of these.
    Unknown,
}

impl Kind {
    /// In words.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Dicom => "DICOM",
            Self::Nifti => "NIfTI",
            Self::MetaImage => "MetaImage",
            Self::Nrrd => "NRRD",
            Self::Picture => "a picture",
            Self::Zip => "a zip archive",
            Self::Gzip => "a gzip stream",
            Self::Unknown => "of unknown kind",
        }
    }
}

/// The kind of some bytes.
pub(crate) fn kind(bytes: &[u8]) -> Kind {
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    if bytes.get(128..132) == Some(b"DICM") {
        Kind::Dicom
    } else if starts(b"PK\x03\x04") || starts(b"PK\x05\x06") {
        Kind::Zip
    } else if starts(&[0x1f, 0x8b]) {
        Kind::Gzip
    } else if starts(&[0x89, b'P', b'N', b'G']) || starts(&[0xff, 0xd8, 0xff]) || is_pgm(bytes) || is_tiff(bytes) {
        Kind::Picture
    } else if starts(b"NRRD000") {
        Kind::Nrrd
    } else if is_nifti(bytes) {
        Kind::Nifti
    } else if is_metaimage(bytes) {
        Kind::MetaImage
    } else if is_bare_dicom(bytes) {
        Kind::Dicom
    } else {
        Kind::Unknown
    }
}

fn is_pgm(bytes: &[u8]) -> bool {
    (bytes.starts_with(b"P5") || bytes.starts_with(b"P2")) && bytes.get(2).is_some_and(u8::is_ascii_whitespace)
}

fn is_tiff(bytes: &[u8]) -> bool {
    bytes.starts_with(b"II\x2a\0") || bytes.starts_with(b"MM\0\x2a")
}

/// sizeof_hdr is 348 (NIfTI-1) or 540 (NIfTI-2) in either byte order.
fn is_nifti(bytes: &[u8]) -> bool {
    let Some(first) = bytes.first_chunk::<4>() else { return false };
    let sizes = [i32::from_le_bytes(*first), i32::from_be_bytes(*first)];
    (sizes.contains(&348) && matches!(bytes.get(344..347), Some(b"n+1" | b"ni1")))
        || (sizes.contains(&540) && matches!(bytes.get(4..7), Some(b"n+2" | b"ni2")))
}

/// A text of `Key = value` lines that names NDims or DimSize near its start.
fn is_metaimage(bytes: &[u8]) -> bool {
    let head = &bytes[..bytes.len().min(4096)];
    let starts_with_key = head.first().is_some_and(u8::is_ascii_alphabetic);
    let has = |key: &[u8]| head.windows(key.len()).any(|w| w == key);
    starts_with_key && has(b"DimSize") && (has(b"ElementType") || has(b"ElementDataFile"))
}

/// A data set without preamble: it begins with group 0002 or 0008 and a value shorter than the file.
fn is_bare_dicom(bytes: &[u8]) -> bool {
    let Some(h) = bytes.first_chunk::<8>() else { return false };
    let known = matches!(h[..2], [0x02, 0x00] | [0x08, 0x00]) && h[3] == 0;
    let explicit = h[4].is_ascii_uppercase() && h[5].is_ascii_uppercase();
    let length = u32::from_le_bytes([h[4], h[5], h[6], h[7]]) as usize;
    known && bytes.len() > 132 && (explicit || length < bytes.len().min(1024))
}

/// Whether a file that is no image may lie beside the images and be left out: a document by its name.
pub(crate) fn is_document(name: &str) -> bool {
    const DOCUMENTS: [&str; 14] = [
        ".txt", ".md", ".json", ".csv", ".html", ".htm", ".css", ".xml", ".xsl", ".pdf", ".inf", ".log", ".ini", ".rtf",
    ];
    let name = name.to_ascii_lowercase();
    let base = name.rsplit(['/', '\\']).next().unwrap_or_default();
    base == "readme" || base == "license" || DOCUMENTS.iter().any(|e| base.ends_with(e))
}

/// Whether the file is a system's own and never an image: hidden, a DICOMDIR, a resource fork.
pub(crate) fn is_ignored(name: &str) -> bool {
    let mut parts = name.split(['/', '\\']).filter(|p| !p.is_empty() && *p != "." && *p != "..").peekable();
    let mut last = "";
    while let Some(part) = parts.next() {
        if part.starts_with('.') || part == "__MACOSX" {
            return true;
        }
        if parts.peek().is_none() {
            last = part;
        }
    }
    last.is_empty() || ["DICOMDIR", "THUMBS.DB", "DESKTOP.INI"].contains(&last.to_ascii_uppercase().as_str())
}

/// Whether the file is a plan by its name.
pub(crate) fn is_plan(name: &str) -> bool {
    name.rsplit(['/', '\\']).next().is_some_and(|base| base.eq_ignore_ascii_case("plan.json"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stray_files_are_told_from_images() {
        assert!(is_ignored("a/.DS_Store") && is_ignored("__MACOSX/x.dcm") && is_ignored("cd/DICOMDIR"));
        assert!(!is_ignored("a/IM0001") && !is_ignored("./x.dcm"));
        assert!(is_document("a/ReadMe.TXT") && !is_document("a/IM0001.dcm"));
        assert!(is_plan("x/plan.json") && !is_plan("floorplan.json"));
    }

    #[test]
    fn short_or_foreign_bytes_are_unknown() {
        for b in [&b""[..], b"P", b"\x1f", b"II*", b"hello world", &[0; 200]] {
            assert_eq!(kind(b), Kind::Unknown, "{b:?}");
        }
    }
}
