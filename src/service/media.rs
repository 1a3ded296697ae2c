//! Names of artefacts and their media types, and which of them is "the result" in which type.
//!
//! VTK's XML files have no registered media type; `application/x-vtk+xml` is this service's name for them, and the
//! other names in use are understood too.

use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// RFC 3339, UTC, of ms since 1970; `None` beyond the calendar.
pub fn rfc3339(ms: i64) -> Option<String> {
    OffsetDateTime::from_unix_timestamp_nanos(i128::from(ms) * 1_000_000).ok()?.format(&Rfc3339).ok()
}

/// The HTTP date (RFC 9110) of ms since 1970; `None` beyond the calendar.
pub fn http_date(ms: i64) -> Option<String> {
    let at = OffsetDateTime::from_unix_timestamp(ms.div_euclid(1000)).ok()?;
    let text = |word: &dyn std::fmt::Display| word.to_string().chars().take(3).collect::<String>();
    let (day, month) = (text(&at.weekday()), text(&at.month()));
    let (hour, minute, second) = at.to_hms();
    Some(format!("{day}, {:02} {month} {:04} {hour:02}:{minute:02}:{second:02} GMT", at.day(), at.year()))
}

/// Ms since 1970 of a time of RFC 3339.
pub fn ms_of(text: &str) -> Option<i64> {
    let time = OffsetDateTime::parse(text, &Rfc3339).ok()?;
    i64::try_from(time.unix_timestamp_nanos() / 1_000_000).ok()
}

/// Base 64 of RFC 4648.
pub fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for three in bytes.chunks(3) {
        let bits = three.iter().enumerate().fold(0_u32, |bits, (i, byte)| bits | u32::from(*byte) << (16 - 8 * i));
        for i in 0..4 {
            let digit = DIGITS[((bits >> (18 - 6 * i)) & 63) as usize];
            text.push(if i <= three.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

/// The bytes of base 64 (RFC 4648, with or without padding); `None` for anything else.
pub fn base64_bytes(text: &str) -> Option<Vec<u8>> {
    let (mut bytes, mut bits, mut held) = (Vec::new(), 0_u32, 0);
    for digit in text.trim_end_matches('=').bytes() {
        let value = match digit {
            b'A'..=b'Z' => digit - b'A',
            b'a'..=b'z' => digit - b'a' + 26,
            b'0'..=b'9' => digit - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => return None,
        };
        bits = (bits << 6) | u32::from(value);
        held += 6;
        if held >= 8 {
            held -= 8;
            bytes.push(u8::try_from((bits >> held) & 0xff).ok()?);
        }
    }
    Some(bytes)
}

/// Media type of VTK XML files.
pub const VTK: &str = "application/x-vtk+xml";

/// A form in which the result can be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Form {
    /// Media type sent.
    pub media_type: &'static str,
    /// Other media types that mean the same.
    pub aliases: &'static [&'static str],
    /// Words for `?format=`.
    pub words: &'static [&'static str],
    /// The artefact.
    pub artefact: &'static str,
}

/// Every form, the preferred one first.
pub const FORMS: &[Form] = &[
    Form { media_type: "application/json", aliases: &[], words: &["json"], artefact: "result.json" },
    Form { media_type: "model/gltf-binary", aliases: &[], words: &["glb", "gltf"], artefact: "surface.glb" },
    Form {
        media_type: VTK,
        aliases: &["application/vnd.vtk+xml", "application/xml+vtk", "model/vnd.vtk", "model/vtk"],
        words: &["vtp", "vtk"],
        artefact: "surface.vtp",
    },
    Form { media_type: "model/stl", aliases: &["application/sla"], words: &["stl"], artefact: "surface.stl" },
    Form { media_type: "text/csv", aliases: &[], words: &["csv"], artefact: "angles.csv" },
    Form { media_type: "text/html", aliases: &[], words: &["html"], artefact: "report.html" },
];

