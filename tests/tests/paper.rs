//! The paper's comparison: one process, shards, a killed shard and a cluster with a killed worker come to the same bytes; what must not be merged is
//! refused. `tests/run` installs HyperQueue in an environment of its own, and GNU parallel.
#![cfg(unix)]

#[path = "common/browser.rs"]
mod chromium;
mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use chromium::{attribute, browser, open};
use common::{command, refuse, signal, succeed};

/// Two methods, one task, two seeds, hardly trained: four runs and the policy that ships.
const TINY: [&str; 14] = [
    "--methods",
    "composer,ppo",
    "--tasks",
    "goal-reaching",
    "--seeds",
    "1,2",
    "--steps",
    "8192",
    "--episodes",
    "2",
    "--set",
    "evaluation_episodes=2",
    "--set",
    "checkpoint_seconds=0",
];

fn paper<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&["report", "paper"], more, &TINY[..]].concat()
}

/// Every file of a folder by its name.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| (path.file_name().unwrap().to_str().unwrap().into(), std::fs::read(path).unwrap())).collect()
}

/// What one process makes of it.
fn reference() -> &'static BTreeMap<String, Vec<u8>> {
    static FILES: OnceLock<BTreeMap<String, Vec<u8>>> = OnceLock::new();
    FILES.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        succeed(folder.path(), &paper(&["--runs", "runs", "--out", "results"]));
        files(&folder.path().join("results"))
    })
}

/// The merge of shards in folders below `folder/parts` is what one process makes.
fn merges_to_the_same(folder: &Path, parts: &[&str]) {
    let parts: Vec<String> = parts.iter().map(|part| format!("parts/{part}")).collect();
    let merge: Vec<&str> = std::iter::once("--merge").chain(parts.iter().map(String::as_str)).collect();
    succeed(folder, &paper(&[&merge[..], &["--out", "merged"]].concat()));
    let (merged, whole) = (files(&folder.join("merged")), reference());
    assert_eq!(merged.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>());
    for (name, bytes) in whole {
        assert!(merged[name] == *bytes, "{name} differs");
    }
}

/// Starts a shard and waits until it is in the middle of a run.
fn begun_shard(folder: &Path, shard: &str, out: &str) -> Child {
    let child = command(folder, &paper(&["--shard", shard, "--out", out, "--jobs", "1"]))
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    wait_for_a_run_in_the_middle(&folder.join(out));
    child
}

