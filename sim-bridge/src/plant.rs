//! What the simulated controllers control.

use composer_shared::observation::Sensors;
use composer_shared::robot::AXES;

/// A robot made of modules, in steps of its own.
///
/// Units and frames are those of [`composer_shared::observation`] and [`composer_shared::robot`].
pub trait Plant {
    /// Number of modules, 1 to [`composer_shared::robot::MAX_MODULES`].
    fn modules(&self) -> usize;
    /// Length of a step, ns.
    fn step_ns(&self) -> u64;
    /// What the sensors of `module` read now.
    fn sensors(&self, module: usize) -> Sensors;
    /// A point of the scene in the frame of the head link (robot units), as the ground station broadcasts it; none if it is not known.
    /// Point 0 is the goal, see [`composer_shared::policy::Task::observed`].
    fn point(&self, number: u8) -> Option<[f32; 3]>;
    /// Sets the torques of `module` (yaw, pitch); they act from the next step on, until set again.
    fn set_torque(&mut self, module: usize, torque: [f32; AXES]);
    /// Advances by [`Plant::step_ns`].
    fn step(&mut self);
    /// Whether the episode is over (success, or its time is up).
    fn done(&self) -> bool;
    /// Moves the goal to a place (robot units, the world's frame), if the plant has one that can be moved.
    fn move_goal(&mut self, _place: [f32; 3]) -> bool {
        false
    }
}

impl<P: Plant + ?Sized> Plant for &mut P {
    fn modules(&self) -> usize {
        (**self).modules()
    }

    fn step_ns(&self) -> u64 {
        (**self).step_ns()
    }

    fn sensors(&self, module: usize) -> Sensors {
        (**self).sensors(module)
    }

    fn point(&self, number: u8) -> Option<[f32; 3]> {
        (**self).point(number)
    }

    fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        (**self).set_torque(module, torque);
    }

    fn step(&mut self) {
        (**self).step();
    }

    fn done(&self) -> bool {
        (**self).done()
    }

    fn move_goal(&mut self, place: [f32; 3]) -> bool {
        (**self).move_goal(place)
    }
}

/// A robot on the bench: straight, level, at room temperature, and nothing moves it.
#[derive(Clone, Copy, Debug)]
pub struct Bench {
    /// How many modules it has.
    pub modules: usize,
    /// Steps of 5 ms that are left.
    pub steps: u32,
}

impl Plant for Bench {
    fn modules(&self) -> usize {
        self.modules
    }

    fn step_ns(&self) -> u64 {
        5_000_000
    }

    fn sensors(&self, _module: usize) -> Sensors {
        Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
    }

    fn point(&self, _number: u8) -> Option<[f32; 3]> {
        None
    }

    fn set_torque(&mut self, _module: usize, _torque: [f32; AXES]) {}

    fn step(&mut self) {
        self.steps = self.steps.saturating_sub(1);
    }

    fn done(&self) -> bool {
        self.steps == 0
    }
}
