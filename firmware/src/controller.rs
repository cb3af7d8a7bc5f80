//! One module as a state machine without I/O.
//!
//! # The control cycle
//!
//! 1. SYNC starts cycle *c*. The *time-keeper* sends it: the live module nearest the head.
//! 2. The module samples its sensors and sends STATE(*c*). As soon as it has the STATE(*c*) of every live neighbour and the station's
//!    GOAL(*c*), or at the state deadline, it computes its observation, encodes it and sends LATENT(*c*).
//! 3. As soon as it has the LATENT(*c*) of every live neighbour, or at the collection deadline, it attends over those it has, acts,
//!    and applies the torque within its limits. What comes later is masked.
//!
//! A neighbour that is silent for [`Timing::dead_after`] cycles is not waited for any more; a fresh frame brings it back.
//!
//! # Time-keeper
//!
//! There is no election traffic. A module that hears no SYNC for [`Timing::takeover_periods`] periods takes over, each a little later
//! than the live ones nearer the head (after power-up, when nobody is known, than all nearer the head). Of two time-keepers that
//! hear each other the one nearer the head goes on and the other follows it; so the two parts of a cut chain go on by themselves and
//! become one again after mending. A module that finds itself the live one nearest the head for three cycles takes the time over
//! by sending SYNC a twentieth of a period before it is due.
//!
//! A SYNC that got lost on its way to one module costs nothing: if a neighbour's frame of the next cycle is here when the
//! cycle is overdue, the module starts it too.
//!
//! A SYNC that would move the cycle to quite another number comes from the other part of a cable that was mended, or it is a frame of the past. The
//! former goes on: the second one in a row is believed.
//!
//! # Joining
//!
//! A module listens for one period after power-up before it sends anything. If its number is already taken it hears so, listens on until that
//! is certain ([`crate::conflict`]), and falls silent without having disturbed the robot.
//!
//! # Arming and emergency stop
//!
//! A module takes part in the control cycle from the start, but moves only when the station has armed it; [`crate::failsafe`] has the state diagram.
//! A stopped module repeats EMERGENCY_STOP every [`REPORT_EVERY`] periods, and the counter in every STATE, LATENT and HEARTBEAT brings the newest stop or
//! release to whoever missed it.
//!
//! # Goal
//!
//! GOAL frames tell points of the scene, of which a module keeps those that its policy's task observes
//! ([`composer_shared::policy::Task::observed`]). They are given in the frame of the head link, so an old one becomes wrong as the head
//! moves: without a new one it holds for [`Timing::goal_memory`] cycles, then the point is unknown. A policy whose goal is known to the
//! head uses them in module 0 only.
//!
//! # Time
//!
//! `now` is the module's own clock: microseconds since any origin, monotonic. Only differences count. A clock that steps back
//! counts as standing still.

mod config;
#[cfg(test)]
mod tests;

use composer_shared::kinematics::Chain;
use composer_shared::observation::{Motors, POINTS, Sensors, Told, observe, place};
use composer_shared::policy::{Encoded, GoalKnownTo, Memory, Policy};
use composer_shared::robot::{AXES, Limits, ROOM};
use composer_shared::wire::{
    Clearing, EmergencyStop, FRAGMENTS, Frame, Goal, Health, Heartbeat, LatentMessage, Message, Mode, NOBODY,
    Operation, PROTOCOL_VERSION, STATION, ServiceCode, ServiceRequest, ServiceResponse, State, StopCommand, StopCount,
    StopLatch, Sync, Telemetry, quantise_angle,
};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

pub use config::{BusKind, Config, ConfigError, Timing};

pub use crate::boot::{Boot, ResetCause, Retained};
use crate::conflict::Conflict;
use crate::failsafe::Failsafe;
pub use crate::failsafe::{BusOffPolicy, BusStatus, Fault, FaultSet, LimitedBy};
use crate::motor_health::MotorHealth;
use crate::neighbours::{Heard, Neighbours, bit};
use crate::power::{Power, PowerWatch};

/// Time in microseconds, or a moment of the module's own clock.
pub type Micros = u64;

/// Version of the firmware as HEARTBEAT says it: major in the upper, minor in the lower 4 bits.
pub const FIRMWARE_VERSION: u8 = 0x01;

/// Cycles between two TELEMETRY frames, and between two HEARTBEAT frames.
pub const REPORT_EVERY: u16 = 10;

/// Periods between two HEARTBEAT frames of a module that fell silent because its number is taken.
const SILENT_REPORT_EVERY: u8 = 40;

/// How far ahead a SYNC may be to be believed at once; more than the cycles that pass until somebody takes the time over.
const SYNC_AHEAD: i16 = 8;

/// Time between two steps of the torque in a jog.
const JOG_STEP_US: u64 = 2_000;

/// Answers that may wait to be sent.
const ANSWERS: usize = 4;

/// Cycles for which a module must find itself the live one nearest the head before it takes the time over.
const CLAIM_AFTER: u8 = 3;

/// What [`Controller::poll`] wants done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outputs {
    /// Torque for the motors now, yaw and pitch, in the robot's torque unit; within the torque limit, changed no faster than the slew
    /// limit. Zero when relaxed.
    pub torque: [f32; AXES],
    /// Whether the motors follow `torque`; if not, switch them off.
    pub motors_enabled: bool,
    /// Poll again no later than this, received frame or not. Always later than `now`.
    pub deadline: Micros,
}

/// Counters since power-up; they saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stats {
    /// Control cycles started.
    pub cycles: u32,
    /// Control cycles in which the module acted; the others were cut short by the next SYNC.
    pub acted: u32,
    /// Cycles in which a live neighbour's latent was missing when the module acted.
    pub deadline_misses: u32,
    /// Age of the oldest latent used in the last cycle: from the start of its cycle to the action.
    pub latent_age_us: u32,
    /// The largest that ever was.
    pub latent_age_max_us: u32,
    /// Frames whose identifier or content is not of this protocol.
    pub malformed: u32,
    /// Frames of modules that this robot does not have.
    pub foreign: u32,
    /// STATE, LATENT, GOAL and SYNC frames of another cycle than the current or next.
    pub stale: u32,
    /// Times this module became time-keeper.
    pub takeovers: u32,
    /// Cycles started without their SYNC, because a neighbour was already in them.
    pub without_sync: u32,
}

