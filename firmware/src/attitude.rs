//! Which way is up, from gyroscope and accelerometer.
//!
//! An accelerometer feels gravity and every acceleration of its link; a gyroscope turns with the link but drifts. The filter keeps the vector
//! against gravity `s` in the module's own frame (units: g), turns it with the gyroscope and pulls it towards the accelerometer:
//!
//! ```text
//! s <- R(-w t) s              w: angular rate, rad/s; t: time since the last sample, s; R: rotation
//! e  = f - s                  f: specific force, g
//! s <- s + t / T  e min(1, B / |e|)                    T = 1 s, B = 0.15 g
//! up = s / |s|
//! ```
//!
//! - *Linear in f.* The mean of an acceleration over a time T is the change of velocity over T, which is small: links at 4 units/s (0.2 m/s) put an
//!   error of v / (g T) = 1.2 degrees on `s`, with accelerations of any size on the way. Hence `s` is not a unit vector and `f` is not normalised:
//!   either would turn accelerations along one axis into errors along another.
//! - *Bounded influence.* What differs from `s` by more than B pulls as if it differed by B (Huber's estimator), so an impact or a saturated
//!   reading moves `s` by no more than a gentle push, and accelerations of 1 to 3 g at 1 Hz by 4 degrees at most. To weigh a sample by how near |f| is
//!   to 1 g is worse than nothing: where an acceleration happens to have |f| = 1, `f` points anywhere, and an upright shake of 2 g
//!   turns the estimate over.
//! - *T = 1 s.* Accelerations cost v / (g T), a gyroscope's offset b costs b T: 1 degree/s costs about a degree, as much as the 20 mg that the
//!   accelerometer is off by. No offset of the gyroscope is estimated: that would remove the smaller half of two degrees.
//! - *Start.* From the first sample on `s` is the plain mean (turned along) of all samples until it is [`START`] old.
//! - *|s| is about 1*, whatever the robot does. If it is not (0.5 to 2), the accelerometer is broken or the estimate was wrong: `up` is then
//!   `s` as it is, which no [`Sensors::plausible`](composer_shared::observation::Sensors::plausible) accepts, and the filter starts anew.
//!
//! Time enters everywhere, so any rate of samples gives the same result. An update takes 616 instructions on a Cortex-M4F
//! (`cargo qemu-bench`; two square roots in software are most of it): 0.4 % of 170 MHz at a thousand samples a second.

use nalgebra::Vector3;

/// T: how long a deviation of the accelerometer takes to be believed, s.
pub const TIME_CONSTANT: f32 = 1.0;
/// B: the largest deviation that counts in full, g.
pub const INFLUENCE: f32 = 0.15;
/// Age up to which the estimate is a plain mean, s. A mean over 2 s lags by 1 s, so the gyroscope's offset costs as much as later.
pub const START: f32 = 2.0;

/// No inertial sensor of a robot reads more, in rad/s or in g.
const SENSELESS: f32 = 200.0;
/// A pause longer than this, in s, was no pause between two samples.
const PAUSE: f32 = 0.5;

/// The filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attitude {
    /// Against gravity, g, own frame.
    s: Vector3<f32>,
    /// What the mean spans, s; at most [`START`]. Nought: there was no sample.
    age: f32,
}

impl Default for Attitude {
    fn default() -> Self {
        Attitude::UNKNOWN
    }
}

impl Attitude {
    /// Before the first sample.
    pub const UNKNOWN: Attitude = Attitude { s: Vector3::new(0.0, 0.0, 0.0), age: 0.0 };

    /// After a long rest in which the accelerometer read `force` (g).
    pub fn rested(force: [f32; 3]) -> Self {
        if sensible(&force) { Attitude { s: force.into(), age: START } } else { Attitude::UNKNOWN }
    }

    /// Takes a sample: angular rate (rad/s) and specific force (g; a unit vector upwards at rest) in the module's own frame, the means over
    /// the `seconds` since the sample before. Returns [`Attitude::up`].
    ///
    /// Numbers that are none, or more than any sensor reads, or nothing but zeros (a sensor without power) make it forget everything. A sample that
    /// took no time is left out; after a pause of more than half a second the filter starts anew.
    pub fn update(&mut self, rate: [f32; 3], force: [f32; 3], seconds: f32) -> [f32; 3] {
        let unpowered = rate.iter().chain(&force).all(|v| *v == 0.0);
        if unpowered || !sensible(&rate) || !sensible(&force) {
            *self = Attitude::UNKNOWN;
            return self.up();
        }
        let force = Vector3::from(force);
        if seconds.is_nan() || seconds <= 0.0 {
            return self.up();
        }
        let settled = self.age >= START;
        if seconds > PAUSE || self.age == 0.0 || settled && !self.sound() {
            *self = Attitude { s: force, age: seconds.min(PAUSE) };
            return self.up();
        }
        self.turn(Vector3::from(rate) * -seconds);
        self.age = (self.age + seconds).min(START);
        let deviation = force - self.s;
        let gain = if settled {
            let size = norm(deviation);
            seconds / TIME_CONSTANT * if size > INFLUENCE { INFLUENCE / size } else { 1.0 }
        } else {
            seconds / self.age
        };
        self.s += deviation * gain;
        self.up()
    }

