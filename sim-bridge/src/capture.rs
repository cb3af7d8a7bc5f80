//! Runs written down: the frames on the bus, one run after the other, as a log for other programs, and beside it what every module's computer was told
//! and what it answered, so that one of them can be run again alone ([`crate::replay`]).
//!
//! # The log
//!
//! A [candump] log, or a [pcap] file. The first run begins at time 0, and each further one at the first whole second that lies at least a second
//! after the last frame before.
//!
//! # The transcript
//!
//! A log of the bus alone does not say what a module's sensors read, nor when a frame reached its computer (a receiver may lose it, or be busy). The
//! transcript says that. It is a text file; each line is one JSON object of one of these forms:
//!
//! | line | what it says |
//! |---|---|
//! | `{"transcript":1,"policy":"goal-reaching","crc32":"89abcdef","modules":8}` | the first line: version of this format, the policy as it was asked for, the checksum in its image, the length of the robot |
//! | `{"run":0,"from_us":0}` | a run begins; its times are so much later in the log |
//! | `{"computer":3,"node":3,"start":"0001..."}` | the computer of a node is switched on: the [`Start`](composer_firmware::link::ToModule::Start) of the [link], in hexadecimal. A node that is plugged in again gets another computer |
//! | `{"computer":3,"now":150200,"bus":0,"room":3,"line":17,...}` | it is polled, and answers |
//! | `{"computer":3,"interrupt":"000#...","off":true}` | something interrupts it between two polls: a frame, or, if that is null, its stop input; whether its motors coast from then on, and what it `tells` at once, if anything |
//!
//! A poll has `now`, the computer's clock in us; `bus`, 0 if its CAN controller is error active, 1 passive, 2 bus-off; `room`, frames that fit in its CAN port; `line`, the line of the log
//! that it receives (from 1), or `told`, a frame that is not in the log, in candump's form; `sensors`, if they read something else than in its last poll: joint
//! angles, joint speeds, up, angular rate, torque, temperature as in [`Sensors`], eight hexadecimal digits each, the bits of the number (IEEE 754, single precision), so that
//! nothing is rounded. The answer is `torque`, if it is another than in the last one (yaw, pitch, in the same way); `on`, whether the motors follow it;
//! `deadline`, when to poll again, us; `acted`, how often it has acted; `sent`, the frames that were then taken out of it: pairs of the room that there was and the frame, none
//! when it had no more.

use std::cell::RefCell;
use std::io::{self, Write};

use composer_firmware::controller::{Boot, BusStatus, Config, Micros};
use composer_firmware::link::{self, MESSAGE_MAX, ToModule};
use composer_firmware::torque_off::Interrupt;
use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::AXES;
use composer_shared::wire::Frame;
use serde::{Deserialize, Serialize};

use crate::candump;
use crate::computer::{Answer, Computer, Launcher, Poll, Status, Trouble};
use crate::pcap;
use crate::sil::{CycleView, Watch};

/// Version of the transcript.
pub const VERSION: u32 = 1;

/// Numbers in a sensor reading.
const READINGS: usize = 17;

/// The first line of a transcript.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heading {
    /// [`VERSION`].
    pub transcript: u32,
    /// The policy, as it was asked for.
    pub policy: String,
    /// The checksum in its image, in hexadecimal.
    pub crc32: String,
    /// Modules of the robot.
    pub modules: usize,
}

impl Heading {
    /// Of runs with this policy.
    pub fn new(name: &str, policy: &Policy<'_>, modules: usize) -> Self {
        Heading { transcript: VERSION, policy: name.into(), crc32: format!("{:08x}", policy.crc()), modules }
    }
}

/// A run begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Begun {
    pub run: u64,
    pub from_us: u64,
}

/// A computer is switched on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Started {
    pub computer: u64,
    pub node: u8,
    pub start: String,
}

