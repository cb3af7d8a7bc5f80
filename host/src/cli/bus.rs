//! `snakectl bus`: watches and commands a robot on its bus.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use composer_shared::registers::{Name, Register};
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::Operation;

use crate::bus::monitor::{json_change, json_state, table};
use crate::bus::{Address, BusError, Drive, Station, registers};

/// Arguments of `bus`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Where the bus is: a CAN interface such as can0, or slcan: and a serial port, such as slcan:/dev/ttyACM0
    transport: Address,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum Verb {
    /// Show all modules, again and again: what they are at, faults by name, supply, temperature. Ctrl-C stops the robot
    Monitor(Monitor),
    /// Arm the robot and keep it armed until Ctrl-C, which stops it
    Arm(Arm),
    /// Disarm the robot: motors off, modules go on taking part
    Disarm,
    /// Stop the robot: motors off and latched until a release
    Stop,
    /// Release a stopped robot; it stays disarmed
    Release,
    /// Tell the robot where its goal is until Ctrl-C, which stops it
    Goal(Goal),
    /// One module: its registers, fault log, light, and a careful movement
    Node(Node),
}

#[derive(clap::Args, Clone, Debug)]
struct Monitor {
    /// Print JSON lines: changes as they come, and the state of all modules
    #[arg(long)]
    json: bool,
    /// Only listen: ask for nothing (no supply then), and stop nothing on Ctrl-C
    #[arg(long)]
    passive: bool,
    /// Seconds between two looks
    #[arg(long, value_name = "S", default_value_t = 0.5)]
    every: f64,
    /// End after so many seconds, without a stop
    #[arg(long = "for", value_name = "S")]
    seconds: Option<f64>,
}

#[derive(clap::Args, Clone, Debug)]
struct Arm {
    /// Arm modules too that restarted though nobody asked for it
    #[arg(long)]
    acknowledge: bool,
    /// End after so many seconds and disarm the robot
    #[arg(long = "for", value_name = "S")]
    seconds: Option<f64>,
}

#[derive(clap::Args, Clone, Debug)]
struct Goal {
    /// Robot units ahead of the head
    #[arg(allow_negative_numbers = true)]
    x: f32,
    /// To its left
    #[arg(allow_negative_numbers = true)]
    y: f32,
    /// Above it
    #[arg(allow_negative_numbers = true)]
    z: f32,
    /// Arm the robot, too
    #[arg(long)]
    arm: bool,
    /// End after so many seconds; disarms the robot if it was to be armed
    #[arg(long = "for", value_name = "S")]
    seconds: Option<f64>,
}

