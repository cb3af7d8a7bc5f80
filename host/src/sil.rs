//! The rapier snake as the plant of the simulated bus: complete controllers, real frames, the same physics as in training.

use std::sync::Arc;

use composer_shared::observation::Sensors;
use composer_shared::robot::AXES;
use composer_sim_bridge::Plant;

use crate::env::EnvConfig;
use crate::eval::Episode;
use crate::sim::Snake;
use crate::tasks::goal_reaching::Bearing;

/// The snake, its goal, and the task's verdict at the end of every control period.
pub struct SnakePlant {
    config: Arc<EnvConfig>,
    snake: Snake,
    goal: [f32; 3],
    physics_steps: usize,
    low_steps: u32,
    distance: f32,
    success: bool,
    /// What the motors get now, by its bits.
    torques: Vec<[u32; AXES]>,
    /// The same of every physics step so far, module by module, if it is kept.
    trace: Option<Vec<[u32; AXES]>>,
}

impl SnakePlant {
    /// The start of the episode with this seed, the same as [`crate::env::SnakeEnv`]'s.
    pub fn new(config: Arc<EnvConfig>, seed: u64) -> Self {
        let snake = Snake::new(&config.robot);
        let goal = config.task.goal(seed, config.robot.link_radius);
        let torques = vec![[0; AXES]; config.robot.modules];
        let mut plant = SnakePlant {
            config,
            snake,
            goal,
            physics_steps: 0,
            low_steps: 0,
            distance: 0.0,
            success: false,
            torques,
            trace: None,
        };
        plant.distance = plant.snake.head_distance(plant.goal);
        plant
    }

    /// The same, keeping the torques of every physics step.
    pub fn traced(config: Arc<EnvConfig>, seed: u64) -> Self {
        SnakePlant { trace: Some(Vec::new()), ..SnakePlant::new(config, seed) }
    }

    /// The torques (yaw and pitch, by their bits) of all physics steps so far, in each module by module; empty if they are not kept.
    pub fn trace(&self) -> &[[u32; AXES]] {
        self.trace.as_deref().unwrap_or_default()
    }

    /// The snake.
    pub fn snake(&self) -> &Snake {
        &self.snake
    }

    /// The goal in the world.
    pub fn goal_in_world(&self) -> [f32; 3] {
        self.goal
    }

    /// Distance of the head to the goal, as of the last control period.
    pub fn distance(&self) -> f32 {
        self.distance
    }

    /// Whole control periods so far.
    pub fn steps(&self) -> u32 {
        (self.physics_steps / self.config.substeps()) as u32
    }

    /// What came of the episode.
    pub fn episode(&self) -> Episode {
        Episode {
            success: self.success,
            distance: self.distance,
            steps: self.steps(),
            bearing: Bearing::of(self.goal),
            motion: self.snake.motion(),
            low_steps: self.low_steps,
        }
    }
}

impl Plant for SnakePlant {
    fn modules(&self) -> usize {
        self.config.robot.modules
    }

    fn step_ns(&self) -> u64 {
        (f64::from(self.config.robot.physics_step) * 1e9).round() as u64
    }

    fn sensors(&self, module: usize) -> Sensors {
        self.snake.sensors(module)
    }

    fn goal(&self) -> Option<[f32; 3]> {
        Some(self.snake.in_head_frame(self.goal))
    }

    fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        self.torques[module] = torque.map(f32::to_bits);
        self.snake.set_torque(module, torque);
    }

    fn step(&mut self) {
        if let Some(trace) = &mut self.trace {
            trace.extend_from_slice(&self.torques);
        }
        self.snake.step();
        self.physics_steps += 1;
        if self.physics_steps.is_multiple_of(self.config.substeps()) {
            self.distance = self.snake.head_distance(self.goal);
            self.success |= self.distance < self.config.task.success_distance;
            if self.snake.height() < 4.0 * self.config.robot.link_radius {
                self.low_steps += 1;
            }
        }
    }

    fn done(&self) -> bool {
        self.success || self.steps() >= self.config.task.cap
    }
}
