//! Variation of robot, ground and sensors as data: ranges from which every episode draws. The policy and the modules know nothing of what was drawn;
//! their limits, geometry and task stay those of the policy's image. A robot whose motors are weaker than nominal is a variation, not another
//! policy.
//!
//! One set ships, [`LAB`]; `snakectl eval POLICY --vary vary-lab` (or a file), and `[vary]` in the settings of a training run.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::env::EnvConfig;
use crate::robot::Robot;

/// What a lab must expect of hobby-grade hardware: the text of `host/configs/vary-lab.toml`.
pub const LAB: &str = include_str!("../configs/vary-lab.toml");
/// The name by which the command line knows it.
pub const LAB_NAME: &str = "vary-lab";

/// A range, least and most; drawn evenly.
type Range = [f32; 2];

/// Ranges; what is left out stays as the robot has it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Variation {
    /// Coefficient of friction along a link. Wider: gaits that need less of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub friction_along: Option<Range>,
    /// Coefficient of friction across a link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub friction_across: Option<Range>,
    /// Factor of the links' mass.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mass: Option<Range>,
    /// Factor of the links' moment of inertia.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub inertia: Option<Range>,
    /// Factor of the joints' stiffness.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<Range>,
    /// Factor of the joints' whole damping, their own and the motors'.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damping: Option<Range>,
    /// Torque of a motor for the torque it was told, as a factor; drawn for each module, the same for its two axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motor_strength: Option<Range>,
    /// Factor of the motors' no-load speed at the nominal supply.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motor_speed: Option<Range>,
    /// Supply voltage as a factor of the nominal one: scales torque and no-load speed of all motors.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub supply: Option<Range>,
    /// Factor of the stiffness of contacts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contact_stiffness: Option<Range>,
    /// Slope of the ground, degrees; its direction is drawn from the whole circle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slope: Option<Range>,
    /// From the sensors' sample to the torque, s. On the simulated bus the delay is the bus's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delay: Option<Range>,
    /// Factor of the sensors' noise and offsets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensor_noise: Option<Range>,
    /// Standard deviation of the zeros of the joints, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoder_zero: Option<Range>,
    /// Share of the frames that a receiver loses; off the bus, of the latents.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lost: Option<Range>,
    /// The physics step is divided by a whole number from this range.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics_step: Option<[usize; 2]>,
}

