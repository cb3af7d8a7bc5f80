//! What the station may ask of a module besides its part in the control cycle: registers, node page, fault log, a jog of one axis.
//!
//! A request is one SERVICE_REQUEST frame with a destination, and every module that is addressed answers with one SERVICE_RESPONSE, which
//! repeats operation, sequence and index. [`Service`] is as free of I/O as the [`Controller`]: the board polls it after the
//! controller, with the frame that came, and sends what it offers after what the controller offers.
//!
//! | operation | index | value | answer | refused (code) |
//! |---|---|---|---|---|
//! | 1 HELLO | item | | the item, see below | there is none (2) |
//! | 2 ARM | | 1: after an unclean restart, too; 0 | | out of range (4), not armable (6), another station (10) |
//! | 3 DISARM | | | | |
//! | 4 CLEAR | | | | armed (5), another station (10) |
//! | 5 READ | register | | its value | no such register (2) |
//! | 6 WRITE | register | value | the value | no such register (2), read-only (3), out of range (4), armed (5), number taken (7), busy (9), another station (10) |
//! | 7 STORE | | | 0; if refused for its range, the register that does not fit | out of range (4), armed (5), storage failed (8), busy (9), another station (10) |
//! | 8 SET_NODE | 0, 1, 2 | word of the unique identifier | | another module's (7) |
//! | 8 SET_NODE | 3 | the module's new number | the number | out of range (4), armed (5), identifier not given or number taken (7), storage failed (8), busy (9), another station (10) |
//! | 9 JOG | axis | bits 0 to 15 current, signed, mA; 16 to 31 time, ms | the torque, f32 | no such axis (2), out of range (4), armed (5), a fault forbids (6), another station (10) |
//! | 10 IDENTIFY | | seconds | | out of range (4) |
//! | 11 LOG | entry, 0 the newest | word | the word, see below | no such entry or word (2) |
//! | 12 CLEAR_LOG | | | | armed (5), another station (10) |
//! | 13 RESTART | | | | armed (5), busy (9), another station (10) |
//! | 14 UPDATE | step: 0 begin | session, bytes | 1 if what was received before is still there | out of range (4), armed (5), storage failed (8), busy (9), another station (10), on trial (20) |
//! | 14 UPDATE | 1 verify | CRC-32 of the policy | the same | armed (5), busy (9), another station (10), and 11 to 20 |
//! | 14 UPDATE | 2 commit, 3 confirm | CRC-32 of the policy | the same | armed (5), storage failed (8), busy (9), another station (10), no update (11), on trial (20) |
//! | 14 UPDATE | 4 abandon | | | armed (5), storage failed (8), busy (9), another station (10), on trial (20) |
//! | 15 UPDATE_STATUS | item | | the item ([`Updater::item`]) | there is none (2) |
//! | 16 UPDATE_LOG | record, 0 the newest | | its first four bytes; 0 if it says nothing | no such record (2) |
//!
//! HELLO's items: 0 versions of protocol, firmware and node page and number of modules, a byte each from bit 0 on; 1 to 3 the words of
//! the unique identifier; 4 the CRC-32 of the policy image; 5 reset reason (bits 0 to 7), resets in a row (8 to 15), starts (16 to 31).
//!
//! # Only while disarmed
//!
//! What moves or forgets anything is refused while the module is armed: WRITE to a field of the node page, STORE, SET_NODE, JOG, CLEAR, CLEAR_LOG,
//! RESTART, UPDATE. A module whose policy is on trial is not armed (code 20).
//!
//! # Node page
//!
//! WRITE changes a copy of the page; STORE checks it as a whole and keeps it ([`crate::storage`]); it counts from the next start on. Its
//! answer comes when the page lies in the flash, some 50 ms later. A module with a key takes no WRITE to its node page but that of its number (code 21): limits and keys are
//! as much the key holder's as the policy.
//!
//! # Update
//!
//! [`crate::update`]. A policy that is on trial is given up, and the module restarts, if nobody confirms it in [`TRIAL_CYCLES`] control cycles, or twice their time.
//!
//! # A number for a module
//!
//! Two modules with the same number cannot be told apart by it. SET_NODE addresses a chip: to all modules (destination 255) go the three words of one's unique
//! identifier, and only that one takes the number that follows within [`SELECTED_US`]. It is stored at once and counts from the next start on. A module that has fallen
//! silent because of its twin does so, too, without an answer.
//!
//! # Jog
//!
//! One axis at no more than half of the motor's largest current and for no more than [`JOG_MAX_MS`]. All limits hold, and every fault that relaxes ends it;
//! DISARM, a stop, or a current of 0 ends it, too.
//!
//! # Another station
//!
//! The station has one identifier, so two of them cannot be told apart by it, but by their sequence numbers: each counts its own, one a request, from any number on. A
//! station is at work if it has been changing things for at least [`AT_WORK_US`], the last one less than [`STATION_US`] ago. Then a request that changes something is
//! refused (code 10) if its sequence number is more than [`SEQUENCE_NEAR`] away. HELLO, READ, LOG, IDENTIFY, DISARM, UPDATE_STATUS and UPDATE_LOG change nothing and are never refused for that.
//!
//! # Fault log
//!
//! An entry for each start, and for each fault when it becomes active, but of each number only one in [`LOG_AGAIN_MS`]. Words of LOG: 0 number of the entry, 1 time
//! since the start in ms, 2 start (bits 0 to 15) and fault (16 to 23; 0: the module started), 3 data. Word 0 chooses the entry that the other words
//! are of, so that an entry that is written in between does no harm. Data is, by fault:
//!
//! | fault | data |
//! |---|---|
//! | 0 start | reset reason (bits 0 to 7), resets in a row (8 to 15) |
//! | 37 OverTemperature | the hotter motor, 0.1 degrees Celsius, signed |
//! | 39 Sensors | bits 0 to 3: encoders without a reading |
//! | 43 UnderVoltage, 44 OverVoltage | supply, mV |
//! | 45 OverCurrent | bits 0 and 1: motors that are cut off |
//! | others | lower 16 bits of the cycle |

