//! Arming and emergency stop on the bus.

use super::*;

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

/// The frames of the stop included, on a bus that is busy with latents or idle.
#[test]
fn a_stop_relaxes_all_reachable_modules_within_2_ms() {
    for (bus, modules) in [(BusKind::Fd, 8), (BusKind::Classic, 8), (BusKind::Fd, 64)] {
        for offset in [0, 60_000, 300_000, 700_000, 1_500_000, 3_000_000, 20_000_000] {
            let at = 500 * MS + offset;
            let config = SilConfig { commands: vec![(at, StopCommand::Stop)], ..SilConfig::new(bus) };
            let mut plant = Fine::new(modules, 20);
            run(&mut plant, &image(), &config, None, &mut |view, plant| {
                assert!(view.at_ns < 100 * MS || view.at_ns > at || plant.rests_since.is_none());
            })
            .unwrap();
            let rests = plant.rests_since.expect("they rest");
            // A module that computes looks at the frame when it is done, and then takes its time for what follows from it: that is not the bus's.
            let latency = 2 * 1000 * step_us(modules as u8) + STEP;
            assert!(
                rests > at && rests - at <= 2 * MS + latency,
                "{bus:?} {modules} {offset}: {} us",
                (rests - at) / 1000
            );
        }
    }
}

#[test]
fn modules_behind_a_cut_stop_when_they_come_back() {
    let mut config = with_faults(BusKind::Fd, "cut:3@500ms..1500ms", 8);
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
    simulate(&mut toy, &with_faults(BusKind::Fd, "cut:3@1s..5s", 8));
    let pulls = |step: usize, module: usize| toy.history[step][module] != [0.0; 2];
    assert!((0..8).all(|module| pulls(290, module)));
    assert!((0..8).all(|module| pulls(350, module) == (module < 4)));
    assert!((0..8).all(|module| pulls(640, module)));
}