fn up(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Before the first cycle, or done with this one.
    Done,
    /// Waiting for STATE frames.
    States,
    /// Waiting for LATENT frames.
    Latents,
}

/// Frames waiting to be sent, one slot each: a newer one replaces an older one that never got onto the bus.
#[derive(Clone, Debug, Default)]
struct Outbox {
    /// With this reason.
    stop: Option<u8>,
    sync: Option<Sync>,
    state: Option<State>,
    latent: Option<LatentMessage>,
    /// Pieces of the latent already sent (classic bus).
    pieces_sent: u8,
    /// Answers to the station, oldest first, without gaps.
    answers: [Option<ServiceResponse>; ANSWERS],
    telemetry: Option<Telemetry>,
    heartbeat: Option<Heartbeat>,
}

impl Outbox {
    /// One more answer; the oldest is lost if too many wait.
    fn answer(&mut self, answer: ServiceResponse) {
        if self.answers.iter().all(Option::is_some) {
            self.answers.rotate_left(1);
            self.answers[ANSWERS - 1] = None;
        }
        if let Some(slot) = self.answers.iter_mut().find(|slot| slot.is_none()) {
            *slot = Some(answer);
        }
    }

    fn next_answer(&mut self) -> Option<ServiceResponse> {
        let first = self.answers[0].take();
        self.answers.rotate_left(1);
        first
    }
}

/// One axis moves as the station asks.
#[derive(Clone, Copy, Debug)]
struct Jog {
    axis: usize,
    torque: f32,
    time_us: u32,
    /// When the torque was last stepped, and when it ends; none before the next poll, because what was known of the time is old.
    times: Option<(Micros, Micros)>,
}

/// A SYNC that would move the cycle to quite another number.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    from: u8,
    cycle: u16,
    at: Micros,
}

/// What is remembered of one point of the scene.
#[derive(Clone, Copy, Debug, Default)]
struct PointMemory {
    /// Its number, if the task has such a point.
    number: Option<u8>,
    position: Option<[f32; 3]>,
    /// Cycles since it was told; saturating.
    age: u8,
    /// That of the next cycle, told before its SYNC came.
    next: Option<Goal>,
}

impl PointMemory {
    /// A cycle starts, with these lower bits of its number; `follows` if it is the next one after the last.
    fn start(&mut self, low: u8, follows: bool, memory: u8) {
        self.age = self.age.saturating_add(1);
        if let Some(goal) = self.next.take().filter(|goal| follows && goal.cycle == low) {
            self.position = goal.position();
            self.age = 0;
        }
        if self.age > memory {
            self.position = None;
        }
    }

    /// A point of cycle `low - age` was told.
    fn hear(&mut self, goal: Goal, age: u8, memory: u8) -> Heard {
        if age == u8::MAX {
            self.next = Some(goal);
            Heard::Next
        } else if age <= self.age && age <= memory {
            self.position = goal.position();
            self.age = age;
            Heard::Now
        } else {
            Heard::Stale
        }
    }
}

/// The controller of one module.
#[derive(Clone, Debug)]
pub struct Controller<'a> {
    config: Config,
    policy: Policy<'a>,
    limits: Limits,
    relax_factor: f32,

    now: Micros,
    /// When the module was switched on.
    power_up: Micros,
    /// Nothing is sent in this cycle: the module only listens.
    quiet: bool,
    /// It has sent something since it began to listen.
    spoken: bool,
    failsafe: Failsafe,
    conflict: Conflict,
    neighbours: Neighbours,
    chain: Chain,
    outbox: Outbox,
    /// When EMERGENCY_STOP is repeated, while stopped.
    stop_due: Option<Micros>,
    /// Whether it answers requests itself.
    serves: bool,
    jog: Option<Jog>,

    time_keeper: Option<u8>,
    /// When SYNC was last heard or sent; power-up before the first.
    last_sync: Micros,
    /// When this module sends SYNC, if it is the time-keeper or claims to be.
    next_sync: Option<Micros>,
    /// Cycles in which nobody nearer the head was alive.
    nearest_for: u8,
    candidate: Option<Candidate>,

    cycle: u16,
    cycle_start: Option<Micros>,
    phase: Phase,
    power: Power,
    /// Beside the mode in HEARTBEAT.
    remark: u8,
    sample: Sensors,
    motors: MotorHealth,
    /// Of the policy: empty at power-up, and where the robot begins to move.
    memory: Memory,
    encoded: Option<Encoded>,
    points: [PointMemory; POINTS],
    /// Cycles since the station was heard; saturating.
    station_silent: u8,
    last_heard: Micros,
    /// When the station was last heard; power-up before the first time.
    last_station: Micros,
    last_act: Option<Micros>,

    /// When the torque was last taken to zero.
    relaxed_at: Option<Micros>,
    torque: [f32; AXES],
    enabled: bool,
    limited_by: LimitedBy,
    used: u64,
    attention: [u16; ROOM],

    last_heartbeat: Option<Micros>,
    faults_told: FaultSet,
    stats: Stats,
}

/// The factor by which the joints of a silent module relax in one control period, for [`Chain::miss`].
pub fn relax_factor(period_us: u32, relax_seconds: f32) -> f32 {
    libm::expf(-(period_us as f32 / 1e6) / relax_seconds)
}

