//! The sensors of a module as their datasheets have them: noise, offsets, range, steps; and behind them the filters of the board.
//!
//! ```text
//! Truth, means over 0.01 s -> SensorModel -> Raw -> Attitude -> Sensors
//! ```
//!
//! The chips are sampled every [`PERIOD`] of simulated time, whatever the step of the physics: noise and filters do not change when the
//! physics is made finer. Whoever steps finer gives the means over the period ([`Mean`]); nobody may step coarser.
//!
//! What a board does a thousand times a second happens here a hundred times: the noise is that of the mean over the period (density times the
//! root of 1 / (2 [`PERIOD`])), and the speed of the joints is the exact solution of the board's tracking loop for angles that change
//! evenly. Left out: bandwidth and saturation within a period, sensitivity (1 %) and its dependence on the temperature, lost samples.

use std::f32::consts::{PI, TAU};

use composer_firmware::attitude::Attitude;
use composer_firmware::drivers::encoder::STEPS;
use composer_firmware::drivers::sensors::SPEED_BANDWIDTH;
use composer_shared::math::sin_cos;
use composer_shared::observation::Sensors;
use composer_shared::random::SplitMix64;
use composer_shared::robot::{AXES, MAX_JOINTS};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Time between two samples, s.
pub const PERIOD: f32 = 0.01;
/// The board samples so often, Hz.
const BOARD_RATE: f32 = 1000.0;

/// What the sensors of all modules have in common. Every offset is drawn once for each module.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorModel {
    /// LSM6DSO, linear acceleration.
    pub accelerometer: Accelerometer,
    /// LSM6DSO, angular rate.
    pub gyroscope: Gyroscope,
    /// AS5047P.
    pub encoder: Encoder,
}

/// An accelerometer; the default is the LSM6DSO at +-4 g, typical values (datasheet, table 2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Accelerometer {
    /// Noise density, micro-g / sqrt(Hz).
    pub noise: f32,
    /// Standard deviation of the zero-g level of an axis, mg.
    pub offset: f32,
    /// Full scale, g; nought: none.
    pub range: f32,
    /// A step, mg; nought: none.
    pub step: f32,
}

impl Default for Accelerometer {
    fn default() -> Self {
        Accelerometer { noise: 75.0, offset: 20.0, range: 4.0, step: 0.122 }
    }
}

/// A gyroscope; the default is the LSM6DSO at +-2000 degrees/s, typical values (datasheet, table 2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Gyroscope {
    /// Noise density, millidegrees / s / sqrt(Hz).
    pub noise: f32,
    /// Standard deviation of the zero-rate level of an axis, degrees/s. As delivered: the board does not calibrate it. Zeroed at rest
    /// after power-up, what remains is the drift with the temperature, 0.01 degrees/s a kelvin.
    pub offset: f32,
    /// Full scale, degrees/s; nought: none.
    pub range: f32,
    /// A step, millidegrees/s; nought: none.
    pub step: f32,
}

impl Default for Gyroscope {
    fn default() -> Self {
        // 16 bits of 70 millidegrees/s each reach beyond the nominal range.
        Gyroscope { noise: 3.8, offset: 1.0, range: 2293.0, step: 70.0 }
    }
}

/// A magnetic encoder; the default is the AS5047P.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Encoder {
    /// Standard deviation of a reading, degrees.
    pub noise: f32,
    /// Standard deviation of the zero of a joint, degrees: how well it was straight when it was calibrated.
    pub zero: f32,
    /// Integral nonlinearity, degrees: an error that goes once round with the magnet, its amplitude drawn evenly up to this.
    pub nonlinearity: f32,
    /// Bits of a turn; nought: no steps.
    pub bits: u32,
    /// Whether the speed comes from the angles, by the board's tracking loop; otherwise it is the true one.
    pub tracking: bool,
}

impl Default for Encoder {
    fn default() -> Self {
        Encoder { noise: 0.068, zero: 0.2, nonlinearity: 0.8, bits: STEPS.trailing_zeros(), tracking: true }
    }
}

