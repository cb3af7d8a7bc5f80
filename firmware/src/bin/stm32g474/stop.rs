//! What stops the motors past the main loop.

use composer_firmware::torque_off::TorqueOff;

/// Told by the interrupts of FDCAN and of the current loops, asked by the current loops.
pub static TORQUE_OFF: TorqueOff = TorqueOff::new();
