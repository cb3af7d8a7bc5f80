//! CAN identifiers and frames: what the modules of one robot, its station and every listener say to each other.
//!
//! `wire-format.md` beside this crate specifies every byte without any Rust; [`LAYOUTS`] is the same as a table, and [`dbc`]
//! prints it for tools that read DBC files.
//!
//! ```
//! use composer_shared::wire::{Message, State, Health};
//!
//! let state = State::new(7, Health::SENSORS_PLAUSIBLE, &[0.1, -0.2, 0.0, 0.3]);
//! let frame = Message::State(state).emit(3, true);
//! assert_eq!(frame.id, 0x183);
//! assert_eq!(Message::parse(&frame), Ok(Message::State(state)));
//! ```

mod fault;
mod frame;
mod layout;
mod message;
mod service;
mod stop;

pub use fault::{Clearing, Effect, Fault, LimitedBy};
pub use frame::{Frame, Function, STATION, WireError};
pub use layout::{Field, LAYOUTS, Layout, Senders, dbc};
pub use message::{
    ANGLE_LSB, EmergencyStop, FRAGMENTS, Fragment, GOAL_LSB, GOAL_POINTS, Goal, Health, Heartbeat, LATENT_SIZE,
    LatentMessage, Message, Mode, NOBODY, Piece, State, StopCommand, Sync, Telemetry, quantise_angle,
};
pub use service::{ALL_MODULES, Operation, ServiceCode, ServiceRequest, ServiceResponse, UpdateStep};
pub use stop::{StopCount, StopLatch};

/// Version of this format; travels in every HEARTBEAT. It changes when a byte of an existing frame changes its meaning.
pub const PROTOCOL_VERSION: u8 = 3;

#[cfg(test)]
mod tests;
