//! A plant in another process, at the end of a pipe or of a loopback TCP connection.
//!
//! `plant-protocol.md` beside this crate says what is exchanged: lines of JSON, in lock-step, in robot units. This is the host's side. The
//! other one may be any program; `examples/mujoco_plant.py` is one.
//!
//! - Every answer has a limited time, [`PATIENCE`] unless told otherwise. Nothing waits for ever.
//! - Every way in which the other side can fail is one sentence, a [`PlantError`].
//! - A process that was started here ends with its [`ExternalPlant`], with everything that it has started; if this program is killed, the kernel
//!   kills it (Linux), and elsewhere the closed pipe tells it.

use std::io::{self, Read, Seek, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::str::FromStr;
use std::time::{Duration, Instant};

use composer_shared::robot::AXES;
use serde::{Deserialize, Serialize};

use crate::qemu::die_with_parent;

/// Name of the protocol, in both greetings.
pub const PROTOCOL: &str = "composer-plant";
/// Version of the protocol that this program speaks.
pub const VERSION: u32 = 1;
/// How long an answer may take, unless told otherwise. A physics step takes milliseconds, the start of an interpreter about a second.
pub const PATIENCE: Duration = Duration::from_secs(10);
/// How long a process may take to end after it was told to, before it is killed.
const FAREWELL: Duration = Duration::from_millis(500);
/// A longer line is nonsense. The state of 64 modules takes a tenth of a megabyte.
const LONGEST_LINE: usize = 16 << 20;

/// A link of the snake, or the block. World frame, units, s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkState {
    /// Its centre.
    pub position: [f32; 3],
    /// Its rotation, quaternion x, y, z, w.
    pub rotation: [f32; 4],
    /// Velocity of its centre, units/s.
    pub linear: [f32; 3],
    /// Its angular velocity, rad/s, by the world's axes.
    pub angular: [f32; 3],
}

/// All that the host has to know of a plant elsewhere to judge, record and show it.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct MirrorState {
    /// The links, head first.
    pub links: Vec<LinkState>,
    /// Angle of every joint, head first, rad.
    pub joint_angles: Vec<f32>,
    /// Speed of every joint, rad/s.
    pub joint_speeds: Vec<f32>,
    /// The block, if there is one.
    pub block: Option<LinkState>,
}

/// What a module's IMU reads, in the frame of its own link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Imu {
    /// Direction against gravity, a unit vector.
    pub up: [f32; 3],
    /// Angular rate, rad/s.
    pub rate: [f32; 3],
}

/// The plant after a reset or a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Links, joints, block.
    pub mirror: MirrorState,
    /// The modules' IMUs, head first, if the plant has its own; otherwise they are worked out from the links.
    pub imu: Option<Vec<Imu>>,
}

/// How many modules and links a snake has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    /// Modules.
    pub modules: usize,
    /// Links of all modules together.
    pub links: usize,
}

/// A box that does not move.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SolidSetup {
    /// Half of each edge along its own axes, units.
    pub half: [f32; 3],
    /// Centre in the world, units.
    pub position: [f32; 3],
    /// Rotation, quaternion x, y, z, w.
    pub rotation: [f32; 4],
}

/// A box that can be pushed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BlockSetup {
    /// Half of each edge along its own axes, units.
    pub half: [f32; 3],
    /// Centre in the world, units.
    pub position: [f32; 3],
    /// Rotation, quaternion x, y, z, w.
    pub rotation: [f32; 4],
    /// Mass, kg.
    pub mass: f32,
    /// Coefficient of friction on the ground.
    pub friction: f32,
}

/// What stands on the ground besides the snake.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SceneSetup {
    /// What does not move.
    pub solids: Vec<SolidSetup>,
    /// What can be pushed.
    pub block: Option<BlockSetup>,
}

/// The start of an episode.
#[derive(Clone, Debug, Serialize)]
pub struct Reset<R> {
    /// The robot, its fields by their names in a robot file, and the law of contact.
    pub robot: R,
    /// Its surroundings.
    pub scene: SceneSetup,
    /// Seed of the episode, for a plant that has anything random.
    pub seed: u64,
    /// The same robot and scene as a model for MuJoCo.
    pub mjcf: String,
}