    /// The direction against gravity in the module's own frame: a unit vector; zeros before the first sample; neither if it is not to be trusted.
    pub fn up(&self) -> [f32; 3] {
        if self.sound() { (self.s / norm(self.s)).into() } else { self.s.into() }
    }

    /// Whether what is felt in the mean can be gravity.
    fn sound(&self) -> bool {
        // As `Sensors::plausible`.
        (0.25..4.0).contains(&self.s.dot(&self.s))
    }

    /// Turns the vector by `angle` (rad, about its direction). By Cayley's formula, which keeps the length whatever the angle; the first factor
    /// makes the angle right to the fifth order.
    fn turn(&mut self, angle: Vector3<f32>) {
        let half = angle * (0.5 + angle.dot(&angle) * (1.0 / 24.0));
        let once = half.cross(&self.s);
        self.s += (once + half.cross(&once)) * (2.0 / (1.0 + half.dot(&half)));
    }
}

fn norm(v: Vector3<f32>) -> f32 {
    libm::sqrtf(v.dot(&v))
}

/// Whether a sensor can have read this. False for what is not a number.
fn sensible(v: &[f32; 3]) -> bool {
    v.iter().all(|v| v.abs() < SENSELESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f32::consts::TAU;
    use proptest::prelude::*;
    use std::vec::Vec;

    const UP: [f32; 3] = [0.0, 0.0, 1.0];

    fn degrees(a: [f32; 3], b: [f32; 3]) -> f32 {
        let (a, b) = (Vector3::from(a), Vector3::from(b));
        libm::atan2f(norm(a.cross(&b)), a.dot(&b)).to_degrees()
    }

    /// Numbers about a normal distribution, the same ones every time.
    fn noise(state: &mut u32) -> f32 {
        let mut sum = -6.0;
        for _ in 0..12 {
            *state = state.wrapping_mul(1664525).wrapping_add(1013904223);
            sum += (*state >> 8) as f32 / (1 << 24) as f32;
        }
        sum
    }

    /// The largest error, in degrees, after `from` seconds of `seconds` under accelerations (g, in the world) of a body that turns about `axis`.
    fn worst(
        mut filter: Attitude,
        (spin, axis): (f32, Vector3<f32>),
        acceleration: impl Fn(f32) -> Vector3<f32>,
        (hz, from, seconds): (f32, f32, f32),
    ) -> f32 {
        let axis = axis / norm(axis);
        let (step, up) = (1.0 / hz, Vector3::from(UP));
        let mut worst = 0.0f32;
        for i in 1..=(seconds * hz) as u32 {
            let time = i as f32 * step;
            // Rodrigues' formula.
            let to_body = |v: Vector3<f32>| {
                let (sin, cos) = libm::sincosf(-spin * time);
                v * cos + axis.cross(&v) * sin + axis * (axis.dot(&v) * (1.0 - cos))
            };
            let force = to_body(up + acceleration(time - 0.5 * step));
            let force = force.map(|f| f.clamp(-4.0, 4.0));
            let estimate = filter.update((axis * spin).into(), force.into(), step);
            if time > from {
                worst = worst.max(degrees(estimate, to_body(up).into()));
            }
        }
        worst
    }

    #[test]
    fn it_turns_with_the_module() {
        for hz in [100.0, 1000.0] {
            for spin in [0.5, 3.0, 20.0] {
                let error = worst(
                    Attitude::UNKNOWN,
                    (spin, Vector3::new(1.0, 2.0, 0.3)),
                    |_| Vector3::zeros(),
                    (hz, 0.0, 10.0),
                );
                assert!(error < 0.1, "{spin} rad/s at {hz} Hz: {error}");
            }
        }
        // With the gyroscope alone: a quarter of a turn while the accelerometer feels what pulls it nowhere.
        let mut filter = Attitude::rested(UP);
        for _ in 0..100 {
            let felt = filter.s;
            filter.turn(Vector3::new(-TAU / 400.0, 0.0, 0.0));
            assert!((norm(filter.s) - norm(felt)).abs() < 1e-6);
        }
        assert!(degrees(filter.up(), [0.0, 1.0, 0.0]) < 1e-2, "{filter:?}");
    }

    #[test]
    fn offsets_and_noise_at_rest_cost_less_than_a_degree() {
        // 0.5 degrees per second in all and 8 mg, with the noise of the LSM6DSO at 100 Hz.
        let mut state = 1;
        let mut filter = Attitude::UNKNOWN;
        for i in 0..6000 {
            let rate = [0.3, -0.3, 0.3].map(|b: f32| (b + 0.027 * noise(&mut state)).to_radians());
            let force = [0.008, 0.0, 1.0].map(|f| f + 0.53e-3 * noise(&mut state));
            let up = filter.update(rate, force, 0.01);
            assert!(degrees(up, UP) < 1.0, "{i}: {up:?}");
        }
    }

    #[test]
    fn shaking_costs_a_few_degrees() {
        let directions = [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, -0.5)];
        for size in [1.0, 2.0, 3.0] {
            for (x, y, z) in directions {
                for spin in [0.0, 1.0] {
                    let shake = |time: f32| Vector3::new(x, y, z) * size * libm::sinf(TAU * time);
                    let motion = (spin, Vector3::new(0.2, 1.0, 0.0));
                    let rested = worst(Attitude::rested(UP), motion, shake, (100.0, 0.0, 20.0));
                    assert!(rested < 6.0, "{size} g along {x}, {y}, {z}, {spin} rad/s: {rested}");
                    // Starting in the middle of it, which no module should.
                    let started = worst(Attitude::UNKNOWN, motion, shake, (100.0, 10.0, 25.0));
                    assert!(started < 8.0, "{size} g along {x}, {y}, {z}, {spin} rad/s from the start: {started}");
                }
            }
        }
    }

    #[test]
    fn a_wrong_estimate_is_given_up() {
        let mut upside_down = Attitude::rested([0.0, 0.0, -1.0]);
        let mut tilted = Attitude::rested([1.0, 0.0, 0.0]);
        for _ in 0..1500 {
            upside_down.update([0.0; 3], UP, 0.01);
            tilted.update([0.0; 3], UP, 0.01);
        }
        assert!(degrees(upside_down.up(), UP) < 0.1, "{upside_down:?}");
        assert!(degrees(tilted.up(), UP) < 1.0, "{tilted:?}");
        // A first sample that is wrong loses its weight as the mean grows.
        let mut filter = Attitude::UNKNOWN;
        filter.update([0.0; 3], [3.9, 0.0, -1.0], 0.001);
        for _ in 0..1000 {
            filter.update([0.0; 3], UP, 0.001);
        }
        assert!(degrees(filter.up(), UP) < 0.5, "{filter:?}");
    }

    #[test]
    fn the_rate_of_the_samples_does_not_matter() {
        let run = |hz: u32| {
            let mut filter = Attitude::UNKNOWN;
            let mut ups = Vec::new();
            for i in 1..=10 * hz {
                let time = (i as f32 - 0.5) / hz as f32;
                let rate = [libm::sinf(3.0 * time), 2.0 * libm::cosf(2.0 * time), 0.5];
                let force = [0.4 * libm::sinf(9.0 * time), 0.3, 1.0 + 0.5 * libm::cosf(7.0 * time)];
                filter.update(rate, force, 1.0 / hz as f32);
                if i % hz == 0 {
                    ups.push(filter.up());
                }
            }
            ups
        };
        for (slow, fast) in run(100).into_iter().zip(run(1000)) {
            assert!(degrees(slow, fast) < 0.6, "{slow:?} {fast:?}");
        }
    }

    #[test]
    fn a_blind_sensor_is_not_plausible() {
        use composer_shared::observation::Sensors;
        let plausible = |up| Sensors { up, ..Sensors::ZERO }.plausible();
        assert!(!plausible(Attitude::UNKNOWN.up()));
        for (rate, force) in [([0.0; 3], [0.0; 3]), ([f32::NAN; 3], UP), ([0.0; 3], [0.0, f32::INFINITY, 1.0])] {
            let mut filter = Attitude::rested(UP);
            assert!(plausible(filter.update([0.1; 3], UP, 0.01)));
            assert_eq!(filter.update(rate, force, 0.01), [0.0; 3]);
            assert!(plausible(filter.update([0.1; 3], UP, 0.01)), "and it comes back");
        }
        // An accelerometer that feels too little or too much all the time.
        for size in [0.2, 3.0] {
            let mut filter = Attitude::rested(UP);
            (0..2000).for_each(|_| _ = filter.update([0.0; 3], [0.0, 0.0, size], 0.01));
            assert!(!plausible(filter.up()), "{size}: {filter:?}");
        }
        assert_eq!(Attitude::rested([f32::NAN; 3]), Attitude::UNKNOWN);
    }

    proptest! {
        #[test]
        fn anything_gives_something_finite(samples in prop::collection::vec(prop::array::uniform7(any::<u32>()), 1..50)) {
            let mut filter = Attitude::UNKNOWN;
            for bits in samples {
                let [a, b, c, d, e, f, seconds] = bits.map(f32::from_bits);
                let up = filter.update([a, b, c], [d, e, f], seconds);
                prop_assert!(up.iter().all(|u| u.is_finite()), "{filter:?}");
            }
        }

        #[test]
        fn anything_that_sensors_read_gives_something_finite(
            samples in prop::collection::vec((prop::array::uniform3(-210.0f32..210.0), prop::array::uniform3(-210.0f32..210.0), -0.1f32..0.6), 1..200)
        ) {
            let mut filter = Attitude::UNKNOWN;
            for (rate, force, seconds) in samples {
                let up = filter.update(rate, force, seconds);
                prop_assert!(up.iter().all(|u| u.is_finite()), "{filter:?}");
            }
        }
    }
}
