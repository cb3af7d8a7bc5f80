//! A module's computer at the end of a [link].

use std::collections::VecDeque;
use std::time::Duration;

use composer_firmware::controller::{Boot, Config, Micros, Outputs};
use composer_firmware::link::{
    self, BUILD, Carried, FromModule, LinkError, MESSAGE_MAX, PROTOCOL, Receiver, Sample, ToModule,
};
use composer_firmware::torque_off::Interrupt;
use composer_shared::robot::AXES;
use composer_shared::wire::{Frame, Mode};

use crate::computer::{Answer, Computer, Poll, Status, Trouble};

/// A line of bytes in both directions.
pub trait Line {
    /// Sends all of these bytes.
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble>;

    /// Waits for bytes, a limited time, and gives at least one.
    fn receive(&mut self, buffer: &mut [u8]) -> Result<usize, Trouble>;

    /// Waits for the end of the other side, a limited time, and says what can be known of it.
    fn post_mortem(&mut self) -> String;
}

/// What an image says of itself when it has booted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hello {
    /// Version of its firmware.
    pub firmware: u8,
    /// Whether it has the same controller as this program.
    pub same_controller: bool,
    /// Tag of the policy in its flash.
    pub policy: u16,
}

/// Why a module at the end of a link cannot be simulated.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LinkTrouble {
    /// Another version of the link.
    #[error(
        "the image of the module speaks version {image} of the link and this program version {PROTOCOL}: build both from the same sources, the image with `cargo qemu-image`"
    )]
    Version {
        /// The image's.
        image: u16,
    },
    /// What it was told is refused.
    #[error("the image of the module refuses: {0}")]
    Refused(String),
    /// It panicked or failed.
    #[error("the image of the module crashed: {words}{after}")]
    Crashed {
        /// Its last words.
        words: String,
        /// How it ended.
        after: String,
    },
    /// It does not answer.
    #[error("the image of the module has not answered for {} s: the link stalls", .0.as_secs_f32())]
    Stalled(Duration),
    /// It says something that makes no sense here.
    #[error("the link to the module fails: {0}")]
    Nonsense(String),
}

impl From<LinkTrouble> for Trouble {
    fn from(trouble: LinkTrouble) -> Self {
        Trouble::Failed(Box::new(trouble))
    }
}

/// A message that an answer can consist of, without what it borrows.
enum Reply {
    Frame(Frame),
    Answer { torque: Option<[f32; AXES]>, motors_enabled: bool, deadline: Micros, acted: u32, node: u8 },
    Sent,
    Status(Box<link::Status>),
    Interrupted(bool),
}

/// A computer at the other end of a [`Line`].
#[derive(Debug)]
pub struct Remote<L> {
    line: L,
    receiver: Receiver,
    /// Received bytes that are not looked at yet.
    ahead: VecDeque<u8>,
    /// What it is to be; taken when it has booted and was told.
    start: Option<(Config, Boot, Micros)>,
    /// The readings that it knows, by their bytes.
    sensors: Vec<u8>,
    torque: [f32; AXES],
    frames: VecDeque<Frame>,
    /// Frames that the last question had room for.
    asked: usize,
    /// It has no more frames until the next poll.
    drained: bool,
    status: link::Status,
}

impl<L: Line> Remote<L> {
    /// What boots at the other end of `line` is to be this module. Does not wait for it.
    pub fn new(line: L, config: Config, boot: Boot, now: Micros) -> Self {
        Remote {
            line,
            receiver: Receiver::default(),
            ahead: VecDeque::new(),
            start: Some((config, boot, now)),
            sensors: Vec::new(),
            torque: [0.0; AXES],
            frames: VecDeque::new(),
            asked: 0,
            drained: true,
            status: link::Status::off(),
        }
    }

