//! Commands to a simulated robot that runs: faults that begin and are mended, the station's orders, a goal that moves. One line a command, over loopback
//! TCP, and one line in answer: `ok at 12.345 s` by the robot's time, or `refused: ` and a sentence. Whatever is refused changes nothing, and the run goes on.
//!
//! | command | what happens |
//! |---|---|
//! | `unplug M`, `plug M` | module M loses its power and leaves the bus; it gets it back |
//! | `brownout M [TIME]` | its supply breaks in, for 10 ms if no time is given |
//! | `cut M`, `mend M` | the cable behind module M breaks; it is whole again |
//! | `sensor M zero`, `stuck`, `good` | the sensors of module M read zero, keep their last reading, work |
//! | `actuator M dead`, `good` | its motors do nothing, work |
//! | `drop P`, `corrupt P`, `duplicate P` | frames are lost at a receiver, broken on the wire, sent twice, with probability P; 0 ends it |
//! | `delay TIME` | receivers see frames up to TIME later; `0ms` ends it |
//! | `misread M P` | module M misreads frames with probability P; 0 ends it |
//! | `babble M [ID]`, `quiet M` | module M floods the bus with frames of this identifier (0x0FF); it is quiet again |
//! | `stop`, `release` | the station stops the robot, releases it |
//! | `goal X Y` | the goal moves there, robot units, the world's frame |
//! | `help` | says what there is |
//!
//! Modules are numbered from 0 at the head. Times have a unit: `s`, `ms` or `us`.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};

use composer_shared::wire::StopCommand;

use crate::faults::{BABBLE_ID, BROWN_OUT_NS, Fault, parse_time};
use crate::sil::{Change, Refusal};

/// Most bytes of a command.
pub const LONGEST: usize = 200;
/// Most programs that are connected at once.
const CLIENTS: usize = 16;
/// Bytes of answers that are kept for a program that does not read them; then it is shut out.
const UNREAD: usize = 1 << 16;

/// What there is, in one line.
pub const HELP: &str = "unplug M, plug M, brownout M [TIME], cut M, mend M, sensor M zero|stuck|good, actuator M dead|good, drop P, corrupt P, duplicate P, \
                        delay TIME, misread M P, babble M [ID], quiet M, stop, release, goal X Y";

/// What is wrong with a command.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// No such word.
    #[error("there is no command `{0}`: there are {HELP}")]
    Unknown(String),
    /// What follows the word is not what belongs there.
    #[error("`{0}` is not how it is written: {1}")]
    Form(String, &'static str),
    /// Too long to be one.
    #[error("a command has at most {LONGEST} bytes")]
    Long,
    /// Not text.
    #[error("a command is text")]
    Text,
}

/// A command.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// These changes; at least one of them has to be possible.
    Change(Vec<Change>),
    /// What is there to say?
    Help,
}

fn form(words: &[&str]) -> Option<&'static str> {
    Some(match *words.first()? {
        "unplug" => "unplug M",
        "plug" => "plug M",
        "brownout" => "brownout M [TIME], such as brownout 3 10ms",
        "cut" => "cut M",
        "mend" => "mend M",
        "sensor" => "sensor M zero, sensor M stuck, or sensor M good",
        "actuator" => "actuator M dead, or actuator M good",
        "drop" => "drop P, such as drop 0.05",
        "corrupt" => "corrupt P, such as corrupt 0.01",
        "duplicate" => "duplicate P, such as duplicate 0.1",
        "delay" => "delay TIME, such as delay 2ms",
        "misread" => "misread M P, such as misread 3 0.1",
        "babble" => "babble M [ID], such as babble 3 0x0FF",
        "quiet" => "quiet M",
        "stop" => "stop",
        "release" => "release",
        "goal" => "goal X Y, such as goal 12 -3.5",
        "help" => "help",
        _ => return None,
    })
}

/// Reads a command.
///
/// # Errors
///
/// What is wrong with it.
pub fn parse(line: &str) -> Result<Command, CommandError> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let Some(form) = form(&words) else { return Err(CommandError::Unknown(words.first().unwrap_or(&"").to_string())) };
    read(&words).ok_or_else(|| CommandError::Form(words.join(" "), form))
}

