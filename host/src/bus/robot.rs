//! What one knows of a robot by listening to its bus.

use std::collections::BTreeMap;
use std::time::Duration;

use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::{
    Fault, Frame, Health, Heartbeat, Message, Mode, PROTOCOL_VERSION, STATION, State, StopLatch, Sync, Telemetry,
};

/// A module that said nothing for so many control cycles is gone.
pub const SILENT_CYCLES: u32 = 3;

/// The control period until two SYNCs were heard.
const PERIOD: Duration = Duration::from_millis(50);

/// A HEARTBEAT comes every ten periods; a module that only sends those is silent, not gone.
const HEARTBEAT_CYCLES: u32 = 10;

/// What is known of one module. Times are those of [`Robot::hear`].
#[derive(Clone, Debug, Default)]
pub struct Module {
    /// When it was heard last; none: never.
    pub heard: Option<Duration>,
    /// Its last STATE.
    pub state: Option<State>,
    /// Its last HEARTBEAT.
    pub heartbeat: Option<Heartbeat>,
    /// Its last TELEMETRY.
    pub telemetry: Option<Telemetry>,
    /// Its supply, V, if it was asked for.
    pub supply: Option<f32>,
    /// The last fault that it reported, and when.
    pub last_fault: Option<(u8, Duration)>,
    /// It was heard before and is not any more.
    pub gone: bool,
    /// Control cycles that had started when it was heard last.
    cycles: u64,
}

impl Module {
    /// What it is at.
    pub fn mode(&self) -> Option<Mode> {
        self.heartbeat.and_then(|heartbeat| heartbeat.mode())
    }

    /// How it is, by its last STATE, or else by its last HEARTBEAT.
    pub fn health(&self) -> Option<Health> {
        self.state.map(|state| state.health).or(self.heartbeat.map(|heartbeat| heartbeat.health))
    }

    /// Its active fault with the lowest number; 0: none.
    pub fn fault(&self) -> Option<u8> {
        self.heartbeat.map(|heartbeat| heartbeat.fault)
    }
}

/// Something that people are told at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// A module is heard for the first time, or again.
    Came(u8),
    /// A module has fallen silent.
    Gone {
        /// Which.
        node: u8,
        /// The last fault that it reported; 0: none.
        last_fault: u8,
    },
    /// A module reports another fault than before; 0: none any more.
    Fault {
        /// Which.
        node: u8,
        /// Which fault.
        fault: u8,
    },
    /// The robot was stopped, or released.
    Stopped(bool),
}

/// The name of a fault, for people.
pub fn fault_name(number: u8) -> String {
    match (number, Fault::from_number(number)) {
        (0, _) => "none".into(),
        (_, Some(fault)) => format!("{number} {fault:?}"),
        _ => format!("{number} (unknown to this program)"),
    }
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {
            Change::Came(node) => write!(f, "module {node} is on the bus"),
            Change::Gone { node, last_fault: 0 } => write!(f, "module {node} is gone; it had reported no fault"),
            Change::Gone { node, last_fault } => {
                write!(f, "module {node} is gone; last fault: {}", fault_name(last_fault))
            }
            Change::Fault { node, fault: 0 } => write!(f, "module {node} reports no fault any more"),
            Change::Fault { node, fault } => write!(f, "module {node} reports fault {}", fault_name(fault)),
            Change::Stopped(true) => f.write_str("the robot is stopped"),
            Change::Stopped(false) => f.write_str("the robot is released"),
        }
    }
}

/// What is known of a robot.
#[derive(Clone, Debug, Default)]
pub struct Robot {
    modules: BTreeMap<u8, Module>,
    /// Modules that the time-keeper believes the robot to have.
    expected: u8,
    /// The last SYNC: who sent it, and when.
    sync: Option<(u8, Sync, Duration)>,
    /// Control cycles that have started.
    cycles: u64,
    period: Option<Duration>,
    stop: StopLatch,
    /// Frames that are not of this protocol.
    malformed: u64,
    /// Frames of another station.
    stations: u64,
    frames: u64,
}

