//! `snakectl update`: a new policy for all modules of a robot over its bus.

use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, bail};

use crate::bus::{Address, BusError, Station, update};
use crate::policy_source::PolicySource;
use crate::signing::Package;

/// Arguments of `update`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Where the bus is: a CAN interface such as can0, or slcan: and a serial port, such as slcan:/dev/ttyACM0
    transport: Address,
    /// The policy: signed with `snakectl sign`, or, for modules without a key, an image, or the name of one that ships
    policy: String,
}

/// A policy by its file, signed or not, or by the name of one that ships.
pub fn load(name: &str) -> Result<Package> {
    if Path::new(name).is_file() {
        let bytes = std::fs::read(name).with_context(|| format!("cannot read {name}"))?;
        return Package::parse(&bytes).with_context(|| format!("{name} is not a usable policy"));
    }
    match PolicySource::load(name)? {
        PolicySource::Image(frozen) => Package::unsigned(&frozen.image),
        _ => bail!("{name} is no policy image: freeze a run with `snakectl export` first"),
    }
}

/// The name of the key that a policy was signed with.
pub fn key_of(package: &Package) -> String {
    package.header().key_id.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let package = load(&arguments.policy)?;
    let ended = super::interrupted()?;
    let mut station = Station::new(arguments.transport.open()?);
    let header = package.header();
    let signed = if package.signed() { format!("signed with {}", key_of(&package)) } else { "not signed".into() };
    println!(
        "policy {:08x} for {}, security counter {}, {signed}; {} bytes",
        header.crc,
        header.task.name(),
        header.counter,
        package.bytes().len()
    );
    let result = update::update(&mut station, &package, &mut |progress| {
        println!("{progress}");
        !ended.load(Ordering::Relaxed)
    });
    let rows = match result {
        Err(BusError::Interrupted) => bail!(
            "interrupted: the same command goes on, and until then the modules have the policy of before, or go back to it"
        ),
        rows => rows?,
    };
    print!("{}", update::text(&rows));
    let late: Vec<String> = rows
        .iter()
        .filter(|(_, policies)| policies.is_none_or(|policies| policies.policy != header.crc || policies.trial))
        .map(|(node, _)| node.to_string())
        .collect();
    if !late.is_empty() {
        bail!(
            "not on this policy: module {}; the others ignore it until the same command has brought it up to date",
            late.join(", ")
        );
    }
    Ok(())
}
