//! The audit: who did what to which job, append only, each line bound to all before it.
//!
//! digest(n) = SHA-256 over digest(n-1) and the fields of line n, each with its length, so that no line can be changed,
//! moved or taken out without every later digest being wrong; `audit_head` keeps the last one, so that lines cut off at
//! the end are missed too. A line is written in the transaction of what it tells. It holds ids, never a patient's data.
//! Limit: whoever can write the whole database can also forge a whole new chain; export it regularly to another place.

use crate::db::{Db, Row, Scope, Tx, args};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

/// Lines read at once.
const BATCH: i64 = 1000;

/// A line to write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Whose data.
    pub tenant: String,
    /// Who: the id of a key, `operator` on the machine itself, `service` for what it does by itself.
    pub actor: String,
    /// What, such as `job.create`.
    pub action: String,
    /// To what: an id.
    pub object: String,
    /// `ok` or the code of a refusal.
    pub outcome: String,
    /// Trace of the request.
    pub trace_id: String,
}

impl Entry {
    /// What an operator did on the machine itself.
    pub fn of_operator(tenant: &str, action: &str, object: &str) -> Self {
        Self {
            tenant: tenant.to_owned(),
            actor: "operator".to_owned(),
            action: action.to_owned(),
            object: object.to_owned(),
            outcome: "ok".to_owned(),
            trace_id: String::new(),
        }
    }
}

/// What a check of the chain found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Every line is bound to the one before it.
    Whole {
        /// Number of lines.
        lines: i64,
    },
    /// A line was changed, moved or taken out.
    Broken {
        /// The first line that does not fit.
        line: i64,
    },
}

fn digest(previous: &str, seq: i64, at: i64, entry: &Entry) -> String {
    let mut hasher = Sha256::new();
    let (seq, at) = (seq.to_string(), at.to_string());
    let fields = [
        previous,
        &seq,
        &at,
        &entry.tenant,
        &entry.actor,
        &entry.action,
        &entry.object,
        &entry.outcome,
        &entry.trace_id,
    ];
    for field in fields {
        hasher.update((field.len() as u64).to_be_bytes());
        hasher.update(field.as_bytes());
    }
    crate::store::hex(&hasher.finalize())
}

/// Writes a line in the transaction of what it tells.
///
/// # Errors
/// The database's.
pub async fn append(tx: &mut Tx<'_>, entry: &Entry) -> sqlx::Result<()> {
    let head = "SELECT seq, digest, now_ms() AS at FROM audit_head WHERE id = 1 FOR UPDATE";
    let head = tx.row(head, Vec::new()).await?.ok_or(sqlx::Error::RowNotFound)?;
    let (seq, at) = (head.get::<i64>("seq")? + 1, head.get::<i64>("at")?);
    let digest = digest(&head.get::<String>("digest")?, seq, at, entry);
    let line = "INSERT INTO audit (seq, at, tenant, actor, action, object, outcome, trace_id, digest) \
                VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
    let values = args![
        seq,
        at,
        &entry.tenant,
        &entry.actor,
        &entry.action,
        &entry.object,
        &entry.outcome,
        &entry.trace_id,
        &digest
    ];
    tx.run(line, values).await?;
    tx.run("UPDATE audit_head SET seq = $1, digest = $2 WHERE id = 1", args![seq, &digest]).await?;
    Ok(())
}

/// Writes a line by itself.
///
/// # Errors
/// The database's.
pub async fn write(db: &Db, entry: Entry) -> sqlx::Result<()> {
    db.write(Scope::System, move |tx| Box::pin(async move { append(tx, &entry).await })).await
}

struct Line {
    seq: i64,
    at: i64,
    entry: Entry,
    digest: String,
}

