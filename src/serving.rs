//! `serve`, `work`, `migrate`, `key`, `openapi`.

use crate::arguments::{Data, Key, KeyAction, Serve};
use artefact::read::{Limits, NamedBytes};
use service::{Auth, Config, Problem};
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

/// Make an API key.
pub(crate) fn key(a: Key) -> ExitCode {
    let KeyAction::Create { data, name } = a.action;
    with_runtime(async move {
        println!("{}", service::create_key(data_config(data), &name).await?);
        Ok(())
    })
}

/// Print openapi.yaml.
pub(crate) fn openapi() -> ExitCode {
    print!("{}", service::openapi());
    ExitCode::SUCCESS
}

fn data_config(a: Data) -> Config {
    Config {
        data_dir: a.data_dir,
        database_url: a.database_url,
        store_url: a.store_url,
        intake,
        check_plan,
        ..Config::default()
    }
}

fn config(a: Serve) -> Config {
    Config {
        listen: a.listen,
        workers: a.workers,
        threads: a.threads.unwrap_or(0),
        auth: if a.no_auth { Auth::None } else { Auth::Required },
        ..data_config(a.data)
    }
}

fn intake(files: Vec<(String, Vec<u8>)>) -> Result<Vec<(String, Vec<u8>)>, Problem> {
    let files = files.into_iter().map(|(name, bytes)| NamedBytes { name, bytes }).collect();
    let taken = artefact::read::intake(files, &Limits::default()).map_err(|e| Problem::from_fault(&e))?;
    Ok(taken.into_iter().map(|f| (f.name, f.bytes)).collect())
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