use composer_shared::observation::Sensors;
use composer_shared::registers::{Access, Register};
use composer_shared::robot::{AXES, MAX_JOINTS};
use composer_shared::update::Key;
use composer_shared::wire::{
    Fault, Frame, Function, Heartbeat, Message, Mode, NOBODY, Operation, PROTOCOL_VERSION, ServiceCode, ServiceRequest,
    ServiceResponse,
};
use embedded_storage::nor_flash::NorFlash;

use crate::controller::{BusKind, Controller, FIRMWARE_VERSION, Micros};
use crate::drivers::motor::Trip;
use crate::failsafe::{BusOffPolicy, FaultSet};
use crate::node_page::{self, NodePage, NodePageError};
use crate::port::PortStatus;
use crate::storage::{Entry, FaultLog, Save, is_doubled};
use crate::update::{PolicyFlash, TRIAL_CYCLES, Updater};

/// The longest jog.
pub const JOG_MAX_MS: u16 = 2_000;
/// Part of a motor's largest current that a jog may take.
const JOG_PART: f32 = 0.5;
/// The longest time for which the light flashes, s.
const IDENTIFY_MAX_S: u32 = 600;
/// How long a change of the light takes.
const FLASH_US: u64 = 100_000;
/// How long a unique identifier is remembered for SET_NODE.
pub const SELECTED_US: u64 = 2_000_000;
/// How long a station is remembered after it changed something.
pub const STATION_US: u64 = 1_500_000;
/// How long it must have been changing things to keep others from it: a single command from a shell keeps nobody out.
pub const AT_WORK_US: u64 = 300_000;
/// How far apart the sequence numbers of one station may be, when frames are lost or sent again.
pub const SEQUENCE_NEAR: u8 = 8;
/// Time between two entries of the same fault.
pub const LOG_AGAIN_MS: u32 = 10_000;
/// From the answer to RESTART to the restart, so that the answer gets onto the bus.
const RESTART_US: u64 = 50_000;
/// How long a module counts as heard, at least, and at most twice as long.
const HEARD_US: u64 = 500_000;
/// Answers that may wait to be sent.
const ANSWERS: usize = 8;
/// What `encoder_raw` reads if there is no reading.
const NO_READING: u32 = u32::MAX;

/// What the board knows and the controller does not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Raw {
    /// What the encoders read, without zero and direction.
    pub encoders: [Option<u16>; MAX_JOINTS],
    /// Readings of each that failed.
    pub encoder_errors: [u32; MAX_JOINTS],
    /// Specific force in the axes of the inertial sensor, g.
    pub force: [f32; 3],
    /// Angular rate in the axes of the inertial sensor, rad/s.
    pub rate: [f32; 3],
    /// Readings of the inertial sensor that failed.
    pub imu_errors: u32,
    /// Supply, V.
    pub supply: f32,
    /// Motor temperatures, degrees Celsius.
    pub temperatures: [f32; AXES],
    /// Motor currents, A.
    pub currents: [f32; AXES],
    /// How the CAN port is.
    pub port: PortStatus,
}

/// The hardware that a service needs.
pub trait Board {
    /// Where node page and fault log lie, see [`crate::storage`].
    type Flash: NorFlash;

    /// Where node page and fault log lie.
    fn storage(&mut self) -> &mut Self::Flash;

    /// Where policies lie, see [`crate::update`].
    type Policies: PolicyFlash;

    /// Where policies lie.
    fn policies(&mut self) -> &mut Self::Policies;

    /// The chip's unique identifier.
    fn unique_id(&self) -> [u32; 3];

    /// The latest readings.
    fn raw(&self) -> Raw;
}

/// What waits for the flash.
#[derive(Clone, Copy, Debug)]
enum Job {
    /// The node page of before, to mend its other place.
    Mend,
    /// The node page, for this request.
    Store(ServiceRequest),
}

/// The station that changed something last.
#[derive(Clone, Copy, Debug)]
struct Station {
    sequence: u8,
    /// Since when it has been changing things.
    since: Micros,
    /// When it did last.
    last: Micros,
}