/// Where the plant is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A program with its arguments, to be started; the protocol goes over its standard input and output.
    Command(Vec<String>),
    /// A server on this machine.
    Tcp(SocketAddr),
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Some(place) = text.strip_prefix("tcp:") {
            let address: SocketAddr = place
                .replace("localhost:", "127.0.0.1:")
                .parse()
                .map_err(|_| format!("{place:?} is no address of the kind 127.0.0.1:5555"))?;
            if !address.ip().is_loopback() {
                return Err(format!(
                    "{} is another machine: the protocol has no protection, so it stays on 127.0.0.1",
                    address.ip()
                ));
            }
            return Ok(Address::Tcp(address));
        }
        let words = words(text)?;
        if words.is_empty() {
            return Err("name a program that is the plant, or tcp:127.0.0.1:PORT".into());
        }
        Ok(Address::Command(words))
    }
}

/// Splits a command line at blanks; quotes of both kinds keep blanks, a backslash outside single quotes keeps what follows.
fn words(text: &str) -> Result<Vec<String>, String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    let mut letters = text.chars();
    while let Some(letter) = letters.next() {
        match (letter, quote) {
            (c, Some(q)) if c == q => quote = None,
            ('\\', None | Some('"')) => {
                let next = letters.next().ok_or("the command ends in a backslash")?;
                word.get_or_insert_default().push(next);
            }
            (c, Some(_)) => word.get_or_insert_default().push(c),
            ('"' | '\'', None) => {
                quote = Some(letter);
                word.get_or_insert_default();
            }
            (c, None) if c.is_whitespace() => words.extend(word.take()),
            (c, None) => word.get_or_insert_default().push(c),
        }
    }
    if quote.is_some() {
        return Err("a quote in the command is not closed".into());
    }
    words.extend(word);
    Ok(words)
}

/// Why there is no plant any more.
#[derive(Debug, thiserror::Error)]
pub enum PlantError {
    /// The program cannot be started, the server not be reached.
    #[error("the plant {name} cannot be started: {reason}")]
    Start {
        /// The program or the address.
        name: String,
        /// What the system said.
        reason: String,
    },
    /// It ended or closed the connection.
    #[error("the plant died: {how}")]
    Died {
        /// How it ended, and its last words.
        how: String,
    },
    /// It does not answer.
    #[error("the plant has not answered for {} s", .0.as_secs_f32())]
    Stalled(Duration),
    /// It says something that makes no sense.
    #[error("the plant answers nonsense: {0}")]
    Nonsense(String),
    /// Another version of the protocol.
    #[error(
        "the plant speaks version {theirs} of {PROTOCOL} and this program version {VERSION}: take a plant of this version"
    )]
    Version {
        /// The plant's.
        theirs: u64,
    },
    /// Another robot.
    #[error(
        "the plant has {} modules with {} links and the robot {} modules with {} links: take a plant of this robot",
        .theirs.modules, .theirs.links, .ours.modules, .ours.links
    )]
    Size {
        /// The plant's.
        theirs: Size,
        /// The host's.
        ours: Size,
    },
    /// A number that is none.
    #[error("the plant's state is not finite ({0}): its motion has diverged")]
    NotFinite(String),
    /// It refuses what it was asked for.
    #[error("the plant refuses: {0}")]
    Refused(String),
}

/// What is sent.
#[derive(Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Question<'a, R> {
    Hello { protocol: &'a str, version: u32, modules: usize, links: usize },
    Reset(&'a Reset<R>),
    Step { dt: f64, torques: &'a [[f32; AXES]] },
    Bye,
}

/// What can come back. Numbers are read with all their digits, so that those too large for the host are seen.
#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Answer {
    Hello { protocol: String, version: u64, modules: usize, links: usize },
    State(WireState),
    Error { message: String },
}

#[derive(Deserialize)]
struct WireState {
    #[serde(flatten)]
    mirror: MirrorState,
    #[serde(default)]
    imu: Option<Vec<Imu>>,
}

/// The near end of the connection.
#[derive(Debug)]
enum Stream {
    Pipe(UnixStream),
    Tcp(TcpStream),
}

impl Stream {
    /// Limits the next reading and writing.
    fn limit(&self, time: Duration) -> io::Result<()> {
        // Zero would mean for ever.
        let time = Some(time.max(Duration::from_millis(1)));
        match self {
            Stream::Pipe(s) => s.set_read_timeout(time).and_then(|()| s.set_write_timeout(time)),
            Stream::Tcp(s) => s.set_read_timeout(time).and_then(|()| s.set_write_timeout(time)),
        }
    }

    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Stream::Pipe(s) => s.read(buffer),
            Stream::Tcp(s) => s.read(buffer),
        }
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Stream::Pipe(s) => s.write(bytes),
            Stream::Tcp(s) => s.write(bytes),
        }
    }

    fn close(&self) {
        // It may be closed already.
        let _ = match self {
            Stream::Pipe(s) => s.shutdown(std::net::Shutdown::Both),
            Stream::Tcp(s) => s.shutdown(std::net::Shutdown::Both),
        };
    }
}

