//! Bad input gets one clear sentence and a non-zero exit; nothing is lost or half written.

mod common;

use common::{command, refuse, snakectl, succeed};
use composer_shared::policies;

const TINY: [&str; 8] = [
    "--set",
    "environments=2",
    "--set",
    "rollout_steps=16",
    "--set",
    "evaluate_every=0",
    "--set",
    "evaluation_episodes=1",
];

fn train<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&["train", "goal-reaching"], more, &TINY[..]].concat()
}

#[test]
fn a_damaged_policy_image_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let image = policies::shipped("goal-reaching").unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    write("short.policy", &image[..image.len() / 2]);
    write("empty.policy", &[]);
    let mut flipped = image.to_vec();
    flipped[5000] ^= 0x10;
    write("flipped.policy", &flipped);
    let mut version = image.to_vec();
    version[8] ^= 0x7f;
    write("version.policy", &version);
    write("noise.policy", &[0x5a; 14040]);
    for verb in ["eval", "sil"] {
        refuse(folder.path(), &[verb, "short.policy"], &["short.policy", "bytes"]);
        refuse(folder.path(), &[verb, "empty.policy"], &["empty.policy"]);
        refuse(folder.path(), &[verb, "flipped.policy"], &["flipped.policy", "CRC"]);
        refuse(folder.path(), &[verb, "version.policy"], &["version.policy", "version"]);
        refuse(folder.path(), &[verb, "noise.policy"], &["noise.policy"]);
        refuse(folder.path(), &[verb, "nothing"], &["no policy nothing", "goal-reaching"]);
    }
}

#[test]
fn a_policy_of_another_task_is_refused() {
    use composer_shared::policy::{IMAGE_SIZE, Policy, Task, random_image, seal};
    let folder = tempfile::tempdir().unwrap();
    let mut image = [0; IMAGE_SIZE];
    random_image(3, &mut image);
    assert_eq!(Policy::parse(&image).unwrap().task(), Task::GoalReaching);
    // The task's byte, and the checksum made right again.
    let at = image.iter().enumerate().position(|(i, _)| {
        let mut other = image;
        other[i] = Task::TubeCrossing as u8;
        seal(&mut other);
        Policy::parse(&other).is_ok_and(|p| p.task() == Task::TubeCrossing)
    });
    let at = at.expect("some byte says the task");
    image[at] = Task::TubeCrossing as u8;
    seal(&mut image);
    std::fs::write(folder.path().join("tube.policy"), image).unwrap();
    for verb in ["eval", "sil"] {
        let wanted = [verb, "tube.policy", "--task", "goal-reaching"];
        refuse(folder.path(), &wanted, &["trained for tube-crossing", "cannot do goal-reaching"]);
    }
}

#[test]
fn a_robot_that_cannot_be_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let good = composer_host::robot::DEFAULT_TOML;
    for (from, to, word) in [
        ("modules = 8", "modules = 0", "modules = 0"),
        ("link_mass = 0.00294", "link_mass = -1.0", "link_mass = -1"),
        ("stiffness", "stifness", "stifness"),
        ("gravity = 196.2", "gravity = \"down\"", "gravity"),
    ] {
        std::fs::write(folder.path().join("robot.toml"), good.replace(from, to)).unwrap();
        refuse(folder.path(), &["eval", "goal-reaching", "--robot", "robot.toml"], &[word]);
        refuse(folder.path(), &train(&["--robot", "robot.toml"]), &[word]);
    }
    refuse(folder.path(), &["eval", "goal-reaching", "--robot", "none.toml"], &["none.toml"]);
    refuse(folder.path(), &["eval", "goal-reaching", "--modules", "65"], &["65", "1 to 64"]);
    refuse(folder.path(), &["sil", "goal-reaching", "--modules", "0"], &["modules = 0"]);
    // A robot whose limits the policy was not trained for.
    std::fs::write(folder.path().join("robot.toml"), good.replace("torque_limit = 80.0", "torque_limit = 40.0"))
        .unwrap();
    refuse(folder.path(), &["sil", "goal-reaching", "--robot", "robot.toml"], &["trained for"]);
    assert!(!folder.path().join("runs").exists(), "a refused run leaves nothing behind");
}

