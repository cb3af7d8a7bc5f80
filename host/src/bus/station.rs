//! The station: asks modules, arms, tells the goal, stops and releases.

use std::collections::BTreeMap;
use std::time::Duration;

use composer_shared::registers::Register;
use composer_shared::wire::{
    ALL_MODULES, EmergencyStop, Fault, Frame, Goal, Health, Message, Operation, STATION, ServiceCode, ServiceRequest,
    ServiceResponse, StopCommand, StopCount,
};

use super::robot::{Change, Robot, fault_name};
use super::{BusError, Transport};

/// How long a module may take to answer: a frame waits for a cycle's traffic at most.
const PATIENCE: Duration = Duration::from_millis(100);
/// How often it is asked.
const TRIES: usize = 3;
/// How often the station repeats that the robot is to be armed.
const ARM_AGAIN: Duration = Duration::from_millis(500);
/// How long it takes at most to hear all modules of a robot that has no time-keeper.
const LISTEN: Duration = Duration::from_millis(1200);
/// How long a refusal that passes by itself is not taken for an answer: another module's or station's business takes some time.
const PASSES: Duration = Duration::from_millis(2500);
/// When to ask again then.
const AGAIN: Duration = Duration::from_millis(150);
/// How long all modules may take to be stopped or released.
const STOPPED: Duration = Duration::from_secs(1);

/// What a module answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// How it ended ([`ServiceCode`]).
    pub code: u8,
    /// Its value.
    pub value: u32,
}

/// What [`Station::drive`] does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Drive {
    /// Keep the robot armed.
    pub arm: bool,
    /// Where the goal is: robot units, x ahead, y left, z up in the frame of the head link.
    pub goal: Option<[f32; 3]>,
}

/// How long the answer may take: what is kept in the flash takes longer.
fn patience(operation: Operation) -> Duration {
    match operation {
        Operation::Store | Operation::SetNode | Operation::ClearLog => 5 * PATIENCE,
        // A slot is erased, or a policy hashed and its signature checked.
        Operation::Update => 15 * PATIENCE,
        _ => PATIENCE,
    }
}

/// Whether a refusal may pass by itself.
fn passes(code: u8) -> bool {
    code == ServiceCode::Busy as u8 || code == ServiceCode::AnotherStation as u8
}

/// The station of a robot.
pub struct Station {
    transport: Box<dyn Transport>,
    robot: Robot,
    sequence: u8,
    answered: Option<u16>,
    changes: Vec<Change>,
}

impl Station {
    /// A station that has not heard anything yet.
    pub fn new(transport: Box<dyn Transport>) -> Self {
        // Not always the same first number: an answer to whoever asked before is none to this station.
        let sequence = std::time::UNIX_EPOCH.elapsed().map_or(0, |time| time.subsec_micros() as u8);
        Station { transport, robot: Robot::default(), sequence, answered: None, changes: Vec::new() }
    }

    /// What is known of the robot.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// The transport.
    pub fn transport(&self) -> &dyn Transport {
        &*self.transport
    }

    /// Time since the transport was opened.
    pub fn now(&self) -> Duration {
        self.transport.now()
    }

