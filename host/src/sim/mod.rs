//! The snake and its scene, simulated.
//!
//! A chain of capsules joined by hinges. Each joint feels `tau - k q - c w`: the motor's torque, a spring that pulls it straight, and the
//! slope `c = tau_max / no-load speed` of the motor's torque-speed line. Whatever a link touches rubs on it dry and anisotropically
//! ([`contact`]). All of it is implicit.
//!
//! | part | whose | why |
//! |---|---|---|
//! | velocities of chain and block ([`chain`]) | ours | rapier's iterations do not converge a chain of 32 links at an affordable number |
//! | law of contact and friction ([`contact`]) | ours | rapier has one coefficient of friction a contact, none along and across |
//! | collision of capsules, ground and boxes ([`collide`]) | ours, analytic; rapier's is the test's oracle | four times faster than the general pipeline |
//! | shapes, joints, solver of the second opinion (`rapier`) | rapier | a simulator that nobody here wrote, in the same process |
//!
//! World frame: x and y horizontal, z up; the snake lies along x with its head towards +x.

use composer_shared::observation::Sensors;
use composer_shared::robot::{self, AXES, Geometry, MAX_JOINTS};
use composer_sim_bridge::sensor_model::{Mean, ModuleSensorState, PERIOD, SensorModel, Truth};
use rapier3d::math::{Pose, Rotation, Vector};

use crate::robot::{Robot, Solver};

pub mod chain;
pub mod collide;
pub mod contact;
pub mod open_loop;
mod rapier;
pub mod scene;

pub use chain::Effort;
pub use scene::Scene;

/// Counts the changes of the physics that change what episodes come to: what was measured on another count is measured again.
///
/// 2: steps that did not converge do (`chain.rs`).
pub const PHYSICS: u32 = 2;

/// Temperature of the motors, which is not simulated, degrees Celsius.
const AMBIENT: f32 = 25.0;

/// Extremes of the motion, for the sanity of what was learnt.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion {
    /// Fastest link since the last reset, units/s.
    pub peak_link_speed: f32,
    /// Highest link centre since the last reset, units above the ground.
    pub peak_height: f32,
    /// Fastest joint since the last reset, rad/s.
    pub peak_joint_speed: f32,
}

/// Where a rigid body is and how it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkState {
    /// Centre of mass, world, units.
    pub position: [f32; 3],
    /// Rotation, quaternion x, y, z, w.
    pub rotation: [f32; 4],
    /// Velocity of the centre of mass, world, units/s.
    pub linear: [f32; 3],
    /// Angular velocity, world, rad/s.
    pub angular: [f32; 3],
}

impl LinkState {
    const REST: LinkState =
        LinkState { position: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], linear: [0.0; 3], angular: [0.0; 3] };

    fn turn(&self) -> Rotation {
        Rotation::from_array(self.rotation)
    }

    fn pose(&self) -> Pose {
        Pose::from_parts(Vector::from(self.position), self.turn())
    }

    fn seen(&self, vector: [f32; 3]) -> [f32; 3] {
        (self.turn().inverse() * Vector::from(vector)).to_array()
    }
}

/// Everything that moves.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Links, from the head on.
    pub links: Vec<LinkState>,
    /// Angle of each joint, head first, rad; even joints yaw, odd joints pitch.
    pub joint_angles: Vec<f32>,
    /// Speed of each joint, rad/s.
    pub joint_speeds: Vec<f32>,
    /// The block, if there is one.
    pub block: Option<LinkState>,
}

/// What moves the snake.
enum Engine {
    Direct(Box<chain::Chain>),
    Rapier(Box<rapier::RapierSnake>),
    /// Something else, elsewhere, that says where it is ([`Snake::follow`]).
    Mirror,
}

/// The sensors of one module, and what they felt since their last sample.
struct Suite {
    sensors: ModuleSensorState,
    mean: Mean,
    /// Velocity of the own link after the last physics step.
    velocity: Vector,
}

/// The snake and its scene.
pub struct Snake {
    robot: Robot,
    engine: Engine,
    state: State,
    /// Torque on each axis of each module now, and where it is heading.
    torque: Vec<[f32; AXES]>,
    command: Vec<[f32; AXES]>,
    /// Torque of each module's motors for a torque of 1, and what acts on the joints.
    strength: Vec<f32>,
    acting: Vec<[f32; AXES]>,
    motion: Motion,
    block: Option<scene::Block>,
    /// Sensors as their datasheets have them; without, a module senses the truth.
    suites: Vec<Suite>,
    /// Physics steps since the sensors were fitted.
    steps: usize,
}

