//! The snake as an environment: rapier physics, a task, faults, and what each module can know of it.
//!
//! One control step does what the modules do on the bus ([`composer_firmware::controller`]): sample the sensors, hear everybody's
//! joint angles (as the STATE frame rounds them), lay out the chain, observe, act, clamp and slew the torque. The torque takes effect
//! one or more physics steps after the sample, as it does on a bus.

use std::sync::Arc;

use composer_shared::kinematics::Chain;
use composer_shared::observation::{self, Sensors};
use composer_shared::policy::GoalKnownTo;
use composer_shared::robot::Limits;
use composer_shared::wire;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::environment::{Environment, Outcome, PRIVILEGED, View};
use crate::robot::Robot;
use crate::sim::{Motion, Snake};
use crate::tasks::goal_reaching::GoalReaching;

/// Something wrong with one module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModuleFault {
    /// Its motors give no torque (paper: corrupted action).
    Action,
    /// Its sensors read zero (paper: corrupted observation).
    Observation,
    /// Gone from this control step on: no messages, no torque.
    Unplugged {
        /// The control step.
        at: u32,
    },
}

/// Faults that training draws for each episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultTraining {
    /// Share of episodes with a fault.
    pub probability: f32,
    /// Most modules hit in one episode; the number is drawn evenly from 1 to this.
    pub most: usize,
    /// Relative weights of the kinds: action, observation, unplugged.
    pub weights: [f32; 3],
    /// Share of a module's latents that its neighbours miss, drawn anew each step (frames lost or late).
    pub missed_latents: f32,
}

impl Default for FaultTraining {
    fn default() -> Self {
        FaultTraining { probability: 0.0, most: 2, weights: [1.0, 1.0, 2.0], missed_latents: 0.0 }
    }
}

impl FaultTraining {
    /// Draws the faults of an episode: (module, fault).
    fn draw(&self, rng: &mut ChaCha8Rng, modules: usize) -> Vec<(usize, ModuleFault)> {
        if rng.random::<f32>() >= self.probability || modules < 2 {
            return Vec::new();
        }
        let count = rng.random_range(1..=self.most.clamp(1, modules - 1));
        let mut order: Vec<usize> = (0..modules).collect();
        order.shuffle(rng);
        let total: f32 = self.weights.iter().sum();
        let mut pick = rng.random::<f32>() * total;
        let kind = self.weights.iter().position(|w| {
            pick -= w;
            pick < 0.0
        });
        let fault = |rng: &mut ChaCha8Rng| match kind {
            Some(0) => ModuleFault::Action,
            Some(1) => ModuleFault::Observation,
            // Half of them from the start: those episodes teach most about living without the module.
            _ => ModuleFault::Unplugged { at: if rng.random() { 0 } else { rng.random_range(1..60) } },
        };
        order.into_iter().take(count).map(|m| (m, fault(rng))).collect()
    }
}

/// Everything that defines the environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvConfig {
    /// The robot.
    pub robot: Robot,
    /// The task.
    pub task: GoalReaching,
    /// Who is told the goal.
    pub goal_known_to: GoalKnownTo,
    /// Control period, s.
    pub control_period: f32,
    /// Physics steps between sampling the sensors and the new torque, least and most; drawn for each episode.
    pub delay: [usize; 2],
    /// Faults drawn in training.
    pub faults: FaultTraining,
}

impl EnvConfig {
    /// The default task on a robot: 0.05 s control period, a torque one physics step after the sample, no faults.
    pub fn new(robot: Robot) -> Self {
        EnvConfig {
            robot,
            task: GoalReaching::default(),
            goal_known_to: GoalKnownTo::All,
            control_period: 0.05,
            delay: [1, 1],
            faults: FaultTraining::default(),
        }
    }

    /// Physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.control_period / self.robot.physics_step).round().max(1.0) as usize
    }
}

/// The state of one episode.
pub struct SnakeEnv {
    config: Arc<EnvConfig>,
    limits: Limits,
    relax: f32,
    snake: Snake,
    goal: [f32; 3],
    faults: Vec<Option<ModuleFault>>,
    chain: Chain,
    sensors: Vec<Sensors>,
    command: Vec<[f32; 2]>,
    heard: Vec<u64>,
    delay: usize,
    steps: u32,
    distance: f32,
    episode_return: f32,
    low_steps: u32,
    rng: ChaCha8Rng,
}

impl SnakeEnv {
    /// An environment, reset with seed 0.
    pub fn new(config: Arc<EnvConfig>) -> Self {
        let snake = Snake::new(&config.robot);
        let modules = config.robot.modules;
        let mut env = SnakeEnv {
            limits: config.robot.limits(),
            relax: libm::expf(-config.control_period / config.robot.relax_seconds()),
            goal: [0.0; 3],
            faults: vec![None; modules],
            chain: Chain::new(config.robot.geometry()),
            sensors: vec![Sensors::ZERO; modules],
            command: vec![[0.0; 2]; modules],
            heard: vec![0; modules],
            delay: 1,
            steps: 0,
            distance: 0.0,
            episode_return: 0.0,
            low_steps: 0,
            rng: ChaCha8Rng::seed_from_u64(0),
            snake,
            config,
        };
        env.reset(0);
        env
    }