    /// What has changed since the last call.
    pub fn changes(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// Receives a frame, or waits so long in vain.
    pub fn listen(&mut self, patience: Duration) -> Result<Option<Frame>, BusError> {
        let frame = self.transport.receive(patience)?;
        let now = self.transport.now();
        let changes = match &frame {
            Some(frame) => self.robot.hear(now, frame),
            // Only now: of frames that still wait, the time is not known.
            None => self.robot.look(now),
        };
        self.changes.extend(changes);
        Ok(frame)
    }

    /// Listens until every module that ought to be there was heard, for a limited time. The error: nobody was.
    pub fn meet(&mut self) -> Result<Vec<u8>, BusError> {
        let start = self.now();
        while self.now() - start < LISTEN {
            self.listen(Duration::from_millis(20))?;
            let expected = usize::from(self.robot.expected());
            let modules = self.robot.modules().filter(|(_, module)| module.state.is_some()).count();
            if expected > 0 && modules >= expected {
                break;
            }
        }
        let present = self.robot.present();
        if present.is_empty() { Err(BusError::Nobody) } else { Ok(present) }
    }

    /// Sends a message that nobody answers.
    pub fn tell(&mut self, message: &Message) -> Result<(), BusError> {
        self.send(message)
    }

    fn send(&mut self, message: &Message) -> Result<(), BusError> {
        let frame = message.emit(STATION, self.transport.fd());
        self.transport.send(&frame)
    }

    /// Sends a request and does not wait for the answer; gives its sequence number.
    pub fn ask(&mut self, destination: u8, operation: Operation, index: u8, value: u32) -> Result<u8, BusError> {
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        let request = ServiceRequest { destination, operation: operation as u8, sequence, index, value };
        self.send(&Message::ServiceRequest(request))?;
        Ok(sequence)
    }

    /// The answer in a frame, and whose it is.
    fn answer(frame: &Frame) -> Option<(u8, ServiceResponse)> {
        match Message::parse(frame) {
            Ok(Message::ServiceResponse(response)) => Some((frame.module(), response)),
            _ => None,
        }
    }

    /// Asks one module once and waits for its answer; none if there is none.
    fn ask_once(&mut self, node: u8, operation: Operation, index: u8, value: u32) -> Result<Option<Answer>, BusError> {
        let sequence = self.ask(node, operation, index, value)?;
        let start = self.now();
        while let Some(left) = patience(operation).checked_sub(self.now() - start) {
            let Some((from, response)) = self.listen(left)?.as_ref().and_then(Self::answer) else { continue };
            if from == node && response.operation == operation as u8 && response.sequence == sequence {
                return Ok(Some(Answer { code: response.code, value: response.value }));
            }
        }
        Ok(None)
    }

    /// Asks one module and waits for its answer, several times if need be: frames may be lost, it may be busy, or remember another station. Repeating
    /// a request does no harm.
    pub fn answer_of(&mut self, node: u8, operation: Operation, index: u8, value: u32) -> Result<Answer, BusError> {
        let start = self.now();
        let mut tries = 0;
        loop {
            match self.ask_once(node, operation, index, value)? {
                Some(answer) if !passes(answer.code) || self.now() - start > PASSES => return Ok(answer),
                Some(_) => self.pause(AGAIN)?,
                None => tries += 1,
            }
            if tries == TRIES {
                return Err(BusError::Silent { node, heard: self.robot.present().contains(&node) });
            }
        }
    }

    /// Listens for so long.
    pub fn pause(&mut self, time: Duration) -> Result<(), BusError> {
        let end = self.now() + time;
        while let Some(left) = end.checked_sub(self.now()).filter(|left| !left.is_zero()) {
            self.listen(left.min(Duration::from_millis(20)))?;
        }
        Ok(())
    }

    /// Asks one module and takes nothing but success for an answer: its value.
    pub fn request(&mut self, node: u8, operation: Operation, index: u8, value: u32) -> Result<u32, BusError> {
        let Answer { code, value } = self.answer_of(node, operation, index, value)?;
        if code == ServiceCode::Ok as u8 {
            return Ok(value);
        }
        Err(BusError::Refused { node, what: operation.name().into(), code })
    }

    /// Asks all modules at once; those that do not answer are asked again by number. `nodes` ought to answer.
    pub fn ask_all(
        &mut self,
        nodes: &[u8],
        operation: Operation,
        index: u8,
        value: u32,
    ) -> Result<BTreeMap<u8, Result<Answer, BusError>>, BusError> {
        let start = self.now();
        loop {
            let answers = self.ask_all_once(nodes, operation, index, value)?;
            let passing = answers.values().flatten().any(|answer| passes(answer.code));
            if !passing || self.now() - start > PASSES {
                return Ok(answers);
            }
            self.pause(AGAIN)?;
        }
    }

    fn ask_all_once(
        &mut self,
        nodes: &[u8],
        operation: Operation,
        index: u8,
        value: u32,
    ) -> Result<BTreeMap<u8, Result<Answer, BusError>>, BusError> {
        let sequence = self.ask(ALL_MODULES, operation, index, value)?;
        let mut answers = BTreeMap::new();
        let start = self.now();
        while let Some(left) = patience(operation).checked_sub(self.now() - start) {
            if let Some((node, response)) = self.listen(left)?.as_ref().and_then(Self::answer)
                && response.operation == operation as u8
                && response.sequence == sequence
            {
                answers.insert(node, Ok(Answer { code: response.code, value: response.value }));
            }
            if nodes.iter().all(|node| answers.contains_key(node)) {
                break;
            }
        }
        for node in nodes {
            if !answers.contains_key(node) {
                let heard = self.robot.present().contains(node);
                let mut answer = Err(BusError::Silent { node: *node, heard });
                for _ in 1..TRIES {
                    if let Some(one) = self.ask_once(*node, operation, index, value)? {
                        answer = Ok(one);
                        break;
                    }
                }
                answers.insert(*node, answer);
            }
        }
        Ok(answers)
    }

    /// Asks all modules that are on the bus for something that all have to do; the error names those that did not, and why.
    pub fn command_all(&mut self, operation: Operation, value: u32) -> Result<Vec<u8>, BusError> {
        let nodes = self.meet()?;
        let answers = self.ask_all(&nodes, operation, 0, value)?;
        let mut reasons: Vec<(String, Vec<String>)> = Vec::new();
        for (node, answer) in &answers {
            let reason = match answer {
                Ok(answer) if answer.code == ServiceCode::Ok as u8 => continue,
                Ok(answer) => super::sentence(answer.code),
                Err(error) => error.to_string(),
            };
            match reasons.iter_mut().find(|(known, _)| *known == reason) {
                Some((_, nodes)) => nodes.push(node.to_string()),
                None => reasons.push((reason, vec![node.to_string()])),
            }
        }
        if reasons.is_empty() {
            return Ok(answers.into_keys().collect());
        }
        let text: Vec<String> = reasons
            .iter()
            .map(|(reason, nodes)| match &nodes[..] {
                [node] => format!("module {node}: {reason}"),
                _ => format!("modules {}: {reason}", nodes.join(", ")),
            })
            .collect();
        Err(BusError::Incomplete(format!("{} is not done by all modules; {}", operation.name(), text.join("; "))))
    }

    /// Arms all modules that are on the bus; `acknowledge` arms those too that restarted though nobody asked for it.
    pub fn arm(&mut self, acknowledge: bool) -> Result<Vec<u8>, BusError> {
        self.command_all(Operation::Arm, u32::from(acknowledge))
    }

    /// Disarms all modules that are on the bus.
    pub fn disarm(&mut self) -> Result<Vec<u8>, BusError> {
        self.command_all(Operation::Disarm, 0)
    }

    /// Stops the robot, at once, and repeats it until every module that is heard says that it is stopped. Gives those.
    pub fn stop(&mut self) -> Result<Vec<u8>, BusError> {
        self.latch(StopCommand::Stop)
    }

    /// Releases a stopped robot. It stays disarmed.
    pub fn release(&mut self) -> Result<Vec<u8>, BusError> {
        self.meet()?;
        self.latch(StopCommand::Release)
    }

    fn latch(&mut self, command: StopCommand) -> Result<Vec<u8>, BusError> {
        let stop = command == StopCommand::Stop;
        // Whoever has heard of no stop yet counts by itself; time is short.
        let frame = |count| Message::EmergencyStop(EmergencyStop::new(command, 0, count));
        self.send(&frame(match self.robot.frames_heard() {
            true => self.robot.stop().count().next(),
            false => StopCount::UNKNOWN,
        }))?;
        let start = self.now();
        let mut again = Duration::from_millis(20);
        let mut done: BTreeMap<u8, bool> = BTreeMap::new();
        while self.now() - start < STOPPED {
            if let Some(frame) = self.listen(Duration::from_millis(5))? {
                let health = match Message::parse(&frame) {
                    Ok(Message::State(state)) => Some(state.health),
                    Ok(Message::Heartbeat(heartbeat)) => Some(heartbeat.health),
                    _ => None,
                };
                if let Some(health) = health {
                    done.insert(frame.module(), health.has(Health::EMERGENCY_STOP) == stop);
                }
            }
            let present = self.robot.present();
            // Two cycles, so that everybody had the time to say so.
            if self.now() - start > 2 * self.robot.period()
                && !present.is_empty()
                && present.iter().all(|node| done.get(node) == Some(&true))
            {
                return Ok(present);
            }
            if self.now() - start > again {
                again = self.now() - start + Duration::from_millis(50);
                let mut latch = self.robot.stop();
                if latch.stopped() != stop {
                    latch.command(command, latch.count().next());
                    *self.robot.stop_mut() = latch;
                }
                self.send(&frame(latch.count()))?;
            }
        }
        let present = self.robot.present();
        if present.is_empty() {
            return Err(BusError::Nobody);
        }
        let late: Vec<String> =
            present.iter().filter(|node| done.get(node) != Some(&true)).map(u8::to_string).collect();
        let what = if stop { "stopped" } else { "released" };
        Err(BusError::Incomplete(format!(
            "not {what}: module {}; {}",
            late.join(", "),
            if stop { "cut the power" } else { "does another node stop the robot, or is a stop input pressed?" }
        )))
    }

    /// Who a module is, for people: names and values.
    pub fn hello(&mut self, node: u8) -> Result<Vec<(&'static str, String)>, BusError> {
        let mut item = |index| self.request(node, Operation::Hello, index, 0);
        let [protocol, firmware, page, modules] = item(0)?.to_le_bytes();
        let unique_id = [item(1)?, item(2)?, item(3)?];
        let policy = item(4)?;
        let [reason, resets, low, high] = item(5)?.to_le_bytes();
        Ok(vec![
            ("protocol", protocol.to_string()),
            ("firmware", format!("{}.{}", firmware >> 4, firmware & 15)),
            ("node page", format!("layout {page}")),
            ("modules", modules.to_string()),
            ("unique id", chip(unique_id)),
            ("policy", format!("{policy:08x} (tag {:04x})", policy as u16)),
            ("last start", format!("reason {reason}, {resets} in a row that nobody asked for")),
            ("starts", u16::from_le_bytes([low, high]).to_string()),
        ])
    }

    /// The fault log of a module, the newest entry first.
    pub fn log(&mut self, node: u8) -> Result<Vec<LogEntry>, BusError> {
        let mut entries = Vec::new();
        for back in 0..=u8::MAX {
            let Answer { code, value: number } = self.answer_of(node, Operation::Log, back, 0)?;
            if code == ServiceCode::NoSuchRegister as u8 {
                break;
            }
            if code != ServiceCode::Ok as u8 {
                return Err(BusError::Refused { node, what: Operation::Log.name().into(), code });
            }
            let time_ms = self.request(node, Operation::Log, back, 1)?;
            let what = self.request(node, Operation::Log, back, 2)?;
            let data = self.request(node, Operation::Log, back, 3)? as u16;
            entries.push(LogEntry { number, boot: what as u16, time_ms, fault: (what >> 16) as u8, data });
        }
        Ok(entries)
    }

    /// Gives a module another number, which counts from its next start on. Where two have the same, `unique_id` says which is meant. Gives its chip, and whether
    /// it answered: one that is silent because of its twin obeys, but says nothing.
    pub fn renumber(&mut self, node: u8, number: u8, unique_id: Option<&str>) -> Result<(String, bool), BusError> {
        let words = match unique_id {
            Some(text) => unchip(text).ok_or_else(|| {
                BusError::Refusal(format!(
                    "`{text}` is no unique identifier: three words of eight hexadecimal digits, as `hello` prints them"
                ))
            })?,
            None => {
                let mut words = [0; 3];
                for (word, index) in words.iter_mut().zip(1..) {
                    *word = self.request(node, Operation::Hello, index, 0)?;
                }
                words
            }
        };
        // Everybody is asked, and all but the one with this chip say that it is not theirs.
        let mut meant = None;
        for (index, word) in (0..).zip(words) {
            let ok = |_, response: &ServiceResponse| response.code == ServiceCode::Ok as u8;
            meant = self.ask_for(Operation::SetNode, index, word, ok)?.map(|(from, _)| from);
        }
        if meant.is_none() && unique_id.is_none() {
            return Err(BusError::Silent { node, heard: self.robot.present().contains(&node) });
        }
        let answer = self.ask_for(Operation::SetNode, 3, number.into(), |from, _| Some(from) == meant)?;
        match answer {
            Some((node, ServiceResponse { code, .. })) if code != ServiceCode::Ok as u8 => {
                Err(BusError::Refused { node, what: format!("the number {number}"), code })
            }
            answer => Ok((chip(words), answer.is_some())),
        }
    }

    /// Asks all modules, and waits for the answer that is wanted.
    fn ask_for(
        &mut self,
        operation: Operation,
        index: u8,
        value: u32,
        wanted: impl Fn(u8, &ServiceResponse) -> bool,
    ) -> Result<Option<(u8, ServiceResponse)>, BusError> {
        let sequence = self.ask(ALL_MODULES, operation, index, value)?;
        let start = self.now();
        while let Some(left) = patience(operation).checked_sub(self.now() - start) {
            if let Some((from, response)) = self.listen(left)?.as_ref().and_then(Self::answer)
                && (response.operation, response.sequence) == (operation as u8, sequence)
                && wanted(from, &response)
            {
                return Ok(Some((from, response)));
            }
        }
        Ok(None)
    }

    /// Asks all modules for their supply; those that do not answer at once have none.
    pub fn look_at_supply(&mut self) -> Result<(), BusError> {
        let operation = Operation::Read;
        let sequence = self.ask(ALL_MODULES, operation, Register::Supply.spec().first, 0)?;
        let start = self.now();
        let mut left = self.robot.present().len();
        while let Some(patience) = PATIENCE.checked_sub(self.now() - start).filter(|_| left > 0) {
            if let Some((node, response)) = self.listen(patience)?.as_ref().and_then(Self::answer)
                && (response.operation, response.sequence) == (operation as u8, sequence)
            {
                left -= 1;
                let volts = f32::from_bits(response.value);
                if response.code == ServiceCode::Ok as u8 && volts.is_finite() {
                    self.robot.note_supply(node, volts);
                }
            }
        }
        Ok(())
    }

    /// Drives the robot until `ended` says so, which is asked several times a cycle: answers each SYNC with the goal, and keeps the robot armed, as
    /// asked for.
    pub fn drive(&mut self, drive: &Drive, mut ended: impl FnMut(&mut Station) -> bool) -> Result<(), BusError> {
        let mut armed = self.now();
        while !ended(self) {
            let frame = self.listen(Duration::from_millis(10))?;
            // A goal that is not known is said, too: it is the station's sign of life.
            if let Some(Ok(Message::Sync(sync))) = frame.as_ref().map(Message::parse)
                && self.answered != Some(sync.cycle)
            {
                self.answered = Some(sync.cycle);
                self.send(&Message::Goal(Goal::new(sync.cycle as u8, 0, drive.goal)))?;
            }
            if drive.arm && self.now() >= armed + ARM_AGAIN {
                armed = self.now();
                self.ask(ALL_MODULES, Operation::Arm, 0, 0)?;
            }
        }
        Ok(())
    }
}

/// An entry of a module's fault log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LogEntry {
    /// Its number; it never changes.
    pub number: u32,
    /// In which start of the module.
    pub boot: u16,
    /// Time since that start, ms.
    pub time_ms: u32,
    /// Number of the fault; 0: the module started.
    pub fault: u8,
    /// Depends on the fault.
    pub data: u16,
}

