//! Why an image is refused, one sentence each.

use core::fmt;

use super::{DIMENSIONS, IMAGE_SIZE, MEMORY, OBS, Task, VERSION};
use crate::observation;

/// Why an image is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyError {
    /// Fewer bytes than an image has.
    TooShort {
        /// Bytes given.
        length: usize,
    },
    /// More bytes than an image has.
    TooLong {
        /// Bytes given.
        length: usize,
    },
    /// The first bytes are not [`MAGIC`](super::MAGIC).
    Magic,
    /// Another layout version.
    Version {
        /// The version it has.
        found: u16,
    },
    /// Another network: widths of embedding, key, value, hidden layer and action.
    Dimensions {
        /// The widths it has.
        found: [u16; 5],
    },
    /// It takes another number of fields of the observation.
    Inputs(u16),
    /// It has a memory of another number of channels.
    Memory(u8),
    /// The length it states is not that of its layout.
    Length {
        /// The length it states.
        stated: u32,
    },
    /// The checksum at the end is not that of the bytes before it.
    Checksum {
        /// As stored.
        stored: u32,
        /// As computed.
        computed: u32,
    },
    /// A task that this code does not know.
    Task(u8),
    /// A number that can only be 0 or 1, or must be 0 (reserved).
    Flag {
        /// Its name in `policy-format.md`.
        field: &'static str,
        /// Its value.
        found: u8,
    },
    /// A quantity that is not finite or out of its range.
    Value {
        /// What it is.
        field: &'static str,
        /// The range it must lie in.
        range: &'static str,
    },
}

/// `[1, 2]`, without the code of `Debug`, which is large for a microcontroller.
fn list(f: &mut fmt::Formatter<'_>, numbers: &[u16]) -> fmt::Result {
    for (i, number) in numbers.iter().enumerate() {
        f.write_str(if i == 0 { "[" } else { ", " })?;
        write!(f, "{number}")?;
    }
    f.write_str("]")
}

impl fmt::Display for PolicyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooShort { length } => {
                write!(f, "the policy image is cut short: it has {length} bytes where {IMAGE_SIZE} are needed")
            }
            Self::TooLong { length } => {
                write!(f, "the policy image is too long: it has {length} bytes where {IMAGE_SIZE} are needed")
            }
            Self::Magic => write!(f, "this is not a policy image: it does not begin with COMPOSER"),
            Self::Version { found } => write!(
                f,
                "the policy image has layout version {found}, this build reads version {VERSION}: \
                 export the policy again"
            ),
            Self::Dimensions { found } => {
                f.write_str("the policy image holds a network of dimensions ")?;
                list(f, &found)?;
                f.write_str(", this build runs ")?;
                list(f, &DIMENSIONS)?;
                f.write_str(" (embedding, key, value, hidden, action)")
            }
            Self::Inputs(found) => write!(
                f,
                "the policy image holds a network of {found} inputs, this build knows the first {} fields of the observation or all {OBS}",
                observation::BASE
            ),
            Self::Memory(found) => write!(
                f,
                "the policy image holds a network with a memory of {found} channels, there is room for {MEMORY} or none"
            ),
            Self::Length { stated } => {
                write!(f, "the policy image says it is {stated} bytes long, layout version {VERSION} is {IMAGE_SIZE}")
            }
            Self::Checksum { stored, computed } => {
                write!(f, "the policy image is damaged: its CRC-32 should be {stored:08x} and is {computed:08x}")
            }
            Self::Task(found) => {
                write!(f, "the policy image is for task {found}, this build knows tasks 0 to {}", Task::ALL.len() - 1)
            }
            Self::Flag { field, found } => {
                write!(
                    f,
                    "the policy image has {found} in field `{field}`, which layout version {VERSION} does not define"
                )
            }
            Self::Value { field, range } => {
                write!(f, "the policy image has a {field} that is not a number from {range}")
            }
        }
    }
}

impl core::error::Error for PolicyError {}
