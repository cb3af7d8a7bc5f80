//! Runs one module's computer again on what was written down of it ([`crate::capture`]), and says whether it does the same: every torque, every frame, bit
//! for bit.

use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::io::{self, BufRead};

use composer_firmware::link::{self, Receiver, ToModule};
use composer_firmware::torque_off::Interrupt;
use composer_shared::observation::Sensors;
use composer_shared::robot::AXES;

use crate::candump::{Log, parse_frame};
use crate::capture::{Heading, Polled, Record, Started, VERSION, bus_from, frame_text, sensors_from, torque_from};
use crate::computer::{Computer, Launcher, Poll, Trouble};

/// Why there is nothing to compare.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// It cannot be read.
    #[error("the transcript cannot be read: {0}")]
    Read(#[from] io::Error),
    /// It does not begin as one does.
    #[error("this is no transcript of version {VERSION}: its first line is not `{{\"transcript\":{VERSION},...}}`")]
    Heading,
    /// A line of it makes no sense.
    #[error("line {line} of the transcript makes no sense: {why}")]
    Line {
        /// Which line, from 1.
        line: u64,
        /// Why.
        why: String,
    },
    /// The node is not in it.
    #[error("the transcript has no node {node}; it has {}", list(.known))]
    NoNode {
        /// The one that is asked for.
        node: u8,
        /// Those that there are.
        known: Vec<u8>,
    },
    /// The computer fails.
    #[error("the module cannot be run again: {0}")]
    Computer(Trouble),
}

fn list(nodes: &[u8]) -> String {
    match nodes {
        [] => "none".into(),
        _ => nodes.iter().map(u8::to_string).collect::<Vec<_>>().join(", "),
    }
}

/// What was compared, and what came of it.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Verdict {
    /// Runs of which something was compared.
    pub runs: u64,
    /// Times that the module was switched on.
    pub starts: u64,
    /// Times that it was polled.
    pub polls: u64,
    /// Times that something interrupted it.
    pub interrupts: u64,
    /// Torques that were compared, yaw and pitch after each poll.
    pub torques: u64,
    /// Those of them whose bits differ.
    pub torques_different: u64,
    /// Frames that it sent then or now.
    pub frames: u64,
    /// Those of them that it sent only then, or only now, or not alike.
    pub frames_different: u64,
    /// Answers that differ in anything else: whether the motors are on, the deadline, how often it has acted.
    pub answers_different: u64,
    /// Frames with its number in the log that it has not sent now.
    pub foreign: u64,
    /// Where it first does something else.
    pub first: Option<Difference>,
    /// Why not everything that was written down was compared, if so.
    pub ended: Option<String>,
}

impl Verdict {
    /// Whether it did the same.
    pub fn same(&self) -> bool {
        self.first.is_none()
    }

    fn differs(&mut self, place: &Place, what: impl FnOnce() -> String) {
        if self.first.is_none() {
            self.first = Some(Difference { place: place.clone(), what: what() });
        }
    }
}

/// A moment of a capture.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Place {
    /// The run, from 0.
    pub run: u64,
    /// The module's clock, us.
    pub clock_us: u64,
    /// The line of the log that was received last, from 1.
    pub log_line: Option<u64>,
    /// The line of the transcript, from 1.
    pub transcript_line: u64,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "in run {} when its clock showed {:.6} s", self.run, self.clock_us as f64 * 1e-6)?;
        if let Some(line) = self.log_line {
            write!(f, ", after line {line} of the log")?;
        }
        write!(f, " (line {} of the transcript)", self.transcript_line)
    }
}

/// A difference.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Difference {
    /// Where.
    pub place: Place,
    /// What.
    pub what: String,
}

/// A computer that is run again.
struct Again<C> {
    computer: C,
    sensors: Sensors,
    torque: [f32; AXES],
}

