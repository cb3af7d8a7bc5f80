//! New policies over the bus, from the key to the table at the end: on emulated microcontrollers, on modules in this process, and by the command line.
#![cfg(target_os = "linux")]

mod common;

use std::cell::{Cell, RefCell};
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use common::{Live, json, refuse, succeed};
use composer_firmware::controller::{Boot, BusKind, Config, FaultSet, Micros, Retained, Stats};
use composer_firmware::torque_off::Interrupt;
use composer_host::bus::simulated::{Still, with_station};
use composer_host::bus::update::{self, Policies, Progress, policies, text};
use composer_host::bus::{BusError, Station};
use composer_host::env::EnvConfig;
use composer_host::signing::{Package, make_key, public_key, public_path};
use composer_host::sil::SnakePlant;
use composer_shared::policies;
use composer_shared::policy::{IMAGE_SIZE, Policy, Task, random_image};
use composer_shared::robot::MAX_MODULES;
use composer_shared::update::chunks;
use composer_shared::wire::{Frame, Function, Mode, Operation};
use composer_sim_bridge::candump;
use composer_sim_bridge::computer::{Answer, Computer, InProcess, Launcher, Poll, Status, Trouble};
use composer_sim_bridge::faults::{Fault, ScheduledFault};
use composer_sim_bridge::frame_bits::{BitRates, length};
use composer_sim_bridge::qemu::{Emulated, PATIENCE, Qemu};
use composer_sim_bridge::sil::{self, SilConfig, SilReport};

const SECOND: u64 = 1_000_000_000;

fn qemu_image() -> PathBuf {
    // The test lies in target/release/deps.
    let program = std::env::current_exe().unwrap();
    program.ancestors().nth(3).unwrap().join("thumbv7em-none-eabihf/firmware/composer-qemu")
}

fn shipped(name: &str) -> &'static [u8] {
    policies::shipped(name).unwrap()
}

fn random(seed: u32) -> Vec<u8> {
    let mut image = [0; IMAGE_SIZE];
    random_image(seed, &mut image);
    image.to_vec()
}

/// What a module was at, kept apart from it.
struct Seen {
    mode: Mode,
    cycle: u16,
    time_keeper: Option<u8>,
    alive: u64,
    heard: u64,
    attention: [u16; MAX_MODULES],
    faults: FaultSet,
    stats: Stats,
    retained: Retained,
}

impl Seen {
    fn of(status: Status<'_>) -> Self {
        let Status { mode, cycle, time_keeper, alive, heard, attention, faults, stats, retained } = status;
        Seen { mode, cycle, time_keeper, alive, heard, attention: *attention, faults, stats, retained }
    }
}

/// An emulated module that outlives the run in which it was updated.
struct Lasting {
    module: Rc<RefCell<Emulated>>,
    seen: Seen,
}

impl Computer for Lasting {
    fn ask_poll(&mut self, poll: &Poll<'_>) -> Result<(), Trouble> {
        self.module.borrow_mut().ask_poll(poll)
    }

    fn answer(&mut self) -> Result<Answer, Trouble> {
        self.module.borrow_mut().answer()
    }

    fn next_frame(&mut self, room: usize) -> Result<Option<Frame>, Trouble> {
        self.module.borrow_mut().next_frame(room)
    }

    fn interrupt(&mut self, interrupt: Interrupt<'_>) -> Result<(bool, Option<Frame>), Trouble> {
        self.module.borrow_mut().interrupt(interrupt)
    }

    fn ask_status(&mut self) -> Result<(), Trouble> {
        self.module.borrow_mut().ask_status()
    }

    fn await_status(&mut self) -> Result<(), Trouble> {
        let mut module = self.module.borrow_mut();
        module.await_status()?;
        self.seen = Seen::of(module.status());
        Ok(())
    }

    fn status(&self) -> Status<'_> {
        let Seen { mode, cycle, time_keeper, alive, heard, attention, faults, stats, retained } = &self.seen;
        Status {
            mode: *mode,
            cycle: *cycle,
            time_keeper: *time_keeper,
            alive: *alive,
            heard: *heard,
            attention,
            faults: *faults,
            stats: *stats,
            retained: *retained,
        }
    }
}

