//! `snakectl` as the tests run it: the same main function, built together with them.

use std::process::ExitCode;

fn main() -> ExitCode {
    composer_host::cli::main()
}
