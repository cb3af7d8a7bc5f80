//! A replay is one file that opens offline: checked in its text, and by opening it in a headless Chromium.

#[path = "common/browser.rs"]
mod chromium;

use std::fs;
use std::sync::Arc;

use chromium::{attribute, browser, open};
use composer_host::env::EnvConfig;
use composer_host::eval::{Trial, healthy};
use composer_host::policy::Random;
use composer_host::recorder;
use composer_host::replay::{
    Episode, FrameRecord, Look, Outline, Pose, Recording, Robot, Setting, Shape, Status, attention_bytes,
};
use composer_shared::policy::Task;

const PERIOD: f32 = 0.05;
const LINKS: usize = 4;

/// A goal to be reached, and nothing else there.
fn reaching() -> Setting {
    Setting {
        task: "Goal Reaching".into(),
        measure: "head to goal".into(),
        threshold: 1.0,
        goal_radius: 1.0,
        ..Setting::default()
    }
}

/// A snake that winds its way towards a goal at the left; `unplugged` loses its power half way.
fn episode(modules: usize, frames: usize, unplugged: usize) -> Episode {
    let (length, goal) = (0.5, [14.0, 7.0, 0.4]);
    // The head's path, sampled finely: a wave about a direction that turns slowly. The body follows in its track.
    let ds = 0.02;
    let before = (modules * LINKS) as f32 * length + 1.0;
    let ahead = frames as f32 * 0.15;
    let angle = |s: f32| 0.75 * (s * 0.9).sin() + 0.045 * s.max(0.0);
    let mut path = vec![[0.0f32; 3]];
    let samples = ((before + ahead) / ds) as usize;
    for i in 0..samples {
        let (s, last) = (i as f32 * ds - before, path[i]);
        path.push([last[0] + ds * angle(s).cos(), last[1] + ds * angle(s).sin(), 0.0]);
    }
    let shift = path[(before / ds) as usize];
    let mut episode = Episode::new(format!("goal ahead and left, {modules} modules"), reaching());
    for frame in 0..frames {
        let head = frame as f32 * 0.15;
        let at = |link: usize| {
            let s = head - link as f32 * length;
            let p = path[(((s + before) / ds) as usize).min(samples)];
            let half = angle(s) / 2.0;
            let lift = 0.4 + 0.12 * (1.0 + (s * 1.8 + head).sin()) * 0.5;
            Pose { position: [p[0] - shift[0], p[1] - shift[1], lift], rotation: [0.0, 0.0, half.sin(), half.cos()] }
        };
        let links: Vec<Pose> = (0..modules * LINKS).map(at).collect();
        let late = frame > frames / 2;
        let distance = (0..3).map(|a| (links[0].position[a] - goal[a]).powi(2)).sum::<f32>().sqrt();
        let mut status = vec![Status::Ok; modules];
        let mut torques: Vec<[f32; 2]> = (0..modules)
            .map(|m| {
                let phase = head - 1.3 * m as f32;
                [70.0 * phase.sin(), 25.0 * (2.0 * phase).cos()]
            })
            .collect();
        if late {
            status[unplugged] = Status::Unplugged;
            torques[unplugged] = [0.0; 2];
        }
        let mut weights = vec![0.0f32; modules * modules];
        for (i, row) in weights.chunks_mut(modules).enumerate() {
            let peak = (head * 0.35).min(modules as f32 - 1.0);
            for (j, w) in row.iter_mut().enumerate() {
                let heard = i == j || !(late && (i == unplugged || j == unplugged));
                let near = -(j as f32 - peak).powi(2) / 3.0;
                *w = if heard { (near + 0.8 * ((i * 3 + j * 5) as f32).sin()).exp() + 0.2 } else { 0.0 };
            }
            let sum: f32 = row.iter().sum();
            row.iter_mut().for_each(|w| *w /= sum);
        }
        episode.push(FrameRecord {
            time: frame as f32 * PERIOD,
            links,
            status,
            torques,
            goal: Some(goal),
            distance,
            attention: Some(attention_bytes(&weights)),
            moving: vec![],
        });
    }
    episode.event((frames / 2 + 1) as f32 * PERIOD, format!("module {unplugged} unplugged"));
    episode.note("outcome", "goal reached");
    episode.note("bearing", "ahead");
    episode
}

