//! MuJoCo as the judge: it loads the model, its joints are the snake's joints, and as a plant behind the protocol it moves as it should.
//! `tests/run` installs it in an environment of its own.
#![cfg(unix)]

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use common::{refuse, succeed};
use composer_host::external::{Elsewhere, External};
use composer_host::robot::Robot;
use composer_host::sim::{Scene, Snake};

/// Head x after ten seconds of the gait, units, under the law of contact, to which both simulators converge in first order. The plant with internal
/// steps of 1/500, 1/1000, 1/2000 s: -34.05, -34.14, -34.18; the simulator with steps of 1/100, 1/200, 1/400, 1/800 s: -34.03, -34.14, -34.19, -34.21.
const GAIT: f64 = -34.21;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().unwrap()
}

fn plant() -> String {
    root().join("sim-bridge/examples/mujoco_plant.py").display().to_string()
}

fn interpreter() -> String {
    // The test lies in target/release/deps.
    let test = std::env::current_exe().unwrap();
    let python = test.ancestors().nth(3).unwrap().join("mujoco-plant/bin/python");
    assert!(python.exists(), "{} is missing: tests/run installs it", python.display());
    python.display().to_string()
}

/// What a Python program prints, as JSON.
fn python(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let output = Command::new(interpreter()).current_dir(folder).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{arguments:?} printed {text:?}: {e}"))
}

fn gait(folder: &Path, more: &[&str]) -> f64 {
    let script = plant();
    python(folder, &[&[script.as_str(), "--gait", "--model", "m.xml"], more].concat())["head_x"].as_f64().unwrap()
}

#[test]
fn mujoco_loads_every_model() {
    let folder = tempfile::tempdir().unwrap();
    let script = "
import json, mujoco
m = mujoco.MjModel.from_xml_path('m.xml')
links = [b for b in range(m.nbody) if '.link' in m.body(b).name]
print(json.dumps(dict(nq=m.nq, nv=m.nv, nu=m.nu, pairs=m.npair, boxes=int((m.geom_type == mujoco.mjtGeom.mjGEOM_BOX).sum()),
    masses=[m.body_mass[b] for b in links], inertias=[i for b in links for i in m.body_inertia[b]],
    names=[m.body(b).name for b in links], joints=[m.joint(j).name for j in range(1, len(links))],
    pair=list(m.pair_friction[-1][:2]), gravity=m.opt.gravity[2], block=[float(m.body(b).mass[0]) for b in range(m.nbody) if m.body(b).name == 'block'])))
";
    for (arguments, modules, boxes, free) in [
        (&["--modules", "1"][..], 1, 0..=0, 0),
        (&["--motors"], 8, 0..=0, 0),
        (&["--modules", "64"], 64, 0..=0, 0),
        (&["--task", "block-pushing", "--seed", "3"], 8, 1..=1, 1),
        (&["--task", "tube-crossing"], 8, 3..=200, 0),
        (&["--task", "wall-climbing", "--modules", "10"], 10, 1..=1, 0),
    ] {
        succeed(folder.path(), &[&["mjcf", "-o", "m.xml"], arguments].concat());
        let m = python(folder.path(), &["-c", script]);
        let links = 4 * modules;
        let motors = if arguments == ["--motors"] { links - 1 } else { 0 };
        assert_eq!(
            (&m["nq"], &m["nv"]),
            (&(links + 6 + 7 * free).into(), &(links + 5 + 6 * free).into()),
            "{arguments:?}"
        );
        assert_eq!((&m["nu"], &m["pairs"]), (&motors.into(), &links.into()), "{arguments:?}");
        assert!(boxes.contains(&m["boxes"].as_u64().unwrap()), "{arguments:?}: {}", m["boxes"]);
        let all = |key: &str, number: f64| {
            let list = m[key].as_array().unwrap();
            !list.is_empty() && list.iter().all(|v| (v.as_f64().unwrap() - number).abs() < 1e-9)
        };
        assert!(all("masses", 0.00294) && all("inertias", 0.0152), "{arguments:?}: {m}");
        assert_eq!((&m["pair"], &m["gravity"]), (&serde_json::json!([0.1, 1.0]), &(-196.2).into()));
        assert_eq!(m["block"], if free == 1 { serde_json::json!([0.01]) } else { serde_json::json!([]) });
        assert_eq!(m["names"][5], if links > 4 { "module1.link1".into() } else { serde_json::Value::Null });
        assert_eq!(m["joints"][2], "module0.joint2");
    }
}

