//! `snakectl dbc`: the message database for CAN tools, generated from the wire format.

use anyhow::Result;
use composer_shared::wire;

/// Arguments of `dbc`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Modules on the bus
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u8).range(1..=64))]
    modules: u8,
    /// For a classic bus; without it for CAN-FD, on which every frame is an FD frame
    #[arg(long)]
    classic: bool,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let mut text = String::new();
    wire::dbc(&mut text, arguments.modules, !arguments.classic)?;
    print!("{text}");
    Ok(())
}
