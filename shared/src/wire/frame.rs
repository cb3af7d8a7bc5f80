//! Frames, identifiers and what can be wrong with them.

use core::fmt;

use crate::robot::MAX_MODULES;

/// The module number of the ground station: it tells the goal, arms, asks, and may stop and release the robot.
pub const STATION: u8 = 0x7f;

/// A CAN or CAN-FD data frame with an 11-bit identifier.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// Identifier, 11 bits: [`Function`] in the upper 4, module in the lower 7.
    pub id: u16,
    /// CAN-FD frame format.
    pub fd: bool,
    /// CAN-FD: the data phase runs at the data bit rate.
    pub brs: bool,
    /// Bytes of payload, padding included: always a number that a DLC can say.
    pub len: u8,
    /// The payload; zero beyond `len`.
    pub data: [u8; 64],
}

impl Frame {
    /// A frame with this payload, padded with zeros to the next length that a DLC can say. `None` if the identifier has more
    /// than 11 bits or the payload is too long: 8 bytes for a classic frame, 64 for CAN-FD.
    pub fn new(id: u16, fd: bool, payload: &[u8]) -> Option<Self> {
        let len = Self::padded_len(payload.len(), fd)?;
        let mut data = [0; 64];
        data.get_mut(..payload.len())?.copy_from_slice(payload);
        (id < 1 << 11).then_some(Frame { id, fd, brs: fd, len, data })
    }

    /// The payload with its padding.
    pub fn payload(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or(&self.data)
    }

    /// The number of the module that sent it (lower 7 bits of the identifier).
    pub fn module(&self) -> u8 {
        (self.id & 0x7f) as u8
    }

    /// What it says (upper 4 bits of the identifier); `None` if nobody of this protocol says that.
    pub fn function(&self) -> Option<Function> {
        Function::from_number((self.id >> 7) as u8)
    }

    /// The shortest length of at least `len` bytes that a DLC can say.
    pub fn padded_len(len: usize, fd: bool) -> Option<u8> {
        const LONG: [u8; 7] = [12, 16, 20, 24, 32, 48, 64];
        match len {
            0..=8 => Some(len as u8),
            _ if fd => LONG.into_iter().find(|&l| usize::from(l) >= len),
            _ => None,
        }
    }

    /// The data length code, 0 to 15.
    pub fn dlc(&self) -> u8 {
        match self.len {
            0..=8 => self.len,
            9..=12 => 9,
            13..=16 => 10,
            17..=20 => 11,
            21..=24 => 12,
            25..=32 => 13,
            33..=48 => 14,
            _ => 15,
        }
    }

    /// The payload length that a data length code says. Classic frames: codes above 8 mean 8 (ISO 11898-1).
    pub fn dlc_to_len(dlc: u8, fd: bool) -> u8 {
        const LEN: [u8; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
        let code = usize::from(dlc & 15);
        if fd { LEN[code] } else { LEN[code].min(8) }
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:03X}#{}", self.id, if self.fd { if self.brs { "#1" } else { "#0" } } else { "" })?;
        self.payload().iter().try_for_each(|b| write!(f, "{b:02X}"))
    }
}

/// What a frame says: the upper 4 bits of its identifier, so that the lower number wins the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Function {
    /// Stop (or, from the station, release) all motors.
    EmergencyStop = 0,
    /// A control cycle starts.
    Sync = 1,
    /// Where the goal is.
    Goal = 2,
    /// Joint angles and health of a module.
    State = 3,
    /// The latent message of a module, whole (CAN-FD).
    Latent = 4,
    /// An eighth of it (classic CAN).
    LatentFragment = 5,
    /// The station asks a module for something, or all of them.
    ServiceRequest = 6,
    /// The answer to it.
    ServiceResponse = 7,
    /// What a module is doing.
    Telemetry = 8,
    /// How a module is.
    Heartbeat = 9,
    /// A piece of a new policy, for all modules (CAN-FD).
    UpdateChunk = 10,
    /// A ninth of it (classic CAN).
    UpdatePiece = 11,
}

impl Function {
    /// All of them, most urgent first.
    pub const ALL: [Function; 12] = [
        Function::EmergencyStop,
        Function::Sync,
        Function::Goal,
        Function::State,
        Function::Latent,
        Function::LatentFragment,
        Function::ServiceRequest,
        Function::ServiceResponse,
        Function::Telemetry,
        Function::Heartbeat,
        Function::UpdateChunk,
        Function::UpdatePiece,
    ];

