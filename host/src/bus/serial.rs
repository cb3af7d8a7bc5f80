//! CAN adapters on a serial line with the slcan protocol, CAN-FD included: CANable, and the pseudo-terminal of `snakectl sil --live`.

use std::collections::VecDeque;
use std::io;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::{Duration, Instant};

use composer_shared::wire::Frame;
use composer_sim_bridge::slcan::{self, Lines, Received, SlcanError};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FlockOperation, Mode, OFlags, flock};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, isatty, tcflush, tcgetattr, tcsetattr};

use super::{BusError, Transport};

/// How long an adapter may take to answer a command.
const PATIENCE: Duration = Duration::from_millis(500);

/// An open adapter. Dropping it closes its channel.
#[derive(Debug)]
pub struct Serial {
    port: OwnedFd,
    name: String,
    lines: Lines,
    frames: VecDeque<Frame>,
    /// Commands that were obeyed or refused since the last look.
    answers: VecDeque<bool>,
    fd: bool,
    garbled: u64,
    reason: Option<String>,
    opened: Instant,
}

impl Serial {
    /// Opens the serial port `path`, at `speed` bit/s if that matters (it does not for USB), and the adapter's channel at 1 Mbit/s, 5 Mbit/s in the
    /// data phase.
    pub fn open(path: &Path, speed: Option<u32>) -> Result<Self, BusError> {
        let name = format!("slcan:{}", path.display());
        let refuse = |reason: String| BusError::Open { transport: name.clone(), reason };
        let system = |error: Errno| refuse(io::Error::from(error).to_string());
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let port = rustix::fs::open(path, flags, Mode::empty()).map_err(|error| match error {
            Errno::NOENT => refuse(
                "there is no such serial port; is the adapter plugged in, or `snakectl sil --live` running?".into(),
            ),
            Errno::ACCESS => refuse("this user may not; on Linux members of the group dialout may".into()),
            error => system(error),
        })?;
        if !isatty(&port) {
            return Err(refuse("it is no serial port".into()));
        }
        if flock(&port, FlockOperation::NonBlockingLockExclusive).is_err() {
            return Err(refuse("another program has it open: two of them would take each other's frames".into()));
        }
        let mut attributes = tcgetattr(&port).map_err(system)?;
        attributes.make_raw();
        attributes.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
        if let Some(speed) = speed {
            attributes
                .set_speed(speed)
                .map_err(|_| refuse(format!("{speed} bit/s is no speed of this serial line")))?;
        }
        tcsetattr(&port, OptionalActions::Now, &attributes).map_err(system)?;
        let mut serial = Serial {
            port,
            name: name.clone(),
            lines: Lines::default(),
            frames: VecDeque::new(),
            answers: VecDeque::new(),
            fd: false,
            garbled: 0,
            reason: None,
            opened: Instant::now(),
        };
        // Whatever a program before left half said, or unread; an adapter whose channel is open stops talking.
        serial.write(b"\r\r\rC\r")?;
        serial.wait(Duration::from_millis(50))?;
        let _ = tcflush(&serial.port, QueueSelector::IFlush);
        (serial.lines, serial.garbled, serial.reason) = Default::default();
        serial.frames.clear();
        for (command, needed) in [("S8", true), ("Y5", false), ("O", true)] {
            match serial.command(command)? {
                Some(true) => {}
                // Adapters for classic CAN know no data phase.
                _ if !needed => {}
                Some(false) => return Err(refuse(format!("the adapter refuses the command {command}"))),
                None => {
                    return Err(refuse(format!(
                        "it does not answer as an slcan adapter does (command {command}); another device, or another serial speed?"
                    )));
                }
            }
        }
        Ok(serial)
    }

    fn failed(&self, error: Errno) -> BusError {
        let reason = match error {
            Errno::IO | Errno::NXIO | Errno::NODEV | Errno::PIPE => {
                "the terminal has closed: the adapter was pulled out, or the simulation has ended".into()
            }
            error => io::Error::from(error).to_string(),
        };
        BusError::Failed { transport: self.name.clone(), reason }
    }

