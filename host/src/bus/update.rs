//! A new policy for a whole robot over its bus: all modules or none.
//!
//! Every module that is on the bus receives it, verifies it and says so, before any is told to try it; all restart together, and only when every one of them runs
//! with it, it is confirmed. A module that falls silent meanwhile is left out: its neighbours ignore what it says until it has the same policy, and the same command
//! brings it up to date when it is back. What was interrupted goes on where it was.

use std::collections::BTreeMap;
use std::time::Duration;

use composer_shared::policy::Task;
use composer_shared::update::{CHUNKS_MAX, ChunkRepr, Record, RecordKind, Slot, chunks};
use composer_shared::wire::{Message, Operation, Piece, ServiceCode, UpdateStep};
use serde_json::{Value, json};

use super::station::Station;
use super::{BusError, sentence};
use crate::signing::Package;

/// Between two chunks on a CAN-FD bus: a module writes one in 0.6 ms.
const PACE: Duration = Duration::from_micros(800);
/// The same on a classic bus, between two of the nine pieces: each takes 0.13 ms on the bus.
const PACE_CLASSIC: Duration = Duration::from_micros(150);
/// How often what is missing is sent again.
const ROUNDS: usize = 60;
/// How long modules may take to be back after a restart.
const BACK: Duration = Duration::from_secs(8);
/// How long a module that is silent is waited for before it is left out.
const SILENT: Duration = Duration::from_millis(1500);

/// What a module says of its policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Policies {
    /// CRC-32 of the policy that it runs with.
    pub policy: u32,
    /// Its task.
    pub task: Option<Task>,
    /// The slot that it lies in.
    pub slot: Slot,
    /// It is on trial.
    pub trial: bool,
    /// Something waits to be tried at the next start.
    pub committed: bool,
    /// Security counter.
    pub counter: u32,
    /// Which keys it has.
    pub keys: [bool; 2],
}

/// What there is to tell on the way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Progress {
    /// These modules have it already.
    UpToDate(Vec<u8>),
    /// These modules are to get it; the chunks that each lacks.
    Begun(Vec<(u8, usize)>),
    /// A round of chunks was sent; what each still lacks.
    Sent(Vec<(u8, usize)>),
    /// All have verified it.
    Verified,
    /// All are to try it.
    Committed,
    /// All run with it.
    Tried,
    /// It is confirmed.
    Confirmed,
    /// A module has fallen silent and is left out.
    LeftOut(u8),
}

impl std::fmt::Display for Progress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let list = |f: &mut std::fmt::Formatter<'_>, lacks: &[(u8, usize)]| {
            let texts: Vec<String> = lacks.iter().map(|(node, lacks)| format!("module {node}: {lacks}")).collect();
            f.write_str(&texts.join(", "))
        };
        match self {
            Progress::UpToDate(nodes) => {
                let numbers: Vec<String> = nodes.iter().map(u8::to_string).collect();
                write!(f, "up to date already: {}", numbers.join(", "))
            }
            Progress::Begun(lacks) => {
                f.write_str("chunks to send: ")?;
                list(f, lacks)
            }
            Progress::Sent(lacks) if lacks.iter().all(|(_, lacks)| *lacks == 0) => f.write_str("all chunks are there"),
            Progress::Sent(lacks) => {
                f.write_str("chunks that were lost: ")?;
                let lacks: Vec<_> = lacks.iter().copied().filter(|(_, lacks)| *lacks > 0).collect();
                list(f, &lacks)
            }
            Progress::Verified => f.write_str("verified by all"),
            Progress::Committed => f.write_str("to be tried by all; they restart"),
            Progress::Tried => f.write_str("all run with it, on trial"),
            Progress::Confirmed => f.write_str("confirmed"),
            Progress::LeftOut(node) => write!(f, "module {node} has fallen silent and is left out"),
        }
    }
}

/// A row of the table at the end, read back from the module; none if it is silent.
pub type Row = (u8, Option<Policies>);

/// How often a module that is heard is asked in vain, each time several times: of many questions on a bad bus one may be lost that often.
const PERSISTENCE: usize = 4;

/// A value that a module that is on the bus will say sooner or later.
fn value(station: &mut Station, node: u8, operation: Operation, index: u8) -> Result<u32, BusError> {
    for _ in 1..PERSISTENCE {
        match station.request(node, operation, index, 0) {
            Err(BusError::Silent { heard: true, .. }) => {}
            result => return result,
        }
    }
    station.request(node, operation, index, 0)
}

