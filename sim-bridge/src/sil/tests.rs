//! Whole robots on a toy plant: what faults do to them.

use super::*;
use crate::candump;
use crate::confinement::ErrorCounters;
use crate::faults::FaultPlan;
use crate::frame_bits::BitRates;
use composer_shared::policy::{IMAGE_SIZE, random_image};
use composer_shared::wire::{EmergencyStop, Fault as Trouble, Message, StopCount};

mod safety;
mod simulation;

const MS: u64 = 1_000_000;

/// Joints whose speed follows the torque; whatever was applied is kept.
pub(crate) struct Toy {
    modules: usize,
    steps: usize,
    angles: Vec<[f32; 4]>,
    torques: Vec<[f32; 2]>,
    pub(crate) history: Vec<Vec<[f32; 2]>>,
}

impl Toy {
    pub(crate) fn new(modules: usize, cycles: usize) -> Self {
        let angles = (0..modules).map(|m| [0.1 * m as f32, -0.05, 0.02 * m as f32, 0.1]).collect();
        Toy { modules, steps: 5 * cycles, angles, torques: vec![[0.0; 2]; modules], history: Vec::new() }
    }
}

impl Plant for Toy {
    fn modules(&self) -> usize {
        self.modules
    }

    fn step_ns(&self) -> u64 {
        10 * MS
    }

    fn sensors(&self, module: usize) -> Sensors {
        let torque = self.torques[module].map(|t| t / 80.0);
        let speeds = [0, 1, 0, 1].map(|axis| torque[axis]);
        Sensors {
            joint_angles: self.angles[module],
            joint_speeds: speeds,
            up: [0.0, 0.0, 1.0],
            torque,
            temperature: 25.0,
            ..Sensors::ZERO
        }
    }

    fn point(&self, _: u8) -> Option<[f32; 3]> {
        Some([5.0, 3.0 - 0.01 * self.history.len() as f32, 0.0])
    }

    fn set_torque(&mut self, module: usize, torque: [f32; 2]) {
        self.torques[module] = torque;
    }

    fn step(&mut self) {
        for (angles, torque) in self.angles.iter_mut().zip(&self.torques) {
            for (k, angle) in angles.iter_mut().enumerate() {
                *angle += 0.01 * (torque[k % 2] / 80.0 - 0.5 * *angle);
            }
        }
        self.history.push(self.torques.clone());
    }

    fn done(&self) -> bool {
        self.history.len() >= self.steps
    }
}

pub(crate) fn image() -> [u8; IMAGE_SIZE] {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    image
}

/// What the tests look at after each cycle.
#[derive(Clone, Debug, PartialEq)]
struct Seen {
    heard: Vec<u64>,
    keepers: Vec<Option<u8>>,
    faults: Vec<Vec<Trouble>>,
    attention: Vec<[u16; MAX_MODULES]>,
}

fn simulate(toy: &mut Toy, config: &SilConfig) -> (SilReport, Vec<Seen>) {
    let mut seen = Vec::new();
    let report = run(toy, &image(), config, None, &mut |view, plant| {
        assert_eq!(view.cycle as usize, seen.len());
        assert_eq!(view.at_ns, plant.history.len() as u64 * 10 * MS);
        seen.push(Seen {
            heard: view.modules.iter().map(|m| m.heard).collect(),
            keepers: view.modules.iter().map(|m| m.time_keeper).collect(),
            faults: view.modules.iter().map(|m| m.faults.iter().collect()).collect(),
            attention: view.modules.iter().map(|m| *m.attention).collect(),
        });
    });
    (report.unwrap(), seen)
}

fn with_faults(bus: BusKind, plan: &str, modules: usize) -> SilConfig {
    let plan: FaultPlan = plan.parse().unwrap();
    SilConfig { faults: plan.draw(1, modules), ..SilConfig::new(bus) }
}

/// The same without guards: whoever babbles is heard.
fn unguarded(bus: BusKind, plan: &str, modules: usize) -> SilConfig {
    SilConfig { guard: false, ..with_faults(bus, plan, modules) }
}

