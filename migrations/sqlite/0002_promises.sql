-- Why: what the queue promises beyond one worker on one machine: order with ageing, caps per tenant, retention, workers
-- that can be seen; resumable uploads; webhooks with an outbox; an audit whose lines are chained; limits per key.

-- rank = ms since 1970 at which a job of priority 0 would stand where this one stands: waiting time and priority on one
-- scale, so that ageing needs no rewriting (queue/claim.rs). The smallest rank runs first.
ALTER TABLE job ADD COLUMN rank INTEGER NOT NULL DEFAULT 0;
UPDATE job SET rank = created_at - priority * 60000;
DROP INDEX job_queued;
CREATE INDEX job_queued ON job (tenant, rank, id) WHERE state = 'queued';
CREATE INDEX job_running_tenant ON job (tenant) WHERE state = 'running';
CREATE INDEX job_expiry ON job (expires_at) WHERE expires_at IS NOT NULL;

ALTER TABLE api_key ADD COLUMN requests_per_minute INTEGER;
ALTER TABLE api_key ADD COLUMN max_bytes INTEGER;

CREATE TABLE worker (
    id         TEXT    PRIMARY KEY,
    host       TEXT    NOT NULL,
    version    TEXT    NOT NULL,
    slots      INTEGER NOT NULL,
    busy       INTEGER NOT NULL,
    memory_mb  INTEGER NOT NULL,
    started_at INTEGER NOT NULL,
    seen_at    INTEGER NOT NULL
) STRICT;

CREATE TABLE upload (
    id         TEXT    PRIMARY KEY,
    tenant     TEXT    NOT NULL REFERENCES tenant (id),
    bytes      INTEGER NOT NULL,
    name       TEXT    NOT NULL,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL
) STRICT;

CREATE TABLE webhook (
    id         TEXT    PRIMARY KEY,
    tenant     TEXT    NOT NULL REFERENCES tenant (id),
    url        TEXT    NOT NULL,
    secret     TEXT    NOT NULL,
    created_at INTEGER NOT NULL
) STRICT;

CREATE INDEX webhook_tenant ON webhook (tenant, id);

CREATE TABLE outbox (
    id         TEXT    PRIMARY KEY,
    webhook    TEXT    NOT NULL REFERENCES webhook (id) ON DELETE CASCADE,
    body       TEXT    NOT NULL,
    attempt    INTEGER NOT NULL DEFAULT 0,
    run_at     INTEGER NOT NULL,
    fault      TEXT
) STRICT;

CREATE INDEX outbox_due ON outbox (run_at, id);
CREATE INDEX outbox_webhook ON outbox (webhook);

CREATE TABLE audit (
    seq      INTEGER PRIMARY KEY,
    at       INTEGER NOT NULL,
    tenant   TEXT    NOT NULL,
    actor    TEXT    NOT NULL,
    action   TEXT    NOT NULL,
    object   TEXT    NOT NULL,
    outcome  TEXT    NOT NULL,
    trace_id TEXT    NOT NULL,
    digest   TEXT    NOT NULL
) STRICT;

CREATE INDEX audit_tenant ON audit (tenant, seq);

CREATE TABLE audit_head (
    id     INTEGER PRIMARY KEY CHECK (id = 1),
    seq    INTEGER NOT NULL,
    digest TEXT    NOT NULL
) STRICT;

INSERT INTO audit_head (id, seq, digest) VALUES (1, 0, '');

CREATE TRIGGER audit_is_append_only_update BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append only'); END;
CREATE TRIGGER audit_is_append_only_delete BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append only'); END;
