//! The link between one emulated module and the simulator: what both sides say, and how it lies on the wire.
//!
//! An emulated microcontroller has no CAN controller, no sensors and no clock that the simulation knows. All of them are a serial
//! line to the simulator: it says what time it is, what the sensors read and which frame came, and the module answers with its torque and the
//! frames it sends. The bus itself stays the simulated one. [`module`] is the module's side, a
//! [`Controller`](crate::controller::Controller) that is asked by messages; the image of the board adds no more than the UART.
//!
//! # On the wire
//!
//! A message is its [postcard](https://postcard.jamesmunns.com/wire-format) encoding (the variant's number, then the fields in order;
//! integers of more than one byte as varints, f32 as 4 bytes little endian, an option as 0 or as 1 and the value), framed by
//! [COBS](https://doi.org/10.1109/90.769765): a 0 byte ends a message and occurs nowhere else; one more between two messages means nothing. No message is longer than
//! [`MESSAGE_MAX`] bytes with its framing. There is no checksum, because the line is a pipe between two processes: what cannot be
//! decoded is an error of the other side, answered with [`FromModule::Refused`], and reading goes on behind the next 0.
//!
//! # Who says what
//!
//! | simulator ([`ToModule`]) | module ([`FromModule`]) |
//! |---|---|
//! | | `Hello` when it has booted; `Refused` behind it if the policy image in its flash is not usable |
//! | `Start`: be this module | nothing, or `Refused` |
//! | `Poll`: so late is it, this the sensors read, this came | a `Frame` for each frame it sends, then `Answer` |
//! | `Frames`: the CAN port has room again | a `Frame` for each, then `Sent` |
//! | `Status` | `Status` |
//! | `Interrupt`: a frame came or the stop input opened while it computed | a `Frame` if it tells the others at once, then `Interrupted` |
//!
//! The module never speaks unasked, but for `Hello` and, if it panics, `LastWords`. It has no time of its own: between two messages nothing
//! happens in it. So what it answers depends on what it was told alone, and the simulator may let several modules work at once.

pub mod module;

use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, MAX_JOINTS, ROOM};
use composer_shared::wire::{Frame, Mode};
use serde::de::{Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::controller::{Boot, BusStatus, Config, FaultSet, Micros, Retained, Stats};

/// Version of these messages. The first two numbers of the first message, 0 and this, stay what they are in every version.
pub const PROTOCOL: u16 = 3;

/// Most bytes of an encoded message, framing and the 0 at its end included.
pub const MESSAGE_MAX: usize = 320;

/// Most bytes of a text in a message.
pub const TEXT_MAX: usize = 200;

/// Where the policy image lies in an emulated module's flash; `boards/qemu.x` says the same.
pub const POLICY_ADDRESS: u32 = 0x0003_8000;

/// A fingerprint of the sources that the controller is built from. Simulator and image should have the same, otherwise they run
/// different controllers.
pub const BUILD: u64 = match u64::from_str_radix(env!("COMPOSER_CONTROLLER_SOURCES"), 16) {
    Ok(fingerprint) => fingerprint,
    Err(_) => panic!("the build script gives 16 hexadecimal digits"),
};

/// What the simulator says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToModule {
    /// Power is on, or a reset is over: a new controller with this configuration begins at `now`. A module that has one already forgets it.
    Start {
        /// Which module of which robot.
        config: Config,
        /// Why it starts, and what it still knows.
        boot: Boot,
        /// The module's clock, us.
        now: Micros,
    },
    /// [`Controller::poll`](crate::controller::Controller::poll).
    Poll {
        /// The module's clock, us.
        now: Micros,
        /// How its CAN controller is.
        bus: BusStatus,
        /// Frames that its CAN port has room for.
        room: u8,
        /// What the sensors read; none if they read what they did last time. All are zero before the first.
        sensors: Option<Sample>,
        /// A frame that it received.
        frame: Option<Carried>,
    },
    /// Its CAN port has room for so many frames.
    Frames {
        /// Frames that fit.
        room: u8,
    },
    /// What is it at?
    Status,
    /// While it computes, its CAN controller received this frame; or, if there is none, its stop input opened ([`crate::torque_off`]).
    Interrupt {
        /// The frame; it comes with a `Poll` again.
        frame: Option<Carried>,
    },
}

