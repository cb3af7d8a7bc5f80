//! Open-loop experiments: the same torques on different physics. What a solver gets wrong shows as a distance from a reference that is far finer.
//!
//! | experiment | torques | what it asks for |
//! |---|---|---|
//! | gait | a yaw wave of 1 Hz at 0.8 of the limit, 10 s | dry friction under sliding: it is all that drives |
//! | lift | the front third pitched up and held, 3 s | springs, motors and load |
//! | wall | a gait against a wall 1 unit ahead, 5 s | stiff contacts under full torque |
//! | tube | a gait between walls 1.6 units apart, 5 s | every module wedged from both sides |
//! | block | a gait into a block 2 units ahead, 5 s | a body that gives way, and its friction on the ground |
//!
//! Commands change every 0.01 s, so that they are the same for every step of the physics; motors slew at 400 a second, fast enough for the wave.

use std::f32::consts::TAU;

use super::scene::{Block, Scene, Solid};
use super::{Effort, Snake};
use crate::robot::Robot;

/// Time between two commands, s.
const COMMAND: f32 = 0.01;

/// Torques and a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experiment {
    /// On open ground.
    Gait,
    /// The front third of the snake in the air.
    Lift,
    /// Pressing on a wall.
    Wall,
    /// Wedged in a tube.
    Tube,
    /// Pushing a block.
    Block,
}

/// What an experiment came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Places of the centres of the links at the end, world, units.
    pub links: Vec<[f32; 3]>,
    /// Place of the block at the end.
    pub block: Option<[f32; 3]>,
    /// Deepest contact at any control step, units; the direct solver alone knows.
    pub penetration: f32,
    /// Widest joint at any control step, units.
    pub joint_gap: f32,
    /// Kinetic and potential energy at the end, kg units^2 / s^2.
    pub energy: f32,
    /// What the direct solver did.
    pub effort: Effort,
}

impl Outcome {
    /// Place of the centre of mass of the snake.
    pub fn centre(&self) -> [f32; 3] {
        let share = 1.0 / self.links.len().max(1) as f32;
        [0, 1, 2].map(|axis| self.links.iter().map(|p| p[axis]).sum::<f32>() * share)
    }

    /// Root of the mean square distance of the links from where another result has them, units.
    pub fn distance(&self, other: &Outcome) -> f32 {
        let square = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>();
        (self.links.iter().zip(&other.links).map(square).sum::<f32>() / self.links.len().max(1) as f32).sqrt()
    }
}

