//! Pendulum-v1 and CartPole-v1 of Gymnasium, by their equations, as robots of one module: whether a method learns can be compared with
//! published returns there.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::environment::{Environment, Outcome, View};
use crate::tasks::Point;

/// Pendulum-v1: swing up and hold a pendulum with a motor too weak to lift it at once. Observed are cosine and sine of the angle from upright
/// and the speed by its limit of 8 rad/s (there in rad/s; SMP keeps the direction of what it sees, not its size). The first action is the
/// torque by its limit of 2. An episode has 200 steps and is cut off there.
#[derive(Clone, Debug, Default)]
pub struct Pendulum {
    /// Angle from upright, rad.
    angle: f64,
    /// rad/s.
    speed: f64,
    steps: u32,
    total: f32,
}

impl Pendulum {
    /// Steps in an episode.
    pub const STEPS: u32 = 200;
}

impl Environment for Pendulum {
    fn modules(&self) -> usize {
        1
    }

    fn reset(&mut self, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let angle = rng.random_range(-std::f64::consts::PI..std::f64::consts::PI);
        *self = Self { angle, speed: rng.random_range(-1.0..1.0), steps: 0, total: 0.0 };
    }

    fn view(&self, view: &mut View) {
        view.clear(1);
        let (sin, cos) = libm::sincos(self.angle);
        view.observations[0][..3].copy_from_slice(&[cos as f32, sin as f32, self.speed as f32 / 8.0]);
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        let torque = f64::from((2.0 * actions[0][0]).clamp(-2.0, 2.0));
        let tau = std::f64::consts::TAU;
        let wrapped = libm::fmod(libm::fmod(self.angle + tau / 2.0, tau) + tau, tau) - tau / 2.0;
        let reward = -(wrapped * wrapped + 0.1 * self.speed * self.speed + 0.001 * torque * torque) as f32;
        // g = 10, m = l = 1, steps of 0.05 s.
        self.speed = (self.speed + (15.0 * libm::sin(self.angle) + 3.0 * torque) * 0.05).clamp(-8.0, 8.0);
        self.angle += 0.05 * self.speed;
        self.steps += 1;
        self.total += reward;
        Outcome {
            reward,
            truncated: self.steps >= Self::STEPS,
            steps: self.steps,
            episode_return: self.total,
            ..Outcome::default()
        }
    }

    fn place(&self, _module: usize, offset: [f32; 3]) -> Point {
        offset
    }

    fn imagined_reward(&self, _positions: &[Point]) -> f32 {
        0.0
    }
}

/// CartPole-v1: balance a pole on a cart by pushing it left or right with 10 N. Observed are place and speed of the cart, angle and angular speed
/// of the pole. The sign of the first action says which way. Every step pays 1; an episode ends when the pole or the cart is out of bounds and is
/// cut off after 500 steps.
#[derive(Clone, Debug, Default)]
pub struct CartPole {
    /// m, m/s, rad, rad/s.
    state: [f64; 4],
    steps: u32,
}

impl CartPole {
    /// Most steps in an episode.
    pub const STEPS: u32 = 500;
}

impl Environment for CartPole {
    fn modules(&self) -> usize {
        1
    }

    fn reset(&mut self, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        *self = Self { state: std::array::from_fn(|_| rng.random_range(-0.05..0.05)), steps: 0 };
    }

    fn view(&self, view: &mut View) {
        view.clear(1);
        for (to, x) in view.observations[0].iter_mut().zip(self.state) {
            *to = x as f32;
        }
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        const GRAVITY: f64 = 9.8;
        const POLE: f64 = 0.1;
        const TOTAL: f64 = 1.1;
        const HALF_LENGTH: f64 = 0.5;
        const STEP: f64 = 0.02;
        let force = if actions[0][0] > 0.0 { 10.0 } else { -10.0 };
        let [x, speed, angle, turning] = self.state;
        let (sin, cos) = libm::sincos(angle);
        let push = (force + POLE * HALF_LENGTH * turning * turning * sin) / TOTAL;
        let turn = (GRAVITY * sin - cos * push) / (HALF_LENGTH * (4.0 / 3.0 - POLE * cos * cos / TOTAL));
        let acceleration = push - POLE * HALF_LENGTH * turn * cos / TOTAL;
        self.state = [x + STEP * speed, speed + STEP * acceleration, angle + STEP * turning, turning + STEP * turn];
        self.steps += 1;
        let out = self.state[0].abs() > 2.4 || self.state[2].abs() > 12f64.to_radians();
        Outcome {
            reward: 1.0,
            terminated: out,
            truncated: !out && self.steps >= Self::STEPS,
            success: !out && self.steps >= Self::STEPS,
            steps: self.steps,
            episode_return: self.steps as f32,
            ..Outcome::default()
        }
    }

    fn place(&self, _module: usize, offset: [f32; 3]) -> Point {
        offset
    }

    fn imagined_reward(&self, _positions: &[Point]) -> f32 {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pendulum_keeps_its_energy_but_for_the_step() {
        let mut pendulum = Pendulum { angle: 3.0, ..Pendulum::default() };
        // Energy of a rod: speed squared by 6, and half of g times the height of its end.
        let energy = |p: &Pendulum| p.speed * p.speed / 6.0 + 5.0 * libm::cos(p.angle);
        let before = energy(&pendulum);
        let outcomes: Vec<_> = (0..200).map(|_| pendulum.step(&[[0.0; 2]])).collect();
        assert!((energy(&pendulum) - before).abs() < 0.05, "{before} {}", energy(&pendulum));
        assert!(!outcomes[198].truncated && outcomes[199].truncated && !outcomes[199].terminated);
        // Hanging still costs the square of the angle; with full torque 0.004 more.
        let mut hanging = Pendulum { angle: std::f64::consts::PI, ..Pendulum::default() };
        assert!((hanging.step(&[[5.0, 0.0]]).reward + 9.8736).abs() < 1e-3);
        assert!((hanging.speed - 0.3).abs() < 1e-9);
    }

    #[test]
    fn a_pole_falls_by_the_equations() {
        let mut cart = CartPole { state: [0.0, 0.0, 0.1, 0.0], steps: 0 };
        cart.step(&[[1.0, 0.0]]);
        // By hand: push = 10 / 1.1; turn = (9.8 sin - cos push) / (0.5 (4/3 - 0.1 cos^2 / 1.1)).
        let (sin, cos) = 0.1f64.sin_cos();
        let turn = (9.8 * sin - cos * 10.0 / 1.1) / (0.5 * (4.0 / 3.0 - 0.1 * cos * cos / 1.1));
        let acceleration = 10.0 / 1.1 - 0.05 * turn * cos / 1.1;
        assert_eq!(cart.state[0], 0.0);
        assert!((cart.state[1] - 0.02 * acceleration).abs() < 1e-12 && (cart.state[3] - 0.02 * turn).abs() < 1e-12);
        let mut steps = 1;
        while !cart.step(&[[1.0, 0.0]]).terminated {
            steps += 1;
        }
        assert!(steps < 20, "{steps}");
    }
}
