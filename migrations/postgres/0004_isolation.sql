-- Why: an operator is to see whether a worker's jobs are held back from the network.

ALTER TABLE worker ADD COLUMN isolation TEXT;
