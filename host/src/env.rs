//! The snake as an environment: rapier physics, a task, faults, and what each module can know of it.
//!
//! One control step does what the modules do on the bus ([`composer_firmware::controller`]): sample the sensors, hear everybody's
//! joint angles (as the STATE frame rounds them), lay out the chain, observe, act, clamp and slew the torque. The torque takes effect
//! one or more physics steps after the sample, as it does on a bus.

use std::sync::Arc;

use composer_firmware::controller::relax_factor;
use composer_shared::kinematics::Chain;
use composer_shared::observation::{self, POINTS, Sensors, Told};
use composer_shared::policy::{GoalKnownTo, Task};
use composer_shared::robot::Limits;
use composer_shared::wire;
use composer_sim_bridge::faults::{Fault, FaultKind, ScheduledFault};
use composer_sim_bridge::sensor_model::SensorModel;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rapier3d::math::{Rotation, Vector};
use serde::{Deserialize, Serialize};

use crate::environment::{Environment, Outcome, PRIVILEGED, View};
use crate::robot::Robot;
use crate::sim::{Motion, Snake};
use crate::tasks::{Judge, Point, Reward, TaskConfig, Verdict};
use crate::vary::Variation;

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
    /// Draws the faults of an episode.
    pub fn draw(&self, seed: u64, modules: usize) -> Vec<ScheduledFault> {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0xfa17);
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
        let hit = order.into_iter().take(count).map(|module| {
            let (at_ns, fault) = match kind {
                Some(0) => (0, Fault::ActuatorDead(module)),
                Some(1) => (0, Fault::SensorZeroed(module)),
                // Half of them from the start: those episodes teach most about living without the module.
                _ => (if rng.random() { 0 } else { rng.random_range(0..3_000_000_000) }, Fault::Unplug(module)),
            };
            ScheduledFault { at_ns, until_ns: None, fault }
        });
        hit.collect()
    }
}

/// Everything that defines the environment.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvConfig {
    /// The robot.
    pub robot: Robot,
    /// The task.
    pub task: TaskConfig,
    /// Who is told the goal.
    pub goal_known_to: GoalKnownTo,
    /// Control period, s.
    pub control_period: f32,
    /// Physics steps in one of the robot's own: at those the bus samples sensors and takes torques, however much finer the physics are.
    pub finer_by: usize,
    /// Physics steps between sampling the sensors and the new torque, least and most; drawn for each episode.
    pub delay: [usize; 2],
    /// Faults drawn in training.
    pub faults: FaultTraining,
    /// What the modules take the time constant for with which joints without torque straighten, s; none: the robot's own.
    pub relax_seconds: Option<f32>,
    /// The modules' sensors; what differs from module to module is drawn for each episode.
    pub sensors: SensorModel,
    /// Torque of each module's motors for the torque they are told, as a factor; nominal for modules that are not named.
    pub motor_strength: Vec<f32>,
    /// What every episode draws anew.
    pub vary: Variation,
}

impl EnvConfig {
    /// A task with its default settings on a robot: 0.05 s control period, a torque one physics step after the sample, no faults.
    pub fn new(task: Task, robot: Robot) -> Self {
        EnvConfig {
            robot,
            task: TaskConfig::new(task),
            goal_known_to: GoalKnownTo::All,
            control_period: 0.05,
            finer_by: 1,
            delay: [1, 1],
            faults: FaultTraining::default(),
            relax_seconds: None,
            sensors: SensorModel::default(),
            motor_strength: Vec::new(),
            vary: Variation::default(),
        }
    }

    /// The same with the physics step divided by `times`. Control period, delay in seconds, sensors and slew stay as they are, and so do the
    /// episodes: what comes out differently is the error of the coarser step.
    pub fn finer(mut self, times: usize) -> Self {
        self.robot.physics_step /= times as f32;
        self.finer_by *= times;
        self.delay = self.delay.map(|steps| steps * times);
        self
    }

    /// The environment of the episode with this seed, with everything that varies drawn.
    pub fn drawn(self: &Arc<Self>, seed: u64) -> Arc<Self> {
        if self.vary.is_none() { self.clone() } else { Arc::new(self.vary.draw(self, seed)) }
    }

    /// The start of the episode with this seed: the snake in its scene with its sensors, and the judge. What varies must have been drawn.
    pub fn start(&self, seed: u64) -> (Snake, Judge) {
        let (mut snake, judge) = Judge::start(&self.task, seed, &self.robot);
        snake.set_strength(&self.motor_strength);
        snake.fit_sensors(&self.sensors, seed);
        (snake, judge)
    }

