//! `Range: bytes=...` and entity tags, as RFC 9110 says. One range is served; several are answered with the whole.

use std::ops::Range;

/// What a Range header asks of an object.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Asked {
    /// No range, or one that is to be ignored.
    Whole,
    /// These bytes.
    Part(Range<u64>),
    /// Nothing of the object.
    Unsatisfiable,
}

/// Reads a Range header for an object of `size` bytes.
pub(super) fn asked(header: Option<&str>, size: u64) -> Asked {
    let Some(set) = header.and_then(|h| h.trim().strip_prefix("bytes=")) else { return Asked::Whole };
    if set.contains(',') {
        return Asked::Whole;
    }
    let Some((first, last)) = set.trim().split_once('-') else { return Asked::Whole };
    let range = match (number(first), number(last)) {
        (Some(Some(first)), Some(Some(last))) if first <= last => first..last.saturating_add(1).min(size),
        (Some(Some(first)), Some(None)) => first..size,
        (Some(None), Some(Some(count))) => size.saturating_sub(count)..size,
        _ => return Asked::Whole,
    };
    if range.start >= range.end { Asked::Unsatisfiable } else { Asked::Part(range) }
}

/// Digits, or nothing (`Some(None)`), or nonsense (`None`).
fn number(text: &str) -> Option<Option<u64>> {
    if text.is_empty() {
        return Some(None);
    }
    if !text.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    // More digits than u64 holds: beyond any object.
    Some(Some(text.parse().unwrap_or(u64::MAX)))
}

/// Whether an If-None-Match list names the tag (weak comparison) or `*`.
pub(super) fn matches(list: &str, tag: &str) -> bool {
    list.split(',').map(str::trim).any(|one| one == "*" || one.strip_prefix("W/").unwrap_or(one) == tag)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges() {
        assert_eq!(asked(None, 10), Asked::Whole);
        assert_eq!(asked(Some("bytes=0-3"), 10), Asked::Part(0..4));
        assert_eq!(asked(Some("bytes=4-"), 10), Asked::Part(4..10));
        assert_eq!(asked(Some("bytes=-3"), 10), Asked::Part(7..10));
        assert_eq!(asked(Some("bytes=-30"), 10), Asked::Part(0..10));
        assert_eq!(asked(Some("bytes=0-99999999999999999999999"), 10), Asked::Part(0..10));
        assert_eq!(asked(Some("bytes=10-"), 10), Asked::Unsatisfiable);
        assert_eq!(asked(Some("bytes=-0"), 10), Asked::Unsatisfiable);
        for ignored in ["bytes=3-1", "bytes=a-b", "bytes=-", "bytes=0-1,3-4", "lines=0-1", "bytes=+1-2"] {
            assert_eq!(asked(Some(ignored), 10), Asked::Whole, "{ignored}");
        }
    }

    #[test]
    fn tags() {
        assert!(matches("\"a\", \"b\"", "\"b\""));
        assert!(matches("W/\"b\"", "\"b\""));
        assert!(matches("*", "\"b\""));
        assert!(!matches("\"a\"", "\"b\""));
    }
}