/// Emulated modules: new ones, made with a policy, and later the same again, with what their flash has by then.
struct Robot {
    qemu: Qemu,
    modules: RefCell<Vec<Option<Rc<RefCell<Emulated>>>>>,
    again: Cell<bool>,
}

impl Launcher for &Robot {
    type Computer = Lasting;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Lasting, Trouble> {
        let mut modules = self.modules.borrow_mut();
        let place = &mut modules[usize::from(config.node)];
        let module = match place.clone().filter(|_| self.again.get()) {
            Some(module) => {
                module.borrow_mut().start_again(config, boot, now)?;
                module
            }
            None => Rc::new(RefCell::new(self.qemu.start(config, boot, now)?)),
        };
        *place = Some(module.clone());
        let seen = Seen::of(module.borrow().status());
        Ok(Lasting { module, seen })
    }
}

fn settings(bus: BusKind) -> SilConfig {
    SilConfig { station: false, limit_ns: u64::MAX, ..SilConfig::new(bus) }
}

/// An episode of the snake with these modules, and the bits of all torques.
fn episode<L: Launcher>(launcher: &L, image: &[u8]) -> (SilReport, Vec<[u32; 2]>) {
    let config = Arc::new(EnvConfig::new(Task::GoalReaching, composer_host::robot::Robot::default()));
    let mut plant = SnakePlant::new(config, 5);
    plant.keep_trace();
    let policy = Policy::parse(image).unwrap();
    let sil = SilConfig { limit_ns: 3 * SECOND, ..SilConfig::new(BusKind::Fd) };
    let report = sil::run_on(launcher, &mut plant, policy, &sil, None, &mut |_, _| {}).unwrap();
    (report, plant.trace().to_vec())
}

/// Eight emulated microcontrollers on a bus that loses 5 % of all frames at their receivers. One loses its power on the way and is plugged in again, as new.
#[test]
fn eight_emulated_modules_are_updated_over_a_bad_bus_and_are_then_as_if_born_with_it() {
    let (old, new) = (random(1), shipped("goal-reaching"));
    let package = Package::unsigned(new).unwrap();
    let robot = Robot {
        qemu: Qemu::new(&qemu_image(), &old, PATIENCE).unwrap(),
        modules: RefCell::new(vec![None; 8]),
        again: Cell::new(false),
    };
    let mut config = settings(BusKind::Fd);
    config.seed = 3;
    let whole = |fault| ScheduledFault { at_ns: 0, until_ns: None, fault };
    config.faults = vec![
        whole(Fault::Drop(0.05)),
        ScheduledFault { at_ns: 5 * SECOND / 4, until_ns: Some(12 * SECOND), fault: Fault::Unplug(3) },
    ];
    let mut still = Still { modules: 8 };
    let policy = Policy::parse(&old).unwrap();
    let mut told = Vec::new();
    let (rows, report) = with_station(&&robot, &mut still, policy, &config, None, |station| {
        let mut watch = |progress: &Progress| {
            told.push(progress.clone());
            true
        };
        let first = update::update(station, &package, &mut watch).unwrap();
        // Module 3 was away: it is not on the bus, or back with its old policy.
        assert!(
            first.iter().all(|(node, p)| *node == 3 || p.is_some_and(|p| p.policy == package.header().crc)),
            "{first:?}"
        );
        while station.now() < Duration::from_secs(13) {
            station.listen(Duration::from_millis(20)).unwrap();
        }
        assert_ne!(policies(station, 3).unwrap().policy, package.header().crc);
        assert!(station.robot().warnings().iter().any(|warning| warning.contains("different policies")));
        update::update(station, &package, &mut watch).unwrap()
    })
    .unwrap();
    assert!(told.contains(&Progress::LeftOut(3)), "{told:?}");
    assert!(told.iter().any(|p| matches!(p, Progress::Sent(lacks) if lacks.iter().any(|(_, n)| *n > 0))), "{told:?}");
    assert!(report.dropped > 500, "{}", report.dropped);
    assert_eq!(rows.len(), 8);
    for (node, policies) in &rows {
        let Policies { policy, trial, .. } = policies.unwrap();
        assert_eq!((policy, trial), (package.header().crc, false), "module {node}");
    }
    println!("updated in {:.2} s on the bus\n{}", report.duration_ns as f64 * 1e-9, text(&rows));
    // An episode with them, and one with modules that were born with the policy.
    robot.again.set(true);
    let updated = episode(&&robot, new);
    let born = episode(&Qemu::new(&qemu_image(), new, PATIENCE).unwrap(), new);
    assert!(updated.1.len() > 1000 && updated.1.iter().any(|torque| *torque != [0; 2]));
    assert_eq!(updated.1, born.1, "torques differ");
    assert_eq!(updated.0, born.0);
}