/// The service of one module.
#[derive(Clone, Debug)]
pub struct Service {
    node: u8,
    fd: bool,
    started: Micros,
    /// The page as it was written so far.
    page: NodePage,
    /// It was written since it was stored.
    changed: bool,
    /// Of the page that counts: torque per ampere, and largest current.
    motors: [(f32, f32); AXES],
    token: u32,
    saving: Option<(Save, Job)>,
    restart_at: Option<Micros>,
    light_until: Option<Micros>,
    /// Words of the unique identifier that were given, and when the first was.
    selected: u8,
    selected_at: Micros,
    station: Option<Station>,
    /// Modules heard in this and in the last stretch of [`HEARD_US`], and when this one began.
    heard: [u64; 2],
    heard_since: Micros,
    answers: [Option<ServiceResponse>; ANSWERS],
    log: FaultLog,
    /// The entry that LOG chose last, and which it was.
    chosen: Option<(u8, Entry)>,
    faults: FaultSet,
    /// When a fault of each number was last logged, ms.
    logged: [Option<u32>; Fault::ALL.len()],
    storage_errors: u32,
    updater: Updater,
}

impl Service {
    /// The service of a module that starts at `now` with this node page and the policy that `updater` says.
    pub fn new(
        page: NodePage,
        updater: Updater,
        controller: &mut Controller<'_>,
        now: Micros,
        board: &mut impl Board,
    ) -> Self {
        controller.leave_requests();
        let log = FaultLog::open(board.storage());
        let mut service = Service {
            node: controller.config().node,
            fd: controller.config().bus == BusKind::Fd,
            started: now,
            page,
            changed: false,
            motors: page.calibration.motors.map(|motor| (motor.torque_constant, motor.current_limit)),
            token: 0,
            saving: None,
            restart_at: None,
            light_until: None,
            selected: 0,
            selected_at: 0,
            station: None,
            heard: [0; 2],
            heard_since: now,
            answers: [None; ANSWERS],
            log,
            chosen: None,
            faults: FaultSet::EMPTY,
            logged: [None; Fault::ALL.len()],
            storage_errors: 0,
            updater,
        };
        controller.set_remark(service.remark());
        let boot = controller.boot();
        service.log.push(0, 0, u16::from(boot.reason()) | u16::from(boot.resets_in_a_row()) << 8);
        if !is_doubled(board.storage()) {
            service.saving = Some((Save::new(board.storage()), Job::Mend));
        }
        service
    }

    /// Goes on to `now`: serves the request in the frame that was received, if it is one, and does one thing that is due. Call it after every
    /// poll of the controller, with the same frame.
    #[inline(never)] // The linked image is checked from here on: `tests/tests/image.rs`.
    pub fn poll(
        &mut self,
        now: Micros,
        controller: &mut Controller<'_>,
        sensors: &Sensors,
        received: Option<&Frame>,
        board: &mut impl Board,
    ) {
        self.watch(now, controller, board);
        self.hear(now, received);
        if let Some(frame) = received {
            self.take(now, frame, controller, sensors, board);
        }
        self.watch_trial(now, controller);
        self.work(controller, board);
    }

    fn take(
        &mut self,
        now: Micros,
        frame: &Frame,
        controller: &mut Controller<'_>,
        sensors: &Sensors,
        board: &mut impl Board,
    ) {
        match frame.function() {
            Some(Function::ServiceRequest) => {
                if let Ok(Message::ServiceRequest(request)) = Message::parse(frame) {
                    self.receive(now, &request, controller, sensors, board);
                }
            }
            Some(Function::UpdateChunk | Function::UpdatePiece) if !controller.armed() => match Message::parse(frame) {
                Ok(Message::UpdateChunk(chunk)) => self.updater.hear_chunk(&chunk),
                Ok(Message::UpdatePiece(piece)) => self.updater.hear_piece(&piece),
                _ => {}
            },
            _ => {}
        }
    }

    /// Ends a trial that takes too long.
    fn watch_trial(&mut self, now: Micros, controller: &Controller<'_>) {
        if self.updater.given_up() && self.restart_at.is_none() {
            self.restart_at = Some(now.saturating_add(RESTART_US));
        } else if self.updater.on_trial() {
            let time = 2 * u64::from(TRIAL_CYCLES) * u64::from(controller.config().timing.period_us);
            if controller.stats().cycles >= TRIAL_CYCLES || now.saturating_sub(self.started) >= time {
                self.updater.give_up();
            }
        }
    }

    /// What HEARTBEAT says of the policy.
    fn remark(&self) -> u8 {
        let lab = if self.updater.lab() { Heartbeat::LAB } else { 0 };
        lab | if self.updater.on_trial() { Heartbeat::TRIAL } else { 0 }
    }

    /// Its policies.
    pub fn updater(&self) -> &Updater {
        &self.updater
    }

    /// The next answer to send.
    #[inline(never)] // Like `poll`.
    pub fn next_frame(&mut self, controller: &Controller<'_>) -> Option<Frame> {
        // Most of the time there is none.
        let first = self.answers.first().copied().flatten()?;
        if controller.silenced() {
            self.answers = [None; ANSWERS];
            return None;
        }
        let mut moved = [None; ANSWERS];
        moved.iter_mut().zip(self.answers.iter().skip(1)).for_each(|(to, from)| *to = *from);
        self.answers = moved;
        Some(Message::ServiceResponse(first).emit(self.node, self.fd))
    }