/// A process that was started here.
#[derive(Debug)]
struct Process {
    child: Child,
    /// What it wrote to standard error.
    complaints: std::fs::File,
}

impl Process {
    /// Waits for its end, a limited time.
    fn ended(&mut self, patience: Duration) -> Option<ExitStatus> {
        let start = Instant::now();
        loop {
            match self.child.try_wait() {
                Ok(Some(status)) => return Some(status),
                _ if start.elapsed() > patience => return None,
                _ => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }

    /// Its last line on standard error.
    fn last_words(&mut self) -> Option<String> {
        let mut bytes = Vec::new();
        let length = self.complaints.seek(io::SeekFrom::End(0)).ok()?;
        self.complaints.seek(io::SeekFrom::Start(length.saturating_sub(2000))).ok()?;
        (&self.complaints).take(2000).read_to_end(&mut bytes).ok()?;
        let text = String::from_utf8_lossy(&bytes).into_owned();
        text.lines().rev().map(str::trim).find(|line| !line.is_empty()).map(String::from)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It leads a process group of its own, so that whatever it has started ends too. It may all have ended already.
        if let Some(group) = rustix::process::Pid::from_raw(self.child.id() as i32) {
            let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A plant elsewhere, greeted. Dropping it says goodbye, and ends its process if it was started here.
#[derive(Debug)]
pub struct ExternalPlant {
    stream: Stream,
    process: Option<Process>,
    patience: Duration,
    size: Size,
    /// Received bytes that are no whole line yet.
    ahead: Vec<u8>,
}

impl ExternalPlant {
    /// Starts or reaches the plant and greets it; each of its answers may take `patience`.
    pub fn start(address: &Address, size: Size, patience: Duration) -> Result<Self, PlantError> {
        let patience = patience.max(Duration::from_millis(1));
        let (stream, process) = match address {
            Address::Command(words) => {
                let fail = |error: io::Error| PlantError::Start {
                    name: words[0].clone(),
                    reason: match error.kind() {
                        io::ErrorKind::NotFound => "there is no such program".into(),
                        _ => error.to_string(),
                    },
                };
                let (stream, process) = spawn(words).map_err(fail)?;
                (Stream::Pipe(stream), Some(process))
            }
            Address::Tcp(address) => {
                let fail = |error: io::Error| PlantError::Start {
                    name: format!("tcp:{address}"),
                    reason: match error.kind() {
                        io::ErrorKind::ConnectionRefused => "nobody listens there".into(),
                        _ => error.to_string(),
                    },
                };
                let stream = TcpStream::connect_timeout(address, patience).map_err(fail)?;
                stream.set_nodelay(true).map_err(fail)?;
                (Stream::Tcp(stream), None)
            }
        };
        let mut plant = ExternalPlant { stream, process, patience, size, ahead: Vec::new() };
        plant.greet()?;
        Ok(plant)
    }

    fn greet(&mut self) -> Result<(), PlantError> {
        let Size { modules, links } = self.size;
        match self.ask::<()>(&Question::Hello { protocol: PROTOCOL, version: VERSION, modules, links })? {
            Answer::Hello { protocol, .. } if protocol != PROTOCOL => {
                Err(PlantError::Nonsense(format!("it speaks {protocol:?} instead of {PROTOCOL:?}")))
            }
            Answer::Hello { version, .. } if version != u64::from(VERSION) => {
                Err(PlantError::Version { theirs: version })
            }
            Answer::Hello { modules, links, .. } => {
                let theirs = Size { modules, links };
                if theirs == self.size { Ok(()) } else { Err(PlantError::Size { theirs, ours: self.size }) }
            }
            Answer::State(_) => Err(PlantError::Nonsense("it does not begin with a hello".into())),
            Answer::Error { message } => Err(refused(&message)),
        }
    }

    /// Starts an episode.
    pub fn reset<R: Serialize>(&mut self, reset: &Reset<R>) -> Result<State, PlantError> {
        let has_block = reset.scene.block.is_some();
        let state = self.ask_state(&Question::Reset(reset))?;
        if state.mirror.block.is_some() != has_block {
            let what = if has_block { "it leaves out the block" } else { "it has a block that the scene has not" };
            return Err(PlantError::Nonsense(what.into()));
        }
        Ok(state)
    }

    /// Advances by `dt` seconds under these torques (robot units; yaw and pitch of each module, on every joint of that axis).
    pub fn step(&mut self, dt: f64, torques: &[[f32; AXES]]) -> Result<State, PlantError> {
        self.ask_state::<()>(&Question::Step { dt, torques })
    }

    fn ask_state<R: Serialize>(&mut self, question: &Question<'_, R>) -> Result<State, PlantError> {
        match self.ask(question)? {
            Answer::State(wire) => self.checked(wire),
            Answer::Hello { .. } => Err(PlantError::Nonsense("it says hello in the middle of an episode".into())),
            Answer::Error { message } => Err(refused(&message)),
        }
    }

    fn checked(&self, WireState { mirror, imu }: WireState) -> Result<State, PlantError> {
        let Size { modules, links } = self.size;
        for (what, got, want) in [
            ("links", mirror.links.len(), links),
            ("joint_angles", mirror.joint_angles.len(), links - 1),
            ("joint_speeds", mirror.joint_speeds.len(), links - 1),
            ("imu", imu.as_ref().map_or(modules, Vec::len), modules),
        ] {
            if got != want {
                return Err(PlantError::Nonsense(format!("{got} {what} instead of {want}")));
            }
        }
        let finite = |what: &str, index: usize, numbers: &[f32]| match numbers.iter().all(|n| n.is_finite()) {
            true => Ok(()),
            false => Err(PlantError::NotFinite(format!("{what} {index}"))),
        };
        let body = |what: &str, index: usize, b: &LinkState| {
            finite(what, index, &[&b.position[..], &b.rotation, &b.linear, &b.angular].concat())?;
            let square: f32 = b.rotation.iter().map(|c| c * c).sum();
            match (square - 1.0).abs() < 0.01 {
                true => Ok(()),
                false => Err(PlantError::Nonsense(format!("the rotation of {what} {index} is no unit quaternion"))),
            }
        };
        for (index, link) in mirror.links.iter().enumerate() {
            body("link", index, link)?;
        }
        if let Some(block) = &mirror.block {
            body("block", 0, block)?;
        }
        for (index, (angle, speed)) in mirror.joint_angles.iter().zip(&mirror.joint_speeds).enumerate() {
            finite("joint", index, &[*angle, *speed])?;
        }
        for (index, imu) in imu.iter().flatten().enumerate() {
            finite("imu", index, &[imu.up, imu.rate].concat())?;
        }
        Ok(State { mirror, imu })
    }

    fn ask<R: Serialize>(&mut self, question: &Question<'_, R>) -> Result<Answer, PlantError> {
        let deadline = Instant::now() + self.patience;
        let mut line = serde_json::to_vec(question).map_err(|e| PlantError::Nonsense(e.to_string()))?;
        line.push(b'\n');
        // What a plant that died before reading this has said is known by `failed`.
        self.send(&line, deadline)?;
        let line = self.line(deadline)?;
        serde_json::from_slice(&line).map_err(|error| nonsense(&line, &error))
    }

    fn send(&mut self, mut bytes: &[u8], deadline: Instant) -> Result<(), PlantError> {
        while !bytes.is_empty() {
            match self.stream.limit(self.left(deadline)?).and_then(|()| self.stream.write(bytes)) {
                Ok(0) => return Err(self.died()),
                Ok(length) => bytes = &bytes[length..],
                Err(error) => self.failed(&error)?,
            }
        }
        Ok(())
    }

    /// The next line, without its end.
    fn line(&mut self, deadline: Instant) -> Result<Vec<u8>, PlantError> {
        let mut seen = 0;
        let mut buffer = [0; 65536];
        loop {
            if let Some(end) = self.ahead[seen..].iter().position(|&byte| byte == b'\n') {
                let rest = self.ahead.split_off(seen + end + 1);
                let mut line = std::mem::replace(&mut self.ahead, rest);
                line.pop();
                return Ok(line);
            }
            seen = self.ahead.len();
            if seen > LONGEST_LINE {
                return Err(PlantError::Nonsense(format!("a line of more than {} MB", LONGEST_LINE >> 20)));
            }
            match self.stream.limit(self.left(deadline)?).and_then(|()| self.stream.read(&mut buffer)) {
                Ok(0) => return Err(self.died()),
                Ok(length) => self.ahead.extend_from_slice(&buffer[..length]),
                Err(error) => self.failed(&error)?,
            }
        }
    }

    fn left(&self, deadline: Instant) -> Result<Duration, PlantError> {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() { Err(PlantError::Stalled(self.patience)) } else { Ok(left) }
    }

    /// What an error of the connection means; nothing if it is to be tried again.
    fn failed(&mut self, error: &io::Error) -> Result<(), PlantError> {
        match error.kind() {
            // The deadline is looked at before the next try.
            io::ErrorKind::Interrupted | io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => Ok(()),
            _ => Err(self.died()),
        }
    }

    fn died(&mut self) -> PlantError {
        let Some(process) = &mut self.process else {
            return PlantError::Died { how: "it closed the connection".into() };
        };
        let mut how = match process.ended(FAREWELL) {
            Some(status) => status.to_string(),
            None => "it closed its output".into(),
        };
        if let Some(words) = process.last_words() {
            how = format!("{how}; its last words: {words}");
        }
        PlantError::Died { how }
    }
}

impl Drop for ExternalPlant {
    fn drop(&mut self) {
        // Whoever failed may not listen any more; the end of the connection tells the same.
        let goodbye = serde_json::to_vec(&Question::<()>::Bye).unwrap_or_default();
        let _ = self.stream.limit(Duration::from_millis(100));
        let _ = self.stream.write(&[&goodbye[..], b"\n"].concat());
        if let Stream::Pipe(stream) = &self.stream {
            let _ = stream.shutdown(std::net::Shutdown::Write);
        }
        if let Some(process) = &mut self.process {
            process.ended(FAREWELL);
        }
        self.stream.close();
    }
}

/// A message of the plant's own, as one line.
fn refused(message: &str) -> PlantError {
    PlantError::Refused(one_line(message))
}

fn one_line(text: &str) -> String {
    let text: Vec<_> = text.split_whitespace().collect();
    shortened(&text.join(" "), 300)
}

fn shortened(text: &str, letters: usize) -> String {
    match text.char_indices().nth(letters) {
        Some((end, _)) => format!("{} ...", &text[..end]),
        None => text.into(),
    }
}

/// Why a line cannot be read. JSON has no words for what is not finite, but many writers do.
fn nonsense(line: &[u8], error: &serde_json::Error) -> PlantError {
    let text = String::from_utf8_lossy(line);
    let word = ["NaN", "Infinity", "nan", "inf"]
        .into_iter()
        .find(|word| text.split(|c: char| !c.is_ascii_alphanumeric() && c != '"').any(|piece| piece == *word));
    if let Some(word) = word {
        return PlantError::NotFinite(word.into());
    }
    if error.to_string().starts_with("number out of range") {
        return PlantError::NotFinite("a number out of range".into());
    }
    PlantError::Nonsense(format!("{error} in {:?}", shortened(&text, 80)))
}

fn spawn(words: &[String]) -> io::Result<(UnixStream, Process)> {
    let (near, far) = UnixStream::pair()?;
    let complaints = tempfile::tempfile()?;
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]).process_group(0);
    command.stdin(Stdio::from(std::os::fd::OwnedFd::from(far.try_clone()?)));
    command.stdout(Stdio::from(std::os::fd::OwnedFd::from(far)));
    command.stderr(Stdio::from(complaints.try_clone()?));
    die_with_parent(&mut command);
    let child = command.spawn()?;
    Ok((near, Process { child, complaints }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size { modules: 1, links: 2 };
    const HELLO: &str =
        r#"{"type":"hello","protocol":"composer-plant","version":1,"modules":1,"links":2,"name":"stub"}"#;
    const LINK: &str = r#"{"position":[0,0,0.4],"rotation":[0,0,0,1],"linear":[0,0,0],"angular":[0,0,0]}"#;

    fn state(angle: &str) -> String {
        format!(
            r#"{{"type":"state","links":[{LINK},{LINK}],"joint_angles":[{angle}],"joint_speeds":[0],"block":null,"imu":[{{"up":[0,0,1],"rate":[0,0,0]}}]}}"#
        )
    }

    /// A shell that answers the n-th line with the n-th of these lines, then does what `end` says.
    fn stub(lines: &[&str], end: &str) -> Address {
        let answers: String = lines.iter().map(|line| format!("read -r q; printf '%s\\n' '{line}'\n")).collect();
        Address::Command(vec!["sh".into(), "-c".into(), format!("{answers}{end}")])
    }

    fn reset() -> Reset<()> {
        Reset { robot: (), scene: SceneSetup::default(), seed: 1, mjcf: String::new() }
    }

    /// Greets, resets and steps once; the state of the step.
    fn drive(address: &Address, patience: Duration) -> Result<State, PlantError> {
        let mut plant = ExternalPlant::start(address, SIZE, patience)?;
        plant.reset(&reset())?;
        plant.step(0.01, &[[1.0, -2.0]])
    }

    fn complaint(address: &Address) -> String {
        let start = Instant::now();
        let text = drive(address, Duration::from_millis(700)).unwrap_err().to_string();
        assert!(start.elapsed() < Duration::from_secs(8), "{text} took {:?}", start.elapsed());
        assert_eq!(text.lines().count(), 1, "{text}");
        text
    }

    #[test]
    fn a_plant_that_does_as_it_should_is_understood() {
        let (first, second) = (state("0.25"), state("-1.5e-1"));
        let state = drive(&stub(&[HELLO, &first, &second], "read -r q"), PATIENCE).unwrap();
        assert_eq!(state.mirror.joint_angles, [-0.15]);
        assert_eq!(state.mirror.links[1].position, [0.0, 0.0, 0.4]);
        assert_eq!((state.mirror.block, state.imu.unwrap()[0].up), (None, [0.0, 0.0, 1.0]));
    }

    #[test]
    fn every_way_to_fail_is_one_sentence() {
        let good = state("0");
        let contains = |address: Address, words: &[&str]| {
            let text = complaint(&address);
            assert!(words.iter().all(|word| text.contains(word)), "{text:?} does not say {words:?}");
        };
        contains(
            Address::Command(vec!["/no/such/plant".into()]),
            &["/no/such/plant cannot be started", "no such program"],
        );
        contains(Address::Command(vec!["/".into()]), &["/ cannot be started"]);
        contains(stub(&[], "echo 'out of luck' >&2; exit 3"), &["died", "exit status: 3", "out of luck"]);
        contains(stub(&[HELLO, &good], "read -r q; kill -9 $$"), &["died", "signal: 9"]);
        contains(stub(&["good morning"], "sleep 9"), &["nonsense", "good morning"]);
        contains(stub(&["{}"], "sleep 9"), &["nonsense", "type"]);
        contains(stub(&[&good], "sleep 9"), &["nonsense", "hello"]);
        contains(stub(&[HELLO, HELLO], "sleep 9"), &["nonsense", "hello"]);
        contains(stub(&["", ""], "sleep 9"), &["nonsense"]);
        contains(stub(&[], "sleep 9"), &["not answered for 0.7 s"]);
        contains(stub(&[HELLO, &good], "sleep 9"), &["not answered for 0.7 s"]);
        // One byte after another does not put the end off.
        contains(stub(&[HELLO], "while :; do printf x; sleep 0.1; done"), &["not answered for 0.7 s"]);
        contains(stub(&[&HELLO.replace("\"version\":1", "\"version\":7")], "sleep 9"), &["version 7", "version 1"]);
        contains(stub(&[&HELLO.replace("composer-plant", "other")], "sleep 9"), &["other"]);
        contains(
            stub(&[&HELLO.replace("\"modules\":1,\"links\":2", "\"modules\":9,\"links\":36")], "sleep 9"),
            &["9 modules", "1 modules"],
        );
        for bad in ["NaN", "-Infinity", "1e400", "1e39"] {
            contains(stub(&[HELLO, &good, &state(bad)], "sleep 9"), &["not finite"]);
        }
        contains(stub(&[HELLO, &state("0,0")], "sleep 9"), &["nonsense", "2 joint_angles instead of 1"]);
        contains(stub(&[HELLO, &good.replace("[0,0,0,1]", "[0,0,0,2]")], "sleep 9"), &["nonsense", "quaternion"]);
        contains(stub(&[HELLO, &good.replace("null", LINK)], "sleep 9"), &["block"]);
        contains(
            stub(&[HELLO, r#"{"type":"error","message":"no such\nmodel"}"#], "sleep 9"),
            &["refuses", "no such model"],
        );
    }

    #[test]
    fn nothing_is_left_running() {
        // A plant that ignores goodbye and a hang-up, with a child of its own.
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pids");
        let end =
            format!("trap '' HUP TERM; sleep 1000 & echo $$ $! > {0}.new; mv {0}.new {0}; sleep 1000", file.display());
        let plant = ExternalPlant::start(&stub(&[HELLO], &end), SIZE, PATIENCE).unwrap();
        let start = Instant::now();
        while !file.exists() {
            assert!(start.elapsed() < PATIENCE);
            std::thread::sleep(Duration::from_millis(5));
        }
        let numbers = std::fs::read_to_string(file).unwrap();
        drop(plant);
        let runs = |number: &str| {
            let pid = rustix::process::Pid::from_raw(number.parse().unwrap()).unwrap();
            rustix::process::test_kill_process(pid).is_ok() && !is_zombie(number)
        };
        let start = Instant::now();
        while numbers.split_whitespace().any(runs) {
            assert!(start.elapsed() < PATIENCE, "{numbers} still run");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waiting for whoever adopted it to notice its end.
    fn is_zombie(number: &str) -> bool {
        std::fs::read_to_string(format!("/proc/{number}/stat")).is_ok_and(|stat| stat.contains(") Z "))
    }

    #[test]
    fn a_server_is_reached_and_its_absence_said() {
        let server = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address: Address = format!("tcp:localhost:{}", server.local_addr().unwrap().port()).parse().unwrap();
        let serving = std::thread::spawn(move || {
            let (mut stream, _) = server.accept().unwrap();
            let mut heard = Vec::new();
            for answer in [HELLO, &state("0.5"), &state("0.75")] {
                let mut buffer = [0; 4096];
                let length = stream.read(&mut buffer).unwrap();
                heard.push(String::from_utf8_lossy(&buffer[..length]).into_owned());
                stream.write_all(format!("{answer}\n").as_bytes()).unwrap();
            }
            let mut rest = String::new();
            stream.read_to_string(&mut rest).unwrap();
            heard.push(rest);
            heard
        });
        let state = drive(&address, PATIENCE).unwrap();
        assert_eq!(state.mirror.joint_angles, [0.75]);
        let heard = serving.join().unwrap();
        assert_eq!(
            heard[0],
            "{\"type\":\"hello\",\"protocol\":\"composer-plant\",\"version\":1,\"modules\":1,\"links\":2}\n"
        );
        assert!(
            heard[1]
                .starts_with("{\"type\":\"reset\",\"robot\":null,\"scene\":{\"solids\":[],\"block\":null},\"seed\":1")
        );
        assert_eq!(heard[2], "{\"type\":\"step\",\"dt\":0.01,\"torques\":[[1.0,-2.0]]}\n");
        assert_eq!(heard[3], "{\"type\":\"bye\"}\n");
        // The server is gone.
        assert!(complaint(&address).contains("nobody listens"));
    }

    #[test]
    fn addresses_are_read() {
        let read = |text: &str| text.parse::<Address>();
        let command = |words: &[&str]| Ok(Address::Command(words.iter().map(|w| w.to_string()).collect()));
        assert_eq!(read("plant --fast"), command(&["plant", "--fast"]));
        assert_eq!(read(r#"a 'b c' "d \"e" f\ g '' "#), command(&["a", "b c", "d \"e", "f g", ""]));
        assert_eq!(read("tcp:127.0.0.1:80"), Ok(Address::Tcp(([127, 0, 0, 1], 80).into())));
        for bad in ["", "  ", "'a", "a\\", "tcp:", "tcp:127.0.0.1", "tcp:10.0.0.1:80"] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }
}