impl SensorModel {
    /// Sensors that read the truth.
    pub fn none() -> Self {
        SensorModel {
            accelerometer: Accelerometer { noise: 0.0, offset: 0.0, range: 0.0, step: 0.0 },
            gyroscope: Gyroscope { noise: 0.0, offset: 0.0, range: 0.0, step: 0.0 },
            encoder: Encoder { noise: 0.0, zero: 0.0, nonlinearity: 0.0, bits: 0, tracking: false },
        }
    }

    /// Whether every number can be; the sentence says which cannot.
    pub fn check(&self) -> Result<(), String> {
        let SensorModel { accelerometer: a, gyroscope: g, encoder: e } = self;
        let numbers = [
            ("accelerometer.noise", a.noise, 1e6),
            ("accelerometer.offset", a.offset, 1e4),
            ("accelerometer.range", a.range, 100.0),
            ("accelerometer.step", a.step, 1e3),
            ("gyroscope.noise", g.noise, 1e6),
            ("gyroscope.offset", g.offset, 1e3),
            ("gyroscope.range", g.range, 1e4),
            ("gyroscope.step", g.step, 1e5),
            ("encoder.noise", e.noise, 90.0),
            ("encoder.zero", e.zero, 90.0),
            ("encoder.nonlinearity", e.nonlinearity, 90.0),
            ("encoder.bits", e.bits as f32, 20.0),
        ];
        match numbers.into_iter().find(|(_, value, most)| !(0.0..=*most).contains(value)) {
            Some((name, value, most)) => Err(format!("{name} = {value}; it lies between 0 and {most}")),
            None => Ok(()),
        }
    }
}

/// What there is to sense of a module.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Truth {
    /// Joint angles now, rad.
    pub joint_angles: [f32; MAX_JOINTS],
    /// Joint speeds now, rad/s; of interest to a model without tracking only.
    pub joint_speeds: [f32; MAX_JOINTS],
    /// Joints that exist.
    pub joints: usize,
    /// Specific force (acceleration less gravity) in the own frame, g: the mean over the period. At rest a unit vector upwards.
    pub specific_force: [f32; 3],
    /// Angular rate in the own frame, rad/s: the mean over the period.
    pub angular_rate: [f32; 3],
}

/// What a board has read, in the units of [`Sensors`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Raw {
    /// Joint angles, rad.
    pub joint_angles: [f32; MAX_JOINTS],
    /// Joint speeds as the board computes them, rad/s.
    pub joint_speeds: [f32; MAX_JOINTS],
    /// Specific force, g.
    pub specific_force: [f32; 3],
    /// Angular rate, rad/s.
    pub angular_rate: [f32; 3],
}

/// The means of specific force and angular rate over a period, for a physics that takes more than one step in it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mean {
    force: [f32; 3],
    rate: [f32; 3],
    seconds: f32,
}

impl Mean {
    /// Takes a step of `seconds`, with the means over it, both in the own frame.
    pub fn add(&mut self, force: [f32; 3], rate: [f32; 3], seconds: f32) {
        for axis in 0..3 {
            self.force[axis] += force[axis] * seconds;
            self.rate[axis] += rate[axis] * seconds;
        }
        self.seconds += seconds;
    }

    /// The means (specific force, angular rate), and starts anew. Zeros if there was no step.
    pub fn take(&mut self) -> ([f32; 3], [f32; 3]) {
        let Mean { force, rate, seconds } = std::mem::take(self);
        let share = if seconds > 0.0 { 1.0 / seconds } else { 0.0 };
        (force.map(|f| f * share), rate.map(|r| r * share))
    }
}

/// An axis of a chip: value in, reading out.
#[derive(Clone, Copy, Debug)]
struct Axis {
    /// Standard deviation of the noise.
    noise: f32,
    range: f32,
    /// A step and how many there are in a unit; the latter is nought if there are none.
    step: (f32, f32),
}

impl Axis {
    fn new(noise: f32, range: f32, step: f32) -> Self {
        Axis {
            noise,
            range: if range > 0.0 { range } else { f32::INFINITY },
            step: (step, if step > 0.0 { 1.0 / step } else { 0.0 }),
        }
    }

