//! Any mixture of everything that can go wrong, against what must never happen: a torque that nobody allowed, a limit exceeded.

use super::*;

/// What happens next to a robot of four.
#[derive(Clone, Copy, Debug)]
enum Trouble {
    Unplug(usize),
    /// A reset; what outlasts it is known. The chip names this cause.
    Reset(u8, ResetCause),
    /// The supply is away for longer than anything outlasts.
    PowerCycle(u8),
    Cut(usize),
    Mend,
    /// Frames are lost at receivers, per cent.
    Loss(u32),
    /// The last frame but so many is seen once more, by all.
    Replay(usize),
    /// Somebody asks a module for a stop.
    Press(usize),
    /// The station says so, without knowing the count.
    Command(StopCommand),
    /// The same with a count of its own, right or wrong.
    CountedCommand(StopCommand, u8),
    /// The station asks all modules, or one.
    Request(u8, Operation, u32),
    Station(bool),
    BusOff(usize, bool),
    Blind(usize, bool),
    Hot(usize, bool),
    /// The joints of a module turn by so much, less than half a turn.
    Bend(usize, f32),
    /// The processor of a module hangs for so long.
    Hang(usize, Micros),
    Jog(usize, f32),
    Wait(Micros),
}

const MODULES: usize = 4;

fn any_trouble() -> impl Strategy<Value = Trouble> {
    let module = 0..MODULES;
    let cause = prop_oneof![Just(ResetCause::Watchdog), Just(ResetCause::PowerOn), Just(ResetCause::Software)];
    let command = || prop_oneof![Just(StopCommand::Stop), Just(StopCommand::Release)];
    let operation = prop_oneof![4 => Just(Operation::Arm), 1 => Just(Operation::Disarm), 1 => Just(Operation::Clear)];
    let to = prop_oneof![Just(ALL_MODULES), 0..MODULES as u8];
    prop_oneof![
        1 => module.clone().prop_map(Trouble::Unplug),
        1 => (0..MODULES as u8, cause).prop_map(|(module, cause)| Trouble::Reset(module, cause)),
        1 => (0..MODULES as u8).prop_map(Trouble::PowerCycle),
        1 => (1..MODULES).prop_map(Trouble::Cut),
        1 => Just(Trouble::Mend),
        1 => (0u32..70).prop_map(Trouble::Loss),
        1 => (0usize..200).prop_map(Trouble::Replay),
        1 => module.clone().prop_map(Trouble::Press),
        3 => command().prop_map(Trouble::Command),
        1 => (command(), 0u8..16).prop_map(|(command, count)| Trouble::CountedCommand(command, count)),
        5 => (to, operation, 0u32..2).prop_map(|(to, operation, value)| Trouble::Request(to, operation, value)),
        1 => any::<bool>().prop_map(Trouble::Station),
        1 => (module.clone(), any::<bool>()).prop_map(|(module, off)| Trouble::BusOff(module, off)),
        1 => (module.clone(), any::<bool>()).prop_map(|(module, blind)| Trouble::Blind(module, blind)),
        1 => (module.clone(), any::<bool>()).prop_map(|(module, hot)| Trouble::Hot(module, hot)),
        1 => (module.clone(), -1.5f32..1.5).prop_map(|(module, way)| Trouble::Bend(module, way)),
        1 => (module.clone(), 0u64..200_000).prop_map(|(module, time)| Trouble::Hang(module, time)),
        1 => (module, -50.0f32..50.0).prop_map(|(module, torque)| Trouble::Jog(module, torque)),
        8 => (0u64..600_000).prop_map(Trouble::Wait),
        2 => (0u64..4_000_000).prop_map(Trouble::Wait),
    ]
}

/// Follows one module from poll to poll, by what it was told and by what it did.
#[derive(Clone, Copy, Default)]
struct Witness {
    /// Torques after the last poll, and when one of them last grew, or all were taken away.
    torque: [f32; AXES],
    changed: Micros,
}