    /// The same computer is to begin anew, as behind a power-on; what its flash has of policies stays.
    pub fn start_again(&mut self, config: Config, boot: Boot, now: Micros) -> Result<(), Trouble> {
        self.ensure_started()?;
        self.send(&ToModule::Start { config, boot, now })?;
        self.sensors.clear();
        self.frames.clear();
        (self.torque, self.asked, self.drained, self.status) = ([0.0; AXES], 0, true, link::Status::off());
        Ok(())
    }

    /// Waits until it has booted.
    pub fn hello(&mut self) -> Result<Hello, Trouble> {
        let first = self.message()?;
        if let Some(image) = link::hello_protocol(&first)
            && image != PROTOCOL
        {
            return Err(LinkTrouble::Version { image }.into());
        }
        match link::decode(&first) {
            Ok(FromModule::Hello { firmware, build, policy: Some(policy), .. }) => {
                Ok(Hello { firmware, same_controller: build == BUILD, policy })
            }
            // The reason comes next.
            Ok(FromModule::Hello { policy: None, .. }) => {
                self.reply().and_then(|_| Err(self.nonsense("it has no policy")))
            }
            Ok(FromModule::LastWords(words)) => Err(self.crashed(words.into())),
            _ => Err(self.nonsense("it does not begin with a hello")),
        }
    }

    /// Waits until it has booted, the first time, and tells it what it is.
    fn ensure_started(&mut self) -> Result<(), Trouble> {
        if let Some((config, boot, now)) = self.start {
            self.hello()?;
            self.start = None;
            self.send(&ToModule::Start { config, boot, now })?;
        }
        Ok(())
    }

    fn send(&mut self, message: &ToModule) -> Result<(), Trouble> {
        let mut buffer = [0; MESSAGE_MAX];
        self.line.send(link::encode(message, &mut buffer))
    }

    /// The bytes of the next message.
    fn message(&mut self) -> Result<Vec<u8>, Trouble> {
        let mut bytes = 0;
        loop {
            while let Some(byte) = self.ahead.pop_front() {
                match self.receiver.push(byte) {
                    None => bytes += 1,
                    Some(Ok(message)) => return Ok(message.to_vec()),
                    Some(Err(error)) => return Err(self.garbled(error)),
                }
                // A stream of zeros is no message and never too long.
                if bytes > MESSAGE_MAX {
                    return Err(self.garbled(LinkError::TooLong));
                }
            }
            let mut buffer = [0; 4096];
            let length = self.line.receive(&mut buffer)?;
            self.ahead.extend(&buffer[..length]);
        }
    }

    fn reply(&mut self) -> Result<Reply, Trouble> {
        let message = self.message()?;
        Ok(match link::decode(&message) {
            Ok(FromModule::Frame(Carried(frame))) => Reply::Frame(frame),
            Ok(FromModule::Answer { torque, motors_enabled, deadline, acted, node }) => {
                Reply::Answer { torque, motors_enabled, deadline, acted, node }
            }
            Ok(FromModule::Sent) => Reply::Sent,
            Ok(FromModule::Status(status)) => Reply::Status(Box::new(status)),
            Ok(FromModule::Interrupted { off }) => Reply::Interrupted(off),
            Ok(FromModule::Refused(reason)) => return Err(LinkTrouble::Refused(reason.into()).into()),
            Ok(FromModule::LastWords(words)) => return Err(self.crashed(words.into())),
            Ok(FromModule::Hello { .. }) => return Err(self.nonsense("it has started again by itself")),
            Err(error) => return Err(self.garbled(error)),
        })
    }

    fn garbled(&self, error: LinkError) -> Trouble {
        LinkTrouble::Nonsense(error.to_string()).into()
    }

    fn crashed(&mut self, words: String) -> Trouble {
        LinkTrouble::Crashed { words, after: self.line.post_mortem() }.into()
    }

    fn nonsense(&self, what: &str) -> Trouble {
        LinkTrouble::Nonsense(what.into()).into()
    }

