//! `snakectl`: trains, evaluates, freezes and proves COMPOSER policies.

use std::process::ExitCode;

fn main() -> ExitCode {
    composer_host::cli::main()
}
