//! The robot as data: a TOML file with everything that the physics needs.
//!
//! Units are those of [`composer_shared::robot`] (SomoGym's scale): lengths in robot units, masses in kilograms, torques in the unit
//! that follows (kg units^2 / s^2). [`Scale`] says what they mean in SI.

use std::path::Path;

use composer_shared::robot::{Geometry, Limits, MAX_JOINTS, MAX_MODULES};
use composer_sim_bridge::sensor_model::PERIOD;
use serde::{Deserialize, Serialize};

/// The paper's robot, and the default of every command.
pub const DEFAULT_TOML: &str = include_str!("../robots/composer-8x4.toml");

/// A snake robot. Every field is checked by [`Robot::validate`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Name, for manifests and replays.
    pub name: String,
    /// Modules, 1 to 64.
    pub modules: usize,
    /// Links in a module, 2 to 4; even joints yaw, odd joints pitch.
    pub links_per_module: usize,
    /// Distance between neighbouring joints.
    pub link_length: f32,
    /// Radius of the capsule around a link.
    pub link_radius: f32,
    /// Mass of a link, kg.
    pub link_mass: f32,
    /// Moment of inertia of a link about each axis, kg units^2. SomoGym gives its links far more than their shape would have;
    /// with the shape's own the joints cannot be simulated at these torques.
    pub link_inertia: f32,
    /// Stiffness of the spring in each joint, torque per radian; it pulls the joint straight.
    pub stiffness: f32,
    /// Damping in each joint in addition to the motor's own, torque per rad/s.
    pub damping: f32,
    /// Largest torque that a motor puts on each joint of its axis.
    pub torque_limit: f32,
    /// Fastest change of a motor's torque, per second.
    pub torque_slew: f32,
    /// No-load speed of the motors, rad/s: the available torque falls linearly with the joint's speed and is nought here.
    /// Faster than this, the drive brakes. Higher: livelier, up to a whip.
    pub joint_speed_limit: f32,
    /// Joint angle at which a module reports a fault, rad.
    pub joint_angle_limit: f32,
    /// Friction coefficient along a link.
    pub friction_along: f32,
    /// Friction coefficient across a link. Only its ratio to `friction_along` lets a wave propel the snake.
    pub friction_across: f32,
    /// Sliding speed at which a contact's friction has reached 71 % of its Coulomb limit in the direction of less friction, units/s; in the other
    /// direction it is smaller by the ratio of the coefficients. Higher: contacts that should hold creep, the solver has less to do.
    pub slip_speed: f32,
    /// Stiffness of a contact, force per unit of depth. Higher: shallower contacts, more sweeps of the solver.
    pub contact_stiffness: f32,
    /// Damping of a contact (Hunt and Crossley), s per unit: the normal force vanishes when the surfaces part at the inverse of it.
    /// Higher: landings that bounce less; above about 1 they do not bounce at all.
    pub contact_damping: f32,
    /// Gravity, units/s^2.
    pub gravity: f32,
    /// Slope of the ground, degrees. Steeper than the angle whose tangent is the coefficient of friction: the snake slides.
    #[serde(default)]
    pub slope: f32,
    /// The direction in which the ground falls, degrees to the left of the world's x axis (the snake's own at the start).
    #[serde(default)]
    pub downhill: f32,
    /// Physics step, s. Smaller: slower and nearer to the truth, in first order.
    pub physics_step: f32,
    /// What solves for the velocities: `direct` ([`crate::sim::chain`]) or `rapier`, its own joints and solver as a second opinion.
    pub solver: Solver,
    /// The direct solver stops when twice the energy that a further sweep could gain, per second of simulated time, is below this,
    /// kg units^2 / s^3. Smaller: more sweeps.
    pub solver_tolerance: f32,
    /// Most sweeps of the direct solver in a step; it needs about 5.
    pub solver_iterations: usize,
    /// Sub-steps and iterations of rapier's solver in a step. Fewer: faster, and a chain that is not converged: what is learnt with one
    /// sub-step and 4 iterations is lost with 16.
    pub rapier_substeps: usize,
    /// See `rapier_substeps`.
    pub rapier_iterations: usize,
    /// What the numbers above mean in SI.
    pub scale: Scale,
}

/// What solves for the velocities of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Articulated-body sweeps inside Newton's method ([`crate::sim::chain`]).
    #[default]
    Direct,
    /// Rapier's joints, contacts and iterations.
    Rapier,
}

impl Solver {
    /// Name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Solver::Direct => "direct",
            Solver::Rapier => "rapier",
        }
    }
}

impl std::str::FromStr for Solver {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "direct" => Ok(Solver::Direct),
            "rapier" => Ok(Solver::Rapier),
            _ => Err(format!("there is no solver {name}; there are direct and rapier")),
        }
    }
}

