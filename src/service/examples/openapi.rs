//! Prints the OpenAPI document.

use std::io::Write as _;

fn main() -> std::io::Result<()> {
    std::io::stdout().write_all(service::openapi().as_bytes())
}