    fn write(&mut self, mut bytes: &[u8]) -> Result<(), BusError> {
        let start = Instant::now();
        while !bytes.is_empty() {
            match rustix::io::write(&self.port, bytes) {
                Ok(length) => bytes = &bytes[length..],
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) if start.elapsed() > PATIENCE => {
                    let reason = "the adapter takes no more frames: nobody acknowledges them, or it hangs".into();
                    return Err(BusError::Failed { transport: self.name.clone(), reason });
                }
                Err(Errno::AGAIN) => {
                    self.ready(PollFlags::OUT, Duration::from_millis(10))?;
                }
                Err(error) => return Err(self.failed(error)),
            }
        }
        Ok(())
    }

    fn ready(&self, what: PollFlags, patience: Duration) -> Result<PollFlags, BusError> {
        let time = Timespec { tv_sec: patience.as_secs() as _, tv_nsec: patience.subsec_nanos() as _ };
        let mut fds = [PollFd::new(&self.port, what)];
        match poll(&mut fds, Some(&time)) {
            Ok(_) | Err(Errno::INTR) => Ok(fds[0].revents()),
            Err(error) => Err(self.failed(error)),
        }
    }

    /// Reads what has come in, after waiting for it at most so long.
    fn wait(&mut self, patience: Duration) -> Result<(), BusError> {
        self.ready(PollFlags::IN, patience)?;
        let mut buffer = [0; 4096];
        loop {
            match rustix::io::read(&self.port, &mut buffer) {
                Ok(0) => return Err(self.failed(Errno::IO)),
                Ok(length) => buffer[..length].iter().for_each(|byte| self.take(*byte)),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(()),
                Err(error) => return Err(self.failed(error)),
            }
        }
    }

    fn take(&mut self, byte: u8) {
        let mut garbled = |error: SlcanError| {
            self.garbled += 1;
            self.reason = Some(error.to_string());
        };
        match self.lines.push(byte) {
            None => {}
            Some(Err(error)) => garbled(error),
            Some(Ok(Received::Refused)) => self.answers.push_back(false),
            Some(Ok(Received::Line(line))) => match line.first() {
                None => self.answers.push_back(true),
                // A frame was sent; versions, serial number, status.
                Some(b'z' | b'Z' | b'V' | b'v' | b'N' | b'F') => {}
                _ => match slcan::frame(&line) {
                    Ok(frame) => {
                        self.fd |= frame.fd;
                        self.frames.push_back(frame);
                    }
                    Err(error) => garbled(error),
                },
            },
        }
    }

    /// Gives a command and waits for the answer: whether it was obeyed, if there is one.
    fn command(&mut self, command: &str) -> Result<Option<bool>, BusError> {
        self.answers.clear();
        self.write(format!("{command}\r").as_bytes())?;
        let start = Instant::now();
        while self.answers.is_empty() && start.elapsed() < PATIENCE {
            self.wait(Duration::from_millis(10))?;
        }
        Ok(self.answers.pop_front())
    }
}

impl Transport for Serial {
    fn send(&mut self, frame: &Frame) -> Result<(), BusError> {
        let mut line = Vec::new();
        slcan::write_frame(&mut line, frame);
        self.write(&line)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<Frame>, BusError> {
        let start = Instant::now();
        loop {
            if let Some(frame) = self.frames.pop_front() {
                return Ok(Some(frame));
            }
            let Some(left) = patience.checked_sub(start.elapsed()) else { return Ok(None) };
            self.wait(left.min(Duration::from_millis(100)))?;
        }
    }

    fn fd(&self) -> bool {
        self.fd
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }

    fn garbled(&self) -> (u64, Option<String>) {
        (self.garbled, self.reason.clone())
    }
}

impl Drop for Serial {
    fn drop(&mut self) {
        let _ = self.write(b"C\r");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_sim_bridge::live::Terminal;

    fn refusal(path: &Path) -> String {
        Serial::open(path, None).unwrap_err().to_string()
    }

    #[test]
    fn what_is_no_adapter_is_refused_with_a_sentence() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bus");
        assert!(refusal(&path).contains("there is no such serial port"));
        std::fs::write(&path, "").unwrap();
        assert!(refusal(&path).contains("it is no serial port"));
        std::fs::remove_file(&path).unwrap();
        // Nobody answers at the other end.
        let terminal = Terminal::open(&path, true).unwrap();
        assert!(refusal(&path).contains("does not answer as an slcan adapter"), "{}", refusal(&path));
        drop(terminal);
    }
}