#[test]
fn a_healthy_robot_keeps_the_beat_on_both_buses() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut toy = Toy::new(8, 125);
        let (report, seen) = simulate(&mut toy, &SilConfig::new(bus));
        assert_eq!((report.cycles, report.duration_ns, seen.len()), (125, 6_250 * MS, 125));
        assert_eq!((report.error_frames, report.deadline_misses, report.cut_short), (0, 0, false));
        assert!(seen.iter().all(|s| s.heard.iter().all(|h| *h == 0xff)), "{bus:?}");
        assert!(seen.iter().all(|s| s.keepers.iter().all(|k| *k == Some(0))));
        assert!(seen.iter().all(|s| s.faults.iter().all(Vec::is_empty)));
        for module in &report.modules {
            assert_eq!((module.stats.acted, module.stats.malformed), (125, 0));
            assert!(module.longest_gap_ms < 51.0 && module.errors == ErrorCounters::default());
        }
        // Attention weights of the modules heard add up to one.
        let sum: u32 = seen[60].attention[3].iter().map(|w| u32::from(*w)).sum();
        assert!((32_700..=32_800).contains(&sum), "{sum}");
        // Frames at least: 8 times STATE and LATENT (in 8 pieces on the classic bus), SYNC and GOAL a cycle.
        let least = if bus == BusKind::Fd { 125 * (16 + 2) } else { 125 * (72 + 2) };
        assert!((least..least + 400).contains(&report.frames), "{bus:?} {}", report.frames);
        let load = if bus == BusKind::Fd { 0.02..0.06 } else { 0.14..0.25 };
        assert!(load.contains(&report.bus_load), "{bus:?} {}", report.bus_load);
        let age = if bus == BusKind::Fd { 1.0..4.0 } else { 6.0..13.0 };
        assert!(age.contains(&report.latent_age_max_ms), "{bus:?} {}", report.latent_age_max_ms);
    }
}

#[test]
fn a_torque_acts_from_the_step_after_it_was_computed() {
    let mut toy = Toy::new(4, 3);
    simulate(&mut toy, &SilConfig::new(BusKind::Fd));
    // Computed within the first 10 ms: the first step still runs without it, the second has it; it changes with the cycles only.
    assert_eq!(toy.history[0], [[0.0; 2]; 4]);
    assert_ne!(toy.history[1], [[0.0; 2]; 4]);
    for cycle in 0..2 {
        let first = 5 * cycle + 1;
        assert!(toy.history[first..first + 5].iter().all(|t| *t == toy.history[first]));
        assert_ne!(toy.history[first + 5], toy.history[first]);
    }
}

#[test]
fn the_same_run_twice_is_the_same_and_the_seed_matters() {
    let all = "unplug:1,drop:0.05,delay:2ms,corrupt:0.02,duplicate:0.02,cut@1s..3s,action:1,observation:1,stuck:1";
    let go = |seed| {
        let mut toy = Toy::new(8, 100);
        let config = SilConfig { seed, ..with_faults(BusKind::Fd, all, 8) };
        let result = simulate(&mut toy, &config);
        (result, toy.history)
    };
    let first = go(1);
    assert!(first == go(1));
    assert!(first.1 != go(2).1);
}

#[test]
fn any_module_can_be_unplugged_and_the_others_go_on() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        for gone in 0..8 {
            // In the middle of a cycle, while latents fly.
            for at in ["1000100us", "1002ms", "1030ms"] {
                let mut toy = Toy::new(8, 60);
                let (report, seen) = simulate(&mut toy, &with_faults(bus, &format!("unplug:#{gone}@{at}"), 8));
                for (module, other) in report.modules.iter().enumerate().filter(|(m, _)| *m != gone) {
                    assert!(other.longest_gap_ms < 150.0, "{bus:?} {gone} {at} {module}: {} ms", other.longest_gap_ms);
                    assert!(other.stats.acted >= 56, "{bus:?} {gone} {at} {module}: {}", other.stats.acted);
                }
                let last = seen.last().unwrap();
                let keeper = Some(u8::from(gone == 0));
                for module in (0..8).filter(|m| *m != gone) {
                    assert_eq!(last.heard[module], 0xff & !(1 << gone));
                    assert_eq!(last.keepers[module], keeper);
                    assert!(last.faults[module].is_empty(), "{:?}", last.faults);
                }
                // The plant feels no torque of it from the next step on.
                assert!(toy.history[101..].iter().all(|t| t[gone] == [0.0; 2]) || at == "1030ms");
                assert!(toy.history[104..].iter().all(|t| t[gone] == [0.0; 2]));
            }
        }
    }
}