    fn read(&self, value: f32, random: &mut Random) -> f32 {
        let value = (value + self.noise * random.normal()).max(-self.range).min(self.range);
        quantise(value, self.step)
    }
}

/// To the nearest step.
fn quantise(value: f32, (step, per_unit): (f32, f32)) -> f32 {
    // By way of an integer: on the oldest x86-64 there is no instruction that rounds.
    if per_unit == 0.0 { value } else { (value * per_unit + 0.5f32.copysign(value)) as i32 as f32 * step }
}

/// Noise, fast: splitmix64, and the sum of four even numbers for a normal one (right to the fourth moment within 10 %, none beyond 3.5).
#[derive(Clone, Copy, Debug)]
struct Random(SplitMix64);

impl Random {
    #[inline]
    fn normal(&mut self) -> f32 {
        let z = self.0.next_u64();
        let sum = (z & 0xffff) + (z >> 16 & 0xffff) + (z >> 32 & 0xffff) + (z >> 48);
        // The mean of the sum, and one over its standard deviation: 65536 sqrt(4 / 12).
        (sum as i32 - 131_070) as f32 * (1.732_050_8 / 65536.0)
    }
}

/// The board's speed estimate of one joint.
#[derive(Clone, Copy, Debug, Default)]
struct Tracking {
    angle: f32,
    followed: f32,
    speed: f32,
}

/// The encoder of one joint.
#[derive(Clone, Copy, Debug, Default)]
struct Joint {
    /// Error where the joint is straight.
    zero: f32,
    /// Amplitude and phase.
    nonlinearity: (f32, f32),
    tracking: Tracking,
}

/// The sensors of one module: its offsets, its noise, its filters.
#[derive(Clone, Debug)]
pub struct ModuleSensorState {
    force: Axis,
    rate: Axis,
    force_offset: [f32; 3],
    rate_offset: [f32; 3],
    /// Noise of a reading and of the mean of those in a period, rad.
    angle_noise: (f32, f32),
    angle_step: (f32, f32),
    track: bool,
    joints: [Joint; MAX_JOINTS],
    random: Random,
    attitude: Attitude,
    raw: Option<Raw>,
}

impl ModuleSensorState {
    /// The sensors of one module. The same seed draws the same offsets and the same noise.
    pub fn new(model: &SensorModel, seed: u64) -> Self {
        let SensorModel { accelerometer, gyroscope, encoder } = model;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut random = Random(SplitMix64(rng.next_u64()));
        let bandwidth = (1.0 / (2.0 * PERIOD)).sqrt();
        let mg = 1e-3;
        let mdps = 1e-3 * PI / 180.0;
        let step = if encoder.bits > 0 { TAU / (1u32 << encoder.bits.min(20)) as f32 } else { 0.0 };
        let noise = encoder.noise.to_radians();
        // Many readings with noise of more than a step make the steps one more noise.
        let mean_noise = (noise * noise + step * step / 12.0).sqrt() / (PERIOD * BOARD_RATE).sqrt();
        let joints = std::array::from_fn(|_| {
            let amplitude = encoder.nonlinearity.to_radians() * even(&mut rng);
            // Where the magnet points when the joint is straight; the calibration takes the error there away.
            let phase = TAU * even(&mut rng);
            let zero = encoder.zero.to_radians() * random.normal() - amplitude * sin_cos(phase).0;
            Joint { zero, nonlinearity: (amplitude, phase), tracking: Tracking::default() }
        });
        ModuleSensorState {
            force: Axis::new(1e-6 * accelerometer.noise * bandwidth, accelerometer.range, accelerometer.step * mg),
            rate: Axis::new(gyroscope.noise * mdps * bandwidth, gyroscope.range.to_radians(), gyroscope.step * mdps),
            force_offset: [(); 3].map(|()| accelerometer.offset * mg * random.normal()),
            rate_offset: [(); 3].map(|()| gyroscope.offset.to_radians() * random.normal()),
            angle_noise: (noise, mean_noise),
            angle_step: (step, if step > 0.0 { 1.0 / step } else { 0.0 }),
            track: encoder.tracking,
            joints,
            random,
            attitude: Attitude::UNKNOWN,
            raw: None,
        }
    }