/// What the module says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum FromModule<'a> {
    /// It has booted.
    Hello {
        /// Its [`PROTOCOL`].
        protocol: u16,
        /// [`FIRMWARE_VERSION`](crate::controller::FIRMWARE_VERSION).
        firmware: u8,
        /// Its [`BUILD`].
        build: u64,
        /// The tag of the policy in its flash; none if that is unusable.
        policy: Option<u16>,
    },
    /// It cannot do that; the reason as a sentence.
    Refused(&'a str),
    /// It sends this frame.
    Frame(Carried),
    /// [`Outputs`](crate::controller::Outputs), and that these were all frames, or as many as there was room for.
    Answer {
        /// The torque; none if it is the same as last time. Zero before the first.
        torque: Option<[f32; AXES]>,
        /// Whether the motors follow it.
        motors_enabled: bool,
        /// When to poll again at the latest, us.
        deadline: Micros,
        /// How often it has acted ([`Stats::acted`]).
        acted: u32,
        /// Its number, for its CAN port; 255 if it is off.
        node: u8,
    },
    /// These were all frames, or as many as there was room for.
    Sent,
    /// What it is at.
    Status(Status),
    /// It took the interrupt.
    Interrupted {
        /// Whether its motors coast now.
        off: bool,
    },
    /// It panics; this is why. Nothing more will come.
    LastWords(&'a str),
}

/// What a module is at, for whoever looks on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// The number of its [`Mode`].
    pub mode: u8,
    /// Number of its control cycle.
    pub cycle: u16,
    /// Whose SYNC it follows.
    pub time_keeper: Option<u8>,
    /// Modules that it believes alive, as a bit mask.
    pub alive: u64,
    /// Modules that it attended over in its last action, as a bit mask.
    pub heard: u64,
    /// Its active faults.
    pub faults: FaultSet,
    /// Its counters.
    pub stats: Stats,
    /// What it keeps for its next start.
    pub retained: Retained,
    /// Its attention over the modules.
    pub attention: Weights,
}

impl Status {
    /// Of a module that is off.
    pub fn off() -> Self {
        Status {
            mode: Mode::Boot as u8,
            cycle: 0,
            time_keeper: None,
            alive: 0,
            heard: 0,
            faults: FaultSet::EMPTY,
            stats: Stats::default(),
            retained: Retained::default(),
            attention: Weights { all: [0; ROOM], modules: 0 },
        }
    }

    /// What the module is at; `None` if no mode has this number.
    pub fn mode(&self) -> Option<Mode> {
        Mode::from_number(self.mode)
    }
}

/// Sensor readings in a message: joint angles, joint speeds, up, angular rate, torque, temperature.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample(#[serde(with = "SensorsDef")] pub Sensors);

#[derive(Serialize, Deserialize)]
#[serde(remote = "Sensors")]
struct SensorsDef {
    joint_angles: [f32; MAX_JOINTS],
    joint_speeds: [f32; MAX_JOINTS],
    up: [f32; 3],
    angular_rate: [f32; 3],
    torque: [f32; AXES],
    temperature: f32,
}

/// A CAN frame in a message: identifier (varint), flags (bit 0: CAN-FD, bit 1: bit-rate switch), and the payload as its length and its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Carried(pub Frame);

impl Serialize for Carried {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let frame = &self.0;
        (frame.id, u8::from(frame.fd) | u8::from(frame.brs) << 1, frame.payload()).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Carried {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let (id, flags, payload): (u16, u8, &'de [u8]) = Deserialize::deserialize(deserializer)?;
        let frame = Frame::new(id, flags & 1 != 0, payload)
            .filter(|frame| flags < 4 && payload.len() == usize::from(frame.len));
        let frame = frame.ok_or_else(|| D::Error::custom("no CAN frame"))?;
        Ok(Carried(Frame { brs: flags & 2 != 0, ..frame }))
    }
}

/// Attention by module, Q15, in a message: how many, and each as a varint. The others are 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Weights {
    /// The weights.
    pub all: [u16; ROOM],
    /// How many of them travel.
    pub modules: u8,
}

impl Serialize for Weights {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.all.get(..usize::from(self.modules)).unwrap_or(&self.all).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Weights {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List;
        impl<'de> Visitor<'de> for List {
            type Value = Weights;