    /// Whether something is on its way into the flash. It goes on with every poll, or with [`Service::work`].
    pub fn is_busy(&self) -> bool {
        self.saving.is_some() || self.log.is_busy() || self.updater.is_busy()
    }

    /// When to poll again at the latest.
    pub fn deadline(&self) -> Micros {
        self.restart_at.unwrap_or(Micros::MAX)
    }

    /// Whether the module is to be restarted now.
    pub fn restart_due(&self, now: Micros) -> bool {
        self.restart_at.is_some_and(|at| now >= at)
    }

    /// What the light shows while the station wants to see which module this is; none: what it always shows.
    pub fn light(&self, now: Micros) -> Option<bool> {
        self.light_until.filter(|until| now < *until).map(|until| until.saturating_sub(now) / FLASH_US % 2 == 1)
    }

    fn time_ms(&self, now: Micros) -> u32 {
        u32::try_from(now.saturating_sub(self.started) / 1000).unwrap_or(u32::MAX)
    }

    /// Notes whose number is taken. The controller's neighbours do not say that: it believes all alive until they prove silent.
    fn hear(&mut self, now: Micros, received: Option<&Frame>) {
        let [this, last] = &mut self.heard;
        if now.saturating_sub(self.heard_since) >= HEARD_US {
            (*last, *this, self.heard_since) = (*this, 0, now);
        }
        if let Some(frame) = received {
            *this |= 1u64.checked_shl(frame.module().into()).unwrap_or(0);
        }
    }

    /// Logs the faults that have become active.
    fn watch(&mut self, now: Micros, controller: &Controller<'_>, board: &mut impl Board) {
        let faults = controller.faults();
        let before = core::mem::replace(&mut self.faults, faults);
        if faults == before {
            return;
        }
        let time = self.time_ms(now);
        for (fault, logged) in Fault::ALL.into_iter().zip(&mut self.logged) {
            let again = logged.is_none_or(|last| time.saturating_sub(last) >= LOG_AGAIN_MS);
            if faults.contains(fault) && !before.contains(fault) && again {
                *logged = Some(time);
                self.log.push(time, fault as u8, data_of(fault, controller, &board.raw()));
            }
        }
    }

    /// Does one thing with the flash, if there is something to do.
    pub fn work(&mut self, controller: &mut Controller<'_>, board: &mut impl Board) {
        let updating = self.updater.is_busy();
        if self.saving.is_none() && self.log.is_idle() && !updating {
            return;
        }
        let may_erase = !controller.armed() && controller.mode() != Mode::Service;
        if updating && may_erase && self.saving.is_none() {
            if let Some((request, result)) = self.updater.work(board.policies()) {
                self.answer(match result {
                    Ok(value) => request.answer(ServiceCode::Ok, value),
                    Err(code) => request.answer(code, 0),
                });
            }
            return controller.set_remark(self.remark());
        }
        let Some((save, job)) = self.saving.as_mut().filter(|_| may_erase) else {
            return self.log.work(board.storage(), may_erase);
        };
        // What is mended is what was read at the start, and nothing may be written before that is done.
        let Some(result) = save.step(board.storage(), &self.page) else { return };
        let job = *job;
        self.saving = None;
        if result.is_err() {
            self.storage_errors = self.storage_errors.saturating_add(1);
        }
        if let Job::Store(request) = job {
            self.changed &= result.is_err();
            let node = u32::from(self.page.node);
            let value = if request.operation == Operation::SetNode as u8 { node } else { 0 };
            self.answer(match result {
                Ok(()) => request.answer(ServiceCode::Ok, value),
                Err(_) => request.answer(ServiceCode::StorageFailed, 0),
            });
        }
    }

    /// An answer for which there is no room is lost; the station asks again.
    fn answer(&mut self, response: ServiceResponse) {
        if let Some(slot) = self.answers.iter_mut().find(|slot| slot.is_none()) {
            *slot = Some(response);
        }
    }

    fn receive(
        &mut self,
        now: Micros,
        request: &ServiceRequest,
        controller: &mut Controller<'_>,
        sensors: &Sensors,
        board: &mut impl Board,
    ) {
        let operation = Operation::from_number(request.operation);
        let other = self.is_another_station(now, request, operation);
        if !request.is_for(self.node) {
            return;
        }
        let result = match operation {
            None => Err(ServiceCode::UnknownOperation),
            Some(_) if other => Err(ServiceCode::AnotherStation),
            Some(operation) => self.serve(now, operation, request, controller, sensors, board),
        };
        match result {
            Ok(Some(value)) => self.answer(request.answer(ServiceCode::Ok, value)),
            // The answer comes later.
            Ok(None) => {}
            // The range that does not fit has been answered with its register.
            Err(code) => self.answer(request.answer(code, 0)),
        }
    }

