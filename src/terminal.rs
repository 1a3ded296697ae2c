//! What goes to standard output. A reader who has seen enough (`| head`) closes the pipe: that is no fault.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write as _};

/// `print!` that ends quietly where nobody reads any more.
macro_rules! say {
    ($($words:tt)*) => { $crate::terminal::write(format_args!($($words)*)) };
}
pub(crate) use say;

pub(crate) fn write(words: Arguments<'_>) {
    match std::io::stdout().write_fmt(words) {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => {}
        Err(e) => {
            eprintln!("vasculum: standard output cannot be written: {e}");
            std::process::exit(1);
        }
        Ok(()) => {}
    }
}