#[test]
fn a_module_plugged_in_again_joins() {
    for gone in [0, 3, 7] {
        let mut toy = Toy::new(8, 80);
        let (report, seen) = simulate(&mut toy, &with_faults(BusKind::Fd, &format!("unplug:#{gone}@1s..2s"), 8));
        assert!(seen[35].heard.iter().enumerate().all(|(m, h)| m == gone || *h == 0xff & !(1 << gone)));
        let last = seen.last().unwrap();
        assert!(last.heard.iter().all(|h| *h == 0xff), "{gone}: {:x?}", last.heard);
        assert!(last.keepers.iter().all(|k| *k == Some(0)), "{gone}: {:?}", last.keepers);
        assert!(last.faults.iter().all(Vec::is_empty), "{gone}: {:?}", last.faults);
        assert!(toy.history[300..].iter().any(|t| t[gone] != [0.0; 2]));
        assert!(report.modules.iter().all(|m| m.longest_gap_ms < 400.0));
    }
}

#[test]
fn both_halves_of_a_cut_robot_go_on_without_a_ring_and_become_one_again() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        for cut in 0..7 {
            let mut toy = Toy::new(8, 100);
            let mut config = with_faults(bus, &format!("cut:{cut}@1001ms..3007ms"), 8);
            config.ring = false;
            let (report, seen) = simulate(&mut toy, &config);
            let front = (2u64 << cut) - 1;
            let during = &seen[45];
            for module in 0..8usize {
                let (mine, keeper) = if module <= cut { (front, 0) } else { (0xff & !front, cut as u8 + 1) };
                assert_eq!(during.heard[module], mine, "{bus:?} {cut} {module}");
                // The last module alone has nobody to keep the time for, but does so.
                assert_eq!(during.keepers[module], Some(keeper), "{bus:?} {cut} {module}");
            }
            for module in report.modules.iter().take(7) {
                assert!(module.longest_gap_ms < 150.0, "{bus:?} {cut}: {}", module.longest_gap_ms);
            }
            let last = seen.last().unwrap();
            assert!(last.heard.iter().all(|h| *h == 0xff), "{bus:?} {cut}: {:x?}", last.heard);
            assert!(last.keepers.iter().all(|k| *k == Some(0)), "{bus:?} {cut}: {:?}", last.keepers);
            assert!(last.faults.iter().all(Vec::is_empty), "{bus:?} {cut}: {:?}", last.faults);
        }
    }
}

/// A station with a port at either end keeps both parts together, whatever else the bus does to frames.
#[test]
fn a_cut_robot_goes_on_as_one_over_the_ring() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        for cut in 0..7 {
            let mut toy = Toy::new(8, 100);
            let config = with_faults(bus, &format!("cut:{cut}@1001ms..3007ms"), 8);
            let (report, seen) = simulate(&mut toy, &config);
            for (cycle, seen) in seen.iter().enumerate().filter(|(cycle, _)| !(20..25).contains(cycle)) {
                assert!(seen.heard.iter().all(|h| *h == 0xff), "{bus:?} {cut} {cycle}: {:x?}", seen.heard);
            }
            for seen in &seen {
                assert!(seen.keepers.iter().all(|k| *k == Some(0)), "{bus:?} {cut}: {:?}", seen.keepers);
                assert!(seen.faults.iter().all(Vec::is_empty), "{bus:?} {cut}: {:?}", seen.faults);
            }
            assert!(report.modules.iter().all(|m| m.longest_gap_ms < 150.0), "{bus:?} {cut}: {report:?}");
        }
        for disturbance in ["drop:0.1", "delay:2ms", "duplicate:0.2", "corrupt:0.05", "delay:2ms,drop:0.05"] {
            let mut toy = Toy::new(8, 120);
            let config = with_faults(bus, &format!("{disturbance},cut:4@1s..3s,cut:2@4s..5s"), 8);
            let (_, seen) = simulate(&mut toy, &config);
            let all = seen.iter().flat_map(|seen| &seen.faults);
            assert!(all.flatten().count() == 0, "{bus:?} {disturbance}: nobody takes another for itself");
            let heard: u32 = seen.iter().flat_map(|s| &s.heard).map(|h| h.count_ones()).sum();
            // On the classic bus one lost piece of eight loses a latent.
            let least = if bus == BusKind::Fd { 0.85 } else { 0.35 };
            assert!(f64::from(heard) > least * 64.0 * 120.0, "{bus:?} {disturbance}: {heard} of 7680");
        }
    }
}