/// Waits until some run below a folder has metrics and is not at its end.
fn wait_for_a_run_in_the_middle(folder: &Path) {
    let patience = Instant::now();
    let in_the_middle = |run: PathBuf| {
        let logged = std::fs::metadata(run.join("metrics.jsonl")).is_ok_and(|metrics| metrics.len() > 0);
        logged && !run.join("trained.json").exists()
    };
    loop {
        let entries =
            |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        if entries(folder).any(in_the_middle) || entries(folder).any(|below| entries(&below).any(in_the_middle)) {
            return;
        }
        assert!(patience.elapsed() < Duration::from_secs(120), "nothing begins in {}", folder.display());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn shards_one_of_them_killed_and_begun_again_merge_to_the_bytes_of_one_process() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let mut killed = begun_shard(here, "1/2", "parts/1");
    killed.kill().unwrap();
    killed.wait().unwrap();
    succeed(here, &paper(&["--shard", "2/2", "--out", "parts/2"]));
    let merge = ["--merge", "parts/1", "parts/2", "--out", "merged"];
    refuse(here, &paper(&merge), &["parts/1/goal-reaching-composer-1 is half written", "--so-far"]);
    assert!(!here.join("merged").exists());
    let so_far = succeed(here, &paper(&[&merge[..], &["--so-far"]].concat()));
    assert!(so_far.contains("2 of 4 runs are done; the 2 others are left out"), "{so_far}");
    std::fs::remove_dir_all(here.join("merged")).unwrap();

    succeed(here, &paper(&["--shard", "1/2", "--out", "parts/1"]));
    // Once more there is nothing to do.
    let before = files(&here.join("parts/1/goal-reaching-composer-1"));
    succeed(here, &paper(&["--shard", "1/2", "--out", "parts/1"]));
    assert!(before == files(&here.join("parts/1/goal-reaching-composer-1")));
    merges_to_the_same(here, &["2", "1"]);

    // What must not be merged.
    let merge = ["--merge", "parts/1", "parts/2", "--out", "other"];
    let of_other_settings = paper(&[&merge[..], &["--set", "sigma=0.4"]].concat());
    refuse(here, &of_other_settings, &["parts/1/goal-reaching-composer-1 holds a run with other settings"]);
    let more_episodes: Vec<&str> = paper(&merge).into_iter().map(|word| if word == "2" { "3" } else { word }).collect();
    refuse(here, &more_episodes, &["is not measured with 3 episodes yet"]);
    refuse(here, &paper(&["--merge", "parts/1", "--out", "other"]), &["parts/1 holds no run goal-reaching-ppo-1"]);
    refuse(here, &paper(&["--merge", "parts/3", "--out", "other"]), &["there is no folder parts/3"]);
    let network = here.join("parts/2/goal-reaching-ppo-1/network.json");
    std::fs::write(&network, "{}").unwrap();
    refuse(
        here,
        &paper(&merge),
        &["goal-reaching-ppo-1 holds another policy than the one that its training ended with"],
    );
    assert!(!here.join("other").exists());
}

#[test]
fn shards_tasks_and_methods_that_are_not_there_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let refuse = |arguments: &[&str], words: &[&str]| {
        refuse(folder.path(), &[&["report", "paper"], arguments].concat(), words);
    };
    refuse(&["--shard", "9/8", "--out", "x"], &["there is no shard 9/8", "the last 8/8"]);
    refuse(&["--shard", "0/8", "--out", "x"], &["there is no shard 0/8", "the first is 1/8"]);
    refuse(&["--shard", "two", "--out", "x"], &["`two` is no shard"]);
    refuse(&["--shard", "1/8"], &["--out"]);
    refuse(&["--methods", "composer,td3"], &["no method `td3`", "mat_dec"]);
    refuse(&["--tasks", "dancing"], &["the tasks are", "wall-climbing"]);
    refuse(&["--seeds", "1,1"], &["asked for twice"]);
    refuse(&["--merge", "nowhere"], &["there is no folder nowhere"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// A file of the repository.
fn script(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../host/cluster").join(name).canonicalize().unwrap()
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_snakectl-under-test");

#[test]
fn a_hyperqueue_cluster_whose_worker_is_killed_goes_on_to_the_same_bytes() {
    let test = std::env::current_exe().unwrap();
    let python = test.ancestors().nth(3).unwrap().join("hyperqueue/bin/python");
    assert!(python.exists(), "{} is missing: tests/run installs it", python.display());
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let on_cluster = || {
        let mut command = Command::new(&python);
        command.current_dir(here).arg(script("on_hyperqueue.py")).args([
            "--shards",
            "3",
            "--out",
            "parts",
            "--workers",
            "1",
        ]);
        command.arg(PROGRAM).arg("--").args(TINY).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    };
    let mut cluster = on_cluster().spawn().unwrap();
    wait_for_a_run_in_the_middle(&here.join("parts"));
    // The worker runs in this process, and what it had begun ends with it or is waited for.
    cluster.kill().unwrap();
    cluster.wait().unwrap();
    assert!(!here.join("parts/3/goal-reaching-composer-2/trained.json").exists(), "it was killed too late");
    let Output { status, stdout, stderr } = on_cluster().output().unwrap();
    let (said, complaint) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(status.success() && said.contains("all 3 shards are done"), "{said}{complaint}");
    merges_to_the_same(here, &["1", "2", "3"]);
}

#[test]
fn gnu_parallel_and_a_slurm_array_come_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let run = |script: &mut Command| {
        let output = script.current_dir(here).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    // As Slurm would for each task of the array; the first half is done when it is stopped.
    let slurm = |task: &str| {
        let mut command = Command::new(script("slurm.sh"));
        command.env("SLURM_ARRAY_TASK_ID", task).env("SLURM_ARRAY_TASK_MAX", "2").args(["parts", PROGRAM]).args(TINY);
        command.stderr(Stdio::piped());
        command
    };
    let mut stopped = slurm("1").current_dir(here).spawn().unwrap();
    wait_for_a_run_in_the_middle(&here.join("parts/1"));
    signal(&stopped, "TERM");
    let complaint = std::io::read_to_string(stopped.stderr.take().unwrap()).unwrap();
    assert!(
        !stopped.wait().unwrap().success() && complaint.contains("the same command goes on from here"),
        "{complaint}"
    );
    run(&mut slurm("2"));
    run(Command::new(script("parallel.sh")).args(["2", "parts", PROGRAM]).args(TINY));
    merges_to_the_same(here, &["1", "2"]);
}

#[test]
fn the_page_opens_offline_in_a_browser_with_a_replay_of_every_method() {
    let page = &reference()["index.html"];
    let text = String::from_utf8_lossy(page);
    for outside in ["https:", "src=", "href=", "@import", "fetch(", "XMLHttpRequest"] {
        assert!(!text.contains(outside), "the page contains {outside}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("index.html");
    std::fs::write(&path, page).unwrap();
    let dom = open(&browser(), &path, "");
    assert_eq!(attribute(&dom, "data-ready"), Some("true"), "the replay is there");
    // Both methods, and the policy that ships.
    let to_choose = dom.split("id=\"pick\"").nth(1).and_then(|rest| rest.split("<iframe").next()).unwrap_or_default();
    assert_eq!(to_choose.matches("<button").count(), 3);
    for words in
        ["Learning curves: the paper", "Table III: other lengths", "What integers and lost frames cost", "Watch them"]
    {
        assert!(dom.contains(words), "{words}");
    }
}