    /// Control steps before an episode is cut.
    pub fn cap(&self) -> u32 {
        self.task.settings.cap_for(self.robot.modules)
    }

    /// Physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.control_period / self.robot.physics_step).round().max(1.0) as usize
    }
}

/// Which modules are hit at this moment, as bit sets, and where the cable is cut.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FaultsNow {
    /// Unplugged.
    pub gone: u64,
    /// Motors dead.
    pub weak: u64,
    /// Sensors zeroed.
    pub blind: u64,
    /// The cable is cut behind this module.
    pub cut: Option<usize>,
}

impl FaultsNow {
    fn at(faults: &[ScheduledFault], now_ns: u64) -> Self {
        let mut now = FaultsNow::default();
        for scheduled in faults.iter().filter(|f| f.active(now_ns)) {
            match scheduled.fault {
                Fault::Unplug(m) => now.gone |= 1 << m,
                Fault::ActuatorDead(m) => now.weak |= 1 << m,
                Fault::SensorZeroed(m) => now.blind |= 1 << m,
                Fault::Cut(m) => now.cut = Some(m),
                _ => {}
            }
        }
        now
    }

    /// 0 for modules on the head's side of a cut, 1 behind it.
    fn side(&self, module: usize) -> usize {
        usize::from(self.cut.is_some_and(|cut| module > cut))
    }
}

/// Whether the environment can show a fault; frames lost, late or broken need a bus.
pub fn knows_fault(kind: &FaultKind) -> bool {
    matches!(kind, FaultKind::Unplug(_) | FaultKind::Action(_) | FaultKind::Observation(_) | FaultKind::Cut(_))
}

/// The state of one episode.
pub struct SnakeEnv {
    /// As it was given, and of this episode.
    base: Arc<EnvConfig>,
    config: Arc<EnvConfig>,
    limits: Limits,
    relax: f32,
    snake: Snake,
    judge: Judge,
    faults: Vec<ScheduledFault>,
    now: FaultsNow,
    /// What the modules before and behind a cut believe of the chain; the same without a cut.
    chains: [Chain; 2],
    sensors: Vec<Sensors>,
    command: Vec<[f32; 2]>,
    heard: Vec<u64>,
    delay: usize,
    episode_return: f32,
    rng: ChaCha8Rng,
}

impl SnakeEnv {
    /// An environment, reset with seed 0.
    pub fn new(config: Arc<EnvConfig>) -> Self {
        let base = config.clone();
        let config = config.drawn(0);
        let (snake, judge) = config.start(0);
        let modules = config.robot.modules;
        let mut env = SnakeEnv {
            limits: base.robot.limits(),
            relax: relax_factor(
                (config.control_period * 1e6).round() as u32,
                config.relax_seconds.unwrap_or_else(|| config.robot.relax_seconds()),
            ),
            judge,
            faults: Vec::new(),
            now: FaultsNow::default(),
            chains: [Chain::new(config.robot.geometry()), Chain::new(config.robot.geometry())],
            sensors: vec![Sensors::ZERO; modules],
            command: vec![[0.0; 2]; modules],
            heard: vec![0; modules],
            delay: 1,
            episode_return: 0.0,
            rng: ChaCha8Rng::seed_from_u64(0),
            snake,
            base,
            config,
        };
        env.reset(0);
        env
    }

