//! The snake as an environment: rapier physics, a task, faults, and what each module can know of it.
//!
//! One control step does what the modules do on the bus ([`composer_firmware::controller`]): sample the sensors, hear everybody's
//! joint angles (as the STATE frame rounds them), lay out the chain, observe, act, clamp and slew the torque. The torque takes effect
//! one or more physics steps after the sample, as it does on a bus.

use std::sync::Arc;

use composer_firmware::controller::relax_factor;
use composer_firmware::motor_health::{MotorHealth, share};
use composer_shared::kinematics::Chain;
use composer_shared::observation::{self, Motors, POINTS, Sensors, Told};
use composer_shared::policy::{GoalKnownTo, Task};
use composer_shared::robot::Limits;
use composer_shared::wire;
use composer_sim_bridge::faults::{Fault, FaultKind, FaultPlan, ScheduledFault};
use composer_sim_bridge::sensor_model::SensorModel;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rapier3d::math::{Rotation, Vector};
use serde::{Deserialize, Serialize};

use crate::environment::{Environment, KINDS, Lesson, Outcome, PLACES, PRIVILEGED, View, place_of};
use crate::robot::Robot;
use crate::sim::{Motion, Snake};
use crate::tasks::{Judge, Point, Reward, TaskConfig, Verdict};
use crate::vary::Variation;

/// Faults that training draws for each episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultTraining {
    /// Share of episodes with a fault. Higher: more practice with faults, less without.
    pub probability: f32,
    /// Most modules hit in one episode. Higher: episodes that are harder, some of them beyond what the body can do. The number is drawn evenly from 1 to
    /// this; if `mixed`, 1 is drawn twice as often as 2 and three times as often as 3.
    pub most: usize,
    /// Relative weights of the kinds: action, observation, unplugged. Higher: more episodes with that kind.
    pub weights: [f32; 3],
    /// Every fault of an episode has a kind of its own, may be drawn more often where it is not mastered (`train.curriculum.failure_share`), and starts
    /// with the episode or, every other one, at any time up to `latest`. If not, all are of one kind, and only unplugging happens on the way.
    pub mixed: bool,
    /// Latest start of a fault, s. Higher: more faults come on the way, but also when the episode is over.
    pub latest: f32,
    /// Faults that every episode has besides, written as on the command line, such as `action:#3@0s`: for a specialist that knows its fault. Empty: none.
    pub fixed: String,
    /// Share of a module's latents that its neighbours miss, drawn anew each step (frames lost or late). Higher:
    /// relies less on what others say.
    pub missed_latents: f32,
}

impl Default for FaultTraining {
    fn default() -> Self {
        FaultTraining {
            probability: 0.0,
            most: 2,
            weights: [1.0, 1.0, 2.0],
            mixed: false,
            latest: 3.0,
            fixed: String::new(),
            missed_latents: 0.0,
        }
    }
}

impl FaultTraining {
    /// Draws the faults of an episode.
    pub fn draw(&self, seed: u64, modules: usize) -> Vec<ScheduledFault> {
        self.draw_for(seed, modules, &Lesson::default())
    }

    /// The same under a curriculum.
    pub fn draw_for(&self, seed: u64, modules: usize, lesson: &Lesson) -> Vec<ScheduledFault> {
        let mut faults = self.draw_random(seed, modules, lesson);
        if !self.fixed.is_empty() {
            // It has been checked.
            faults.extend(self.fixed.parse::<FaultPlan>().map_or_else(|_| Vec::new(), |plan| plan.draw(seed, modules)));
        }
        faults
    }