#[test]
fn losses_and_corruption_cost_little() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut toy = Toy::new(8, 125);
        let (report, seen) = simulate(&mut toy, &with_faults(bus, "drop:0.05", 8));
        assert!(report.dropped > 500 && report.deadline_misses > 50, "{report:?}");
        for module in &report.modules {
            assert!(module.stats.acted >= 120 && module.longest_gap_ms < 150.0, "{bus:?}: {module:?}");
        }
        let heard: u32 = seen.iter().flat_map(|s| &s.heard).map(|h| h.count_ones()).sum();
        // One frame in twenty lost a latent; on the classic bus one in eight pieces is enough.
        let least = if bus == BusKind::Fd { 0.90 } else { 0.60 };
        assert!(f64::from(heard) > least * 8.0 * 8.0 * 125.0, "{bus:?}: {heard} of 8000");

        let mut toy = Toy::new(8, 125);
        let (report, seen) = simulate(&mut toy, &with_faults(bus, "corrupt:0.01", 8));
        assert!(report.error_frames > 5, "{report:?}");
        assert!(seen.iter().all(|s| s.heard.iter().all(|h| *h == 0xff)), "all are sent again in time");
        assert!(report.modules.iter().all(|m| m.longest_gap_ms < 55.0 && m.stats.acted == 125));
    }
}

#[test]
fn late_and_repeated_frames_do_no_harm() {
    let mut toy = Toy::new(8, 125);
    let (report, _) = simulate(&mut toy, &with_faults(BusKind::Fd, "delay:2ms,duplicate:0.2", 8));
    assert!(report.modules.iter().all(|m| m.stats.acted >= 124 && m.longest_gap_ms < 60.0), "{report:?}");
    assert!(report.latent_age_max_ms > 2.5);
}

/// Software that runs wild sends two dozen frames a second, whichever it tries; to the others its module is silent, and they go on.
#[test]
fn a_module_that_babbles_is_shut_out_by_its_guard() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        // SYNC of nobody, of the module itself and of the head, the head's STATE, and the goal.
        for id in [0x0ff, 0x085, 0x080, 0x180, 0x17f, 0x7ff] {
            let mut toy = Toy::new(8, 125);
            let (report, seen) = simulate(&mut toy, &with_faults(bus, &format!("babble:#5/{id:#x}@1s..4s"), 8));
            let others = |seen: &Seen| (0..8).filter(|m| *m != 5).all(|m| seen.heard[m] | 1 << 5 == 0xff);
            let full = seen[25..80].iter().filter(|seen| others(seen)).count();
            assert!(full >= 50, "{bus:?} {id:#x}: all others are heard in {full} of 55 cycles");
            assert!(report.bus_load < 0.5, "{bus:?} {id:#x}: {}", report.bus_load);
            assert!(report.modules[5].port.guarded > 1000 && report.modules[4].port.guarded == 0, "{report:?}");
            let keepers = |seen: &Seen| seen.keepers.iter().all(|keeper| *keeper == Some(0));
            assert!(seen[25..].iter().filter(|seen| !keepers(seen)).count() < 10, "{bus:?} {id:#x}");
            let last = seen.last().unwrap();
            assert!(last.heard.iter().all(|h| *h == 0xff) && last.faults.iter().all(Vec::is_empty), "{last:?}");
        }
    }
}

/// A CAN bus has no cure for a CAN controller that floods it with a high priority: SYNC gets through, nothing else does. Without
/// STATE, LATENT and GOAL each module acts on its own; nothing worse happens, and all is well afterwards.
#[test]
fn babble_does_not_make_every_module_its_own_time_keeper() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut toy = Toy::new(8, 125);
        let (report, seen) = simulate(&mut toy, &unguarded(bus, "babble:#5@1s..3s", 8));
        let during = &seen[50];
        for module in 0..8 {
            assert_eq!(during.heard[module], 1 << module, "hears nobody's latent");
        }
        assert!(seen.iter().all(|s| s.keepers.iter().all(|keeper| *keeper == Some(0))), "the head keeps the time");
        assert!(report.bus_load > 0.3);
        for (number, module) in report.modules.iter().enumerate() {
            assert!(module.stats.acted >= 120 && module.longest_gap_ms < 150.0, "{module:?}");
            assert_eq!(module.stats.takeovers, u32::from(number == 0), "{module:?}");
            assert!(module.port.displaced > 0 || number > 0, "{module:?}");
        }
        let last = seen.last().unwrap();
        assert!(last.heard.iter().all(|h| *h == 0xff) && last.faults.iter().all(Vec::is_empty), "{last:?}");
    }
}

