//! A plant elsewhere in the place of this program's own physics ([`composer_sim_bridge::external_plant`]).
//!
//! The motors stay here, and so do the sensors: [`Snake::slew`] says which torques act in each physics step, and [`Snake::follow`] takes over
//! what the plant answers, so that the task's judge, the recorder and the modules see a snake like any other.

use std::time::Duration;

use composer_shared::observation::Sensors;
use composer_sim_bridge::external_plant::{
    self, Address, BlockSetup, ExternalPlant, MirrorState, PlantError, Reset, SceneSetup, Size, SolidSetup,
};

use crate::mjcf::{self, mjcf};
use crate::robot::Robot;
use crate::sim::{LinkState, Scene, Snake, State};

/// What a plant needs for an episode.
fn reset(robot: &Robot, scene: &Scene, seed: u64) -> Reset<Robot> {
    let solid =
        |s: &crate::sim::scene::Solid| SolidSetup { half: s.half, position: s.position, rotation: s.rotation() };
    Reset {
        robot: robot.clone(),
        scene: SceneSetup {
            solids: scene.solids.iter().map(solid).collect(),
            block: scene.block.map(|b| BlockSetup {
                half: b.half,
                position: b.position,
                rotation: b.rotation(),
                mass: b.mass,
                friction: b.friction,
            }),
        },
        seed,
        mjcf: mjcf(robot, scene, mjcf::Options::default()),
    }
}

/// Where a plant elsewhere is, and how long it may take to answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Elsewhere {
    /// Where.
    pub address: Address,
    /// How long each answer may take.
    pub patience: Duration,
}

/// A plant elsewhere, in an episode.
#[derive(Debug)]
pub struct External {
    plant: ExternalPlant,
    /// Of every step, s.
    dt: f64,
    state: external_plant::State,
    /// Why there are no more steps.
    trouble: Option<PlantError>,
}

impl External {
    /// Starts or reaches the plant and begins an episode; also returns the snake that mirrors it.
    pub fn start(elsewhere: &Elsewhere, robot: &Robot, scene: &Scene, seed: u64) -> Result<(Self, Snake), PlantError> {
        let size = Size { modules: robot.modules, links: robot.links() };
        let mut plant = ExternalPlant::start(&elsewhere.address, size, elsewhere.patience)?;
        let state = plant.reset(&reset(robot, scene, seed))?;
        let mut snake = Snake::mirror(robot, scene);
        snake.follow(&own(&state.mirror));
        // The decimal in the robot file, and not the nearest binary number.
        let dt = robot.physics_step.to_string().parse().unwrap_or(f64::from(robot.physics_step));
        Ok((External { plant, dt, state, trouble: None }, snake))
    }

    /// Moves the snake that mirrors it by one physics step. After a trouble nothing moves any more.
    pub fn step(&mut self, snake: &mut Snake) {
        if self.trouble.is_some() {
            return;
        }
        match self.plant.step(self.dt, snake.slew()) {
            Ok(state) => {
                snake.follow(&own(&state.mirror));
                self.state = state;
            }
            Err(trouble) => self.trouble = Some(trouble),
        }
    }

    /// Why the plant does not go on, if so.
    pub fn trouble(&self) -> Option<&PlantError> {
        self.trouble.as_ref()
    }

    /// What a module senses: what the sensors of its mirror say, but for an IMU of the plant's own.
    pub fn sensors(&self, snake: &Snake, module: usize) -> Sensors {
        let sensors = snake.sensors(module);
        match &self.state.imu {
            Some(imu) => Sensors { up: imu[module].up, angular_rate: imu[module].rate, ..sensors },
            None => sensors,
        }
    }
}

/// The same for this program's own snake.
fn own(mirror: &MirrorState) -> State {
    let body = |body: &external_plant::LinkState| {
        let external_plant::LinkState { position, rotation, linear, angular } = *body;
        LinkState { position, rotation, linear, angular }
    };
    State {
        links: mirror.links.iter().map(body).collect(),
        joint_angles: mirror.joint_angles.clone(),
        joint_speeds: mirror.joint_speeds.clone(),
        block: mirror.block.as_ref().map(body),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reset_says_robot_law_scene_and_model() {
        let robot = Robot::default();
        let text = serde_json::to_string(&reset(&robot, &Scene::default(), 7)).unwrap();
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(value["robot"]["modules"], 8);
        assert_eq!(value["robot"]["contact_stiffness"], 2000.0);
        assert_eq!(value["seed"], 7);
        assert!(value["scene"]["block"].is_null() && value["mjcf"].as_str().unwrap().starts_with("<mujoco"));
    }
}
