-- Why: a job that takes an earlier one's scan or result (a variant, other roles) is looked for beside it. The earlier job may
-- be erased first, so that this is its name and no reference.
ALTER TABLE job ADD COLUMN parent TEXT;
CREATE INDEX job_parent ON job (tenant, parent, id) WHERE parent IS NOT NULL;