    /// Follows the sequence numbers of all requests, for whomever they are, and says whether this one is not the working station's.
    fn is_another_station(&mut self, now: Micros, request: &ServiceRequest, operation: Option<Operation>) -> bool {
        let changes = operation.is_some_and(changes);
        let sequence = request.sequence;
        if let Some(known) = self.station.filter(|known| now.saturating_sub(known.last) < STATION_US) {
            let ahead = sequence.wrapping_sub(known.sequence);
            if ahead <= SEQUENCE_NEAR || ahead.wrapping_neg() <= SEQUENCE_NEAR {
                self.station = Some(Station { sequence, last: if changes { now } else { known.last }, ..known });
                return false;
            }
            if !changes {
                return false;
            }
            if known.last.saturating_sub(known.since) >= AT_WORK_US {
                return true;
            }
        }
        if changes {
            self.station = Some(Station { sequence, since: now, last: now });
        }
        false
    }

    fn serve(
        &mut self,
        now: Micros,
        operation: Operation,
        request: &ServiceRequest,
        controller: &mut Controller<'_>,
        sensors: &Sensors,
        board: &mut impl Board,
    ) -> Result<Option<u32>, ServiceCode> {
        let disarmed = if controller.armed() { Err(ServiceCode::Armed) } else { Ok(()) };
        let ServiceRequest { index, value, .. } = *request;
        match operation {
            Operation::Hello => self.hello(index, controller, board).map(Some),
            Operation::Arm if value > 1 => Err(ServiceCode::OutOfRange),
            Operation::Arm if self.updater.on_trial() => Err(ServiceCode::OnTrial),
            Operation::Arm => controller.arm(value == 1).map(|()| Some(0)),
            Operation::Disarm => {
                controller.disarm();
                Ok(Some(0))
            }
            Operation::Clear => {
                disarmed?;
                controller.clear();
                Ok(Some(0))
            }
            Operation::Read => self.read(now, index, controller, sensors, board).map(Some),
            Operation::Write => self.write(index, value, controller).map(Some),
            Operation::Store => {
                disarmed?;
                self.free()?;
                at_rest(controller)?;
                if let Err(error) = self.page.check() {
                    self.answer(request.answer(ServiceCode::OutOfRange, u32::from(culprit(&error))));
                    return Ok(None);
                }
                self.saving = Some((Save::new(board.storage()), Job::Store(*request)));
                Ok(None)
            }
            Operation::SetNode => self.set_node(now, request, controller, board),
            Operation::Jog => {
                disarmed?;
                self.free()?;
                self.jog(index, value, controller).map(Some)
            }
            Operation::Identify => {
                if value > IDENTIFY_MAX_S {
                    return Err(ServiceCode::OutOfRange);
                }
                self.light_until = Some(now.saturating_add(u64::from(value) * 1_000_000));
                Ok(Some(0))
            }
            Operation::Log => self.entry(index, value, board).map(Some),
            Operation::ClearLog => {
                disarmed?;
                let time = self.time_ms(now);
                self.log.clear(time);
                self.chosen = None;
                Ok(Some(0))
            }
            Operation::Restart => {
                disarmed?;
                self.free()?;
                self.restart_at = Some(now.saturating_add(RESTART_US));
                Ok(Some(0))
            }
            Operation::Update => {
                disarmed?;
                self.free()?;
                at_rest(controller)?;
                self.updater.serve(request, controller.policy().crc())
            }
            Operation::UpdateStatus if index == 23 => Ok(Some(controller.policy().task() as u32)),
            Operation::UpdateStatus => self.updater.item(index).map(Some).ok_or(ServiceCode::NoSuchRegister),
            Operation::UpdateLog => {
                if u32::from(index) >= self.updater.records().count() {
                    return Err(ServiceCode::NoSuchRegister);
                }
                let record = self.updater.records().back(board.policies(), index.into());
                Ok(Some(record.map_or(0, |record| {
                    let [a, b, c, d, ..] = record.emit();
                    u32::from_le_bytes([a, b, c, d])
                })))
            }
        }
    }

    /// Whether the flash is free for another page, or another step of an update.
    fn free(&self) -> Result<(), ServiceCode> {
        if self.saving.is_some() || self.updater.is_busy() { Err(ServiceCode::Busy) } else { Ok(()) }
    }

    fn hello(&self, item: u8, controller: &Controller<'_>, board: &impl Board) -> Result<u32, ServiceCode> {
        let boot = controller.boot();
        Ok(match item {
            0 => u32::from_le_bytes([
                PROTOCOL_VERSION,
                FIRMWARE_VERSION,
                node_page::VERSION as u8,
                controller.config().modules,
            ]),
            1..=3 => word(&board.unique_id(), item - 1),
            4 => controller.policy().crc(),
            5 => {
                let [low, high] = self.log.boot().to_le_bytes();
                u32::from_le_bytes([boot.reason(), boot.resets_in_a_row(), low, high])
            }
            _ => return Err(ServiceCode::NoSuchRegister),
        })
    }