fn read(words: &[&str]) -> Option<Command> {
    let module = |text: &str| text.parse::<usize>().ok();
    let probability = |text: &str| text.parse::<f64>().ok().filter(|p| p.is_finite());
    let begin = |fault| vec![Change::Begin(fault, None)];
    // A disturbance of no strength is none.
    let strong = |fault, strength: f64| if strength == 0.0 { vec![Change::End(fault)] } else { begin(fault) };
    Some(Command::Change(match *words {
        ["help"] => return Some(Command::Help),
        ["unplug", m] => begin(Fault::Unplug(module(m)?)),
        ["plug", m] => vec![Change::End(Fault::Unplug(module(m)?)), Change::End(Fault::BrownOut(module(m)?))],
        ["brownout", m] => vec![Change::Begin(Fault::BrownOut(module(m)?), Some(BROWN_OUT_NS))],
        ["brownout", m, time] => vec![Change::Begin(Fault::BrownOut(module(m)?), Some(parse_time(time).ok()?))],
        ["cut", m] => begin(Fault::Cut(module(m)?)),
        ["mend", m] => vec![Change::End(Fault::Cut(module(m)?))],
        ["sensor", m, "zero"] => begin(Fault::SensorZeroed(module(m)?)),
        ["sensor", m, "stuck"] => begin(Fault::SensorStuck(module(m)?)),
        ["sensor", m, "good"] => {
            vec![Change::End(Fault::SensorZeroed(module(m)?)), Change::End(Fault::SensorStuck(module(m)?))]
        }
        ["actuator", m, "dead"] => begin(Fault::ActuatorDead(module(m)?)),
        ["actuator", m, "good"] => vec![Change::End(Fault::ActuatorDead(module(m)?))],
        ["drop", p] => strong(Fault::Drop(probability(p)?), probability(p)?),
        ["corrupt", p] => strong(Fault::Corrupt(probability(p)?), probability(p)?),
        ["duplicate", p] => strong(Fault::Duplicate(probability(p)?), probability(p)?),
        ["delay", time] => strong(Fault::Delay(parse_time(time).ok()?), parse_time(time).ok()? as f64),
        ["misread", m, p] => strong(Fault::Misread(module(m)?, probability(p)?), probability(p)?),
        ["babble", m] => begin(Fault::Babble(module(m)?, BABBLE_ID)),
        ["babble", m, id] => begin(Fault::Babble(module(m)?, identifier(id)?)),
        ["quiet", m] => vec![Change::End(Fault::Babble(module(m)?, BABBLE_ID))],
        ["stop"] => vec![Change::Order(StopCommand::Stop)],
        ["release"] => vec![Change::Order(StopCommand::Release)],
        ["goal", x, y] => vec![Change::Goal([x.parse().ok()?, y.parse().ok()?, 0.0])],
        _ => return None,
    }))
}

fn identifier(text: &str) -> Option<u16> {
    match text.strip_prefix("0x") {
        Some(digits) => u16::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

/// Why nobody can connect.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// Others than this machine could.
    #[error(
        "{0} is not on this machine: whoever can connect may break the robot, so the address is 127.0.0.1:PORT, or [::1]:PORT"
    )]
    NotLoopback(SocketAddr),
    /// The system refuses.
    #[error("nobody can connect to {address}: {error}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why.
        error: io::Error,
    },
}

/// Somebody who is connected.
#[derive(Debug)]
struct Client {
    number: u64,
    stream: TcpStream,
    line: Vec<u8>,
    out: VecDeque<u8>,
    /// It has sent all it had to say.
    ended: bool,
}

impl Client {
    fn answer(&mut self, text: &str) {
        self.out.extend(text.as_bytes());
        self.out.push_back(b'\n');
    }
}

/// Programs that command a run.
#[derive(Debug)]
pub struct Control {
    listener: TcpListener,
    address: SocketAddr,
    clients: Vec<Client>,
    numbers: u64,
    /// Commands that wait, with the number of their client.
    waiting: VecDeque<(u64, VecDeque<Change>)>,
    /// The refusal of the command that is carried out, if nothing of it has been possible so far.
    outcome: Option<Result<(), Refusal>>,
}