#[test]
fn its_joints_are_those_of_the_snake() {
    let folder = tempfile::tempdir().unwrap();
    succeed(folder.path(), &["mjcf", "-o", "m.xml"]);
    let script = "
import json, mujoco
m = mujoco.MjModel.from_xml_path('m.xml')
d = mujoco.MjData(m)
d.qpos[:] = json.load(open('q.json'))
mujoco.mj_kinematics(m, d)
print(json.dumps([d.xpos[b].tolist() + d.xquat[b].tolist() for b in range(1, m.nbody)]))
";
    let mut snake = Snake::new(&Robot::default());
    for round in 0..4 {
        for module in 0..8 {
            let bits = (module * 7 + round * 13) as f32;
            snake.set_torque(module, [80.0 * bits.sin(), 60.0 * (1.7 * bits + 1.0).sin()]);
        }
        (0..60).for_each(|_| snake.step());
        let (position, [x, y, z, w]) = snake.poses().next().unwrap();
        let mut q: Vec<f32> = [&position[..], &[w, x, y, z]].concat();
        q.extend((0..8).flat_map(|module| snake.sensors(module).joint_angles));
        // The last module's last joint does not exist.
        q.pop();
        assert!(q[7..].iter().any(|angle| angle.abs() > 0.2), "{q:?}");
        std::fs::write(folder.path().join("q.json"), serde_json::to_string(&q).unwrap()).unwrap();
        let poses = python(folder.path(), &["-c", script]);
        for (link, (position, [x, y, z, w])) in snake.poses().enumerate() {
            let theirs: Vec<f64> = poses[link].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).collect();
            let off = position.iter().zip(&theirs).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
            let same: f64 = [w, x, y, z].iter().zip(&theirs[3..]).map(|(a, b)| f64::from(*a) * b).sum();
            assert!(off < 1e-3 && same.abs() > 0.9999, "round {round}, link {link}: {off} {same}");
        }
    }
}

#[test]
fn the_gait_is_the_same_by_the_protocol_converged_and_not_that_of_its_own_contacts() {
    let folder = tempfile::tempdir().unwrap();
    succeed(folder.path(), &["mjcf", "-o", "m.xml"]);
    let converged = gait(folder.path(), &["--internal-step", "1/500"]);
    assert!((converged / GAIT - 1.0).abs() < 0.01, "{converged}");
    let own = gait(folder.path(), &["--own-contacts"]);
    assert!((own / GAIT - 0.70).abs() < 0.05, "{own}");

    // The same by the protocol.
    let robot = Robot { torque_slew: 400.0, physics_step: 0.01, ..Robot::default() };
    let command = format!("'{}' '{}' --internal-step 1/250 --imu", interpreter(), plant());
    let elsewhere = Elsewhere { address: command.parse().unwrap(), patience: Duration::from_secs(60) };
    let (mut external, mut snake) = External::start(&elsewhere, &robot, &Scene::default(), 1).unwrap();
    for step in 0..200 {
        wave(&mut snake, f64::from(step) * 0.01);
        external.step(&mut snake);
        assert!(external.trouble().is_none(), "{:?}", external.trouble());
    }
    let expected = gait(folder.path(), &["--internal-step", "1/250", "--torque-step", "0.01", "--seconds", "2"]);
    assert!((f64::from(snake.head()[0]) - expected).abs() < 1e-3, "{:?} {expected}", snake.head());
    // What the plant's IMU says is what the host works out from the motion.
    let (theirs, ours) = (external.sensors(&snake, 3), snake.sensors(3));
    let off = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(
        off(theirs.up, ours.up) < 1e-5 && off(theirs.angular_rate, ours.angular_rate) < 1e-3,
        "{theirs:?} {ours:?}"
    );
    assert!(ours.angular_rate[2].abs() > 0.05, "{ours:?}");
}

