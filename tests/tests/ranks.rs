//! One training run over two processes by MPI: the bytes of one process, and a killed rank. `tests/run` installs OpenMPI and builds `composer-ranks`.
#![cfg(target_os = "linux")]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{refuse, succeed};

/// Few environments, minibatches of three chunks, a checkpoint after every iteration.
const TINY: [&str; 20] = [
    "train",
    "goal-reaching",
    "--steps",
    "3840",
    "--set",
    "environments=4",
    "--set",
    "rollout_steps=48",
    "--set",
    "minibatches=1",
    "--set",
    "evaluate_every=1920",
    "--set",
    "evaluation_episodes=1",
    "--set",
    "checkpoint_seconds=0",
    "--set",
    "threads=1",
    "--set",
    "faults.probability=0.5",
];

/// The program that connects ranks.
fn connector() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let path = test.ancestors().nth(3).unwrap().join("mpi/release/composer-ranks");
    assert!(path.exists(), "{} is missing: tests/run builds it", path.display());
    path
}

fn two_ranks(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new("mpirun");
    command.current_dir(folder).args(["--oversubscribe", "-n", "2"]);
    command.arg(connector()).arg(env!("CARGO_BIN_EXE_snakectl-under-test")).args(arguments);
    // Tests may be root's, in a container.
    command.env("OMPI_ALLOW_RUN_AS_ROOT", "1").env("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Processes that run `snakectl` as a rank in a folder.
fn ranks_in(folder: &Path) -> Vec<u32> {
    let is_one = |process: &PathBuf| {
        let line = std::fs::read(process.join("cmdline")).unwrap_or_default();
        let words: Vec<&[u8]> = line.split(|byte| *byte == 0).collect();
        let program = words.first().is_some_and(|word| word.ends_with(b"snakectl-under-test"));
        program
            && words.contains(&&b"--ranks"[..])
            && std::fs::read_link(process.join("cwd")).is_ok_and(|cwd| cwd == folder)
    };
    let all = std::fs::read_dir("/proc").unwrap().flatten().map(|entry| entry.path()).filter(is_one);
    all.filter_map(|process| process.file_name()?.to_str()?.parse().ok()).collect()
}

fn lines(path: &Path) -> usize {
    std::fs::read_to_string(path).map_or(0, |text| text.lines().count())
}

#[test]
fn two_ranks_one_of_them_killed_come_to_the_bytes_of_one_process() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path().canonicalize().unwrap();
    let [alone, together, killed] = ["alone", "together", "killed"].map(|name| [&TINY[..], &["--out", name]].concat());
    succeed(&here, &alone);
    let results =
        |name: &str| ["checkpoint.bin", "network.json"].map(|file| std::fs::read(here.join(name).join(file)).unwrap());

    let output = two_ranks(&here, &together).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(said.matches("done after 3840 steps").count(), 1, "{said}");
    assert!(results("alone") == results("together"), "two ranks came to something else");

    let mut mpi = two_ranks(&here, &killed).spawn().unwrap();
    let (patience, log) = (Instant::now(), here.join("killed/metrics.jsonl"));
    while lines(&log) < 2 {
        assert!(
            patience.elapsed() < Duration::from_secs(120) && mpi.try_wait().unwrap().is_none(),
            "it does not begin"
        );
        std::thread::sleep(Duration::from_millis(2));
    }
    let ranks = ranks_in(&here);
    assert_eq!(ranks.len(), 2, "{ranks:?}");
    let status = Command::new("kill").args(["-KILL", &ranks[1].to_string()]).status().unwrap();
    assert!(status.success());
    let output = mpi.wait_with_output().unwrap();
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && complaint.contains("--resume goes on from it"), "{complaint}");
    let done = lines(&log);
    assert!(done < 20, "it was killed too late");
    assert!(ranks_in(&here).is_empty(), "a rank outlives the others");

    let output = two_ranks(&here, &["train", "--resume", "killed"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(results("alone") == results("killed"), "the resumed run came to something else");
}

#[test]
fn ranks_that_nobody_connects_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = [&TINY[..], &["--out", "x", "--ranks"]].concat();
    refuse(folder.path(), &arguments, &["--ranks is for `mpirun", "host/mpi/README.md"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let smp = two_ranks(folder.path(), &[&TINY[..], &["--method", "smp"]].concat()).output().unwrap();
    let complaint = String::from_utf8_lossy(&smp.stderr);
    assert!(!smp.status.success() && complaint.contains("smp learns in one process"), "{complaint}");
}