#[derive(clap::Args, Clone, Debug)]
struct Node {
    /// Number of the module, 0 is the head
    #[arg(value_parser = clap::value_parser!(u8).range(0..MAX_MODULES as i64))]
    node: u8,
    #[command(subcommand)]
    verb: NodeVerb,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum NodeVerb {
    /// Print registers; without a name all of them
    Get {
        /// Names or numbers, as in firmware/registers.md
        names: Vec<String>,
    },
    /// Write a register; `store` keeps it
    Set {
        /// Name or number
        name: String,
        /// Value, in the register's steps
        #[arg(allow_hyphen_values = true)]
        value: String,
    },
    /// Keep what was written through a loss of power
    Store,
    /// Flash the module's light
    Identify,
    /// Clear the faults that a person may clear
    Clear,
    /// Restart the module
    Restart,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let ended = super::interrupted()?;
    let mut station = Station::new(arguments.transport.open()?);
    match &arguments.verb {
        Verb::Monitor(options) => monitor(&mut station, options, &ended),
        Verb::Arm(options) => {
            let seconds = duration(options.seconds)?;
            let armed = station.arm(options.acknowledge)?;
            println!("armed: {}", list(&armed));
            session(&mut station, &Drive { arm: true, goal: None }, seconds, &ended)
        }
        Verb::Disarm => {
            let nodes = station.disarm()?;
            println!("disarmed: {}", list(&nodes));
            Ok(())
        }
        Verb::Stop => {
            let nodes = station.stop()?;
            println!("stopped: {}", list(&nodes));
            Ok(())
        }
        Verb::Release => {
            let nodes = station.release()?;
            println!("released, and disarmed: {}", list(&nodes));
            Ok(())
        }
        Verb::Goal(Goal { x, y, z, arm, seconds }) => {
            let seconds = duration(*seconds)?;
            let goal = [*x, *y, *z];
            if !goal.iter().all(|x| x.abs() < 128.0) {
                bail!("the goal is within 128 units of the head in x, y and z: a GOAL frame says no more");
            }
            if *arm {
                let armed = station.arm(false)?;
                println!("armed: {}", list(&armed));
            } else {
                station.meet()?;
            }
            session(&mut station, &Drive { arm: *arm, goal: Some(goal) }, seconds, &ended)
        }
        Verb::Node(Node { node, verb }) => one(&mut station, *node, verb),
    }
}

fn duration(seconds: Option<f64>) -> Result<Option<Duration>> {
    match seconds {
        Some(seconds) if !(0.001..=1e6).contains(&seconds) => bail!("--for is 0.001 to 1000000 seconds"),
        seconds => Ok(seconds.map(Duration::from_secs_f64)),
    }
}

/// Modules for people: `module 3`, `modules 0 to 7`, `modules 0, 2`.
fn list(nodes: &[u8]) -> String {
    match nodes {
        [node] => format!("module {node}"),
        [first, .., last] if usize::from(last - first) + 1 == nodes.len() => format!("modules {first} to {last}"),
        _ => format!("modules {}", nodes.iter().map(u8::to_string).collect::<Vec<_>>().join(", ")),
    }
}

/// Drives the robot until Ctrl-C, which stops it, or for some time, after which it is disarmed if it was to be armed.
fn session(station: &mut Station, drive: &Drive, seconds: Option<Duration>, ended: &AtomicBool) -> Result<()> {
    let start = Instant::now();
    let over = || seconds.is_some_and(|seconds| start.elapsed() >= seconds);
    let result = station.drive(drive, |station| {
        for change in station.changes() {
            println!("{change}");
        }
        ended.load(Ordering::Relaxed) || over()
    });
    if ended.load(Ordering::Relaxed) {
        let nodes = station.stop()?;
        println!("stopped: {}", list(&nodes));
    } else if result.is_ok() && drive.arm {
        let nodes = station.disarm()?;
        println!("disarmed: {}", list(&nodes));
    }
    Ok(result?)
}

fn monitor(station: &mut Station, options: &Monitor, ended: &AtomicBool) -> Result<()> {
    let seconds = duration(options.seconds)?;
    if !(0.01..=3600.0).contains(&options.every) {
        bail!("--every is 0.01 to 3600 seconds");
    }
    let every = Duration::from_secs_f64(options.every);
    let start = Instant::now();
    let screen = !options.json && std::io::stdout().is_terminal();
    let mut next = every.min(Duration::from_millis(300));
    let mut told: Vec<String> = Vec::new();
    while !ended.load(Ordering::Relaxed) && seconds.is_none_or(|seconds| start.elapsed() < seconds) {
        station.listen(Duration::from_millis(10))?;
        let mut out = std::io::stdout().lock();
        for change in station.changes() {
            if options.json {
                writeln!(out, "{}", json_change(change, station.now()))?;
            } else if screen {
                // Below the table, the last few.
                told.push(format!("{:8.1} s  {change}", station.now().as_secs_f64()));
                told.drain(..told.len().saturating_sub(10));
            } else {
                writeln!(out, "{change}")?;
            }
        }
        if start.elapsed() < next {
            continue;
        }
        next = start.elapsed() + every;
        drop(out);
        if !options.passive {
            station.look_at_supply()?;
        }
        let mut out = std::io::stdout().lock();
        if options.json {
            writeln!(out, "{}", json_state(station.robot(), station.now()))?;
        } else {
            // From the upper left corner; what is left of the last look is cleared.
            let text = table(station.robot(), station.now());
            let text = if screen { format!("\x1b[H\x1b[2J{text}\n{}\n", told.join("\n")) } else { text + "\n" };
            out.write_all(text.as_bytes())?;
        }
        out.flush()?;
    }
    if ended.load(Ordering::Relaxed) && !options.passive {
        let nodes = station.stop()?;
        if !options.json {
            println!("stopped: {}", list(&nodes));
        }
    }
    Ok(())
}

fn one(station: &mut Station, node: u8, verb: &NodeVerb) -> Result<()> {
    let read = |station: &mut Station, number: u8| station.request(node, Operation::Read, number, 0);
    match verb {
        NodeVerb::Get { names } => {
            let mut numbers = Vec::new();
            for name in names {
                numbers.extend(registers::find(name)?);
            }
            if names.is_empty() {
                numbers.extend(Register::ALL.iter().flat_map(|register| register.numbers()));
            }
            for number in numbers {
                match read(station, number) {
                    Ok(bits) => println!("{} = {}", Name(number), registers::show(number, bits)),
                    // Among all of them some may not be on this board.
                    Err(BusError::Refused { .. }) if names.is_empty() => {}
                    Err(error) => return Err(error.into()),
                }
            }
        }
        NodeVerb::Set { name, value } => {
            let numbers = registers::find(name)?;
            let [number] = numbers[..] else {
                bail!("`{name}` are {} registers: say which, {name}_0 to {name}_{}", numbers.len(), numbers.len() - 1);
            };
            let bits = registers::bits(number, value)?;
            let bits = station.request(node, Operation::Write, number, bits)?;
            println!("{} = {}", Name(number), registers::show(number, bits));
        }
        NodeVerb::Store => {
            station.request(node, Operation::Store, 0, 0)?;
            println!("module {node} has stored its node page; it counts from the next start on (restart)");
        }
        NodeVerb::Identify => {
            station.request(node, Operation::Identify, 0, 0)?;
            println!("the light of module {node} flashes");
        }
        NodeVerb::Clear => {
            station.request(node, Operation::Clear, 0, 0)?;
            println!("module {node} has cleared its faults");
        }
        NodeVerb::Restart => {
            station.request(node, Operation::Restart, 0, 0)?;
            println!("module {node} restarts");
        }
    }
    Ok(())
}