    fn draw_random(&self, seed: u64, modules: usize, lesson: &Lesson) -> Vec<ScheduledFault> {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0xfa17);
        if rng.random::<f32>() >= self.probability * lesson.faults || modules < 2 {
            return Vec::new();
        }
        if self.mixed {
            return self.draw_mixed(rng, modules, lesson);
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
                _ => (if rng.random() { 0 } else { rng.random_range(0..self.latest_ns()) }, Fault::Unplug(module)),
            };
            ScheduledFault { at_ns, until_ns: None, fault }
        });
        hit.collect()
    }

    fn latest_ns(&self) -> u64 {
        ((f64::from(self.latest) * 1e9).round() as u64).max(1)
    }

    /// Faults of any kinds, no module hit twice.
    fn draw_mixed(&self, rng: &mut ChaCha8Rng, modules: usize, lesson: &Lesson) -> Vec<ScheduledFault> {
        let most = self.most.clamp(1, modules - 1);
        let count = 1 + pick(rng, (1..=most).map(|count| 1.0 / count as f32));
        // Weight of each kind of each module: an even part, and one in proportion to how often it fails.
        let trouble = |kind: usize, module: usize| lesson.failure[kind * PLACES + place_of(module, modules)];
        let all = (0..KINDS).flat_map(|kind| (0..modules).map(move |module| (kind, module)));
        let mut pairs: Vec<(usize, usize, f32, f32)> = all
            .map(|(kind, module)| (kind, module, self.weights[kind], self.weights[kind] * trouble(kind, module)))
            .collect();
        (0..count)
            .map(|_| {
                let even: f32 = pairs.iter().map(|pair| pair.2).sum();
                let failing: f32 = pairs.iter().map(|pair| pair.3).sum();
                let share = if failing > 0.0 { lesson.failure_share } else { 0.0 };
                let weight = |pair: &(usize, usize, f32, f32)| {
                    (1.0 - share) * pair.2 / even + if share > 0.0 { share * pair.3 / failing } else { 0.0 }
                };
                let (kind, module, ..) = pairs[pick(rng, pairs.iter().map(weight))];
                pairs.retain(|pair| pair.1 != module);
                let fault = [Fault::ActuatorDead, Fault::SensorZeroed, Fault::Unplug][kind](module);
                let at_ns = if rng.random() { 0 } else { rng.random_range(0..self.latest_ns()) };
                ScheduledFault { at_ns, until_ns: None, fault }
            })
            .collect()
    }
}

