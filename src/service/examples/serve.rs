//! A service process for tests: `serve DATA_DIR PYTHON SCRIPT [auth|idle|work]`, any free port, the script as the job's program.

use std::path::PathBuf;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let data_dir = PathBuf::from(args.next().unwrap_or_else(|| "vasculum-data".to_owned()));
    let executable = PathBuf::from(args.next().unwrap_or_else(|| "python3".to_owned()));
    let script = args.next().unwrap_or_else(|| "exec_job.py".to_owned());
    let mode = args.next().unwrap_or_default();
    let auth = if mode == "auth" { service::Auth::Required } else { service::Auth::None };
    let config = service::Config {
        data_dir,
        executable,
        executable_args: vec![script],
        auth,
        workers: usize::from(mode != "idle"),
        listen: std::net::SocketAddr::from(([127, 0, 0, 1], 0)),
        ..service::Config::default()
    };
    if mode == "work" { service::work(config).await } else { service::serve(config).await }
}
