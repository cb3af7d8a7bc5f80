//! What a run leaves behind, and what can be made of it: captures that other programs read, and one module of them run again.

mod common;

use std::path::Path;

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

#[cfg(unix)]
#[test]
fn a_disk_that_fills_up_ends_the_run_with_what_there_was() {
    let folder = tempfile::tempdir().unwrap();
    for (file, least) in [("bus.log", 40_000), ("bus.pcap", 40_000)] {
        let program = command(folder.path(), &[]).get_program().to_owned();
        // The system refuses to make a file longer than this, in blocks of 512 bytes, as a full disk would.
        let script = format!(
            "trap '' XFSZ; ulimit -f 100; exec \"$0\" {} --capture {file} --capture-episodes 20",
            SIL.join(" ")
        );
        let mut shell = std::process::Command::new("sh");
        let output = shell.arg("-c").arg(script).arg(program).current_dir(folder.path()).output().unwrap();
        let complaint = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && complaint.lines().count() == 1, "{complaint}");
        assert!(complaint.contains("the capture cannot be written: "), "{complaint}");
        let length = std::fs::metadata(folder.path().join(file)).unwrap().len();
        assert!((least..=51_200).contains(&length), "{length}");
    }
    let text = std::fs::read_to_string(folder.path().join("bus.log")).unwrap();
    let log = composer_sim_bridge::candump::Log::parse(&text).unwrap();
    assert!(log.entries.len() > 300, "{}", log.entries.len());
}
