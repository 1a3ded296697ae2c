-- Why: the one state of record. A job is accepted when its row is committed; everything a reader may see
-- (state, result, artefact digests) is in these tables, and a file that no row names does not exist for anybody.
-- Ids compare by byte. Times are milliseconds since 1970 of the database's clock. `fence` grows with every claim; a writer whose fence is
-- older than the row's has lost its lease. `revision` grows with every visible change and is the job's ETag.

-- The database's clock in ms since 1970, the only clock that is ever compared.
CREATE FUNCTION now_ms() RETURNS BIGINT LANGUAGE sql STABLE AS $$
    SELECT (EXTRACT(EPOCH FROM clock_timestamp()) * 1000)::BIGINT
$$;

CREATE TABLE tenant (
    id           TEXT COLLATE "C"    PRIMARY KEY,
    name         TEXT    NOT NULL,
    max_running  BIGINT,
    retention_ms BIGINT,
    created_at   BIGINT NOT NULL
);

INSERT INTO tenant (id, name, created_at)
VALUES ('default', 'default', now_ms());

CREATE TABLE api_key (
    id           TEXT COLLATE "C"    PRIMARY KEY,
    tenant       TEXT COLLATE "C"    NOT NULL REFERENCES tenant (id),
    role         TEXT    NOT NULL CHECK (role IN ('upload', 'read', 'admin', 'auditor')),
    label        TEXT    NOT NULL,
    digest       BYTEA    NOT NULL UNIQUE,
    created_at   BIGINT NOT NULL,
    revoked_at   BIGINT
);

CREATE TABLE job (
    id               TEXT COLLATE "C"    PRIMARY KEY,
    tenant           TEXT COLLATE "C"    NOT NULL REFERENCES tenant (id),
    kind             TEXT    NOT NULL,
    state            TEXT    NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    priority         BIGINT NOT NULL DEFAULT 0,
    plan             TEXT    NOT NULL,
    input_digest     TEXT    NOT NULL,
    input_files      BIGINT NOT NULL,
    input_bytes      BIGINT NOT NULL,
    attempt          BIGINT NOT NULL DEFAULT 0,
    max_attempts     BIGINT NOT NULL DEFAULT 3,
    run_at           BIGINT NOT NULL,
    memory_mb        BIGINT NOT NULL DEFAULT 0,
    lease_owner      TEXT,
    lease_until      BIGINT,
    fence            BIGINT NOT NULL DEFAULT 0,
    cancel_requested BIGINT NOT NULL DEFAULT 0,
    stage            TEXT,
    progress         DOUBLE PRECISION    NOT NULL DEFAULT 0,
    eta_s            DOUBLE PRECISION,
    result           TEXT,
    error            TEXT,
    trace_id         TEXT    NOT NULL,
    idempotency_key  TEXT,
    revision         BIGINT NOT NULL DEFAULT 1,
    created_at       BIGINT NOT NULL,
    started_at       BIGINT,
    finished_at      BIGINT,
    expires_at       BIGINT
);

-- Claiming and rescuing read only these two small indexes, so that neither slows with the number of finished jobs.
CREATE INDEX job_queued ON job (priority DESC, id) WHERE state = 'queued';
CREATE INDEX job_running ON job (lease_until) WHERE state = 'running';
CREATE INDEX job_page ON job (tenant, id);
CREATE INDEX job_page_state ON job (tenant, state, id);
CREATE UNIQUE INDEX job_idempotency ON job (tenant, idempotency_key) WHERE idempotency_key IS NOT NULL;

CREATE TABLE artefact (
    job        TEXT COLLATE "C"    NOT NULL REFERENCES job (id) ON DELETE CASCADE,
    name       TEXT    NOT NULL,
    media_type TEXT    NOT NULL,
    bytes      BIGINT NOT NULL,
    digest     TEXT    NOT NULL,
    object_key TEXT    NOT NULL,
    PRIMARY KEY (job, name)
);

CREATE TABLE event (
    id       BIGINT  GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    job      TEXT COLLATE "C"    NOT NULL REFERENCES job (id) ON DELETE CASCADE,
    kind     TEXT    NOT NULL CHECK (kind IN ('progress', 'stage', 'state')),
    state    TEXT    NOT NULL,
    stage    TEXT,
    progress DOUBLE PRECISION    NOT NULL,
    eta_s    DOUBLE PRECISION,
    at       BIGINT NOT NULL
);

CREATE INDEX event_job ON event (job, id);
