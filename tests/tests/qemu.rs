//! The modules as emulated microcontrollers: the image that `cargo qemu-image` builds, one QEMU process a module.
//! `tests/run` builds the image and installs QEMU.
#![cfg(target_os = "linux")]

mod common;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{command, json, refuse};

const SIL: [&str; 3] = ["sil", "goal-reaching", "--qemu"];

fn image() -> PathBuf {
    // The test lies in target/release/deps.
    let program = std::env::current_exe().unwrap();
    program.ancestors().nth(3).unwrap().join("thumbv7em-none-eabihf/firmware/composer-qemu")
}

/// Processes whose parent is `parent`, zombies apart.
fn children(parent: u32) -> Vec<u32> {
    let processes =
        std::fs::read_dir("/proc").unwrap().filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    processes
        .filter(|process: &u32| {
            // PID (COMMAND) STATE PARENT ...
            let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
            let mut fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
            fields.next() != Some("Z") && fields.next() == Some(&parent.to_string())
        })
        .collect()
}

fn signal(process: u32, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &process.to_string()]).status().unwrap();
    assert!(status.success());
}

fn wait_until(what: &str, mut is: impl FnMut() -> bool) {
    let start = Instant::now();
    while !is() {
        assert!(start.elapsed() < Duration::from_secs(120), "waited too long until {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A run whose eight modules work.
fn running(folder: &Path, more: &[&str]) -> (Child, Vec<u32>) {
    let mut run = command(folder, &[&SIL[..], &["--episodes", "1", "--json"], more].concat());
    let mut child = run.env("TMPDIR", folder).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let pid = child.id();
    wait_until("eight modules run", || {
        assert!(child.try_wait().unwrap().is_none(), "it ended before: {}", complaint(&mut child));
        // A child that has not yet become an emulator is still the simulator's own copy.
        children(pid).into_iter().filter(|process| alive(*process)).count() == 8
    });
    let modules = children(pid);
    (child, modules)
}

fn complaint(child: &mut Child) -> String {
    let mut text = String::new();
    child.stderr.take().unwrap().read_to_string(&mut text).unwrap();
    text
}

/// A seed whose first episode is long enough to be disturbed in the middle.
fn long_episode(folder: &Path) -> String {
    let seeds = (1..200).map(|seed: u32| seed.to_string());
    let long = seeds.into_iter().find(|seed| {
        let report = json(folder, &["sil", "goal-reaching", "--episodes", "1", "--json", "--seed", seed]);
        report["steps_mean"].as_f64().unwrap() >= 40.0
    });
    long.expect("some goal is far away")
}

#[test]
fn every_torque_is_the_same_as_in_process() {
    let folder = tempfile::tempdir().unwrap();
    for (bus, fault, episodes) in [
        ("fd", "none", 2),
        ("fd", "unplug:1@0.4s..0.9s,action:1", 1),
        ("classic", "unplug:#0@0.5s,observation:1,drop:0.05", 1),
    ] {
        let more = ["--parity", "--json", "--bus", bus, "--fault", fault, "--episodes", &episodes.to_string()];
        let report = json(folder.path(), &[&SIL[..], &more].concat());
        let parity = &report["parity"];
        let number = |key: &str| parity[key].as_u64().unwrap_or_else(|| panic!("{key} is missing in {report}"));
        assert_eq!((number("different"), number("other"), &report["lost"]), (0, 0, &0.into()), "{report}");
        // Two axes of eight modules in ten physics steps a cycle.
        assert_eq!(number("torques"), number("cycles") * 10 * 8 * 2, "{report}");
        assert!(number("cycles") >= 10 * episodes, "{report}");
    }
}

#[test]
fn the_episode_goes_on_when_somebody_kills_a_module() {
    let folder = tempfile::tempdir().unwrap();
    let seed = long_episode(folder.path());
    let (mut run, modules) = running(folder.path(), &["--seed", &seed]);
    // Every byte to a module is two reads of its process, and 800 of them a cycle: the snake is on its way.
    let start = reads(modules[3]);
    wait_until("the snake is on its way", || reads(modules[3]) > start + 20_000);
    signal(modules[3], "KILL");
    let mut said = String::new();
    run.stdout.take().unwrap().read_to_string(&mut said).unwrap();
    let complaint = complaint(&mut run);
    assert!(run.wait().unwrap().success(), "{complaint}");
    let report: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&report["lost"], &report["episodes"]), (&1.into(), &1.into()), "{report}");
    let words = "note: episode 1: module ";
    let rest = complaint.split(words).nth(1).unwrap_or_else(|| panic!("no {words:?} in {complaint:?}"));
    assert!(rest.contains("lost at") && rest.contains("signal 9"), "{complaint}");
    let at: f64 = rest.split("lost at ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    let end = report["steps_mean"].as_f64().unwrap() * 0.05;
    assert!(at > 0.0 && at < end - 0.5, "killed at {at} s of {end} s");
    wait_until("no module is left", || !modules.iter().any(|module| alive(*module)));
}

/// How often a process has read.
fn reads(process: u32) -> u64 {
    let io = std::fs::read_to_string(format!("/proc/{process}/io")).unwrap_or_default();
    io.lines().find_map(|line| line.strip_prefix("syscr: ")?.parse().ok()).expect("the module still runs")
}

/// Whether a process of this number is an emulator.
fn alive(process: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    stat.contains("(qemu-system") && !stat.contains(") Z ")
}

#[test]
fn no_module_outlives_a_simulator_that_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["KILL", "TERM"] {
        let (mut run, modules) = running(folder.path(), &[]);
        signal(run.id(), name);
        assert!(!run.wait().unwrap().success());
        wait_until("no module is left", || !modules.iter().any(|module| alive(*module)));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "no file is left either");
    }
}

