//! A small JSON tree whose printer refuses numbers that are not finite.
//!
//! serde_json turns NaN into null without a word; in result.json null means "could not be had, see the warnings", so a
//! NaN that slipped through would be told as a considered answer. Here every number is checked when it is printed, and
//! the error names its JSON path. Numbers are rounded to [`DIGITS`] significant digits: finer than any measurement of a
//! scan by five orders, and short enough to read. Arrays of plain values stay on one line.

use super::Error;
use space::{P3, Place, V3, Warning};

/// Significant digits of a printed number: 1e-9 relative, 0.1 nm on a position 100 mm from the origin.
pub const DIGITS: usize = 9;

/// A JSON value with ordered members.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Json {
    Null,
    Bool(bool),
    Int(i64),
    Number(f64),
    Text(String),
    List(Vec<Json>),
    Object(Vec<(&'static str, Json)>),
}

impl From<bool> for Json {
    fn from(x: bool) -> Self {
        Self::Bool(x)
    }
}
impl From<usize> for Json {
    fn from(x: usize) -> Self {
        Self::Int(i64::try_from(x).unwrap_or(i64::MAX))
    }
}
impl From<i64> for Json {
    fn from(x: i64) -> Self {
        Self::Int(x)
    }
}
impl From<u32> for Json {
    fn from(x: u32) -> Self {
        Self::Int(i64::from(x))
    }
}
impl From<f64> for Json {
    fn from(x: f64) -> Self {
        Self::Number(x)
    }
}
impl From<&str> for Json {
    fn from(x: &str) -> Self {
        Self::Text(x.to_owned())
    }
}
impl From<&String> for Json {
    fn from(x: &String) -> Self {
        Self::Text(x.clone())
    }
}
impl From<P3> for Json {
    fn from(x: P3) -> Self {
        Self::list(x.to_array())
    }
}
impl From<V3> for Json {
    fn from(x: V3) -> Self {
        Self::list(x.to_array())
    }
}
impl<const N: usize> From<[f64; N]> for Json {
    fn from(x: [f64; N]) -> Self {
        Self::list(x)
    }
}
impl<T: Into<Json>> From<Option<T>> for Json {
    fn from(x: Option<T>) -> Self {
        x.map_or(Self::Null, Into::into)
    }
}

impl Json {
    /// A list of anything that is a value.
    pub(crate) fn list<T: Into<Self>>(items: impl IntoIterator<Item = T>) -> Self {
        Self::List(items.into_iter().map(Into::into).collect())
    }
    /// The text of the tree, two spaces per level, a newline at the end.
    ///
    /// # Errors
    /// [`Error::NotFinite`] with the path of the first number that is not finite.
    pub(crate) fn print(&self, artefact: &'static str) -> Result<Vec<u8>, Error> {
        let mut out = String::new();
        let mut path = String::from("$");
        self.write(&mut out, &mut path, 0).map_err(|(path, x)| Error::NotFinite {
            artefact,
            path,
            value: x.to_string(),
        })?;
        out.push('\n');
        Ok(out.into_bytes())
    }
    fn is_plain(&self) -> bool {
        match self {
            Self::Object(_) => false,
            Self::List(items) => items.iter().all(|i| !matches!(i, Self::List(_)) && i.is_plain()),
            _ => true,
        }
    }
    /// Lists of numbers, and lists of short lists of numbers (positions), go on one line.
    fn is_line(&self) -> bool {
        match self {
            Self::List(items) => items.iter().all(Self::is_plain),
            _ => self.is_plain(),
        }
    }
    fn write(&self, out: &mut String, path: &mut String, depth: usize) -> Result<(), (String, f64)> {
        match self {
            Self::Null => out.push_str("null"),
            Self::Bool(x) => out.push_str(if *x { "true" } else { "false" }),
            Self::Int(x) => out.push_str(&x.to_string()),
            Self::Number(x) => out.push_str(&number(*x).ok_or_else(|| (path.clone(), *x))?),
            Self::Text(x) => out.push_str(&serde_json::Value::from(x.as_str()).to_string()),
            Self::List(items) => self.write_list(items, out, path, depth)?,
            Self::Object(members) => {
                out.push('{');
                for (i, (name, value)) in members.iter().enumerate() {
                    out.push_str(if i == 0 { "" } else { "," });
                    new_line(out, depth + 1);
                    out.push_str(&format!("\"{name}\": "));
                    let length = path.len();
                    path.push('.');
                    path.push_str(name);
                    value.write(out, path, depth + 1)?;
                    path.truncate(length);
                }
                if !members.is_empty() {
                    new_line(out, depth);
                }
                out.push('}');
            }
        }
        Ok(())
    }
    fn write_list(
        &self,
        items: &[Self],
        out: &mut String,
        path: &mut String,
        depth: usize,
    ) -> Result<(), (String, f64)> {
        let line = self.is_line();
        out.push('[');
        for (i, value) in items.iter().enumerate() {
            match (line, i) {
                (true, 0) => {}
                (true, _) => out.push_str(", "),
                (false, _) => {
                    out.push_str(if i == 0 { "" } else { "," });
                    new_line(out, depth + 1);
                }
            }
            let length = path.len();
            path.push_str(&format!("[{i}]"));
            value.write(out, path, depth + 1)?;
            path.truncate(length);
        }
        if !line {
            new_line(out, depth);
        }
        out.push(']');
        Ok(())
    }
}

fn new_line(out: &mut String, depth: usize) {
    out.push('\n');
    out.push_str(&"  ".repeat(depth));
}

/// The shortest text of a number rounded to [`DIGITS`] significant digits; `None` when it is not finite. Zero has no
/// sign.
pub(crate) fn number(x: f64) -> Option<String> {
    if !x.is_finite() {
        return None;
    }
    let rounded: f64 = format!("{:.*e}", DIGITS - 1, x).parse().ok()?;
    // -0.0 + 0.0 is +0.0
    Some(serde_json::Value::from(rounded + 0.0).to_string())
}

/// A place as an object with only the members that are known; null when nothing is.
pub(crate) fn place(p: &Place) -> Json {
    if p.is_none() {
        return Json::Null;
    }
    let members: [(&'static str, Json); 6] = [
        ("file", p.file.as_ref().into()),
        ("field", p.field.as_ref().into()),
        ("slice", p.slice.into()),
        ("contour", p.contour.into()),
        ("element", p.element.into()),
        ("position", p.position.into()),
    ];
    Json::Object(members.into_iter().filter(|(_, v)| *v != Json::Null).collect())
}

/// A warning as in result.json.
pub(crate) fn warning(w: &Warning) -> Json {
    Json::Object(vec![("code", w.code.into()), ("message", (&w.message).into()), ("where", place(&w.place))])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn numbers_are_rounded_to_nine_digits_and_zero_has_no_sign() {
        assert_eq!(number(0.1 + 0.2).unwrap(), "0.3");
        assert_eq!(number(-0.0).unwrap(), "0.0");
        assert_eq!(number(123_456_789.123).unwrap(), "123456789.0");
        assert_eq!(number(3.1e-12).unwrap(), "3.1e-12");
        assert!(number(f64::NAN).is_none());
    }

    #[test]
    fn a_number_that_is_not_finite_is_refused_with_its_path() {
        let tree =
            Json::Object(vec![("a", Json::List(vec![Json::Null, Json::Object(vec![("b", f64::INFINITY.into())])]))]);
        let Err(Error::NotFinite { artefact, path, value }) = tree.print("x.json") else { panic!("accepted") };
        assert_eq!((artefact, path.as_str(), value.as_str()), ("x.json", "$.a[1].b", "inf"));
    }

    #[test]
    fn the_text_is_json_that_others_read() {
        let tree = Json::Object(vec![
            ("text", "quote \" and \n".into()),
            ("list", Json::list([1.5, 2.0])),
            ("points", Json::list([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])),
            ("objects", Json::List(vec![Json::Object(vec![("k", true.into())])])),
            ("none", Json::List(vec![])),
        ]);
        let bytes = tree.print("x.json").unwrap();
        let value: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!(value["text"], "quote \" and \n");
        assert_eq!(value["points"][1][2], 6.0);
        assert_eq!(value["objects"][0]["k"], true);
        assert!(String::from_utf8(bytes).unwrap().contains("\"points\": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]"));
    }
}