/// A computer is polled, and answers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Polled {
    pub computer: u64,
    pub now: Micros,
    pub bus: u8,
    pub room: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub line: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub told: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub torque: Option<String>,
    pub on: bool,
    pub deadline: Micros,
    pub acted: u32,
    pub sent: Vec<(usize, Option<String>)>,
}

/// Something interrupts a computer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Interrupted {
    pub computer: u64,
    #[serde(deserialize_with = "Option::deserialize")]
    pub interrupt: Option<String>,
    pub off: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tells: Option<String>,
}

/// A line of a transcript, but for the first.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(untagged)]
pub(crate) enum Record {
    Begun(Begun),
    Started(Started),
    Interrupted(Interrupted),
    Polled(Polled),
}

/// The numbers of a sensor reading.
fn numbers(sensors: &Sensors) -> [f32; READINGS] {
    let Sensors { joint_angles: a, joint_speeds: s, up, angular_rate: r, torque: t, temperature } = *sensors;
    [a[0], a[1], a[2], a[3], s[0], s[1], s[2], s[3], up[0], up[1], up[2], r[0], r[1], r[2], t[0], t[1], temperature]
}

fn reading(n: [f32; READINGS]) -> Sensors {
    Sensors {
        joint_angles: [n[0], n[1], n[2], n[3]],
        joint_speeds: [n[4], n[5], n[6], n[7]],
        up: [n[8], n[9], n[10]],
        angular_rate: [n[11], n[12], n[13]],
        torque: [n[14], n[15]],
        temperature: n[16],
    }
}

fn bits_to_hex(numbers: &[f32]) -> String {
    numbers.iter().map(|number| format!("{:08x}", number.to_bits())).collect()
}

fn hex_to_bits<const N: usize>(text: &str) -> Option<[f32; N]> {
    if text.len() != 8 * N || !text.is_ascii() {
        return None;
    }
    let mut numbers = [0.0; N];
    for (number, digits) in numbers.iter_mut().zip(text.as_bytes().chunks(8)) {
        *number = f32::from_bits(u32::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?);
    }
    Some(numbers)
}

pub(crate) fn sensors_from(text: &str) -> Option<Sensors> {
    hex_to_bits(text).map(reading)
}

pub(crate) fn torque_from(text: &str) -> Option<[f32; AXES]> {
    hex_to_bits(text)
}

pub(crate) fn frame_text(frame: &Frame) -> String {
    let mut line = Vec::new();
    // A vector takes everything, and everything in it is ASCII.
    let _ = candump::write_frame(&mut line, frame);
    String::from_utf8(line).unwrap_or_default()
}

pub(crate) fn bus_number(bus: BusStatus) -> u8 {
    match bus {
        BusStatus::ErrorActive => 0,
        BusStatus::ErrorPassive => 1,
        BusStatus::BusOff => 2,
    }
}

pub(crate) fn bus_from(number: u8) -> Option<BusStatus> {
    [BusStatus::ErrorActive, BusStatus::ErrorPassive, BusStatus::BusOff].get(usize::from(number)).copied()
}

/// What kind of file a log is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// See [`candump`].
    Candump,
    /// See [`pcap`].
    Pcap,
}

struct Inner<'w> {
    log: &'w mut dyn Write,
    format: Format,
    transcript: Option<&'w mut dyn Write>,
    runs: u64,
    /// What a time in this run is later in the log, ns.
    from_ns: u64,
    last_ns: u64,
    /// Lines in the log before this run.
    before: u64,
    /// Frames of this run, one a line, if there is a transcript.
    frames: Vec<Frame>,
    computers: u64,
    trouble: Option<io::Error>,
}

impl Inner<'_> {
    fn note(&mut self, record: &impl Serialize) {
        if let (Some(out), None) = (&mut self.transcript, &self.trouble) {
            let written = serde_json::to_writer(&mut *out, record).map_err(io::Error::from);
            self.trouble = written.and_then(|()| out.write_all(b"\n")).err();
        }
    }
}

