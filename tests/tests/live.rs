//! The simulated bus in real time: python-can, `snakectl bus` and whoever else opens the terminal talk to simulated modules as to real ones.
//! `tests/run` installs python-can and cantools in an environment of their own.
#![cfg(unix)]

mod common;

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use common::{Live, refuse, signal, succeed};
use serde_json::Value;

fn python(folder: &Path, script: &str, arguments: &[&str]) -> Output {
    // The test lies in target/release/deps.
    let test = std::env::current_exe().unwrap();
    let python = test.ancestors().nth(3).unwrap().join("can-tools/bin/python");
    assert!(python.exists(), "{} is missing: tests/run installs it", python.display());
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("python").join(script).canonicalize().unwrap();
    Command::new(python).current_dir(folder).arg(script).args(arguments).output().unwrap()
}

/// What `snakectl bus slcan:bus monitor --json` prints, line by line.
fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line:?}: {e}"))).collect()
}

#[test]
fn python_can_decodes_every_frame_by_our_dbc_arms_sets_a_goal_and_stops() {
    let live = Live::start(&["--no-station"]);
    let dbc = succeed(live.path(), &["dbc"]);
    std::fs::write(live.path().join("robot.dbc"), dbc).unwrap();
    let output = python(live.path(), "live_bus.py", &["bus", "robot.dbc", "8"]);
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{complaint}");
    let seen: Value = serde_json::from_slice(&output.stdout).unwrap();
    for (frame, least) in [
        ("SYNC", 40),
        ("STATE", 8 * 40),
        ("LATENT", 8 * 40),
        ("TELEMETRY", 8),
        ("HEARTBEAT", 16),
        ("SERVICE_RESPONSE", 8),
    ] {
        assert!(seen["heard"][frame].as_u64().unwrap_or(0) >= least, "{frame}: {seen}");
    }
    // In bus time it is less than two milliseconds; here are two processes, a terminal, and up to a cycle until STATE says so.
    assert!(seen["stopped_after"].as_f64().unwrap() < 1.0, "{seen}");
    let report = live.interrupt();
    assert!(report.contains("s simulated"), "{report}");
}

#[test]
fn the_monitor_names_an_unplugged_module_within_three_cycles() {
    let live = Live::start(&["--fault", "unplug:#3@6s..12s", "--seconds", "60"]);
    let seen = lines(&live.bus(&["monitor", "--json", "--passive", "--every", "0.1", "--for", "9"]));
    let gone = seen.iter().find(|line| line["event"] == "gone").unwrap_or_else(|| panic!("{seen:?}"));
    assert_eq!((&gone["node"], &gone["fault_name"]), (&3.into(), &"none".into()));
    // Its last sign of life, by the last look before.
    let before = seen.iter().rfind(|line| line["modules"][3]["present"] == true).unwrap();
    let heard = before["at"].as_f64().unwrap() - before["modules"][3]["age"].as_f64().unwrap();
    let named = gone["at"].as_f64().unwrap();
    // Within three cycles of the bus; one more, since it may have spoken after that look, and a little for two processes.
    assert!(named - heard < 4.0 * 0.05 + 0.1, "heard at {heard} s, named at {named} s");
    assert_eq!(seen.iter().filter(|line| line["event"] == "gone").count(), 1, "{seen:?}");
    let last = seen.iter().rfind(|line| line["modules"].is_array()).unwrap();
    assert_eq!(
        (last["modules"][3]["present"].clone(), last["modules"][2]["present"].clone()),
        (false.into(), true.into())
    );
    // It is plugged in again.
    let seen = lines(&live.bus(&["monitor", "--json", "--passive", "--every", "0.1", "--for", "7"]));
    assert!(seen.iter().any(|line| line["modules"][3]["present"] == true), "{seen:?}");
}