/// What an update costs on the bus: all frames of it against the image once over the wire.
#[test]
fn an_update_takes_little_more_of_the_bus_than_the_image_once() {
    let (old, new) = (random(1), random(2));
    let package = Package::unsigned(&new).unwrap();
    let policy = Policy::parse(&old).unwrap();
    println!(
        "| bus | modules | chunks, ms on the bus | all frames of the update, ms | bound: bytes / data rate, ms | takes, s |"
    );
    // Classic CAN has room for 32 modules.
    for (bus, most) in [(BusKind::Fd, 64), (BusKind::Classic, 32)] {
        for modules in [8, most] {
            let config = settings(bus);
            let mut log = Vec::new();
            let (rows, report) = with_station(
                &InProcess::new(policy),
                &mut Still { modules },
                policy,
                &config,
                Some(&mut log),
                |station| update::update(station, &package, &mut |_| true).unwrap(),
            )
            .unwrap();
            assert_eq!(rows.len(), modules);
            assert!(rows.iter().all(|(_, p)| p.is_some_and(|p| p.policy == package.header().crc && !p.trial)));
            let rates = if bus == BusKind::Fd { BitRates::FD_1M_5M } else { BitRates::CLASSIC_1M };
            let log = candump::parse(std::str::from_utf8(&log).unwrap()).unwrap();
            let ms = |functions: &[Function]| {
                let frames = log.iter().filter(|entry| entry.frame.function().is_some_and(|f| functions.contains(&f)));
                let time: u64 = frames.clone().map(|entry| rates.with_interframe_ns(length(&entry.frame))).sum();
                (frames.count(), time as f64 * 1e-6)
            };
            let (frames, carried) = ms(&[Function::UpdateChunk, Function::UpdatePiece]);
            let (_, all) = ms(&[
                Function::UpdateChunk,
                Function::UpdatePiece,
                Function::ServiceRequest,
                Function::ServiceResponse,
            ]);
            // Every chunk goes over the wire once, whatever the number of modules; now and then one is sent again.
            let once = chunks(package.bytes().len()) * if bus == BusKind::Fd { 1 } else { 9 };
            assert!(
                (once..=once + once / 50).contains(&frames),
                "{bus:?}, {modules} modules: {frames} frames, {once} once"
            );
            let bound = 8.0 * package.bytes().len() as f64 / f64::from(rates.data.max(rates.nominal)) * 1e3;
            let takes = report.duration_ns as f64 * 1e-9;
            println!("| {bus:?} | {modules} | {carried:.1} | {all:.1} | {bound:.1} | {takes:.2} |");
            assert!(carried < 4.0 * bound, "{carried} ms against {bound} ms");
            assert!(takes < 12.0, "{takes} s");
        }
    }
}

fn in_process<T: Send>(image: &[u8], modules: usize, client: impl FnOnce(&mut Station) -> T + Send) -> T {
    let policy = Policy::parse(image).unwrap();
    let launcher = InProcess::new(policy);
    with_station(&launcher, &mut Still { modules }, policy, &settings(BusKind::Fd), None, client).unwrap().0
}

/// One update that must fail with words, and changes nothing.
fn refused(station: &mut Station, package: &Package, words: &[&str]) {
    let before = update::table(station).unwrap();
    let error = update::update(station, package, &mut |_| true).unwrap_err().to_string();
    assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{error}");
    assert_eq!(update::table(station).unwrap(), before, "{error}");
}

