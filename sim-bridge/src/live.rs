//! The simulated bus in real time, for other programs: a run that keeps pace with the clock on the wall, with serial CAN adapters on
//! pseudo-terminals as nodes of its bus.
//!
//! A [`Terminal`] looks to other programs like the serial port of an [slcan](crate::slcan) adapter. What they write enters the simulated bus as the
//! frames of one more node: with arbitration, acknowledgement, error counters. What the other nodes say comes out; what came in at a terminal does
//! not come out of it again. While nobody has a terminal open, or its channel is closed, nothing is kept for it. A [`Control`]
//! lets programs break and mend the robot while it runs.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use composer_shared::wire::Frame;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, tcflush, tcgetattr, tcsetattr};

use crate::control::Control;
use crate::sil::{Outside, Refusal, Turn};
use crate::slcan::{Adapter, Lines, Obeyed, REFUSED, Received, write_frame};

/// Most bytes kept for a program that does not read; then whole frames are lost, as in an adapter.
const BUFFER: usize = 1 << 16;

/// So long a wait may be before somebody looks whether the run is to end, or whether a terminal was opened.
const PATIENCE: Duration = Duration::from_millis(10);

/// A run that is further behind the clock on the wall than this does not try to catch up.
const SLIP: Duration = Duration::from_millis(100);

/// Why there is no terminal.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The system gives none.
    #[error("no pseudo-terminal can be made: {0}")]
    Terminal(io::Error),
    /// Something is there already.
    #[error("{} exists already and is no link to a terminal that is gone: choose another path, or remove it", .0.display())]
    Exists(PathBuf),
    /// The link cannot be made.
    #[error("no link to the terminal can be made at {}: {error}", .path.display())]
    Link {
        /// Where.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// The serial port of an adapter, as other programs see it: a pseudo-terminal with a symbolic link to it. Dropping it removes both.
#[derive(Debug)]
pub struct Terminal {
    master: OwnedFd,
    name: PathBuf,
    link: PathBuf,
    lines: Lines,
    adapter: Adapter,
    /// Bytes that its reader has not taken yet.
    out: VecDeque<u8>,
    attached: bool,
    lost: u64,
}

impl Terminal {
    /// A terminal that can be opened at `link`, an adapter for a CAN-FD bus or for a classic one.
    pub fn open(link: &Path, fd: bool) -> Result<Self, LiveError> {
        let system = |error: Errno| LiveError::Terminal(error.into());
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).map_err(system)?;
        grantpt(&master).map_err(system)?;
        unlockpt(&master).map_err(system)?;
        let name = ptsname(&master, Vec::new()).map_err(system)?;
        let name = PathBuf::from(OsStr::from_bytes(name.as_bytes()));
        // A terminal would echo what is written to it and treat control characters its own way.
        let mut attributes = tcgetattr(&master).map_err(system)?;
        attributes.make_raw();
        tcsetattr(&master, OptionalActions::Now, &attributes).map_err(system)?;
        fcntl_setfl(&master, fcntl_getfl(&master).map_err(system)? | OFlags::NONBLOCK).map_err(system)?;
        make_link(&name, link)?;
        let (lines, adapter, out) = (Lines::default(), Adapter::new(fd), VecDeque::new());
        Ok(Terminal { master, name, link: link.into(), lines, adapter, out, attached: false, lost: 0 })
    }

    /// Whether a program has it open.
    pub fn attached(&self) -> bool {
        self.attached
    }

    /// Frames that its reader was too slow for.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Reads what has come in, obeys it, and gives the frames to be sent.
    fn read(&mut self, frames: &mut VecDeque<Frame>) {
        let mut buffer = [0; 4096];
        loop {
            match rustix::io::read(&self.master, &mut buffer) {
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return self.attached = true,
                // Nobody has it open: EIO on Linux, an end elsewhere. What the last one asked for is out of date.
                Err(_) | Ok(0) => {
                    if self.attached {
                        self.attached = false;
                        self.forget();
                    }
                    return;
                }
                Ok(length) => {
                    self.attached = true;
                    for byte in &buffer[..length] {
                        match self.lines.push(*byte) {
                            Some(Ok(Received::Line(line))) => {
                                let Obeyed { reply, frame } = self.adapter.obey(&line);
                                self.out.extend(reply);
                                frames.extend(frame);
                            }
                            Some(Ok(Received::Refused) | Err(_)) => self.out.push_back(REFUSED),
                            None => {}
                        }
                    }
                }
            }
        }
    }

    /// Whoever had it open has gone: nothing of it is left for the next one.
    fn forget(&mut self) {
        self.lines = Lines::default();
        self.adapter.close();
        self.out.clear();
        // What it did not read waits in the system, at the other end.
        if let Ok(other) = rustix::fs::open(&self.name, OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK, Mode::empty())
        {
            let _ = tcflush(&other, QueueSelector::IFlush);
        }
    }

    /// Writes what its reader takes.
    fn write(&mut self) {
        while !self.out.is_empty() {
            match rustix::io::write(&self.master, self.out.as_slices().0) {
                Ok(length) => drop(self.out.drain(..length)),
                Err(Errno::INTR) => {}
                Err(_) => return,
            }
        }
    }

    fn hear(&mut self, frame: &Frame) {
        if !self.attached || !self.adapter.hears() {
            return;
        }
        let mut line = Vec::new();
        write_frame(&mut line, frame);
        if self.out.len() + line.len() > BUFFER {
            self.lost += 1;
        } else {
            self.out.extend(line);
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // Somebody may have put another link in its place.
        if std::fs::read_link(&self.link).is_ok_and(|target| target == self.name) {
            let _ = std::fs::remove_file(&self.link);
        }
    }
}

/// Links to the terminal; a link to one that is gone is replaced.
fn make_link(name: &Path, link: &Path) -> Result<(), LiveError> {
    if let Ok(there) = std::fs::symlink_metadata(link) {
        // A number of a terminal is used again, so a link that is left over may even lead to this one.
        let stale =
            there.is_symlink() && (!link.exists() || std::fs::read_link(link).is_ok_and(|target| target == name));
        if !stale {
            return Err(LiveError::Exists(link.into()));
        }
        let _ = std::fs::remove_file(link);
    }
    std::os::unix::fs::symlink(name, link).map_err(|error| LiveError::Link { path: link.into(), error })
}

/// Terminals as nodes of a simulated bus that keeps pace with the clock on the wall.
#[derive(Debug)]
pub struct Live<'a> {
    terminals: Vec<Terminal>,
    /// Frames that came in, with the number of their terminal.
    coming: VecDeque<(usize, Frame)>,
    /// Seconds of the simulation in a second.
    pace: f64,
    /// When the simulation was at 0, or would have been if it had not fallen behind since.
    start: Option<Instant>,
    behind: Duration,
    /// Programs that command the run.
    control: Option<Control>,
    ended: &'a AtomicBool,
}