impl Experiment {
    /// All of them.
    pub const ALL: [Experiment; 5] =
        [Experiment::Gait, Experiment::Lift, Experiment::Wall, Experiment::Tube, Experiment::Block];

    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Experiment::Gait => "gait",
            Experiment::Lift => "lift",
            Experiment::Wall => "wall",
            Experiment::Tube => "tube",
            Experiment::Block => "block",
        }
    }

    /// How long it takes, s.
    pub fn seconds(self) -> f32 {
        match self {
            Experiment::Gait => 10.0,
            Experiment::Lift => 3.0,
            _ => 5.0,
        }
    }

    /// What stands on the ground.
    pub fn scene(self) -> Scene {
        let solid = |half, position| Solid { half, position, yaw: 0.0, roll: 0.0 };
        match self {
            Experiment::Gait | Experiment::Lift => Scene::default(),
            Experiment::Wall => Scene { solids: vec![solid([0.5, 20.0, 2.0], [2.15, 0.0, 2.0])], block: None },
            Experiment::Tube => Scene {
                solids: vec![solid([40.0, 0.5, 2.0], [0.0, 1.3, 2.0]), solid([40.0, 0.5, 2.0], [0.0, -1.3, 2.0])],
                block: None,
            },
            Experiment::Block => {
                let block =
                    Block { half: [1.0, 1.0, 0.5], position: [3.65, 0.3, 0.5], yaw: 0.2, mass: 0.01, friction: 0.5 };
                Scene { solids: Vec::new(), block: Some(block) }
            }
        }
    }

    /// Torque of a module, yaw and pitch, as a share of the limit. A wave that lags from tail to head drives the snake forward, one that
    /// lags from head to tail backward.
    pub fn torque(self, time: f32, module: usize, modules: usize) -> [f32; 2] {
        let wave = |lag: f32| 0.8 * libm::sinf(TAU * time + lag * module as f32);
        match self {
            Experiment::Gait => [wave(2.0), 0.0],
            Experiment::Lift => {
                let third = modules.div_ceil(3);
                let up = if module < third { 0.3 * (time / 1.0).min(1.0) } else { 0.0 };
                [0.0, up]
            }
            _ => [wave(-2.0), 0.0],
        }
    }

    /// The robot that it is done with: motors that can follow the wave.
    pub fn robot(self, robot: &Robot) -> Robot {
        Robot { torque_slew: 400.0, ..robot.clone() }
    }

    /// Does it.
    pub fn run(self, robot: &Robot) -> Outcome {
        let robot = self.robot(robot);
        let mut snake = Snake::in_scene(&robot, &self.scene());
        let steps = snake.steps_in(COMMAND);
        let commands = (self.seconds() / COMMAND).round() as usize;
        let mut result = Outcome::default();
        for command in 0..commands {
            let time = command as f32 * COMMAND;
            for module in 0..robot.modules {
                let torque = self.torque(time, module, robot.modules).map(|t| t * robot.torque_limit);
                snake.set_torque(module, torque);
            }
            (0..steps).for_each(|_| snake.step());
            if command % 5 == 4 {
                result.penetration = result.penetration.max(snake.penetration());
                result.joint_gap = result.joint_gap.max(snake.joint_gap());
            }
        }
        result.links = snake.poses().map(|(position, _)| position).collect();
        result.block = snake.block().map(|(position, _)| position);
        result.energy = snake.energy();
        result.effort = snake.effort();
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::Solver;

    #[test]
    fn the_default_step_is_converged() {
        let robot = Robot::default();
        let fine = Robot {
            physics_step: robot.physics_step / 8.0,
            solver_tolerance: 0.01 * robot.solver_tolerance,
            ..robot.clone()
        };
        for experiment in [Experiment::Gait, Experiment::Lift] {
            let (coarse, fine) = (experiment.run(&robot), experiment.run(&fine));
            let way = (0..3).map(|k| (fine.centre()[k] - experiment.start(&robot)[k]).powi(2)).sum::<f32>().sqrt();
            let error = (0..3).map(|k| (fine.centre()[k] - coarse.centre()[k]).powi(2)).sum::<f32>().sqrt();
            assert!(error < 0.01 * way.max(1.0), "{}: {error} of {way}", experiment.name());
            assert!(coarse.joint_gap < 1e-3 * robot.link_length);
            assert!(coarse.penetration < 0.02 * 2.0 * robot.link_radius, "{}", coarse.penetration);
        }
    }

    #[test]
    fn rapiers_own_solver_agrees() {
        let distance = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt();
        for experiment in Experiment::ALL {
            let run = |solver| experiment.run(&Robot { solver, ..Robot::default() });
            let (direct, rapier) = (run(Solver::Direct), run(Solver::Rapier));
            let way = distance(direct.links[0], [0.0; 3]);
            let apart = direct.distance(&rapier);
            // Different regularisations of friction, different contacts: a few percent.
            assert!(apart < 0.05 * way.max(5.0), "{}: {apart} of {way}", experiment.name());
            if let (Some(a), Some(b)) = (direct.block, rapier.block) {
                assert!(distance(a, b) < 0.5, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn a_tighter_tolerance_changes_nothing() {
        let robot = Robot::default();
        let tight = Robot { solver_tolerance: 0.01 * robot.solver_tolerance, ..robot.clone() };
        for experiment in Experiment::ALL {
            let apart = experiment.run(&robot).distance(&experiment.run(&tight));
            assert!(apart < 0.1, "{}: {apart}", experiment.name());
        }
    }

    #[test]
    fn wall_tube_and_block_are_touched() {
        let robot = Robot::default();
        let tube = Experiment::Tube.run(&robot);
        assert!(tube.penetration > 5e-4, "{tube:?}");
        assert!(tube.links.iter().all(|p| p[1].abs() < 0.8 - robot.link_radius + 0.05), "{tube:?}");
        let wall = Experiment::Wall.run(&robot);
        assert!(wall.links[0][0] > 0.9 && wall.penetration > 1e-3, "{wall:?}");
        let block = Experiment::Block.run(&robot);
        assert!(block.block.unwrap()[0] > 4.0, "{block:?}");
    }

    impl Experiment {
        fn start(self, robot: &Robot) -> [f32; 3] {
            [-0.5 * (robot.links() - 1) as f32 * robot.link_length, 0.0, robot.link_radius]
        }
    }
}