/// The instructions of a control step grow with the number of modules, and so does the time until it acts.
#[test]
fn acting_takes_what_the_microcontroller_needs_for_that_many_modules() {
    for (modules, least, most) in [(8, 0.58, 0.75), (64, 2.33, 3.0)] {
        let age = |act_latency_us| {
            let config = SilConfig { act_latency_us, ..SilConfig::new(BusKind::Fd) };
            simulate(&mut Toy::new(modules, 20), &config).0.latent_age_max_ms
        };
        let acting = age(None) - age(Some(0));
        assert!((least..most).contains(&acting), "{acting} ms for {modules} modules");
    }
}

/// While a module computes nobody takes its received frames; they wait, and none is lost in any robot.
#[test]
fn received_frames_wait_while_a_module_computes() {
    for (modules, plan) in [(8, "none"), (64, "none"), (64, "drop:0.05"), (16, "babble:#5")] {
        let (report, _) = simulate(&mut Toy::new(modules, 20), &unguarded(BusKind::Fd, plan, modules));
        assert!(report.modules.iter().all(|module| module.port.overflowed == 0), "{modules} {plan}: {report:?}");
    }
    // A computer that is much too slow loses some, counts them, and the robot goes on.
    let slow = SilConfig { act_latency_us: Some(20_000), ..unguarded(BusKind::Fd, "babble:#5/0x7FF", 8) };
    let (report, _) = simulate(&mut Toy::new(8, 40), &slow);
    for (number, module) in report.modules.iter().enumerate() {
        assert!(module.port.overflowed > 1000 || number == 5, "{module:?}");
        assert!(module.stats.acted >= 38, "{module:?}");
    }
}

/// With the most urgent identifier of all not even SYNC gets through: everybody relaxes, and comes back afterwards.
#[test]
fn a_bus_that_is_jammed_altogether_relaxes_the_motors() {
    let mut toy = Toy::new(8, 125);
    let (_, seen) = simulate(&mut toy, &unguarded(BusKind::Fd, "babble:#5/0x000@1s..4s", 8));
    let relaxed = (0..8).filter(|m| toy.history[390][*m] == [0.0; 2]).count();
    // Whoever takes the time over by itself follows its own beat until it is isolated.
    assert!(seen[78].faults.iter().filter(|f| !f.is_empty()).count() >= 7, "{:?}", seen[78].faults);
    assert!(relaxed >= 7, "{:?}", toy.history[390]);
    let last = seen.last().unwrap();
    assert!(last.heard.iter().all(|h| *h == 0xff) && last.faults.iter().all(Vec::is_empty), "{last:?}");
    assert!(last.keepers.iter().all(|k| *k == Some(0)));
}

/// An urgent flood below all control traffic only costs bandwidth.
#[test]
fn a_babbling_node_of_low_priority_is_harmless() {
    let mut toy = Toy::new(8, 60);
    let (report, seen) = simulate(&mut toy, &unguarded(BusKind::Fd, "babble:#5/0x7FF", 8));
    assert!(report.bus_load > 0.95);
    assert!(seen[1..].iter().all(|s| s.heard.iter().all(|h| *h == 0xff)));
}

#[test]
fn malformed_and_foreign_frames_are_survived_and_counted() {
    let mut config = SilConfig::new(BusKind::Fd);
    let mut random = 1u64;
    for k in 0..2000u64 {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(k | 1);
        let bytes: Vec<u8> = (0..64).map(|i| (random >> (i % 56)) as u8 ^ i as u8).collect();
        let len = [0, 3, 8, 8, 16, 64][(random >> 40) as usize % 6];
        let fd = (random >> 33) & 3 != 0 || len > 8;
        // Any identifier but a stop, and SYNC of a module nearer the head than all.
        let id = 0x100 + (random >> 20) as u16 % 0x700;
        let id = if id >> 7 < 8 { id | 0x40 } else { id };
        config.injected.push(Injected { at_ns: k * MS + k * 37, frame: Frame::new(id, fd, &bytes[..len]).unwrap() });
    }
    let mut toy = Toy::new(8, 60);
    let (report, seen) = simulate(&mut toy, &config);
    assert!(report.modules.iter().all(|m| m.stats.malformed > 300), "{:?}", report.modules[0].stats);
    assert!(report.modules.iter().all(|m| m.stats.acted == 60 && m.longest_gap_ms < 55.0), "{report:?}");
    let last = seen.last().unwrap();
    assert!(last.heard.iter().all(|h| *h == 0xff) && last.faults.iter().all(Vec::is_empty), "{last:?}");
}

