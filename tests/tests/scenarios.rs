//! The suite of scenarios that ships holds, and a scenario that does not is seen, named and shown again.

mod common;

use std::path::Path;
use std::process::Command;

use common::{refuse, snakectl, succeed};

/// What Python's XML parser makes of a JUnit file: tests, failures, and the messages of the failures.
fn read_back(file: &Path) -> serde_json::Value {
    let program = "import json, sys, xml.etree.ElementTree as t\n\
                   r = t.parse(sys.argv[1]).getroot()\n\
                   print(json.dumps([int(r.get('tests')), int(r.get('failures')), [c.get('name') for c in r.iter('testcase')], \
                   [f.get('message') for f in r.iter('failure')]]))";
    let output = Command::new("python3").arg("-c").arg(program).arg(file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_suite_that_ships_holds() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let junit = folder.path().join("junit.xml");
    let text = succeed(root, &["test", "--junit", junit.to_str().unwrap()]);
    let scenarios = std::fs::read_dir(root.join("tests/scenarios")).unwrap().count();
    assert!(text.contains(&format!("{scenarios} scenarios hold")), "{text}");
    let junit = read_back(&junit);
    assert_eq!((junit[0].as_u64(), junit[1].as_u64()), (Some(scenarios as u64), Some(0)));
}

#[test]
fn a_broken_scenario_fails_is_written_down_and_shown_again_by_the_command_it_names() {
    let folder = tempfile::tempdir().unwrap();
    let red = "about = \"A <red> one\"\ntask = \"goal-reaching\"\nepisodes = 3\nfaults = \"unplug:#3@0.2s\"\n[expect]\ndead_seen_within = 0\nsuccess_rate = 0.1\n";
    let green = red.replace("dead_seen_within = 0", "dead_seen_within = 4");
    std::fs::write(folder.path().join("red.toml"), red).unwrap();
    std::fs::write(folder.path().join("green.toml"), green).unwrap();
    let output = snakectl(folder.path(), &["test", ".", "--junit", "junit.xml"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8(output.stderr).unwrap().contains("1 of 2 scenarios are broken"));
    let again = text.split("(snakectl ").nth(1).and_then(|rest| rest.split(')').next()).unwrap();
    assert!(again.starts_with("test ./red.toml --episode "), "{text}");
    let output = snakectl(folder.path(), &again.split(' ').collect::<Vec<_>>());
    let shown = String::from_utf8(output.stdout).unwrap();
    let complaint = |text: &str| text.lines().find(|line| line.contains("dead_seen_within")).unwrap().to_string();
    assert_eq!(complaint(&shown), complaint(&text));
    let junit = read_back(&folder.path().join("junit.xml"));
    assert_eq!((junit[0].as_u64(), junit[1].as_u64()), (Some(2), Some(1)));
    assert!(junit[3][0].as_str().unwrap().contains("believes module 3 alive"), "{junit}");
}

#[test]
fn files_that_are_no_scenarios_are_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    refuse(folder.path(), &["test", "."], &["no scenarios in ."]);
    refuse(folder.path(), &["test", "missing.toml"], &["cannot read the scenario missing.toml"]);
    std::fs::write(
        folder.path().join("a.toml"),
        "about = \"x\"\ntask = \"goal-reaching\"\ncolour = 1\n[expect]\nlink_speed = 1.0\n",
    )
    .unwrap();
    refuse(folder.path(), &["test", "a.toml"], &["a.toml cannot be", "unknown field `colour`"]);
}

#[test]
fn a_campaign_goes_on_where_it_was_and_shards_make_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let campaign =
        |more: &[&str]| succeed(folder.path(), &[&["campaign", "--schedules", "24", "--seed", "3"], more].concat());
    assert!(campaign(&["--out", "whole.jsonl"]).contains("24 schedules, 0 break a rule"));
    let whole = std::fs::read_to_string(path("whole.jsonl")).unwrap();
    // Cut off in the middle of a line, as by a full disk.
    std::fs::write(path("cut.jsonl"), &whole[..whole.len() - 9]).unwrap();
    campaign(&["--out", "cut.jsonl"]);
    assert_eq!(std::fs::read_to_string(path("cut.jsonl")).unwrap(), whole);
    for part in ["1/3", "2/3", "3/3"] {
        campaign(&["--shard", part]);
    }
    let parts = ["runs/campaign-1-of-3.jsonl", "runs/campaign-2-of-3.jsonl", "runs/campaign-3-of-3.jsonl"];
    campaign(&[&["--out", "merged.jsonl", "--merge"], &parts[..]].concat());
    assert_eq!(std::fs::read_to_string(path("merged.jsonl")).unwrap(), whole);
    refuse(folder.path(), &["campaign", "--shard", "0/3"], &["no shard 0/3", "the first is 1/3"]);
    refuse(
        folder.path(),
        &["campaign", "--schedules", "24", "--seed", "4", "--out", "whole.jsonl"],
        &["another campaign"],
    );
    refuse(folder.path(), &["campaign", "--number", "1", "--schedule", "explode:1"], &["unknown fault `explode`"]);
}

#[test]
fn what_broke_a_rule_once_breaks_none_any_more() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let corpus = std::fs::read_to_string(root.join("tests/campaign/corpus.txt")).unwrap();
    let mut count = 0;
    for line in corpus.lines().filter(|line| !line.starts_with('#')) {
        let [policy, seed, modules, number, schedule] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            panic!("policy, seed, modules, number and schedule: {line}")
        };
        let run =
            ["campaign", policy, "--seed", seed, "--modules", modules, "--number", number, "--schedule", schedule];
        assert_eq!(succeed(root, &run).trim(), "no rule is broken", "{line}");
        count += 1;
    }
    assert!(count >= 6, "{count}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_scenario_runs_on_emulated_modules_too() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = "about = \"x\"\ntask = \"goal-reaching\"\nepisodes = 2\nfaults = \"unplug:#3@0.2s..0.6s\"\n\
                    [expect]\ndead_seen_within = 4\none_time_keeper_within = 12\nlatent_age = \"20ms\"\n";
    std::fs::write(folder.path().join("emulated.toml"), scenario).unwrap();
    let row = |more: &[&str]| {
        let text = succeed(folder.path(), &[&["test", "emulated.toml"], more].concat());
        text.lines().find(|line| line.starts_with("emulated ")).unwrap().to_string()
    };
    assert_eq!(row(&["--qemu"]), row(&[]));
}