    /// The function with this number, if there is one.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u8 == number)
    }

    /// The identifier of the frame in which `module` says this.
    pub const fn id(self, module: u8) -> u16 {
        ((self as u16) << 7) | (module as u16 & 0x7f)
    }

    /// The name that `wire-format.md` uses.
    pub const fn name(self) -> &'static str {
        match self {
            Function::EmergencyStop => "EMERGENCY_STOP",
            Function::Sync => "SYNC",
            Function::Goal => "GOAL",
            Function::State => "STATE",
            Function::Latent => "LATENT",
            Function::LatentFragment => "LATENT_FRAGMENT",
            Function::ServiceRequest => "SERVICE_REQUEST",
            Function::ServiceResponse => "SERVICE_RESPONSE",
            Function::Telemetry => "TELEMETRY",
            Function::Heartbeat => "HEARTBEAT",
            Function::UpdateChunk => "UPDATE_CHUNK",
            Function::UpdatePiece => "UPDATE_PIECE",
        }
    }
}

/// Why a frame is not one of ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WireError {
    /// The identifier has more than 11 bits.
    Identifier(u16),
    /// No function has this number.
    UnknownFunction(u8),
    /// Neither a module number nor the station's.
    UnknownModule(u8),
    /// This module number may not send this.
    WrongSender {
        /// What it said.
        function: Function,
        /// Who said it.
        module: u8,
    },
    /// The payload is too short or too long.
    WrongLength {
        /// What it said.
        function: Function,
        /// Bytes on the wire.
        got: u8,
        /// Bytes there should have been, padding included.
        expected: u8,
    },
    /// Bits that must be zero are set, padding among them.
    ReservedBits(Function),
    /// A field has a value that means nothing.
    WrongValue {
        /// What it said.
        function: Function,
        /// The name of the field.
        field: &'static str,
        /// Its value.
        value: u8,
    },
}

impl fmt::Display for WireError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            WireError::Identifier(id) => write!(f, "identifier {id:#x} has more than 11 bits"),
            WireError::UnknownFunction(n) => {
                write!(f, "function {n} is not part of this protocol, which knows 0 to 11")
            }
            WireError::UnknownModule(m) => {
                write!(f, "module {m} cannot be: modules are 0 to {}, the station is {STATION}", MAX_MODULES - 1)
            }
            WireError::WrongSender { function, module: STATION } => {
                write!(f, "{} came from the station, but only modules send it", function.name())
            }
            WireError::WrongSender { function: Function::EmergencyStop, module } => {
                write!(f, "EMERGENCY_STOP with a release came from module {module}, but only the station sends it")
            }
            WireError::WrongSender { function, module } => {
                write!(f, "{} came from module {module}, but only the station sends it", function.name())
            }
            WireError::WrongLength { function, got, expected } => {
                write!(f, "{} has {got} bytes instead of {expected}", function.name())
            }
            WireError::ReservedBits(function) => {
                write!(f, "{} has reserved bits or padding set that must be zero", function.name())
            }
            WireError::WrongValue { function, field, value } => {
                write!(f, "{}: {value} is no {field}, see wire-format.md", function.name())
            }
        }
    }
}

impl core::error::Error for WireError {}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{format, string::ToString};

    #[test]
    fn lengths_are_those_a_dlc_can_say() {
        for len in 0..=64usize {
            let frame = Frame::new(1, true, &[0xff; 64][..len]).unwrap();
            assert!(usize::from(frame.len) >= len);
            assert_eq!(Frame::dlc_to_len(frame.dlc(), true), frame.len);
            assert_eq!(frame.data.iter().filter(|b| **b != 0).count(), len);
            assert_eq!(Frame::new(1, false, &[0; 64][..len]).is_some(), len <= 8);
        }
        assert_eq!(Frame::padded_len(49, true), Some(64));
        assert_eq!(Frame::padded_len(65, true), None);
        assert_eq!(Frame::dlc_to_len(15, false), 8);
        assert_eq!(Frame::new(0x800, true, &[]), None);
    }

    #[test]
    fn lower_functions_win_arbitration() {
        assert!(Function::ALL.windows(2).all(|f| f[0].id(STATION) < f[1].id(0)));
        assert_eq!(Function::Heartbeat.id(3), 0x483);
    }

    #[test]
    fn errors_are_sentences() {
        let error = WireError::WrongLength { function: Function::State, got: 3, expected: 8 };
        assert_eq!(error.to_string(), "STATE has 3 bytes instead of 8");
        let frame = Frame::new(0x183, true, &[0xab, 1]).unwrap();
        assert_eq!(format!("{frame:?}"), "183##1AB01");
    }
}
