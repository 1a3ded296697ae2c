#!/bin/sh
# Copies a service's state into a new folder: the database first, then the artefacts. Objects are never changed once a row
# names them, so a copy of the store made after that of the database holds everything the database names.
# Usage: backup.sh DATA_DIR BACKUP_DIR        (SQLite and a local store; the service may run)
#        VASCULUM_DATABASE_URL=postgres://... backup.sh DATA_DIR BACKUP_DIR   (pg_dump instead)
# Restore: restore.sh beside this file.
set -eu
data=$1
backup=$2
mkdir -p "$backup"
case "${VASCULUM_DATABASE_URL:-}" in
# Row level security binds the service's own role too: it sees every row as the tenant `*` alone.
postgres*)
    PGOPTIONS="-c vasculum.tenant=*" pg_dump --enable-row-security --format=custom \
        --file="$backup/vasculum.dump" "$VASCULUM_DATABASE_URL"
    ;;
*) vasculum backup --data-dir "$data" --out "$backup/vasculum.sqlite" ;;
esac
if [ -d "$data/store" ]; then
    cp -a "$data/store" "$backup/store"
fi
sync
