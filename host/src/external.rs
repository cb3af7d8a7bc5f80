//! A plant elsewhere in the place of this program's own physics ([`composer_sim_bridge::external_plant`]).
//!
//! The motors stay here: torques are slewed as [`crate::sim::Snake`] does it, and the plant is told what acts in each physics step. Everything
//! that a module senses comes from the plant.

use std::time::Duration;

use composer_shared::observation::Sensors;
use composer_shared::robot::{self, AXES, MAX_JOINTS};
use composer_sim_bridge::external_plant::{
    Address, BlockSetup, ExternalPlant, MirrorState, PlantError, Reset, SceneSetup, Size, SolidSetup, State,
};
use serde::Serialize;

use crate::mjcf::{self, mjcf};
use crate::robot::Robot;
use crate::sim::Scene;

/// The law of contact that the plant is to follow; `plant-protocol.md` has the formulas.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ContactLaw {
    /// Normal force by depth, force per unit.
    pub contact_stiffness: f32,
    /// Growth of the normal force with the approaching speed, s/unit.
    pub contact_damping: f32,
    /// Sliding speed across at which friction has most of its force, units/s.
    pub slip_speed: f32,
}

impl ContactLaw {
    // MERGE: these are to be `robot.contact_stiffness`, `robot.contact_damping` and `robot.slip_speed`. When the robot has them, `RobotSetup`
    // needs no `law` any more: the robot itself says it all.
    fn of(_robot: &Robot) -> Self {
        ContactLaw { contact_stiffness: 2000.0, contact_damping: 5.0, slip_speed: 0.05 }
    }
}

/// The robot as a plant gets it.
#[derive(Clone, Debug, Serialize)]
pub struct RobotSetup {
    #[serde(flatten)]
    robot: Robot,
    #[serde(flatten)]
    law: ContactLaw,
}

/// What a plant needs for an episode.
fn reset(robot: &Robot, scene: &Scene, seed: u64) -> Reset<RobotSetup> {
    let solids = scene.solids.iter();
    let turn = |yaw: f32| [0.0, 0.0, libm::sinf(0.5 * yaw), libm::cosf(0.5 * yaw)];
    Reset {
        robot: RobotSetup { robot: robot.clone(), law: ContactLaw::of(robot) },
        scene: SceneSetup {
            solids: solids.map(|s| SolidSetup { half: s.half, position: s.position, rotation: s.rotation() }).collect(),
            block: scene.block.map(|b| BlockSetup {
                half: b.half,
                position: b.position,
                rotation: turn(b.yaw),
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

/// A plant elsewhere with its motors, in an episode.
#[derive(Debug)]
pub struct External {
    robot: Robot,
    plant: ExternalPlant,
    state: State,
    torque: Vec<[f32; AXES]>,
    command: Vec<[f32; AXES]>,
    /// Why there are no more steps.
    trouble: Option<PlantError>,
}

impl External {
    /// Starts or reaches the plant and begins an episode.
    pub fn start(elsewhere: &Elsewhere, robot: &Robot, scene: &Scene, seed: u64) -> Result<Self, PlantError> {
        let size = Size { modules: robot.modules, links: robot.links() };
        let mut plant = ExternalPlant::start(&elsewhere.address, size, elsewhere.patience)?;
        let state = plant.reset(&reset(robot, scene, seed))?;
        let still = vec![[0.0; AXES]; robot.modules];
        Ok(External { robot: robot.clone(), plant, state, torque: still.clone(), command: still, trouble: None })
    }

    /// The torque (robot units) that a module commands; its motors slew towards it from the next step on.
    pub fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        let limit = self.robot.torque_limit;
        self.command[module] = torque.map(|t| t.clamp(-limit, limit));
    }

    /// The torques that act on the joints now.
    pub fn torques(&self) -> &[[f32; AXES]] {
        &self.torque
    }

    /// Advances by one physics step. After a trouble nothing moves any more.
    pub fn step(&mut self) {
        if self.trouble.is_some() {
            return;
        }
        let most = self.robot.torque_slew * self.robot.physics_step;
        for (torque, command) in self.torque.iter_mut().zip(&self.command) {
            for axis in 0..AXES {
                torque[axis] = robot::slew(torque[axis], command[axis], most);
            }
        }
        // The shortest decimal of the step, as in the robot file, and not what the nearest binary number is.
        let dt = self.robot.physics_step.to_string().parse().unwrap_or(f64::from(self.robot.physics_step));
        match self.plant.step(dt, &self.torque) {
            Ok(state) => self.state = state,
            Err(trouble) => self.trouble = Some(trouble),
        }
    }

    /// What the plant was last seen at.
    pub fn mirror(&self) -> &MirrorState {
        &self.state.mirror
    }

    /// Why the plant does not go on, if so.
    pub fn trouble(&self) -> Option<&PlantError> {
        self.trouble.as_ref()
    }

    /// One sample of a module's sensors.
    pub fn sensors(&self, module: usize) -> Sensors {
        let mut sensors = Sensors { temperature: 25.0, ..Sensors::ZERO };
        let MirrorState { joint_angles, joint_speeds, .. } = &self.state.mirror;
        for k in 0..self.robot.links_per_module.min(MAX_JOINTS) {
            let joint = module * self.robot.links_per_module + k;
            if let (Some(angle), Some(speed)) = (joint_angles.get(joint), joint_speeds.get(joint)) {
                sensors.joint_angles[k] = *angle;
                sensors.joint_speeds[k] = *speed;
            }
        }
        sensors.up = self.state.imu[module].up;
        sensors.angular_rate = self.state.imu[module].rate;
        sensors.torque = self.torque[module].map(|t| t / self.robot.torque_limit);
        sensors
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