impl Snake {
    /// A straight snake at rest on level ground, its head link centred at the origin.
    pub fn new(robot: &Robot) -> Self {
        Self::in_scene(robot, &Scene::default())
    }

    /// The same with something else on the ground.
    pub fn in_scene(robot: &Robot, scene: &Scene) -> Self {
        let engine = match robot.solver {
            Solver::Direct => Engine::Direct(Box::new(chain::Chain::new(robot, scene))),
            Solver::Rapier => Engine::Rapier(Box::new(rapier::RapierSnake::new(robot, scene))),
        };
        Self::with_engine(robot, scene, engine)
    }

    /// A snake that something else moves: it only shows what [`Snake::follow`] tells.
    pub fn mirror(robot: &Robot, scene: &Scene) -> Self {
        Self::with_engine(robot, scene, Engine::Mirror)
    }

    fn with_engine(robot: &Robot, scene: &Scene, engine: Engine) -> Self {
        let links = robot.links();
        let place = |link: usize| LinkState {
            position: [-(link as f32) * robot.link_length, 0.0, robot.link_radius],
            ..LinkState::REST
        };
        let block = scene.block.map(|block| LinkState {
            position: block.position,
            rotation: block.rotation(),
            ..LinkState::REST
        });
        let mut snake = Snake {
            robot: robot.clone(),
            engine,
            state: State {
                links: (0..links).map(place).collect(),
                joint_angles: vec![0.0; links - 1],
                joint_speeds: vec![0.0; links - 1],
                block,
            },
            torque: vec![[0.0; AXES]; robot.modules],
            command: vec![[0.0; AXES]; robot.modules],
            strength: vec![1.0; robot.modules],
            acting: vec![[0.0; AXES]; robot.modules],
            motion: Motion::default(),
            block: scene.block,
            suites: Vec::new(),
            steps: 0,
        };
        snake.read();
        snake
    }

    /// Fits every module with sensors that have noise, offsets and filters, drawn with `seed`, after a rest where the snake is now.
    pub fn fit_sensors(&mut self, model: &SensorModel, seed: u64) {
        self.steps = 0;
        self.suites = (0..self.robot.modules)
            .map(|module| {
                let mut sensors = ModuleSensorState::new(model, crate::methods::mix(seed ^ (module as u64) << 32));
                let force = self.own_link(module).seen(self.up());
                sensors.rest(&self.truth(module, force, [0.0; 3]));
                Suite { sensors, mean: Mean::default(), velocity: Vector::ZERO }
            })
            .collect();
    }

    /// What there is to sense of a module: its joints now, and the specific force (g) and angular rate (rad/s) it felt.
    fn truth(&self, module: usize, specific_force: [f32; 3], angular_rate: [f32; 3]) -> Truth {
        let links = self.robot.links_per_module;
        let mut truth = Truth { specific_force, angular_rate, ..Truth::default() };
        for k in 0..links.min(MAX_JOINTS) {
            let index = module * links + k;
            if index < self.state.joint_angles.len() {
                truth.joint_angles[k] = self.state.joint_angles[index];
                truth.joint_speeds[k] = self.state.joint_speeds[index];
                truth.joints = k + 1;
            }
        }
        truth
    }

    /// Lets the sensors feel the last physics step, and sample when it is time.
    fn sense(&mut self) {
        let (dt, gravity) = (self.robot.physics_step, self.robot.gravity);
        let fall = Vector::from(self.robot.gravity_vector());
        self.steps += 1;
        let sample = self.steps.is_multiple_of((PERIOD / dt).round().max(1.0) as usize);
        for module in 0..self.suites.len() {
            let own = *self.own_link(module);
            let suite = &mut self.suites[module];
            let velocity = Vector::from(own.linear);
            let force = ((velocity - suite.velocity) / dt - fall) / gravity;
            suite.velocity = velocity;
            suite.mean.add(own.seen(force.to_array()), own.seen(own.angular), dt);
            if sample {
                let (force, rate) = suite.mean.take();
                let truth = self.truth(module, force, rate);
                self.suites[module].sensors.update(&truth);
            }
        }
    }

