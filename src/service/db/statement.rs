//! Statements and rows of SQLite by rusqlite, with the values and faults that both databases share.

use super::{Row, Value};
use rusqlite::types::{ToSqlOutput, ValueRef};
use rusqlite::{Connection, ToSql};
use std::borrow::Cow;
use std::ffi::c_int;
use std::sync::Arc;

/// SQL of PostgreSQL in SQLite's words.
fn words(sql: &str) -> String {
    sql.replace("now_ms()", "CAST(unixepoch('subsec') * 1000 AS INTEGER)")
        .replace(" FOR UPDATE SKIP LOCKED", "")
        .replace(" FOR NO KEY UPDATE", "")
        .replace(" FOR UPDATE", "")
}

/// Every row of a statement.
pub(super) fn rows(connection: &Connection, sql: &str, args: &[Value]) -> sqlx::Result<Vec<Row>> {
    let mut statement = prepared(connection, sql, args)?;
    let names: Arc<[String]> = statement.column_names().into_iter().map(str::to_owned).collect();
    let mut out = Vec::new();
    let mut found = statement.raw_query();
    while let Some(row) = found.next().map_err(fault)? {
        let values = (0..names.len()).map(|i| row.get(i).map_err(fault)).collect::<sqlx::Result<_>>()?;
        out.push(Row::Sqlite(Cells { names: Arc::clone(&names), values }));
    }
    Ok(out)
}

/// Runs a statement; the number of rows it touched.
pub(super) fn run(connection: &Connection, sql: &str, args: &[Value]) -> sqlx::Result<u64> {
    let mut statement = prepared(connection, sql, args)?;
    let mut found = statement.raw_query();
    while found.next().map_err(fault)?.is_some() {}
    Ok(connection.changes())
}

/// A statement whose `$N` are bound to the N-th argument.
fn prepared<'c>(connection: &'c Connection, sql: &str, args: &[Value]) -> sqlx::Result<rusqlite::CachedStatement<'c>> {
    let mut statement = connection.prepare_cached(&words(sql)).map_err(fault)?;
    for i in 1..=statement.parameter_count() {
        let number = statement.parameter_name(i).and_then(|name| name.get(1..)?.parse::<usize>().ok()).unwrap_or(i);
        let missing = || sqlx::Error::Protocol(format!("the statement has no argument {number}"));
        let value = number.checked_sub(1).and_then(|k| args.get(k)).ok_or_else(missing)?;
        statement.raw_bind_parameter(i, value).map_err(fault)?;
    }
    Ok(statement)
}

impl ToSql for Value {
    fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
        let value = match self {
            Self::Text(Some(text)) => ValueRef::Text(text.as_bytes()),
            Self::Int(Some(number)) => ValueRef::Integer(*number),
            Self::Real(Some(number)) => ValueRef::Real(*number),
            Self::Bytes(Some(bytes)) => ValueRef::Blob(bytes),
            Self::Text(None) | Self::Int(None) | Self::Real(None) | Self::Bytes(None) => ValueRef::Null,
        };
        Ok(ToSqlOutput::Borrowed(value))
    }
}

/// A row of SQLite.
#[derive(Debug)]
pub struct Cells {
    names: Arc<[String]>,
    values: Vec<rusqlite::types::Value>,
}

impl Cells {
    pub(super) fn get<'r, T: FromCell<'r>>(&'r self, column: &str) -> sqlx::Result<T> {
        let at = self.names.iter().position(|name| name == column);
        let value =
            at.and_then(|i| self.values.get(i)).ok_or_else(|| sqlx::Error::ColumnNotFound(column.to_owned()))?;
        T::from_cell(value).ok_or_else(|| sqlx::Error::ColumnDecode {
            index: column.to_owned(),
            source: format!("a value of type {}", value.data_type()).into(),
        })
    }
}

/// What a cell can be read as.
pub trait FromCell<'r>: Sized {
    /// `None` where the cell is of another type.
    fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self>;
}

macro_rules! from_cell {
    ($($to:ty: $($variant:ident $value:ident => $make:expr),+;)*) => {
        $(impl<'r> FromCell<'r> for $to {
            fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self> {
                match cell {
                    $(rusqlite::types::Value::$variant($value) => Some($make),)+
                    _ => None,
                }
            }
        })*
    };
}

from_cell! {
    &'r str: Text v => v.as_str();
    String: Text v => v.clone();
    i64: Integer v => *v;
    f64: Real v => *v, Integer v => *v as f64;
    Vec<u8>: Blob v => v.clone();
}

impl<'r, T: FromCell<'r>> FromCell<'r> for Option<T> {
    fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self> {
        match cell {
            rusqlite::types::Value::Null => Some(None),
            other => T::from_cell(other).map(Some),
        }
    }
}

/// A fault of SQLite as sqlx tells those of a database.
#[derive(Debug)]
struct Fault {
    code: c_int,
    message: String,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "(code: {}) {}", self.code, self.message)
    }
}

impl std::error::Error for Fault {}

impl sqlx::error::DatabaseError for Fault {
    fn message(&self) -> &str {
        &self.message
    }

    fn code(&self) -> Option<Cow<'_, str>> {
        Some(self.code.to_string().into())
    }

    fn kind(&self) -> sqlx::error::ErrorKind {
        match self.code {
            rusqlite::ffi::SQLITE_CONSTRAINT_UNIQUE | rusqlite::ffi::SQLITE_CONSTRAINT_PRIMARYKEY => {
                sqlx::error::ErrorKind::UniqueViolation
            }
            _ => sqlx::error::ErrorKind::Other,
        }
    }

    fn as_error(&self) -> &(dyn std::error::Error + Send + Sync + 'static) {
        self
    }

    fn as_error_mut(&mut self) -> &mut (dyn std::error::Error + Send + Sync + 'static) {
        self
    }

    fn into_error(self: Box<Self>) -> Box<dyn std::error::Error + Send + Sync + 'static> {
        self
    }
}

pub(super) fn fault(error: rusqlite::Error) -> sqlx::Error {
    match error {
        rusqlite::Error::SqliteFailure(failure, message) => {
            let message = message.unwrap_or_else(|| failure.to_string());
            sqlx::Error::Database(Box::new(Fault { code: failure.extended_code, message }))
        }
        other => sqlx::Error::Protocol(other.to_string()),
    }
}

pub(super) fn is_interruption(error: &sqlx::Error) -> bool {
    let code = error.as_database_error().and_then(|fault| fault.code().map(Cow::into_owned));
    code.is_some_and(|code| code == rusqlite::ffi::SQLITE_INTERRUPT.to_string())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::db::args;

    #[test]
    fn arguments_go_by_their_numbers() {
        let connection = Connection::open_in_memory().unwrap();
        let sql = "SELECT $2 AS b, $1 AS a, $2 AS again, $3 AS none";
        let values = args!["one", 2_i64, None::<i64>];
        let found = rows(&connection, sql, &values).unwrap();
        let row = found.first().unwrap();
        assert_eq!(row.get::<String>("a").unwrap(), "one");
        assert_eq!([row.get::<i64>("b").unwrap(), row.get("again").unwrap()], [2, 2]);
        assert_eq!(row.get::<Option<i64>>("none").unwrap(), None);
        assert!(matches!(row.get::<i64>("a"), Err(sqlx::Error::ColumnDecode { .. })));
        assert!(matches!(row.get::<i64>("c"), Err(sqlx::Error::ColumnNotFound(_))));
        assert!(rows(&connection, sql, &values[..1]).is_err());
    }
}