impl Robot {
    /// The modules that were ever heard, and those that ought to be there, by number.
    pub fn modules(&self) -> impl Iterator<Item = (u8, &Module)> {
        self.modules.iter().map(|(node, module)| (*node, module))
    }

    /// One of them.
    pub fn module(&self, node: u8) -> Option<&Module> {
        self.modules.get(&node)
    }

    /// Those that are on the bus now.
    pub fn present(&self) -> Vec<u8> {
        self.modules().filter(|(_, module)| module.heard.is_some() && !module.gone).map(|(node, _)| node).collect()
    }

    /// Modules that the robot has, by its time-keeper; 0: not known.
    pub fn expected(&self) -> u8 {
        self.expected
    }

    /// The last SYNC and who sent it.
    pub fn sync(&self) -> Option<(u8, Sync)> {
        self.sync.map(|(node, sync, _)| (node, sync))
    }

    /// The control period.
    pub fn period(&self) -> Duration {
        self.period.unwrap_or(PERIOD)
    }

    /// The emergency stop, as this program knows it.
    pub fn stop(&self) -> StopLatch {
        self.stop
    }

    /// The same, to count one on.
    pub(super) fn stop_mut(&mut self) -> &mut StopLatch {
        &mut self.stop
    }

    /// Notes what a module answered about its supply.
    pub fn note_supply(&mut self, node: u8, volts: f32) {
        self.modules.entry(node).or_default().supply = Some(volts);
    }

    /// Whether anything of this protocol was heard.
    pub(super) fn frames_heard(&self) -> bool {
        self.frames > self.malformed
    }

    /// Frames heard, those that are not of this protocol, and those of another station.
    pub fn counts(&self) -> (u64, u64, u64) {
        (self.frames, self.malformed, self.stations)
    }

    /// Takes a frame that was received at `at`.
    pub fn hear(&mut self, at: Duration, frame: &Frame) -> Vec<Change> {
        self.frames += 1;
        let Ok(message) = Message::parse(frame) else {
            self.malformed += 1;
            return Vec::new();
        };
        let mut changes = Vec::new();
        let node = frame.module();
        if let Message::EmergencyStop(stop) = &message
            && self.stop.command(stop.command(), stop.count())
        {
            changes.push(Change::Stopped(self.stop.stopped()));
        }
        if node == STATION {
            self.stations += 1;
            return changes;
        }
        let module = self.modules.entry(node).or_default();
        if module.heard.is_none() || module.gone {
            changes.push(Change::Came(node));
            module.gone = false;
        }
        module.heard = Some(at);
        module.cycles = self.cycles;
        let mut health = None;
        match message {
            Message::Sync(sync) => {
                if let Some((_, last, then)) = self.sync
                    && last.cycle.wrapping_add(1) == sync.cycle
                {
                    let period = at.saturating_sub(then);
                    if period > PERIOD / 10 && period < PERIOD * 10 {
                        self.period = Some(self.period.map_or(period, |old| (old * 7 + period) / 8));
                    }
                }
                self.cycles += u64::from(self.sync.is_none_or(|(_, last, _)| last.cycle != sync.cycle));
                self.sync = Some((node, sync, at));
                self.expected = sync.modules;
                for node in 0..sync.modules.min(MAX_MODULES as u8) {
                    self.modules.entry(node).or_default();
                }
                let cycles = self.cycles;
                changes.extend(self.who_is_gone(|module| cycles - module.cycles >= u64::from(SILENT_CYCLES)));
            }
            Message::State(state) => {
                module.state = Some(state);
                health = Some(state.health);
            }
            Message::Latent(latent) => health = Some(latent.health),
            Message::Telemetry(telemetry) => module.telemetry = Some(telemetry),
            Message::Heartbeat(heartbeat) => {
                health = Some(heartbeat.health);
                let before = module.fault().unwrap_or(0);
                if heartbeat.fault != before {
                    changes.push(Change::Fault { node, fault: heartbeat.fault });
                }
                if heartbeat.fault != 0 {
                    module.last_fault = Some((heartbeat.fault, at));
                }
                module.heartbeat = Some(heartbeat);
            }
            _ => {}
        }
        if let Some(health) = health
            && self.stop.hear(health.has(Health::EMERGENCY_STOP), health.stop_count())
        {
            changes.push(Change::Stopped(self.stop.stopped()));
        }
        changes
    }