    /// The module has lain as it lies now for long: its filters have settled. At the start of an episode; the first [`PERIOD`] ends later.
    pub fn rest(&mut self, truth: &Truth) {
        self.raw = None;
        let raw = self.sample(truth);
        self.attitude = Attitude::rested(raw.specific_force);
        self.raw = Some(raw);
    }

    /// A [`PERIOD`] is over: reads the chips, updates the filters. This, every [`PERIOD`], and [`ModuleSensorState::sensors`] whenever the
    /// controller wants a sample is all that a simulation needs.
    pub fn update(&mut self, truth: &Truth) {
        let raw = self.sample(truth);
        self.attitude.update(raw.angular_rate, raw.specific_force, PERIOD);
        self.raw = Some(raw);
    }

    /// What the controller sees: the latest readings, and up by the filter. Not plausible before the first period is over.
    pub fn sensors(&self, torque: [f32; AXES], temperature: f32) -> Sensors {
        let raw = self.raw.unwrap_or_default();
        Sensors {
            joint_angles: raw.joint_angles,
            joint_speeds: raw.joint_speeds,
            up: self.attitude.up(),
            angular_rate: raw.angular_rate,
            torque,
            temperature,
        }
    }

    /// Reads the chips; the filter of the attitude is left as it is ([`ModuleSensorState::update`] is both).
    pub fn sample(&mut self, truth: &Truth) -> Raw {
        let first = self.raw.is_none();
        let mut raw = Raw::default();
        for axis in 0..3 {
            raw.specific_force[axis] =
                self.force.read(truth.specific_force[axis] + self.force_offset[axis], &mut self.random);
            raw.angular_rate[axis] =
                self.rate.read(truth.angular_rate[axis] + self.rate_offset[axis], &mut self.random);
        }
        for (k, joint) in self.joints.iter_mut().enumerate().take(truth.joints) {
            let draw = self.random.normal();
            let (amplitude, phase) = joint.nonlinearity;
            let truly = truth.joint_angles[k];
            let shown = truly + joint.zero + amplitude * sin_cos(truly + phase).0;
            raw.joint_angles[k] = wrap(quantise(shown + self.angle_noise.0 * draw, self.angle_step));
            raw.joint_speeds[k] = if self.track {
                joint.tracking.update(shown + self.angle_noise.1 * draw, first)
            } else {
                truth.joint_speeds[k]
            };
        }
        raw
    }
}

impl Tracking {
    /// The loop of [`composer_firmware::drivers::encoder::SpeedEstimator`], followed' = speed + 2 w e, speed' = w^2 e with
    /// e = angle - followed, solved for an angle that changes evenly over the period.
    fn update(&mut self, angle: f32, first: bool) -> f32 {
        const W: f32 = SPEED_BANDWIDTH;
        /// exp(-W PERIOD)
        const DECAY: f32 = 0.208_045_18;
        if first {
            *self = Tracking { angle, followed: angle, speed: 0.0 };
            return 0.0;
        }
        let slope = wrap(angle - self.angle) * (1.0 / PERIOD);
        // Deviations from following without lag; both eigenvalues are -W.
        let (x, v) = (wrap(self.followed - self.angle), self.speed - slope);
        let both = (v - W * x) * PERIOD;
        self.angle = angle;
        self.followed = angle + DECAY * (x + both);
        self.speed = slope + DECAY * (v + W * both);
        self.speed
    }
}

/// An even draw from 0 to 1.
fn even(rng: &mut ChaCha8Rng) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1 << 24) as f32
}

