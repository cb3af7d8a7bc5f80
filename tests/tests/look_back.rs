//! What a run leaves behind, and what can be made of it: captures that other programs read, and one module of them run again.

mod common;

use std::path::Path;
use std::process::Command;

use common::{command, json, refuse, snakectl, succeed};

const SIL: [&str; 6] = ["sil", "goal-reaching", "--episodes", "20", "--seed", "3"];

/// A capture of twenty episodes in which one module loses its power and gets it back, and frames get lost.
fn twenty(folder: &Path) {
    let more = ["--capture", "bus.log", "--capture-episodes", "20", "--replayable"];
    succeed(folder, &[&SIL[..], &more, &["--fault", "unplug:1@0.4s..0.9s,drop:0.02"]].concat());
}

#[test]
fn a_module_of_a_capture_of_twenty_episodes_does_the_same_again_here_and_emulated() {
    let folder = tempfile::tempdir().unwrap();
    twenty(folder.path());
    let replay = |more: &[&str]| json(folder.path(), &[&["replay", "bus.log", "--json"], more].concat());
    let number = |verdict: &serde_json::Value, key: &str| verdict[key].as_u64().unwrap();
    let mut starts = 0;
    for node in 0..8 {
        let verdict = replay(&["--node", &node.to_string()]);
        assert!(verdict["first"].is_null() && verdict["ended"].is_null(), "{verdict}");
        assert_eq!((number(&verdict, "runs"), number(&verdict, "foreign")), (20, 0), "{verdict}");
        // At least a STATE and a LATENT in each of the cycles, of which an episode has more than ten.
        assert!(
            number(&verdict, "frames") > 20 * 10 * 2 && number(&verdict, "torques") > 20 * 10 * 2 * 10,
            "{verdict}"
        );
        starts += number(&verdict, "starts");
    }
    assert!((8 * 20 + 15..=8 * 20 + 20).contains(&starts), "one module an episode is switched on again: {starts}");
    let here = replay(&["--node", "3"]);
    assert_eq!(replay(&["--node", "3", "--qemu"]), here, "the emulated module");
    let text = succeed(folder.path(), &["replay", "bus.log", "--node", "3"]);
    assert!(text.contains("20 runs") && text.contains(" torques compared, 0 differ"), "{text}");
}

#[test]
fn another_policy_is_told_apart_and_a_capture_that_was_cut_off_is_used_as_far_as_it_goes() {
    let folder = tempfile::tempdir().unwrap();
    twenty(folder.path());
    let output = snakectl(folder.path(), &["replay", "bus.log", "--node", "2", "--policy", "tube-crossing"]);
    let complaint = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success());
    assert!(complaint.contains("module 2 does not do the same: in run 0 when its clock showed "), "{complaint}");
    assert!(complaint.contains(" of the transcript)") && complaint.lines().count() == 1, "{complaint}");
    // In the middle of a line: a note, and the rest is used.
    let log = std::fs::read(folder.path().join("bus.log")).unwrap();
    let cut = log.len() / 2 + (0..).find(|k| log[log.len() / 2 + k] == b'#').unwrap() + 3;
    std::fs::write(folder.path().join("bus.log"), &log[..cut]).unwrap();
    let output = snakectl(folder.path(), &["replay", "bus.log", "--node", "2", "--json"]);
    let complaint = String::from_utf8(output.stderr).unwrap();
    let line = 1 + log[..cut].iter().filter(|byte| **byte == b'\n').count();
    assert!(output.status.success(), "{complaint}");
    let note = format!("note: bus.log is cut off in the middle of line {line}, which is left out\n");
    assert_eq!(complaint, note);
    let verdict: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(verdict["polls"].as_u64().unwrap() > 1000 && verdict["first"].is_null(), "{verdict}");
    let ended = verdict["ended"].as_str().unwrap();
    assert!(ended.starts_with("the log ends before its line "), "{ended}");
    // What cannot be.
    refuse(folder.path(), &["replay", "none.log", "--node", "2"], &["cannot read the capture none.log"]);
    refuse(folder.path(), &["replay", "bus.log", "--node", "8"], &["bus.log", "has no node 8; it has 0, 1, 2"]);
    std::fs::write(folder.path().join("other.log"), "(0.000001) can0 123#DEAD\nnonsense\n").unwrap();
    refuse(folder.path(), &["replay", "other.log", "--node", "2"], &["other.log, line 2: `nonsense` is not a line"]);
    std::fs::write(folder.path().join("other.log"), "(0.000001) can0 123#DEAD\n").unwrap();
    refuse(folder.path(), &["replay", "other.log", "--node", "2"], &["other.log.modules", "--replayable"]);
    std::fs::write(folder.path().join("other.log.modules"), "{}\n").unwrap();
    refuse(
        folder.path(),
        &["replay", "other.log", "--node", "2"],
        &["other.log.modules", "no transcript of version 1"],
    );
    refuse(folder.path(), &["sil", "goal-reaching", "--replayable"], &["--capture"]);
    let pcap = ["sil", "goal-reaching", "--capture", "bus.pcap", "--replayable"];
    refuse(folder.path(), &pcap, &["--replayable goes with a candump log"]);
    assert!(!folder.path().join("bus.pcap").exists());
}

