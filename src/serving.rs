//! `serve`, `work`, `migrate`, `key`, `tenant`, `openapi`.

use crate::arguments::{Backup, Data, Key, KeyAction, OidcArgs, Serve, Tenant, TenantAction, VerifyAudit};
use crate::terminal::say;
use artefact::read::{Limits, NamedBytes};
use artefact::write;
use serde_json::Value;
use service::auth::{Role, keys, keys::NewKey, tenants};
use service::{Auth, Config, Instance, Oidc, Problem, Tls, audit};
use std::process::ExitCode;
use tracing_subscriber::EnvFilter;

/// API, portal and workers.
pub(crate) fn serve(a: Serve) -> ExitCode {
    with_runtime(service::serve(config(a)))
}

/// A worker without API.
pub(crate) fn work(a: Serve) -> ExitCode {
    with_runtime(service::work(config(a)))
}

/// Bring the database up to date.
pub(crate) fn migrate(a: Data) -> ExitCode {
    with_runtime(service::migrate(data_config(a)))
}

/// Copy the database.
pub(crate) fn backup(a: Backup) -> ExitCode {
    with_runtime(async move {
        let db = service::open_database(&data_config(a.data)).await?;
        let copied = db.backup(&a.out).await;
        db.close().await;
        copied
    })
}

/// Make, list or revoke API keys.
pub(crate) fn key(a: Key) -> ExitCode {
    with_runtime(async move {
        match a.action {
            KeyAction::Create { data, name, role, tenant, requests_per_minute, max_bytes } => {
                let role =
                    Role::of(&role).ok_or_else(|| anyhow::anyhow!("roles are upload, read, admin and auditor"))?;
                let db = service::open_database(&data_config(data)).await?;
                let new = NewKey { label: name, role, tenant, requests_per_minute, max_bytes };
                say!("{}\n", keys::create(&db, new).await?);
                db.close().await;
            }
            KeyAction::List { data } => {
                let db = service::open_database(&data_config(data)).await?;
                say!("{:<38}{:<16}{:<10}{:<10}label\n", "id", "tenant", "role", "state");
                for key in keys::list(&db).await? {
                    let state = if key.revoked_at.is_some() { "revoked" } else { "valid" };
                    say!("{:<38}{:<16}{:<10}{state:<10}{}\n", key.id, key.tenant, key.role, key.label);
                }
                db.close().await;
            }
            KeyAction::Revoke { data, id } => {
                let db = service::open_database(&data_config(data)).await?;
                let revoked = keys::revoke(&db, &id).await?;
                db.close().await;
                anyhow::ensure!(revoked, "there is no valid key {id}; `vasculum key list` shows them");
            }
        }
        Ok(())
    })
}

/// Set or list tenants.
pub(crate) fn tenant(a: Tenant) -> ExitCode {
    with_runtime(async move {
        match a.action {
            TenantAction::Set { data, name, max_running, keep_days } => {
                let db = service::open_database(&data_config(data)).await?;
                let keep_ms = keep_days.map(|days| days * 86_400_000);
                tenants::set(&db, &name, max_running, keep_ms).await?;
                db.close().await;
            }
            TenantAction::List { data } => {
                let db = service::open_database(&data_config(data)).await?;
                say!("{:<24}{:>12}{:>12}\n", "tenant", "max running", "kept, days");
                let shown = |bound: Option<i64>| bound.map_or_else(|| "-".to_owned(), |n| n.to_string());
                for row in tenants::list(&db).await? {
                    let days = row.keep_ms.map(|ms| ms / 86_400_000);
                    say!("{:<24}{:>12}{:>12}\n", row.id, shown(row.max_running), shown(days));
                }
                db.close().await;
            }
        }
        Ok(())
    })
}

/// Check the audit's chain, and print it as FHIR AuditEvent resources if wanted.
pub(crate) fn verify_audit(a: VerifyAudit) -> ExitCode {
    with_runtime(async move {
        let db = service::open_database(&data_config(a.data)).await?;
        let mut after = 0;
        if a.fhir {
            loop {
                let (events, last) = audit::fhir(&db, None, after).await?;
                if events.is_empty() {
                    break;
                }
                after = last;
                events.iter().for_each(|event| say!("{event}\n"));
            }
        }
        let verdict = audit::verify(&db).await?;
        db.close().await;
        match verdict {
            audit::Verdict::Whole { lines } => eprintln!("the audit is whole: {lines} lines"),
            audit::Verdict::Broken { line } => {
                anyhow::bail!("the audit is broken at line {line}: it was changed, moved or taken out")
            }
        }
        Ok(())
    })
}

/// Print openapi.yaml.
pub(crate) fn openapi() -> ExitCode {
    say!("{}", service::openapi());
    ExitCode::SUCCESS
}