    /// Starts an episode with given faults instead of drawn ones.
    pub fn reset_with(&mut self, seed: u64, faults: &[ScheduledFault]) {
        let config = self.base.drawn(seed);
        self.config = config.clone();
        (self.snake, self.judge) = config.start(seed);
        self.rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed_fa17);
        self.faults = faults.to_vec();
        self.delay = self.rng.random_range(config.delay[0]..=config.delay[1]).min(config.substeps() - 1);
        self.chains = [Chain::new(config.robot.geometry()), Chain::new(config.robot.geometry())];
        self.command.fill([0.0; 2]);
        self.episode_return = 0.0;
        self.sample();
    }

    /// Samples the sensors and lets everybody hear everybody, as one control cycle on the bus does.
    fn sample(&mut self) {
        let modules = self.config.robot.modules;
        let period_ns = f64::from(self.config.control_period) * 1e9;
        self.now = FaultsNow::at(&self.faults, (f64::from(self.judge.steps()) * period_ns).round() as u64);
        let mut speaking = [0u64; 2];
        for module in 0..modules {
            let bit = 1u64 << module;
            self.sensors[module] = if self.now.blind & bit != 0 { Sensors::ZERO } else { self.snake.sensors(module) };
            let speaks = self.now.gone & bit == 0 && self.sensors[module].plausible();
            let angles = self.sensors[module].joint_angles.map(wire::quantise_angle);
            for (side, chain) in self.chains.iter_mut().enumerate() {
                if speaks && (self.now.cut.is_none() || self.now.side(module) == side) {
                    chain.hear(module, &angles);
                    speaking[side] |= bit;
                } else {
                    chain.miss(module, self.relax);
                }
            }
        }
        let missed = self.config.faults.missed_latents;
        for module in 0..modules {
            let mut heard = speaking[self.now.side(module)];
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

    /// The scene of the episode and what came of it so far.
    pub fn judge(&self) -> &Judge {
        &self.judge
    }

    /// The snake.
    pub fn snake(&self) -> &Snake {
        &self.snake
    }

    /// The faults at this moment.
    pub fn faults(&self) -> FaultsNow {
        self.now
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
        let faults = self.config.faults.draw(seed, self.config.robot.modules);
        self.reset_with(seed, &faults);
    }

    fn view(&self, view: &mut View) {
        let modules = self.modules();
        view.observations.clear();
        view.privileged.clear();
        view.acts.clear();
        view.heard.clone_from(&self.heard);
        let task = self.config.task.task();
        // As the GOAL frames round them.
        let point = |number| {
            let position = self.judge.point_from_head(&self.config.task, &self.snake, number);
            wire::Goal::new(0, number, position).position()
        };
        let told: Vec<_> = (0..task.points(modules as u8)).map(point).collect();
        let Verdict { distance, left, .. } = self.judge.verdict();
        for module in 0..modules {
            let side = self.now.side(module);
            let head = self.chains[side].head_seen_from(module);
            // The station that tells the points sits at the head's end of the cable.
            let hears = side == 0 && (self.config.goal_known_to == GoalKnownTo::All || module == 0);
            let observed = task.observed(module as u8, modules as u8);
            let mut points = [None; POINTS];
            for (point, number) in points.iter_mut().zip(observed) {
                *point = number.filter(|_| hears).and_then(|n| told[usize::from(n)]).map(Into::into);
            }
            let place = observation::place(module, modules);
            let told = Told { points, seeker: task.seeker() };
            view.observations.push(observation::observe(&self.sensors[module], place, &head, &told));
            let (velocity, height) = self.snake.privileged(module);
            let true_point = |n: Option<u8>| -> Option<Point> {
                let point = self.config.task.rules().point(self.judge.course(), &self.snake, n?)?;
                Some(self.snake.in_own_frame(module, point))
            };
            let [goal, second, _] = observed.map(|n| true_point(n).unwrap_or_default());
            let hit = |set: u64| f32::from((set >> module & 1) as u8);
            let mut p = [0.0; PRIVILEGED];
            for axis in 0..3 {
                p[axis] = velocity[axis] / 5.0;
                p[3 + axis] = goal[axis] / 10.0;
                p[12 + axis] = second[axis] / 10.0;
            }
            p[6] = height;
            p[7] = libm::logf(1.0 + distance);
            p[8] = hit(self.now.gone);
            p[9] = hit(self.now.weak);
            p[10] = hit(self.now.blind);
            p[11] = self.delay as f32 / self.config.finer_by as f32;
            p[15] = left / 10.0;
            view.privileged.push(p);
            view.acts.push(self.now.gone >> module & 1 == 0);
        }
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        for (module, (command, action)) in self.command.iter_mut().zip(actions).enumerate() {
            if self.now.gone >> module & 1 == 1 {
                *command = [0.0; 2];
                self.snake.set_torque(module, *command);
            } else {
                for (previous, wanted) in command.iter_mut().zip(action) {
                    *previous = self.limits.command(*previous, *wanted, self.config.control_period);
                }
            }
        }
        for substep in 0..self.config.substeps() {
            if substep == self.delay {
                for module in 0..self.modules() {
                    let dead = self.now.weak >> module & 1 == 1;
                    self.snake.set_torque(module, if dead { [0.0; 2] } else { self.command[module] });
                }
            }
            self.snake.step();
            self.judge.watch(&self.config.task, &self.snake);
        }
        let reward = self.judge.step(&self.config.task, &self.snake);
        self.episode_return += reward;
        self.sample();
        let Verdict { success, distance, .. } = self.judge.verdict();
        let steps = self.judge.steps();
        Outcome {
            reward,
            terminated: success,
            truncated: !success && steps >= self.config.cap(),
            success,
            distance,
            steps,
            episode_return: self.episode_return,
        }
    }

    fn place(&self, module: usize, offset: [f32; 3]) -> Point {
        let rotation = Rotation::from_array(self.snake.module_rotation(module));
        (Vector::from(self.snake.module_position(module)) + rotation * Vector::from(offset)).to_array()
    }

    /// Of the kind that the task pays: the decrease of the task's distance ([`crate::tasks::Rules::imagined_distance`]) from the modules' places now to
    /// those imagined, or -0.1 times the latter.
    fn imagined_reward(&self, positions: &[Point]) -> f32 {
        let task = &self.config.task;
        let distance = |p: &[Point]| task.rules().imagined_distance(self.judge.course(), &self.snake, p);
        match task.settings.reward {
            Reward::Paper => -0.1 * distance(positions),
            Reward::Progress => {
                let here: Vec<_> = (0..self.modules()).map(|module| self.snake.module_position(module)).collect();
                distance(&here) - distance(positions)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(env: &mut SnakeEnv, steps: usize) -> Vec<u32> {
        let mut bits = Vec::new();
        let mut view = View::default();
        for step in 0..steps {
            env.view(&mut view);
            bits.extend(view.observations.iter().flatten().map(|v| v.to_bits()));
            let actions: Vec<_> = (0..8).map(|m| [((step * 3 + m * 5) as f32).sin(), 0.3]).collect();
            let outcome = env.step(&actions);
            bits.push(outcome.reward.to_bits());
        }
        bits
    }

    #[test]
    fn the_same_seed_and_actions_give_the_same_bits_after_any_history() {
        let faults = FaultTraining { probability: 1.0, missed_latents: 0.1, ..FaultTraining::default() };
        for task in Task::ALL {
            let faults = faults.clone();
            let config = Arc::new(EnvConfig { faults, delay: [1, 2], ..EnvConfig::new(task, Robot::default()) });
            let mut fresh = SnakeEnv::new(config.clone());
            let mut used = SnakeEnv::new(config);
            drive(&mut used, 30);
            fresh.reset(42);
            used.reset(42);
            assert_eq!(drive(&mut fresh, 60), drive(&mut used, 60), "{task}");
            assert!(
                fresh.snake().poses().eq(used.snake().poses()) && fresh.snake().block() == used.snake().block(),
                "{task}"
            );
        }
    }

    #[test]
    fn an_unplugged_module_falls_silent_and_slack_and_an_observation_fault_masks_the_key() {
        let mut env = SnakeEnv::new(Arc::new(EnvConfig::new(Task::GoalReaching, Robot::default())));
        let scheduled = |at_ns, fault| ScheduledFault { at_ns, until_ns: None, fault };
        env.reset_with(1, &[scheduled(500_000_000, Fault::Unplug(3)), scheduled(0, Fault::SensorZeroed(5))]);
        let mut view = View::default();
        for step in 0..30 {
            env.view(&mut view);
            let gone = step >= 10;
            assert_eq!(view.acts[3], !gone);
            assert_eq!(view.heard[0] >> 3 & 1, u64::from(!gone));
            assert_eq!(view.heard[0] >> 5 & 1, 0);
            assert_eq!(view.observations[5], [0.0; observation::SIZE]);
            env.step(&[[1.0, 0.0]; 8]);
        }
        assert_eq!(env.snake().torque(3), [0.0; 2]);
        assert_eq!(env.snake().torque(2), [80.0, 0.0]);
    }

    #[test]
    fn a_cut_cable_makes_two_groups_and_a_replugged_module_comes_back() {
        let mut env = SnakeEnv::new(Arc::new(EnvConfig::new(Task::GoalReaching, Robot::default())));
        env.reset_with(
            1,
            &[
                ScheduledFault { at_ns: 100_000_000, until_ns: None, fault: Fault::Cut(2) },
                ScheduledFault { at_ns: 0, until_ns: Some(300_000_000), fault: Fault::Unplug(6) },
            ],
        );
        let mut view = View::default();
        for step in 0..10 {
            env.view(&mut view);
            let here = if step >= 6 { 0xff } else { 0xbf };
            assert_eq!(view.heard[1], if step >= 2 { 0b111 } else { here }, "step {step}");
            assert_eq!(view.heard[4], if step >= 2 { here & 0xf8 } else { here }, "step {step}");
            assert_eq!(view.observations[4][7], if step >= 2 { 0.0 } else { 1.0 });
            env.step(&[[0.5, 0.0]; 8]);
        }
    }

    #[test]
    fn only_the_head_is_told_when_only_the_head_knows() {
        let config =
            EnvConfig { goal_known_to: GoalKnownTo::Head, ..EnvConfig::new(Task::GoalReaching, Robot::default()) };
        let env = SnakeEnv::new(Arc::new(config));
        let mut view = View::default();
        env.view(&mut view);
        assert_eq!(view.observations[0][7], 1.0);
        assert!(view.observations[1..].iter().all(|o| o[..8].iter().all(|v| *v == 0.0)));
    }

    #[test]
    fn what_is_imagined_lies_where_the_modules_frame_says_and_earns_what_the_task_says() {
        for (reward, task) in [Task::GoalReaching, Task::ShapeFormation]
            .into_iter()
            .flat_map(|task| [(Reward::Progress, task), (Reward::Paper, task)])
        {
            let mut config = EnvConfig::new(task, Robot::default());
            config.task.settings.reward = reward;
            let mut env = SnakeEnv::new(Arc::new(config));
            // Bent and turned: the frames differ from the world's.
            drive(&mut env, 20);
            let (task, goal) = (&env.config.task, env.judge.course().goal);
            let left = |p: &[Point]| task.rules().imagined_distance(env.judge.course(), &env.snake, p);
            let offset = [0.3, -0.2, 0.1];
            let here: Vec<_> = (0..8).map(|module| env.place(module, [0.0; 3])).collect();
            for (module, place) in here.iter().enumerate() {
                assert_eq!(*place, env.snake.module_position(module));
                let back = env.snake.in_own_frame(module, env.place(module, offset));
                assert!(back.iter().zip(offset).all(|(b, o)| (b - o).abs() < 1e-5), "{back:?}");
            }
            // Half a unit towards the middle of the course.
            let there: Vec<Point> = here
                .iter()
                .map(|p| {
                    let way: Point = std::array::from_fn(|axis| goal[axis] - p[axis]);
                    let length = way.iter().map(|x| x * x).sum::<f32>().sqrt();
                    std::array::from_fn(|axis| p[axis] + 0.5 * way[axis] / length)
                })
                .collect();
            match reward {
                Reward::Progress => {
                    assert_eq!(env.imagined_reward(&here), 0.0);
                    assert!((env.imagined_reward(&there) - (left(&here) - left(&there))).abs() < 1e-6);
                }
                Reward::Paper => assert!((env.imagined_reward(&there) + 0.1 * left(&there)).abs() < 1e-6),
            }
            if task.task() == Task::GoalReaching {
                assert!((left(&here) - left(&there) - 0.5).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn a_finer_step_changes_neither_the_episode_nor_when_a_torque_acts() {
        let config = EnvConfig { delay: [1, 3], ..EnvConfig::new(Task::BlockPushing, Robot::default()) };
        let fine = config.clone().finer(4);
        assert_eq!((config.substeps(), fine.substeps(), fine.delay), (10, 40, [4, 12]));
        assert_eq!(config.clone().finer(1), config);
        let (mut coarse, mut fine) = (SnakeEnv::new(Arc::new(config)), SnakeEnv::new(Arc::new(fine)));
        coarse.reset_with(5, &[]);
        fine.reset_with(5, &[]);
        assert_eq!(coarse.judge().course(), fine.judge().course());
        drive(&mut coarse, 3);
        drive(&mut fine, 3);
        for module in 0..8 {
            assert_eq!(coarse.command[module], fine.command[module], "slew is per control period");
            assert!(
                crate::tasks::distance(coarse.snake.module_position(module), fine.snake.module_position(module)) < 0.2
            );
        }
    }

    #[test]
    fn an_episode_is_cut_at_the_cap_and_ends_at_the_goal() {
        let mut config = EnvConfig::new(Task::GoalReaching, Robot::default());
        config.task.settings.cap = 3;
        let mut env = SnakeEnv::new(Arc::new(config));
        let still = [[0.0; 2]; 8];
        assert!(!env.step(&still).truncated && !env.step(&still).truncated);
        let last = env.step(&still);
        assert!(last.truncated && !last.terminated && (last.distance - 17.5).abs() < 7.6);
    }
}
