//! The robot as a module knows it: the shape of the chain and the limits of its motors.
//!
//! Units: one *robot unit* of length is 0.05 m (SomoGym simulates at 20 times life size, so that a 0.1 m finger is 2 units
//! long); masses are in kilograms, torques in the unit that follows, stiffness in torque per radian. The host's robot file
//! says how they scale to SI.
//!
//! Modules are numbered from the head (0) to the tail. A module is [`Geometry::links_per_module`] rigid links. Joint `k` of a
//! module connects its link `k` to the next link towards the tail; the last joint of the last module does not exist and
//! reads zero. Even joints yaw (about the link's z axis, up at rest), odd joints pitch (about its y axis, left).

/// Most modules on one bus: one CAN identifier each, see [`crate::wire`].
pub const MAX_MODULES: usize = 64;
/// Modules that this build has room for: all that a bus takes, or 16 with the feature `room-16`. What a module keeps of the others (its
/// chain, their latents) has so many places.
pub const ROOM: usize = if cfg!(feature = "room-16") { 16 } else { MAX_MODULES };
/// Most joints in one module; a STATE frame has room for that many.
pub const MAX_JOINTS: usize = 4;
/// Bending axes of a module, one motor each: 0 is yaw, 1 is pitch.
pub const AXES: usize = 2;

/// Control cycles without a frame after which a module counts as dead.
pub const DEAD_AFTER: u8 = 3;

/// The shape of the chain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geometry {
    /// Links (and joints) in one module, 2 to [`MAX_JOINTS`].
    pub links_per_module: u8,
    /// Distance between two neighbouring joints, in robot units.
    pub link_length: f32,
}

impl Geometry {
    /// The link whose frame is the module's own frame (its IMU sits there): the second, counted from the head end.
    pub const OWN_LINK: usize = 1;
}

impl Default for Geometry {
    /// The paper's robot: 8 modules of 4 links, 0.5 units each.
    fn default() -> Self {
        Geometry { links_per_module: 4, link_length: 0.5 }
    }
}

/// What a module may do with its motors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest torque of a motor; an action of 1 asks for it.
    pub torque: f32,
    /// Fastest change of a torque, per second.
    pub torque_slew: f32,
    /// Joint angle beyond which a module reports a fault, rad.
    pub joint_angle: f32,
    /// Joint speed that the motors cannot outrun, rad/s (no-load speed of the torque-speed line).
    pub joint_speed: f32,
    /// Motor temperature above which a module relaxes its motors, degrees Celsius.
    pub temperature: f32,
}

impl Default for Limits {
    fn default() -> Self {
        Limits { torque: 80.0, torque_slew: 200.0, joint_angle: 3.1, joint_speed: 3.0, temperature: 80.0 }
    }
}

impl Limits {
    /// The torque to command after `previous`, when the policy wants `action` (normalised, -1 to 1) and `seconds` passed:
    /// clamped to the torque limit and to the slew limit. An action that is not a number counts as zero.
    pub fn command(&self, previous: f32, action: f32, seconds: f32) -> f32 {
        let action = if action.is_nan() { 0.0 } else { action.clamp(-1.0, 1.0) };
        slew(previous, action * self.torque, self.torque_slew * seconds)
    }
}

/// `wanted`, but no further than `step` away from `previous`.
pub fn slew(previous: f32, wanted: f32, step: f32) -> f32 {
    // Not `f32::clamp`: it panics when a bound is not a number.
    (wanted - previous).max(-step).min(step) + previous
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_is_clamped_and_slewed() {
        let limits = Limits::default();
        assert_eq!(limits.command(0.0, 1.0, 0.05), 10.0);
        assert_eq!(limits.command(75.0, 5.0, 0.05), 80.0);
        assert_eq!(limits.command(80.0, -1.0, 0.05), 70.0);
        assert_eq!(limits.command(5.0, f32::NAN, 0.05), 0.0);
    }
}
