//! Device drivers over `embedded-hal` 1.0 traits: they run on any board that implements those, and on the host against mocks.
//!
//! - [`encoder`]: the angle of a joint, AS5047P over SPI.
//! - [`imu`]: specific force and angular rate, LSM6DSO over SPI.
//! - [`motor`]: an H-bridge with a current loop.
//! - [`stage`]: both motors of a module in step, with the supply.
//! - [`thermistor`]: the temperature of a motor.
//! - [`sensors`]: all of a module's sensors together, as the controller wants them.
//!
//! A driver never panics. What it cannot read it says so, and [`sensors::ModuleSensors`] turns that into
//! [`Sensors`](composer_shared::observation::Sensors) that are not plausible, which the controller reports as fault 39.

pub mod encoder;
pub mod imu;
pub mod motor;
pub mod sensors;
pub mod stage;
pub mod thermistor;
