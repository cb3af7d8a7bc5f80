//! What a robot's bus comes to over losses, lengths and cuts, as tables that are kept beside this file. A change that moves a number shows in them and is looked
//! at; `UPDATE_SWEEPS=1 cargo test --release -p composer-sim-bridge --test sweeps` writes them anew.

use std::fmt::Write;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use composer_firmware::controller::BusKind;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_sim_bridge::computer::InProcess;
use composer_sim_bridge::faults::Fault;
use composer_sim_bridge::plant::Bench;
use composer_sim_bridge::sil::{Change, CycleView, SilConfig, SilReport, Simulation};

type Run<'a> = Simulation<'a, Bench, InProcess<'a>>;

/// A robot on the bench for some control cycles.
fn robot<'a>(image: &'a [u8], modules: usize, cycles: u32, config: SilConfig) -> Run<'a> {
    let policy = Policy::parse(image).unwrap();
    Simulation::new(InProcess::new(policy), Bench { modules, steps: 10 * cycles }, policy, config).unwrap()
}

fn image() -> [u8; IMAGE_SIZE] {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    image
}

/// The rows of all these cases, in their order, computed on all cores.
fn rows<C: Sync>(cases: &[C], row: impl Fn(&C) -> String + Sync) -> Vec<String> {
    let (next, threads) = (AtomicUsize::new(0), std::thread::available_parallelism().map_or(1, usize::from));
    let work = || {
        let mut done = Vec::new();
        while let Some((index, case)) =
            Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|i| Some((i, cases.get(i)?)))
        {
            done.push((index, row(case)));
        }
        done
    };
    let mut rows: Vec<(usize, String)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
    });
    rows.sort_unstable();
    rows.into_iter().map(|(_, row)| row).collect()
}