            fn expecting(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                write!(f, "at most {ROOM} weights")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Weights, A::Error> {
                let mut weights = Weights { all: [0; ROOM], modules: 0 };
                while let Some(weight) = list.next_element()? {
                    let slot = weights.all.get_mut(usize::from(weights.modules));
                    *slot.ok_or_else(|| A::Error::custom("too many weights"))? = weight;
                    weights.modules += 1;
                }
                Ok(weights)
            }
        }
        deserializer.deserialize_seq(List)
    }
}

/// A text of at most [`TEXT_MAX`] bytes that is written piece by piece; what does not fit is cut off.
#[derive(Clone, Debug)]
pub struct Text {
    bytes: [u8; TEXT_MAX],
    len: usize,
}

impl Text {
    /// What `value` displays as.
    pub fn of(value: impl core::fmt::Display) -> Self {
        let mut text = Text { bytes: [0; TEXT_MAX], len: 0 };
        // Writing into it never fails, and a Display that does has nothing more to say.
        let _ = core::fmt::Write::write_fmt(&mut text, format_args!("{value}"));
        text
    }

    /// The text.
    pub fn as_str(&self) -> &str {
        self.bytes.get(..self.len).and_then(|bytes| core::str::from_utf8(bytes).ok()).unwrap_or_default()
    }
}

impl core::fmt::Write for Text {
    fn write_str(&mut self, s: &str) -> core::fmt::Result {
        for c in s.chars() {
            let mut utf8 = [0; 4];
            let c = c.encode_utf8(&mut utf8).as_bytes();
            let Some(room) = self.bytes.get_mut(self.len..self.len + c.len()) else { break };
            room.copy_from_slice(c);
            self.len += c.len();
        }
        Ok(())
    }
}

/// Why received bytes are no message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkError {
    /// More than [`MESSAGE_MAX`] bytes without a 0.
    TooLong,
    /// They decode to nothing of this protocol.
    Garbled,
}

impl core::fmt::Display for LinkError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            LinkError::TooLong => write!(f, "a message on the link has more than {MESSAGE_MAX} bytes"),
            LinkError::Garbled => write!(f, "a message on the link cannot be decoded"),
        }
    }
}

impl core::error::Error for LinkError {}

/// Encodes a message, framing included. Gives nothing if it is too long, which no message of this protocol is.
pub fn encode<'b>(message: &impl Serialize, buffer: &'b mut [u8; MESSAGE_MAX]) -> &'b [u8] {
    postcard::to_slice_cobs(message, buffer).map_or(&[], |bytes| bytes)
}

/// Collects received bytes into messages.
#[derive(Clone, Debug)]
pub struct Receiver {
    buffer: [u8; MESSAGE_MAX],
    /// Bytes so far; more than fit if the message is too long. What follows up to the next 0 belongs to it too.
    len: usize,
}

impl Default for Receiver {
    fn default() -> Self {
        Receiver { buffer: [0; MESSAGE_MAX], len: 0 }
    }
}

impl Receiver {
    /// Takes one byte. At the end of a message: its bytes with the framing taken off, for [`decode`].
    pub fn push(&mut self, byte: u8) -> Option<Result<&[u8], LinkError>> {
        if byte != 0 {
            if let Some(slot) = self.buffer.get_mut(self.len) {
                *slot = byte;
            }
            self.len = self.len.saturating_add(1).min(MESSAGE_MAX);
            return None;
        }
        let len = core::mem::take(&mut self.len);
        if len == 0 {
            return None;
        }
        // The 0 counts too.
        let Some(message) = self.buffer.get_mut(..len).filter(|_| len < MESSAGE_MAX) else {
            return Some(Err(LinkError::TooLong));
        };
        let Ok(len) = cobs::decode_in_place(message) else {
            return Some(Err(LinkError::Garbled));
        };
        Some(self.buffer.get(..len).ok_or(LinkError::Garbled))
    }
}

/// The message that these bytes say, all of them.
pub fn decode<'a, T: Deserialize<'a>>(message: &'a [u8]) -> Result<T, LinkError> {
    match postcard::take_from_bytes(message) {
        Ok((message, [])) => Ok(message),
        _ => Err(LinkError::Garbled),
    }
}

/// The protocol version in a module's first message, whatever version it is; `None` if that is no `Hello`.
pub fn hello_protocol(message: &[u8]) -> Option<u16> {
    match postcard::take_from_bytes::<(u8, u16)>(message) {
        Ok(((0, protocol), _)) => Some(protocol),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