fn python(folder: &Path, script: &str, arguments: &[&str]) -> serde_json::Value {
    // The test lies in target/release/deps.
    let test = std::env::current_exe().unwrap();
    let python = test.ancestors().nth(3).unwrap().join("can-tools/bin/python");
    assert!(python.exists(), "{} is missing: tests/run installs it", python.display());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python").join(script);
    let output = Command::new(python).current_dir(folder).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn python_can_cantools_mcap_and_foxgloves_schemas_open_what_a_run_leaves_behind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::write(path.join("robot.dbc"), succeed(path, &["dbc"])).unwrap();
    let more = ["--capture", "bus.log", "--record", "run.mcap", "--capture-episodes", "3"];
    succeed(path, &[&SIL[..], &more, &["--fault", "unplug:#3@0.2s..0.6s,action:#5"]].concat());
    let seen = python(path, "look_back.py", &["robot.dbc", "bus.log", "run.mcap", "8", "32"]);
    let count = |topic: &str| seen["counts"][topic].as_u64().unwrap();
    let cycles = count("/modules");
    assert!(cycles > 3 * 10 && count("/bus") > cycles * 16, "{seen}");
    for topic in ["/joints", "/torques", "/attention"] {
        assert_eq!(count(topic), cycles, "{topic}");
    }
    // And once at the start of each of three episodes.
    assert_eq!(count("/tf"), cycles + 3);
    // At the start, armed or not, unplugged, plugged in, active: at least four looks an episode.
    assert!(seen["scenes"].as_u64().unwrap() >= 3 * 4, "{seen}");
    let faults = seen["faults"].as_array().unwrap();
    let of_an_episode = [
        serde_json::json!(["module 5's motors dead"]),
        serde_json::json!(["module 5's motors dead", "module 3 unplugged"]),
        serde_json::json!(["module 5's motors dead"]),
    ];
    assert_eq!(faults[..3], of_an_episode, "{seen}");
    assert_eq!(seen["schemas"], 21);
    assert!(
        (seen["attention"].as_f64().unwrap() - 1.0).abs() < 0.01 && seen["moved"].as_f64().unwrap() > 1.0,
        "{seen}"
    );
    assert!(seen["heard"]["LATENT"].as_u64().unwrap() > 7 * cycles / 2, "{seen}");
}

#[test]
fn wireshark_reads_our_pcap_and_sees_which_frames_are_can_fd() {
    let folder = tempfile::tempdir().unwrap();
    for (bus, fd) in [("fd", true), ("classic", false)] {
        let (pcap, log) = (format!("{bus}.pcap"), format!("{bus}.log"));
        for file in [&pcap, &log] {
            succeed(
                folder.path(),
                &["sil", "goal-reaching", "--episodes", "1", "--seed", "3", "--bus", bus, "--capture", file],
            );
        }
        let mut tshark = Command::new("tshark");
        let fields = ["can.id", "canfd.flags.brs", "can.flags.rtr", "data.data", "frame.time_epoch"];
        tshark
            .current_dir(folder.path())
            .args(["-r", &pcap, "-T", "fields"])
            .args(fields.iter().flat_map(|f| ["-e", f]));
        let output = tshark.output().expect("tests/run installs tshark");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = String::from_utf8(output.stdout).unwrap();
        let written = std::fs::read_to_string(folder.path().join(&log)).unwrap();
        let log = composer_sim_bridge::candump::parse(&written).unwrap();
        assert_eq!(text.lines().count(), log.len());
        for (line, entry) in text.lines().zip(log) {
            let fields: Vec<&str> = line.split('\t').collect();
            assert_eq!(fields[0], entry.frame.id.to_string(), "{line}");
            // It shows the flag of bit-rate switching for CAN-FD alone, that of remote frames for classic CAN alone.
            assert_eq!(fields[1..3], if fd { ["1", ""] } else { ["", "0"] }, "{line}");
            let data: String = entry.frame.payload().iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(fields[3], data, "{line}");
            let (seconds, rest) = fields[4].split_once('.').unwrap();
            let us = 1_000_000 * seconds.parse::<u64>().unwrap() + rest[..6].parse::<u64>().unwrap();
            assert_eq!(us, entry.at_us, "{line}");
        }
    }
}

#[cfg(unix)]
#[test]
fn a_disk_that_fills_up_ends_the_run_with_what_there_was() {
    let folder = tempfile::tempdir().unwrap();
    let files =
        [("--capture", "bus.log", 260_000), ("--capture", "bus.pcap", 260_000), ("--record", "run.mcap", 100_000)];
    for (option, file, least) in files {
        let program = command(folder.path(), &[]).get_program().to_owned();
        // The system refuses to make a file longer than this, in blocks of 512 bytes, as a full disk would.
        let script =
            format!("trap '' XFSZ; ulimit -f 600; exec \"$0\" {} {option} {file} --capture-episodes 20", SIL.join(" "));
        let mut shell = Command::new("sh");
        let output = shell.arg("-c").arg(script).arg(program).current_dir(folder.path()).output().unwrap();
        let complaint = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && complaint.lines().count() == 1, "{complaint}");
        assert!(complaint.contains("what is to be written down cannot be written: "), "{complaint}");
        let length = std::fs::metadata(folder.path().join(file)).unwrap().len();
        assert!((least..=307_200).contains(&length), "{length}");
    }
    let text = std::fs::read_to_string(folder.path().join("bus.log")).unwrap();
    let log = composer_sim_bridge::candump::Log::parse(&text).unwrap();
    assert!(log.entries.len() > 2000, "{}", log.entries.len());
    // A recording is whole all the same: its end takes the place of what did not fit.
    let recording = std::fs::read(folder.path().join("run.mcap")).unwrap();
    assert!(recording.ends_with(b"\x89MCAP0\r\n"));
    let counts = python(folder.path(), "recording.py", &["run.mcap"]);
    assert!(counts["/tf"].as_u64().unwrap() > 10 && counts["/bus"].as_u64().unwrap() > 100, "{counts}");
}