/// They collide until one gets through; the other hears its own number, relaxes and falls silent.
#[test]
fn of_two_modules_with_one_number_one_falls_silent_and_all_others_go_on() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut config = SilConfig::new(bus);
        config.numbers = vec![0, 1, 2, 3, 4, 4, 6, 7];
        let mut toy = Toy::new(8, 80);
        let (report, seen) = simulate(&mut toy, &config);
        let last = seen.last().unwrap();
        let silent = |module: &usize| last.faults[*module] == [Trouble::DuplicateNode];
        let twins: Vec<usize> = [4, 5].into_iter().filter(silent).collect();
        assert!(!twins.is_empty(), "{:?}", last.faults);
        for twin in twins {
            assert_eq!(toy.history.last().unwrap()[twin], [0.0; 2]);
        }
        for module in [0, 1, 2, 3, 6, 7] {
            assert_eq!(last.heard[module] & !(1 << 4), 0b1100_1111, "{:x?}", last.heard);
            assert!(last.faults[module].is_empty(), "{:?}", last.faults);
            assert!(report.modules[module].longest_gap_ms < 150.0);
        }
        assert!(report.error_frames > 0);
    }
}

#[test]
fn sensors_and_actuators_fail_as_told() {
    let mut toy = Toy::new(8, 60);
    let (_, seen) = simulate(&mut toy, &with_faults(BusKind::Fd, "action:#2,observation:#4,stuck:#6@500ms", 8));
    assert!(toy.history.iter().all(|t| t[2] == [0.0; 2]));
    let last = seen.last().unwrap();
    assert_eq!(last.faults[4], [Trouble::Sensors]);
    // Its neighbours mask its latent.
    assert!((0..8).all(|m| m == 4 || last.heard[m] == 0xff & !(1 << 4)), "{:x?}", last.heard);
    assert!(toy.history[250..].iter().any(|t| t[6] != [0.0; 2]));
}

#[test]
fn the_station_stops_and_releases_the_robot() {
    let mut config = SilConfig::new(BusKind::Classic);
    config.commands = vec![(1000 * MS, StopCommand::Stop), (2000 * MS, StopCommand::Release)];
    let mut toy = Toy::new(8, 60);
    simulate(&mut toy, &config);
    assert!(toy.history[102..200].iter().all(|t| t.iter().all(|t| *t == [0.0; 2])));
    assert!(toy.history[210].iter().all(|t| *t != [0.0; 2]));
}

#[test]
fn clocks_that_differ_and_drift_do_not_matter() {
    let mut config = SilConfig::new(BusKind::Fd);
    config.clocks =
        (0..8).map(|m| Clock { offset_us: 1_000_000_007 * m, drift_ppb: 100_000 * (m as i32 % 3 - 1) }).collect();
    let mut toy = Toy::new(8, 125);
    let (report, seen) = simulate(&mut toy, &config);
    assert!(seen.iter().all(|s| s.heard.iter().all(|h| *h == 0xff) && s.keepers.iter().all(|k| *k == Some(0))));
    assert!(report.modules.iter().all(|m| m.longest_gap_ms < 55.0 && m.stats.takeovers <= 1), "{report:?}");
}

#[test]
fn a_clock_reaches_what_it_shows() {
    for drift_ppb in [0, 100_000, -100_000, 33_333, -99_999_999] {
        let clock = Clock { offset_us: 5_000, drift_ppb };
        for us in [5_000, 5_001, 105_000, 12_345_678] {
            let ns = clock.reaches(us);
            assert!(clock.show(ns) >= us && (ns == 0 || clock.show(ns - 1) < us), "{drift_ppb} {us}");
        }
    }
}

