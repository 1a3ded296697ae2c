//! What MetaImage and NRRD headers share: lines of text before, or beside, the voxels.

use super::{Error, NamedBytes};

/// A header is shorter than this.
const MAX_HEADER: usize = 64 << 10;

/// The fields of a header, in their order.
pub(crate) struct Fields<'a> {
    pub(crate) file: &'a str,
    pub(crate) fields: Vec<(String, &'a str)>,
    /// Bytes after the header.
    pub(crate) rest: &'a [u8],
}

/// What a line of a header is.
pub(crate) enum Line<'a> {
    /// A comment or an empty line within the header.
    Nothing,
    /// Key and value.
    Field(String, &'a str),
    /// Key and value, after which the voxels begin.
    LastField(String, &'a str),
    /// The line after which the voxels begin.
    End,
    /// None of these.
    Foreign,
}

impl<'a> Fields<'a> {
    /// The fields of a header whose lines `of` tells apart (by number and text); the flag says whether the header's end
    /// was found.
    ///
    /// # Errors
    /// [`Error::Malformed`] for lines that are no text or no field.
    pub(crate) fn parse(
        file: &'a str,
        bytes: &'a [u8],
        of: impl Fn(usize, &'a str) -> Line<'a>,
    ) -> Result<(Self, bool), Error> {
        let malformed = |reason: &str| Error::Malformed { file: file.to_owned(), reason: reason.to_owned() };
        let mut fields = Vec::new();
        let (mut at, mut number) = (0, 0);
        while at < bytes.len().min(MAX_HEADER) {
            let line = bytes[at..].split(|b| *b == b'\n').next().unwrap_or_default();
            at = (at + line.len() + 1).min(bytes.len());
            // a comment may be written in any encoding
            let line = if line.starts_with(b"#") { &b"#"[..] } else { line };
            let text = std::str::from_utf8(line).map_err(|_| malformed("a line of its header is no text"))?;
            let rest = &bytes[at..];
            match of(number, text) {
                Line::Nothing => {}
                Line::Field(key, value) => fields.push((key, value)),
                Line::LastField(key, value) => {
                    fields.push((key, value));
                    return Ok((Self { file, fields, rest }, true));
                }
                Line::End => return Ok((Self { file, fields, rest }, true)),
                Line::Foreign => return Err(malformed("a line of its header is no field")),
            }
            number += 1;
        }
        Ok((Self { file, fields, rest: &[] }, false))
    }
    /// The value of the first of some keys that is there.
    pub(crate) fn any(&self, keys: &[&str]) -> Option<&'a str> {
        keys.iter().find_map(|key| self.fields.iter().find(|(k, _)| k == key).map(|(_, v)| *v))
    }
    pub(crate) fn get(&self, key: &str) -> Option<&'a str> {
        self.any(&[key])
    }
    pub(crate) fn malformed(&self, reason: impl Into<String>) -> Error {
        Error::Malformed { file: self.file.to_owned(), reason: reason.into() }
    }
    pub(crate) fn unsupported(&self, reason: impl Into<String>) -> Error {
        Error::Unsupported { file: self.file.to_owned(), reason: reason.into() }
    }
    /// The finite numbers of a value, separated by spaces or commas, possibly within one pair of parentheses.
    ///
    /// # Errors
    /// [`Error::Malformed`] when there are not `N` of them.
    pub(crate) fn numbers<const N: usize>(&self, key: &str, text: &str) -> Result<[f64; N], Error> {
        let inner = text.trim().trim_start_matches('(').trim_end_matches(')');
        let parsed: Option<Vec<f64>> = inner
            .split([',', ' ', '\t'])
            .filter(|t| !t.is_empty())
            .map(|t| t.parse().ok().filter(|x: &f64| x.is_finite()))
            .collect();
        parsed
            .and_then(|v| <[f64; N]>::try_from(v).ok())
            .ok_or_else(|| self.malformed(format!("{key} does not hold {N} numbers")))
    }
    /// Three sizes.
    ///
    /// # Errors
    /// [`Error::Malformed`] unless they are whole numbers from 1.
    pub(crate) fn size(&self, key: &str) -> Result<[u64; 3], Error> {
        let size = self.numbers::<3>(key, self.get(key).unwrap_or_default())?;
        if size.iter().any(|n| *n < 1.0 || *n > 1e9 || n.fract() != 0.0) {
            return Err(self.malformed(format!("{key} is {size:?}")));
        }
        Ok(size.map(|n| n as u64))
    }
    /// The bytes of the image: those after the header, or a whole file named by the header.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for lists of files, [`Error::Malformed`] when the file is not there.
    pub(crate) fn data<'b>(&self, named: Option<&str>, companions: &[&'b NamedBytes]) -> Result<&'b [u8], Error>
    where
        'a: 'b,
    {
        let Some(name) = named else { return Ok(self.rest) };
        if name.starts_with("LIST") || name.contains('%') {
            return Err(self.unsupported("one data file per slice is not read; save the volume as one file"));
        }
        companion(companions, name)
            .ok_or_else(|| self.malformed("the data file that its header names was not sent with it"))
    }
}

/// A file by the last part of its name.
pub(crate) fn companion<'b>(files: &[&'b NamedBytes], name: &str) -> Option<&'b [u8]> {
    let base = |n: &str| n.rsplit(['/', '\\']).next().unwrap_or_default().to_owned();
    files.iter().find(|f| base(&f.name) == base(name)).map(|f| f.bytes.as_slice())
}