#[test]
fn a_robot_with_a_key_takes_what_its_holder_signed_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let (own, foreign) = (folder.path().join("own"), folder.path().join("foreign"));
    make_key(&own).unwrap();
    make_key(&foreign).unwrap();
    let sign = |image: &[u8], key: &PathBuf, counter| Package::sign(image, key, counter, 0).unwrap();
    let (a, b, c) = (random(2), random(3), random(4));
    in_process(&random(1), 3, |station| {
        // In the lab anything goes, signed or not.
        update::update(station, &Package::unsigned(&a).unwrap(), &mut |_| true).unwrap();
        let key = public_key(&public_path(&own)).unwrap();
        assert_eq!(update::give_key(station, &key, false).unwrap(), [0, 1, 2]);
        for node in 0..3 {
            station.request(node, Operation::Restart, 0, 0).unwrap();
        }
        station.pause(Duration::from_secs(1)).unwrap();
        refused(station, &Package::unsigned(&b).unwrap(), &["module 0 has a key", "snakectl sign"]);
        refused(
            station,
            &sign(&b, &foreign, 0),
            &["modules 0, 1, 2 refuse to verify", "none of the module's keys signed"],
        );
        let rows = update::update(station, &sign(&b, &own, 5), &mut |_| true).unwrap();
        assert!(rows.iter().all(|(_, p)| p.is_some_and(|p| (p.counter, p.keys) == (5, [true, false]))), "{rows:?}");
        refused(station, &sign(&c, &own, 4), &["security counter 4", "has 5 already"]);
        // Its limits and keys are the holder's, too.
        let error = station.request(1, Operation::Write, 172, 1e5f32.to_bits()).unwrap_err().to_string();
        assert!(error.contains("debug probe"), "{error}");
        let error = update::give_key(station, &[1; 32], true).unwrap_err().to_string();
        assert!(error.contains("debug probe"), "{error}");
        // What an update was interrupted in goes on.
        let third = sign(&c, &own, 6);
        for stop in [Progress::Verified, Progress::Committed, Progress::Tried] {
            let mut seen = 0;
            let result = update::update(station, &third, &mut |progress| {
                seen += usize::from(*progress == stop);
                *progress != stop
            });
            assert!(matches!(result, Err(BusError::Interrupted)) && seen == 1, "{stop:?}: {result:?}");
        }
        let rows = update::update(station, &third, &mut |_| true).unwrap();
        assert!(rows.iter().all(|(_, p)| p.is_some_and(|p| p.policy == third.header().crc && p.counter == 6)));
        // Why is it on that policy?
        let records = update::records(station, 1).unwrap();
        let texts: Vec<String> = records.iter().flatten().map(ToString::to_string).collect();
        assert!(texts[0].contains("confirmed, security counter 6"), "{texts:#?}");
        let log = update::export_log(station).unwrap();
        assert_eq!(log["modules"][1]["policy"]["security_counter"], 6);
        assert!(log["modules"][1]["policy_records"].as_array().unwrap().len() >= 8, "{log}");
        assert!(
            log["modules"][2]["fault_log"]
                .as_array()
                .unwrap()
                .iter()
                .any(|e| e["text"].as_str().unwrap().contains("started"))
        );
    });
}

#[test]
fn a_policy_for_another_task_is_refused_while_the_modules_disagree() {
    let image = shipped("goal-reaching");
    let policy = Policy::parse(image).unwrap();
    let mut config = settings(BusKind::Fd);
    // One is away while the others are updated.
    config.faults = vec![ScheduledFault { at_ns: SECOND / 10, until_ns: Some(8 * SECOND), fault: Fault::Unplug(2) }];
    let launcher = InProcess::new(policy);
    let tube = Package::unsigned(shipped("tube-crossing")).unwrap();
    let wall = Package::unsigned(shipped("wall-climbing")).unwrap();
    with_station(&launcher, &mut Still { modules: 3 }, policy, &config, None, |station| {
        station.pause(Duration::from_secs(1)).unwrap();
        let rows = update::update(station, &tube, &mut |_| true).unwrap();
        assert!(text(&rows).contains("     2  not on the bus"), "{}", text(&rows));
        station.pause(Duration::from_secs(9).saturating_sub(station.now())).unwrap();
        refused(station, &wall, &["the modules disagree", "for wall-climbing", "module 2", "for goal-reaching"]);
        // Either of theirs is taken; then all agree, and any other is.
        update::update(station, &tube, &mut |_| true).unwrap();
        let rows = update::update(station, &wall, &mut |_| true).unwrap();
        assert!(rows.iter().all(|(_, p)| p.is_some_and(|p| p.policy == wall.header().crc)));
        // While armed nothing is begun.
        station.arm(false).unwrap();
        refused(station, &tube, &["refuse to begin", "disarm first"]);
    })
    .unwrap();
}