/// Draws a number with these weights.
fn pick(rng: &mut ChaCha8Rng, weights: impl Iterator<Item = f32> + Clone) -> usize {
    let mut left = rng.random::<f32>() * weights.clone().sum::<f32>();
    let last = weights.clone().count() - 1;
    weights
        .clone()
        .position(|weight| {
            left -= weight;
            left < 0.0
        })
        .unwrap_or(last)
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

    /// The same, in a share of the episodes only; the others are as if nothing varied.
    fn drawn_in(self: &Arc<Self>, share: f32, seed: u64) -> Arc<Self> {
        let varied = share >= 1.0 || ChaCha8Rng::seed_from_u64(seed ^ 0x5a4e).random::<f32>() < share;
        match varied || self.vary.is_none() {
            true => self.drawn(seed),
            false => Arc::new(EnvConfig { vary: Variation::default(), ..(**self).clone() }),
        }
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

    /// The troubles that these are, as [`Outcome::troubles`] has them.
    fn troubles(&self, modules: usize) -> u32 {
        let mut troubles = 0;
        for (kind, hit) in [self.weak, self.blind, self.gone].into_iter().enumerate() {
            for module in (0..modules).filter(|module| hit >> module & 1 == 1) {
                troubles |= 1 << (kind * PLACES + place_of(module, modules));
            }
        }
        troubles
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
    lesson: Lesson,
    troubles: u32,
    /// What the modules before and behind a cut believe of the chain; the same without a cut.
    chains: [Chain; 2],
    sensors: Vec<Sensors>,
    command: Vec<[f32; 2]>,
    /// What each module knows of its motors.
    health: Vec<MotorHealth>,
    /// Who is heard before a cut, and behind it.
    speaking: [u64; 2],
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
            lesson: Lesson::default(),
            troubles: 0,
            chains: [Chain::new(config.robot.geometry()), Chain::new(config.robot.geometry())],
            sensors: vec![Sensors::ZERO; modules],
            command: vec![[0.0; 2]; modules],
            health: vec![MotorHealth::default(); modules],
            speaking: [0; 2],
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
        let config = self.base.drawn_in(self.lesson.varied, seed);
        self.config = config.clone();
        self.troubles = 0;
        (self.snake, self.judge) = config.start(seed);
        self.rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed_fa17);
        self.faults = faults.to_vec();
        self.delay = self.rng.random_range(config.delay[0]..=config.delay[1]).min(config.substeps() - 1);
        self.chains = [Chain::new(config.robot.geometry()), Chain::new(config.robot.geometry())];
        self.command.fill([0.0; 2]);
        self.health.fill(MotorHealth::default());
        self.episode_return = 0.0;
        self.sample();
    }

    /// A module's command as a fraction of the torque limit.
    fn commanded(&self, module: usize) -> [f32; 2] {
        self.command[module].map(|torque| torque / self.limits.torque)
    }

    /// What a module knows of motors: its own, and those of the modules next to it, as far as it hears them.
    fn motors(&self, module: usize) -> Motors {
        let working = |other: Option<usize>| match other {
            None => 1.0,
            Some(other) if self.speaking[self.now.side(module)] >> other & 1 == 0 => 0.0,
            Some(other) => share(self.health[other].work()),
        };
        let behind = Some(module + 1).filter(|other| *other < self.modules());
        Motors {
            commanded: self.commanded(module),
            work: self.health[module].work(),
            beside: [working(module.checked_sub(1)), working(behind)],
        }
    }

    /// Samples the sensors and lets everybody hear everybody, as one control cycle on the bus does.
    fn sample(&mut self) {
        let modules = self.config.robot.modules;
        let period_ns = f64::from(self.config.control_period) * 1e9;
        self.now = FaultsNow::at(&self.faults, (f64::from(self.judge.steps()) * period_ns).round() as u64);
        self.troubles |= self.now.troubles(modules);
        let mut speaking = [0u64; 2];
        for module in 0..modules {
            let bit = 1u64 << module;
            self.sensors[module] = if self.now.blind & bit != 0 { Sensors::ZERO } else { self.snake.sensors(module) };
            let speaks = self.now.gone & bit == 0 && self.sensors[module].plausible();
            if self.now.gone & bit != 0 {
                self.health[module] = MotorHealth::default();
            } else if speaks {
                let commanded = self.commanded(module);
                self.health[module].update(commanded, &self.sensors[module], self.limits.joint_speed);
            }
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
        self.speaking = speaking;
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
        let faults = self.config.faults.draw_for(seed, self.config.robot.modules, &self.lesson);
        self.reset_with(seed, &faults);
    }

    fn teach(&mut self, lesson: &Lesson) {
        self.lesson = *lesson;
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
            let motors = self.motors(module);
            view.observations.push(observation::observe(&self.sensors[module], &motors, place, &head, &told));
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
            troubles: self.troubles,
        }
    }

    fn place(&self, module: usize, offset: [f32; 3]) -> Point {
        let rotation = Rotation::from_array(self.snake.module_rotation(module));
        (Vector::from(self.snake.module_position(module)) + rotation * Vector::from(offset)).to_array()
    }

    fn imagined_reward(&self, positions: &[Point]) -> f32 {
        let task = &self.config.task;
        self.imagined(positions, &|p| task.rules().imagined_distance(self.judge.course(), &self.snake, p))
    }

    fn imagined_reward_of_each(&self, positions: &[Point]) -> f32 {
        let task = &self.config.task;
        self.imagined(positions, &|p| task.rules().imagined_distance_of_each(self.judge.course(), &self.snake, p))
    }

    /// The centre of a module stays a link's radius off the solids of the scene and above the ground.
    fn clipped(&self, module: usize, target: Point) -> Point {
        let (from, radius) = (self.snake.module_position(module), self.config.robot.link_radius);
        let to = [target[0], target[1], target[2].max(radius)];
        let free = self.judge.course().scene.solids.iter().map(|solid| solid.entered(from, to, radius));
        let share = free.fold(1.0, f32::min);
        std::array::from_fn(|axis| from[axis] + share * (to[axis] - from[axis]))
    }
}

