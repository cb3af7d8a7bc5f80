//! From episodes, on the bus or in the simulator, to a replay.

use composer_shared::policy::Task;
use composer_shared::wire::Mode;
use composer_sim_bridge::faults::{Fault, ScheduledFault};
use composer_sim_bridge::sil::{CycleView, ModuleView, SilReport};

use crate::env::{EnvConfig, FaultsNow, SnakeEnv};
use crate::environment::{Environment, View};
use crate::eval::{Trial, episode_seed};
use crate::methods::mix;
use crate::outcome;
use crate::policy::{Memories, Policy};
use crate::replay::{Episode, FrameRecord, Look, Outline, Pose, Recording, Robot, Setting, Shape, Status};
use crate::sil::SnakePlant;
use crate::sim::Snake;
use crate::tasks::{Course, Judge, TaskConfig};

/// An empty recording of snakes like the one in this environment.
pub fn recording(config: &EnvConfig, title: &str, policy: &str) -> Recording {
    let robot = &config.robot;
    let robot = Robot {
        modules: robot.modules,
        links_per_module: robot.links_per_module,
        link_length: robot.link_length,
        link_radius: robot.link_radius,
        torque_limit: robot.torque_limit,
        metres_per_unit: robot.scale.metres_per_unit,
    };
    let mut recording = Recording::new(title, robot);
    recording.note("policy", policy);
    recording
}

/// What the page shows of a course.
pub(crate) fn setting(task: &TaskConfig, course: &Course, link_radius: f32) -> Setting {
    let rules = task.rules();
    let shape = |outline, pose, look| Shape { outline, pose, look, moves: false, label: String::new() };
    let look = if task.task() == Task::TubeCrossing { Look::Glass } else { Look::Solid };
    let mut scene: Vec<Shape> = course
        .scene
        .solids
        .iter()
        .map(|solid| {
            let pose = Pose { position: solid.position, rotation: solid.rotation() };
            shape(Outline::Box { half: solid.half }, pose, look)
        })
        .collect();
    scene.extend(course.scene.block.map(|block| Shape {
        moves: true,
        ..shape(Outline::Box { half: block.half }, Pose::at(block.position), Look::Solid)
    }));
    let mark = |position, radius, label: &str| Shape {
        label: label.into(),
        ..shape(Outline::Sphere { radius }, Pose::at(position), Look::Wanted)
    };
    match task.task() {
        Task::ShapeFormation => {
            scene.extend(course.marks.iter().enumerate().map(|(m, target)| mark(*target, link_radius, &m.to_string())));
        }
        Task::TubeCrossing => {
            let ends = [course.marks.first(), course.marks.last()];
            scene.extend(ends.into_iter().flatten().zip(["entrance", "exit"]).map(|(p, word)| mark(*p, 0.15, word)));
        }
        _ => {}
    }
    Setting {
        task: task.task().title().into(),
        measure: rules.words().measure.into(),
        threshold: rules.threshold(),
        goal_radius: rules.goal_radius(),
        scene,
    }
}

/// Records one episode, a frame a control cycle.
pub struct Recorder {
    episode: Episode,
    task: TaskConfig,
    time_keeper: Option<u8>,
}

impl Recorder {
    /// Begins with the plant as it is.
    pub fn new(name: &str, plant: &SnakePlant, faults: &[ScheduledFault]) -> Self {
        Recorder::begin(name, &plant.config().task, plant.snake(), plant.judge(), faults)
    }

    fn begin(name: &str, task: &TaskConfig, snake: &Snake, judge: &Judge, faults: &[ScheduledFault]) -> Self {
        let modules = snake.robot().modules;
        let mut recorder = Recorder {
            episode: Episode::new(name, setting(task, judge.course(), snake.robot().link_radius)),
            task: task.clone(),
            time_keeper: None,
        };
        for scheduled in faults {
            recorder.episode.event((scheduled.at_ns as f64 * 1e-9) as f32, describe(&scheduled.fault));
            if let Some(until) = scheduled.until_ns {
                recorder.episode.event((until as f64 * 1e-9) as f32, format!("{} ends", describe(&scheduled.fault)));
            }
        }
        recorder.push(0.0, snake, judge, vec![Status::Ok; modules], None);
        recorder
    }

