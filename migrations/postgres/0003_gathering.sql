-- Why: a series that is sent by DICOMweb comes in several requests. The job that gathers it is found again by a digest of
-- the series' names (the names themselves are not kept); it waits by its run_at until nothing more has come for a while.

CREATE TABLE gathering (
    tenant TEXT COLLATE "C" NOT NULL REFERENCES tenant (id),
    series TEXT COLLATE "C" NOT NULL,
    job    TEXT COLLATE "C" REFERENCES job (id) ON DELETE CASCADE,
    PRIMARY KEY (tenant, series)
);

CREATE INDEX gathering_job ON gathering (job);

ALTER TABLE gathering ENABLE ROW LEVEL SECURITY;
ALTER TABLE gathering FORCE ROW LEVEL SECURITY;
CREATE POLICY gathering_tenant ON gathering USING (tenant_may_see(tenant));