impl std::fmt::Display for LogEntry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let LogEntry { number, boot, time_ms, fault, data } = *self;
        write!(f, "{number:5}  start {boot}, {:10.3} s  ", f64::from(time_ms) / 1e3)?;
        match Fault::from_number(fault) {
            None if fault == 0 => {
                let [reason, resets] = data.to_le_bytes();
                write!(f, "the module started: reason {reason}, {resets} in a row that nobody asked for")
            }
            Some(Fault::OverTemperature) => write!(f, "{}: {:.1} C", fault_name(fault), f32::from(data as i16) / 10.0),
            Some(Fault::UnderVoltage | Fault::OverVoltage) => {
                write!(f, "{}: {:.2} V", fault_name(fault), f32::from(data) / 1e3)
            }
            Some(Fault::Sensors) => write!(f, "{}: encoders without a reading {data:04b}", fault_name(fault)),
            Some(Fault::OverCurrent) => write!(f, "{}: motors cut off {data:02b}", fault_name(fault)),
            _ => write!(f, "{} in cycle {data}", fault_name(fault)),
        }
    }
}

/// A chip's unique identifier as people read it.
fn chip(words: [u32; 3]) -> String {
    words.map(|word| format!("{word:08x}")).join("-")
}

/// The same back.
fn unchip(text: &str) -> Option<[u32; 3]> {
    let words: Vec<u32> = text
        .split('-')
        .filter(|word| word.len() == 8)
        .map(|word| u32::from_str_radix(word, 16))
        .collect::<Result<_, _>>()
        .ok()?;
    words.try_into().ok()
}