impl Control {
    /// Listens at an address of this machine; port 0 is any that is free.
    ///
    /// # Errors
    ///
    /// If that is not possible.
    pub fn listen(address: SocketAddr) -> Result<Self, ControlError> {
        if !address.ip().is_loopback() {
            return Err(ControlError::NotLoopback(address));
        }
        let failed = |error| ControlError::Listen { address, error };
        let listener = TcpListener::bind(address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let (clients, waiting) = (Vec::new(), VecDeque::new());
        Ok(Control { listener, address, clients, numbers: 0, waiting, outcome: None })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Whoever is worth waiting for.
    #[cfg(unix)]
    pub(crate) fn sources(&self) -> impl Iterator<Item = (std::os::fd::BorrowedFd<'_>, bool)> {
        use std::os::fd::AsFd;
        let clients = self.clients.iter().filter(|client| !client.ended || !client.out.is_empty());
        let clients = clients.map(|client| (client.stream.as_fd(), !client.out.is_empty()));
        clients.chain([(self.listener.as_fd(), false)])
    }

    /// The next change that somebody asks for. Each is to be followed by [`Control::changed`].
    pub fn asked(&mut self) -> Option<Change> {
        self.accept();
        for client in &mut self.clients {
            let obeyed = read_lines(client);
            self.waiting.extend(obeyed.into_iter().map(|changes| (client.number, changes.into())));
        }
        self.clients.retain_mut(write);
        self.waiting.front_mut().and_then(|(_, changes)| changes.pop_front())
    }

    /// What became of that change, at `now` (ns).
    pub fn changed(&mut self, now: u64, outcome: Result<(), Refusal>) {
        let outcome = match self.outcome.take() {
            Some(before) => before.or(outcome),
            None => outcome,
        };
        let Some((number, left)) = self.waiting.front() else { return };
        if !left.is_empty() {
            self.outcome = Some(outcome);
            return;
        }
        if let Some(client) = self.clients.iter_mut().find(|client| client.number == *number) {
            client.answer(&match outcome {
                Ok(()) => format!("ok at {:.3} s", now as f64 * 1e-9),
                Err(refusal) => format!("refused: {refusal}"),
            });
            write(client);
        }
        self.waiting.pop_front();
    }

    fn accept(&mut self) {
        while let Ok((mut stream, _)) = self.listener.accept() {
            if self.clients.len() == CLIENTS {
                let _ = writeln!(stream, "refused: {CLIENTS} programs are connected already");
            } else if stream.set_nonblocking(true).is_ok() && stream.set_nodelay(true).is_ok() {
                self.numbers += 1;
                let (line, out) = (Vec::new(), VecDeque::new());
                self.clients.push(Client { number: self.numbers, stream, line, out, ended: false });
            }
        }
    }
}

/// The changes that a client asks for; what makes no sense is answered at once.
fn read_lines(client: &mut Client) -> Vec<Vec<Change>> {
    let mut commands = Vec::new();
    let mut buffer = [0; 1024];
    while !client.ended {
        match client.stream.read(&mut buffer) {
            Ok(0) => client.ended = true,
            Ok(length) => {
                for byte in &buffer[..length] {
                    if *byte != b'\n' {
                        // One byte too many is enough to know that it is too long.
                        if client.line.len() <= LONGEST {
                            client.line.push(*byte);
                        }
                        continue;
                    }
                    let line = std::mem::take(&mut client.line);
                    match obey(&line) {
                        Ok(Command::Change(changes)) => commands.push(changes),
                        Ok(Command::Help) => client.answer(HELP),
                        Err(error) => client.answer(&format!("refused: {error}")),
                    }
                }
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(_) => client.ended = true,
        }
    }
    commands
}

/// The command of a line.
fn obey(line: &[u8]) -> Result<Command, CommandError> {
    if line.len() > LONGEST {
        return Err(CommandError::Long);
    }
    parse(std::str::from_utf8(line).map_err(|_| CommandError::Text)?)
}

/// Writes what a client takes; whether it is still there.
fn write(client: &mut Client) -> bool {
    while !client.out.is_empty() {
        match client.stream.write(client.out.as_slices().0) {
            Ok(0) => return false,
            Ok(length) => drop(client.out.drain(..length)),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return client.out.len() <= UNREAD,
            Err(_) => return false,
        }
    }
    // One that has hung up gets the answers to what it asked last, as far as it takes them.
    !client.ended
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader};

    fn changes(line: &str) -> Vec<Change> {
        match parse(line) {
            Ok(Command::Change(changes)) => changes,
            other => panic!("{line}: {other:?}"),
        }
    }

    #[test]
    fn commands_are_read() {
        for (line, expected) in [
            ("unplug 3", vec![Change::Begin(Fault::Unplug(3), None)]),
            (" brownout  2 ", vec![Change::Begin(Fault::BrownOut(2), Some(BROWN_OUT_NS))]),
            ("brownout 2 1.5s\r", vec![Change::Begin(Fault::BrownOut(2), Some(1_500_000_000))]),
            ("drop 0.25", vec![Change::Begin(Fault::Drop(0.25), None)]),
            ("drop 0", vec![Change::End(Fault::Drop(0.0))]),
            ("delay 0ms", vec![Change::End(Fault::Delay(0))]),
            ("misread 1 0", vec![Change::End(Fault::Misread(1, 0.0))]),
            ("babble 1 0x7F", vec![Change::Begin(Fault::Babble(1, 0x7f), None)]),
            ("release", vec![Change::Order(StopCommand::Release)]),
            ("goal 3 -4.5", vec![Change::Goal([3.0, -4.5, 0.0])]),
        ] {
            assert_eq!(changes(line), expected, "{line}");
        }
        assert_eq!(changes("sensor 1 good").len(), 2);
        assert_eq!(parse("help"), Ok(Command::Help));
        // Every word that is offered has its form, and the form names it.
        for word in HELP.split(", ").map(|command| command.split(' ').next().unwrap()) {
            assert!(form(&[word]).unwrap().starts_with(word));
        }
    }

    #[test]
    fn nonsense_gets_its_sentence() {
        for (line, sentence) in [
            ("", "there is no command ``: there are unplug M"),
            ("explode 3", "there is no command `explode`"),
            ("unplug", "`unplug` is not how it is written: unplug M"),
            ("unplug -1", "`unplug -1` is not how it is written: unplug M"),
            ("unplug 1 2", "`unplug 1 2` is not how it is written: unplug M"),
            ("drop lots", "`drop lots` is not how it is written: drop P, such as drop 0.05"),
            ("drop NaN", "`drop NaN` is not"),
            ("delay 2", "`delay 2` is not how it is written: delay TIME, such as delay 2ms"),
            ("sensor 1 blind", "`sensor 1 blind` is not how it is written: sensor M zero, sensor M stuck"),
            ("babble 1 0xZZ", "`babble 1 0xZZ` is not"),
            ("goal here", "`goal here` is not how it is written: goal X Y"),
        ] {
            let error = parse(line).unwrap_err().to_string();
            assert!(error.starts_with(sentence), "{error}");
        }
    }

    #[test]
    fn two_programs_are_answered_each_its_own() {
        let mut control = Control::listen("127.0.0.1:0".parse().unwrap()).unwrap();
        let connect = || {
            let stream = TcpStream::connect(control.address()).unwrap();
            (stream.try_clone().unwrap(), BufReader::new(stream).lines())
        };
        let ((mut one, mut its), (mut two, mut theirs)) = (connect(), connect());
        one.write_all(b"unplug 3\nplug 4\nnonsense\n").unwrap();
        let next = |control: &mut Control| loop {
            if let Some(change) = control.asked() {
                return change;
            }
        };
        assert_eq!(next(&mut control), Change::Begin(Fault::Unplug(3), None));
        control.changed(1_500_000_000, Ok(()));
        assert_eq!(next(&mut control), Change::End(Fault::Unplug(4)));
        control.changed(0, Err(Refusal::NotSo(Fault::Unplug(4))));
        assert_eq!(next(&mut control), Change::End(Fault::BrownOut(4)));
        control.changed(0, Err(Refusal::NotSo(Fault::BrownOut(4))));
        two.write_all(&[b'x'; LONGEST + 50]).unwrap();
        two.write_all(b"\n\xff\xfe\nsensor 2 good\nstop").unwrap();
        assert_eq!(next(&mut control), Change::End(Fault::SensorZeroed(2)));
        control.changed(0, Err(Refusal::NotSo(Fault::SensorZeroed(2))));
        assert_eq!(next(&mut control), Change::End(Fault::SensorStuck(2)));
        control.changed(2_000_000, Ok(()));
        let line = |lines: &mut dyn Iterator<Item = io::Result<String>>| lines.next().unwrap().unwrap();
        assert_eq!(line(&mut its), "refused: there is no command `nonsense`: there are ".to_string() + HELP);
        assert_eq!(line(&mut its), "ok at 1.500 s");
        assert_eq!(line(&mut its), "refused: not so: module 4 is plugged in");
        assert_eq!(line(&mut theirs), "refused: a command has at most 200 bytes");
        assert_eq!(line(&mut theirs), "refused: a command is text");
        assert_eq!(line(&mut theirs), "ok at 0.002 s");
        // Without the end of its line it is no command.
        assert_eq!(control.asked(), None);
        // Whoever hangs up before the answer is not waited for.
        one.write_all(b"stop\n").unwrap();
        drop((one, its));
        assert_eq!(next(&mut control), Change::Order(StopCommand::Stop));
        control.changed(0, Ok(()));
        assert_eq!(control.asked(), None);
    }

    #[test]
    fn only_this_machine_may_connect() {
        let error = Control::listen("0.0.0.0:0".parse().unwrap()).unwrap_err().to_string();
        assert!(error.starts_with("0.0.0.0:0 is not on this machine"), "{error}");
        let first = Control::listen("127.0.0.1:0".parse().unwrap()).unwrap();
        let error = Control::listen(first.address()).unwrap_err().to_string();
        assert!(error.starts_with("nobody can connect to 127.0.0.1:"), "{error}");
    }
}