    /// The direction against gravity, a unit vector.
    fn up(&self) -> [f32; 3] {
        self.robot.gravity_vector().map(|g| -g / self.robot.gravity)
    }

    /// How strong each module's motors are, as a factor of the torque they are told; those that are not named are nominal.
    pub fn set_strength(&mut self, strength: &[f32]) {
        self.strength.iter_mut().zip(strength).for_each(|(own, new)| *own = *new);
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// Physics steps taken in `seconds`.
    pub fn steps_in(&self, seconds: f32) -> usize {
        (seconds / self.robot.physics_step).round() as usize
    }

    /// The torque (robot units) that a module commands; its motors slew towards it from the next step on.
    pub fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        self.command[module] = torque.map(|t| t.clamp(-self.robot.torque_limit, self.robot.torque_limit));
    }

    /// The torque that a module's motors are told now; a motor that is not nominal puts another one on its joints.
    pub fn torque(&self, module: usize) -> [f32; AXES] {
        self.torque[module]
    }

    /// Lets the motors slew for one physics step, and returns the torques that act in it: yaw and pitch of each module.
    pub fn slew(&mut self) -> &[[f32; AXES]] {
        let step = self.robot.torque_slew * self.robot.physics_step;
        for (module, (torque, command)) in self.torque.iter_mut().zip(&self.command).enumerate() {
            for axis in 0..AXES {
                torque[axis] = robot::slew(torque[axis], command[axis], step);
                self.acting[module][axis] = self.strength[module] * torque[axis];
            }
        }
        &self.acting
    }

    /// Advances by one physics step.
    pub fn step(&mut self) {
        self.slew();
        match &mut self.engine {
            Engine::Direct(chain) => chain.step(&self.robot, &self.acting),
            Engine::Rapier(world) => world.step(&self.robot, &self.acting, &self.state.joint_speeds),
            Engine::Mirror => {}
        }
        self.read();
        self.watch();
    }

    /// Takes over where everything is, for a snake that something else moves.
    pub fn follow(&mut self, state: &State) {
        self.state.clone_from(state);
        self.watch();
    }

    fn read(&mut self) {
        match &self.engine {
            Engine::Direct(chain) => chain.write(&mut self.state),
            Engine::Rapier(world) => world.write(&self.robot, &mut self.state),
            Engine::Mirror => {}
        }
    }

    fn watch(&mut self) {
        let motion = &mut self.motion;
        for link in &self.state.links {
            motion.peak_link_speed = motion.peak_link_speed.max(Vector::from(link.linear).length());
            motion.peak_height = motion.peak_height.max(link.position[2]);
        }
        for speed in &self.state.joint_speeds {
            motion.peak_joint_speed = motion.peak_joint_speed.max(speed.abs());
        }
        if !self.suites.is_empty() {
            self.sense();
        }
    }

    /// Where everything is, and how it moves.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// What the direct solver did so far; nothing of another.
    pub fn effort(&self) -> Effort {
        match &self.engine {
            Engine::Direct(chain) => chain.effort(),
            _ => Effort::default(),
        }
    }

    /// How deep the deepest contact of the snake is now, units; the direct solver alone knows.
    pub fn penetration(&mut self) -> f32 {
        match &mut self.engine {
            Engine::Direct(chain) => chain.penetration(&self.robot),
            _ => 0.0,
        }
    }

    /// Position and rotation (quaternion x, y, z, w) of the block, if there is one.
    pub fn block(&self) -> Option<([f32; 3], [f32; 4])> {
        self.state.block.map(|block| (block.position, block.rotation))
    }

    /// Where a module is: the centre of its own link, units.
    pub fn module_position(&self, module: usize) -> [f32; 3] {
        self.own_link(module).position
    }

    /// Rotation of a module's own frame, quaternion x, y, z, w.
    pub fn module_rotation(&self, module: usize) -> [f32; 4] {
        self.own_link(module).rotation
    }

    /// Centre of the last link in the world.
    pub fn tail(&self) -> [f32; 3] {
        self.state.links[self.state.links.len() - 1].position
    }