impl<'a> Controller<'a> {
    /// A module that started at `now`, and how. It listens, starts the clock itself if nobody else does, and waits to be armed.
    pub fn new(config: Config, policy: Policy<'a>, boot: Boot, now: Micros) -> Result<Self, ConfigError> {
        config.check()?;
        let timing = &config.timing;
        let limits = policy.limits();
        Ok(Controller {
            limits,
            relax_factor: relax_factor(timing.period_us, policy.relax_seconds()),
            now,
            power_up: now,
            quiet: true,
            spoken: false,
            failsafe: Failsafe::new(limits, config.safety, config.bus_off, timing.poll_grace_us, boot),
            conflict: Conflict::new(now),
            neighbours: Neighbours::new(config.node, config.modules, timing.dead_after, policy.tag()),
            chain: Chain::new(policy.geometry()),
            outbox: Outbox::default(),
            stop_due: None,
            serves: true,
            jog: None,
            time_keeper: None,
            last_sync: now,
            next_sync: None,
            nearest_for: 0,
            candidate: None,
            cycle: 0,
            cycle_start: None,
            phase: Phase::Done,
            power: Power::default(),
            remark: 0,
            sample: Sensors::ZERO,
            motors: MotorHealth::default(),
            memory: Memory::EMPTY,
            encoded: None,
            points: policy
                .task()
                .observed(config.node, config.modules)
                .map(|number| PointMemory { number, ..PointMemory::default() }),
            station_silent: 0,
            last_heard: now,
            last_station: now,
            last_act: None,
            relaxed_at: None,
            torque: [0.0; AXES],
            enabled: false,
            limited_by: LimitedBy::Relaxed,
            used: 0,
            attention: [0; ROOM],
            last_heartbeat: None,
            faults_told: FaultSet::EMPTY,
            stats: Stats::default(),
            config,
            policy,
        })
    }

    /// Goes on to `now`: takes one received frame, or `None` when only time passed.
    ///
    /// Call it for every received frame, and at the latest at the last answer's deadline. `sensors` are the latest readings; the sample
    /// of a cycle is taken when the cycle starts. Do not feed the module's own frames back: a frame with its own number means
    /// that another node has the same. Send what [`Controller::next_frame`] offers afterwards.
    ///
    /// Cost: at most one encoding and one action, whatever is received. Never panics. Deadlines are kept on every call, so a flood of
    /// frames does not delay them.
    #[inline(never)] // The linked image is checked from here on: `tests/tests/image.rs`.
    pub fn poll(&mut self, now: Micros, sensors: &Sensors, received: Option<&Frame>, bus: BusStatus) -> Outputs {
        let now = now.max(self.now);
        self.now = now;
        self.failsafe.check_poll(now);
        self.failsafe.check_bus(bus);
        self.failsafe.check_temperature(sensors.temperature);
        self.failsafe.check_joints(sensors);
        self.failsafe.check_power(now, &self.power);
        if let Some(frame) = received {
            self.receive(frame, sensors);
        }
        self.keep_time(sensors);
        self.supervise();
        self.advance();
        self.step_jog();
        self.bear();
        self.report();
        let deadline = self.deadline();
        self.failsafe.promise(deadline);
        Outputs { torque: self.torque, motors_enabled: self.enabled, deadline }
    }

    /// Tells what the board measured of supply and motors; it counts from the next poll on, until it is told anew. A board that never does has a good supply.
    pub fn set_power(&mut self, power: Power) {
        self.power = power;
    }

    /// What HEARTBEAT is to say of the policy: [`Heartbeat::LAB`], [`Heartbeat::TRIAL`].
    pub fn set_remark(&mut self, remark: u8) {
        self.remark = remark & (Heartbeat::LAB | Heartbeat::TRIAL);
    }

    /// Supply and cut-offs.
    pub fn power(&self) -> &PowerWatch {
        self.failsafe.power()
    }

    /// Which motors that were cut off may begin again: after a poll, for their drivers. Each is said once.
    pub fn rearm(&mut self) -> [bool; AXES] {
        self.failsafe.rearm(self.now)
    }

