//! `snakectl sign`: signs a policy.

use std::path::PathBuf;

use anyhow::{Result, bail};

use super::update;
use crate::files::write_whole;
use crate::signing::{self, Package};

/// Arguments of `sign`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Policy image, or the name of one that ships
    policy: String,
    /// The secret key, as `snakectl key new` writes it
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Security counter: once a policy with it is confirmed, a module takes none with a lower one. Raise it to shut out policies that were signed before
    #[arg(long, value_name = "N", default_value_t = 0)]
    counter: u32,
    /// Edition of the policy, for people
    #[arg(long, value_name = "N", default_value_t = 0)]
    edition: u32,
    /// The signed policy [default: the policy with the ending .signed]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let package = update::load(&arguments.policy)?;
    if package.signed() {
        bail!("{} is signed already, with key {}: sign the image itself", arguments.policy, update::key_of(&package));
    }
    let signed = Package::sign(package.image(), &arguments.key, arguments.counter, arguments.edition)?;
    let output = arguments.output.clone().unwrap_or_else(|| PathBuf::from(&arguments.policy).with_extension("signed"));
    write_whole(&output, signed.bytes())?;
    let (_, key) = signing::show_key(&arguments.key)?;
    let header = signed.header();
    println!(
        "{}: policy {:08x} for {}, security counter {}, edition {}, signed with {}",
        output.display(),
        header.crc,
        header.task.name(),
        header.counter,
        header.edition,
        signing::name(&key)
    );
    Ok(())
}