    /// What a module's sensors say: their last sample, or the truth if none were fitted.
    pub fn sensors(&self, module: usize) -> Sensors {
        let torque = self.torque[module].map(|t| t / self.robot.torque_limit);
        if let Some(suite) = self.suites.get(module) {
            return suite.sensors.sensors(torque, AMBIENT);
        }
        let own = self.own_link(module);
        let truth = self.truth(module, [0.0; 3], [0.0; 3]);
        Sensors {
            joint_angles: truth.joint_angles,
            joint_speeds: truth.joint_speeds,
            up: own.seen(self.up()),
            angular_rate: own.seen(own.angular),
            torque,
            temperature: AMBIENT,
        }
    }

    fn own_link(&self, module: usize) -> &LinkState {
        let own = Geometry::OWN_LINK.min(self.robot.links_per_module - 1);
        &self.state.links[module * self.robot.links_per_module + own]
    }

    /// What no real module could measure, for the critic of the training alone: linear velocity in the own frame (units/s) and height of the own link.
    pub fn privileged(&self, module: usize) -> ([f32; 3], f32) {
        let own = self.own_link(module);
        (own.seen(own.linear), own.position[2])
    }

    /// A world point in the own frame of a module.
    pub fn in_own_frame(&self, module: usize, point: [f32; 3]) -> [f32; 3] {
        self.own_link(module).pose().inverse_transform_point(Vector::from(point)).to_array()
    }

    /// Centre of the head link in the world.
    pub fn head(&self) -> [f32; 3] {
        self.state.links[0].position
    }

    /// A world point in the frame of the head link.
    pub fn in_head_frame(&self, point: [f32; 3]) -> [f32; 3] {
        self.state.links[0].pose().inverse_transform_point(Vector::from(point)).to_array()
    }

    /// Distance of the centre of the head link to a world point.
    pub fn head_distance(&self, point: [f32; 3]) -> f32 {
        Vector::from(self.head()).distance(Vector::from(point))
    }

    /// Position and rotation (quaternion x, y, z, w) of every link, from the head on.
    pub fn poses(&self) -> impl Iterator<Item = ([f32; 3], [f32; 4])> + '_ {
        self.state.links.iter().map(|link| (link.position, link.rotation))
    }

    /// Height of the highest link centre now, units above the ground.
    pub fn height(&self) -> f32 {
        self.state.links.iter().map(|link| link.position[2]).fold(0.0, f32::max)
    }

    /// Kinetic plus potential energy (gravity and joint springs) of snake and block, for tests of the physics.
    pub fn energy(&self) -> f32 {
        let robot = &self.robot;
        let square = |v: [f32; 3]| v.iter().map(|x| x * x).sum::<f32>();
        let fall = Vector::from(robot.gravity_vector());
        let lifted = |position: [f32; 3]| -fall.dot(Vector::from(position));
        let links = self.state.links.iter().map(|link| {
            0.5 * robot.link_mass * square(link.linear)
                + 0.5 * robot.link_inertia * square(link.angular)
                + robot.link_mass * lifted(link.position)
        });
        let springs = self.state.joint_angles.iter().map(|angle| 0.5 * robot.stiffness * angle * angle);
        let block = self.state.block.zip(self.block).map_or(0.0, |(state, block)| {
            let spin = state.seen(state.angular);
            let turning: f32 = spin.iter().zip(block.moments()).map(|(w, moment)| 0.5 * moment * w * w).sum();
            turning + block.mass * (0.5 * square(state.linear) + lifted(state.position))
        });
        links.sum::<f32>() + springs.sum::<f32>() + block
    }

    /// Largest distance between the two halves of a joint, units: how far the solver let the chain come apart.
    pub fn joint_gap(&self) -> f32 {
        let half = Vector::new(0.5 * self.robot.link_length, 0.0, 0.0);
        let gap =
            |pair: &[LinkState]| pair[0].pose().transform_point(-half).distance(pair[1].pose().transform_point(half));
        self.state.links.windows(2).map(gap).fold(0.0, f32::max)
    }

    /// Extremes of the motion so far.
    pub fn motion(&self) -> Motion {
        self.motion
    }
}