    fn push(&mut self, time: f32, snake: &Snake, judge: &Judge, status: Vec<Status>, attention: Option<Vec<u8>>) {
        let pose = |(position, rotation)| Pose { position, rotation };
        // The targets of a shape say more than their middle does.
        let goal = (self.task.task() != Task::ShapeFormation).then_some(judge.course().goal);
        self.episode.push(FrameRecord {
            time,
            links: snake.poses().map(pose).collect(),
            status,
            torques: (0..snake.robot().modules).map(|m| snake.torque(m)).collect(),
            goal,
            distance: judge.verdict().distance,
            attention,
            moving: snake.block().map(pose).into_iter().collect(),
        });
    }

    /// The end of a control cycle.
    pub fn cycle(&mut self, cycle: &CycleView<'_>, plant: &SnakePlant) {
        let modules = cycle.modules.len();
        let status = (0..modules).map(|m| module_status(m, &cycle.modules[m], cycle.faults)).collect();
        let weights: Vec<f32> = cycle
            .modules
            .iter()
            .flat_map(|view| {
                view.attention[..modules].iter().map(|&w| if view.plugged { f32::from(w) / 32767.0 } else { 0.0 })
            })
            .collect();
        let time = (cycle.at_ns as f64 * 1e-9) as f32;
        // The clock that most modules follow.
        let keeper = cycle.modules.iter().filter(|m| m.plugged).find_map(|m| m.time_keeper);
        if let (Some(before), Some(now)) = (self.time_keeper, keeper)
            && before != now
        {
            self.episode.event(time, format!("module {now} keeps the time now"));
        }
        self.time_keeper = keeper.or(self.time_keeper);
        let attention = Some(crate::replay::attention_bytes(&weights));
        self.push(time, plant.snake(), plant.judge(), status, attention);
    }

    /// The episode on the bus with its result.
    pub fn finish(mut self, result: &outcome::Episode, report: &SilReport) -> Episode {
        self.conclude(result);
        self.episode.note("bus load", format!("{:.1} %", 100.0 * report.bus_load));
        self.episode
    }

    fn conclude(&mut self, result: &outcome::Episode) {
        let words = self.task.rules().words();
        self.episode.note("result", if result.success { words.done } else { words.missed });
        self.episode.note("control steps", result.steps.to_string());
        self.episode.note("distance at the end", format!("{:.2} units", result.distance));
    }
}

/// What a module is able to do, with these faults active.
pub(crate) fn module_status(module: usize, view: &ModuleView, faults: &[Fault]) -> Status {
    if !view.plugged {
        return Status::Unplugged;
    }
    let hit = |wanted: fn(&Fault) -> Option<usize>| faults.iter().any(|fault| wanted(fault) == Some(module));
    if hit(|f| if let Fault::ActuatorDead(m) = f { Some(*m) } else { None }) {
        Status::ActuatorDead
    } else if hit(|f| match f {
        Fault::SensorZeroed(m) | Fault::SensorStuck(m) => Some(*m),
        _ => None,
    }) {
        Status::SensorFault
    } else if matches!(view.mode, Mode::Active | Mode::Alone) {
        Status::Ok
    } else {
        Status::Relaxed
    }
}

/// Runs the first `count` episodes of a trial again and records them.
pub fn record(trial: &Trial, policy: &dyn Policy, count: usize) -> Vec<Episode> {
    let mut env = SnakeEnv::new(trial.config.clone());
    let record = |index: usize| {
        let seed = episode_seed(trial.seed, index as u64);
        let faults = (trial.faults)(seed, trial.config.robot.modules);
        simulate(trial.config, &mut env, policy, &format!("episode {}", index + 1), seed, &faults)
    };
    (0..count.min(trial.episodes)).map(record).collect()
}