#[test]
fn what_is_no_bus_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let refuse = |arguments: &[&str], words: &[&str]| refuse(folder.path(), arguments, words);
    refuse(&["bus", "/dev/ttyACM0", "stop"], &["slcan:/dev/ttyACM0"]);
    refuse(&["bus", "slcan:nothing", "stop"], &["slcan:nothing cannot be opened", "no such serial port"]);
    refuse(&["bus", "nocan9", "stop"], &["nocan9 cannot be opened"]);
    std::fs::write(folder.path().join("file"), "precious").unwrap();
    refuse(&["bus", "slcan:file", "stop"], &["it is no serial port"]);
    refuse(&["sil", "goal-reaching", "--live", "slcan:file"], &["file exists already"]);
    assert_eq!(std::fs::read_to_string(folder.path().join("file")).unwrap(), "precious");
    refuse(&["sil", "goal-reaching", "--live", "bus"], &["slcan:PATH"]);
    refuse(&["sil", "goal-reaching", "--live", "slcan:bus", "--pace", "0"], &["--pace is 0.001 to 1000"]);
    refuse(&["sil", "goal-reaching", "--pace", "2"], &["--live"]);
    refuse(&["sil", "goal-reaching", "--no-station"], &["--live"]);
    refuse(&["sil", "goal-reaching", "--live", "slcan:bus", "--parity", "--qemu"], &["--parity"]);
    assert!(!folder.path().join("bus").exists());
}

/// Waits for the end of a program, and gives what it said.
fn end(child: Child) -> Output {
    let (id, start) = (child.id(), Instant::now());
    let waiting = std::thread::spawn(move || child.wait_with_output().unwrap());
    while !waiting.is_finished() {
        assert!(start.elapsed() < Duration::from_secs(20), "process {id} goes on");
        std::thread::sleep(Duration::from_millis(5));
    }
    waiting.join().unwrap()
}

/// The first line that a program prints, and the program.
fn first_line(mut child: Child) -> (String, Child) {
    let mut reader = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    reader.read_line(&mut line).unwrap();
    child.stdout = Some(reader.into_inner());
    (line, child)
}

#[test]
fn two_programs_on_one_terminal_and_a_terminal_that_closes() {
    let live = Live::start(&[]);
    // It has it open as soon as it prints.
    let monitor = live.command(&["monitor", "--passive", "--json", "--every", "0.05"]).spawn().unwrap();
    let (_, monitor) = first_line(monitor);
    live.refuse(&["stop"], &["slcan:bus cannot be opened", "another program has it open"]);
    live.interrupt();
    // The simulation has ended under the monitor's hands.
    let output = end(monitor);
    let complaint = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && complaint.contains("the terminal has closed"), "{complaint}");
    assert_eq!(complaint.lines().count(), 1, "{complaint}");
}

#[test]
fn control_c_of_whoever_armed_the_robot_stops_it_until_it_is_released() {
    let live = Live::start(&["--no-station"]);
    let (line, armed) = first_line(live.command(&["arm"]).spawn().unwrap());
    assert_eq!(line.trim(), "armed: modules 0 to 7");
    std::thread::sleep(Duration::from_millis(500));
    signal(&armed, "INT");
    let output = end(armed);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && text.contains("stopped: modules 0 to 7"), "{text}");
    let seen = lines(&live.bus(&["monitor", "--json", "--every", "0.3", "--for", "2"]));
    let last = seen.iter().rfind(|line| line["modules"].is_array()).unwrap();
    assert_eq!(last["stopped"], true, "{last}");
    for module in last["modules"].as_array().unwrap() {
        assert_eq!(
            (&module["mode"], &module["fault_name"]),
            (&"stopped".into(), &"32 EmergencyStop".into()),
            "{module}"
        );
        assert!(module["supply"].as_f64().unwrap() > 5.0, "{module}");
    }
    live.refuse(&["arm"], &["modules 0, 1, 2, 3, 4, 5, 6, 7", "a fault, a stop or an unclean restart forbids it"]);
    assert_eq!(live.bus(&["release"]).trim(), "released, and disarmed: modules 0 to 7");
    assert_eq!(live.bus(&["arm", "--for", "0.3"]), "armed: modules 0 to 7\ndisarmed: modules 0 to 7\n");
    // Ctrl-C of a monitor stops, too.
    let (_, monitor) = first_line(live.command(&["monitor", "--every", "0.2"]).spawn().unwrap());
    signal(&monitor, "INT");
    let text = String::from_utf8(end(monitor).stdout).unwrap();
    assert!(text.ends_with("stopped: modules 0 to 7\n"), "{text}");
}