#[cfg(test)]
impl Snake {
    /// The direct solver's own state.
    fn chain(&mut self) -> &mut chain::Chain {
        match &mut self.engine {
            Engine::Direct(chain) => chain,
            _ => unreachable!("these tests run on the direct solver"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten seconds of a travelling wave; `phase` is the lag from module to module. Returns the head's displacement along x.
    fn wave(robot: &Robot, phase: f32) -> (f32, Snake) {
        let mut snake = Snake::new(robot);
        for step in 0..snake.steps_in(10.0) {
            let time = step as f32 * robot.physics_step;
            for module in 0..robot.modules {
                let yaw = 0.8 * robot.torque_limit * libm::sinf(std::f32::consts::TAU * time + phase * module as f32);
                snake.set_torque(module, [yaw, 0.0]);
            }
            snake.step();
        }
        (snake.head()[0], snake)
    }

    #[test]
    fn a_wave_propels_the_snake_against_it_and_only_with_anisotropic_friction() {
        // Motors that can follow a wave of 1 Hz.
        let robot = Robot { torque_slew: 400.0, ..Robot::default() };
        let (backward, snake) = wave(&robot, 2.0);
        let (forward, _) = wave(&robot, -2.0);
        let (isotropic, _) = wave(&Robot { friction_along: 1.0, ..robot.clone() }, 2.0);
        assert!(backward < -8.0 && forward > 8.0, "{backward} {forward}");
        assert!(isotropic.abs() < 0.25 * forward, "{isotropic}");
        assert!(snake.joint_gap() < 0.01, "{}", snake.joint_gap());
        assert!(snake.motion().peak_joint_speed < 3.0, "{:?}", snake.motion());
        assert!(snake.motion().peak_height < 0.5, "{:?}", snake.motion());
    }

    #[test]
    fn the_same_torques_give_the_same_bits() {
        let robot = Robot::default();
        let ((a, snake_a), (b, snake_b)) = (wave(&robot, 2.0), wave(&robot, 2.0));
        assert_eq!(a.to_bits(), b.to_bits());
        assert!(snake_a.poses().eq(snake_b.poses()));
    }

    #[test]
    fn a_snake_at_rest_stays_at_rest() {
        let mut snake = Snake::new(&Robot::default());
        (0..snake.steps_in(5.0)).for_each(|_| snake.step());
        let [x, y, z] = snake.head();
        assert!(x.abs() < 0.01 && y.abs() < 0.01 && (z - 0.4).abs() < 0.02, "{x} {y} {z}");
    }

    #[test]
    fn energy_does_not_grow_with_the_motors_off() {
        let mut snake = Snake::new(&Robot::default());
        for module in 0..8 {
            snake.set_torque(module, [80.0, if module % 2 == 0 { 60.0 } else { -60.0 }]);
        }
        (0..snake.steps_in(0.6)).for_each(|_| snake.step());
        (0..8).for_each(|module| snake.set_torque(module, [0.0; 2]));
        (0..snake.steps_in(0.3)).for_each(|_| snake.step());
        let mut energy = snake.energy();
        let start = energy;
        for _ in 0..40 {
            (0..snake.steps_in(0.05)).for_each(|_| snake.step());
            let now = snake.energy();
            assert!(now <= energy + 0.02 * start, "{energy} -> {now}");
            energy = now;
        }
        assert!(energy < 0.8 * start, "{start} -> {energy}");
    }

    #[test]
    fn sensors_and_chain_kinematics_agree_with_the_simulated_truth() {
        let robot = Robot::default();
        let (_, mut snake) = wave(&robot, 1.3);
        for module in 0..8 {
            snake.set_torque(module, [25.0, -8.0 + 2.0 * module as f32]);
        }
        (0..snake.steps_in(1.5)).for_each(|_| snake.step());
        let mut chain = composer_shared::kinematics::Chain::new(robot.geometry());
        for module in 0..robot.modules {
            chain.hear(module, &snake.sensors(module).joint_angles);
        }
        let goal = [7.0, -4.0, 0.4];
        for module in 0..robot.modules {
            let through_chain = chain.head_seen_from(module).point(snake.in_head_frame(goal).into());
            let truth = snake.in_own_frame(module, goal);
            let error = (0..3).map(|i| (through_chain[i] - truth[i]).abs()).fold(0.0, f32::max);
            let distance = truth.iter().map(|v| v * v).sum::<f32>().sqrt();
            // The chain assumes perfect hinges; under full torque the solver lets them give a little.
            assert!(error < 0.02 * distance, "module {module}: {through_chain:?} against {truth:?}");
        }
    }
}
