//! Arming and emergency stop on the bus.

use super::*;
use crate::frame_bits::{Format, worst_case};

/// A [`Toy`] that takes ten small steps for one, and remembers when it was last told to pull.
struct Fine {
    toy: Toy,
    steps: u64,
    pulling: Vec<bool>,
    /// When the last module stopped pulling, and nobody pulled any more, ns.
    rests_since: Option<u64>,
}

/// Step of [`Fine`], ns.
const STEP: u64 = 100_000;

impl Fine {
    fn new(modules: usize, cycles: usize) -> Self {
        Fine { toy: Toy::new(modules, cycles), steps: 0, pulling: vec![false; modules], rests_since: Some(0) }
    }
}

impl Plant for Fine {
    fn modules(&self) -> usize {
        self.toy.modules
    }

    fn step_ns(&self) -> u64 {
        STEP
    }

    fn sensors(&self, module: usize) -> Sensors {
        self.toy.sensors(module)
    }

    fn point(&self, point: u8) -> Option<[f32; 3]> {
        self.toy.point(point)
    }

    fn set_torque(&mut self, module: usize, torque: [f32; 2]) {
        self.toy.set_torque(module, torque);
        self.pulling[module] = torque != [0.0; 2];
        if self.pulling.contains(&true) {
            self.rests_since = None;
        } else {
            self.rests_since = self.rests_since.or(Some(self.steps * STEP));
        }
    }

    fn step(&mut self) {
        self.steps += 1;
        if self.steps.is_multiple_of(100) {
            self.toy.step();
        }
    }

    fn done(&self) -> bool {
        self.toy.done()
    }
}

/// How long after `at` all torques of a robot are zero, us; the step of the plant included.
fn rests_after(modules: usize, at: u64, config: &SilConfig) -> u64 {
    let mut plant = Fine::new(modules, 20);
    let mut pulled = false;
    let config = SilConfig { limit_ns: at + 20 * MS, ..config.clone() };
    run(&mut plant, &image(), &config, None, &mut |view, plant| {
        pulled |= view.at_ns + 50 * MS > at && view.at_ns <= at && plant.rests_since.is_none();
    })
    .unwrap();
    assert!(pulled, "the robot was not at rest before");
    (plant.rests_since.expect("they rest") - at) / 1000
}

/// Longest frame of a bus with the pause behind it, us: what a stop waits for when it comes a bit too late.
fn longest_frame_us(bus: BusKind) -> u64 {
    let (format, len) = match bus {
        BusKind::Fd => (Format::FdBrs, 64),
        BusKind::Classic => (Format::Classic, 8),
    };
    SilConfig::new(bus).rates.with_interframe_ns(worst_case(format, len)) / 1000
}

/// From the moment at which the station wants the stop until no module gives any torque: in every phase of the control cycle, on an idle bus and on one
/// that is never idle. What bounds it is the bus: the frame that is on the wire, the stop itself, and the period of the current loops.
#[test]
fn a_stop_relaxes_all_reachable_modules_within_2_ms() {
    let mut worst = Vec::new();
    for (bus, modules, steps) in [(BusKind::Fd, 8, 100), (BusKind::Classic, 8, 100), (BusKind::Fd, 64, 25)] {
        for loaded in [false, true] {
            let mut longest = 0;
            for phase in 0..steps {
                let at = 400 * MS + phase * 50 * MS / steps;
                // The least urgent and longest frames there are, one behind the other: whenever the bus would be idle one of them is on it.
                let length = if bus == BusKind::Fd { 64 } else { 8 };
                let flood = Frame::new(0x7fe, bus == BusKind::Fd, &[0x55; 64][..length]).unwrap();
                let flood = (0..if loaded { 1500 } else { 0 })
                    .map(|number| Injected { at_ns: 390 * MS + number * 40_000, frame: flood })
                    .collect();
                let config =
                    SilConfig { commands: vec![(at, StopCommand::Stop)], injected: flood, ..SilConfig::new(bus) };
                longest = longest.max(rests_after(modules, at, &config));
            }
            worst.push((bus, modules, loaded, longest));
        }
    }
    for (bus, modules, loaded, longest) in worst {
        let bound = 2 * longest_frame_us(bus) + WITHIN_US + STEP / 1000;
        assert!(longest <= bound.min(2000), "{bus:?}, {modules} modules, loaded {loaded}: {longest} us, not {bound}");
    }
}

/// What noise destroys, here every tenth frame, is sent again at once; each time costs a frame and an error frame.
#[test]
fn a_stop_on_a_noisy_line_is_late_by_its_retransmissions_only() {
    for (bus, seed) in (0..40).flat_map(|seed| [(BusKind::Fd, seed), (BusKind::Classic, seed)]) {
        let at = 400 * MS + 1_250_000 * seed;
        let faults = crate::faults::FaultPlan::draw(&"corrupt:0.1".parse().unwrap(), seed, 8);
        let config = SilConfig { faults, seed, commands: vec![(at, StopCommand::Stop)], ..SilConfig::new(bus) };
        let longest = rests_after(8, at, &config);
        assert!(longest <= 2000, "{bus:?} {seed}: {longest} us");
    }
}