fn robot(modules: usize) -> Robot {
    Robot {
        modules,
        links_per_module: LINKS,
        link_length: 0.5,
        link_radius: 0.4,
        torque_limit: 80.0,
        metres_per_unit: 0.05,
    }
}

fn recording(modules: usize) -> Recording {
    let title = "Goal reaching over a simulated CAN-FD bus";
    let mut recording = Recording::new(title, robot(modules));
    recording.note("bus", "CAN-FD 1M/5M");
    recording.push(episode(modules, 110, modules * 3 / 8));
    recording.push(episode(modules, 61, 0));
    recording
}

#[test]
fn the_file_needs_nothing_from_outside() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    recording(8).write_html(&path).unwrap();
    let html = fs::read_to_string(&path).unwrap();
    for outside in ["http:", "https:", "src=", "href=", "url(", "@import", "fetch(", "XMLHttpRequest", "import("] {
        assert!(!html.contains(outside), "the page contains {outside}");
    }
    assert!(!html.contains("@RECORDING@") && !html.contains("@TITLE@"));
    assert!(html.len() < 250_000, "{} bytes", html.len());
}

#[test]
fn it_opens_in_a_browser() {
    let browser = browser();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    recording(8).write_html(&path).unwrap();

    let dom = open(&browser, &path, "#t=4");
    assert_eq!(attribute(&dom, "data-error"), Some(""));
    assert_eq!(attribute(&dom, "data-webgl"), None, "WebGL is there, but the page's shaders are refused");
    assert_eq!(attribute(&dom, "data-ready"), Some("true"));
    assert_eq!(attribute(&dom, "data-view"), Some("webgl2"), "drawn in 3D, by Chromium's software renderer if need be");
    assert_eq!((attribute(&dom, "data-frames"), attribute(&dom, "data-episodes")), (Some("110"), Some("2")));
    assert_eq!(attribute(&dom, "data-time"), Some("4.000"));
    assert_eq!(attribute(&dom, "data-fits"), Some("true"), "all of it is in view");
    let body = &dom[..dom.find("id=\"recording\"").unwrap()];
    assert!(body.contains("module 3: unplugged"), "the label in the scene");

    // The other episode, without WebGL, playing by itself.
    let dom = open(&browser, &path, "#episode=2&2d");
    assert_eq!(attribute(&dom, "data-error"), Some(""));
    assert_eq!(attribute(&dom, "data-view"), Some("2d"));
    assert_eq!(attribute(&dom, "data-frames"), Some("61"));
    let time: f32 = attribute(&dom, "data-time").unwrap().parse().unwrap();
    assert!(time > 0.0, "the page plays by itself");
}

#[test]
fn keys_wheel_and_hooks_drive_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    let html = recording(8).to_html().unwrap();
    let driver = "<script>
        const key = (k, shiftKey) => window.dispatchEvent(new KeyboardEvent('keydown', { key: k, shiftKey }));
        __replay.setEpisode(1);
        for (const k of 'tfpnrtfpn') { key(k); __replay.seek(1.5); }
        document.getElementById('view').dispatchEvent(new WheelEvent('wheel', { deltaY: 120, cancelable: true }));
        key('Home'); key('ArrowRight'); key('ArrowRight'); key('ArrowLeft'); key('ArrowRight', true);
        document.body.dataset.after = [__replay.ready, __replay.frames, __replay.episodes, __replay.time.toFixed(2)];
        key(','); key('End'); __replay.seek(__replay.time);
    </script></body>";
    fs::write(&path, html.replacen("</body>", driver, 1)).unwrap();
    let dom = open(&browser(), &path, "#pause");
    assert_eq!(attribute(&dom, "data-error"), Some(""));
    assert!(dom.contains("data-after=\"true,61,2,1.05\""), "one step of 0.05 s and one second from the start");
    assert_eq!((attribute(&dom, "data-frames"), attribute(&dom, "data-time")), (Some("110"), Some("5.450")));
}

#[test]
fn a_damaged_file_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    let html = recording(2).to_html().unwrap();
    fs::write(&path, html.replacen("\"format\":2", "\"format\":9", 1)).unwrap();
    let dom = open(&browser(), &path, "");
    assert_eq!(attribute(&dom, "data-ready"), Some("false"));
    assert!(dom.contains("This replay cannot be shown: Uncaught Error: its format 9 is not known"));
}

