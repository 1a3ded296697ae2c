-- Why: whoever watches the queue asks who sent a job. The label of the key (or the name that a token gives) is kept with the
-- job, because a key may be revoked later; the audit keeps the key's id.
ALTER TABLE job ADD COLUMN sent_by TEXT;