/// The stop input of one module takes its own torque at once and that of the others with the frame that tells them, even while it computes.
#[test]
fn a_stop_input_relaxes_all_reachable_modules_within_2_ms() {
    for (bus, modules) in [(BusKind::Fd, 8), (BusKind::Classic, 8), (BusKind::Fd, 64)] {
        for phase in 0..50 {
            let at = 400 * MS + phase * MS;
            let presses = vec![(at, modules / 2)];
            let longest = rests_after(modules, at, &SilConfig { presses, ..SilConfig::new(bus) });
            let bound = 2 * longest_frame_us(bus) + WITHIN_US + STEP / 1000;
            assert!(longest <= bound.min(2000), "{bus:?}, {modules} modules, {phase} ms: {longest} us, not {bound}");
        }
    }
}

/// Both parts of a cut cable, from the moment on at which it is cut.
#[test]
fn a_stop_reaches_both_parts_of_a_cut_robot_within_2_ms() {
    for (bus, cut) in (0..7).flat_map(|cut| [(BusKind::Fd, cut), (BusKind::Classic, cut)]) {
        for after in [0, 5, 30, 60, 200] {
            let at = 400 * MS + after * MS;
            let faults = crate::faults::FaultPlan::draw(&format!("cut:{cut}@400ms").parse().unwrap(), 1, 8);
            let config = SilConfig { faults, commands: vec![(at, StopCommand::Stop)], ..SilConfig::new(bus) };
            let longest = rests_after(8, at, &config);
            assert!(longest <= 2000, "{bus:?} {cut} {after}: {longest} us");
        }
    }
}

#[test]
fn modules_behind_a_cut_stop_when_they_come_back() {
    let mut config = SilConfig { ring: false, ..with_faults(BusKind::Fd, "cut:3@500ms..1500ms", 8) };
    config.commands = vec![(1000 * MS, StopCommand::Stop)];
    let mut toy = Toy::new(8, 50);
    simulate(&mut toy, &config);
    let pulls = |step: usize, module: usize| toy.history[step][module] != [0.0; 2];
    assert!((0..4).all(|module| !pulls(110, module)), "reachable");
    assert!((4..8).all(|module| pulls(140, module)), "behind the cut");
    assert!(toy.history[165..].iter().all(|torques| torques.iter().all(|t| *t == [0.0; 2])));
}

#[test]
fn a_stop_survives_losses_a_brown_out_of_all_and_a_module_that_comes_in() {
    let all: Vec<String> = (0..8).map(|m| format!("brownout:#{m}@{}ms", 1200 + m)).collect();
    let mut config = with_faults(BusKind::Fd, &format!("drop:0.3,unplug:#5@100ms..2s,{}", all.join(",")), 8);
    config.commands = vec![(1000 * MS, StopCommand::Stop)];
    let mut toy = Toy::new(8, 80);
    let (_, seen) = simulate(&mut toy, &config);
    assert!(toy.history[115..].iter().all(|torques| torques.iter().all(|t| *t == [0.0; 2])));
    let last = seen.last().unwrap();
    assert!(last.faults.iter().all(|faults| faults.contains(&Trouble::EmergencyStop)), "{:?}", last.faults);
}

#[test]
fn a_module_that_browned_out_stays_disarmed_and_the_others_go_on() {
    let mut toy = Toy::new(8, 80);
    let (_, seen) = simulate(&mut toy, &with_faults(BusKind::Fd, "brownout:#3@1s,unplug:#6@1s..1100ms", 8));
    assert!(toy.history[102..].iter().all(|torques| torques[3] == [0.0; 2]));
    let last = seen.last().unwrap();
    for module in 0..8 {
        let faults: &[Trouble] = if module == 3 { &[Trouble::Restarted] } else { &[] };
        assert_eq!(last.faults[module], faults);
        // The one that was plugged in again was armed by the station, the one whose supply broke in waits for somebody.
        assert_eq!(toy.history.last().unwrap()[module] == [0.0; 2], module == 3, "{module}");
    }
    assert!(last.heard.iter().all(|heard| *heard == 0xff), "it takes part");
}

#[test]
fn without_a_station_nobody_moves() {
    let config = SilConfig { station: false, ..SilConfig::new(BusKind::Fd) };
    let mut toy = Toy::new(8, 60);
    simulate(&mut toy, &config);
    assert!(toy.history.iter().all(|torques| torques.iter().all(|t| *t == [0.0; 2])));
}

#[test]
fn what_is_blind_relaxes_if_it_is_to_be_as_on_a_board() {
    for blind_relaxes in [false, true] {
        let mut config = with_faults(BusKind::Fd, "observation:#4@1s", 8);
        config.safety.blind_relaxes = blind_relaxes;
        let mut toy = Toy::new(8, 60);
        simulate(&mut toy, &config);
        assert!(toy.history[106..].iter().all(|torques| (torques[4] == [0.0; 2]) == blind_relaxes));
    }
}

/// A cut takes the station from one part; after the dead man's time that part relaxes, and comes back with the cable.
#[test]
fn a_part_of_the_robot_that_lost_the_station_relaxes_after_a_while() {
    let mut toy = Toy::new(8, 140);
    let mut config = with_faults(BusKind::Fd, "cut:3@1s..5s", 8);
    config.ring = false;
    simulate(&mut toy, &config);
    let pulls = |step: usize, module: usize| toy.history[step][module] != [0.0; 2];
    assert!((0..8).all(|module| pulls(290, module)));
    assert!((0..8).all(|module| pulls(350, module) == (module < 4)));
    assert!((0..8).all(|module| pulls(640, module)));
}