    fn set_node(
        &mut self,
        now: Micros,
        request: &ServiceRequest,
        controller: &Controller<'_>,
        board: &mut impl Board,
    ) -> Result<Option<u32>, ServiceCode> {
        let ServiceRequest { index, value, .. } = *request;
        match index {
            0..=2 => {
                if index == 0 {
                    (self.selected, self.selected_at) = (0, now);
                }
                if word(&board.unique_id(), index) != value {
                    self.selected = 0;
                    return Err(ServiceCode::WrongModule);
                }
                self.selected |= 1 << index;
                Ok(Some(0))
            }
            3 => {
                if self.selected != 7 || now.saturating_sub(self.selected_at) >= SELECTED_US {
                    return Err(ServiceCode::WrongModule);
                }
                self.free()?;
                at_rest(controller)?;
                let node = Register::Node.spec().first;
                self.write(node, value, controller)?;
                self.selected = 0;
                if let Err(error) = self.page.check() {
                    self.answer(request.answer(ServiceCode::OutOfRange, u32::from(culprit(&error))));
                    return Ok(None);
                }
                self.saving = Some((Save::new(board.storage()), Job::Store(*request)));
                Ok(None)
            }
            _ => Err(ServiceCode::NoSuchRegister),
        }
    }

    fn jog(&mut self, axis: u8, value: u32, controller: &mut Controller<'_>) -> Result<u32, ServiceCode> {
        let (constant, limit) = *self.motors.get(usize::from(axis)).ok_or(ServiceCode::NoSuchRegister)?;
        let (current, time_ms) = (f32::from(value as u16 as i16) / 1000.0, (value >> 16) as u16);
        if current.abs() > JOG_PART * limit || time_ms > JOG_MAX_MS {
            return Err(ServiceCode::OutOfRange);
        }
        let torque = current * constant;
        controller.jog(usize::from(axis), torque, u32::from(time_ms) * 1000)?;
        Ok(torque.to_bits())
    }

    fn entry(&mut self, back: u8, which: u32, board: &mut impl Board) -> Result<u32, ServiceCode> {
        let chosen = match self.chosen {
            Some((chosen, entry)) if which > 0 && chosen == back => Some(entry),
            _ => self.log.entry(board.storage(), u32::from(back)),
        };
        let entry = chosen.ok_or(ServiceCode::NoSuchRegister)?;
        self.chosen = Some((back, entry));
        match which {
            0 => Ok(entry.number),
            1 => Ok(entry.time_ms),
            2 => Ok(u32::from(entry.boot) | u32::from(entry.fault) << 16),
            3 => Ok(entry.data.into()),
            _ => Err(ServiceCode::NoSuchRegister),
        }
    }

    fn write(&mut self, number: u8, value: u32, controller: &Controller<'_>) -> Result<u32, ServiceCode> {
        let (register, spec, offset) = Register::by_number(number).ok_or(ServiceCode::NoSuchRegister)?;
        if spec.access == Access::ReadOnly {
            return Err(ServiceCode::ReadOnly);
        }
        if !spec.accepts(value) {
            return Err(ServiceCode::OutOfRange);
        }
        if spec.access == Access::WhileDisarmed {
            if controller.armed() {
                return Err(ServiceCode::Armed);
            }
            if register != Register::Node && !self.updater.lab() {
                return Err(ServiceCode::Locked);
            }
            // A page on its way into the flash must not change.
            self.free()?;
        }
        match register {
            Register::Token => self.token = value,
            Register::Node => {
                let number = value as u8;
                if number >= self.page.modules {
                    return Err(ServiceCode::OutOfRange);
                }
                let [this, last] = self.heard;
                if number != self.node && (this | last) >> (number & 63) & 1 != 0 {
                    return Err(ServiceCode::WrongModule);
                }
                self.page.node = number;
                self.changed = true;
            }
            _ => {
                set(&mut self.page, register, offset, value);
                self.changed = true;
            }
        }
        Ok(value)
    }

