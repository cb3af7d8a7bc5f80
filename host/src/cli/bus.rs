//! `snakectl bus`: watches and commands a robot on its bus.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use composer_shared::registers::{Name, Register};
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::Operation;

use crate::bus::calibrate::{Axis, Bench, Jog, Turned};
use crate::bus::config::{self, Restored, RobotFile};
use crate::bus::monitor::{json_change, json_state, table};
use crate::bus::{Address, BusError, Drive, Station, registers, update};
use crate::files::write_whole;
use crate::signing;

/// How long `identify` flashes a light.
const IDENTIFY_SECONDS: u32 = 10;

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
    /// Write the configuration of the whole robot as TOML
    Dump {
        /// File [default: print it]
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Write a configuration to the robot that it is of, and store it
    Restore {
        /// The file
        file: PathBuf,
    },
    /// Calibrate one module on the bench; `--store` keeps what was found
    Calibrate(Calibrate),
    /// Give all modules the public key of who may change policy and limits from their next start on. Only a debug probe takes it back
    Key {
        /// The public key, as `snakectl key new` writes it
        file: PathBuf,
        /// As the second key, for the time in which keys are changed
        #[arg(long)]
        second: bool,
    },
    /// Write what all modules know of themselves as JSON: who they are, their policies and why they have them, their fault logs
    ExportLog {
        /// File [default: print it]
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
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
    /// Who it is: versions, unique identifier, policy, why it started
    Hello,
    /// Print its fault log, the newest entry first
    Log {
        /// Forget the log
        #[arg(long)]
        clear: bool,
    },
    /// Give it another number; counts from its next start on
    Number {
        /// The new number
        number: u8,
        /// Unique identifier of the chip (as `hello` prints it), where two modules have the same number
        #[arg(long, value_name = "ID")]
        unique_id: Option<String>,
    },
    /// Drive one axis for a moment
    Jog {
        /// Which
        #[arg(value_enum)]
        axis: Axis,
        #[command(flatten)]
        how: How,
        /// The other way
        #[arg(long)]
        back: bool,
    },
    /// Flash the module's light
    Identify,
    /// Clear the faults that a person may clear
    Clear,
    /// Restart the module
    Restart,
}

/// How strong and how long a jog is.
#[derive(clap::Args, Clone, Copy, Debug)]
struct How {
    /// Current, as a part of the motor's largest; at most a half
    #[arg(long, value_name = "PART", default_value_t = Jog::default().part)]
    current: f32,
    /// Time, s; at most 2
    #[arg(long, value_name = "S", default_value_t = Jog::default().time.as_secs_f32())]
    time: f32,
}

impl How {
    fn jog(self) -> Result<Jog> {
        if !(0.01..=0.5).contains(&self.current) {
            bail!("--current is 0.01 to 0.5 of the motor's largest current");
        }
        if !(0.05..=2.0).contains(&self.time) {
            bail!("--time is 0.05 to 2 s");
        }
        Ok(Jog { part: self.current, time: Duration::from_secs_f32(self.time) })
    }
}

#[derive(clap::Args, Clone, Debug)]
struct Calibrate {
    /// Number of the module
    #[arg(value_parser = clap::value_parser!(u8).range(0..MAX_MODULES as i64))]
    node: u8,
    #[command(subcommand)]
    what: What,
    /// Keep what was found through a loss of power
    #[arg(long, global = true)]
    store: bool,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    /// The module lies flat: correct the mounting of its inertial sensor
    Level,
    /// Find the mounting of its inertial sensor from two poses, for which it asks
    Imu,
    /// Its joints are straight as they are: make that their zero
    Zero {
        /// Which joints, 0 nearest the head [default: all four]
        #[arg(long, value_name = "J", value_parser = clap::value_parser!(u8).range(0..4))]
        joint: Vec<u8>,
    },
    /// Drive an axis and find out which way motor and encoders turn
    Polarity {
        /// Which
        #[arg(value_enum)]
        axis: Axis,
        #[command(flatten)]
        how: How,
        /// Which way the rear turned, if it was seen before; without it the question is asked
        #[arg(long, value_enum, value_name = "WAY")]
        turned: Option<Way>,
    },
    /// Drive an axis both ways, gently, until it goes no further, and set the limits of its joints inside of that
    Range {
        /// Which
        #[arg(value_enum)]
        axis: Axis,
        #[command(flatten)]
        how: How,
        /// Go no further than this, rad
        #[arg(long, default_value_t = 2.8)]
        guard: f32,
        /// Distance of the limits from the ends, rad
        #[arg(long, default_value_t = 0.05)]
        margin: f32,
    },
}

/// Which way the rear end of a module turned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Way {
    Left,
    Right,
    Down,
    Up,
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
        Verb::Dump { output } => {
            let text = config::dump(&mut station)?.to_toml();
            match output {
                Some(path) => write_whole(path, text.as_bytes()),
                None => {
                    print!("{text}");
                    Ok(())
                }
            }
        }
        Verb::Restore { file } => {
            let text = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
            let robot = RobotFile::parse(&text).with_context(|| file.display().to_string())?;
            let Restored { changed, same } =
                config::restore(&mut station, &robot).with_context(|| file.display().to_string())?;
            for (node, registers) in &changed {
                println!("module {node}: {registers} registers written and stored");
            }
            if !same.is_empty() {
                println!("{}: as in the file already", list(&same));
            }
            if !changed.is_empty() {
                println!(
                    "it counts from the next start of the modules on: `node N restart`, or switch the robot off and on"
                );
            }
            Ok(())
        }
        Verb::Calibrate(options) => calibrate(&mut station, options),
        Verb::Key { file, second } => {
            let key = signing::public_key(file)?;
            let nodes = update::give_key(&mut station, &key, *second)?;
            println!("key {}: {}; it counts from their next start on", signing::name(&key), list(&nodes));
            Ok(())
        }
        Verb::ExportLog { output } => {
            let text = serde_json::to_string_pretty(&update::export_log(&mut station)?)? + "\n";
            match output {
                Some(path) => write_whole(path, text.as_bytes()),
                None => {
                    print!("{text}");
                    Ok(())
                }
            }
        }
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
    // Who is there was said already.
    drop(station.changes());
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
        NodeVerb::Hello => {
            for (name, value) in station.hello(node)? {
                println!("{name}: {value}");
            }
        }
        NodeVerb::Log { clear: true } => {
            station.request(node, Operation::ClearLog, 0, 0)?;
            println!("module {node} has forgotten its fault log");
        }
        NodeVerb::Log { clear: false } => {
            let entries = station.log(node)?;
            if entries.is_empty() {
                println!("the fault log of module {node} is empty");
            }
            for entry in entries {
                println!("{entry}");
            }
        }
        NodeVerb::Number { number, unique_id } => match station.renumber(node, *number, unique_id.as_deref())? {
            (chip, true) => println!("chip {chip} is module {number} from its next start on (restart)"),
            (chip, false) => println!(
                "chip {chip} was told to be module {number}, and did not answer: it is silent because of its twin, or not there; switch it off and on, and look"
            ),
        },
        NodeVerb::Jog { axis, how, back } => {
            let jog = how.jog()?;
            let ways = Bench::new(station, node).jog(*axis, jog, !back)?;
            for (joint, way) in axis.joints().iter().zip(ways) {
                println!("joint {joint} went {way:+.3} rad");
            }
        }
        NodeVerb::Store => {
            config::store(station, node)?;
            println!("module {node} has stored its node page; it counts from the next start on (restart)");
        }
        NodeVerb::Identify => {
            station.request(node, Operation::Identify, 0, IDENTIFY_SECONDS)?;
            println!("the light of module {node} flashes for {IDENTIFY_SECONDS} s");
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

fn calibrate(station: &mut Station, options: &Calibrate) -> Result<()> {
    let node = options.node;
    let mut bench = Bench::new(station, node);
    match &options.what {
        What::Level => {
            let by = bench.level()?;
            println!(
                "module {node}: the mounting of the inertial sensor was corrected by {:.1} degrees",
                by.to_degrees()
            );
        }
        What::Imu => {
            let by = bench.imu(|pose| answer(&format!("{pose}, then press Enter")).map(|_| ()))?;
            println!(
                "module {node}: the mounting of the inertial sensor is {:.1} degrees from what it was",
                by.to_degrees()
            );
        }
        What::Zero { joint } => {
            let joints: &[u8] = if joint.is_empty() { &[0, 1, 2, 3] } else { joint };
            for (joint, before, now) in bench.zero(joints)? {
                println!("joint {joint}: zero is {now}, was {before}");
            }
        }
        What::Polarity { axis, how, turned } => {
            let fits = match axis {
                Axis::Yaw => [Way::Left, Way::Right],
                Axis::Pitch => [Way::Down, Way::Up],
            };
            if turned.is_some_and(|way| !fits.contains(&way)) {
                bail!("the yaw axis turns left or right, the pitch axis down or up");
            }
            let found = bench.polarity(*axis, how.jog()?, || {
                let way = match turned {
                    Some(way) => *way,
                    None => asked(*axis)?,
                };
                Ok(if matches!(way, Way::Left | Way::Down) { Turned::Positive } else { Turned::Negative })
            })?;
            let motor = if found.swap_motor {
                "turned round: its torque constant has the other sign now"
            } else {
                "as configured"
            };
            println!("motor: {motor}");
            for joint in axis.joints() {
                let swapped = found.swap_encoder[usize::from(joint)];
                println!(
                    "encoder of joint {joint}: {}",
                    if swapped { "counted the other way, corrected" } else { "as configured" }
                );
            }
        }
        What::Range { axis, how, guard, margin } => {
            if !(0.1..=3.1).contains(guard) || !(0.0..=1.0).contains(margin) {
                bail!("--guard is 0.1 to 3.1 rad, --margin 0 to 1 rad");
            }
            for (joint, low, high) in bench.range(*axis, how.jog()?, *guard, *margin)? {
                println!("joint {joint}: {low:.3} to {high:.3} rad");
            }
        }
    }
    if options.store {
        config::store(station, node)?;
        println!("stored; it counts from the next start on (restart)");
    } else {
        println!("not stored yet: `node {node} store` keeps it, `node {node} restart` forgets it");
    }
    Ok(())
}

/// Asks which way the rear end turned.
fn asked(axis: Axis) -> Result<Way, BusError> {
    let (first, second) = if axis == Axis::Yaw { ("left", "right") } else { ("down", "up") };
    loop {
        let text = answer(&format!("which way did the rear end turn, {first} or {second}?"))?;
        match text.trim() {
            "left" | "l" if axis == Axis::Yaw => return Ok(Way::Left),
            "right" | "r" if axis == Axis::Yaw => return Ok(Way::Right),
            "down" | "d" if axis == Axis::Pitch => return Ok(Way::Down),
            "up" | "u" if axis == Axis::Pitch => return Ok(Way::Up),
            _ => {}
        }
    }
}

/// A line that somebody types.
fn answer(question: &str) -> Result<String, BusError> {
    eprintln!("{question}");
    let mut line = String::new();
    match std::io::stdin().read_line(&mut line) {
        Ok(length) if length > 0 => Ok(line),
        _ => Err(BusError::Interrupted),
    }
}
