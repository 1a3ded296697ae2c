#!/bin/sh
# Brings a backup of backup.sh back onto an empty data folder (and an empty database), checks the audit's chain, and leaves the
# service to be started. Jobs that ran at the backup are taken back by the first start and run again.
# Usage: restore.sh BACKUP_DIR DATA_DIR       (SQLite)
#        VASCULUM_DATABASE_URL=postgres://... restore.sh BACKUP_DIR DATA_DIR   (pg_restore into that database)
set -eu
backup=$1
data=$2
if [ -e "$data" ] && [ -n "$(ls -A "$data")" ]; then
    echo "restore.sh: $data is not empty: move it away first" >&2
    exit 2
fi
mkdir -p "$data"
chmod 700 "$data"
case "${VASCULUM_DATABASE_URL:-}" in
postgres*) pg_restore --exit-on-error --no-owner --dbname="$VASCULUM_DATABASE_URL" "$backup/vasculum.dump" ;;
*) cp "$backup/vasculum.sqlite" "$data/vasculum.sqlite" ;;
esac
if [ -d "$backup/store" ]; then
    cp -a "$backup/store" "$data/store"
fi
sync
vasculum migrate --data-dir "$data"
vasculum verify-audit --data-dir "$data"