/// An angle brought to -pi .. pi, if it is within three halves of a turn.
fn wrap(angle: f32) -> f32 {
    if angle > PI {
        angle - TAU
    } else if angle < -PI {
        angle + TAU
    } else {
        angle
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_firmware::drivers::encoder::SpeedEstimator;

    const LEVEL: Truth = Truth {
        joint_angles: [0.1, -0.2, 0.3, 0.0],
        joint_speeds: [0.0; MAX_JOINTS],
        joints: 3,
        specific_force: [0.0, 0.0, 1.0],
        angular_rate: [0.0; 3],
    };

    fn spread(values: &[f32]) -> (f32, f32) {
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / values.len() as f32).sqrt())
    }

    #[test]
    fn without_a_model_the_truth_is_read() {
        let mut state = ModuleSensorState::new(&SensorModel::none(), 1);
        let truth = Truth { joint_speeds: [1.0, -2.0, 3.0, 0.0], angular_rate: [0.1, 0.2, 50.0], ..LEVEL };
        let raw = state.sample(&truth);
        assert_eq!((raw.joint_angles, raw.joint_speeds), (truth.joint_angles, truth.joint_speeds));
        assert_eq!((raw.specific_force, raw.angular_rate), (truth.specific_force, truth.angular_rate));
        assert!(!state.sensors([0.0; 2], 25.0).plausible(), "nothing was read yet");
        state.rest(&LEVEL);
        let sensors = state.sensors([0.5, 0.0], 25.0);
        assert_eq!((sensors.up, sensors.torque), ([0.0, 0.0, 1.0], [0.5, 0.0]));
        assert!(sensors.plausible());
    }

    #[test]
    fn the_same_seed_gives_the_same_bits() {
        let run = |seed| {
            let mut state = ModuleSensorState::new(&SensorModel::default(), seed);
            state.rest(&LEVEL);
            (0..100).for_each(|_| state.update(&LEVEL));
            state.sensors([0.0; 2], 25.0)
        };
        assert_eq!(run(7), run(7));
        assert_ne!(run(7), run(8));
    }

    #[test]
    fn noise_offsets_steps_and_ranges_are_those_of_the_datasheets() {
        let model = SensorModel::default();
        let mut offsets = Vec::new();
        for seed in 0..200 {
            let mut state = ModuleSensorState::new(&model, seed);
            let raws: Vec<Raw> = (0..2000).map(|_| state.sample(&LEVEL)).collect();
            let axis = |f: &dyn Fn(&Raw) -> f32| spread(&raws.iter().map(f).collect::<Vec<_>>());
            let (force, force_noise) = axis(&|raw| raw.specific_force[0]);
            let (rate, rate_noise) = axis(&|raw| raw.angular_rate[1].to_degrees());
            let (_, angle_noise) = axis(&|raw| raw.joint_angles[1].to_degrees());
            // 75 ug and 3.8 mdps over 50 Hz, with the steps.
            assert!((force_noise / 0.53e-3 - 1.0).abs() < 0.1, "{force_noise}");
            assert!((rate_noise / 0.0335 - 1.0).abs() < 0.2, "{rate_noise}");
            assert!((angle_noise / 0.068 - 1.0).abs() < 0.1, "{angle_noise}");
            offsets.push([force, rate]);
        }
        let [force, rate] = [0, 1].map(|i| spread(&offsets.iter().map(|o| o[i]).collect::<Vec<_>>()).1);
        assert!((force / 0.02 - 1.0).abs() < 0.2 && (rate - 1.0).abs() < 0.2, "{force} {rate}");

        let mut state = ModuleSensorState::new(&model, 1);
        let violent = Truth { specific_force: [9.0, -9.0, 1.0], angular_rate: [50.0, -50.0, 0.0], ..LEVEL };
        let raw = state.sample(&violent);
        assert!((raw.specific_force[0] - 4.0).abs() < 1e-3 && (raw.specific_force[1] + 4.0).abs() < 1e-3, "{raw:?}");
        assert!((raw.angular_rate[0] - 40.0).abs() < 0.1 && (raw.angular_rate[1] + 40.0).abs() < 0.1, "{raw:?}");
        let steps = raw.joint_angles[0] / TAU * f32::from(STEPS);
        assert!((steps - steps.round()).abs() < 1e-2 && raw.joint_angles[3] == 0.0, "{raw:?}");
        let steps = raw.specific_force[2] / 0.122e-3;
        assert!((steps - steps.round()).abs() < 1e-2, "{raw:?}");
    }

    /// The speed of a swinging joint, from a hundred samples a second here and from a thousand through the board's own code.
    #[test]
    fn the_speed_is_that_of_the_board() {
        let quiet = Encoder { noise: 0.0, zero: 0.0, nonlinearity: 0.0, bits: 0, tracking: true };
        let angle = |time: f32| 0.8 * (TAU * 0.7 * time).sin() + 0.2 * (TAU * 3.0 * time).cos();
        for (encoder, noisy) in [(quiet, false), (Encoder { zero: 0.0, nonlinearity: 0.0, ..Encoder::default() }, true)]
        {
            let mut here = ModuleSensorState::new(&SensorModel { encoder, ..SensorModel::none() }, 5);
            let mut board = SpeedEstimator::new(SPEED_BANDWIDTH);
            let mut random = Random(SplitMix64(9));
            let (mut apart, mut rough_here, mut rough_board) = (Vec::new(), Vec::new(), Vec::new());
            here.rest(&Truth { joint_angles: [angle(0.0); 4], ..LEVEL });
            board.update(angle(0.0), 1e-3);
            for period in 1..=2000 {
                let time = period as f32 * PERIOD;
                let mut speed = 0.0;
                for k in 1..=10 {
                    let noise = if noisy { encoder.noise.to_radians() * random.normal() } else { 0.0 };
                    speed = board.update(angle(time - PERIOD + 1e-3 * k as f32) + noise, 1e-3);
                }
                here.update(&Truth { joint_angles: [angle(time); 4], ..LEVEL });
                let own = here.sensors([0.0; 2], 25.0).joint_speeds[0];
                let lag = time - 2.0 / SPEED_BANDWIDTH;
                let truth = (angle(lag + 1e-3) - angle(lag - 1e-3)) / 2e-3;
                if period > 20 {
                    apart.push(own - speed);
                    rough_here.push(own - truth);
                    rough_board.push(speed - truth);
                }
            }
            let [apart, rough_here, rough_board] = [apart, rough_here, rough_board].map(|v| spread(&v).1);
            if noisy {
                assert!((0.7..1.3).contains(&(rough_here / rough_board)), "{rough_here} {rough_board}");
            } else {
                assert!(apart < 0.08, "{apart}; {rough_here} {rough_board}");
            }
            println!("noisy {noisy}: {apart} rad/s apart; here {rough_here}, board {rough_board}");
        }
    }

    #[test]
    fn the_speed_does_not_jump_where_the_angle_turns_over() {
        let mut state = ModuleSensorState::new(&SensorModel::default(), 3);
        for period in 0..2000 {
            let angle = wrap((0.02 * period as f32) % TAU);
            state.update(&Truth { joint_angles: [angle; 4], ..LEVEL });
            let speed = state.sensors([0.0; 2], 25.0).joint_speeds[0];
            assert!(period < 10 || (speed - 2.0).abs() < 0.5, "{period}: {speed}");
        }
    }

    #[test]
    fn finer_physics_gives_the_same_means() {
        let mut mean = Mean::default();
        for k in 0..4 {
            mean.add([k as f32, 0.0, 1.0], [0.0, 2.0 * k as f32, 0.0], 0.0025);
        }
        let (force, rate) = mean.take();
        assert!((force[0] - 1.5).abs() < 1e-6 && (force[2] - 1.0).abs() < 1e-6 && (rate[1] - 3.0).abs() < 1e-6);
        assert_eq!(mean.take(), ([0.0; 3], [0.0; 3]));
    }

    #[test]
    fn up_is_right_within_the_offsets() {
        let mut worst = 0.0f32;
        for seed in 0..100 {
            let mut state = ModuleSensorState::new(&SensorModel::default(), seed);
            state.rest(&LEVEL);
            for _ in 0..1000 {
                state.update(&LEVEL);
                let [x, y, z] = state.sensors([0.0; 2], 25.0).up;
                worst = worst.max(x.hypot(y).atan2(z).to_degrees());
            }
        }
        println!("{worst} degrees");
        assert!(worst < 6.0, "{worst}");
    }

    #[test]
    fn settings_are_checked() {
        assert_eq!(SensorModel::default().check(), Ok(()));
        assert_eq!(SensorModel::none().check(), Ok(()));
        let mut model = SensorModel::default();
        model.gyroscope.offset = f32::NAN;
        assert!(model.check().is_err_and(|e| e.contains("gyroscope.offset")));
    }
}