    fn read(
        &self,
        now: Micros,
        number: u8,
        controller: &Controller<'_>,
        sensors: &Sensors,
        board: &impl Board,
    ) -> Result<u32, ServiceCode> {
        let (register, spec, offset) = Register::by_number(number).ok_or(ServiceCode::NoSuchRegister)?;
        if spec.is_stored() {
            return Ok(get(&self.page, register, offset));
        }
        let (stats, boot) = (controller.stats(), controller.boot());
        let (raw, trips) = (board.raw(), controller.power().trips());
        let counts = &raw.port.counts;
        let half = |mask: u64| (mask >> (32 * u32::from(offset & 1))) as u32;
        let float = |values: &[f32]| values.get(usize::from(offset)).copied().unwrap_or(f32::NAN).to_bits();
        Ok(match register {
            Register::Protocol => PROTOCOL_VERSION.into(),
            Register::Firmware => FIRMWARE_VERSION.into(),
            Register::Policy => controller.policy().crc(),
            Register::PageVersion => node_page::VERSION.into(),
            Register::UniqueId => word(&board.unique_id(), offset),
            Register::PageChanged => self.changed.into(),
            Register::Token => self.token,
            Register::Mode => controller.mode() as u32,
            Register::Faults => controller.faults().bits(),
            Register::LimitedBy => controller.limited_by() as u32,
            Register::Cycle => controller.cycle().into(),
            Register::TimeKeeper => controller.time_keeper().unwrap_or(NOBODY).into(),
            Register::Alive => half(controller.alive()),
            Register::Heard => half(controller.heard()),
            Register::ResetReason => boot.reason().into(),
            Register::Resets => boot.resets_in_a_row().into(),
            Register::Boots => self.log.boot().into(),
            Register::Uptime => self.time_ms(now),
            Register::Cycles => stats.cycles,
            Register::Acted => stats.acted,
            Register::DeadlineMisses => stats.deadline_misses,
            Register::LatentAge => stats.latent_age_us,
            Register::LatentAgeMax => stats.latent_age_max_us,
            Register::Malformed => stats.malformed,
            Register::Foreign => stats.foreign,
            Register::Stale => stats.stale,
            Register::Takeovers => stats.takeovers,
            Register::WithoutSync => stats.without_sync,
            Register::RxOverflow => counts.overflowed,
            Register::Aborted => counts.displaced.saturating_add(counts.replaced).saturating_add(counts.stale),
            Register::Tec => raw.port.transmit_errors.into(),
            Register::Rec => raw.port.receive_errors.into(),
            Register::BusOffs => counts.bus_off,
            Register::TxLost => counts.crowded,
            Register::Trips => trips.total().get(usize::from(offset)).copied().unwrap_or_default().into(),
            Register::Trip => trips.reasons().get(usize::from(offset)).copied().flatten().map_or(0, trip_number),
            Register::EncoderErrors => word(&raw.encoder_errors, offset),
            Register::ImuErrors => raw.imu_errors,
            Register::StorageErrors => {
                self.storage_errors.saturating_add(self.log.errors()).saturating_add(self.updater.errors())
            }
            Register::LogNewest => self.log.newest(),
            Register::LogLost => self.log.lost(),
            Register::EncoderRaw => {
                raw.encoders.get(usize::from(offset)).copied().flatten().map_or(NO_READING, u32::from)
            }
            Register::JointAngle => float(&sensors.joint_angles),
            Register::JointSpeed => float(&sensors.joint_speeds),
            Register::Acceleration => float(&raw.force),
            Register::Rate => float(&raw.rate),
            Register::Up => float(&sensors.up),
            Register::Supply => raw.supply.to_bits(),
            Register::Temperature => float(&raw.temperatures),
            Register::Current => float(&raw.currents),
            Register::TorqueCommand => float(&controller.torque()),
            Register::Torque => float(&sensors.torque),
            // Fields of the node page were read above.
            _ => return Err(ServiceCode::NoSuchRegister),
        })
    }
}

/// Whether an operation changes something, and so is one station's at a time.
fn changes(operation: Operation) -> bool {
    !matches!(
        operation,
        Operation::Hello
            | Operation::Read
            | Operation::Log
            | Operation::Identify
            | Operation::Disarm
            | Operation::UpdateStatus
            | Operation::UpdateLog
    )
}

fn word(words: &[u32], which: u8) -> u32 {
    words.get(usize::from(which)).copied().unwrap_or_default()
}

/// What the log says of a fault besides its number.
fn data_of(fault: Fault, controller: &Controller<'_>, raw: &Raw) -> u16 {
    match fault {
        Fault::OverTemperature => {
            let hottest = raw.temperatures.iter().fold(f32::MIN, |a, b| a.max(*b));
            (hottest * 10.0) as i16 as u16
        }
        Fault::Sensors => mask(raw.encoders.iter().map(Option::is_none)),
        Fault::UnderVoltage | Fault::OverVoltage => (raw.supply * 1000.0) as u16,
        Fault::OverCurrent => mask((0..AXES).map(|axis| controller.power().trips().off(axis))),
        _ => controller.cycle(),
    }
}

/// The number of a reason for a cut-off, for the bus.
fn trip_number(trip: Trip) -> u32 {
    match trip {
        Trip::Overcurrent => 1,
        Trip::CurrentSense => 2,
        Trip::Output => 3,
    }
}

/// Bit n says the n-th.
fn mask(bits: impl Iterator<Item = bool>) -> u16 {
    bits.zip(0u16..16).fold(0, |mask, (set, n)| mask | u16::from(set) << n)
}

/// The registers of the fields that [`NodePage::check`] may complain about.
const FIELDS: [(&str, Register); 19] = [
    ("number of modules", Register::Modules),
    ("number of this module", Register::Node),
    ("zero of an encoder", Register::EncoderZero),
    ("least angle of a joint", Register::JointMin),
    ("greatest angle of a joint", Register::JointMax),
    ("dead-man time", Register::DeadMan),
    ("mounting of the inertial sensor", Register::ImuMounting),
    ("cap of the torque", Register::TorqueCap),
    ("cap of the slew", Register::SlewCap),
    ("cap of the motor temperature", Register::TemperatureCap),
    ("lowest supply", Register::SupplyUnder),
    ("highest supply", Register::SupplyOver),
    ("torque constant", Register::TorqueConstant),
    ("current limit", Register::CurrentLimit),
    ("winding resistance", Register::Resistance),
    ("winding inductance", Register::Inductance),
    ("range of the current sense", Register::SenseRange),
    ("zero of the current sense", Register::SenseZero),
    ("cut-off current", Register::CutOff),
];

/// The first register of the field that makes a page impossible.
fn culprit(error: &NodePageError) -> u8 {
    let NodePageError::Value { field, .. } = error else { return 0 };
    FIELDS.iter().find(|(name, _)| name == field).map_or(0, |(_, register)| register.spec().first)
}