fn data_config(a: Data) -> Config {
    Config {
        data_dir: a.data_dir,
        database_url: a.database_url,
        store_url: a.store_url,
        s3: std::env::vars()
            .filter_map(|(name, value)| Some((name.strip_prefix("VASCULUM_S3_")?.to_owned(), value)))
            .collect(),
        intake,
        receive,
        check_plan,
        check_scan,
        cohort: crate::cohorts::of_jobs,
        ..Config::default()
    }
}

fn config(a: Serve) -> Config {
    Config {
        listen: a.listen,
        tls: a.tls_cert.zip(a.tls_key).map(|(cert, key)| Tls { cert, key }),
        workers: a.workers,
        threads: a.threads.unwrap_or(0),
        memory_mb: a.memory_mb,
        job_seconds: a.job_seconds,
        webhook_hosts: a.webhook_hosts,
        frame_ancestors: a.frame_ancestors,
        otlp_endpoint: a.otlp_endpoint,
        stow_quiet_seconds: a.stow_quiet_seconds,
        auth: if a.no_auth { Auth::None } else { Auth::Required },
        oidc: oidc(a.oidc),
        ..data_config(a.data)
    }
}

fn oidc(a: OidcArgs) -> Option<Oidc> {
    Some(Oidc {
        issuer: a.oidc_issuer?,
        audience: a.oidc_audience?,
        jwks_url: a.oidc_jwks_url?,
        tenant_claim: a.oidc_tenant_claim,
        role_claim: a.oidc_role_claim,
        ..Oidc::default()
    })
}

fn intake(files: Vec<(String, Vec<u8>)>) -> Result<Vec<(String, Vec<u8>)>, Problem> {
    let files = files.into_iter().map(|(name, bytes)| NamedBytes { name, bytes }).collect();
    let taken = artefact::read::intake(files, &Limits::default()).map_err(|e| Problem::from_fault(&e))?;
    Ok(taken.into_iter().map(|f| (f.name, f.bytes)).collect())
}

fn receive(bytes: &[u8]) -> Instance {
    let (names, file) = artefact::read::instance(bytes, &Limits::default());
    let file = file.and_then(|file| file.ok_or(artefact::read::Error::NoImages { files: 1 }));
    let file = file.map_err(|e| Problem::from_fault(&e));
    Instance { class: names.class, instance: names.instance, study: names.study, series: names.series, file }
}

fn check_plan(bytes: &[u8]) -> Result<(), Problem> {
    match artefact::plan::Plan::parse(bytes) {
        Ok(_) => Ok(()),
        Err(faults) => {
            let each = |f: &artefact::plan::PlanFault| serde_json::json!({"code": f.code, "message": f.message, "where": {"field": f.field}});
            Err(Problem::from_fault(&faults).with_errors(faults.faults.iter().map(each).collect()))
        }
    }
}

/// Most pixels of a scan that is read for a check, which happens beside the service's other work (1 GiB).
const MOST_CHECKED: u64 = 256 << 20;

/// What would be understood of a scan, with its slices as a picture in the answer itself.
fn check_scan(files: Vec<(String, Vec<u8>)>, plan: &str) -> Result<Value, Problem> {
    let files = files.into_iter().map(|(name, bytes)| NamedBytes { name, bytes }).collect();
    let plan = artefact::plan::Plan::parse(plan.as_bytes()).map_err(|e| Problem::from_fault(&e))?;
    let limits = Limits { pixels: MOST_CHECKED, ..Limits::default() };
    let ctx = exec::Ctx::new(1).map_err(Problem::internal)?;
    let read = pipeline::understand(files, &plan, &limits, &ctx).map_err(|e| Problem::from_fault(&e))?;
    let mut told = read.facts;
    if let Some(refusal) = &read.refusal {
        told["refusal"] = serde_json::to_value(Problem::from_fault(refusal)).map_err(Problem::internal)?;
    }
    let atlas = write::stack_atlas(&read.stack, read.contours.as_ref()).map_err(|e| Problem::from_fault(&e))?;
    if let Some(atlas) = atlas {
        let text = atlas.json().map_err(|e| Problem::from_fault(&e))?;
        told["slices"] = serde_json::from_slice(&text).map_err(Problem::internal)?;
        told["slices"]["image"] = format!("data:image/jpeg;base64,{}", service::media::base64(&atlas.jpeg)).into();
    }
    Ok(told)
}

fn with_runtime(work: impl Future<Output = anyhow::Result<()>>) -> ExitCode {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let outcome = tokio::runtime::Runtime::new().map_err(anyhow::Error::from).and_then(|rt| rt.block_on(work));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("vasculum: {e:#}");
            ExitCode::FAILURE
        }
    }
}