#[test]
fn one_module_and_sixty_four() {
    for (modules, bus) in [(1, BusKind::Fd), (2, BusKind::Classic), (64, BusKind::Fd)] {
        let mut toy = Toy::new(modules, 30);
        let (report, seen) = simulate(&mut toy, &SilConfig::new(bus));
        assert_eq!(report.deadline_misses, 0);
        let all = u64::MAX >> (64 - modules);
        assert!(seen.last().unwrap().heard.iter().all(|h| *h == all));
        assert!(report.modules.iter().all(|m| m.stats.acted == 30), "{report:?}");
    }
}

#[test]
fn the_capture_is_a_candump_log_of_everything() {
    let mut log = Vec::new();
    let config = with_faults(BusKind::Classic, "cut:3@500ms", 8);
    let report = run(&mut Toy::new(8, 20), &image(), &config, Some(&mut log), &mut |_, _| {}).unwrap();
    let entries = candump::parse(std::str::from_utf8(&log).unwrap()).unwrap();
    assert_eq!(entries.len() as u64, report.frames);
    assert!(entries.windows(2).all(|pair| pair[0].at_us <= pair[1].at_us));
    let first = Message::parse(&entries[0].frame).unwrap();
    assert!(matches!(first, Message::Sync(_)) && entries[0].at_us < 200, "{:?}", entries[0]);
    assert!(entries.iter().any(|e| e.interface == "can1" && e.frame.module() == 4));
    assert!(!entries.iter().any(|e| e.interface == "can1" && e.at_us < 500_000));
}

#[test]
fn a_stop_from_anybody_counts() {
    let stop = Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::UNKNOWN)).emit(5, true);
    let config = SilConfig { injected: vec![Injected { at_ns: 500 * MS, frame: stop }], ..SilConfig::new(BusKind::Fd) };
    let mut toy = Toy::new(4, 20);
    simulate(&mut toy, &config);
    assert!(toy.history[52..].iter().all(|t| t.iter().all(|t| *t == [0.0; 2])));
}

#[test]
fn what_cannot_be_run_is_refused_with_a_sentence() {
    let sentence = |modules, image: &[u8], config: &SilConfig| {
        run(&mut Toy::new(modules, 1), image, config, None, &mut |_, _| {}).unwrap_err().to_string()
    };
    let good = SilConfig::new(BusKind::Fd);
    assert_eq!(sentence(65, &image(), &good), "65 modules cannot be simulated: a robot has 1 to 64");
    assert!(sentence(0, &image(), &good).starts_with("0 modules"));
    assert!(!sentence(8, &image()[..100], &good).is_empty());
    let slow = SilConfig { rates: BitRates { nominal: 1_000_000, data: 500_000 }, ..good.clone() };
    assert!(sentence(8, &image(), &slow).starts_with("bit rates of 1000000 and 500000 bit/s cannot be"));
    let number = SilConfig { numbers: vec![9], ..good };
    assert!(sentence(8, &image(), &number).starts_with("module 9 cannot be one of 8"));
}

#[test]
fn a_plant_that_never_ends_is_cut_short() {
    let config = SilConfig { limit_ns: 1000 * MS, ..SilConfig::new(BusKind::Fd) };
    let (report, _) = simulate(&mut Toy::new(2, 100_000), &config);
    assert!(report.cut_short && report.duration_ns == 1000 * MS);
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(24))]

    /// Whatever goes wrong together: the run ends, with nothing but numbers for torques within the limit, and can be repeated.
    #[test]
    fn any_mixture_of_faults_is_survived(
        kinds in proptest::collection::vec((0usize..11, 0usize..6, 1u32..1500, 1u32..1500), 0..6), classic: bool, seed: u64,
    ) {
        let texts: Vec<String> = kinds.iter().map(|&(kind, module, from, length)| {
            let p = f64::from(from % 100) / 100.0;
            let what = match kind {
                0 => format!("unplug:#{module}"),
                1 => format!("action:#{module}"),
                2 => format!("observation:#{module}"),
                3 => format!("stuck:#{module}"),
                4 => format!("babble:#{module}/{}", from % 0x800),
                5 => format!("cut:{module}"),
                6 => format!("drop:{p}"),
                7 => format!("delay:{}us", from * 10),
                8 => format!("corrupt:{p}"),
                9 => format!("corrupt:{p}#{module}"),
                _ => format!("duplicate:{p}"),
            };
            format!("{what}@{from}ms..{}ms", from + length)
        }).collect();
        let plan: FaultPlan = texts.join(",").parse().unwrap();
        let bus = if classic { BusKind::Classic } else { BusKind::Fd };
        let config = SilConfig { faults: plan.draw(seed, 6), seed, station_behind: (seed % 8) as usize, ..SilConfig::new(bus) };
        let go = || {
            let mut toy = Toy::new(6, 80);
            let report = run(&mut toy, &image(), &config, None, &mut |_, _| {}).unwrap();
            (report, toy.history)
        };
        let (report, history) = go();
        proptest::prop_assert!(!report.cut_short && report.duration_ns == 4_000 * MS);
        proptest::prop_assert!(history.iter().flatten().flatten().all(|t| t.abs() <= 80.0));
        proptest::prop_assert!((report, history) == go());
    }
}

