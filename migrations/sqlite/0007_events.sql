-- Why: every change of a job's state is told, and every end has its consequences (the end of the tenant's retention, a
-- message for each webhook). The row itself sees to it, so that no statement can forget it and none needs further ones.

CREATE TRIGGER job_made AFTER INSERT ON job BEGIN
    INSERT INTO event (job, kind, state, stage, progress, eta_s, at)
    VALUES (NEW.id, 'state', NEW.state, NEW.stage, NEW.progress, NEW.eta_s, CAST(unixepoch('subsec') * 1000 AS INTEGER));
END;

CREATE TRIGGER job_changed AFTER UPDATE OF state ON job WHEN NEW.state <> OLD.state BEGIN
    INSERT INTO event (job, kind, state, stage, progress, eta_s, at)
    VALUES (NEW.id, 'state', NEW.state, NEW.stage, NEW.progress, NEW.eta_s, CAST(unixepoch('subsec') * 1000 AS INTEGER));
END;

CREATE TRIGGER job_ended AFTER UPDATE OF state ON job
WHEN NEW.state <> OLD.state AND NEW.state IN ('succeeded', 'failed', 'cancelled') BEGIN
    UPDATE job SET expires_at = NEW.finished_at + (SELECT retention_ms FROM tenant WHERE id = NEW.tenant)
    WHERE id = NEW.id AND EXISTS (SELECT 1 FROM tenant WHERE id = NEW.tenant AND retention_ms IS NOT NULL);
    INSERT INTO outbox (id, webhook, body, run_at)
    SELECT id || '.' || NEW.id || '.' || NEW.revision, id,
           '{"id":"' || NEW.id || '","state":"' || NEW.state || '","at":' || NEW.finished_at || '}', CAST(unixepoch('subsec') * 1000 AS INTEGER)
    FROM webhook WHERE tenant = NEW.tenant;
END;
