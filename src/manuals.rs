//! `man` and `completions`: both are made from the arguments themselves, so that they cannot be old.

use crate::arguments::{Arguments, Completions, Man};
use clap::{Command, CommandFactory};
use std::io::Write;
use std::process::ExitCode;

/// The page of `vasculum`, or with `--out` one page for each sub-command as well.
pub(crate) fn man(a: &Man) -> ExitCode {
    let command = Arguments::command();
    let written = match &a.out {
        None => clap_mangen::Man::new(command).render(&mut std::io::stdout()),
        Some(folder) => std::fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(command, folder)),
    };
    told(written)
}

/// What a shell needs to complete our arguments.
pub(crate) fn completions(a: &Completions) -> ExitCode {
    let mut command: Command = Arguments::command();
    let mut text = Vec::new();
    clap_complete::generate(a.shell, &mut command, "vasculum", &mut text);
    told(std::io::stdout().write_all(&text))
}

fn told(written: std::io::Result<()>) -> ExitCode {
    match written {
        // Who reads only the beginning has read what was wanted.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => {
            eprintln!("vasculum: this cannot be written: {e}");
            ExitCode::FAILURE
        }
        _ => ExitCode::SUCCESS,
    }
}