impl SnakeEnv {
    /// Of the kind that the task pays: the decrease of the task's distance ([`crate::tasks::Rules::imagined_distance`]) from the modules' places now to
    /// those imagined, or -0.1 times the latter.
    fn imagined(&self, positions: &[Point], distance: &dyn Fn(&[Point]) -> f32) -> f32 {
        match self.config.task.settings.reward {
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
    fn a_module_knows_of_its_dead_motors_and_those_beside_it() {
        let mut env = SnakeEnv::new(Arc::new(EnvConfig::new(Task::GoalReaching, Robot::default())));
        let fault = |fault| ScheduledFault { at_ns: 0, until_ns: None, fault };
        env.reset_with(1, &[fault(Fault::ActuatorDead(3)), fault(Fault::Unplug(6))]);
        let mut view = View::default();
        for step in 0..12 {
            env.view(&mut view);
            let works = f32::from(u8::from(step < 6));
            let all = &view.observations;
            if !(2..6).contains(&step) {
                assert_eq!(all[3][42..44], [works; 2], "step {step}");
                assert_eq!((all[2][45], all[4][44]), (works, works), "step {step}");
            }
            // Nobody is missing beyond the ends; who is silent gives nothing.
            assert_eq!([all[0][44], all[7][45], all[5][45], all[7][44]], [1.0, 1.0, 0.0, 0.0]);
            assert_eq!((all[1][42..46].iter().sum::<f32>(), all[5][44]), (4.0, 1.0));
            let swing = if step % 8 < 4 { 0.8 } else { -0.8 };
            env.step(&[[swing, -swing]; 8]);
        }
        env.view(&mut view);
        assert!(view.observations[0][40] != 0.0 && view.observations[0][40] == -view.observations[0][41]);
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
    fn faults_of_a_lesson_are_mixed_and_go_where_it_fails() {
        let faults = FaultTraining { probability: 0.8, most: 3, mixed: true, ..FaultTraining::default() };
        let mut lesson =
            Lesson { failure_share: 0.5, failure: [0.0; crate::environment::TROUBLES], ..Lesson::default() };
        // Only dead motors of the third module fail.
        lesson.failure[2] = 0.9;
        let episodes = 4000;
        let (mut count, mut hard, mut kinds_differ, mut late) = ([0usize; 4], 0, 0, 0);
        for seed in 0..episodes {
            let drawn = faults.draw_for(seed, 8, &lesson);
            count[drawn.len()] += 1;
            let module = |fault: &ScheduledFault| match fault.fault {
                Fault::ActuatorDead(m) => (0, m),
                Fault::SensorZeroed(m) => (1, m),
                Fault::Unplug(m) => (2, m),
                _ => unreachable!("no such fault is trained with"),
            };
            let mut modules: Vec<usize> = drawn.iter().map(|fault| module(fault).1).collect();
            modules.sort_unstable();
            modules.dedup();
            assert_eq!(modules.len(), drawn.len(), "no module is hit twice");
            hard += usize::from(drawn.iter().any(|fault| module(fault) == (0, 2)));
            kinds_differ += usize::from(drawn.windows(2).any(|pair| module(&pair[0]).0 != module(&pair[1]).0));
            late += drawn.iter().filter(|fault| fault.at_ns > 0).count();
        }
        let total: usize = (1..4).map(|n| n * count[n]).sum();
        let share = |n: usize| n as f64 / episodes as f64;
        // 0.8 of the episodes have faults, 6/11, 3/11 and 2/11 of them one, two and three.
        for (n, expected) in [0.2, 0.8 * 6.0 / 11.0, 0.8 * 3.0 / 11.0, 0.8 * 2.0 / 11.0].into_iter().enumerate() {
            assert!((share(count[n]) - expected).abs() < 0.03, "{n}: {}", share(count[n]));
        }
        assert!(share(hard) > 0.4 && kinds_differ > 500, "{hard} {kinds_differ}");
        assert!((late as f64 / total as f64 - 0.5).abs() < 0.03);
        lesson.faults = 0.5;
        let fewer = (0..episodes).filter(|seed| !faults.draw_for(*seed, 8, &lesson).is_empty()).count();
        assert!((share(fewer) - 0.4).abs() < 0.03);
        // Longer robots have the same places.
        assert_eq!([0, 1, 7, 8, 15].map(|module| crate::environment::place_of(module, 16)), [0, 0, 3, 4, 7]);
        assert_eq!(
            (0..8).map(|module| crate::environment::place_of(module, 8)).collect::<Vec<_>>(),
            (0..8).collect::<Vec<_>>()
        );
    }

    #[test]
    fn an_episode_says_which_troubles_it_had_and_a_share_of_them_varies() {
        let vary = crate::vary::Variation::from_toml("mass = [2.0, 2.0]").unwrap();
        let mut env =
            SnakeEnv::new(Arc::new(EnvConfig { vary, ..EnvConfig::new(Task::GoalReaching, Robot::default()) }));
        let fault = |at_ns, fault| ScheduledFault { at_ns, until_ns: None, fault };
        env.reset_with(1, &[fault(0, Fault::ActuatorDead(2)), fault(75_000_000, Fault::Unplug(7))]);
        assert_eq!(env.step(&[[0.0; 2]; 8]).troubles, 1 << 2);
        assert_eq!(env.step(&[[0.0; 2]; 8]).troubles, 1 << 2 | 1 << 23);
        env.teach(&Lesson { varied: 0.25, ..Lesson::default() });
        let varied = (0..400).filter(|seed| {
            env.reset(*seed);
            env.snake().robot().link_mass > 1.5 * Robot::default().link_mass
        });
        assert!((varied.count() as f64 / 400.0 - 0.25).abs() < 0.06);
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

    /// The shipped policies on robots of the lab: no motor that works is called dead, and one that is dead is found soon after it is asked for torque.
    #[test]
    fn sound_motors_raise_no_alarm_on_any_robot_of_the_lab_and_dead_ones_are_found() {
        let (mut sound, mut late) = (0, Vec::new());
        for task in Task::ALL {
            let image = composer_shared::policies::shipped(task.name()).unwrap();
            let policy = composer_shared::policy::Policy::parse(image).unwrap();
            let vary = Variation::from_toml(crate::vary::LAB).unwrap();
            let config = Arc::new(EnvConfig { vary, delay: [1, 3], ..EnvConfig::new(task, Robot::default()) });
            let mut env = SnakeEnv::new(config.clone());
            for seed in 0..20 {
                let dead = (seed % 2 == 1).then_some(seed as usize / 2 % 8);
                let fault = |module| ScheduledFault { at_ns: 0, until_ns: None, fault: Fault::ActuatorDead(module) };
                let faults: Vec<_> = dead.map(fault).into_iter().collect();
                let (mut asked, mut found) = ([0; 2], [None; 2]);
                crate::eval::run_episode(&mut env, &policy, seed, &faults, |env, _| {
                    for module in 0..8 {
                        let work = env.health[module].work();
                        if dead != Some(module) {
                            assert_eq!(work, [true; 2], "{task}, seed {seed}, module {module}");
                            sound += 2;
                            continue;
                        }
                        let commanded = env.commanded(module);
                        for axis in 0..2 {
                            asked[axis] += usize::from(commanded[axis].abs() > 0.2);
                            if !work[axis] && found[axis].is_none() {
                                found[axis] = Some(asked[axis]);
                            }
                            assert!(work[axis] || found[axis].is_some());
                        }
                    }
                });
                // A motor that is hardly ever asked for anything is not missed.
                let steps = |axis: usize| found[axis].or((asked[axis] > 40).then_some(usize::MAX));
                late.extend(dead.iter().flat_map(|_| (0..2).filter_map(steps)));
            }
        }
        late.sort_unstable();
        let (median, last) = (late[late.len() / 2], late[late.len() * 19 / 20]);
        println!(
            "{sound} motor steps without an alarm; {} dead motors: asked {median} steps in the median, 95 % at most {last}",
            late.len()
        );
        assert!(late.len() > 50 && median <= 6 && last <= 15, "{late:?}");
    }
}
