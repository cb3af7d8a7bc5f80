//! What stands on the ground besides the snake.

use rapier3d::math::{Rotation, Vector};

/// A box that does not move: a wall, a panel of a tube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solid {
    /// Half of each edge along its own axes, units.
    pub half: [f32; 3],
    /// Centre in the world, units.
    pub position: [f32; 3],
    /// Turn about the world's z axis, rad; after `roll`.
    pub yaw: f32,
    /// Turn about its own x axis, rad.
    pub roll: f32,
}

impl Solid {
    /// Its rotation, quaternion x, y, z, w.
    pub fn rotation(&self) -> [f32; 4] {
        let ((sy, cy), (sr, cr)) = (libm::sincosf(0.5 * self.yaw), libm::sincosf(0.5 * self.roll));
        [cy * sr, sy * sr, sy * cr, cy * cr]
    }

    /// The share of the straight way between two points of the world that lies before this box, grown by `margin` on all sides; 1 if the way does not
    /// enter it, or begins in it.
    pub fn entered(&self, from: [f32; 3], to: [f32; 3], margin: f32) -> f32 {
        let back = Rotation::from_array(self.rotation()).inverse();
        let local = |p: [f32; 3]| (back * (Vector::from(p) - Vector::from(self.position))).to_array();
        let (a, b) = (local(from), local(to));
        let (mut enters, mut leaves) = (0.0f32, 1.0f32);
        let mut inside = true;
        for axis in 0..3 {
            let half = self.half[axis] + margin;
            inside &= a[axis].abs() < half;
            let way = b[axis] - a[axis];
            if way == 0.0 {
                if a[axis].abs() >= half {
                    return 1.0;
                }
                continue;
            }
            let (near, far) = ((-half - a[axis]) / way, (half - a[axis]) / way);
            enters = enters.max(near.min(far));
            leaves = leaves.min(near.max(far));
        }
        if inside || enters >= leaves { 1.0 } else { enters }
    }
}

/// A box that can be pushed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// Half of each edge, units.
    pub half: [f32; 3],
    /// Centre in the world at the start, units.
    pub position: [f32; 3],
    /// Turn about the world's z axis at the start, rad.
    pub yaw: f32,
    /// Mass, kg.
    pub mass: f32,
    /// Coefficient of its friction on ground and solids, the same in every direction. On the snake's body it is the snake's own.
    pub friction: f32,
}

/// Everything on the ground besides the snake.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// What does not move.
    pub solids: Vec<Solid>,
    /// What can be pushed.
    pub block: Option<Block>,
}

impl Block {
    /// Its rotation at the start, quaternion x, y, z, w.
    pub fn rotation(&self) -> [f32; 4] {
        let (sin, cos) = libm::sincosf(0.5 * self.yaw);
        [0.0, 0.0, sin, cos]
    }