    /// Starts an episode with given faults instead of drawn ones.
    pub fn reset_with(&mut self, seed: u64, faults: &[(usize, ModuleFault)]) {
        let config = self.config.clone();
        self.snake = Snake::new(&config.robot);
        self.goal = config.task.goal(seed, config.robot.link_radius);
        self.rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed_fa17);
        self.faults.fill(None);
        for &(module, fault) in faults {
            self.faults[module] = Some(fault);
        }
        self.delay = self.rng.random_range(config.delay[0]..=config.delay[1]).min(config.substeps() - 1);
        self.chain = Chain::new(config.robot.geometry());
        self.command.fill([0.0; 2]);
        self.steps = 0;
        self.episode_return = 0.0;
        self.low_steps = 0;
        self.distance = self.measure();
        self.sample();
    }

    fn measure(&self) -> f32 {
        let [x, y, z] = self.snake.in_head_frame(self.goal);
        libm::sqrtf(x * x + y * y + z * z)
    }

    fn gone(&self, module: usize) -> bool {
        matches!(self.faults[module], Some(ModuleFault::Unplugged { at }) if at <= self.steps)
    }

    /// Samples the sensors and lets everybody hear everybody, as one control cycle on the bus does.
    fn sample(&mut self) {
        let modules = self.config.robot.modules;
        let mut speaking = 0u64;
        for module in 0..modules {
            self.sensors[module] = match self.faults[module] {
                Some(ModuleFault::Observation) => Sensors::ZERO,
                _ => self.snake.sensors(module),
            };
            if self.gone(module) || !self.sensors[module].plausible() {
                self.chain.miss(module, self.relax);
            } else {
                speaking |= 1 << module;
                self.chain.hear(module, &self.sensors[module].joint_angles.map(wire::quantise_angle));
            }
        }
        let missed = self.config.faults.missed_latents;
        for module in 0..modules {
            let mut heard = speaking;
            if missed > 0.0 {
                for other in 0..modules {
                    if self.rng.random::<f32>() < missed {
                        heard &= !(1 << other);
                    }
                }
            }
            self.heard[module] = heard | (1 << module);
        }
    }

    /// The goal in the world.
    pub fn goal(&self) -> [f32; 3] {
        self.goal
    }

    /// The snake.
    pub fn snake(&self) -> &Snake {
        &self.snake
    }

    /// The faults of this episode, a module each.
    pub fn faults(&self) -> &[Option<ModuleFault>] {
        &self.faults
    }

    /// Distance of the head to the goal now.
    pub fn distance(&self) -> f32 {
        self.distance
    }

    /// Control steps whose highest link centre stayed below two link diameters.
    pub fn low_steps(&self) -> u32 {
        self.low_steps
    }

    /// Extremes of the motion in this episode.
    pub fn motion(&self) -> Motion {
        self.snake.motion()
    }
}

impl Environment for SnakeEnv {
    fn modules(&self) -> usize {
        self.config.robot.modules
    }

    fn reset(&mut self, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xfa17);
        let faults = self.config.faults.draw(&mut rng, self.config.robot.modules);
        self.reset_with(seed, &faults);
    }

    fn view(&self, view: &mut View) {
        let modules = self.modules();
        view.observations.clear();
        view.privileged.clear();
        view.acts.clear();
        view.heard.clone_from(&self.heard);
        // As the GOAL frame rounds it.
        let goal = wire::Goal::new(0, Some(self.snake.in_head_frame(self.goal))).position();
        for module in 0..modules {
            let head = self.chain.head_seen_from(module);
            let told = self.config.goal_known_to == GoalKnownTo::All || module == 0;
            let place = observation::place(module, modules);
            view.observations.push(observation::observe(
                &self.sensors[module],
                place,
                &head,
                goal.filter(|_| told).map(Into::into),
            ));
            let (velocity, height) = self.snake.privileged(module);
            let true_goal = self.snake.in_own_frame(module, self.goal);
            let fault = self.faults[module];
            let mut p = [0.0; PRIVILEGED];
            for axis in 0..3 {
                p[axis] = velocity[axis] / 5.0;
                p[3 + axis] = true_goal[axis] / 10.0;
            }
            p[6] = height;
            p[7] = libm::logf(1.0 + self.distance);
            p[8] = f32::from(u8::from(self.gone(module)));
            p[9] = f32::from(u8::from(fault == Some(ModuleFault::Action)));
            p[10] = f32::from(u8::from(fault == Some(ModuleFault::Observation)));
            p[11] = self.delay as f32;
            view.privileged.push(p);
            view.acts.push(!self.gone(module));
        }
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        for module in 0..self.modules() {
            if self.gone(module) {
                self.command[module] = [0.0; 2];
                self.snake.set_torque(module, [0.0; 2]);
            } else {
                for axis in 0..2 {
                    let previous = self.command[module][axis];
                    self.command[module][axis] =
                        self.limits.command(previous, actions[module][axis], self.config.control_period);
                }
            }
        }
        for substep in 0..self.config.substeps() {
            if substep == self.delay {
                for module in 0..self.modules() {
                    let dead = self.faults[module] == Some(ModuleFault::Action);
                    self.snake.set_torque(module, if dead { [0.0; 2] } else { self.command[module] });
                }
            }
            self.snake.step();
        }
        self.steps += 1;
        if self.snake.height() < 4.0 * self.config.robot.link_radius {
            self.low_steps += 1;
        }
        let before = self.distance;
        self.distance = self.measure();
        let success = self.distance < self.config.task.success_distance;
        let reward = self.config.task.reward(before, self.distance, success);
        self.episode_return += reward;
        self.sample();
        Outcome {
            reward,
            terminated: success,
            truncated: !success && self.steps >= self.config.task.cap,
            success,
            distance: self.distance,
            steps: self.steps,
            episode_return: self.episode_return,
        }
    }
}
