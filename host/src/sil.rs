//! The snake as the plant of the simulated bus: complete controllers, real frames, the same physics as in training, or those of a plant
//! elsewhere ([`crate::external`]) that the snake here only mirrors.

use std::sync::Arc;

use composer_shared::observation::Sensors;
use composer_shared::policies;
use composer_shared::policy::{Policy, Task};
use composer_shared::robot::AXES;
use composer_sim_bridge::Plant;
use composer_sim_bridge::computer::InProcess;
use composer_sim_bridge::external_plant::PlantError;
use composer_sim_bridge::sil::{SilConfig, Simulation};

use crate::env::EnvConfig;
use crate::external::{Elsewhere, External};
use crate::outcome::Episode;
use crate::robot::Robot;
use crate::sim::Snake;
use crate::tasks::{Judge, Point};

/// The snake, its goal, and the task's verdict at the end of every control period.
pub struct SnakePlant {
    config: Arc<EnvConfig>,
    snake: Snake,
    /// Whoever moves the snake if it does not move itself.
    external: Option<External>,
    judge: Judge,
    physics_steps: usize,
    /// What the motors get now, by its bits.
    torques: Vec<[u32; AXES]>,
    /// The same of every physics step so far, module by module, if it is kept.
    trace: Option<Vec<[u32; AXES]>>,
    endless: bool,
}

/// A robot of so many modules with the policy that ships for a task, at the start of the episode with this seed, on a simulated bus that is set up like this.
///
/// ```
/// use composer_firmware::controller::BusKind;
/// use composer_host::sil::shipped;
/// use composer_shared::policy::Task;
/// use composer_sim_bridge::faults::Fault;
/// use composer_sim_bridge::sil::{Change, SilConfig};
///
/// # fn main() -> anyhow::Result<()> {
/// let mut robot = shipped(Task::GoalReaching, 8, 5, SilConfig::new(BusKind::Fd))?;
/// robot.advance_cycles(10)?;
/// robot.change(Change::Begin(Fault::Unplug(3), None))??;
/// robot.advance_cycles(4)?;
/// assert!(robot.look(|seen| seen.modules.iter().all(|module| module.alive >> 3 & 1 == 0))?);
/// robot.advance(60_000_000_000)?;
/// assert!(robot.plant().judge().verdict().distance < 4.0 && robot.report()?.deadline_misses < 50);
/// # Ok(())
/// # }
/// ```
///
/// # Errors
///
/// If there cannot be such a robot.
pub fn shipped(
    task: Task,
    modules: usize,
    seed: u64,
    sil: SilConfig,
) -> anyhow::Result<Simulation<'static, SnakePlant, InProcess<'static>>> {
    let image = policies::shipped(task.name()).ok_or_else(|| anyhow::anyhow!("no policy ships for {task}"))?;
    let policy = Policy::parse(image).map_err(|error| anyhow::anyhow!("{error}"))?;
    let robot = Robot::default().with_modules(modules)?;
    let plant = SnakePlant::new(Arc::new(EnvConfig::new(task, robot)), seed);
    Ok(Simulation::new(InProcess::new(policy), plant, policy, sil)?)
}

impl SnakePlant {
    /// The start of the episode with this seed, the same as [`crate::env::SnakeEnv`]'s.
    pub fn new(config: Arc<EnvConfig>, seed: u64) -> Self {
        let config = config.drawn(seed);
        let (snake, judge) = config.start(seed);
        let torques = vec![[0; AXES]; config.robot.modules];
        SnakePlant { config, snake, external: None, judge, physics_steps: 0, torques, trace: None, endless: false }
    }

    /// The same episode, of a plant elsewhere.
    pub fn elsewhere(config: Arc<EnvConfig>, seed: u64, elsewhere: &Elsewhere) -> Result<Self, PlantError> {
        let plant = SnakePlant::new(config, seed);
        let scene = &plant.judge.course().scene;
        let (external, mut snake) = External::start(elsewhere, &plant.config.robot, scene, seed)?;
        snake.set_strength(&plant.config.motor_strength);
        snake.fit_sensors(&plant.config.sensors, seed);
        Ok(SnakePlant { snake, external: Some(external), ..plant })
    }

    /// Why the plant elsewhere did not go on to the end, if so: then nothing about the episode means anything.
    pub fn trouble(&self) -> Option<&PlantError> {
        self.external.as_ref().and_then(External::trouble)
    }

    /// Goes on when the task is done or its time is over, for people who look on.
    pub fn make_endless(&mut self) {
        self.endless = true;
    }

    /// Keeps the torques of every physics step from now on.
    pub fn keep_trace(&mut self) {
        self.trace = Some(Vec::new());
    }

    /// The torques (yaw and pitch, by their bits) of all physics steps so far, in each module by module; empty if they are not kept.
    pub fn trace(&self) -> &[[u32; AXES]] {
        self.trace.as_deref().unwrap_or_default()
    }

    /// The snake.
    pub fn snake(&self) -> &Snake {
        &self.snake
    }

    /// The environment.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// The scene of the episode and what came of it so far.
    pub fn judge(&self) -> &Judge {
        &self.judge
    }

    /// What came of the episode.
    pub fn episode(&self) -> Episode {
        Episode::new(&self.judge, &self.snake)
    }
}

impl Plant for SnakePlant {
    fn modules(&self) -> usize {
        self.config.robot.modules
    }

    fn step_ns(&self) -> u64 {
        (f64::from(self.config.robot.physics_step) * self.config.finer_by as f64 * 1e9).round() as u64
    }

    fn sensors(&self, module: usize) -> Sensors {
        match &self.external {
            Some(external) => external.sensors(&self.snake, module),
            None => self.snake.sensors(module),
        }
    }

    fn point(&self, number: u8) -> Option<Point> {
        self.judge.point_from_head(&self.config.task, &self.snake, number)
    }

    fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        self.torques[module] = torque.map(f32::to_bits);
        self.snake.set_torque(module, torque);
    }

    fn step(&mut self) {
        (0..self.config.finer_by).for_each(|_| self.physics_step());
    }

    fn move_goal(&mut self, [x, y, _]: Point) -> bool {
        self.judge.move_goal(&self.config.task, [x, y])
    }

    fn done(&self) -> bool {
        let over = self.judge.verdict().success || self.judge.steps() >= self.config.cap();
        over && !self.endless || self.trouble().is_some()
    }
}

impl SnakePlant {
    fn physics_step(&mut self) {
        if let Some(trace) = &mut self.trace {
            trace.extend_from_slice(&self.torques);
        }
        match &mut self.external {
            Some(external) => external.step(&mut self.snake),
            None => self.snake.step(),
        }
        self.judge.watch(&self.config.task, &self.snake);
        self.physics_steps += 1;
        if self.physics_steps.is_multiple_of(self.config.substeps()) {
            self.judge.step(&self.config.task, &self.snake);
        }
    }
}