impl<'a> Live<'a> {
    /// A run with these terminals at `pace` times real time that ends when `ended` is set.
    pub fn new(terminals: Vec<Terminal>, pace: f64, ended: &'a AtomicBool) -> Self {
        Live { terminals, coming: VecDeque::new(), pace, start: None, behind: Duration::ZERO, control: None, ended }
    }

    /// The same with programs that command it.
    pub fn commanded(self, control: Option<Control>) -> Self {
        Live { control, ..self }
    }

    /// The terminals.
    pub fn terminals(&self) -> &[Terminal] {
        &self.terminals
    }

    /// How much longer the run took than it should have, because this machine could not keep up.
    pub fn behind(&self) -> Duration {
        self.behind
    }

    /// Waits until a terminal can be read, at most until then.
    fn sleep(&self, longest: Duration) {
        let longest = longest.min(PATIENCE);
        // A terminal that nobody has open is always ready: it is looked at from time to time.
        let wanted = |terminal: &&Terminal| terminal.attached;
        let mut fds: Vec<PollFd<'_>> = self
            .terminals
            .iter()
            .filter(wanted)
            .map(|terminal| {
                let write = if terminal.out.is_empty() { PollFlags::empty() } else { PollFlags::OUT };
                PollFd::new(&terminal.master, PollFlags::IN | write)
            })
            .collect();
        for (source, write) in self.control.iter().flat_map(Control::sources) {
            let write = if write { PollFlags::OUT } else { PollFlags::empty() };
            fds.push(PollFd::from_borrowed_fd(source, PollFlags::IN | write));
        }
        let time = Timespec { tv_sec: 0, tv_nsec: i64::from(longest.subsec_nanos()) as _ };
        let _ = poll(&mut fds, Some(&time));
    }
}

