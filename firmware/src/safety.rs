//! What a module keeps to whatever its policy wants: the part of the node page ([`crate::node_page`]) that [`crate::failsafe`] enforces.

use composer_shared::robot::MAX_JOINTS;
use serde::{Deserialize, Serialize};

use crate::limits::{Caps, JointRange};
use crate::supply::Thresholds;

/// Limits and reactions of one module.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Safety {
    /// Where its joints may be, head end first. The policy's limit counts where it is smaller.
    pub joints: [JointRange; MAX_JOINTS],
    /// What its motors bear. The policy's limits count where they are smaller.
    pub caps: Caps,
    /// Between which voltages it drives.
    pub supply: Thresholds,
    /// After so many milliseconds without a frame of the station it relaxes and disarms; 0: never.
    pub dead_man_ms: u16,
    /// Whether it relaxes while its sensors say what cannot be true. If not, it acts on an observation of zeros, as the paper's observation fault does.
    pub blind_relaxes: bool,
}

impl Safety {
    /// What a board of the robot that ships keeps to if nobody says otherwise. `host/configs/calibration.toml` says the same in SI units; a test compares them.
    pub const BOARD: Safety = Safety {
        joints: [JointRange { min: -3.0, max: 3.0 }; MAX_JOINTS],
        // 0.2 N m and 0.5 N m/s.
        caps: Caps { torque: 80.0, torque_slew: 200.0, temperature: 80.0 },
        supply: Thresholds { under: 9.0, over: 16.0 },
        dead_man_ms: 2000,
        blind_relaxes: true,
    };

    /// Nothing but what the policy says, and the reactions of a board: for robots that are only simulated.
    pub const POLICY: Safety = Safety {
        joints: [JointRange::TURN; MAX_JOINTS],
        caps: Caps::NONE,
        supply: Thresholds { under: 0.0, over: f32::INFINITY },
        ..Safety::BOARD
    };
}
