#!/bin/sh
# A role that is no superuser, so that row level security binds it.
set -eu
psql --set=ON_ERROR_STOP=1 --set=password="$POSTGRES_PASSWORD" --username postgres <<'SQL'
CREATE ROLE vasculum LOGIN NOSUPERUSER NOBYPASSRLS PASSWORD :'password';
CREATE DATABASE vasculum OWNER vasculum;
SQL
