//! Values, rows and transactions that mean the same on both databases.

use super::statement;
use sqlx::postgres::{PgConnection, PgRow};
use sqlx::{Decode, Postgres, Row as _, Type};

/// A bound value. Every integer is 64 bits wide, truth values are 0 and 1; a missing value keeps its type.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// TEXT.
    Text(Option<String>),
    /// INTEGER or BIGINT.
    Int(Option<i64>),
    /// REAL or DOUBLE PRECISION.
    Real(Option<f64>),
    /// BLOB or BYTEA.
    Bytes(Option<Vec<u8>>),
}

macro_rules! from {
    ($($from:ty => $variant:ident $value:ident $make:expr;)*) => {
        $(impl From<$from> for Value {
            fn from($value: $from) -> Self {
                Self::$variant($make)
            }
        })*
    };
}

from! {
    &str => Text v Some(v.to_owned());
    String => Text v Some(v);
    &String => Text v Some(v.clone());
    Option<String> => Text v v;
    &Option<String> => Text v v.clone();
    Option<&str> => Text v v.map(str::to_owned);
    uuid::Uuid => Text v Some(v.to_string());
    i64 => Int v Some(v);
    Option<i64> => Int v v;
    bool => Int v Some(i64::from(v));
    f64 => Real v Some(v);
    Option<f64> => Real v v;
    Vec<u8> => Bytes v Some(v);
    &[u8] => Bytes v Some(v.to_vec());
}

/// The arguments of a statement.
macro_rules! args {
    ($($value:expr),* $(,)?) => { vec![$($crate::db::Value::from($value)),*] };
}
pub(crate) use args;

/// A row of either database.
#[derive(Debug)]
pub enum Row {
    /// Of SQLite.
    Sqlite(statement::Cells),
    /// Of PostgreSQL.
    Postgres(PgRow),
}

impl Row {
    /// A column by name: `String`, `i64`, `f64`, `Vec<u8>`, or an `Option` of these.
    ///
    /// # Errors
    /// No such column, or of another type.
    pub fn get<'r, T>(&'r self, column: &str) -> sqlx::Result<T>
    where
        T: statement::FromCell<'r> + Decode<'r, Postgres> + Type<Postgres>,
    {
        match self {
            Self::Sqlite(row) => row.get(column),
            Self::Postgres(row) => row.try_get(column),
        }
    }

    /// A column of 0 and 1.
    ///
    /// # Errors
    /// No such column, or of another type.
    pub fn flag(&self, column: &str) -> sqlx::Result<bool> {
        Ok(self.get::<i64>(column)? != 0)
    }
}

/// A transaction of either database.
#[derive(Debug)]
pub enum Tx<'a> {
    /// Of SQLite.
    Sqlite(&'a mut rusqlite::Connection),
    /// Of PostgreSQL.
    Postgres(&'a mut PgConnection),
}

macro_rules! bound {
    ($sql:expr, $args:expr) => {{
        let mut query = sqlx::query($sql);
        for value in $args {
            query = match value {
                Value::Text(v) => query.bind(v),
                Value::Int(v) => query.bind(v),
                Value::Real(v) => query.bind(v),
                Value::Bytes(v) => query.bind(v),
            };
        }
        query
    }};
}
pub(super) use bound;

impl Tx<'_> {
    /// Every row of a statement.
    ///
    /// # Errors
    /// The database's.
    pub async fn rows(&mut self, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        match self {
            Self::Sqlite(connection) => statement::rows(connection, sql, &args),
            Self::Postgres(connection) => {
                let rows = bound!(sql, args).fetch_all(&mut **connection).await?;
                Ok(rows.into_iter().map(Row::Postgres).collect())
            }
        }
    }

    /// The first row of a statement.
    ///
    /// # Errors
    /// The database's.
    pub async fn row(&mut self, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Option<Row>> {
        Ok(self.rows(sql, args).await?.into_iter().next())
    }

    /// Runs a statement; the number of rows it touched.
    ///
    /// # Errors
    /// The database's.
    pub async fn run(&mut self, sql: &'static str, args: Vec<Value>) -> sqlx::Result<u64> {
        match self {
            Self::Sqlite(connection) => statement::run(connection, sql, &args),
            Self::Postgres(connection) => Ok(bound!(sql, args).execute(&mut **connection).await?.rows_affected()),
        }
    }
}