fn read(row: &Row) -> sqlx::Result<Line> {
    Ok(Line {
        seq: row.get("seq")?,
        at: row.get("at")?,
        digest: row.get("digest")?,
        entry: Entry {
            tenant: row.get("tenant")?,
            actor: row.get("actor")?,
            action: row.get("action")?,
            object: row.get("object")?,
            outcome: row.get("outcome")?,
            trace_id: row.get("trace_id")?,
        },
    })
}

async fn lines(db: &Db, after: i64) -> sqlx::Result<Vec<Line>> {
    let sql = "SELECT * FROM audit WHERE seq > $1 ORDER BY seq LIMIT $2";
    db.rows(Scope::System, sql, args![after, BATCH]).await?.iter().map(read).collect()
}

/// Checks the whole chain.
///
/// # Errors
/// The database's.
pub async fn verify(db: &Db) -> sqlx::Result<Verdict> {
    let (mut seq, mut previous) = (0, String::new());
    let head = db.row(Scope::System, "SELECT seq, digest FROM audit_head WHERE id = 1", Vec::new()).await?;
    let head = head.ok_or(sqlx::Error::RowNotFound)?;
    let (last, end) = (head.get::<i64>("seq")?, head.get::<String>("digest")?);
    loop {
        let some = lines(db, seq).await?;
        if some.is_empty() {
            break;
        }
        for line in some {
            seq += 1;
            if line.seq != seq || line.digest != digest(&previous, seq, line.at, &line.entry) {
                return Ok(Verdict::Broken { line: seq });
            }
            if seq == last && line.digest != end {
                return Ok(Verdict::Broken { line: seq });
            }
            previous = line.digest;
        }
    }
    // Lines written since the head was read are no fault; lines missing before it are.
    Ok(if seq < last { Verdict::Broken { line: seq + 1 } } else { Verdict::Whole { lines: seq } })
}

/// The audit (of one tenant, or the whole) after line `after` as FHIR R4 AuditEvent resources, at most a thousand; and
/// the number of the last line.
///
/// # Errors
/// The database's.
pub async fn fhir(db: &Db, tenant: Option<&str>, after: i64) -> sqlx::Result<(Vec<Value>, i64)> {
    let some = match tenant {
        None => lines(db, after).await?,
        Some(tenant) => {
            let sql = "SELECT * FROM audit WHERE tenant = $1 AND seq > $2 ORDER BY seq LIMIT $3";
            let rows = db.rows(Scope::Tenant(tenant), sql, args![tenant, after, BATCH]).await?;
            rows.iter().map(read).collect::<sqlx::Result<_>>()?
        }
    };
    let last = some.last().map_or(after, |line| line.seq);
    Ok((some.iter().map(event).collect(), last))
}

fn event(line: &Line) -> Value {
    let entry = &line.entry;
    // AuditEvent.action: create, read, update, delete, execute.
    let action = match entry.action.rsplit('.').next().unwrap_or("") {
        "create" => "C",
        "read" | "list" => "R",
        "erase" | "revoke" => "D",
        _ => "E",
    };
    json!({
        "resourceType": "AuditEvent",
        "id": format!("vasculum-{}", line.seq),
        "type": {"system": "http://terminology.hl7.org/CodeSystem/audit-event-type", "code": "rest", "display": "RESTful Operation"},
        "subtype": [{"system": "urn:vasculum:action", "code": entry.action}],
        "action": action,
        "recorded": crate::media::rfc3339(line.at),
        // FHIR: 0 success, 4 minor failure.
        "outcome": if entry.outcome == "ok" { "0" } else { "4" },
        "outcomeDesc": entry.outcome,
        "agent": [{"who": {"identifier": {"system": "urn:vasculum:key", "value": entry.actor}}, "requestor": true}],
        "source": {"observer": {"display": "vasculum"}, "site": entry.tenant},
        "entity": [{"what": {"identifier": {"system": "urn:vasculum:object", "value": entry.object}},
                    "detail": [{"type": "digest", "valueString": line.digest}, {"type": "trace", "valueString": entry.trace_id}]}]
    })
}