/// What a module says of its policies.
pub fn policies(station: &mut Station, node: u8) -> Result<Policies, BusError> {
    let policy = value(station, node, Operation::Hello, 4)?;
    let mut item = |item| value(station, node, Operation::UpdateStatus, item);
    let (state, counter, task) = (item(16)?, item(17)?, item(23)?);
    Ok(Policies {
        policy,
        task: Task::ALL.into_iter().find(|known| *known as u32 == task),
        slot: if state >> 4 & 1 == 0 { Slot::A } else { Slot::B },
        trial: state >> 3 & 1 != 0,
        committed: state & 7 == 4,
        counter,
        keys: [state >> 5 & 1 != 0, state >> 6 & 1 != 0],
    })
}

/// An update under way.
struct Update<'a> {
    station: &'a mut Station,
    package: &'a Package,
    watch: &'a mut dyn FnMut(&Progress) -> bool,
    /// Modules that take part.
    nodes: Vec<u8>,
}

/// Brings a policy to all modules that are on the bus. `watch` is told what happens and says whether to go on. Gives the table at the end.
///
/// Errors: nobody is there, a module refuses (then nothing is changed anywhere), or it was interrupted.
pub fn update(
    station: &mut Station,
    package: &Package,
    watch: &mut dyn FnMut(&Progress) -> bool,
) -> Result<Vec<Row>, BusError> {
    let nodes = station.meet()?;
    let mut before = BTreeMap::new();
    for node in &nodes {
        before.insert(*node, policies(station, *node)?);
    }
    check(package, &before)?;
    let crc = package.header().crc;
    let has = |policies: &Policies| policies.policy == crc && !policies.trial;
    let (done, todo): (Vec<u8>, Vec<u8>) = nodes.iter().partition(|node| has(&before[node]));
    let mut update = Update { station, package, watch, nodes: todo };
    if !done.is_empty() {
        update.tell(Progress::UpToDate(done))?;
    }
    if !update.nodes.is_empty() {
        // Those that have restarted with it in an update that was interrupted need no more than to be confirmed.
        let tried = |policies: &Policies| policies.policy == crc && policies.trial;
        if !update.nodes.iter().all(|node| tried(&before[node])) {
            if let Some(node) = update.nodes.iter().find(|node| before[node].trial) {
                return Err(BusError::Incomplete(format!(
                    "module {node} tries a policy that was not confirmed, and goes back to the one before within a minute: ask again then"
                )));
            }
            update.stage(&before)?;
            update.commit()?;
            update.restart()?;
        }
        update.confirm()?;
    }
    table(station)
}

/// What can be refused before anything is sent.
fn check(package: &Package, before: &BTreeMap<u8, Policies>) -> Result<(), BusError> {
    let header = package.header();
    if let Some((node, _)) = before.iter().find(|(_, policies)| policies.keys != [false; 2] && !package.signed()) {
        return Err(BusError::Refusal(format!(
            "module {node} has a key and the policy is not signed: sign it with `snakectl sign`; nothing was changed"
        )));
    }
    if let Some((node, policies)) = before.iter().find(|(_, policies)| policies.counter > header.counter) {
        return Err(BusError::Refusal(format!(
            "the policy has security counter {} and module {node} has {} already: sign it with a counter that is no lower; nothing was changed",
            header.counter, policies.counter
        )));
    }
    let tags: std::collections::BTreeSet<u32> = before.values().map(|policies| policies.policy).collect();
    let own = before.values().any(|policies| policies.policy == header.crc || policies.task == Some(header.task));
    if tags.len() > 1 && !own {
        let texts: Vec<String> = before
            .iter()
            .map(|(node, policies)| {
                format!("module {node} {:08x} for {}", policies.policy, policies.task.map_or("?", Task::name))
            })
            .collect();
        return Err(BusError::Refusal(format!(
            "the modules disagree about their policy ({}), and this one is for {}, another task than any of theirs: bring them onto one policy of theirs first; nothing was changed",
            texts.join(", "),
            header.task.name()
        )));
    }
    Ok(())
}