    /// Moments of inertia about its own axes, kg units^2: those of a box that is as heavy everywhere.
    pub fn moments(&self) -> [f32; 3] {
        let ([x, y, z], third) = (self.half.map(|h| h * h), self.mass / 3.0);
        [y + z, x + z, x + y].map(|squares| squares * third)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{LinkState, Snake};
    use super::*;
    use crate::robot::Robot;

    const BLOCK: Block =
        Block { half: [0.75, 0.75, 0.5], position: [3.0, 0.0, 0.5], yaw: 0.3, mass: 0.01, friction: 0.5 };

    fn wall(position: [f32; 3], half: [f32; 3]) -> Scene {
        Scene { solids: vec![Solid { half, position, yaw: 0.0, roll: 0.0 }], block: None }
    }

    /// Moves the whole snake.
    fn shift(snake: &mut Snake, by: [f32; 3]) {
        snake.chain().shift(by);
        snake.read();
    }

    /// Sets the velocity of every link.
    fn throw(snake: &mut Snake, velocity: [f32; 3]) {
        snake.chain().throw(velocity);
        snake.read();
    }

    fn speed(link: &LinkState) -> f32 {
        link.linear.iter().map(|v| v * v).sum::<f32>().sqrt()
    }

    /// Two seconds with the motors off. The energy never rises above what it was within the last quarter of a second, for so long the
    /// solver's give in joints and contacts can keep it, by more than half a percent; returns the share left.
    fn energy_falls(snake: &mut Snake) -> f32 {
        (0..snake.robot().modules).for_each(|module| snake.set_torque(module, [0.0; 2]));
        // Until the slew has brought the torques down.
        while (0..snake.robot().modules).any(|module| snake.torque(module) != [0.0; 2]) {
            snake.step();
        }
        let rest = Snake::new(snake.robot()).energy();
        let mut energy = vec![snake.energy()];
        for step in 0..40 {
            (0..snake.steps_in(0.05)).for_each(|_| snake.step());
            let before = energy.iter().rev().take(5).fold(0.0, |a: f32, b| a.max(*b));
            energy.push(snake.energy());
            assert!(snake.energy() <= before + 0.005 * energy[0], "step {step}: {energy:?}");
        }
        assert!(snake.energy() > 0.9 * rest, "the snake has sunk: {energy:?}");
        snake.energy() / energy[0]
    }

    #[test]
    fn energy_does_not_grow_with_the_motors_off_against_walls_and_blocks() {
        let robot = Robot::default();
        // Thrown at a wall, head first and sideways.
        for (scene, velocity) in [
            (wall([1.5, 0.0, 1.0], [0.5, 20.0, 1.0]), [20.0, 0.0, 0.0]),
            (wall([0.0, 1.5, 1.0], [40.0, 0.5, 1.0]), [0.0, 20.0, 0.0]),
            // A block, and a block with a wall behind it.
            (Scene { block: Some(BLOCK), ..Scene::default() }, [20.0, 0.0, 0.0]),
            (Scene { block: Some(BLOCK), ..wall([4.6, 0.0, 1.0], [0.5, 20.0, 1.0]) }, [20.0, 0.0, 0.0]),
        ] {
            let mut snake = Snake::in_scene(&robot, &scene);
            throw(&mut snake, velocity);
            let left = energy_falls(&mut snake);
            assert!(left < 0.95, "{left}");
        }
        // Pressed against a wall at full torque, then let go.
        let mut snake = Snake::in_scene(&robot, &wall([-8.0, 1.0, 1.0], [10.0, 0.5, 1.0]));
        (0..8).for_each(|module| snake.set_torque(module, [if module % 2 == 0 { 80.0 } else { -80.0 }, 40.0]));
        (0..snake.steps_in(1.0)).for_each(|_| snake.step());
        energy_falls(&mut snake);
        // Dropped across a wall and onto a block.
        for scene in [
            wall([-8.0, 0.0, 0.5], [0.5, 5.0, 0.5]),
            Scene { block: Some(Block { position: [-5.0, 0.0, 0.5], ..BLOCK }), ..Scene::default() },
        ] {
            let mut snake = Snake::in_scene(&robot, &scene);
            shift(&mut snake, [0.0, 0.0, 2.0]);
            energy_falls(&mut snake);
        }
    }

    /// What a training came upon once in 7,000 episodes: the head of nine modules meets a block's face with its end, on a robot and a floor as in `hit.json`,
    /// told these torques. Newton's steps alone lead ever further away there and threw snake and block off with 30,000 units/s.
    #[test]
    fn a_hit_that_newtons_steps_lead_away_from_converges_with_the_loads_of_friction_held() {
        #[derive(serde::Deserialize)]
        struct Hit {
            robot: Robot,
            block: Place,
            strength: Vec<f32>,
            /// Physics steps from the beginning of a control step to its torques.
            delay: usize,
            torques: Vec<Vec<[f32; 2]>>,
        }
        #[derive(serde::Deserialize)]
        struct Place {
            position: [f32; 3],
            yaw: f32,
        }
        let hit: Hit = serde_json::from_str(include_str!("hit.json")).unwrap();
        let block = Block { half: [1.0, 1.0, 0.5], position: hit.block.position, yaw: hit.block.yaw, ..BLOCK };
        let mut snake = Snake::in_scene(&hit.robot, &Scene { block: Some(block), ..Scene::default() });
        snake.set_strength(&hit.strength);
        for torques in &hit.torques {
            for step in 0..snake.steps_in(0.05) {
                if step == hit.delay {
                    torques.iter().enumerate().for_each(|(module, torque)| snake.set_torque(module, *torque));
                }
                snake.step();
            }
        }
        let effort = snake.effort();
        assert!(effort.held >= 1 && effort.capped == 0, "{effort:?}");
        assert!(snake.motion().peak_link_speed < 25.0, "{:?}", snake.motion());
        let pushed = snake.state().block.unwrap();
        assert!(speed(&pushed) < 15.0 && pushed.position[0] > block.position[0], "{pushed:?}");
    }

    /// The same elsewhere: snakes that writhe into a block or a wall, each with another floor and other motions.
    #[test]
    fn every_step_converges_whatever_is_hit_and_nothing_is_thrown_off() {
        let mut held = [0; 2];
        // Of the first 2,000 those where it happens, some of them.
        for number in [68, 208, 405, 568, 809, 1023, 1224, 1922u64] {
            let draw = |what: u64, low: f32, high: f32| {
                let bits = crate::methods::mix(number << 8 | what) >> 40;
                low + (high - low) * bits as f32 / (1u64 << 24) as f32
            };
            let robot = Robot {
                friction_across: draw(0, 0.7, 1.3),
                contact_stiffness: draw(1, 0.5, 2.0) * Robot::default().contact_stiffness,
                ..Robot::default()
            };
            let kind = (number % 2) as usize;
            let scene = match kind {
                0 => {
                    let position = [draw(2, 2.0, 4.0), draw(3, -1.5, 1.5), 0.5];
                    let block = Block { half: [1.0, 1.0, 0.5], position, yaw: draw(4, 0.0, 3.0), ..BLOCK };
                    Scene { block: Some(block), ..Scene::default() }
                }
                _ => wall([draw(2, 2.0, 4.0), 0.0, 0.7], [0.5, 20.0, 0.7]),
            };
            let mut snake = Snake::in_scene(&robot, &scene);
            throw(&mut snake, [draw(5, 0.0, 20.0), draw(6, -8.0, 8.0), 0.0]);
            for step in 0..300 {
                for module in 0..robot.modules {
                    let of = |what: u64| {
                        let what = 10 * module as u64 + what;
                        let (rate, phase) = (draw(10 + what, 1.0, 12.0), draw(13 + what, 0.0, 6.0));
                        draw(16 + what, 0.0, 80.0) * libm::sinf(rate * 0.005 * step as f32 + phase)
                    };
                    snake.set_torque(module, [of(0), of(1)]);
                }
                snake.step();
                let block = snake.state().block.map_or(0.0, |block| speed(&block));
                let fastest = snake.state().links.iter().map(speed).fold(block, f32::max);
                assert!(fastest < 80.0, "{number}, step {step}: {fastest}, {:?}", snake.effort());
            }
            assert_eq!(snake.effort().capped, 0, "{number}");
            held[kind] += snake.effort().held;
        }
        assert!(held[0] >= 4 && held[1] >= 4, "{held:?}");
    }

    #[test]
    fn friction_on_a_solid_is_that_of_the_contacts_own_load_and_normal() {
        let robot = Robot::default();
        // Speed lost in 0.1 s along and across the links, by a snake that a sideways pull presses against what is beside it.
        let lost = |scene: &Scene, pull: f32, velocity: [f32; 3]| {
            let mut snake = Snake::in_scene(&robot, scene);
            snake.chain().pull([0.0, pull, -robot.gravity]);
            (0..snake.steps_in(0.2)).for_each(|_| snake.step());
            throw(&mut snake, velocity);
            (0..snake.steps_in(0.1)).for_each(|_| snake.step());
            let mean = snake.state().links.iter().map(speed).sum::<f32>() / 32.0;
            velocity.iter().sum::<f32>() - mean
        };
        let g = 0.1 * robot.gravity;
        let near = |got: f32, want: f32| assert!((got - want).abs() < 0.05 * want, "{got} instead of {want}");
        let plain = Scene::default();
        near(lost(&plain, 0.0, [30.0, 0.0, 0.0]), g * robot.friction_along);
        // A wall takes the pull, and adds its own friction to the ground's.
        let beside = wall([-8.0, 0.9 + 1e-3, 5.0], [20.0, 0.5, 5.0]);
        near(lost(&beside, robot.gravity, [30.0, 0.0, 0.0]), 2.0 * g * robot.friction_along);
        // Up along the wall: across the links, and gravity, and nothing from the ground.
        near(lost(&beside, robot.gravity, [0.0, 0.0, 60.0]), g * (1.0 + robot.friction_across));
        // On top of a solid as on the ground.
        let floor = wall([-8.0, 0.0, -0.5], [20.0, 20.0, 0.5 + 1e-3]);
        near(lost(&floor, 0.0, [0.0, 30.0, 0.0]), g * robot.friction_across);
    }

    #[test]
    fn friction_never_drives_and_a_snake_held_tight_comes_to_rest() {
        let robot = Robot { friction_along: 1.0, ..Robot::default() };
        for tight in [0.0, 0.005, 0.02] {
            // In a groove: ground and a wall on either side.
            let mut scene = wall([-8.0, 0.9 - tight, 1.0], [20.0, 0.5, 1.0]);
            scene.solids.push(Solid { position: [-8.0, -0.9 + tight, 1.0], ..scene.solids[0] });
            let mut snake = Snake::in_scene(&robot, &scene);
            throw(&mut snake, [1.0, 0.0, 0.0]);
            for step in 0..400 {
                snake.step();
                let links = snake.state().links.iter();
                let (back, fastest) = links.fold((0.0f32, 0.0f32), |(b, f), l| (b.max(-l.linear[0]), f.max(speed(l))));
                assert!(back < 0.1 && fastest < 1.1, "{tight}, step {step}: {fastest}, back {back}");
                assert!(step < 300 || fastest < 0.02, "{tight}, step {step}: {fastest}");
            }
        }
    }

    #[test]
    fn a_block_at_rest_stays_at_rest_while_the_snake_moves_elsewhere() {
        for (torque, yaw) in [(0.0, 0.3), (80.0, 0.0), (80.0, 1.2)] {
            let block = Block { position: [12.0, 8.0, 0.5], yaw, ..BLOCK };
            let mut snake = Snake::in_scene(&Robot::default(), &Scene { block: Some(block), ..Scene::default() });
            let (start, _) = snake.block().unwrap();
            let mut rests = snake.block().unwrap();
            for step in 0..125 {
                (0..8).for_each(|m| snake.set_torque(m, [torque * libm::sinf(0.2 * step as f32 + m as f32), 0.0]));
                (0..snake.steps_in(0.05)).for_each(|_| snake.step());
                let (position, rotation) = snake.block().unwrap();
                // Its weight has settled on the ground.
                if step == 10 {
                    rests = (position, rotation);
                }
                let off = |from: [f32; 3], axis: usize| (position[axis] - from[axis]).abs();
                assert!(
                    off(start, 0) < 2e-3 && off(start, 1) < 2e-3 && off(start, 2) < 5e-3,
                    "step {step}: {position:?}"
                );
                let moved = (0..3).map(|axis| off(rests.0, axis)).fold(0.0, f32::max);
                let turned = (0..4).map(|axis| (rotation[axis] - rests.1[axis]).abs()).fold(0.0, f32::max);
                assert!(step < 10 || moved < 1e-4 && turned < 1e-4, "step {step}: {position:?} {rotation:?}");
            }
        }
    }

    #[test]
    fn a_block_pushed_and_let_go_slides_to_a_stop_by_its_friction() {
        for friction in [0.2, 0.5, 1.0] {
            let block = Block { position: [5.0, 0.0, 0.5], yaw: 0.0, friction, ..BLOCK };
            let mut snake = Snake::in_scene(&Robot::default(), &Scene { block: Some(block), ..Scene::default() });
            (0..snake.steps_in(0.2)).for_each(|_| snake.step());
            snake.chain().push_block([10.0, 0.0, 0.0]);
            (0..snake.steps_in(1.5)).for_each(|_| snake.step());
            let ([x, y, z], _) = snake.block().unwrap();
            let way = 10.0f32.powi(2) / (2.0 * friction * 196.2);
            assert!((x - 5.0 - way).abs() < 0.1 * way + 0.06, "friction {friction}: {} instead of {way}", x - 5.0);
            assert!(y.abs() < 0.02 && (z - 0.5).abs() < 0.01, "{y} {z}");
            assert!(speed(&snake.state().block.unwrap()) < 1e-3);
        }
    }

    #[test]
    fn a_way_ends_where_it_enters_a_box() {
        let wall = Solid { half: [0.5, 4.0, 1.0], position: [3.0, 0.0, 1.0], yaw: 0.0, roll: 0.0 };
        // Its near face, 0.4 before it, is at 2.1.
        assert!((wall.entered([0.0, 0.0, 0.5], [6.0, 0.0, 0.5], 0.4) - 0.35).abs() < 1e-6);
        for (from, to) in [
            ([0.0, 0.0, 0.5], [2.0, 0.0, 0.5]),
            ([0.0, 0.0, 2.5], [6.0, 0.0, 2.5]),
            ([0.0, 5.0, 0.5], [6.0, 5.0, 0.5]),
            ([6.0, 0.0, 0.5], [9.0, 0.0, 0.5]),
            ([3.0, 0.0, 0.5], [9.0, 0.0, 0.5]),
        ] {
            assert_eq!(wall.entered(from, to, 0.4), 1.0, "{from:?} {to:?}");
        }
        let turned = Solid { yaw: std::f32::consts::FRAC_PI_2, ..wall };
        assert!((turned.entered([3.0, -3.0, 0.5], [3.0, 3.0, 0.5], 0.4) - 0.35).abs() < 1e-6);
    }
}