/// How long the frames of a control cycle take from the first bit of SYNC to the last LATENT, ms, and how much of that the bus is busy: the worst
/// cycle of a robot that has come to rest.
fn cycle_on_the_wire(bus: BusKind, modules: usize) -> (f64, f64) {
    let config = SilConfig::new(bus);
    let mut log = Vec::new();
    run(&mut Toy::new(modules, 20), &image(), &config, Some(&mut log), &mut |_, _| {}).unwrap();
    let (mut begins, mut busy, mut worst) = (0, 0, (0.0, 0.0));
    for entry in candump::parse(&String::from_utf8(log).unwrap()).unwrap() {
        let at_ns = entry.at_us * 1000;
        let took = config.rates.ns(crate::frame_bits::length(&entry.frame));
        let full = config.rates.with_interframe_ns(crate::frame_bits::length(&entry.frame));
        match entry.frame.function() {
            Some(Function::Sync) => (begins, busy) = (at_ns.saturating_sub(took), full),
            Some(Function::Latent | Function::LatentFragment) => {
                busy += full;
                let span = (at_ns - begins) as f64 * 1e-6;
                if begins > 500 * MS && span > worst.0 {
                    worst = (span, busy as f64 * 1e-6);
                }
            }
            _ => busy += full,
        }
    }
    worst
}

/// The modules keep the wire busy: with 64 of them a cycle takes what its frames take, and hardly more.
#[test]
fn sixty_four_modules_on_can_fd_are_within_5_per_cent_of_the_wire() {
    let (span, busy) = cycle_on_the_wire(BusKind::Fd, 64);
    println!("{span:.2} ms, of which the bus is busy {busy:.2} ms");
    assert!(span < 1.05 * busy && span < 15.4, "{span} ms, of which the bus is busy {busy} ms");
    let mut toy = Toy::new(64, 40);
    let (report, seen) = simulate(&mut toy, &SilConfig::new(BusKind::Fd));
    assert!(seen[4..].iter().all(|seen| seen.heard.iter().all(|heard| *heard == u64::MAX)));
    assert!(report.modules.iter().all(|module| module.stats.acted == 40 && module.longest_gap_ms < 55.0));
}

/// On a classic bus the latents of 32 modules come in time; those of more would not, so they are refused.
#[test]
fn classic_can_has_room_for_32_modules_and_refuses_more() {
    let mut toy = Toy::new(32, 40);
    let (report, seen) = simulate(&mut toy, &SilConfig::new(BusKind::Classic));
    assert!(seen[4..].iter().all(|seen| seen.heard.iter().all(|heard| *heard == 0xffff_ffff)));
    assert!(report.modules.iter().all(|module| module.stats.acted == 40 && module.longest_gap_ms < 55.0));
    let refused = |modules, config: &SilConfig| {
        run(&mut Toy::new(modules, 5), &image(), config, None, &mut |_, _| {}).unwrap_err().to_string()
    };
    let classic = refused(33, &SilConfig::new(BusKind::Classic));
    assert!(
        classic.contains("33 modules do not fit") && classic.contains("32 modules fit, or more on CAN-FD"),
        "{classic}"
    );
    let slow = SilConfig { rates: BitRates { nominal: 125_000, data: 250_000 }, ..SilConfig::new(BusKind::Fd) };
    assert!(refused(64, &slow).contains("64 modules do not fit on this bus"), "{}", refused(64, &slow));
}
