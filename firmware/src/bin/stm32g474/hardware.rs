//! What the service of a module needs of this board.

use composer_firmware::port::PortStatus;
use composer_firmware::service::{Board, Raw};
use embassy_stm32::uid;

use crate::drive::Measured;
use crate::flash::{Policies, Storage};
use crate::sense::Sense;

/// Storage, identifier and readings.
pub struct Hardware {
    storage: Storage,
    policies: Policies,
    raw: Raw,
}

impl Hardware {
    /// Nothing was read yet.
    pub fn new(storage: Storage, policies: Policies) -> Self {
        Hardware { storage, policies, raw: Raw::default() }
    }

    /// Takes what sensors, motors and CAN port say now.
    pub fn note(&mut self, sense: &Sense<'_>, drive: &Measured, port: PortStatus) {
        let chips = sense.raw();
        self.raw = Raw {
            encoders: chips.encoders,
            encoder_errors: chips.encoder_errors,
            force: chips.force,
            rate: chips.rate,
            imu_errors: chips.imu_errors,
            supply: drive.volts,
            temperatures: sense.temperatures(),
            currents: drive.current,
            port,
        };
    }
}

impl Board for Hardware {
    type Flash = Storage;
    type Policies = Policies;

    fn policies(&mut self) -> &mut Policies {
        &mut self.policies
    }

    fn storage(&mut self) -> &mut Storage {
        &mut self.storage
    }

    fn unique_id(&self) -> [u32; 3] {
        let [a, b, c, d, e, f, g, h, i, j, k, l] = uid::uid();
        [[a, b, c, d], [e, f, g, h], [i, j, k, l]].map(u32::from_le_bytes)
    }

    fn raw(&self) -> Raw {
        self.raw
    }
}