/// Runs and records one episode without a bus; the same as [`crate::eval::run_episode`].
pub fn simulate(
    config: &EnvConfig,
    env: &mut SnakeEnv,
    policy: &dyn Policy,
    name: &str,
    seed: u64,
    faults: &[ScheduledFault],
) -> Episode {
    env.reset_with(seed, faults);
    let mut recorder = Recorder::begin(name, &config.task, env.snake(), env.judge(), faults);
    let (mut view, mut actions, modules) = (View::default(), Vec::new(), env.modules());
    let mut memories = Memories::default();
    for step in 0u64.. {
        let mut weights = Vec::new();
        env.view(&mut view);
        policy.act(&view, mix(seed ^ step), &mut memories, &mut actions, Some(&mut weights));
        let hit = env.faults();
        let outcome = env.step(&actions);
        let time = outcome.steps as f32 * config.control_period;
        let status = (0..modules).map(|module| simulated_status(&hit, module)).collect();
        let attention = weights.iter().any(|w| *w > 0.0).then(|| {
            for (module, row) in weights.chunks_mut(modules).enumerate() {
                if hit.gone >> module & 1 == 1 {
                    row.fill(0.0);
                }
            }
            crate::replay::attention_bytes(&weights)
        });
        recorder.push(time, env.snake(), env.judge(), status, attention);
        if outcome.terminated || outcome.truncated {
            break;
        }
    }
    recorder.conclude(&outcome::Episode::new(env.judge(), env.snake()));
    recorder.episode
}

fn simulated_status(hit: &FaultsNow, module: usize) -> Status {
    let of = |set: u64| set >> module & 1 == 1;
    if of(hit.gone) {
        Status::Unplugged
    } else if of(hit.weak) {
        Status::ActuatorDead
    } else if of(hit.blind) {
        Status::SensorFault
    } else {
        Status::Ok
    }
}

