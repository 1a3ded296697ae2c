-- Why: what the queue promises beyond one worker on one machine: order with ageing, caps per tenant, retention, workers
-- that can be seen; resumable uploads; webhooks with an outbox; an audit whose lines are chained; limits per key.

-- rank = ms since 1970 at which a job of priority 0 would stand where this one stands: waiting time and priority on one
-- scale, so that ageing needs no rewriting (queue/claim.rs). The smallest rank runs first.
ALTER TABLE job ADD COLUMN rank BIGINT NOT NULL DEFAULT 0;
UPDATE job SET rank = created_at - priority * 60000;
DROP INDEX job_queued;
CREATE INDEX job_queued ON job (tenant, rank, id) WHERE state = 'queued';
CREATE INDEX job_running_tenant ON job (tenant) WHERE state = 'running';
CREATE INDEX job_expiry ON job (expires_at) WHERE expires_at IS NOT NULL;

ALTER TABLE api_key ADD COLUMN requests_per_minute BIGINT;
ALTER TABLE api_key ADD COLUMN max_bytes BIGINT;

CREATE TABLE worker (
    id         TEXT COLLATE "C"    PRIMARY KEY,
    host       TEXT    NOT NULL,
    version    TEXT    NOT NULL,
    slots      BIGINT NOT NULL,
    busy       BIGINT NOT NULL,
    memory_mb  BIGINT NOT NULL,
    started_at BIGINT NOT NULL,
    seen_at    BIGINT NOT NULL
);

CREATE TABLE upload (
    id         TEXT COLLATE "C"    PRIMARY KEY,
    tenant     TEXT COLLATE "C"    NOT NULL REFERENCES tenant (id),
    bytes      BIGINT NOT NULL,
    name       TEXT    NOT NULL,
    created_at BIGINT NOT NULL,
    expires_at BIGINT NOT NULL
);

CREATE TABLE webhook (
    id         TEXT COLLATE "C"    PRIMARY KEY,
    tenant     TEXT COLLATE "C"    NOT NULL REFERENCES tenant (id),
    url        TEXT    NOT NULL,
    secret     TEXT    NOT NULL,
    created_at BIGINT NOT NULL
);

CREATE INDEX webhook_tenant ON webhook (tenant, id);

CREATE TABLE outbox (
    id         TEXT COLLATE "C"    PRIMARY KEY,
    webhook    TEXT COLLATE "C"    NOT NULL REFERENCES webhook (id) ON DELETE CASCADE,
    body       TEXT    NOT NULL,
    attempt    BIGINT NOT NULL DEFAULT 0,
    run_at     BIGINT NOT NULL,
    fault      TEXT
);

CREATE INDEX outbox_due ON outbox (run_at, id);
CREATE INDEX outbox_webhook ON outbox (webhook);

CREATE TABLE audit (
    seq      BIGINT PRIMARY KEY,
    at       BIGINT NOT NULL,
    tenant   TEXT    NOT NULL,
    actor    TEXT    NOT NULL,
    action   TEXT    NOT NULL,
    object   TEXT    NOT NULL,
    outcome  TEXT    NOT NULL,
    trace_id TEXT    NOT NULL,
    digest   TEXT    NOT NULL
);

CREATE INDEX audit_tenant ON audit (tenant, seq);

CREATE TABLE audit_head (
    id     BIGINT PRIMARY KEY CHECK (id = 1),
    seq    BIGINT NOT NULL,
    digest TEXT    NOT NULL
);

INSERT INTO audit_head (id, seq, digest) VALUES (1, 0, '');

CREATE FUNCTION audit_is_append_only() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION 'the audit is append only';
END
$$;
CREATE TRIGGER audit_is_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON audit
    FOR EACH STATEMENT EXECUTE FUNCTION audit_is_append_only();

-- Row level security: a statement made for a tenant sees that tenant's rows only, whatever it asks for. The service's own
-- statements run as '*'. A superuser is not bound by it: give the service a role of its own (docs/deploy.md).
CREATE FUNCTION tenant_may_see(owner TEXT) RETURNS BOOLEAN LANGUAGE sql STABLE AS $$
    SELECT current_setting('vasculum.tenant', true) IN ('*', owner)
$$;

ALTER TABLE job ENABLE ROW LEVEL SECURITY;
ALTER TABLE job FORCE ROW LEVEL SECURITY;
CREATE POLICY job_tenant ON job USING (tenant_may_see(tenant));

ALTER TABLE webhook ENABLE ROW LEVEL SECURITY;
ALTER TABLE webhook FORCE ROW LEVEL SECURITY;
CREATE POLICY webhook_tenant ON webhook USING (tenant_may_see(tenant));

ALTER TABLE upload ENABLE ROW LEVEL SECURITY;
ALTER TABLE upload FORCE ROW LEVEL SECURITY;
CREATE POLICY upload_tenant ON upload USING (tenant_may_see(tenant));

ALTER TABLE audit ENABLE ROW LEVEL SECURITY;
ALTER TABLE audit FORCE ROW LEVEL SECURITY;
CREATE POLICY audit_tenant ON audit USING (tenant_may_see(tenant));

ALTER TABLE artefact ENABLE ROW LEVEL SECURITY;
ALTER TABLE artefact FORCE ROW LEVEL SECURITY;
CREATE POLICY artefact_tenant ON artefact USING (
    current_setting('vasculum.tenant', true) = '*' OR EXISTS (SELECT 1 FROM job WHERE job.id = artefact.job)
);

ALTER TABLE event ENABLE ROW LEVEL SECURITY;
ALTER TABLE event FORCE ROW LEVEL SECURITY;
CREATE POLICY event_tenant ON event USING (
    current_setting('vasculum.tenant', true) = '*' OR EXISTS (SELECT 1 FROM job WHERE job.id = event.job)
);

ALTER TABLE outbox ENABLE ROW LEVEL SECURITY;
ALTER TABLE outbox FORCE ROW LEVEL SECURITY;
CREATE POLICY outbox_tenant ON outbox USING (
    current_setting('vasculum.tenant', true) = '*' OR EXISTS (SELECT 1 FROM webhook WHERE webhook.id = outbox.webhook)
);
