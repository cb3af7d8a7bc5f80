//! From control cycles on the bus to a replay.

use composer_shared::wire::Mode;
use composer_sim_bridge::faults::{Fault, ScheduledFault};
use composer_sim_bridge::sil::{CycleView, ModuleView, SilReport};

use crate::env::EnvConfig;
use crate::eval;
use crate::replay::{Episode, FrameRecord, Pose, Recording, Robot, Status};
use crate::sil::SnakePlant;

/// An empty recording of snakes in this environment.
pub fn recording(config: &EnvConfig, policy: &str) -> Recording {
    let robot = &config.robot;
    let robot = Robot {
        modules: robot.modules,
        links_per_module: robot.links_per_module,
        link_length: robot.link_length,
        link_radius: robot.link_radius,
        torque_limit: robot.torque_limit,
        metres_per_unit: robot.scale.metres_per_unit,
    };
    let mut recording = Recording::new(
        "COMPOSER on the simulated bus",
        config.task.task().title(),
        robot,
        config.task.rules().goal_radius(),
    );
    recording.note("policy", policy);
    recording
}

/// Records one episode, a frame a control cycle.
pub struct Recorder {
    episode: Episode,
    faults: Vec<ScheduledFault>,
    time_keeper: Option<u8>,
}

impl Recorder {
    /// Begins with the plant as it is.
    pub fn new(name: &str, plant: &SnakePlant, faults: &[ScheduledFault]) -> Self {
        let mut recorder = Recorder { episode: Episode::new(name), faults: faults.to_vec(), time_keeper: None };
        for scheduled in faults {
            recorder.episode.event((scheduled.at_ns as f64 * 1e-9) as f32, describe(&scheduled.fault));
            if let Some(until) = scheduled.until_ns {
                recorder.episode.event((until as f64 * 1e-9) as f32, format!("{} ends", describe(&scheduled.fault)));
            }
        }
        let modules = plant.snake().robot().modules;
        recorder.push(0.0, plant, vec![Status::Ok; modules], None);
        recorder
    }

    fn push(&mut self, time: f32, plant: &SnakePlant, status: Vec<Status>, attention: Option<Vec<u8>>) {
        let links = plant.snake().poses().map(|(position, rotation)| Pose { position, rotation }).collect();
        let modules = plant.snake().robot().modules;
        self.episode.push(FrameRecord {
            time,
            links,
            status,
            torques: (0..modules).map(|m| plant.snake().torque(m)).collect(),
            goal: Some(plant.judge().course().goal),
            distance: plant.judge().verdict().distance,
            attention,
            ..FrameRecord::default()
        });
    }

    fn status(&self, module: usize, view: &ModuleView, now_ns: u64) -> Status {
        if !view.plugged {
            return Status::Unplugged;
        }
        let hit = |wanted: fn(&Fault) -> Option<usize>| {
            self.faults.iter().any(|f| f.active(now_ns) && wanted(&f.fault) == Some(module))
        };
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

    /// The end of a control cycle.
    pub fn cycle(&mut self, cycle: &CycleView<'_>, plant: &SnakePlant) {
        let modules = cycle.modules.len();
        let status = (0..modules).map(|m| self.status(m, &cycle.modules[m], cycle.at_ns)).collect();
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
        self.push(time, plant, status, Some(crate::replay::attention_bytes(&weights)));
    }

    /// The episode with its result.
    pub fn finish(mut self, result: &eval::Episode, report: &SilReport) -> Episode {
        self.episode.note("result", if result.success { "goal reached" } else { "goal not reached" });
        self.episode.note("control steps", result.steps.to_string());
        self.episode.note("distance at the end", format!("{:.2} units", result.distance));
        self.episode.note("bus load", format!("{:.1} %", 100.0 * report.bus_load));
        self.episode
    }
}

/// A fault in words.
pub fn describe(fault: &Fault) -> String {
    match *fault {
        Fault::Unplug(m) => format!("module {m} unplugged"),
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