    /// Keeps a frame; no more may come than there was room for.
    fn keep(&mut self, frame: Frame, count: &mut usize) -> Result<(), Trouble> {
        *count += 1;
        if *count > self.asked {
            return Err(self.nonsense("it sends more frames than there is room for"));
        }
        self.frames.push_back(frame);
        Ok(())
    }
}

impl<L: Line> Computer for Remote<L> {
    fn ask_poll(&mut self, poll: &Poll<'_>) -> Result<(), Trouble> {
        self.ensure_started()?;
        // By bytes: 0 and -0 are equal but not the same.
        let mut bytes = [0; MESSAGE_MAX];
        let bytes = link::encode(&Sample(*poll.sensors), &mut bytes);
        let sensors = (*bytes != *self.sensors).then_some(Sample(*poll.sensors));
        if sensors.is_some() {
            self.sensors = bytes.to_vec();
        }
        self.asked = poll.room.min(usize::from(u8::MAX));
        let frame = poll.frame.copied().map(Carried);
        self.send(&ToModule::Poll { now: poll.now, bus: poll.bus, room: self.asked as u8, sensors, frame })
    }

    fn answer(&mut self) -> Result<Answer, Trouble> {
        let mut count = 0;
        loop {
            match self.reply()? {
                Reply::Frame(frame) => self.keep(frame, &mut count)?,
                Reply::Answer { torque, motors_enabled, deadline, acted, node } => {
                    self.torque = torque.unwrap_or(self.torque);
                    self.drained = count < self.asked;
                    return Ok(Answer {
                        outputs: Outputs { torque: self.torque, motors_enabled, deadline },
                        acted,
                        node,
                    });
                }
                _ => return Err(self.nonsense("it answers something else than it was asked")),
            }
        }
    }

    fn next_frame(&mut self, room: usize) -> Result<Option<Frame>, Trouble> {
        if self.frames.is_empty() && !self.drained {
            self.asked = room.min(usize::from(u8::MAX));
            self.send(&ToModule::Frames { room: self.asked as u8 })?;
            let mut count = 0;
            loop {
                match self.reply()? {
                    Reply::Frame(frame) => self.keep(frame, &mut count)?,
                    Reply::Sent => break,
                    _ => return Err(self.nonsense("it answers something else than it was asked")),
                }
            }
            self.drained = count < self.asked;
        }
        Ok(self.frames.pop_front())
    }

    fn interrupt(&mut self, interrupt: Interrupt<'_>) -> Result<(bool, Option<Frame>), Trouble> {
        self.ensure_started()?;
        let frame = match interrupt {
            Interrupt::Frame(frame) => Some(Carried(*frame)),
            Interrupt::StopInput => None,
        };
        self.send(&ToModule::Interrupt { frame })?;
        match self.reply()? {
            Reply::Interrupted(off) => Ok((off, None)),
            Reply::Frame(frame) => match self.reply()? {
                Reply::Interrupted(off) => Ok((off, Some(frame))),
                _ => Err(self.nonsense("it answers something else than it was asked")),
            },
            _ => Err(self.nonsense("it answers something else than it was asked")),
        }
    }

    fn ask_status(&mut self) -> Result<(), Trouble> {
        self.ensure_started()?;
        self.send(&ToModule::Status)
    }

    fn await_status(&mut self) -> Result<(), Trouble> {
        match self.reply()? {
            Reply::Status(status) if status.mode().is_some() => self.status = *status,
            _ => return Err(self.nonsense("it answers something else than it was asked")),
        }
        Ok(())
    }

    fn status(&self) -> Status<'_> {
        let status = &self.status;
        Status {
            mode: status.mode().unwrap_or(Mode::Boot),
            cycle: status.cycle,
            time_keeper: status.time_keeper,
            alive: status.alive,
            heard: status.heard,
            attention: &status.attention.all,
            faults: status.faults,
            stats: status.stats,
            retained: status.retained,
        }
    }
}

#[cfg(test)]
mod tests;