impl Variation {
    /// Reads a set of ranges; the sentence says what is wrong with it.
    pub fn from_toml(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|error| error.message().trim().replace('\n', " "))
    }

    /// Whether nothing is varied.
    pub fn is_none(&self) -> bool {
        *self == Variation::default()
    }

    /// The ranges with their names, and what their numbers must lie between.
    fn ranges(&self) -> [(&'static str, Option<Range>, Range); 15] {
        [
            ("friction_along", self.friction_along, [1e-3, 10.0]),
            ("friction_across", self.friction_across, [1e-3, 10.0]),
            ("mass", self.mass, [0.05, 20.0]),
            ("inertia", self.inertia, [0.05, 20.0]),
            ("stiffness", self.stiffness, [0.05, 20.0]),
            ("damping", self.damping, [0.05, 20.0]),
            ("motor_strength", self.motor_strength, [0.0, 1.5]),
            ("motor_speed", self.motor_speed, [0.1, 5.0]),
            ("supply", self.supply, [0.1, 1.5]),
            ("contact_stiffness", self.contact_stiffness, [0.05, 20.0]),
            ("slope", self.slope, [0.0, 30.0]),
            ("delay", self.delay, [0.0, 1.0]),
            ("sensor_noise", self.sensor_noise, [0.0, 100.0]),
            ("encoder_zero", self.encoder_zero, [0.0, 45.0]),
            ("lost", self.lost, [0.0, 0.99]),
        ]
    }

    /// Whether episodes of `config` can draw from it; the sentence says which range cannot be.
    pub fn check(&self, config: &EnvConfig) -> Result<(), String> {
        for (name, range, [least, most]) in self.ranges() {
            let Some([low, high]) = range else { continue };
            if low.is_nan() || high.is_nan() || low > high {
                return Err(format!("{name} = [{low}, {high}] is upside down: write the smaller number first"));
            }
            if !(low >= least && high <= most) {
                return Err(format!(
                    "{name} = [{low}, {high}]: no such robot can be, the range lies within {least} and {most}"
                ));
            }
        }
        if let Some([low, high]) = self.physics_step
            && !(1 <= low && low <= high && high <= 64)
        {
            return Err(format!(
                "physics_step = [{low}, {high}]: it is divided by whole numbers from 1 to 64, the smaller one first"
            ));
        }
        if let Some([_, high]) = self.delay
            && high >= config.control_period
        {
            return Err(format!(
                "delay = [.., {high}]: it must stay below the control period of {} s",
                config.control_period
            ));
        }
        Ok(())
    }

    /// The environment of one episode: what was drawn stands in it, and nothing is left to draw.
    pub fn draw(&self, config: &EnvConfig, seed: u64) -> EnvConfig {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed ^ 0x7a51_ab1e);
        // Everything is drawn, varied or not, so that a range more or less does not change what the others come to.
        let mut draw = |range: Option<Range>, nominal: f32| {
            let share = rng.random::<f32>();
            range.map_or(nominal, |[low, high]| low + share * (high - low))
        };
        let nominal = &config.robot;
        let supply = draw(self.supply, 1.0);
        let damping = draw(self.damping, 1.0);
        let robot = Robot {
            friction_along: draw(self.friction_along, nominal.friction_along),
            friction_across: draw(self.friction_across, nominal.friction_across),
            link_mass: nominal.link_mass * draw(self.mass, 1.0),
            link_inertia: nominal.link_inertia * draw(self.inertia, 1.0),
            stiffness: nominal.stiffness * draw(self.stiffness, 1.0),
            damping: nominal.damping * damping,
            joint_speed_limit: nominal.joint_speed_limit * draw(self.motor_speed, 1.0) * supply / damping,
            contact_stiffness: nominal.contact_stiffness * draw(self.contact_stiffness, 1.0),
            slope: draw(self.slope, nominal.slope),
            downhill: draw(self.slope.map(|_| [-180.0, 180.0]), nominal.downhill),
            ..nominal.clone()
        };
        let mut drawn = EnvConfig { vary: Variation::default(), ..config.clone() };
        drawn.relax_seconds = Some(config.relax_seconds.unwrap_or_else(|| nominal.relax_seconds()));
        drawn.robot = robot;
        // Whole steps of the nominal physics.
        let steps = (draw(self.delay, 0.0) / nominal.physics_step).round() as usize;
        if self.delay.is_some() {
            drawn.delay = [steps.min(config.substeps() - 1); 2];
        }
        let noise = draw(self.sensor_noise, 1.0);
        let sensors = &mut drawn.sensors;
        for number in [
            &mut sensors.accelerometer.noise,
            &mut sensors.accelerometer.offset,
            &mut sensors.gyroscope.noise,
            &mut sensors.gyroscope.offset,
            &mut sensors.encoder.noise,
            &mut sensors.encoder.nonlinearity,
        ] {
            *number *= noise;
        }
        sensors.encoder.zero = draw(self.encoder_zero, sensors.encoder.zero);
        drawn.faults.missed_latents = draw(self.lost, drawn.faults.missed_latents);
        let strength = self.motor_strength;
        drawn.motor_strength = (0..nominal.modules).map(|_| supply * draw(strength, 1.0)).collect();
        match self.physics_step {
            Some([low, high]) => drawn.finer(rng.random_range(low..=high)),
            None => drawn,
        }
    }

    /// What was drawn for an episode, with what a lost frame is.
    pub fn lost(&self, config: &EnvConfig, seed: u64) -> Option<f32> {
        self.lost.map(|_| self.draw(config, seed).faults.missed_latents)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::Snake;
    use composer_shared::policy::Task;
    use std::sync::Arc;

    fn nominal() -> EnvConfig {
        EnvConfig::new(Task::GoalReaching, Robot::default())
    }

    #[test]
    fn every_episode_draws_its_own_robot_within_the_ranges() {
        let lab = Variation::from_toml(LAB).unwrap();
        let config = nominal();
        lab.check(&config).unwrap();
        let robots: Vec<EnvConfig> = (0..200).map(|seed| lab.draw(&config, seed)).collect();
        assert_eq!(robots[7], lab.draw(&config, 7));
        let mut seen = [f32::MAX, f32::MIN];
        for drawn in &robots {
            drawn.robot.validate().unwrap();
            let ratio = drawn.robot.link_mass / config.robot.link_mass;
            seen = [seen[0].min(ratio), seen[1].max(ratio)];
            assert!((0.05..=0.18).contains(&drawn.robot.friction_along) && (0.0..=4.0).contains(&drawn.robot.slope));
            assert!(drawn.motor_strength.len() == 8 && drawn.motor_strength.iter().all(|s| (0.67..1.16).contains(s)));
            // What the modules go by is the nominal robot.
            assert_eq!(drawn.robot.limits().torque, config.robot.limits().torque);
            assert_eq!(drawn.relax_seconds, Some(config.robot.relax_seconds()));
            let delay = drawn.delay[0] as f32 * drawn.robot.physics_step;
            assert!((0.0049..0.0201).contains(&delay) && drawn.delay[0] < drawn.substeps(), "{delay}");
            assert!(drawn.vary.is_none());
        }
        assert!(seen[0] >= 0.75 && seen[0] < 0.78 && seen[1] <= 1.25 && seen[1] > 1.22, "{seen:?}");
        // One range more leaves the others' draws alone.
        let fewer = Variation { mass: None, ..lab.clone() };
        assert_eq!(fewer.draw(&config, 3).robot.stiffness, lab.draw(&config, 3).robot.stiffness);
        let none = Variation::default().draw(&config, 3);
        assert_eq!((none.robot, none.delay, none.sensors), (config.robot.clone(), config.delay, config.sensors));
    }

    #[test]
    fn what_cannot_be_is_refused_in_one_sentence() {
        let config = nominal();
        for (text, words) in [
            ("friction_along = [0.2, 0.1]", "friction_along = [0.2, 0.1] is upside down"),
            ("mass = [-1.0, 1.0]", "mass = [-1, 1]: no such robot can be"),
            ("mass = [nan, 1.0]", "upside down"),
            ("slope = [0.0, 60.0]", "within 0 and 30"),
            ("delay = [0.0, 0.05]", "below the control period of 0.05 s"),
            ("physics_step = [0, 2]", "whole numbers from 1 to 64"),
        ] {
            let error = Variation::from_toml(text).unwrap().check(&config).unwrap_err();
            assert!(error.contains(words) && !error.contains('\n'), "{error}");
        }
        for (text, words) in
            [("masss = [1.0, 1.0]", "masss"), ("mass = 1.0", "invalid type"), ("mass = [1.0]", "invalid length")]
        {
            let error = Variation::from_toml(text).unwrap_err();
            assert!(error.contains(words) && !error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn a_smooth_slope_is_slid_down_a_rough_one_not_and_sensors_feel_both() {
        // Along the snake: across it a straight snake would roll.
        let smooth = Robot { slope: 4.0, friction_along: 0.05, ..Robot::default() };
        let (sin, cos) = libm::sincosf(4f32.to_radians());
        let mut snake = Snake::new(&smooth);
        (0..snake.steps_in(1.0)).for_each(|_| snake.step());
        let way = 0.5 * smooth.gravity * (sin - 0.05 * cos);
        let [x, y, _] = snake.head();
        assert!((x - way).abs() < 0.05 * way && y.abs() < 0.01, "{x} {y} instead of {way}");
        let mut snake = Snake::new(&Robot { slope: 4.0, downhill: 180.0, ..Robot::default() });
        for fitted in [false, true] {
            if fitted {
                snake.fit_sensors(&composer_sim_bridge::sensor_model::SensorModel::none(), 1);
            }
            (0..snake.steps_in(1.0)).for_each(|_| snake.step());
            let up = snake.sensors(3).up;
            assert!(snake.head()[0].abs() < 0.2 && (up[0] - sin).abs() < 5e-3 && (up[2] - cos).abs() < 5e-3, "{up:?}");
        }
    }

    #[test]
    fn a_weak_motor_puts_less_torque_on_its_joints() {
        let settled = |strength: &[f32]| {
            let mut snake = Snake::new(&Robot::default());
            snake.set_strength(strength);
            (0..8).for_each(|module| snake.set_torque(module, [40.0, 0.0]));
            (0..snake.steps_in(3.0)).for_each(|_| snake.step());
            (snake.slew().to_vec(), snake.state().joint_angles[4], snake.torque(1))
        };
        let (acting, nominal, _) = settled(&[]);
        assert_eq!(acting, [[40.0, 0.0]; 8]);
        let (acting, weak, told) = settled(&[1.0, 0.5]);
        assert_eq!((acting[0], acting[1], acting[2], told), ([40.0, 0.0], [20.0, 0.0], [40.0, 0.0], [40.0, 0.0]));
        assert!(weak < 0.8 * nominal, "{weak} {nominal}");
    }

    #[test]
    fn environment_and_bus_draw_the_same_robot() {
        let mut config = nominal();
        config.vary = Variation::from_toml(LAB).unwrap();
        let config = Arc::new(config);
        let env = {
            use crate::environment::Environment;
            let mut env = crate::env::SnakeEnv::new(config.clone());
            env.reset(5);
            env
        };
        let plant = crate::sil::SnakePlant::new(config, 5);
        assert_eq!(env.snake().robot(), plant.snake().robot());
        assert_ne!(env.snake().robot(), &Robot::default());
    }
}