/// A fault in words.
pub fn describe(fault: &Fault) -> String {
    match *fault {
        Fault::Unplug(m) => format!("module {m} unplugged"),
        Fault::BrownOut(m) => format!("supply of module {m} breaks in"),
        Fault::ActuatorDead(m) => format!("module {m}'s motors dead"),
        Fault::SensorZeroed(m) => format!("module {m}'s sensors read zero"),
        Fault::SensorStuck(m) => format!("module {m}'s sensors stuck"),
        Fault::Babble(m, id) => format!("module {m} babbles with identifier {id:#05x}"),
        Fault::Cut(m) => format!("cable cut behind module {m}"),
        Fault::Drop(p) => format!("{:.1} % of frames lost", 100.0 * p),
        Fault::Delay(ns) => format!("frames up to {:.1} ms late", ns as f64 * 1e-6),
        Fault::Corrupt(p) => format!("{:.1} % of frames corrupted", 100.0 * p),
        Fault::Misread(m, p) => format!("module {m} misreads {:.1} % of frames", 100.0 * p),
        Fault::Duplicate(p) => format!("{:.1} % of frames doubled", 100.0 * p),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::eval::{healthy, run_episode};
    use crate::policy::Random;
    use crate::robot::Robot;

    fn config(task: Task, cap: u32) -> Arc<EnvConfig> {
        let mut config = EnvConfig::new(task, Robot::default());
        config.task.settings.cap = cap;
        Arc::new(config)
    }

    #[test]
    fn every_tasks_scene_is_recorded_and_the_episode_is_the_evaluated_one() {
        for task in Task::ALL {
            let config = config(task, 12);
            let trial = Trial { config: &config, episodes: 2, seed: 3, faults: &healthy, threads: 1 };
            let episodes = record(&trial, &Random, 5);
            assert_eq!(episodes.len(), 2);
            for (index, episode) in episodes.iter().enumerate() {
                let mut env = SnakeEnv::new(config.clone());
                run_episode(&mut env, &Random, episode_seed(3, index as u64), &[], |_, _| {});
                let last = episode.frames().last().unwrap();
                assert_eq!(episode.len(), 13);
                assert!(last.links.iter().map(|pose| (pose.position, pose.rotation)).eq(env.snake().poses()), "{task}");
                assert_eq!(last.moving.first().map(|pose| (pose.position, pose.rotation)), env.snake().block());
                assert_eq!(last.distance, env.judge().verdict().distance);
                let (scene, course) = (&episode.setting().scene, env.judge().course());
                let marks = match task {
                    Task::ShapeFormation => 8,
                    Task::TubeCrossing => 2,
                    _ => 0,
                };
                let things = course.scene.solids.len() + usize::from(course.scene.block.is_some());
                assert_eq!(scene.len(), things + marks, "{task}");
                assert_eq!(things, [0, 1, 0, 40, 1][task as usize], "{task}");
            }
            let mut recording = recording(&config, "x", "random");
            episodes.into_iter().for_each(|episode| recording.push(episode));
            let page = recording.to_html().unwrap();
            assert!(page.contains(task.title()) && page.contains(config.task.rules().words().missed), "{task}");
        }
    }

    #[test]
    fn what_is_hit_shows_in_the_frames() {
        let config = config(Task::GoalReaching, 12);
        let scheduled = |at_ns, fault| ScheduledFault { at_ns, until_ns: None, fault };
        let faults = [scheduled(200_000_000, Fault::Unplug(2)), scheduled(0, Fault::ActuatorDead(5))];
        let episode = simulate(&config, &mut SnakeEnv::new(config.clone()), &Random, "hit", 1, &faults);
        let status = |frame: usize, module: usize| episode.frames()[frame].status[module];
        assert_eq!((status(1, 5), status(4, 2), status(5, 2)), (Status::ActuatorDead, Status::Ok, Status::Unplugged));
        assert_eq!(episode.frames()[12].torques[2], [0.0; 2]);
    }

    #[test]
    fn in_the_replay_no_link_passes_the_wall_through_its_face() {
        let mut config = EnvConfig::new(Task::WallClimbing, Robot::default());
        config.task.rules.wall_climbing.wall_height = [0.8, 1.0];
        let mut over = 0;
        // A wave that drives the snake into the wall, and another that lifts it: its frequency in Hz and its lag from module to module.
        for (seed, (frequency, lag)) in
            [(0.3, 2.5), (0.6, 1.1), (1.2, 0.0)].into_iter().flat_map(|w| (0..6).map(move |s| (s, w)))
        {
            let (mut snake, judge) = Judge::start(&config.task, seed, &config.robot);
            let mut recorder = Recorder::begin("driven", &config.task, &snake, &judge, &[]);
            for step in 0..125u32 {
                for module in 0..config.robot.modules {
                    let (turns, m) = (std::f32::consts::TAU * 0.05 * step as f32, module as f32);
                    let yaw = libm::sinf(0.6 * turns - 1.1 * m);
                    let pitch = libm::sinf(frequency * turns - lag * m);
                    snake.set_torque(module, [80.0 * yaw, 80.0 * pitch]);
                }
                (0..config.substeps()).for_each(|_| snake.step());
                recorder.push(0.05 * (step + 1) as f32, &snake, &judge, vec![Status::Ok; 8], None);
            }
            let wall = &recorder.episode.setting().scene[0];
            let Outline::Box { half } = wall.outline else { panic!("the wall is a box") };
            let [.., sin, cos] = wall.pose.rotation;
            let normal = [cos * cos - sin * sin, 2.0 * sin * cos];
            let along =
                |p: [f32; 3]| (p[0] - wall.pose.position[0]) * normal[0] + (p[1] - wall.pose.position[1]) * normal[1];
            for frames in recorder.episode.frames().windows(2) {
                for (a, b) in frames[0].links.iter().zip(&frames[1].links) {
                    let (from, to) = (along(a.position), along(b.position));
                    over += u32::from(to > half[0]);
                    for face in [-half[0], half[0]] {
                        if (from < face) != (to < face) {
                            let share = (face - from) / (to - from);
                            let height = a.position[2] + share * (b.position[2] - a.position[2]);
                            assert!(height > 2.0 * half[2], "seed {seed}: through the face at {height}");
                        }
                    }
                }
            }
        }
        assert!(over > 0, "no link ever got over the wall: the test shows nothing");
    }
}