impl Net {
    /// Looks at the outputs after anything happened: who drives was armed, and changed its torque within the slew limit.
    fn witness(&self, witnesses: &mut [Witness; MODULES]) -> Result<(), TestCaseError> {
        let limits = self.policy.limits();
        let caps = self.safety.caps;
        for (node, witness) in witnesses.iter_mut().enumerate() {
            let Some(controller) = &self.nodes[node] else {
                *witness = Witness { torque: [0.0; AXES], changed: self.now };
                continue;
            };
            let outputs = &self.outputs[node];
            let allowed = controller.armed() || controller.mode() == Mode::Service;
            let stopped = controller.failsafe.stop().stopped();
            prop_assert!(outputs.torque == [0.0; AXES] || (allowed && !stopped && outputs.motors_enabled));
            prop_assert!(!outputs.motors_enabled || (allowed && !stopped));
            let mut grown = !outputs.motors_enabled && witness.torque != [0.0; AXES];
            for (torque, before) in outputs.torque.iter().zip(witness.torque) {
                prop_assert!(torque.abs() <= caps.torque_limit(&limits));
                // Towards zero a torque may drop at once.
                if torque.abs() > before.abs() || torque * before < 0.0 {
                    grown = true;
                    let seconds = (self.now - witness.changed).min(PERIOD) as f32 / 1e6;
                    let most = caps.torque_slew.min(limits.torque_slew) * seconds + 1e-3;
                    // A change of sign may have dropped to zero on the way.
                    let change = if torque * before < 0.0 { torque.abs() } else { torque.abs() - before.abs() };
                    prop_assert!(change <= most, "module {node}: {change} in {seconds} s");
                }
            }
            let changed = if grown { self.now } else { witness.changed };
            *witness = Witness { torque: outputs.torque, changed };
            // Outwards beyond its end, no joint is pushed.
            let beyond = |sign: f32, axis: usize| {
                let own = self.sensors[node].joint_angles.iter().skip(axis).step_by(AXES);
                own.clone().any(|angle| sign * angle > self.safety.joints[axis].max.min(limits.joint_angle))
            };
            for (axis, torque) in outputs.torque.iter().enumerate() {
                prop_assert!(*torque <= 0.0 || !beyond(1.0, axis));
                prop_assert!(*torque >= 0.0 || !beyond(-1.0, axis));
            }
        }
        Ok(())
    }

    /// Time passes, looked at after every moment at which something happened.
    fn run_watched(&mut self, time: Micros, witnesses: &mut [Witness; MODULES]) -> Result<(), TestCaseError> {
        let until = self.now + time;
        while self.now < until {
            let due = self.nodes.iter().zip(&self.outputs).filter_map(|(n, o)| n.as_ref().map(|_| o.deadline)).min();
            let next = due.unwrap_or(until).clamp(self.now + 1, until);
            self.run(next - self.now);
            self.witness(witnesses)?;
        }
        Ok(())
    }