/// A field of the node page, as bits.
fn get(page: &NodePage, register: Register, offset: u8) -> u32 {
    let at = usize::from(offset);
    let NodePage { node, modules, bus_off, safety, calibration, keys: [key_a, key_b] } = page;
    let joint = calibration.joints.get(at).copied().unwrap_or_default();
    let range = safety.joints.get(at);
    let motor = calibration.motors.get(at);
    let float = match register {
        Register::Node => return (*node).into(),
        Register::Modules => return (*modules).into(),
        Register::BusOff => return (*bus_off == BusOffPolicy::Latch).into(),
        Register::BlindActs => return (!safety.blind_relaxes).into(),
        Register::EncoderZero => return joint.zero.into(),
        Register::EncoderReversed => return joint.reversed.into(),
        Register::DeadMan => return safety.dead_man_ms.into(),
        Register::KeyA => return word_of(key_a, at),
        Register::KeyB => return word_of(key_b, at),
        Register::ImuMounting => calibration.imu_mounting.as_flattened().get(at).copied().unwrap_or(f32::NAN),
        Register::TorqueConstant => motor.map_or(f32::NAN, |m| m.torque_constant),
        Register::CurrentLimit => motor.map_or(f32::NAN, |m| m.current_limit),
        Register::CutOff => motor.map_or(f32::NAN, |m| m.cut_off),
        Register::Resistance => motor.map_or(f32::NAN, |m| m.resistance),
        Register::Inductance => motor.map_or(f32::NAN, |m| m.inductance),
        Register::SenseRange => motor.map_or(f32::NAN, |m| m.sense_range),
        Register::SenseZero => motor.map_or(f32::NAN, |m| m.sense_zero),
        Register::JointMin => range.map_or(f32::NAN, |range| range.min),
        Register::JointMax => range.map_or(f32::NAN, |range| range.max),
        Register::TorqueCap => safety.caps.torque,
        Register::SlewCap => safety.caps.torque_slew,
        Register::TemperatureCap => safety.caps.temperature,
        Register::SupplyUnder => safety.supply.under,
        Register::SupplyOver => safety.supply.over,
        // Not of the page.
        _ => f32::NAN,
    };
    float.to_bits()
}

/// Word `at` of a key.
fn word_of(key: &Key, at: usize) -> u32 {
    key.as_chunks().0.get(at).map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

fn set_word(key: &mut Key, at: usize, value: u32) {
    key.as_chunks_mut().0.get_mut(at).into_iter().for_each(|bytes| *bytes = value.to_le_bytes());
}

/// Writes a field of the node page; the value lies in the register's range.
fn set(page: &mut NodePage, register: Register, offset: u8, value: u32) {
    let at = usize::from(offset);
    let float = f32::from_bits(value);
    let NodePage { node, modules, bus_off, safety, calibration, keys: [key_a, key_b] } = page;
    let joint = calibration.joints.get_mut(at);
    let range = safety.joints.get_mut(at);
    let motor = calibration.motors.get_mut(at);
    let place = match register {
        Register::Node => return *node = value as u8,
        Register::Modules => return *modules = value as u8,
        Register::BusOff => {
            return *bus_off = if value == 0 { BusOffPolicy::Recover } else { BusOffPolicy::Latch };
        }
        Register::BlindActs => return safety.blind_relaxes = value == 0,
        Register::EncoderZero => return joint.into_iter().for_each(|joint| joint.zero = value as u16),
        Register::EncoderReversed => return joint.into_iter().for_each(|joint| joint.reversed = value != 0),
        Register::DeadMan => return safety.dead_man_ms = value as u16,
        Register::KeyA => return set_word(key_a, at, value),
        Register::KeyB => return set_word(key_b, at, value),
        Register::ImuMounting => calibration.imu_mounting.as_flattened_mut().get_mut(at),
        Register::TorqueConstant => motor.map(|m| &mut m.torque_constant),
        Register::CurrentLimit => motor.map(|m| &mut m.current_limit),
        Register::CutOff => motor.map(|m| &mut m.cut_off),
        Register::Resistance => motor.map(|m| &mut m.resistance),
        Register::Inductance => motor.map(|m| &mut m.inductance),
        Register::SenseRange => motor.map(|m| &mut m.sense_range),
        Register::SenseZero => motor.map(|m| &mut m.sense_zero),
        Register::JointMin => range.map(|range| &mut range.min),
        Register::JointMax => range.map(|range| &mut range.max),
        Register::TorqueCap => Some(&mut safety.caps.torque),
        Register::SlewCap => Some(&mut safety.caps.torque_slew),
        Register::TemperatureCap => Some(&mut safety.caps.temperature),
        Register::SupplyUnder => Some(&mut safety.supply.under),
        Register::SupplyOver => Some(&mut safety.supply.over),
        // Not of the page.
        _ => None,
    };
    if let Some(place) = place {
        *place = float;
    }
}

/// Nothing is written to the flash while a motor jogs.
fn at_rest(controller: &Controller<'_>) -> Result<(), ServiceCode> {
    if controller.mode() == Mode::Service { Err(ServiceCode::Busy) } else { Ok(()) }
}

#[cfg(test)]
mod tests;