#[test]
fn what_a_module_refuses_becomes_a_sentence() {
    let live = Live::start(&["--no-station"]);
    let set = |name: &str, value: &str, words: &[&str]| live.refuse(&["node", "2", "set", name, value], words);
    set("encoder_null", "1", &["no register `encoder_null`", "encoder_zero"]);
    set("encoder_zero_0", "20000", &["`20000` is no value of encoder_zero_0", "0 to 16383"]);
    set("encoder_zero", "1", &["4 registers", "encoder_zero_0"]);
    set("supply", "12", &["module 2 refuses WRITE", "can be read, not written"]);
    set("node", "9", &["module 2 refuses WRITE", "out of range"]);
    set("node", "3", &["module 2 refuses WRITE", "the number is taken"]);
    live.refuse(&["node", "2", "number", "3"], &["module 2 refuses the number 3", "the number is taken"]);
    live.refuse(&["node", "9", "get", "supply"], &["module 9 does not answer", "not heard on the bus"]);
    live.refuse(&["node", "64", "get", "supply"], &["64"]);
    live.refuse(&["goal", "200", "0", "0"], &["within 128 units"]);
    live.refuse(&["node", "2", "jog", "yaw", "--current", "0.9"], &["--current is 0.01 to 0.5"]);
    // A page whose registers do not fit together is refused as a whole.
    live.bus(&["node", "2", "set", "supply_under", "20"]);
    live.refuse(&["node", "2", "store"], &["module 2 refuses STORE: supply_over does not fit"]);
    // Forgotten by a restart.
    live.bus(&["node", "2", "restart"]);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(live.bus(&["node", "2", "get", "supply_under"]).trim(), "supply_under = 9 V");
}

#[test]
fn two_stations_at_once_and_a_command_while_armed_are_refused() {
    let live = Live::start(&["--no-station"]);
    let (line, armed) = first_line(live.command(&["arm"]).spawn().unwrap());
    assert!(line.starts_with("armed"), "{line}");
    std::thread::sleep(Duration::from_millis(1500));
    let set = ["bus", "slcan:bus2", "node", "2", "set", "encoder_zero_0", "7"];
    // Stations count from a number that the clock gives them. One that happens to begin near the other's, 17 of 256 do, passes for it, and for the time
    // that a station is remembered the modules take the first for the other one. On a busy machine the first may be silent for so long, too.
    let told_apart = |attempt: u64| {
        std::thread::sleep(Duration::from_millis(2000 * attempt.min(1)));
        refuse(live.path(), &set, &["module 2 refuses WRITE"]).contains("another station is at work")
    };
    assert!((0..4).any(told_apart));
    // Reading is everybody's.
    succeed(live.path(), &["bus", "slcan:bus2", "node", "2", "get", "supply"]);
    // The first station is gone; for the dead-man time the robot is still armed.
    let second = common::command(live.path(), &set).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(200));
    signal(&armed, "KILL");
    end(armed);
    let complaint = String::from_utf8(end(second).stderr).unwrap();
    assert!(complaint.contains("module 2 refuses WRITE: refused while armed: disarm first"), "{complaint}");
    // Then it relaxes and disarms by itself.
    std::thread::sleep(Duration::from_millis(2500));
    assert_eq!(succeed(live.path(), &set).trim(), "encoder_zero_0 = 7 (0.0027 rad)");
}

#[test]
fn a_configuration_is_dumped_and_restored_and_that_of_another_robot_is_refused() {
    let live = Live::start(&["--no-station"]);
    live.bus(&["dump", "-o", "robot.toml"]);
    let file = std::fs::read_to_string(live.path().join("robot.toml")).unwrap();
    let changed = file.replacen("bus_off = 0", "bus_off = 1", 1);
    assert_ne!(changed, file);
    std::fs::write(live.path().join("changed.toml"), changed).unwrap();
    let text = live.bus(&["restore", "changed.toml"]);
    assert!(
        text.contains("module 0: 1 registers written and stored\nmodules 1 to 7: as in the file already"),
        "{text}"
    );
    live.bus(&["node", "0", "restart"]);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(live.bus(&["node", "0", "get", "bus_off"]).trim(), "bus_off = 1");
    live.bus(&["restore", "robot.toml"]);

    let id = "unique_id = \"";
    let at = file.find(id).unwrap() + id.len();
    let mut other = file.clone();
    other.replace_range(at..at + 8, "deadbeef");
    std::fs::write(live.path().join("other.toml"), other).unwrap();
    live.refuse(&["restore", "other.toml"], &["other.toml", "the file is of another robot", "module 0", "deadbeef"]);
    std::fs::write(live.path().join("typo.toml"), file.replacen("bus_off", "busoff", 1)).unwrap();
    live.refuse(&["restore", "typo.toml"], &["typo.toml", "no configuration of a robot", "`busoff` is no register"]);
    live.refuse(&["restore", "none.toml"], &["cannot read none.toml"]);
    let three = file.replacen("modules = 8", "modules = 3", 1);
    let end = three.match_indices("[[module]]").nth(3).unwrap().0;
    std::fs::write(live.path().join("three.toml"), &three[..end]).unwrap();
    live.refuse(&["restore", "three.toml"], &["the file is of a robot of 3 modules, this one has 8"]);
    // Nothing of that was written.
    let text = live.bus(&["restore", "robot.toml"]);
    assert!(text.contains("modules 0 to 7: as in the file already"), "{text}");
}