impl Update<'_> {
    fn tell(&mut self, progress: Progress) -> Result<(), BusError> {
        if (self.watch)(&progress) { Ok(()) } else { Err(BusError::Interrupted) }
    }

    /// Asks all that take part for a step; gives the values. One that is silent is left out, one that refuses ends the update everywhere.
    fn step(&mut self, step: UpdateStep, value: u32) -> Result<BTreeMap<u8, u32>, BusError> {
        let nodes = self.nodes.clone();
        let answers = self.station.ask_all(&nodes, Operation::Update, step as u8, value)?;
        let mut values = BTreeMap::new();
        let mut refused: Vec<(String, Vec<u8>)> = Vec::new();
        for node in nodes {
            let mut answer = answers.get(&node);
            let again;
            if matches!(answer, None | Some(Err(BusError::Silent { .. }))) && !self.is_gone(node)? {
                again = self.station.answer_of(node, Operation::Update, step as u8, value);
                answer = Some(&again);
            }
            match answer {
                Some(Ok(answer)) if answer.code == ServiceCode::Ok as u8 => {
                    values.insert(node, answer.value);
                }
                Some(Ok(answer)) => {
                    let text = sentence(answer.code);
                    match refused.iter_mut().find(|(known, _)| *known == text) {
                        Some((_, nodes)) => nodes.push(node),
                        None => refused.push((text, vec![node])),
                    }
                }
                _ => self.leave_out(node)?,
            }
        }
        if !refused.is_empty() {
            return Err(self.abandon(step, &refused));
        }
        if self.nodes.is_empty() { Err(BusError::Nobody) } else { Ok(values) }
    }

    /// Takes back what was staged or is to be tried, and says why.
    fn abandon(&mut self, step: UpdateStep, refused: &[(String, Vec<u8>)]) -> BusError {
        if step != UpdateStep::Confirm {
            let nodes = self.nodes.clone();
            let _ = self.station.ask_all(&nodes, Operation::Update, UpdateStep::Abandon as u8, 0);
        }
        let texts: Vec<String> = refused
            .iter()
            .map(|(text, nodes)| match &nodes[..] {
                [node] => format!("module {node} refuses to {}: {text}", step.name()),
                _ => {
                    let numbers: Vec<String> = nodes.iter().map(u8::to_string).collect();
                    format!("modules {} refuse to {}: {text}", numbers.join(", "), step.name())
                }
            })
            .collect();
        let end = match step {
            UpdateStep::Confirm => "what is not confirmed goes back to the policy before",
            _ => "no module has changed its policy",
        };
        BusError::Incomplete(format!("{}; {end}", texts.join("; ")))
    }

    /// Whether a module is not heard any more; listens for a while to be sure.
    fn is_gone(&mut self, node: u8) -> Result<bool, BusError> {
        let end = self.station.now() + SILENT;
        while !self.station.robot().present().contains(&node) {
            if self.station.now() >= end {
                return Ok(true);
            }
            self.station.listen(Duration::from_millis(20))?;
        }
        Ok(false)
    }

    fn leave_out(&mut self, node: u8) -> Result<(), BusError> {
        self.nodes.retain(|known| *known != node);
        self.tell(Progress::LeftOut(node))?;
        if self.nodes.is_empty() { Err(BusError::Nobody) } else { Ok(()) }
    }

    /// Chunks that a module lacks.
    fn lacks(&mut self, node: u8) -> Result<Vec<u16>, BusError> {
        let count = chunks(self.package.bytes().len());
        let there = value(self.station, node, Operation::UpdateStatus, 19)?;
        if there as usize == count {
            return Ok(Vec::new());
        }
        let mut lacks = Vec::new();
        for word in 0..count.div_ceil(32) {
            let bits = value(self.station, node, Operation::UpdateStatus, word as u8)?;
            let numbers = (0..32).map(|bit| (32 * word + bit, bits >> bit & 1));
            lacks.extend(
                numbers.filter(|(number, there)| *there == 0 && *number < count).map(|(number, _)| number as u16),
            );
        }
        Ok(lacks)
    }

    /// What each module lacks. One that is silent is left out.
    fn look(&mut self) -> Result<BTreeMap<u8, Vec<u16>>, BusError> {
        let mut lacks = BTreeMap::new();
        for node in self.nodes.clone() {
            match self.lacks(node) {
                Ok(missing) => {
                    lacks.insert(node, missing);
                }
                Err(BusError::Silent { .. }) if self.is_gone(node)? => self.leave_out(node)?,
                Err(BusError::Silent { .. }) => {
                    lacks.insert(node, self.lacks(node)?);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(lacks)
    }

    fn stage(&mut self, before: &BTreeMap<u8, Policies>) -> Result<(), BusError> {
        let total = self.package.bytes().len();
        debug_assert!(chunks(total) <= CHUNKS_MAX);
        let begin = u32::from(self.package.session()) | (total as u32) << 16;
        // What waits to be tried already, from an update that was interrupted, is given up: all begin from the same.
        let committed = self.nodes.iter().any(|node| before[node].committed);
        if committed {
            self.step(UpdateStep::Abandon, 0)?;
        }
        self.step(UpdateStep::Begin, begin)?;
        let mut lacks = self.look()?;
        self.tell(Progress::Begun(counts(&lacks)))?;
        for _ in 0..ROUNDS {
            let mut wanted: Vec<u16> = lacks.values().flatten().copied().collect();
            wanted.sort_unstable();
            wanted.dedup();
            if wanted.is_empty() {
                break;
            }
            for number in wanted {
                self.send(number)?;
            }
            lacks = self.look()?;
            // A module that restarted meanwhile has forgotten that it was begun.
            if lacks.values().any(|missing| missing.len() == chunks(total)) {
                self.step(UpdateStep::Begin, begin)?;
            }
            self.tell(Progress::Sent(counts(&lacks)))?;
        }
        if let Some((node, missing)) = lacks.iter().find(|(_, missing)| !missing.is_empty()) {
            return Err(BusError::Incomplete(format!(
                "module {node} still lacks {} chunks after {ROUNDS} rounds: look after the bus, then give the same command again; no module has changed its policy",
                missing.len()
            )));
        }
        let crc = self.package.header().crc;
        let verified = self.step(UpdateStep::Verify, crc)?;
        // Each has compared the digest; here all are compared with one another.
        if let Some((node, found)) = verified.iter().find(|(_, found)| **found != crc) {
            let text = format!("it has verified policy {found:08x}, and not {crc:08x}");
            return Err(self.abandon(UpdateStep::Verify, &[(text, vec![*node])]));
        }
        self.tell(Progress::Verified)
    }

    fn send(&mut self, number: u16) -> Result<(), BusError> {
        let Some(chunk) = ChunkRepr::of(self.package.bytes(), self.package.session(), number) else { return Ok(()) };
        if self.station.transport().fd() {
            self.station.tell(&Message::UpdateChunk(chunk))?;
            return self.station.pause(PACE);
        }
        for piece in chunk.pieces() {
            self.station.tell(&Message::UpdatePiece(Piece(piece)))?;
            self.station.pause(PACE_CLASSIC)?;
        }
        Ok(())
    }

    fn commit(&mut self) -> Result<(), BusError> {
        self.step(UpdateStep::Commit, self.package.header().crc)?;
        self.tell(Progress::Committed)
    }

    /// All restart, and are waited for.
    fn restart(&mut self) -> Result<(), BusError> {
        let crc = self.package.header().crc;
        for node in self.nodes.clone() {
            // Not by one request to all: those that have the policy already go on.
            self.station.ask(node, Operation::Restart, 0, 0)?;
            self.station.pause(Duration::from_millis(2))?;
        }
        let end = self.station.now() + BACK;
        self.station.pause(Duration::from_millis(150))?;
        for node in self.nodes.clone() {
            loop {
                match policies(self.station, node) {
                    Ok(policies) if policies.policy == crc => break,
                    // It did not hear that it is to restart, or came back with the old policy.
                    Ok(policies) if policies.committed => {
                        self.station.ask(node, Operation::Restart, 0, 0)?;
                        self.station.pause(Duration::from_millis(150))?;
                    }
                    Ok(_) => {
                        return Err(BusError::Incomplete(format!(
                            "module {node} has gone back to its policy of before: nothing is confirmed, and the others go back, too, within a minute"
                        )));
                    }
                    Err(BusError::Silent { .. }) if self.station.now() < end => self.station.pause(SILENT / 10)?,
                    Err(BusError::Silent { .. }) => {
                        self.leave_out(node)?;
                        break;
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        self.tell(Progress::Tried)
    }

    fn confirm(&mut self) -> Result<(), BusError> {
        self.step(UpdateStep::Confirm, self.package.header().crc)?;
        self.tell(Progress::Confirmed)
    }
}

fn counts(lacks: &BTreeMap<u8, Vec<u16>>) -> Vec<(u8, usize)> {
    lacks.iter().map(|(node, missing)| (*node, missing.len())).collect()
}

/// What every module that ought to be there says of its policies.
pub fn table(station: &mut Station) -> Result<Vec<Row>, BusError> {
    let nodes: Vec<u8> = station.robot().modules().map(|(node, _)| node).collect();
    let mut rows = Vec::new();
    for node in nodes {
        match policies(station, node) {
            Ok(policies) => rows.push((node, Some(policies))),
            Err(BusError::Silent { .. }) => rows.push((node, None)),
            Err(error) => return Err(error),
        }
    }
    Ok(rows)
}

/// The table for people.
pub fn text(rows: &[Row]) -> String {
    let mut text = format!(
        "{:>6}  {:8}  {:15}  {:4}  {:7}  {:9}  {}\n",
        "module", "policy", "task", "slot", "counter", "confirmed", "keys"
    );
    for (node, policies) in rows {
        match policies {
            None => text += &format!("{node:>6}  not on the bus\n"),
            Some(Policies { policy, task, slot, trial, counter, keys, .. }) => {
                let confirmed = if *trial { "on trial" } else { "yes" };
                let keys = match keys {
                    [false, false] => "none: takes what nobody signed",
                    [true, false] => "A",
                    [false, true] => "B",
                    [true, true] => "A and B",
                };
                let task = task.map_or("?", Task::name);
                let line = format!(
                    "{node:>6}  {policy:08x}  {task:15}  {:4}  {counter:7}  {confirmed:9}  {keys}",
                    slot.name()
                );
                text += &format!("{}\n", line.trim_end());
            }
        }
    }
    text
}

/// Why a module is on its policy: its records, the newest first.
pub fn records(station: &mut Station, node: u8) -> Result<Vec<Option<Record>>, BusError> {
    let mut records = Vec::new();
    for back in 0..=u8::MAX {
        let answer = station.answer_of(node, Operation::UpdateLog, back, 0)?;
        if answer.code == ServiceCode::NoSuchRegister as u8 {
            break;
        }
        if answer.code != ServiceCode::Ok as u8 {
            return Err(BusError::Refused { node, what: Operation::UpdateLog.name().into(), code: answer.code });
        }
        let [head, a, b, c] = answer.value.to_le_bytes();
        let kind = RecordKind::ALL.into_iter().find(|kind| *kind as u8 == head & 15);
        let record = kind.zip(Slot::from_number(head >> 4));
        records.push(record.map(|(kind, slot)| Record { kind, slot, value: u32::from_le_bytes([a, b, c, 0]) }));
    }
    Ok(records)
}

/// Everything that the modules know of themselves and of what happened to them, as JSON: who each is, its policies and why it has them, and its fault log.
pub fn export_log(station: &mut Station) -> Result<Value, BusError> {
    let nodes = station.meet()?;
    let mut modules = Vec::new();
    for node in nodes {
        let hello: serde_json::Map<String, Value> =
            station.hello(node)?.into_iter().map(|(name, value)| (name.replace(' ', "_"), value.into())).collect();
        let own = policies(station, node)?;
        let records: Vec<Value> = records(station, node)?
            .iter()
            .map(|record| match record {
                Some(record) => json!({
                    "what": format!("{:?}", record.kind),
                    "slot": record.slot.name(),
                    "value": record.value,
                    "text": record.to_string(),
                }),
                None => json!({ "what": null, "text": "a record that was cut short by a loss of power" }),
            })
            .collect();
        let faults: Vec<Value> = station
            .log(node)?
            .iter()
            .map(|entry| {
                json!({
                    "number": entry.number,
                    "start": entry.boot,
                    "time_ms": entry.time_ms,
                    "fault": entry.fault,
                    "data": entry.data,
                    "text": entry.to_string().split_whitespace().collect::<Vec<_>>().join(" "),
                })
            })
            .collect();
        modules.push(json!({
            "node": node,
            "hello": hello,
            "policy": {
                "crc": format!("{:08x}", own.policy),
                "task": own.task.map(Task::name),
                "slot": own.slot.name(),
                "on_trial": own.trial,
                "security_counter": own.counter,
                "keys": own.keys,
            },
            "policy_records": records,
            "fault_log": faults,
        }));
    }
    Ok(json!({ "modules": modules }))
}

/// Gives all modules the public key of who may change policy and limits from now on. Gives those. It counts from their next start on.
pub fn give_key(station: &mut Station, key: &[u8; 32], second: bool) -> Result<Vec<u8>, BusError> {
    use composer_shared::registers::Register;
    let register = if second { Register::KeyB } else { Register::KeyA };
    let nodes = station.meet()?;
    for node in &nodes {
        for (number, word) in register.numbers().zip(key.as_chunks::<4>().0) {
            station.request(*node, Operation::Write, number, u32::from_le_bytes(*word))?;
        }
    }
    for node in &nodes {
        station.request(*node, Operation::Store, 0, 0)?;
    }
    Ok(nodes)
}