/// Faster than the no-load speed the drive brakes with this many times its normal damping.
const OVERSPEED_BRAKE: f32 = 8.0;

/// SI values of one robot unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scale {
    /// Metres in one unit of length.
    pub metres_per_unit: f32,
    /// Newton metres in one unit of torque.
    pub newton_metres_per_unit: f32,
}

/// Why a robot file was refused.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// The file could not be read.
    #[error("cannot read the robot file {path}: {source}")]
    Read {
        /// The file.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, a field missing, unknown or of the wrong type.
    #[error("the robot file {path} is not a robot: {message}")]
    Parse {
        /// The file.
        path: String,
        /// Where and why.
        message: String,
    },
    /// A value that cannot be.
    #[error("the robot {name} cannot be: {reason}")]
    Invalid {
        /// The robot's name.
        name: String,
        /// One sentence: what is wrong and what would be right.
        reason: String,
    },
}

impl Default for Robot {
    fn default() -> Self {
        Robot::from_toml(DEFAULT_TOML, "composer-8x4.toml").expect("the robot that ships is valid; a test reads it")
    }
}

impl Robot {
    /// Reads and checks a robot file.
    pub fn load(path: &Path) -> Result<Self, RobotError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| RobotError::Read { path: name.clone(), source })?;
        Robot::from_toml(&text, &name)
    }

    /// Parses and checks the text of a robot file; `path` is for the error message.
    pub fn from_toml(text: &str, path: &str) -> Result<Self, RobotError> {
        let robot: Robot = toml::from_str(text)
            .map_err(|e| RobotError::Parse { path: path.into(), message: e.to_string().trim().replace('\n', " ") })?;
        robot.validate()?;
        Ok(robot)
    }

    /// The same robot with another number of modules.
    pub fn with_modules(&self, modules: usize) -> Result<Self, RobotError> {
        let robot = Robot { modules, ..self.clone() };
        robot.validate()?;
        Ok(robot)
    }

    /// Checks every field.
    pub fn validate(&self) -> Result<(), RobotError> {
        let invalid = |reason: String| Err(RobotError::Invalid { name: self.name.clone(), reason });
        if !(1..=MAX_MODULES).contains(&self.modules) {
            return invalid(format!("modules = {}; a bus carries 1 to {MAX_MODULES}", self.modules));
        }
        if !(2..=MAX_JOINTS).contains(&self.links_per_module) {
            return invalid(format!(
                "links_per_module = {}; 2 to {MAX_JOINTS} fit a STATE frame",
                self.links_per_module
            ));
        }
        let positive = [
            ("link_length", self.link_length),
            ("link_radius", self.link_radius),
            ("link_mass", self.link_mass),
            ("link_inertia", self.link_inertia),
            ("stiffness", self.stiffness),
            ("torque_limit", self.torque_limit),
            ("torque_slew", self.torque_slew),
            ("joint_speed_limit", self.joint_speed_limit),
            ("joint_angle_limit", self.joint_angle_limit),
            ("friction_along", self.friction_along),
            ("friction_across", self.friction_across),
            ("slip_speed", self.slip_speed),
            ("contact_stiffness", self.contact_stiffness),
            ("contact_damping", self.contact_damping),
            ("solver_tolerance", self.solver_tolerance),
            ("gravity", self.gravity),
            ("physics_step", self.physics_step),
            ("scale.metres_per_unit", self.scale.metres_per_unit),
            ("scale.newton_metres_per_unit", self.scale.newton_metres_per_unit),
        ];
        for (name, value) in positive {
            if !(value > 0.0 && value.is_finite()) {
                return invalid(format!("{name} = {value}; it must be a number above zero"));
            }
        }
        if !(self.damping >= 0.0 && self.damping.is_finite()) {
            return invalid(format!("damping = {}; it must be zero or more", self.damping));
        }
        if !(0.0..=45.0).contains(&self.slope) || !self.downhill.is_finite() {
            return invalid(format!(
                "slope = {} and downhill = {}; a slope of 0 to 45 degrees in any direction is possible",
                self.slope, self.downhill
            ));
        }
        let in_a_sample = PERIOD / self.physics_step;
        if in_a_sample < 0.999 || (in_a_sample - in_a_sample.round()).abs() > 1e-3 * in_a_sample {
            return invalid(format!(
                "physics_step = {}; it must be {PERIOD} s, at which the sensors sample, or a whole part of it",
                self.physics_step
            ));
        }
        if !(4..=1000).contains(&self.solver_iterations) {
            return invalid(format!("solver_iterations = {}; 4 to 1000 are possible", self.solver_iterations));
        }
        for (name, value) in [("rapier_substeps", self.rapier_substeps), ("rapier_iterations", self.rapier_iterations)]
        {
            if !(1..=1000).contains(&value) {
                return invalid(format!("{name} = {value}; 1 to 1000 are possible"));
            }
        }
        if self.link_radius > 2.0 * self.link_length {
            return invalid(format!(
                "link_radius = {} with link_length = {}; links of neighbouring modules would overlap",
                self.link_radius, self.link_length
            ));
        }
        Ok(())
    }

    /// Gravity in the frame of the ground (z is its normal), units/s^2.
    pub fn gravity_vector(&self) -> [f32; 3] {
        if self.slope == 0.0 {
            return [0.0, 0.0, -self.gravity];
        }
        let (sin, cos) = libm::sincosf(self.slope.to_radians());
        let (left, ahead) = libm::sincosf(self.downhill.to_radians());
        [self.gravity * sin * ahead, self.gravity * sin * left, -self.gravity * cos]
    }

    /// Links in the whole snake.
    pub fn links(&self) -> usize {
        self.modules * self.links_per_module
    }

    /// Axis of a joint in the frames of both its links: even joints of a module yaw, odd joints pitch.
    pub fn joint_axis(&self, joint: usize) -> [f32; 3] {
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]][self.motor_of(joint).1]
    }

    /// The motor that drives a joint: its module, and which of the two axes.
    pub fn motor_of(&self, joint: usize) -> (usize, usize) {
        (joint / self.links_per_module, joint % self.links_per_module % 2)
    }

    /// The shape of the chain as the modules know it.
    pub fn geometry(&self) -> Geometry {
        Geometry { links_per_module: self.links_per_module as u8, link_length: self.link_length }
    }

    /// The limits that the modules keep.
    pub fn limits(&self) -> Limits {
        Limits {
            torque: self.torque_limit,
            torque_slew: self.torque_slew,
            joint_angle: self.joint_angle_limit,
            joint_speed: self.joint_speed_limit,
            ..Limits::default()
        }
    }

    /// Damping of a joint: its own and that of the motor's torque-speed line, torque per rad/s.
    pub fn joint_damping(&self) -> f32 {
        self.damping + self.torque_limit / self.joint_speed_limit
    }

    /// The same at a joint speed (rad/s): beyond the no-load speed the drive brakes harder.
    pub fn damping_at(&self, speed: f32) -> f32 {
        let over = (speed.abs() / self.joint_speed_limit - 1.0).clamp(0.0, 1.0);
        self.joint_damping() * (1.0 + OVERSPEED_BRAKE * over)
    }

    /// Time constant with which a joint without torque relaxes towards straight, s.
    pub fn relax_seconds(&self) -> f32 {
        self.joint_damping() / self.stiffness
    }

    /// A line that changes when anything about the robot changes: a checkpoint of another robot is refused by it.
    pub fn fingerprint(&self) -> String {
        toml::to_string(self).expect("a robot is plain data")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_robot_is_the_papers() {
        let robot = Robot::default();
        assert_eq!((robot.modules, robot.links()), (8, 32));
        assert!((robot.relax_seconds() - 0.305).abs() < 1e-3);
        assert_eq!(Robot::from_toml(&robot.fingerprint(), "x").unwrap(), robot);
    }

    #[test]
    fn robots_that_cannot_be_are_refused_with_a_sentence() {
        let change = |from: &str, to: &str| {
            let text = DEFAULT_TOML.replace(from, to);
            assert_ne!(text, DEFAULT_TOML, "{from} is not in the file");
            Robot::from_toml(&text, "x.toml").unwrap_err().to_string()
        };
        assert!(change("modules = 8", "modules = 0").contains("1 to 64"));
        assert!(change("modules = 8", "modules = 65").contains("1 to 64"));
        assert!(change("link_mass = 0.00294", "link_mass = -1.0").contains("link_mass = -1"));
        assert!(change("link_mass", "link_maas").contains("link_maas"));
        assert!(change("gravity = 196.2", "gravity = nan").contains("gravity"));
        assert!(
            change("slip_speed = 0.05", "slip_speed = 0.0").contains("slip_speed = 0; it must be a number above zero")
        );
        assert!(change("contact_stiffness = 2000.0", "contact_stiffness = -1.0").contains("contact_stiffness = -1"));
        assert!(change("physics_step = 0.005", "physics_step = 0.003").contains("a whole part of it"));
        assert!(change("\"direct\"", "\"mujoco\"").contains("solver"));
        assert!(change("links_per_module = 4", "links_per_module = 5").contains("2 to 4"));
    }
}