#[test]
fn emulated_microcontrollers_answer_as_modules_in_this_process_do() {
    let live = Live::start(&["--no-station", "--qemu", "--modules", "3"]);
    let text = live.bus(&["node", "1", "hello"]);
    assert!(text.contains("protocol: 3") && text.contains("modules: 3"), "{text}");
    assert_eq!(live.bus(&["node", "1", "set", "encoder_zero_0", "9"]).trim(), "encoder_zero_0 = 9 (0.0035 rad)");
    live.bus(&["node", "1", "store"]);
    live.bus(&["node", "1", "restart"]);
    std::thread::sleep(Duration::from_millis(1000));
    assert!(live.bus(&["node", "1", "get", "encoder_zero_0"]).starts_with("encoder_zero_0 = 9 "));
    assert_eq!(
        live.bus(&["goal", "5", "0", "0", "--arm", "--for", "1"]),
        "armed: modules 0 to 2\ndisarmed: modules 0 to 2\n"
    );
    assert_eq!(live.bus(&["stop"]).trim(), "stopped: modules 0 to 2");
    assert!(live.interrupt().contains("s simulated"));
}

#[test]
fn a_script_unplugs_module_3_while_the_robot_runs_and_the_others_go_on() {
    let live = Live::start(&["--control", "127.0.0.1:0"]);
    let address = live.control();
    std::fs::write(live.path().join("robot.dbc"), succeed(live.path(), &["dbc"])).unwrap();
    let output = python(live.path(), "control.py", &["bus", "robot.dbc", "8", &address]);
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{complaint}");
    let seen: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(seen["unplugged_for"].as_f64().unwrap() > 0.3 && seen["help"].as_str().unwrap().starts_with("unplug M, "));
    for (command, sentence) in [
        ("explode", "there is no command `explode`: there are unplug M, "),
        ("unplug", "there is no module 8: this robot has 8, numbered from 0"),
        ("cut", "there is no cable behind module 7: it is the last one"),
        ("plug", "not so: module 3 is plugged in"),
        ("drop", "2 is no probability: it lies between 0 and 1"),
        ("goal", "`goal here` is not how it is written: goal X Y, such as goal 12 -3.5"),
        ("long", "a command has at most 200 bytes"),
    ] {
        let answer = seen["refused"][command].as_str().unwrap();
        assert!(answer.starts_with(&format!("refused: {sentence}")), "{answer}");
    }
    assert!(live.interrupt().contains("s simulated"));
}

#[test]
fn what_this_plant_or_bus_cannot_do_is_refused() {
    let live = Live::start(&["--control", "127.0.0.1:0", "--no-station"]);
    let mut control = std::net::TcpStream::connect(live.control()).unwrap();
    let mut answers = BufReader::new(control.try_clone().unwrap()).lines();
    let mut ask = |line: &str| {
        control.write_all(format!("{line}\n").as_bytes()).unwrap();
        answers.next().unwrap().unwrap()
    };
    assert!(ask("stop").starts_with("refused: there is no station in this run"));
    assert!(ask("goal 3 4").starts_with("ok at "));
    let folder = live.path();
    let start = ["sil", "wall-climbing", "--live", "slcan:wall", "--control"];
    refuse(folder, &[&start[..], &["192.0.2.1:7000"]].concat(), &["192.0.2.1:7000 is not on this machine"]);
    refuse(folder, &["sil", "goal-reaching", "--control", "127.0.0.1:0"], &["--live"]);
    let taken = live.control();
    refuse(folder, &[&start[..], &[&taken]].concat(), &["nobody can connect to", &taken]);
    let wall = Live::start_with("wall-climbing", &["--control", "127.0.0.1:0"]);
    let mut control = std::net::TcpStream::connect(wall.control()).unwrap();
    control.write_all(b"goal 3 4\n").unwrap();
    let answer = BufReader::new(control).lines().next().unwrap().unwrap();
    assert!(answer.starts_with("refused: this plant has no goal that can be moved"), "{answer}");
}
