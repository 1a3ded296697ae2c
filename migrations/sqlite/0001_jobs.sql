-- Why: the one state of record. A job is accepted when its row is committed; everything a reader may see
-- (state, result, artefact digests) is in these tables, and a file that no row names does not exist for anybody.
-- Times are milliseconds since 1970 of the database's clock. `fence` grows with every claim; a writer whose fence is
-- older than the row's has lost its lease. `revision` grows with every visible change and is the job's ETag.

CREATE TABLE tenant (
    id           TEXT    PRIMARY KEY,
    name         TEXT    NOT NULL,
    max_running  INTEGER,
    retention_ms INTEGER,
    created_at   INTEGER NOT NULL
) STRICT;

INSERT INTO tenant (id, name, created_at)
VALUES ('default', 'default', CAST(unixepoch('subsec') * 1000 AS INTEGER));

CREATE TABLE api_key (
    id           TEXT    PRIMARY KEY,
    tenant       TEXT    NOT NULL REFERENCES tenant (id),
    role         TEXT    NOT NULL CHECK (role IN ('upload', 'read', 'admin', 'auditor')),
    label        TEXT    NOT NULL,
    digest       BLOB    NOT NULL UNIQUE,
    created_at   INTEGER NOT NULL,
    revoked_at   INTEGER
) STRICT;

CREATE TABLE job (
    id               TEXT    PRIMARY KEY,
    tenant           TEXT    NOT NULL REFERENCES tenant (id),
    kind             TEXT    NOT NULL,
    state            TEXT    NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    priority         INTEGER NOT NULL DEFAULT 0,
    plan             TEXT    NOT NULL,
    input_digest     TEXT    NOT NULL,
    input_files      INTEGER NOT NULL,
    input_bytes      INTEGER NOT NULL,
    attempt          INTEGER NOT NULL DEFAULT 0,
    max_attempts     INTEGER NOT NULL DEFAULT 3,
    run_at           INTEGER NOT NULL,
    memory_mb        INTEGER NOT NULL DEFAULT 0,
    lease_owner      TEXT,
    lease_until      INTEGER,
    fence            INTEGER NOT NULL DEFAULT 0,
    cancel_requested INTEGER NOT NULL DEFAULT 0,
    stage            TEXT,
    progress         REAL    NOT NULL DEFAULT 0,
    eta_s            REAL,
    result           TEXT,
    error            TEXT,
    trace_id         TEXT    NOT NULL,
    idempotency_key  TEXT,
    revision         INTEGER NOT NULL DEFAULT 1,
    created_at       INTEGER NOT NULL,
    started_at       INTEGER,
    finished_at      INTEGER,
    expires_at       INTEGER
) STRICT;

-- Claiming and rescuing read only these two small indexes, so that neither slows with the number of finished jobs.
CREATE INDEX job_queued ON job (priority DESC, id) WHERE state = 'queued';
CREATE INDEX job_running ON job (lease_until) WHERE state = 'running';
CREATE INDEX job_page ON job (tenant, id);
CREATE INDEX job_page_state ON job (tenant, state, id);
CREATE UNIQUE INDEX job_idempotency ON job (tenant, idempotency_key) WHERE idempotency_key IS NOT NULL;

CREATE TABLE artefact (
    job        TEXT    NOT NULL REFERENCES job (id) ON DELETE CASCADE,
    name       TEXT    NOT NULL,
    media_type TEXT    NOT NULL,
    bytes      INTEGER NOT NULL,
    digest     TEXT    NOT NULL,
    object_key TEXT    NOT NULL,
    PRIMARY KEY (job, name)
) STRICT, WITHOUT ROWID;

CREATE TABLE event (
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    job      TEXT    NOT NULL REFERENCES job (id) ON DELETE CASCADE,
    kind     TEXT    NOT NULL CHECK (kind IN ('progress', 'stage', 'state')),
    state    TEXT    NOT NULL,
    stage    TEXT,
    progress REAL    NOT NULL,
    eta_s    REAL,
    at       INTEGER NOT NULL
) STRICT;

CREATE INDEX event_job ON event (job, id);