/// Writes down runs, one after the other.
pub struct Capture<'w> {
    inner: RefCell<Inner<'w>>,
}

impl<'w> Capture<'w> {
    /// A log in this format.
    ///
    /// # Errors
    ///
    /// If its beginning cannot be written.
    pub fn new(log: &'w mut dyn Write, format: Format) -> io::Result<Self> {
        if format == Format::Pcap {
            pcap::write_heading(log)?;
        }
        let inner = Inner {
            log,
            format,
            transcript: None,
            runs: 0,
            from_ns: 0,
            last_ns: 0,
            before: 0,
            frames: Vec::new(),
            computers: 0,
            trouble: None,
        };
        Ok(Capture { inner: RefCell::new(inner) })
    }

    /// The same with a transcript beside it.
    pub fn with_transcript(self, out: &'w mut dyn Write, heading: &Heading) -> Self {
        let mut inner = self.inner.into_inner();
        inner.transcript = Some(out);
        inner.note(heading);
        Capture { inner: RefCell::new(inner) }
    }

    /// The next run begins.
    pub fn begin_run(&self) {
        const SECOND: u64 = 1_000_000_000;
        let mut inner = self.inner.borrow_mut();
        if inner.runs > 0 {
            inner.from_ns = (inner.last_ns + SECOND).next_multiple_of(SECOND);
        }
        inner.before += inner.frames.len() as u64;
        inner.frames.clear();
        let begun = Begun { run: inner.runs, from_us: inner.from_ns / 1000 };
        inner.runs += 1;
        inner.note(&begun);
    }

    /// Makes the computers that `launcher` starts be written down too, if there is a transcript.
    pub fn recording<'c, L>(&'c self, launcher: &'c L) -> Recording<'c, 'w, L> {
        Recording { launcher, capture: self }
    }

    /// The last run is over.
    ///
    /// # Errors
    ///
    /// If anything could not be written.
    pub fn finish(self) -> io::Result<()> {
        let mut inner = self.inner.into_inner();
        inner.log.flush()?;
        inner.transcript.as_mut().map_or(Ok(()), |out| out.flush())?;
        inner.trouble.map_or(Ok(()), Err)
    }

    fn frame(&self, at_ns: u64, piece: usize, frame: &Frame) -> io::Result<()> {
        let mut inner = self.inner.borrow_mut();
        let at_ns = inner.from_ns + at_ns;
        inner.last_ns = at_ns;
        if inner.transcript.is_some() {
            inner.frames.push(*frame);
        }
        match inner.format {
            Format::Candump => candump::write_entry(inner.log, at_ns, &candump::interface(piece), frame),
            Format::Pcap => pcap::write_frame(inner.log, at_ns, frame),
        }
    }
}

impl<P: ?Sized> Watch<P> for &Capture<'_> {
    fn frame(&mut self, at_ns: u64, piece: usize, frame: &Frame) -> io::Result<()> {
        Capture::frame(self, at_ns, piece, frame)
    }

    fn cycle(&mut self, _: &CycleView<'_>, _: &P) -> io::Result<()> {
        self.inner.borrow_mut().trouble.take().map_or(Ok(()), Err)
    }
}

/// A [`Launcher`] whose computers are written down. See [`Capture::recording`].
pub struct Recording<'c, 'w, L> {
    launcher: &'c L,
    capture: &'c Capture<'w>,
}

impl<'c, 'w, L: Launcher> Launcher for Recording<'c, 'w, L> {
    type Computer = Recorded<'c, 'w, L::Computer>;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Self::Computer, Trouble> {
        let computer = self.launcher.start(config, boot, now)?;
        let mut inner = self.capture.inner.borrow_mut();
        let number = inner.computers;
        inner.computers += 1;
        let mut buffer = [0; MESSAGE_MAX];
        let start = link::encode(&ToModule::Start { config, boot, now }, &mut buffer);
        let start = start.iter().map(|byte| format!("{byte:02x}")).collect();
        inner.note(&Started { computer: number, node: config.node, start });
        let next = inner.frames.len();
        Ok(Recorded { computer, capture: self.capture, number, next, sensors: None, torque: None, pending: None })
    }
}

