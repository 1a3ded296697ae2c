-- Why: every change of a job's state is told, and every end has its consequences (the end of the tenant's retention, a
-- message for each webhook). The row itself sees to it, so that no statement can forget it and none needs further ones.

CREATE FUNCTION job_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO event (job, kind, state, stage, progress, eta_s, at)
    VALUES (NEW.id, 'state', NEW.state, NEW.stage, NEW.progress, NEW.eta_s, now_ms());
    IF NEW.state IN ('succeeded', 'failed', 'cancelled') THEN
        UPDATE job SET expires_at = NEW.finished_at + tenant.retention_ms
        FROM tenant WHERE job.id = NEW.id AND tenant.id = NEW.tenant AND tenant.retention_ms IS NOT NULL;
        INSERT INTO outbox (id, webhook, body, run_at)
        SELECT id || '.' || NEW.id || '.' || NEW.revision, id,
               '{"id":"' || NEW.id || '","state":"' || NEW.state || '","at":' || NEW.finished_at || '}', now_ms()
        FROM webhook WHERE tenant = NEW.tenant;
    END IF;
    RETURN NULL;
END
$$;

-- The same clock, read once in a statement: only so does the planner put its words in place of the call (a function may
-- not be inlined that promises more than what it calls; sixteen calls a job were a fifth of the database's work).
CREATE OR REPLACE FUNCTION now_ms() RETURNS BIGINT LANGUAGE sql STABLE AS $$
    SELECT (date_part('epoch', statement_timestamp()) * 1000)::BIGINT
$$;

CREATE FUNCTION job_made() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO event (job, kind, state, stage, progress, eta_s, at)
    SELECT id, 'state', state, stage, progress, eta_s, now_ms() FROM made;
    RETURN NULL;
END
$$;

CREATE TRIGGER job_made AFTER INSERT ON job REFERENCING NEW TABLE AS made
    FOR EACH STATEMENT EXECUTE FUNCTION job_made();
CREATE TRIGGER job_changed AFTER UPDATE OF state ON job FOR EACH ROW
    WHEN (NEW.state <> OLD.state) EXECUTE FUNCTION job_changed();