    /// Looks at the clock: who has fallen silent? To be asked when no frame waits to be heard.
    pub fn look(&mut self, at: Duration) -> Vec<Change> {
        let period = self.period();
        // Without a time-keeper nobody sends STATE, but HEARTBEAT goes on. When the whole bus pauses, nobody in particular is gone.
        let beating = self.sync.is_some_and(|(.., then)| at.saturating_sub(then) < period * 3 / 2);
        let patience = period * if beating { SILENT_CYCLES } else { HEARTBEAT_CYCLES * SILENT_CYCLES };
        self.who_is_gone(|module| module.heard.is_some_and(|heard| at.saturating_sub(heard) >= patience))
    }

    fn who_is_gone(&mut self, silent: impl Fn(&Module) -> bool) -> Vec<Change> {
        let mut changes = Vec::new();
        for (node, module) in &mut self.modules {
            if module.heard.is_some() && !module.gone && silent(module) {
                module.gone = true;
                let last_fault = module.last_fault.map_or(0, |(fault, _)| fault);
                changes.push(Change::Gone { node: *node, last_fault });
            }
        }
        changes
    }

    /// What people should know of the robot as a whole: each a sentence.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (node, module) in self.modules() {
            if module.heard.is_none() {
                warnings.push(format!("module {node} was never heard, though the robot has {} modules", self.expected));
            }
            if let Some(heartbeat) = module.heartbeat
                && heartbeat.protocol != PROTOCOL_VERSION
            {
                warnings.push(format!(
                    "module {node} speaks version {} of the protocol, this program version {PROTOCOL_VERSION}",
                    heartbeat.protocol
                ));
            }
        }
        let policies: std::collections::BTreeSet<u16> = self
            .modules()
            .filter(|(_, module)| !module.gone)
            .filter_map(|(_, m)| m.heartbeat.map(|h| h.policy))
            .collect();
        if policies.len() > 1 {
            let tags: Vec<String> = policies.iter().map(|tag| format!("{tag:04x}")).collect();
            warnings.push(format!("the modules have different policies: {}", tags.join(", ")));
        }
        warnings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::{EmergencyStop, NOBODY, StopCommand, StopCount};

    const HEALTHY: Health = Health::SENSORS_PLAUSIBLE;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn heartbeat(node: u8, fault: u8) -> Frame {
        let (mode, health) = (Mode::Disarmed as u8, HEALTHY);
        let beat =
            Heartbeat { mode, fault, health, time_keeper: NOBODY, protocol: PROTOCOL_VERSION, firmware: 16, policy: 7 };
        Message::Heartbeat(beat).emit(node, true)
    }

    fn state(node: u8, cycle: u64, health: Health) -> Frame {
        Message::State(State::new(cycle as u8, health, &[0.0; 4])).emit(node, true)
    }

    fn sync(cycle: u64, modules: u8) -> Frame {
        Message::Sync(Sync::new(cycle as u16, modules, modules)).emit(0, true)
    }

    /// Sixty cycles of 20 ms with modules 0 and 1 of three, then one of them is unplugged right after its STATE.
    /// When is it named, after being unplugged, and how?
    fn unplug(leaver: u8) -> (Duration, Change, Robot) {
        let mut robot = Robot::default();
        let beat = |robot: &mut Robot, cycle: u64, at: Duration| {
            let mut changes = Vec::new();
            let alone = cycle > 60 && leaver == 0;
            // The next time-keeper waits for two periods.
            if !alone || cycle > 62 {
                changes
                    .extend(robot.hear(at, &Message::Sync(Sync::new(cycle as u16, 2, 3)).emit(u8::from(alone), true)));
            }
            for node in [0, 1].into_iter().filter(|node| *node != leaver || cycle <= 60) {
                changes.extend(robot.hear(at, &state(node, cycle, HEALTHY)));
            }
            changes
        };
        for cycle in 0..=60 {
            beat(&mut robot, cycle, ms(20 * cycle));
            assert!(cycle == 0 || robot.look(ms(20 * cycle + 19)).is_empty(), "cycle {cycle}");
        }
        let told = [robot.hear(ms(1200), &heartbeat(leaver, 43)), robot.hear(ms(1200), &heartbeat(leaver, 0))].concat();
        assert_eq!(told, [Change::Fault { node: leaver, fault: 43 }, Change::Fault { node: leaver, fault: 0 }]);
        for now in 1201..2000 {
            let mut changes = Vec::new();
            if now % 20 == 0 {
                changes.extend(beat(&mut robot, now / 20, ms(now)));
            }
            changes.extend(robot.look(ms(now)));
            if let [change] = changes[..] {
                return (ms(now - 1200), change, robot);
            }
            assert!(changes.is_empty(), "{changes:?}");
        }
        panic!("nobody noticed");
    }

    #[test]
    fn a_module_that_is_unplugged_is_named_within_three_cycles_with_its_last_fault() {
        for leaver in [0, 1] {
            let (after, change, mut robot) = unplug(leaver);
            assert_eq!(change, Change::Gone { node: leaver, last_fault: 43 });
            assert!(after <= 3 * ms(20), "module {leaver}: {after:?}");
            assert_eq!(change.to_string(), format!("module {leaver} is gone; last fault: 43 UnderVoltage"));
            assert_eq!(robot.present(), [1 - leaver]);
            assert!(robot.warnings()[0].contains("module 2 was never heard"));
            assert_eq!(robot.hear(ms(1300), &state(leaver, 0, HEALTHY)), [Change::Came(leaver)]);
        }
    }

    #[test]
    fn frames_that_come_late_and_all_together_make_nobody_disappear() {
        let mut robot = Robot::default();
        for cycle in 0..100u64 {
            // Five cycles at once.
            let at = ms(100 * (cycle / 5));
            let mut changes = robot.hear(at, &sync(cycle, 2));
            changes.extend([0, 1].iter().flat_map(|node| robot.hear(at, &state(*node, cycle, HEALTHY))));
            assert!(cycle == 0 || changes.is_empty(), "cycle {cycle}: {changes:?}");
        }
    }

    #[test]
    fn without_a_beat_a_heartbeat_is_enough() {
        let mut robot = Robot::default();
        assert_eq!(robot.hear(ms(0), &heartbeat(4, 34)), [Change::Came(4), Change::Fault { node: 4, fault: 34 }]);
        assert!(robot.look(ms(1400)).is_empty());
        assert_eq!(robot.look(ms(1600)), [Change::Gone { node: 4, last_fault: 34 }]);
    }

    #[test]
    fn the_stop_is_known_by_whoever_says_so() {
        let mut robot = Robot::default();
        let stopped = HEALTHY.with(Health::EMERGENCY_STOP).with_stop_count(StopCount::new(4));
        let changes = robot.hear(ms(0), &state(2, 0, stopped));
        assert_eq!(changes, [Change::Came(2), Change::Stopped(true)]);
        assert_eq!(robot.stop().count().number(), 4);
        let release = Message::EmergencyStop(EmergencyStop::new(StopCommand::Release, 0, StopCount::new(5)));
        assert_eq!(robot.hear(ms(1), &release.emit(STATION, true)), [Change::Stopped(false)]);
        assert_eq!(robot.counts(), (2, 0, 1));
        assert!(robot.hear(ms(1), &Frame::new(0x700, true, &[1]).unwrap()).is_empty());
        assert_eq!(robot.counts().1, 1);
    }

    #[test]
    fn different_policies_are_told() {
        let mut robot = Robot::default();
        robot.hear(ms(0), &heartbeat(0, 0));
        assert!(robot.warnings().is_empty());
        let other = Heartbeat { policy: 8, protocol: 1, ..robot.module(0).unwrap().heartbeat.unwrap() };
        robot.hear(ms(0), &Message::Heartbeat(other).emit(1, true));
        let warnings = robot.warnings();
        assert!(
            warnings[0].contains("module 1 speaks version 1") && warnings[1].contains("0007, 0008"),
            "{warnings:?}"
        );
    }
}