/// A computer that is written down.
pub struct Recorded<'c, 'w, C> {
    computer: C,
    capture: &'c Capture<'w>,
    number: u64,
    /// The first frame of this run that it may receive next.
    next: usize,
    sensors: Option<[u32; READINGS]>,
    torque: Option<[u32; AXES]>,
    /// The poll that may yet be asked for frames.
    pending: Option<Polled>,
}

impl<C> Recorded<'_, '_, C> {
    fn flush(&mut self) {
        if let Some(polled) = self.pending.take() {
            self.capture.inner.borrow_mut().note(&polled);
        }
    }

    /// The line of a frame that is received, as it comes in order of time.
    fn line(&mut self, frame: &Frame) -> Option<u64> {
        let inner = self.capture.inner.borrow();
        let from = |from: usize| inner.frames.get(from..)?.iter().position(|f| f == frame).map(|index| from + index);
        // Late frames of before it was plugged in are looked for from the beginning.
        let index = from(self.next).or_else(|| from(0))?;
        self.next = self.next.max(index + 1);
        Some(inner.before + index as u64 + 1)
    }
}

impl<C> Drop for Recorded<'_, '_, C> {
    fn drop(&mut self) {
        self.flush();
    }
}

impl<C: Computer> Computer for Recorded<'_, '_, C> {
    fn ask_poll(&mut self, poll: &Poll<'_>) -> Result<(), Trouble> {
        self.flush();
        let line = poll.frame.and_then(|frame| self.line(frame));
        let told = poll.frame.filter(|_| line.is_none()).map(frame_text);
        let read = numbers(poll.sensors).map(f32::to_bits);
        let sensors = (self.sensors != Some(read)).then(|| bits_to_hex(&numbers(poll.sensors)));
        self.sensors = Some(read);
        let (bus, computer) = (bus_number(poll.bus), self.number);
        let polled = Polled { computer, now: poll.now, bus, room: poll.room, line, told, sensors, ..Polled::default() };
        self.pending = Some(polled);
        self.computer.ask_poll(poll)
    }

    fn answer(&mut self) -> Result<Answer, Trouble> {
        let answer = self.computer.answer()?;
        if let Some(polled) = &mut self.pending {
            let bits = answer.outputs.torque.map(f32::to_bits);
            polled.torque = (self.torque != Some(bits)).then(|| bits_to_hex(&answer.outputs.torque));
            self.torque = Some(bits);
            polled.on = answer.outputs.motors_enabled;
            polled.deadline = answer.outputs.deadline;
            polled.acted = answer.acted;
        }
        Ok(answer)
    }

    fn next_frame(&mut self, room: usize) -> Result<Option<Frame>, Trouble> {
        let frame = self.computer.next_frame(room)?;
        if let Some(polled) = &mut self.pending {
            polled.sent.push((room, frame.as_ref().map(frame_text)));
        }
        Ok(frame)
    }

    fn interrupt(&mut self, interrupt: Interrupt<'_>) -> Result<(bool, Option<Frame>), Trouble> {
        self.flush();
        let (off, tells) = self.computer.interrupt(interrupt)?;
        let interrupt = match interrupt {
            Interrupt::Frame(frame) => Some(frame_text(frame)),
            Interrupt::StopInput => None,
        };
        let record = Interrupted { computer: self.number, interrupt, off, tells: tells.as_ref().map(frame_text) };
        self.capture.inner.borrow_mut().note(&record);
        Ok((off, tells))
    }

    fn ask_status(&mut self) -> Result<(), Trouble> {
        self.computer.ask_status()
    }

    fn await_status(&mut self) -> Result<(), Trouble> {
        self.computer.await_status()
    }

    fn status(&self) -> Status<'_> {
        self.computer.status()
    }
}