/// One page with an episode of every task, as the simulator records them, for a random policy.
fn every_task() -> Recording {
    let config = |task| {
        let mut config = EnvConfig::new(task, composer_host::robot::Robot::default());
        config.task.settings.cap = 20;
        Arc::new(config)
    };
    let mut recording = recorder::recording(&config(Task::GoalReaching), "Every task", "random");
    for task in Task::ALL {
        let config = config(task);
        let trial = Trial { config: &config, episodes: 1, seed: 1, faults: &healthy, threads: 1 };
        recorder::record(&trial, &Random, 1).into_iter().for_each(|episode| recording.push(episode));
    }
    recording
}

#[test]
fn every_tasks_scene_opens() {
    let browser = browser();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    every_task().write_html(&path).unwrap();
    let words =
        ["goal not reached", "block not at the goal", "shape not formed", "not through the tube", "not over the wall"];
    for (index, (task, words)) in Task::ALL.into_iter().zip(words).enumerate() {
        for view in ["", "&top", "&2d"] {
            let dom = open(&browser, &path, &format!("#t=0.5&pause&episode={}{view}", index + 1));
            let state = (attribute(&dom, "data-error"), attribute(&dom, "data-ready"), attribute(&dom, "data-fits"));
            assert_eq!(state, (Some(""), Some("true"), Some("true")), "{task}{view}");
            let body = &dom[..dom.find("id=\"recording\"").unwrap()];
            assert!(body.contains(&format!("{}, 8 modules", task.title())) && body.contains(words), "{task}{view}");
            // Labels in the scene, as far as they are shown.
            let shown = |class: &str| body.matches(&format!("class=\"{class}\"")).count();
            assert_eq!(shown("goal"), usize::from(task != Task::ShapeFormation), "{task}{view}");
            assert_eq!(shown("num want"), if task == Task::ShapeFormation { 8 } else { 0 }, "{task}{view}");
            assert_eq!(shown("mark"), if task == Task::TubeCrossing { 2 } else { 0 }, "{task}{view}");
        }
    }
}

/// A block that is pushed aside between a wall, a tube, a post and a wanted place; no goal, no attention, all relaxed.
fn scene(modules: usize) -> Recording {
    let shapes = [
        (Outline::Box { half: [0.5, 4.0, 2.0] }, Look::Solid, false, "wall"),
        (Outline::Box { half: [0.2, 40.0, 1.0] }, Look::Glass, false, ""),
        (Outline::Tube { radius: 1.2, half_length: 3.0 }, Look::Glass, false, ""),
        (Outline::Box { half: [1.0; 3] }, Look::Solid, true, "block"),
        (Outline::Cylinder { radius: 0.5, half_length: 1.0 }, Look::Solid, false, ""),
        (Outline::Sphere { radius: 1.0 }, Look::Wanted, false, "0"),
    ];
    let scene = shapes.map(|(outline, look, moves, label)| {
        let pose = Pose::at([6.0, -6.0, 1.0]);
        Shape { outline, pose, look, moves, label: label.into() }
    });
    let setting = Setting { task: "Block Pushing".into(), scene: scene.into(), ..Setting::default() };
    let mut recording = Recording::new("A scene", robot(modules));
    let mut episode = Episode::new("pushed", setting);
    for i in 0..2 {
        episode.push(FrameRecord {
            time: i as f32,
            links: (0..modules * LINKS).map(|k| Pose::at([-0.5 * k as f32, 0.0, 0.4])).collect(),
            status: vec![Status::Relaxed; modules],
            torques: vec![[0.0; 2]; modules],
            distance: f32::NAN,
            moving: vec![Pose::at([2.0, i as f32, 1.0])],
            ..FrameRecord::default()
        });
    }
    recording.push(episode);
    recording
}

#[test]
fn robots_of_other_sizes_and_scenes_open_too() {
    let browser = browser();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("replay.html");
    for (recording, hash) in [(recording(1), ""), (recording(64), ""), (scene(3), "&2d"), (scene(3), "&top")] {
        recording.write_html(&path).unwrap();
        let dom = open(&browser, &path, &format!("#t=0.5{hash}"));
        assert_eq!((attribute(&dom, "data-error"), attribute(&dom, "data-ready")), (Some(""), Some("true")));
        assert_eq!((attribute(&dom, "data-time"), attribute(&dom, "data-fits")), (Some("0.500"), Some("true")));
    }
}