    /// The next frame to send, the most urgent first; call it whenever the CAN port has room. A frame that is still waiting in the port
    /// when the same function is offered again is out of date: replace it if the port can.
    #[inline(never)] // Like `poll`.
    pub fn next_frame(&mut self) -> Option<Frame> {
        if self.failsafe.silenced() {
            // A stop waits for the bus, everything else gets old.
            let Outbox { stop, heartbeat, .. } = core::mem::take(&mut self.outbox);
            self.outbox.stop = stop;
            if self.failsafe.bus_off() {
                return None;
            }
            self.outbox.heartbeat = heartbeat;
        }
        let (node, fd) = (self.config.node, self.config.bus == BusKind::Fd);
        let outbox = &mut self.outbox;
        let latch = self.failsafe.stop();
        let message = if let Some(reason) = outbox.stop.take().filter(|_| latch.stopped()) {
            Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, reason, latch.count()))
        } else if let Some(m) = outbox.sync.take() {
            Message::Sync(m)
        } else if let Some(m) = outbox.state.take() {
            Message::State(m)
        } else if let Some(m) = outbox.latent.take() {
            if fd {
                Message::Latent(m)
            } else {
                let piece = *m.fragments().get(usize::from(outbox.pieces_sent))?;
                outbox.pieces_sent += 1;
                if usize::from(outbox.pieces_sent) < FRAGMENTS {
                    outbox.latent = Some(m);
                }
                Message::LatentFragment(piece)
            }
        } else if let Some(m) = outbox.next_answer() {
            Message::ServiceResponse(m)
        } else if let Some(m) = outbox.telemetry.take() {
            Message::Telemetry(m)
        } else {
            Message::Heartbeat(outbox.heartbeat.take()?)
        };
        Some(message.emit(node, fd))
    }

    /// Stops the whole robot from here (a button, a supervisor), for this reason (the number of a fault, 0 if somebody asked for it): latched like a stop
    /// from the bus, and told to all others, as soon as the bus allows. The motors relax with the next poll. A robot that is stopped stays so.
    pub fn emergency_stop(&mut self, reason: u8) {
        if !self.failsafe.stop().stopped() {
            self.failsafe.command_stop(StopCommand::Stop, StopCount::UNKNOWN);
            self.outbox.stop = Some(reason);
        }
    }

    /// Releases the whole robot from here; the others are told by the counter in STATE. The module stays disarmed.
    pub fn release(&mut self) {
        self.failsafe.command_stop(StopCommand::Release, StopCount::UNKNOWN);
    }

    /// Follows a stop that an interrupt took while the controller computed ([`crate::torque_off`]), before the next poll. The frame that brought it may still come.
    pub fn follow_stop(&mut self, latch: StopLatch) {
        self.failsafe.follow(latch);
    }

    /// The emergency stop as the controller knows it.
    pub fn stop_latch(&self) -> StopLatch {
        self.failsafe.stop()
    }

    /// Allows the motors to be driven; `acknowledge`: even after a reset that was not clean. The error is [`ServiceCode::NotArmable`].
    pub fn arm(&mut self, acknowledge: bool) -> Result<(), ServiceCode> {
        let begins = !self.failsafe.armed();
        self.failsafe.arm(acknowledge)?;
        if begins {
            self.memory = Memory::EMPTY;
        }
        if self.jog.is_some() {
            self.relax();
        }
        Ok(())
    }

    /// Takes that back.
    pub fn disarm(&mut self) {
        self.failsafe.disarm();
        self.relax();
    }

    /// Whether the station has armed it.
    pub fn armed(&self) -> bool {
        self.failsafe.armed()
    }

    /// Ends the latched faults that a person may end ([`Clearing::Clear`]).
    pub fn clear(&mut self) {
        self.failsafe.clear(Clearing::Clear);
        self.failsafe.clear_cut_offs();
        // It listens before it talks again.
        self.conflict = Conflict::new(self.now);
        (self.power_up, self.spoken) = (self.now, false);
    }

    /// Drives one axis (0 yaw, 1 pitch) with this torque (the robot's torque unit, within its limits and slewed) for `time_us`, while the module is disarmed.
    /// A torque or time of 0 ends it. Refused while armed, and while a fault forbids arming or relaxes.
    pub fn jog(&mut self, axis: usize, torque: f32, time_us: u32) -> Result<(), ServiceCode> {
        if axis >= AXES {
            return Err(ServiceCode::NoSuchRegister);
        }
        if torque.is_nan() || torque.abs() > self.limits.torque {
            return Err(ServiceCode::OutOfRange);
        }
        if self.failsafe.armed() {
            return Err(ServiceCode::Armed);
        }
        if !self.failsafe.fit() || self.faults().meets(FaultSet::FORBIDDING) {
            return Err(ServiceCode::NotArmable);
        }
        self.jog = (torque != 0.0 && time_us != 0).then_some(Jog { axis, torque, time_us, times: None });
        Ok(())
    }

    /// Why the module started.
    pub fn boot(&self) -> &Boot {
        self.failsafe.boot()
    }

    /// What the board has to keep for the next start, whenever it changes.
    pub fn retained(&self) -> Retained {
        self.failsafe.retained()
    }

    /// The board is about to reset itself because somebody asked for it: that will have been a clean one.
    pub fn expect_restart(&mut self) {
        self.failsafe.expect_restart();
    }

    /// Somebody else answers the station's requests and calls [`Controller::arm`] and the others; by itself the controller answers ARM, DISARM and CLEAR, and to
    /// all others that it does not know them.
    pub fn leave_requests(&mut self) {
        self.serves = false;
    }

    /// The policy.
    pub fn policy(&self) -> &Policy<'a> {
        &self.policy
    }

    /// The torque that the motors are told to give, yaw and pitch, in the robot's torque unit; zero if relaxed.
    pub fn torque(&self) -> [f32; AXES] {
        self.torque
    }

    /// Whether the module must not answer: its number is another's, too, or it is off the bus.
    pub fn silenced(&self) -> bool {
        self.failsafe.silenced()
    }

    /// The active faults.
    pub fn faults(&self) -> FaultSet {
        self.failsafe.faults()
    }

    /// Whether the CAN port may recover from bus-off by itself.
    pub fn may_recover_bus(&self) -> bool {
        self.failsafe.may_recover()
    }

    /// What holds the torque back.
    pub fn limited_by(&self) -> LimitedBy {
        self.limited_by
    }

    /// What the module is at.
    pub fn mode(&self) -> Mode {
        let silent = self.now.saturating_sub(self.last_heard);
        if self.failsafe.stop().stopped() {
            Mode::Stopped
        } else if self.jog.is_some() {
            Mode::Service
        } else if self.cycle_start.is_none() {
            Mode::Boot
        } else if !self.failsafe.armed() {
            Mode::Disarmed
        } else if self.failsafe.relaxed() {
            Mode::Relaxed
        } else if self.config.modules > 1 && silent > self.periods(self.config.timing.dead_after) {
            Mode::Alone
        } else {
            Mode::Active
        }
    }

    /// Number of the current control cycle.
    pub fn cycle(&self) -> u16 {
        self.cycle
    }

    /// Whose SYNC the module follows; its own number if it keeps the time.
    pub fn time_keeper(&self) -> Option<u8> {
        self.time_keeper
    }

    /// Modules believed alive, itself included, as a bit mask.
    pub fn alive(&self) -> u64 {
        self.neighbours.alive() | self.own_bit()
    }

    /// Modules attended over in the last action, itself included, as a bit mask.
    pub fn heard(&self) -> u64 {
        self.used | self.own_bit()
    }

    /// The attention weights of the last action by module, Q15 (32767 is 1).
    pub fn attention(&self) -> &[u16; ROOM] {
        &self.attention
    }

    /// Counters.
    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Its configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// What TELEMETRY would say now.
    pub fn telemetry(&self) -> Telemetry {
        let others = self.attention.iter().enumerate().filter(|(j, w)| *j != self.own() && **w > 0);
        let most = others.max_by_key(|(_, w)| **w);
        Telemetry {
            torque: self.torque.map(|t| libm::roundf(t / self.limits.torque * 127.0) as i8),
            temperature: self.sample.temperature as i8,
            limited_by: self.limited_by as u8,
            heard: self.heard().count_ones() as u8,
            deadline_misses: self.stats.deadline_misses as u8,
            attends_to: most.map_or(NOBODY, |(j, _)| j as u8),
            // Q15 to 1/255.
            attention: most.map_or(0, |(_, w)| (u32::from(*w) * 255 / 32767).min(255) as u8),
        }
    }

    /// What HEARTBEAT would say now.
    pub fn heartbeat(&self) -> Heartbeat {
        Heartbeat {
            mode: self.mode() as u8 | self.remark,
            fault: self.faults().number(),
            health: self.health(),
            time_keeper: self.time_keeper.unwrap_or(NOBODY),
            protocol: PROTOCOL_VERSION,
            firmware: FIRMWARE_VERSION,
            policy: self.policy.tag(),
        }
    }

    /// Listen before you talk; longer if somebody else seems to have the same number.
    fn listening(&self) -> bool {
        let certain = self.faults().contains(Fault::DuplicateNode);
        let suspected = !self.spoken && !certain && self.conflict.suspected(self.now, self.periods(3));
        suspected || self.now.saturating_sub(self.power_up) < self.period()
    }

    fn own(&self) -> usize {
        usize::from(self.config.node)
    }

    fn own_bit(&self) -> u64 {
        bit(self.config.node)
    }

    fn period(&self) -> Micros {
        u64::from(self.config.timing.period_us)
    }

    fn periods(&self, count: u8) -> Micros {
        u64::from(count) * self.period()
    }

    fn health(&self) -> Health {
        let faults = self.faults();
        let [yaw_dead, pitch_dead] = self.motors.work().map(|works| !works);
        let flags = [
            (Health::SENSORS_PLAUSIBLE, self.sample.plausible()),
            (Health::YAW_DEAD, yaw_dead),
            (Health::EMERGENCY_STOP, faults.contains(Fault::EmergencyStop)),
            (Health::PITCH_DEAD, pitch_dead),
        ];
        let health =
            flags.into_iter().fold(Health(0), |health, (flag, set)| if set { health.with(flag) } else { health });
        health.with_stop_count(self.failsafe.stop().count())
    }

    // Receiving

    fn receive(&mut self, frame: &Frame, sensors: &Sensors) {
        let Ok(message) = Message::parse(frame) else {
            return up(&mut self.stats.malformed);
        };
        let module = frame.module();
        // A stop counts whoever sends it.
        if let Message::EmergencyStop(stop) = message {
            self.failsafe.command_stop(stop.command(), stop.count());
        }
        if module == self.config.node {
            return self.hear_own_number(&message);
        }
        if module != STATION && module >= self.config.modules {
            return up(&mut self.stats.foreign);
        }
        self.last_heard = self.now;
        if module == STATION {
            self.last_station = self.now;
        }
        self.neighbours.hear(module);
        let heard = match message {
            Message::EmergencyStop(_)
            | Message::Telemetry(_)
            | Message::ServiceResponse(_)
            | Message::UpdateChunk(_)
            | Message::UpdatePiece(_) => Heard::Now,
            Message::ServiceRequest(request) => {
                self.serve(&request);
                Heard::Now
            }
            Message::Sync(sync) => self.hear_sync(module, sync, sensors),
            Message::Goal(goal) => self.hear_goal(goal),
            Message::State(state) => {
                self.failsafe.hear_stop(state.health);
                self.neighbours.hear_state(module, state)
            }
            Message::Latent(latent) => {
                self.failsafe.hear_stop(latent.health);
                self.neighbours.hear_latent(module, &latent)
            }
            Message::LatentFragment(fragment) => match self.neighbours.hear_fragment(module, &fragment) {
                Ok(heard) => heard,
                Err(_) => return up(&mut self.stats.malformed),
            },
            Message::Heartbeat(heartbeat) => {
                self.failsafe.hear_stop(heartbeat.health);
                self.neighbours.hear_policy(module, heartbeat.policy);
                self.neighbours.hear_protocol(module, heartbeat.protocol);
                Heard::Now
            }
        };
        if heard == Heard::Stale {
            up(&mut self.stats.stale);
        }
    }

    /// Somebody else says something under this module's number, or a frame of its own came back.
    fn hear_own_number(&mut self, message: &Message) {
        let low = self.cycle as u8;
        let near = |cycle: u8| self.cycle_start.is_none() || cycle.wrapping_sub(low).wrapping_add(1) <= 2;
        let fresh = match message {
            Message::State(state) => near(state.cycle),
            Message::Latent(latent) => near(latent.cycle),
            Message::Sync(sync) => near(sync.cycle as u8),
            _ => false,
        };
        if self.conflict.hear(self.now, self.period(), fresh) {
            self.failsafe.set(Fault::DuplicateNode, true);
            self.time_keeper = self.time_keeper.filter(|keeper| *keeper != self.config.node);
            self.next_sync = None;
        }
    }

    /// The station asks for something.
    fn serve(&mut self, request: &ServiceRequest) {
        if !self.serves || !request.is_for(self.config.node) {
            return;
        }
        let result = match Operation::from_number(request.operation) {
            Some(Operation::Arm) if request.value > 1 => Err(ServiceCode::OutOfRange),
            Some(Operation::Arm) => self.arm(request.value == 1),
            Some(Operation::Disarm) => {
                self.disarm();
                Ok(())
            }
            Some(Operation::Clear) if self.armed() => Err(ServiceCode::Armed),
            Some(Operation::Clear) => {
                self.clear();
                Ok(())
            }
            _ => Err(ServiceCode::UnknownOperation),
        };
        self.outbox.answer(request.answer(result.err().unwrap_or(ServiceCode::Ok), 0));
    }

    fn hear_sync(&mut self, from: u8, sync: Sync, sensors: &Sensors) -> Heard {
        let silence = self.now.saturating_sub(self.last_sync);
        let since_start = self.cycle_start.map(|start| self.now.saturating_sub(start));
        let lost = silence > self.period() + self.period() / 2;
        let ahead = sync.cycle.wrapping_sub(self.cycle) as i16;
        let keeper = self.time_keeper;
        match keeper {
            // Who is nearer the head keeps the time; this module's own SYNC makes the other one yield.
            Some(keeper) if from > keeper && (keeper == self.config.node || !lost) => return Heard::Stale,
            // A frame that was held up or repeated.
            Some(keeper) if from == keeper && !lost && ahead < 0 => return Heard::Stale,
            // Nobody keeps time that badly: a babbling node must not drive the cycle.
            Some(keeper) if from == keeper && ahead > 0 && since_start.is_some_and(|t| t < self.period() / 4) => {
                return Heard::Stale;
            }
            // The other part of a mended cable goes on with its numbers, a frame of the past does not.
            Some(_)
                if !(0..=SYNC_AHEAD).contains(&ahead)
                    && silence <= self.periods(self.config.timing.sync_lost_after)
                    && !self.confirmed(from, sync.cycle) =>
            {
                return Heard::Stale;
            }
            _ => {}
        }
        self.time_keeper = Some(from);
        self.next_sync = None;
        self.last_sync = self.now;
        self.candidate = None;
        self.failsafe.set(Fault::ModuleCount, sync.modules != self.config.modules);
        // Already in this cycle, by a neighbour's frame or by another time-keeper's SYNC.
        let known = ahead == 0 && since_start.is_some_and(|t| t < self.period() / 4 * 3);
        if !known {
            self.start_cycle(sync.cycle, sensors);
        }
        Heard::Now
    }

    /// Whether this is the second SYNC of its sender in a row, in time and number.
    fn confirmed(&mut self, from: u8, cycle: u16) -> bool {
        let now = Candidate { from, cycle, at: self.now };
        self.candidate.replace(now).filter(|before| before.from == from).is_some_and(|before| {
            let cycles = u64::from(cycle.wrapping_sub(before.cycle));
            let late = self.now.saturating_sub(before.at).abs_diff(cycles * self.period());
            (1..=3).contains(&cycles) && late < self.period() / 4
        })
    }

    fn hear_goal(&mut self, goal: Goal) -> Heard {
        self.station_silent = 0;
        if self.cycle_start.is_none() {
            return Heard::Stale;
        }
        let age = (self.cycle as u8).wrapping_sub(goal.cycle);
        let memory = self.config.timing.goal_memory;
        let point = self.points.iter_mut().find(|point| point.number == Some(goal.point()));
        // Other modules' points say no more than that the station is there.
        point.map_or(Heard::Now, |point| point.hear(goal, age, memory))
    }

    // Keeping time

    fn keep_time(&mut self, sensors: &Sensors) {
        if self.failsafe.faults().contains(Fault::DuplicateNode) || self.listening() {
            return;
        }
        let now = self.now;
        let node = self.config.node;
        if let Some(due) = self.next_sync {
            if now >= due {
                if self.time_keeper != Some(node) {
                    up(&mut self.stats.takeovers);
                }
                self.time_keeper = Some(node);
                // After a gap the beat starts anew instead of catching up.
                let next = due.saturating_add(self.period());
                self.next_sync = Some(if next > now { next } else { now.saturating_add(self.period()) });
                self.send_sync(self.cycle.wrapping_add(1), sensors);
            }
        } else if now >= self.takeover_not_before() && now >= self.takeover_at() {
            up(&mut self.stats.takeovers);
            self.time_keeper = Some(node);
            let period = self.period();
            match self.cycle_start {
                // Just started without SYNC: that was the right time, announce it.
                Some(start) if now.saturating_sub(start) < period / 2 => {
                    self.next_sync = Some(start.saturating_add(period));
                    self.last_sync = now;
                    self.outbox.sync = Some(Sync::new(self.cycle, self.alive_count(), self.config.modules));
                }
                start => {
                    // The lost time-keeper's numbers go on, so that modules that follow it without SYNC agree.
                    let gap = start.map_or(period, |start| now.saturating_sub(start));
                    let cycles = (gap.saturating_add(period / 2) / period.max(1)).max(1);
                    self.next_sync = Some(now.saturating_add(period));
                    self.send_sync(self.cycle.wrapping_add(cycles as u16), sensors);
                }
            }
        } else if self.overdue_at().is_some_and(|at| now >= at) && self.neighbours.next_cycle_seen() {
            up(&mut self.stats.without_sync);
            self.start_cycle(self.cycle.wrapping_add(1), sensors);
        }
    }

    fn alive_count(&self) -> u8 {
        self.alive().count_ones() as u8
    }

    fn send_sync(&mut self, cycle: u16, sensors: &Sensors) {
        self.last_sync = self.now;
        self.spoken = true;
        self.failsafe.set(Fault::ModuleCount, false);
        self.outbox.sync = Some(Sync::new(cycle, self.alive_count(), self.config.modules));
        self.start_cycle(cycle, sensors);
    }

    /// A moment before which no module takes over. Cheap: the modules before this one in line need not be counted.
    fn takeover_not_before(&self) -> Micros {
        self.last_sync.saturating_add(self.periods(self.config.timing.takeover_periods))
    }

    /// When this module takes over from a silent time-keeper: later for each live module before it in line.
    fn takeover_at(&self) -> Micros {
        let timing = &self.config.timing;
        let keeper = self.time_keeper.map_or(0, bit);
        let before = self.neighbours.alive() & crate::neighbours::first(self.config.node) & !keeper;
        let turn = u64::from(before.count_ones()) + 1;
        let wait = self.periods(timing.takeover_periods) + turn * u64::from(timing.takeover_stagger_us);
        self.last_sync.saturating_add(wait)
    }

    /// When a cycle is so late that its SYNC must have been lost.
    fn overdue_at(&self) -> Option<Micros> {
        let start = self.cycle_start.filter(|_| self.next_sync.is_none())?;
        Some(start.saturating_add(self.period() + self.period() / 25))
    }

    // The control cycle

    fn start_cycle(&mut self, cycle: u16, sensors: &Sensors) {
        let follows = self.cycle.wrapping_add(1) == cycle && self.cycle_start.is_some();
        let low = cycle as u8;
        self.cycle = cycle;
        self.cycle_start = Some(self.now);
        self.phase = Phase::States;
        self.encoded = None;
        self.sample = *sensors;
        self.failsafe.check_sample(sensors);
        self.motors.update(self.commanded(), sensors, self.limits.joint_speed);
        self.failsafe.set(Fault::MotorDead, self.motors.work() != [true; AXES]);
        self.neighbours.start(low);
        self.failsafe.set(Fault::PolicyMismatch, self.neighbours.mismatch() != 0);
        self.failsafe.set(Fault::ProtocolVersion, self.neighbours.foreign_protocol() != 0);
        up(&mut self.stats.cycles);

        self.station_silent = self.station_silent.saturating_add(1);
        for point in &mut self.points {
            point.start(low, follows, self.config.timing.goal_memory);
        }

        // Somebody who follows another though nobody nearer the head lives will keep the time soon.
        let nearer = self.neighbours.alive() & crate::neighbours::first(self.config.node);
        self.nearest_for = if nearer == 0 { self.nearest_for.saturating_add(1) } else { 0 };
        if self.time_keeper != Some(self.config.node) && self.nearest_for >= CLAIM_AFTER && !self.failsafe.silenced() {
            self.next_sync = Some(self.now.saturating_add(self.period() - self.period() / 20));
        }

        self.outbox.latent = None;
        self.quiet = self.listening();
        if self.quiet {
            return;
        }
        self.spoken = true;
        self.outbox.state = Some(State::new(low, self.health(), &sensors.joint_angles));
        if cycle.wrapping_add(u16::from(self.config.node)) % REPORT_EVERY == 0 {
            self.outbox.telemetry = Some(self.telemetry());
        }
    }

    /// The torque commanded now, of the policy's limit.
    fn commanded(&self) -> [f32; AXES] {
        self.torque.map(|torque| torque / self.limits.torque)
    }

    /// Whether this module is told the goal.
    fn uses_goal(&self) -> bool {
        self.policy.goal_known_to() == GoalKnownTo::All || self.config.node == 0
    }

    /// Whether the station still has to tell a point of this cycle, and can be expected to.
    fn points_due(&self) -> bool {
        self.uses_goal()
            && self.station_silent <= self.config.timing.goal_memory
            && self.points.iter().any(|point| point.number.is_some() && point.age > 0)
    }

    fn advance(&mut self) {
        let Some(start) = self.cycle_start else { return };
        let since = self.now.saturating_sub(start);
        let timing = self.config.timing;
        if self.phase == Phase::States {
            let complete = self.neighbours.missing_states() == 0 && !self.points_due();
            if complete || since >= u64::from(timing.state_deadline_us) {
                self.observe();
            }
        }
        if self.phase == Phase::Latents {
            let complete = !self.policy.attention() || self.neighbours.missing_latents() == 0;
            if complete || since >= u64::from(timing.collect_deadline_us) {
                if !complete {
                    up(&mut self.stats.deadline_misses);
                }
                self.act(since);
            }
        }
    }

    fn observe(&mut self) {
        for module in 0..self.config.modules {
            let angles = if module == self.config.node {
                // Rounded like everybody else's: all modules lay out the same chain.
                self.sample.plausible().then(|| self.sample.joint_angles.map(quantise_angle))
            } else {
                self.neighbours.state(module).map(|state| state.angles())
            };
            match angles {
                Some(angles) => self.chain.hear(usize::from(module), &angles),
                None => self.chain.miss(usize::from(module), self.relax_factor),
            }
        }
        let head = self.chain.head_seen_from(self.own());
        let uses_goal = self.uses_goal();
        let told = Told {
            points: self.points.map(|point| point.position.filter(|_| uses_goal).map(Vector3::from)),
            seeker: self.policy.task().seeker(),
        };
        let place = place(self.own(), usize::from(self.config.modules));
        let node = self.config.node;
        let motors = Motors {
            commanded: self.commanded(),
            work: self.motors.work(),
            beside: [node.checked_sub(1), Some(node.saturating_add(1))].map(|module| self.neighbours.motors(module)),
        };
        let observation = observe(&self.sample, &motors, place, &head, &told);
        let encoded = self.policy.encode(&mut self.memory, &observation);
        if self.policy.attention() && !self.quiet {
            self.outbox.pieces_sent = 0;
            self.outbox.latent = Some(LatentMessage {
                cycle: self.cycle as u8,
                health: self.health(),
                policy: self.policy.tag(),
                key: encoded.latent.key,
                value: encoded.latent.value,
            });
        }
        self.encoded = Some(encoded);
        self.phase = Phase::Latents;
    }

    fn act(&mut self, since_start: Micros) {
        self.phase = Phase::Done;
        let Some(encoded) = self.encoded else { return };
        self.used = if self.policy.attention() { self.neighbours.usable() } else { 0 };
        let (own, latents) = (self.own(), self.neighbours.latents());
        let action = self.policy.act(&encoded, latents, self.used, Some(&mut self.attention), own);
        // As fast as the time since the torque was set allows; a period at most, which is what the policy was trained with.
        let period = self.period();
        let set = self.last_act.max(self.relaxed_at).unwrap_or(self.power_up);
        let seconds = self.now.saturating_sub(set).min(period) as f32 / 1e6;
        // A jog goes on.
        if self.jog.is_none() {
            (self.torque, self.limited_by) = self.failsafe.command(self.torque, action, seconds);
            self.enabled = !self.failsafe.relaxed();
        }
        self.last_act = Some(self.now);
        up(&mut self.stats.acted);
        if self.used != 0 {
            self.stats.latent_age_us = u32::try_from(since_start).unwrap_or(u32::MAX);
            self.stats.latent_age_max_us = self.stats.latent_age_max_us.max(self.stats.latent_age_us);
        }
    }

    /// Takes back what joints and motors do not bear any more.
    fn bear(&mut self) {
        if self.failsafe.bears_all() {
            return;
        }
        let bearable = self.failsafe.bearable(self.torque);
        if bearable != self.torque {
            self.torque = bearable;
            self.limited_by = LimitedBy::JointAngle;
        }
    }

    /// Relaxes the motors as soon as there is a reason.
    fn supervise(&mut self) {
        let timing = &self.config.timing;
        let sync_lost = self.cycle_start.is_some()
            && self.now.saturating_sub(self.last_sync) > self.periods(timing.sync_lost_after);
        let silence = self.now.saturating_sub(self.last_heard);
        let isolated = self.config.modules > 1 && silence > self.periods(timing.isolated_after);
        self.failsafe.check_station(self.now.saturating_sub(self.last_station));
        self.failsafe.set(Fault::SyncLost, sync_lost);
        self.failsafe.set(Fault::Isolated, isolated);
        let jogged = self.jog.is_some() && self.may_jog();
        if self.failsafe.relaxed() && !jogged {
            self.relax();
        }
    }

    /// No torque, and no jog.
    fn relax(&mut self) {
        if self.enabled {
            self.relaxed_at = Some(self.now);
        }
        self.torque = [0.0; AXES];
        self.enabled = false;
        self.limited_by = LimitedBy::Relaxed;
        self.jog = None;
    }

    fn may_jog(&self) -> bool {
        !self.failsafe.armed() && self.failsafe.fit() && !self.faults().meets(FaultSet::FORBIDDING)
    }

    /// Drives the axis that the station wants to move.
    fn step_jog(&mut self) {
        let Some(jog) = self.jog else { return };
        let (stepped, until) = jog.times.unwrap_or((self.now, self.now.saturating_add(jog.time_us.into())));
        if self.now >= until {
            return self.relax();
        }
        let seconds = self.now.saturating_sub(stepped).min(self.period()) as f32 / 1e6;
        let mut torque = [0.0; AXES];
        for (axis, (torque, before)) in torque.iter_mut().zip(self.torque).enumerate() {
            let wanted = if axis == jog.axis { jog.torque / self.limits.torque } else { 0.0 };
            *torque = self.failsafe.command_axis(before, wanted, seconds);
        }
        self.torque = torque;
        self.enabled = true;
        self.limited_by = LimitedBy::Nothing;
        self.jog = Some(Jog { times: Some((self.now, until)), ..jog });
    }

    /// Queues a HEARTBEAT: every [`REPORT_EVERY`] periods, and when the faults change, but never more than one a period. And a stop
    /// again and again, each module in its own period.
    fn report(&mut self) {
        if self.listening() {
            return;
        }
        if !self.failsafe.stop().stopped() {
            self.stop_due = None;
        } else if self.stop_due.is_none_or(|due| self.now >= due) {
            let wait = match self.stop_due {
                None => 1 + self.config.node % REPORT_EVERY as u8,
                Some(_) => REPORT_EVERY as u8,
            };
            if self.stop_due.is_some() {
                self.outbox.stop = self.outbox.stop.or(Some(0));
            }
            self.stop_due = Some(self.now.saturating_add(self.periods(wait)));
        }
        let changed = self.faults() != self.faults_told;
        let wait = match changed {
            true => self.period(),
            false if self.failsafe.silenced() => self.periods(SILENT_REPORT_EVERY),
            false => u64::from(REPORT_EVERY) * self.period(),
        };
        if self.last_heartbeat.is_none_or(|last| self.now.saturating_sub(last) >= wait) {
            self.last_heartbeat = Some(self.now);
            self.faults_told = self.faults();
            self.outbox.heartbeat = Some(self.heartbeat());
        }
    }

    /// The next moment at which something happens without a frame.
    fn deadline(&self) -> Micros {
        let timing = &self.config.timing;
        let latest = self.now.saturating_add(self.period().min(u64::from(timing.poll_within_us)));
        let mut deadline = latest;
        let mut at = |moment: Micros| {
            if moment > self.now {
                deadline = deadline.min(moment);
            }
        };
        match self.next_sync {
            Some(due) => at(due),
            None if self.takeover_not_before() < latest => at(self.takeover_at()),
            None => {}
        }
        if let Some(start) = self.cycle_start {
            match self.phase {
                Phase::States => at(start.saturating_add(u64::from(timing.state_deadline_us))),
                Phase::Latents => at(start.saturating_add(u64::from(timing.collect_deadline_us))),
                Phase::Done => {}
            }
            if let Some(overdue) = self.overdue_at() {
                at(overdue);
            }
            at(self.last_sync.saturating_add(self.periods(timing.sync_lost_after) + 1));
        }
        at(self.last_heard.saturating_add(self.periods(timing.isolated_after) + 1));
        if let Some((_, until)) = self.jog.and_then(|jog| jog.times) {
            at(until.min(self.now.saturating_add(JOG_STEP_US)));
        }
        // The clock cannot go beyond the end of time; nothing else can make this fail.
        deadline.max(self.now.saturating_add(1))
    }
}