#[test]
fn without_any_module_nothing_is_changed() {
    let image = random(1);
    let policy = Policy::parse(&image).unwrap();
    let mut config = settings(BusKind::Fd);
    config.faults = vec![ScheduledFault { at_ns: 0, until_ns: None, fault: Fault::Unplug(0) }];
    let package = Package::unsigned(&random(2)).unwrap();
    with_station(&InProcess::new(policy), &mut Still { modules: 1 }, policy, &config, None, |station| {
        station.pause(Duration::from_millis(500)).unwrap();
        let error = update::update(station, &package, &mut |_| true).unwrap_err();
        assert!(matches!(error, BusError::Nobody), "{error}");
    })
    .unwrap();
}

#[test]
fn the_command_line_makes_keys_signs_updates_and_exports() {
    let live = Live::start(&["--no-station"]);
    let run = |arguments: &[&str]| succeed(live.path(), arguments);
    assert!(run(&["key", "new", "lab"]).contains("public key lab.pub"));
    assert!(run(&["key", "show", "lab.pub"]).contains("a public key"));
    refuse(live.path(), &["key", "new", "lab"], &["lab.pub exists already"]);
    refuse(live.path(), &["sign", "tube-crossing", "--key", "lab.pub"], &["is a public key", "the secret one"]);
    refuse(live.path(), &["sign", "nothing", "--key", "lab"], &["nothing"]);
    let said = run(&["sign", "tube-crossing", "--key", "lab", "--counter", "3"]);
    assert!(said.contains("tube-crossing.signed") && said.contains("security counter 3"), "{said}");
    refuse(live.path(), &["sign", "tube-crossing.signed", "--key", "lab"], &["is signed already"]);
    refuse(live.path(), &["bus", "slcan:bus", "key", "lab"], &["lab is a secret key"]);
    assert!(run(&["bus", "slcan:bus", "key", "lab.pub"]).contains("modules 0 to 7"));
    let said = run(&["update", "slcan:bus", "tube-crossing.signed"]);
    assert!(said.contains("verified by all") && said.contains("confirmed"), "{said}");
    assert_eq!(said.matches(" tube-crossing ").count(), 8, "{said}");
    assert!(
        run(&["update", "slcan:bus", "tube-crossing.signed"]).contains("up to date already: 0, 1, 2, 3, 4, 5, 6, 7")
    );
    // The keys count since the restart that was part of the update.
    refuse_update(&live, "wall-climbing", &["module 0 has a key", "not signed"]);
    std::fs::write(
        live.path().join("short.signed"),
        &std::fs::read(live.path().join("tube-crossing.signed")).unwrap()[..9000],
    )
    .unwrap();
    refuse(
        live.path(),
        &["update", "slcan:bus", "short.signed"],
        &["short.signed is not a usable policy", "cut short"],
    );
    refuse(live.path(), &["update", "slcan:nothing", "tube-crossing"], &["slcan:nothing cannot be opened"]);
    let log = json(live.path(), &["bus", "slcan:bus", "export-log"]);
    assert_eq!(log["modules"][7]["policy"]["task"], "tube-crossing");
    assert_eq!(log["modules"][7]["policy_records"][0]["text"], "slot B is confirmed, security counter 3");
}

/// It prints what it brings before it meets the robot.
fn refuse_update(live: &Live, policy: &str, words: &[&str]) {
    let output = common::snakectl(live.path(), &["update", "slcan:bus", policy]);
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && words.iter().all(|word| complaint.contains(word)), "{complaint}");
    assert_eq!(complaint.trim().lines().count(), 1, "{complaint}");
}
