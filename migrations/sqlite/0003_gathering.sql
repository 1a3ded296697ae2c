-- Why: a series that is sent by DICOMweb comes in several requests. The job that gathers it is found again by a digest of
-- the series' names (the names themselves are not kept); it waits by its run_at until nothing more has come for a while.

CREATE TABLE gathering (
    tenant TEXT NOT NULL REFERENCES tenant (id),
    series TEXT NOT NULL,
    job    TEXT REFERENCES job (id) ON DELETE CASCADE,
    PRIMARY KEY (tenant, series)
) STRICT, WITHOUT ROWID;

CREATE INDEX gathering_job ON gathering (job);