impl Outside for Live<'_> {
    fn nodes(&self) -> usize {
        self.terminals.len()
    }

    fn wait(&mut self, now: u64, next: u64) -> Turn {
        let wall = |ns: u64, pace: f64| Duration::from_secs_f64(ns as f64 * 1e-9 / pace);
        let mut start = *self.start.get_or_insert_with(|| Instant::now() - wall(now, self.pace));
        loop {
            if self.ended.load(Ordering::Relaxed) {
                return Turn::End;
            }
            for (number, terminal) in self.terminals.iter_mut().enumerate() {
                let mut frames = VecDeque::new();
                terminal.read(&mut frames);
                terminal.write();
                self.coming.extend(frames.into_iter().map(|frame| (number, frame)));
            }
            if let Some(change) = self.control.as_mut().and_then(Control::asked) {
                return Turn::Change(change);
            }
            let passed = start.elapsed();
            if let Some((node, frame)) = self.coming.pop_front() {
                let at_ns = (passed.as_secs_f64() * self.pace * 1e9) as u64;
                return Turn::Send { node, at_ns, frame };
            }
            let due = wall(next, self.pace);
            if let Some(early) = due.checked_sub(passed).filter(|early| !early.is_zero()) {
                self.sleep(early);
                continue;
            }
            let late = passed - due;
            if late > SLIP {
                start += late;
                self.start = Some(start);
                self.behind += late;
            }
            return Turn::GoOn;
        }
    }

    fn changed(&mut self, now: u64, outcome: Result<(), Refusal>) {
        if let Some(control) = &mut self.control {
            control.changed(now, outcome);
        }
    }

    fn hear(&mut self, node: usize, frame: &Frame) {
        if let Some(terminal) = self.terminals.get_mut(node) {
            terminal.hear(frame);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sil::tests::Toy;
    use crate::sil::{self, SilConfig};
    use crate::slcan;
    use composer_firmware::controller::BusKind;
    use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
    use composer_shared::wire::{EmergencyStop, Message, STATION, StopCommand, StopCount};
    use std::fs::File;
    use std::io::{Read, Write};

    /// A robot of three modules on a bus with these terminals, until `client` has returned.
    fn while_running<T: Send>(
        links: &[&Path],
        fd: bool,
        pace: f64,
        client: impl FnOnce() -> T + Send,
    ) -> (T, Duration) {
        let mut image = [0; IMAGE_SIZE];
        random_image(7, &mut image);
        let ended = AtomicBool::new(false);
        let terminals = links.iter().map(|link| Terminal::open(link, fd).unwrap()).collect();
        std::thread::scope(|scope| {
            let robot = scope.spawn(|| {
                let mut live = Live::new(terminals, pace, &ended);
                let policy = Policy::parse(&image).unwrap();
                let config =
                    SilConfig { limit_ns: u64::MAX, ..SilConfig::new(if fd { BusKind::Fd } else { BusKind::Classic }) };
                let launcher = crate::computer::InProcess::new(policy);
                let mut toy = Toy::new(3, 1_000_000);
                let report =
                    sil::run_with(&launcher, &mut toy, policy, &config, Some(&mut live), None, &mut |_, _| {}).unwrap();
                assert!(live.terminals().iter().all(|terminal| terminal.lost() == 0));
                Duration::from_nanos(report.duration_ns)
            });
            let client = scope.spawn(client);
            let result = client.join();
            ended.store(true, Ordering::Relaxed);
            let passed = robot.join().unwrap();
            (result.unwrap_or_else(|panic| std::panic::resume_unwind(panic)), passed)
        })
    }

    fn serial(path: &Path) -> File {
        let patience = Instant::now();
        loop {
            match File::options().read(true).write(true).open(path) {
                Ok(file) => return file,
                Err(error) if patience.elapsed() > Duration::from_secs(10) => panic!("{error}"),
                Err(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Frames from a serial line until `enough`.
    fn frames(mut file: &File, mut enough: impl FnMut(&Frame) -> bool) -> Vec<Frame> {
        let (mut lines, mut seen, mut byte) = (Lines::default(), Vec::new(), [0]);
        loop {
            file.read_exact(&mut byte).unwrap();
            if let Some(Received::Line(line)) = lines.push(byte[0]).map(Result::unwrap)
                && let Ok(frame) = slcan::frame(&line)
            {
                seen.push(frame);
                if enough(&frame) {
                    return seen;
                }
            }
        }
    }

    #[test]
    fn frames_go_in_and_out_and_none_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("one"), folder.path().join("two"));
        while_running(&[&first, &second], true, 1.0, || {
            let (mut one, mut two) = (serial(&first), serial(&second));
            two.write_all(b"O\r").unwrap();
            one.write_all(b"\r\r\rC\rS8\rO\r").unwrap();
            let heard = frames(&two, |frame| frame.id == 0x180);
            assert!(heard.iter().all(|frame| frame.fd && Message::parse(frame).is_ok()), "{heard:?}");
            let stop = Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::UNKNOWN))
                .emit(STATION, true);
            let mut line = Vec::new();
            write_frame(&mut line, &stop);
            one.write_all(&line).unwrap();
            let heard = frames(&two, |frame| *frame == stop);
            assert_eq!(heard.iter().filter(|frame| **frame == stop).count(), 1);
            // All three modules say that they are stopped, and who asked for it does not hear himself.
            let mut stopped = [false; 3];
            let heard = frames(&one, |frame| {
                if let Ok(Message::State(state)) = Message::parse(frame) {
                    stopped[usize::from(frame.module())] |= state.health.0 & 4 != 0;
                }
                stopped == [true; 3]
            });
            assert!(!heard.contains(&stop), "{heard:?}");
        });
        assert!(!first.exists() && std::fs::symlink_metadata(&first).is_err(), "the link is gone with the terminal");
    }

    #[test]
    fn it_keeps_pace() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("can");
        let start = Instant::now();
        let ((), passed) = while_running(&[&path], false, 4.0, || {
            let mut file = serial(&path);
            file.write_all(b"L\r").unwrap();
            let mut beats = 0;
            frames(&file, |frame| {
                beats += u32::from(frame.id == 0x080);
                beats == 40
            });
        });
        // Forty cycles of 50 ms at four times real time: half a second. Slower machines may fall behind.
        assert!(start.elapsed() > Duration::from_millis(480), "{:?}", start.elapsed());
        assert!(passed > Duration::from_millis(1950), "{passed:?}");
        assert!(passed <= start.elapsed() * 4 + Duration::from_millis(10), "{passed:?}");
    }

    #[test]
    fn whoever_goes_leaves_nothing_behind_and_the_next_one_starts_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("can");
        while_running(&[&path], true, 2.0, || {
            let mut file = serial(&path);
            file.write_all(b"O\r").unwrap();
            frames(&file, |frame| frame.id == 0x080);
            // The last words count, although their speaker is gone at once.
            file.write_all(b"b07F3010000\r").unwrap();
            drop(file);
            std::thread::sleep(Duration::from_millis(200));
            let mut file = serial(&path);
            file.write_all(b"t0001\r").unwrap();
            let mut first = [0];
            file.read_exact(&mut first).unwrap();
            assert_eq!(first, [REFUSED], "the channel is closed, and nothing of before comes out");
            file.write_all(b"O\r").unwrap();
            frames(
                &file,
                |frame| matches!(Message::parse(frame), Ok(Message::State(state)) if state.health.0 & 4 != 0),
            );
        });
    }

    #[test]
    fn a_path_that_is_taken_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("can");
        std::fs::write(&path, "important").unwrap();
        let error = Terminal::open(&path, true).unwrap_err().to_string();
        assert!(error.contains("exists already") && error.contains("can"), "{error}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "important");
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("/dev/pts/no-more", &path).unwrap();
        let terminal = Terminal::open(&path, true).unwrap();
        assert!(Terminal::open(&path, true).unwrap_err().to_string().contains("exists already"), "it is in use");
        drop(terminal);
        let missing = folder.path().join("no/such/can");
        assert!(Terminal::open(&missing, true).unwrap_err().to_string().contains("no/such/can"));
    }
}
