//! The binary serving on a free port, for tests against it.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// `vasculum serve` of this binary without keys on the folder `data`, with what `configure` adds to the command, once it
/// listens: the process and its address.
pub(crate) fn serve(binary: &Path, data: &Path, configure: impl FnOnce(&mut Command)) -> (Child, String) {
    let mut command = Command::new(binary);
    command.args(["serve", "--no-auth", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data);
    command.env("RUST_LOG", "error").stdout(Stdio::piped()).stdin(Stdio::null());
    configure(&mut command);
    let mut process = command.spawn().unwrap();
    let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
    let address = lines.find_map(|l| l.unwrap().strip_prefix("listening on ").map(str::to_owned)).unwrap();
    std::thread::spawn(move || lines.for_each(drop));
    (process, address.trim().to_owned())
}
