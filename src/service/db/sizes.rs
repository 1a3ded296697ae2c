//! Statements over several rows, written out for a few numbers of rows.
//!
//! Neither database takes a list of rows as one argument in the other's words (`unnest`, `json_each`), and a text for every
//! number of rows would be as many prepared statements on each connection. So there is one for each power of two up to
//! [`MOST`], and each row says in a last column of its own whether it is one (1) or only fills up the statement (0).

use super::{MOST, Value};
use std::sync::OnceLock;

/// Powers of two up to [`MOST`].
const TEXTS: usize = MOST.ilog2() as usize + 1;

/// One statement for 1, 2, 4 .. [`MOST`] rows.
#[derive(Debug)]
pub(crate) struct Sizes {
    text: fn(usize) -> String,
    texts: OnceLock<[String; TEXTS]>,
}

impl Sizes {
    /// `text` is the statement for so many rows.
    pub(crate) const fn new(text: fn(usize) -> String) -> Self {
        Self { text, texts: OnceLock::new() }
    }

    /// The statements, mostly one, that take all of `rows`, with their arguments.
    pub(crate) fn over<const COLUMNS: usize>(
        &'static self,
        rows: &[[Value; COLUMNS]],
    ) -> Vec<(&'static str, Vec<Value>)> {
        let texts = self.texts.get_or_init(|| std::array::from_fn(|k| (self.text)(1 << k)));
        let mut statements = Vec::new();
        for some in rows.chunks(MOST) {
            let size = some.len().next_power_of_two();
            let Some((text, last)) = texts.get(size.ilog2() as usize).zip(some.last()) else { continue };
            let mut values = Vec::with_capacity(size * (COLUMNS + 1));
            for row in some {
                values.extend_from_slice(row);
                values.push(Value::from(true));
            }
            for _ in some.len()..size {
                values.extend_from_slice(last);
                values.push(Value::from(false));
            }
            statements.push((text.as_str(), values));
        }
        statements
    }
}

/// `($1, $2, $3), ($4, $5, $6)`: so many rows of so many arguments and the one that says whether it is a row.
pub(crate) fn placeholders(rows: usize, columns: usize) -> String {
    let row = |k: usize| {
        let numbers: Vec<String> = (1..=columns + 1).map(|c| format!("${}", k * (columns + 1) + c)).collect();
        format!("({})", numbers.join(", "))
    };
    (0..rows).map(row).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_filled_up_to_powers_of_two() {
        static TEXT: Sizes = Sizes::new(|rows| placeholders(rows, 1));
        let rows: Vec<[Value; 1]> = (0_i64..).take(MOST + 3).map(|n| [Value::from(n)]).collect();
        let statements = TEXT.over(&rows);
        assert_eq!(statements.iter().map(|(_, values)| values.len()).collect::<Vec<_>>(), [2 * MOST, 8]);
        let (text, values) = statements.last().cloned().unwrap_or_default();
        assert_eq!(text, "($1, $2), ($3, $4), ($5, $6), ($7, $8)");
        let flags: Vec<_> = values.iter().skip(1).step_by(2).cloned().collect();
        assert_eq!(flags, [true, true, true, false].map(Value::from));
        assert_eq!(values.get(4), values.get(6), "the last row fills up");
        assert!(TEXT.over::<1>(&[]).is_empty());
    }
}
