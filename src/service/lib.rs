//! The service: an HTTP API, a portal, a durable queue and workers, in one process on one machine.
//!
//! `http` says what callers see, `queue` holds every SQL statement about jobs, `store` every object key, `worker` runs
//! one child process per job, `auth` knows who calls. The numeric work happens in the child; nothing here computes.
//!
//! Promises: a 202 is given after the job is committed and synced; a job ends in exactly one final state, whoever is
//! killed on the way; a reader sees only artefacts that the job table names. See ARCHITECTURE.md for the walk through.

pub mod audit;
pub mod auth;
pub mod cohort;
pub mod config;
pub mod db;
pub mod error;
mod http;
pub mod intake;
mod keeping;
pub mod media;
pub mod queue;
mod server;
pub mod state;
pub mod store;
pub mod telemetry;
pub mod tls;
pub mod traces;
mod uploads;
pub mod webhooks;
pub mod worker;

pub use config::{Auth, CheckPlan, Config, Instance, Intake, NamedBytes, Oidc, Receive};
pub use error::{PROBLEM_JSON, Problem, place_json};
pub use server::{Server, migrate, open_database, serve, work};
pub use tls::Tls;

/// The OpenAPI 3.1 document as YAML; the same bytes for the same version.
pub fn openapi() -> String {
    // A document of maps and strings always has a YAML form; a test compares it with the committed file.
    http::openapi().to_yaml().unwrap_or_default()
}