    fn suffer(&mut self, trouble: Trouble, witnesses: &mut [Witness; MODULES], seed: u32) -> Result<(), TestCaseError> {
        match trouble {
            Trouble::Unplug(node) => self.unplug(node),
            Trouble::Reset(node, said) => {
                let kept = self.nodes[usize::from(node)].as_ref().map_or([0; 2], |n| n.retained().words());
                self.unplug(node.into());
                self.start(node, Boot::new(said, kept));
            }
            Trouble::PowerCycle(node) => {
                self.unplug(node.into());
                self.start(node, Boot::default());
            }
            Trouble::Cut(at) => self.part = (0..MODULES).map(|i| u8::from(i >= at)).collect(),
            Trouble::Mend => self.part = vec![0; MODULES],
            Trouble::Loss(percent) => {
                let mut state = seed;
                self.loss = Box::new(move |_, _, _| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    (state >> 16) % 100 < percent
                });
            }
            Trouble::Replay(back) => {
                if let Some((_, frame)) = self.log.len().checked_sub(back + 1).map(|at| self.log[at]) {
                    self.inject(frame);
                }
            }
            Trouble::Press(node) => {
                if let Some(controller) = &mut self.nodes[node] {
                    controller.emergency_stop(0);
                    self.poll(node, None);
                    self.settle();
                    prop_assert!(!self.outputs[node].motors_enabled);
                }
            }
            Trouble::Command(command) => {
                let stop = EmergencyStop::new(command, 0, StopCount::UNKNOWN);
                self.inject(Message::EmergencyStop(stop).emit(STATION, true));
            }
            Trouble::CountedCommand(command, count) => {
                let stop = EmergencyStop::new(command, 0, StopCount::new(count));
                self.inject(Message::EmergencyStop(stop).emit(STATION, true));
            }
            Trouble::Request(to, operation, value) => self.request(to, operation, value),
            Trouble::Station(on) => (self.station, self.armed) = (on, on),
            Trouble::BusOff(node, off) => {
                self.status[node] = if off { BusStatus::BusOff } else { BusStatus::ErrorActive };
                self.part[node] = if off { 9 } else { 0 };
            }
            Trouble::Blind(node, blind) => {
                self.sensors[node] = if blind { Sensors::ZERO } else { level() };
                self.poll(node, None);
            }
            Trouble::Hot(node, hot) => self.sensors[node].temperature = if hot { 95.0 } else { 25.0 },
            Trouble::Bend(node, way) => {
                self.sensors[node].joint_angles = self.sensors[node].joint_angles.map(|a| (a + way).clamp(-3.1, 3.1));
                self.poll(node, None);
            }
            Trouble::Hang(node, time) => {
                let hung = self.nodes[node].take();
                let (outputs, witness) = (self.outputs[node], witnesses[node]);
                self.run_watched(time, witnesses)?;
                witnesses[node] = witness;
                // Its motors did as they were told meanwhile, and the hardware's watchdog is not looked at here.
                self.nodes[node] = hung;
                self.outputs[node] = outputs;
                if self.nodes[node].is_some() {
                    self.poll(node, None);
                }
            }
            Trouble::Jog(node, torque) => {
                if let Some(controller) = &mut self.nodes[node] {
                    let _ = controller.jog(node % AXES, torque, 300_000);
                }
            }
            Trouble::Wait(time) => self.run_watched(time, witnesses)?,
        }
        self.witness(witnesses)
    }
}

/// Schedules to try: 200, or as many as the environment variable says.
fn cases() -> u32 {
    std::env::var("COMPOSER_SCHEDULES").ok().and_then(|n| n.parse().ok()).unwrap_or(200)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases(), failure_persistence: None, ..ProptestConfig::default() })]

    /// Any mixture of faults, resets, stops, brown-outs, stale frames, lost frames and cuts: never a torque while disarmed or stopped, never
    /// more than the limits allow; and when all is well again and the station says so, the robot stops and moves as one.
    #[test]
    fn no_mixture_of_troubles_makes_a_torque_that_nobody_allowed(
        troubles in prop::collection::vec(any_trouble(), 1..40), seed in any::<u32>(),
    ) {
        let mut net = Net::new(MODULES as u8, BusKind::Fd, policy(1 + seed % 4, &[]));
        net.safety.caps.torque_slew = 150.0;
        net.safety.joints = [crate::limits::JointRange { min: -3.0, max: 3.0 }; 4];
        (0..MODULES as u8).for_each(|node| net.plug(node));
        let mut witnesses = [Witness::default(); MODULES];
        for trouble in troubles {
            net.suffer(trouble, &mut witnesses, seed)?;
        }
        // All is well again.
        net.part = vec![0; MODULES];
        net.status = vec![BusStatus::ErrorActive; MODULES];
        net.sensors = vec![level(); MODULES];
        net.loss = Box::new(|_, _, _| false);
        (net.station, net.armed) = (true, false);
        for node in 0..MODULES as u8 {
            if net.nodes[usize::from(node)].is_none() {
                net.start(node, Boot::default());
            }
        }
        net.run_watched(2 * SECOND, &mut witnesses)?;
        net.station_says(StopCommand::Stop);
        net.run_watched(2 * PERIOD, &mut witnesses)?;
        prop_assert!(net.live().all(|n| n.mode() == Mode::Stopped));
        net.request(ALL_MODULES, Operation::Clear, 0);
        net.run_watched(SECOND, &mut witnesses)?;
        net.station_says(StopCommand::Release);
        net.run_watched(2 * PERIOD, &mut witnesses)?;
        net.request(ALL_MODULES, Operation::Arm, 1);
        net.run_watched(4 * PERIOD, &mut witnesses)?;
        net.assert_in_step();
        prop_assert!(net.outputs.iter().all(|o| o.motors_enabled));
    }
}
