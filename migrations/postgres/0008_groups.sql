-- Why: jobs are accepted, claimed and ended in groups; what each row of a group cost by itself is done once for the group
-- (docs/adr/0076). And a beat, which changes no index's column, must not touch an index.

-- An event of a job is written by the job's own trigger or beside a change of its row, which holds the row: that there is such a job
-- need not be looked up for each event. Erasing takes the events along, as the reference did; before the row goes, so that row level
-- security still shows whose events they are.
ALTER TABLE event DROP CONSTRAINT event_job_fkey;

CREATE FUNCTION job_erased() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    DELETE FROM event WHERE job = OLD.id;
    RETURN OLD;
END
$$;
CREATE TRIGGER job_erased BEFORE DELETE ON job FOR EACH ROW EXECUTE FUNCTION job_erased();

-- Rows before and after are told apart by grouping, whose cost does not hang on the plan that was kept from a statement of few rows.
CREATE OR REPLACE FUNCTION job_changed() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    ended TEXT[];
BEGIN
    WITH told AS (
        INSERT INTO event (job, kind, state, stage, progress, eta_s, at)
        SELECT id, 'state', state, MAX(stage) FILTER (WHERE side = 1), MAX(progress) FILTER (WHERE side = 1),
               MAX(eta_s) FILTER (WHERE side = 1), now_ms()
        FROM (SELECT id, state, stage, progress, eta_s, 1 AS side FROM after
              UNION ALL SELECT id, state, NULL, NULL, NULL, -1 FROM before) AS sides
        GROUP BY id, state HAVING SUM(side) = 1
        RETURNING job, state
    )
    SELECT ARRAY_AGG(job) INTO ended FROM told WHERE state IN ('succeeded', 'failed', 'cancelled');
    IF ended IS NULL THEN
        RETURN NULL;
    END IF;
    IF EXISTS (SELECT 1 FROM after JOIN tenant ON tenant.id = after.tenant WHERE retention_ms IS NOT NULL) THEN
        UPDATE job SET expires_at = job.finished_at + tenant.retention_ms
        FROM tenant WHERE job.id = ANY (ended) AND tenant.id = job.tenant AND tenant.retention_ms IS NOT NULL;
    END IF;
    INSERT INTO outbox (id, webhook, body, run_at)
    SELECT webhook.id || '.' || job.id || '.' || job.revision, webhook.id,
           '{"id":"' || job.id || '","state":"' || job.state || '","at":' || job.finished_at || '}', now_ms()
    FROM webhook JOIN after AS job ON job.tenant = webhook.tenant WHERE job.id = ANY (ended);
    RETURN NULL;
END
$$;
DROP TRIGGER job_changed ON job;
CREATE TRIGGER job_changed AFTER UPDATE ON job REFERENCING OLD TABLE AS before NEW TABLE AS after
    FOR EACH STATEMENT EXECUTE FUNCTION job_changed();

-- The running jobs are few and found by the other index of them; with the lease in an index every beat wrote to all nine.
DROP INDEX job_running;
ALTER TABLE job SET (fillfactor = 80);
