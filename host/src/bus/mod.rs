//! A robot on a real bus, or on a simulated one in real time: transports, the station, and what people do with them.
//!
//! A [`Transport`] carries frames: [SocketCAN](socketcan) or a serial adapter with the [slcan](serial) protocol, which may also be the pseudo-terminal
//! of `snakectl sil --live`. [`Robot`] makes of the frames what one knows of each module, [`Station`] asks and commands. Nothing here prints.

pub mod calibrate;
pub mod config;
pub mod monitor;
pub mod registers;
mod robot;
#[cfg(unix)]
pub mod serial;
pub mod simulated;
#[cfg(target_os = "linux")]
pub mod socketcan;
mod station;
pub mod update;

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use composer_shared::wire::{Frame, ServiceCode};

pub use robot::{Change, Module, Robot, SILENT_CYCLES, fault_name};
pub use station::{Answer, Drive, LogEntry, Station};

/// What carries frames to and from a bus.
pub trait Transport: Send {
    /// Sends a frame, or hands it to the system to be sent.
    fn send(&mut self, frame: &Frame) -> Result<(), BusError>;

    /// The next frame that somebody else sent; none if there is none within `patience`.
    fn receive(&mut self, patience: Duration) -> Result<Option<Frame>, BusError>;

    /// Whether the bus is known to carry CAN-FD frames. Modules understand short frames in either format.
    fn fd(&self) -> bool;

    /// Time since the transport was opened.
    fn now(&self) -> Duration;

    /// Lines or frames received that made no sense, and the last reason.
    fn garbled(&self) -> (u64, Option<String>) {
        (0, None)
    }
}

/// What goes wrong between a program and a robot.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The transport cannot be opened.
    #[error("{transport} cannot be opened: {reason}")]
    Open {
        /// Which.
        transport: String,
        /// Why, and what would be right.
        reason: String,
    },
    /// It was closed, or failed, while it was in use.
    #[error("{transport} has failed: {reason}")]
    Failed {
        /// Which.
        transport: String,
        /// Why.
        reason: String,
    },
    /// Nobody is heard.
    #[error(
        "no module is heard on the bus: is the robot powered, the cable plugged in, and the bit rate 1 Mbit/s (5 Mbit/s in the data phase)?"
    )]
    Nobody,
    /// A module does not answer.
    #[error("module {node} does not answer: {}", if *.heard { "it is on the bus; ask again" } else { "it is not heard on the bus" })]
    Silent {
        /// Which.
        node: u8,
        /// Whether it is on the bus.
        heard: bool,
    },
    /// A module refuses.
    #[error("module {node} refuses {what}: {}", sentence(*.code))]
    Refused {
        /// Which.
        node: u8,
        /// What it was asked for.
        what: String,
        /// Its answer, a [`ServiceCode`].
        code: u8,
    },
    /// A file does not fit the robot, or a measurement makes no sense.
    #[error("{0}")]
    Refusal(String),
    /// Not all modules do what was asked for.
    #[error("{0}")]
    Incomplete(String),
    /// Ctrl-C.
    #[error("interrupted")]
    Interrupted,
}

/// What a code says.
pub fn sentence(code: u8) -> String {
    match ServiceCode::from_number(code) {
        Some(code) => code.sentence().into(),
        None => format!("it answers with the code {code}, which this program does not know"),
    }
}

/// Where a bus is, as people write it: `can0`, or `slcan:/dev/ttyACM0`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A network interface of Linux.
    SocketCan(String),
    /// A serial adapter, and the speed of its serial line if that matters.
    Serial {
        /// The device.
        path: PathBuf,
        /// Bit/s.
        speed: Option<u32>,
    },
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        const RIGHT: &str = "a transport is a CAN interface such as can0, or slcan: and a serial port, such as slcan:/dev/ttyACM0 or slcan:/dev/ttyUSB0@921600";
        if let Some(serial) = text.strip_prefix("slcan:") {
            let (path, speed) = match serial.rsplit_once('@') {
                Some((path, speed)) => {
                    let speed =
                        speed.parse().map_err(|_| format!("`{speed}` is no speed of a serial line: {RIGHT}"))?;
                    (path, Some(speed))
                }
                None => (serial, None),
            };
            if path.is_empty() {
                return Err(format!("`{text}` names no serial port: {RIGHT}"));
            }
            return Ok(Address::Serial { path: path.into(), speed });
        }
        let good = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if text.is_empty() || text.len() > 15 || !text.chars().all(good) {
            return Err(format!("`{text}` is none: {RIGHT}"));
        }
        Ok(Address::SocketCan(text.into()))
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Address::SocketCan(name) => f.write_str(name),
            Address::Serial { path, speed: None } => write!(f, "slcan:{}", path.display()),
            Address::Serial { path, speed: Some(speed) } => write!(f, "slcan:{}@{speed}", path.display()),
        }
    }
}

impl Address {
    /// Opens it.
    pub fn open(&self) -> Result<Box<dyn Transport>, BusError> {
        match self {
            #[cfg(target_os = "linux")]
            Address::SocketCan(name) => Ok(Box::new(socketcan::SocketCan::open(name)?)),
            #[cfg(not(target_os = "linux"))]
            Address::SocketCan(_) => Err(BusError::Open {
                transport: self.to_string(),
                reason: "SocketCAN is a part of Linux; here a serial adapter does it: slcan:/dev/tty...".into(),
            }),
            #[cfg(unix)]
            Address::Serial { path, speed } => Ok(Box::new(serial::Serial::open(path, *speed)?)),
            #[cfg(not(unix))]
            Address::Serial { .. } => Err(BusError::Open {
                transport: self.to_string(),
                reason: "serial adapters are supported on Linux and macOS".into(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_what_is_none_gets_a_sentence() {
        let serial = |path: &str, speed| Address::Serial { path: path.into(), speed };
        for (text, address) in [
            ("can0", Address::SocketCan("can0".into())),
            ("slcan:/dev/ttyACM0", serial("/dev/ttyACM0", None)),
            ("slcan:bus@921600", serial("bus", Some(921_600))),
        ] {
            assert_eq!(text.parse(), Ok(address.clone()));
            assert_eq!(address.to_string(), text);
        }
        for (text, word) in [
            ("", "`` is none"),
            ("/dev/ttyACM0", "slcan:/dev/ttyACM0"),
            ("slcan:", "names no serial port"),
            ("slcan:bus@fast", "`fast` is no speed"),
            ("an-interface-too-long", "is none"),
        ] {
            let error = text.parse::<Address>().unwrap_err();
            assert!(error.contains(word), "{error}");
        }
        assert!(sentence(5).contains("disarm first") && sentence(99).contains("code 99"));
    }
}