/// Compares a table with the one that is kept, or keeps it.
fn compare(name: &str, table: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/sweeps").join(name);
    if std::env::var_os("UPDATE_SWEEPS").is_some() {
        std::fs::write(&path, table).unwrap();
        return;
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    let mut differences = String::new();
    for (number, (kept, now)) in kept.lines().zip(table.lines()).enumerate().filter(|(_, (a, b))| a != b) {
        let _ = write!(differences, "line {}:\n  was {kept}\n  is  {now}\n", number + 1);
    }
    assert!(
        kept == table,
        "{} is not what comes out now; if it is meant to change, UPDATE_SWEEPS=1 writes it anew\n{differences}",
        path.display()
    );
}

/// Of a hundred control cycles, how often the module acted that acted least.
fn acted(report: &SilReport, cycles: u32) -> f64 {
    let least = report.modules.iter().map(|module| module.stats.acted).min().unwrap_or(0);
    100.0 * f64::from(least) / f64::from(cycles)
}

fn longest_gap(report: &SilReport) -> f64 {
    report.modules.iter().map(|module| module.longest_gap_ms).fold(0.0, f64::max)
}

#[test]
fn loss_by_length_and_kind_of_bus() {
    const CYCLES: u32 = 200;
    let mut cases = Vec::new();
    for bus in [BusKind::Fd, BusKind::Classic] {
        // Classic CAN has no room for more.
        for modules in if bus == BusKind::Fd { vec![4, 8, 16, 32, 64] } else { vec![4, 8, 16] } {
            cases.extend([0.0, 0.01, 0.05, 0.1, 0.2, 0.4].map(|loss| (bus, modules, loss)));
        }
    }
    let image = image();
    let table = rows(&cases, |&(bus, modules, loss)| {
        let mut robot = robot(&image, modules, CYCLES, SilConfig { seed: 1, ..SilConfig::new(bus) });
        if loss > 0.0 {
            robot.change(Change::Begin(Fault::Drop(loss), None)).unwrap().unwrap();
        }
        robot.advance(u64::MAX).unwrap();
        let report = robot.report().unwrap();
        let all: u32 = report.modules.iter().map(|module| module.stats.acted).sum();
        let misses = 100.0 * report.deadline_misses as f64 / f64::from(all.max(1));
        let takeovers: u32 = report.modules.iter().map(|module| module.stats.takeovers).sum();
        format!(
            "{:>8} {modules:>8} {loss:>6} {:>9.1} {:>15.1} {misses:>21.1} {:>18.2} {takeovers:>10} {:>7.2}\n",
            if bus == BusKind::Fd { "fd" } else { "classic" },
            acted(&report, CYCLES),
            longest_gap(&report),
            report.latent_age_max_ms,
            100.0 * report.bus_load,
        )
    });
    let heading = format!(
        "{:>8} {:>8} {:>6} {:>9} {:>15} {:>21} {:>18} {:>10} {:>7}\n",
        "bus",
        "modules",
        "loss",
        "acted, %",
        "longest gap, ms",
        "misses of 100 actions",
        "oldest latent, ms",
        "takeovers",
        "load, %"
    );
    compare("loss.txt", &format!("{heading}{}", table.concat()));
}

/// Whether the modules of every piece of cable follow one time-keeper and believe each other alive, and nobody else.
fn settled(view: &CycleView<'_>) -> bool {
    view.pieces().iter().all(|piece| {
        let all = piece.iter().fold(0u64, |set, module| set | 1 << module);
        piece.iter().all(|module| view.modules[*module].alive == all)
            && piece.windows(2).all(|two| view.modules[two[0]].time_keeper == view.modules[two[1]].time_keeper)
    })
}

/// Control cycles until the robot has settled.
fn settles(robot: &mut Run<'_>) -> String {
    for cycles in 0..200 {
        if robot.look(settled).unwrap() {
            return cycles.to_string();
        }
        robot.advance_cycles(1).unwrap();
    }
    "never".into()
}

#[test]
fn cuts_by_place_and_time() {
    const CYCLES: u32 = 200;
    let mut cases = Vec::new();
    for bus in [BusKind::Fd, BusKind::Classic] {
        for behind in [0, 1, 3, 5, 6] {
            cases.extend([20, 100, 200, 1000, 4000].map(|ms| (bus, behind, ms)));
        }
    }
    let image = image();
    let table = rows(&cases, |&(bus, behind, ms)| {
        let mut robot = robot(&image, 8, CYCLES, SilConfig { seed: 1, ..SilConfig::new(bus) });
        robot.advance(1_013_000_000).unwrap();
        robot.change(Change::Begin(Fault::Cut(behind), None)).unwrap().unwrap();
        let start = robot.now_ns();
        let apart = if ms < 1000 { "-".into() } else { settles(&mut robot) };
        robot.advance(ms * 1_000_000 - (robot.now_ns() - start)).unwrap();
        robot.change(Change::End(Fault::Cut(behind))).unwrap().unwrap();
        let together = settles(&mut robot);
        robot.advance(u64::MAX).unwrap();
        let report = robot.report().unwrap();
        let takeovers: u32 = report.modules.iter().map(|module| module.stats.takeovers).sum();
        let least = |modules: &[composer_sim_bridge::sil::ModuleReport]| {
            let least = modules.iter().map(|module| module.stats.acted).min().unwrap_or(0);
            100.0 * f64::from(least) / f64::from(CYCLES)
        };
        let (front, rear) = report.modules.split_at(behind + 1);
        format!(
            "{:>8} {behind:>12} {ms:>8} {:>11.1} {:>10.1} {:>15.1} {apart:>17} {together:>20} {takeovers:>10} {:>12}\n",
            if bus == BusKind::Fd { "fd" } else { "classic" },
            least(front),
            least(rear),
            longest_gap(&report),
            report.error_frames,
        )
    });
    let heading = format!(
        "{:>8} {:>12} {:>8} {:>11} {:>10} {:>15} {:>17} {:>20} {:>10} {:>12}\n",
        "bus",
        "cut behind",
        "for, ms",
        "front acts",
        "rear acts",
        "longest gap, ms",
        "pieces in, cycles",
        "whole again, cycles",
        "takeovers",
        "error frames"
    );
    compare("cut.txt", &format!("{heading}{}", table.concat()));
}
