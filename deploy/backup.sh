#!/bin/sh
# Copies a service's state into a new folder: the database first, then the artefacts. Objects are never changed once a row
# names them, so a copy of the store made after that of the database holds everything the database names.
# Usage: backup.sh DATA_DIR BACKUP_DIR        (SQLite and a local store; the service may run)
#        VASCULUM_DATABASE_URL=postgres://... backup.sh DATA_DIR BACKUP_DIR   (pg_dump instead)
# Restore: stop the service; copy BACKUP_DIR/vasculum.sqlite and BACKUP_DIR/store into an empty data folder (or
# `pg_restore --dbname URL BACKUP_DIR/vasculum.dump`); start it; `vasculum verify-audit`. Jobs that ran are taken back.
set -eu
data=$1
backup=$2
mkdir -p "$backup"
case "${VASCULUM_DATABASE_URL:-}" in
postgres*) pg_dump --format=custom --file="$backup/vasculum.dump" "$VASCULUM_DATABASE_URL" ;;
*) vasculum backup --data-dir "$data" --out "$backup/vasculum.sqlite" ;;
esac
if [ -d "$data/store" ]; then
    cp -a "$data/store" "$backup/store"
fi
sync