#[test]
fn settings_flags_and_faults_are_checked() {
    let folder = tempfile::tempdir().unwrap();
    refuse(folder.path(), &train(&["--set", "gama=0.9"]), &["gama"]);
    refuse(folder.path(), &train(&["--set", "gamma=1.5"]), &["gamma", "1.5"]);
    refuse(folder.path(), &train(&["--set", "goal_distance=[1, 5]"]), &["goal_distance"]);
    refuse(folder.path(), &["train", "swimming"], &["swimming", "wall-climbing"]);
    // Scenes that cannot be.
    for (task, setting, words) in [
        ("tube-crossing", "tube_width=0.7", ["tube_width = 0.7", "0.8 units thick"]),
        ("tube-crossing", "goal_beyond=0.5", ["goal_beyond = 0.5", "inside the tube"]),
        ("wall-climbing", "wall_thickness=0", ["wall_thickness = 0", "from 0.5"]),
        ("wall-climbing", "wall_height=[0.5, 1]", ["wall_height = [0.5, 1]", "higher than the snake"]),
        ("block-pushing", "block_distance=[0, 3]", ["block_distance = [0, 3]", "stand on the snake"]),
        ("block-pushing", "goal_distance=[0.5, 3]", ["goal_distance = [0.5, 3]", "from the start"]),
        ("goal-reaching", "goal_distance=[10, 1000]", ["goal_distance = [10, 1000]", "within 100 units"]),
        ("shape-formation", "shapes=[]", ["shapes = []", "at least one"]),
    ] {
        refuse(folder.path(), &["train", task, "--steps", "100", "--set", setting], &words);
    }
    refuse(folder.path(), &["eval", "goal-reaching", "--fault", "explode:1"], &["explode"]);
    refuse(folder.path(), &["eval", "goal-reaching", "--fault", "unplug:9"], &["9", "8"]);
    refuse(folder.path(), &["eval", "goal-reaching", "--fault", "drop:0.1"], &["sil"]);
    refuse(folder.path(), &["sil", "goal-reaching", "--bitrate", "1"], &["bit rate"]);
    refuse(folder.path(), &["sil", "goal-reaching", "--drop", "2"], &["probability"]);
    refuse(folder.path(), &["eval", "goal-reaching", "--episodes", "0"], &["0"]);
    for verb in ["eval", "sil"] {
        let run =
            |more: &[&str], words: &[&str]| refuse(folder.path(), &[&[verb, "goal-reaching"], more].concat(), words);
        run(&["--finer", "0"], &["--finer", "0 is not in 1..=1000"]);
        run(&["--tolerance", "0"], &["--tolerance 0", "above zero"]);
        run(&["--vary", "frictoin=1"], &["`frictoin`", "friction_along", "gravity"]);
        run(&["--vary", "torque_limit=40"], &["`torque_limit`", "stiffness"]);
        run(&["--vary", "gravity"], &["KEY=VALUE"]);
        run(&["--published", "--seed", "3"], &["--published", "--seed"]);
    }
    refuse(folder.path(), &["report", "policies", "--configs", "none"], &["none/goal-reaching.toml"]);
    refuse(folder.path(), &["report", "policies", "--tasks", "dancing"], &["dancing"]);
    refuse(
        folder.path(),
        &["report", "policies", "--configs", concat!(env!("CARGO_MANIFEST_DIR"), "/../host/configs"), "--only-freeze"],
        &["holds no run of goal-reaching"],
    );
    refuse(folder.path(), &["export", ".", "-o", "x.policy"], &["config.toml"]);
    refuse(
        folder.path(),
        &["sil", "goal-reaching", "--episodes", "1", "--replay", "no/such/folder.html"],
        &["no/such"],
    );
}

#[test]
fn a_run_survives_kill_and_other_folders_other_robots_and_full_disks_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    refuse(path, &train(&["--out", "/proc/composer"]), &["/proc/composer"]);

    // Killed in the middle, the run goes on from its last checkpoint and ends where an undisturbed one does.
    let steps = ["--steps", "640", "--set", "checkpoint_seconds=0.0"];
    succeed(path, &train(&[&steps[..], &["--out", "whole"]].concat()));
    let mut child = command(path, &train(&[&steps[..], &["--out", "killed"]].concat())).spawn().unwrap();
    let metrics = path.join("killed/metrics.jsonl");
    let lines = |file: &std::path::Path| std::fs::read_to_string(file).map_or(0, |t| t.lines().count());
    let patience = std::time::Instant::now();
    while lines(&metrics) < 3 && patience.elapsed().as_secs() < 120 && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    succeed(path, &["train", "--resume", "killed"]);
    let network = |run: &str| std::fs::read(path.join(run).join("network.json")).unwrap();
    assert_eq!(network("whole"), network("killed"), "the same bits as without the kill");

    // A run is not overwritten, and not resumed with another robot.
    refuse(path, &train(&["--out", "whole"]), &["already holds a run"]);
    let heavier = composer_host::robot::DEFAULT_TOML.replace("link_mass = 0.00294", "link_mass = 0.003");
    std::fs::write(path.join("heavier.toml"), heavier).unwrap();
    refuse(path, &["train", "--resume", "whole", "--robot", "heavier.toml"], &["another robot"]);
    refuse(path, &["train", "--resume", "nowhere"], &["nowhere"]);

    // A checkpoint with one bit flipped.
    let checkpoint = path.join("killed/checkpoint.bin");
    let mut bytes = std::fs::read(&checkpoint).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&checkpoint, &bytes).unwrap();
    refuse(path, &["train", "--resume", "killed"], &["damaged"]);

    // The disk is full (files may not grow past 100 KiB): the run stops with a sentence and the old checkpoint is whole.
    let before = std::fs::read(path.join("whole/checkpoint.bin")).unwrap();
    assert!(before.len() > 150_000, "the limit below must be smaller than a checkpoint: {}", before.len());
    let program = env!("CARGO_BIN_EXE_snakectl-under-test");
    let script = format!("trap '' XFSZ; ulimit -f 100; exec {program} train --resume whole --steps 1280");
    let output = std::process::Command::new("bash").current_dir(path).args(["-c", &script]).output().unwrap();
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && complaint.contains("checkpoint"), "{complaint}");
    assert!(!complaint.contains("panicked"), "{complaint}");
    assert_eq!(before, std::fs::read(path.join("whole/checkpoint.bin")).unwrap());
    succeed(path, &["train", "--resume", "whole", "--steps", "704"]);
}

#[test]
fn help_is_there_for_every_verb() {
    let folder = tempfile::tempdir().unwrap();
    for verb in ["train", "eval", "export", "sil", "flash", "bench", "dbc", "bus"] {
        let output = snakectl(folder.path(), &[verb, "--help"]);
        assert!(output.status.success() && String::from_utf8_lossy(&output.stdout).contains("Usage"));
    }
}