/// Reads the heading of a transcript.
///
/// # Errors
///
/// If it is none.
pub fn heading(transcript: &mut dyn BufRead) -> Result<Heading, ReplayError> {
    let mut line = String::new();
    transcript.read_line(&mut line)?;
    let heading = serde_json::from_str::<Heading>(&line).map_err(|_| ReplayError::Heading)?;
    if heading.transcript == VERSION { Ok(heading) } else { Err(ReplayError::Heading) }
}

/// Runs the computers of a node again. `transcript` is behind its [`heading`].
///
/// # Errors
///
/// If the transcript makes no sense, or the computer fails.
pub fn replay<L: Launcher>(
    launcher: &L,
    log: &Log,
    transcript: &mut dyn BufRead,
    node: u8,
) -> Result<Verdict, ReplayError> {
    let mut verdict = Verdict::default();
    let mut computers: BTreeMap<u64, Again<L::Computer>> = BTreeMap::new();
    let (mut known, mut sent, mut place) =
        (Vec::new(), HashSet::new(), Place { transcript_line: 1, ..Place::default() });
    let (mut bytes, mut last_line) = (Vec::new(), 0);
    let mut of_run = 0;
    loop {
        bytes.clear();
        if transcript.read_until(b'\n', &mut bytes)? == 0 {
            break;
        }
        place.transcript_line += 1;
        let line = place.transcript_line;
        let nonsense = |why: &str| ReplayError::Line { line, why: why.into() };
        if bytes.pop_if(|byte| *byte == b'\n').is_none() {
            verdict.ended = Some(format!("the transcript ends in the middle of line {line}"));
            break;
        }
        match serde_json::from_slice(&bytes).map_err(|error| nonsense(&error.to_string()))? {
            Record::Begun(begun) => (place.run, of_run, computers) = (begun.run, 0, BTreeMap::new()),
            Record::Started(started) => {
                if let Err(at) = known.binary_search(&started.node) {
                    known.insert(at, started.node);
                }
                if started.node != node {
                    continue;
                }
                let (config, boot, now) = start_of(&started).ok_or_else(|| nonsense("`start` is no START"))?;
                let computer = launcher.start(config, boot, now).map_err(ReplayError::Computer)?;
                computers.insert(started.computer, Again { computer, sensors: Sensors::ZERO, torque: [0.0; AXES] });
                verdict.starts += 1;
            }
            Record::Interrupted(then) => {
                let Some(again) = computers.get_mut(&then.computer) else { continue };
                let frame = then.interrupt.as_deref().map(parse_frame).transpose();
                let frame = frame.map_err(|error| nonsense(&error.to_string()))?;
                let interrupt = frame.as_ref().map_or(Interrupt::StopInput, Interrupt::Frame);
                let (off, tells) = again.computer.interrupt(interrupt).map_err(ReplayError::Computer)?;
                let tells = tells.as_ref().map(frame_text);
                sent.extend(tells.clone());
                verdict.interrupts += 1;
                if (off, &tells) != (then.off, &then.tells) {
                    verdict.answers_different += 1;
                    let say = |off, tells: &Option<String>| {
                        let coast = if off { "coast" } else { "go on" };
                        format!("its motors {coast} and it sends {}", tells.as_deref().unwrap_or("nothing"))
                    };
                    let (now, then) = (say(off, &tells), say(then.off, &then.tells));
                    verdict.differs(&place, || format!("interrupted, {now} instead of {then}"));
                }
            }
            Record::Polled(polled) => {
                let Some(again) = computers.get_mut(&polled.computer) else { continue };
                let frame = match (polled.line, &polled.told) {
                    (Some(number), _) => {
                        let Some(entry) = log.line(number) else {
                            verdict.ended = Some(format!("the log ends before its line {number}"));
                            break;
                        };
                        place.log_line = Some(number);
                        last_line = last_line.max(number);
                        Some(entry.frame)
                    }
                    (None, Some(told)) => Some(parse_frame(told).map_err(|error| nonsense(&error.to_string()))?),
                    (None, None) => None,
                };
                if let Some(text) = &polled.sensors {
                    again.sensors = sensors_from(text).ok_or_else(|| nonsense("`sensors` are not 17 numbers"))?;
                }
                if let Some(text) = &polled.torque {
                    again.torque = torque_from(text).ok_or_else(|| nonsense("`torque` is not 2 numbers"))?;
                }
                let bus = bus_from(polled.bus).ok_or_else(|| nonsense("`bus` is 0, 1 or 2"))?;
                place.clock_us = polled.now;
                verdict.runs += u64::from(std::mem::replace(&mut of_run, 1) == 0);
                let (now, sensors) = (polled.now, again.sensors);
                let poll = Poll { now, sensors: &sensors, frame: frame.as_ref(), bus, room: polled.room };
                compare(again, &poll, &polled, &place, &mut verdict, &mut sent)?;
            }
        }
    }
    if verdict.starts == 0 {
        return Err(ReplayError::NoNode { node, known });
    }
    if verdict.ended.is_none() {
        last_line = u64::MAX;
    }
    for (number, entry) in log.entries.iter().filter(|(number, _)| *number <= last_line) {
        let frame = &entry.frame;
        if frame.module() == node && frame.function().is_some() && !sent.contains(&frame_text(frame)) {
            verdict.foreign += 1;
            let place = Place { log_line: Some(*number), ..place.clone() };
            verdict.differs(&place, || format!("the log has {} of it, which it has not sent", frame_text(frame)));
        }
    }
    Ok(verdict)
}