/// The gait's torques at this time, s.
fn wave(snake: &mut Snake, time: f64) {
    for module in 0..snake.robot().modules {
        let phase = std::f64::consts::TAU * time + 2.0 * module as f64;
        snake.set_torque(module, [(64.0 * phase.sin()) as f32, 0.0]);
    }
}

#[test]
fn the_simulator_moves_as_mujoco_does_under_the_same_law() {
    let folder = tempfile::tempdir().unwrap();
    succeed(folder.path(), &["mjcf", "-o", "m.xml"]);
    for (step, tolerance) in [(0.01, 0.01), (0.005, 0.005), (0.00125, 0.002)] {
        let robot = Robot { torque_slew: 400.0, physics_step: step, ..Robot::default() };
        let mut snake = Snake::new(&robot);
        for count in 0..(10.0 / f64::from(step)).round() as usize {
            wave(&mut snake, count as f64 * f64::from(step));
            snake.step();
        }
        let head = f64::from(snake.head()[0]);
        assert!((head / GAIT - 1.0).abs() < tolerance, "{step}: {head}");
    }
}

#[test]
fn a_plant_that_fails_ends_the_run_with_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let sil = |plant: &str, words: &[&str]| {
        let arguments = ["sil", "goal-reaching", "--episodes", "1", "--plant-timeout", "20", "--plant", plant];
        let complaint = refuse(folder.path(), &arguments, words);
        assert_eq!(complaint.lines().count(), 1, "{complaint}");
    };
    sil("no-such-plant", &["no-such-plant cannot be started", "no such program"]);
    sil("sh -c 'echo broken >&2; exit 4'", &["episode 1", "died", "exit status: 4", "broken"]);
    sil("sh -c 'echo good morning; sleep 9'", &["nonsense", "good morning"]);
    sil(&format!("'{}' '{}' --internal-step 3", interpreter(), plant()), &["died", "internal-step"]);
    refuse(folder.path(), &["sil", "goal-reaching", "--plant", "tcp:8.8.8.8:80"], &["another machine"]);
    refuse(folder.path(), &["sil", "goal-reaching", "--plant", "x", "--plant-timeout", "0"], &["--plant-timeout"]);
    refuse(folder.path(), &["mjcf", "--seed", "1"], &["--task"]);
    refuse(folder.path(), &["mjcf", "--modules", "65"], &["1 to 64"]);
    refuse(folder.path(), &["mjcf", "-o", "no/such/m.xml"], &["no/such"]);
    for (more, word) in [(&[][..], "--model"), (&["--model", "none.xml"], "none.xml")] {
        let output =
            Command::new(interpreter()).current_dir(folder.path()).arg(plant()).arg("--gait").args(more).output();
        let output = output.unwrap();
        let complaint = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !output.status.success() && complaint.contains(word) && !complaint.contains("Traceback"),
            "{complaint}"
        );
    }
}

#[test]
fn an_episode_on_the_bus_is_judged_and_repeats() {
    let folder = tempfile::tempdir().unwrap();
    let plant = format!("'{}' '{}' --internal-step 1/250", interpreter(), plant());
    let run = |fault: &str, replay: &str| {
        let arguments = [
            "sil",
            "goal-reaching",
            "--episodes",
            "1",
            "--json",
            "--fault",
            fault,
            "--plant",
            &plant,
            "--replay",
            replay,
        ];
        common::json(folder.path(), &arguments)
    };
    let mut report = run("none", "a.html");
    let steps = report["steps_mean"].as_f64().unwrap();
    assert!((10.0..=125.0).contains(&steps), "{report}");
    assert!(report["peak_joint_speed"].as_f64().unwrap() > 0.2, "the snake moves: {report}");
    let mut again = run("none", "a.html");
    for report in [&mut report, &mut again] {
        report["realtime_factor"].take();
    }
    assert_eq!(report, again);
    assert!(folder.path().join("a.html").exists());
    // A module that is dead is dead for the plant too.
    let still = run("action:8", "b.html");
    assert!(still["peak_joint_speed"].as_f64().unwrap() < 0.2, "{still}");
}