/// Media type of an artefact by its name.
pub fn media_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map_or("", |(_, ext)| ext) {
        "json" => "application/json",
        "csv" => "text/csv; charset=utf-8",
        "html" => "text/html; charset=utf-8",
        "vtp" | "vtu" => VTK,
        "glb" => "model/gltf-binary",
        "stl" => "model/stl",
        "zip" => "application/zip",
        "xml" => "application/xml",
        "png" => "image/png",
        "jpg" => "image/jpeg",
        _ => "application/octet-stream",
    }
}

/// The form of these that an Accept header prefers: highest q, then the more exact range, then our own order.
/// No header, or an empty one, takes JSON; `None` when nothing offered is acceptable.
pub fn negotiate<'a>(accept: &str, forms: &'a [Form]) -> Option<&'a Form> {
    if accept.trim().is_empty() {
        return forms.first();
    }
    let ranges: Vec<(String, f32)> = accept.split(',').filter_map(range).collect();
    let mut best: Option<(&Form, f32, u8)> = None;
    for form in forms {
        let Some((exact, q)) = quality(form, &ranges) else { continue };
        if q > 0.0 && best.is_none_or(|(_, bq, be)| (q, exact) > (bq, be)) {
            best = Some((form, q, exact));
        }
    }
    best.map(|(form, _, _)| form)
}

/// The form of `?format=WORD` (a word or a media type).
pub fn form_of(word: &str) -> Option<&'static Form> {
    FORMS.iter().find(|f| f.words.contains(&word) || f.media_type == word || f.aliases.contains(&word))
}

fn range(text: &str) -> Option<(String, f32)> {
    let mut parts = text.split(';').map(str::trim);
    let name = parts.next()?.to_ascii_lowercase();
    let q =
        parts.find_map(|p| p.strip_prefix("q=").or_else(|| p.strip_prefix("Q="))).map_or(Some(1.0), |q| q.parse().ok());
    Some((name, q?))
}

/// How exactly and how much the ranges want this form: the most exact range decides.
fn quality(form: &Form, ranges: &[(String, f32)]) -> Option<(u8, f32)> {
    let group = form.media_type.split('/').next().unwrap_or_default();
    let exactness = |name: &str| {
        if name == form.media_type || form.aliases.contains(&name) {
            Some(2)
        } else if name.strip_suffix("/*") == Some(group) {
            Some(1)
        } else {
            (name == "*/*").then_some(0)
        }
    };
    ranges.iter().filter_map(|(name, q)| Some((exactness(name)?, *q))).max_by_key(|(exact, _)| *exact)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_as_rfc_4648_has_it() {
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg==")] {
            assert_eq!(base64(plain.as_bytes()), coded);
            assert_eq!(base64_bytes(coded).as_deref(), Some(plain.as_bytes()));
        }
    }

    #[test]
    fn accept_is_read_as_rfc_9110_says() {
        let artefact = |accept| negotiate(accept, FORMS).map(|f| f.artefact);
        assert_eq!(artefact(""), Some("result.json"));
        assert_eq!(artefact("*/*"), Some("result.json"));
        assert_eq!(artefact("model/gltf-binary"), Some("surface.glb"));
        assert_eq!(artefact("model/*"), Some("surface.glb"));
        assert_eq!(artefact("application/json;q=0.5, application/xml+vtk"), Some("surface.vtp"));
        assert_eq!(artefact("application/json;q=0, */*"), Some("surface.glb"));
        assert_eq!(artefact("image/png"), None);
        // A browser's header: html is wanted most.
        assert_eq!(artefact("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"), Some("report.html"));
    }

    #[test]
    fn every_form_is_found_by_its_words() {
        for form in FORMS {
            for word in form.words.iter().chain(form.aliases) {
                assert_eq!(form_of(word), Some(form));
            }
            assert!(media_type(form.artefact).starts_with(form.media_type));
        }
    }
}