fn compare<C: Computer>(
    again: &mut Again<C>,
    poll: &Poll<'_>,
    polled: &Polled,
    place: &Place,
    verdict: &mut Verdict,
    all_sent: &mut HashSet<String>,
) -> Result<(), ReplayError> {
    let computer = &mut again.computer;
    computer.ask_poll(poll).map_err(ReplayError::Computer)?;
    let answer = computer.answer().map_err(ReplayError::Computer)?;
    verdict.polls += 1;
    for (axis, (now, then)) in ["yaw", "pitch"].iter().zip(answer.outputs.torque.iter().zip(again.torque)) {
        verdict.torques += 1;
        if now.to_bits() != then.to_bits() {
            verdict.torques_different += 1;
            verdict.differs(place, || format!("its torque in {axis} is {now} instead of {then}"));
        }
    }
    let outputs = &answer.outputs;
    let (now, then) =
        ((outputs.motors_enabled, outputs.deadline, answer.acted), (polled.on, polled.deadline, polled.acted));
    if now != then {
        verdict.answers_different += 1;
        let say = |(on, deadline, acted): (bool, u64, u32)| {
            format!("its motors {}, {acted} actions, the next poll at {deadline} us", if on { "on" } else { "off" })
        };
        verdict.differs(place, || format!("{} instead of {}", say(now), say(then)));
    }
    for (room, then) in &polled.sent {
        let now = computer.next_frame(*room).map_err(ReplayError::Computer)?.as_ref().map(frame_text);
        all_sent.extend(now.clone());
        verdict.frames += u64::from(now.is_some() || then.is_some());
        if now != *then {
            verdict.frames_different += 1;
            let say = |frame: &Option<String>| frame.clone().unwrap_or_else(|| "nothing".into());
            verdict.differs(place, || format!("it sends {} instead of {}", say(&now), say(then)));
        }
    }
    Ok(())
}

type Start = (composer_firmware::controller::Config, composer_firmware::controller::Boot, u64);

fn start_of(started: &Started) -> Option<Start> {
    let text = started.start.as_bytes();
    if !text.len().is_multiple_of(2) {
        return None;
    }
    let mut receiver = Receiver::default();
    let mut message = None;
    for digits in text.chunks(2) {
        let byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
        if let Some(received) = receiver.push(byte) {
            message = Some(received.ok()?.to_vec());
        }
    }
    match link::decode(&message?) {
        Ok(ToModule::Start { config, boot, now }) => Some((config, boot, now)),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
