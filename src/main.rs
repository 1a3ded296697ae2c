//! `vasculum`: parse the arguments, build the configuration, call one function per sub-command.

mod arguments;
mod cohorts;
mod demo;
mod isolation;
mod jobs;
mod manuals;
mod phantoms;
mod serving;
mod table;
mod terminal;
mod understood;
mod variants;

use crate::terminal::say;
use arguments::{Arguments, Command};
use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    service::tls::provide();
    let arguments = Arguments::parse();
    match arguments.command {
        Command::Run(a) => jobs::run(&a),
        Command::Vary(a) => variants::vary(&a),
        Command::Cohort(a) => cohorts::cohort(&a),
        Command::Validate(a) => jobs::validate(&a),
        Command::ExecJob(a) => jobs::exec(&a),
        Command::Phantom(a) => phantoms::write(&a),
        Command::Serve(a) => serving::serve(a),
        Command::Work(a) => serving::work(a),
        Command::Migrate(a) => serving::migrate(a),
        Command::Backup(a) => serving::backup(a),
        Command::Key(a) => serving::key(a),
        Command::Tenant(a) => serving::tenant(a),
        Command::VerifyAudit(a) => serving::verify_audit(a),
        Command::Demo(a) => demo::demo(&a),
        Command::Show(a) => jobs::show(&a),
        Command::Openapi => serving::openapi(),
        Command::Man(a) => manuals::man(&a),
        Command::Completions(a) => manuals::completions(&a),
        Command::Version => {
            say!("vasculum {}\n", env!("CARGO_PKG_VERSION"));
            ExitCode::SUCCESS
        }
    }
}