#[test]
fn a_module_that_does_not_answer_ends_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let (mut run, modules) = running(folder.path(), &["--qemu-timeout", "3"]);
    signal(modules[5], "STOP");
    let complaint = complaint(&mut run);
    assert!(!run.wait().unwrap().success());
    assert!(complaint.contains("has not answered for 3 s"), "{complaint}");
    wait_until("no module is left", || !modules.iter().any(|module| alive(*module)));
}

#[test]
fn what_is_missing_or_no_image_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let with = |more: &[&'static str]| [&SIL[..], &["--episodes", "1"], more].concat();
    refuse(folder.path(), &with(&["--qemu-image", "nothing"]), &["no image", "nothing", "cargo qemu-image"]);
    std::fs::write(folder.path().join("noise"), [0x5a; 5000]).unwrap();
    // QEMU takes any file as a raw image; this one runs into its own noise.
    refuse(
        folder.path(),
        &with(&["--qemu-image", "noise", "--qemu-timeout", "5"]),
        &["snakectl: ", "image of the module"],
    );
    refuse(folder.path(), &with(&["--qemu-timeout", "0"]), &["--qemu-timeout"]);
    let output = command(folder.path(), &with(&[])).env("PATH", folder.path()).output().unwrap();
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    for word in ["qemu-system-arm is not installed", "apt-get install qemu-system-arm", "brew install qemu"] {
        assert!(complaint.contains(word), "{complaint}");
    }
}

#[test]
fn an_image_that_crashes_says_its_last_words() {
    let folder = tempfile::tempdir().unwrap();
    let mut elf = std::fs::read(image()).unwrap();
    // An undefined instruction where it begins. ELF32: the entry, then the segments with their place in the file and their address.
    let word = |at: usize| u32::from_le_bytes(elf[at..at + 4].try_into().unwrap()) as usize;
    let half = |at: usize| usize::from(u16::from_le_bytes(elf[at..at + 2].try_into().unwrap()));
    let (entry, headers, size, count) = (word(24) & !1, word(28), half(42), half(44));
    let places = (0..count).map(|i| headers + i * size).map(|at| (word(at), word(at + 4), word(at + 8), word(at + 16)));
    let holds = |&(kind, _, address, length): &_| kind == 1 && (address..address + length).contains(&entry);
    let (_, offset, address, _) = places.into_iter().find(holds).expect("some segment holds the entry");
    let at = offset + entry - address;
    elf[at..at + 2].copy_from_slice(&[0x00, 0xde]);
    std::fs::write(folder.path().join("broken"), &elf).unwrap();
    let complaint = refuse(
        folder.path(),
        &[&SIL[..], &["--episodes", "1", "--qemu-image", "broken"]].concat(),
        &["crashed: hard fault at 0x", "qemu-system-arm: exit status: 1"],
    );
    assert_eq!(complaint.lines().count(), 1, "{complaint}");
}
