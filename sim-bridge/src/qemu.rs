//! One emulated microcontroller a module: QEMU processes that run the firmware's image.
//!
//! Each module is a `qemu-system-arm -M mps2-an386` of its own with the image of board `qemu` and the policy image in its flash. Its UART 0 is the
//! [link](composer_firmware::link), a pair of connected sockets as the process's standard input and output.
//!
//! # Speed
//!
//! The emulated UART has no FIFO, so every byte to the module costs a wake-up of QEMU's main loop and one of the emulated core. QEMU's
//! multiplexing character device (`mux=on`) puts a buffer of 32 bytes before it that the core empties at once, which makes messages several
//! times as fast; the escape character with which it would switch to a monitor is set to one that is none (`-echr 256`). `cargo run --release -p
//! composer-sim-bridge --example link_cost` prints what a message costs with and without.
//!
//! # Ends
//!
//! - A process that somebody else ends (a signal, or QEMU told to quit) is a module that was unplugged: [`Trouble::Gone`].
//! - One that ends by itself, or with last words, is a failure of the image: [`Trouble::Failed`] with all that is known.
//! - One that does not answer in time is a failure too. Nothing waits for ever.
//! - All processes end with their [`Emulated`]; if this program is killed, the kernel kills them (Linux), and elsewhere the image gives up
//!   after two minutes of silence.

use std::io::{self, Read, Seek, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use composer_firmware::controller::{Boot, BusKind, Config, Micros};
use composer_firmware::link::POLICY_ADDRESS;
use composer_shared::policy::Policy;

use crate::computer::{Launcher, Trouble};
use crate::remote::{Hello, Line, LinkTrouble, Remote};

/// The program that emulates a module.
pub const PROGRAM: &str = "qemu-system-arm";

/// How long a module may take to answer, unless told otherwise. It takes far less than a millisecond on an idle machine.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Why no module can be emulated.
#[derive(Debug, thiserror::Error)]
pub enum QemuError {
    /// The program is not installed.
    #[error(
        "{PROGRAM} is not installed: get it by `apt-get install qemu-system-arm` (Debian, Ubuntu) or `brew install qemu` (macOS)"
    )]
    Missing,
    /// It cannot be started for another reason.
    #[error("{PROGRAM} cannot be started: {0}")]
    Start(io::Error),
    /// There is no image.
    #[error("there is no image of the module at {}: build it with `cargo qemu-image`", .0.display())]
    NoImage(PathBuf),
    /// The policy image cannot be put where QEMU finds it.
    #[error("the policy image cannot be written for {PROGRAM}: {0}")]
    Policy(io::Error),
}

impl From<QemuError> for Trouble {
    fn from(error: QemuError) -> Self {
        Trouble::Failed(Box::new(error))
    }
}

/// Emulated modules with one image and one policy.
#[derive(Debug)]
pub struct Qemu {
    image: PathBuf,
    policy: PolicyFile,
    patience: Duration,
    buffered: bool,
}

impl Qemu {
    /// Modules that run the ELF file `image` with the policy image `policy`, and take at most `patience` to answer.
    pub fn new(image: &Path, policy: &[u8], patience: Duration) -> Result<Self, QemuError> {
        if !image.is_file() {
            return Err(QemuError::NoImage(image.into()));
        }
        let policy = PolicyFile::new(policy).map_err(QemuError::Policy)?;
        // Zero would mean for ever.
        let patience = patience.max(Duration::from_millis(1));
        Ok(Qemu { image: image.into(), policy, patience, buffered: true })
    }

    /// The same without the buffer before the UART, for comparison.
    pub fn unbuffered(self) -> Self {
        Qemu { buffered: false, ..self }
    }

    /// Boots one module to see what the image is, and ends it.
    pub fn probe(&self, policy: &Policy<'_>) -> Result<Hello, Trouble> {
        self.start(Config::new(0, 1, BusKind::Fd, policy), Boot::default(), 0)?.hello()
    }

    fn command(&self) -> Command {
        let mut command = Command::new(PROGRAM);
        command.args(["-M", "mps2-an386", "-nodefaults", "-display", "none", "-echr", "256"]);
        let buffered = if self.buffered { "on" } else { "off" };
        command
            .arg("-chardev")
            .arg(format!("stdio,id=link,signal=off,mux={buffered}"))
            .args(["-serial", "chardev:link"]);
        command.args(["-semihosting-config", "enable=on,target=native", "-kernel"]).arg(&self.image);
        // A comma in a file name is doubled in QEMU's lists.
        let policy = self.policy.path.to_string_lossy().replace(',', ",,");
        command.arg("-device").arg(format!("loader,file={policy},addr={POLICY_ADDRESS:#x},force-raw=on"));
        command
    }

    fn spawn(&self) -> Result<Process, QemuError> {
        let (near, far) = UnixStream::pair().map_err(QemuError::Start)?;
        near.set_read_timeout(Some(self.patience)).map_err(QemuError::Start)?;
        near.set_write_timeout(Some(self.patience)).map_err(QemuError::Start)?;
        let complaints = tempfile::tempfile().map_err(QemuError::Start)?;
        let mut command = self.command();
        command.stdin(Stdio::from(std::os::fd::OwnedFd::from(far.try_clone().map_err(QemuError::Start)?)));
        command.stdout(Stdio::from(std::os::fd::OwnedFd::from(far)));
        command.stderr(Stdio::from(complaints.try_clone().map_err(QemuError::Start)?));
        die_with_parent(&mut command);
        let child = command.spawn().map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => QemuError::Missing,
            _ => QemuError::Start(error),
        })?;
        Ok(Process { child, stream: near, complaints, patience: self.patience })
    }
}

/// The policy image where QEMU can read it. On Linux without a name in the file system, so that nothing is left if this program is killed.
#[derive(Debug)]
struct PolicyFile {
    path: PathBuf,
    /// Keeps the file.
    _file: std::fs::File,
    _name: Option<tempfile::TempPath>,
}

impl PolicyFile {
    fn new(image: &[u8]) -> io::Result<Self> {
        let mut file = tempfile::NamedTempFile::new()?;
        file.write_all(image)?;
        let (file, name) = file.into_parts();
        if cfg!(target_os = "linux") {
            let path = format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd()).into();
            return Ok(PolicyFile { path, _file: file, _name: None });
        }
        Ok(PolicyFile { path: name.to_path_buf(), _file: file, _name: Some(name) })
    }
}

/// A module in a process of its own.
pub type Emulated = Remote<Process>;

impl Launcher for Qemu {
    type Computer = Emulated;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Emulated, Trouble> {
        config.check().map_err(Trouble::Config)?;
        Ok(Remote::new(self.spawn()?, config, boot, now))
    }
}

/// Has the kernel kill the process when the thread that starts it ends, also by a signal that cannot be caught.
///
/// The thread that runs an episode starts its processes and waits for them, so they never outlive it rightfully.
#[cfg(target_os = "linux")]
#[allow(unsafe_code)]
pub(crate) fn die_with_parent(command: &mut Command) {
    use std::os::unix::process::CommandExt;

    use rustix::process::{Signal, getpid, getppid, set_parent_process_death_signal};
    let parent = getpid();
    // SAFETY: between fork and exec only async-signal-safe functions may be called: these two are plain system calls, and nothing is allocated.
    unsafe {
        command.pre_exec(move || {
            set_parent_process_death_signal(Some(Signal::KILL))?;
            // It may have died just before.
            if getppid() == Some(parent) { Ok(()) } else { Err(io::ErrorKind::BrokenPipe.into()) }
        });
    }
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn die_with_parent(_: &mut Command) {}

/// A running QEMU and the near end of its link. Dropping it kills it.
#[derive(Debug)]
pub struct Process {
    child: Child,
    stream: UnixStream,
    /// What it wrote to standard error.
    complaints: std::fs::File,
    patience: Duration,
}

impl Process {
    /// Waits for its end, a limited time.
    fn ended(&mut self) -> Option<ExitStatus> {
        let start = Instant::now();
        loop {
            match self.child.try_wait() {
                Ok(Some(status)) => return Some(status),
                _ if start.elapsed() > self.patience => return None,
                _ => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// What it complained about, as one line.
    fn complaints(&mut self) -> String {
        let mut text = Vec::new();
        let read = self.complaints.rewind().and_then(|()| (&self.complaints).take(2000).read_to_end(&mut text));
        let text = String::from_utf8_lossy(if read.is_ok() { &text } else { &[] }).into_owned();
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    fn failed(&mut self, error: &io::Error) -> Trouble {
        use io::ErrorKind::{TimedOut, WouldBlock};
        if matches!(error.kind(), TimedOut | WouldBlock) {
            return LinkTrouble::Stalled(self.patience).into();
        }
        self.closed()
    }

    /// The link is closed: who ended the process?
    fn closed(&mut self) -> Trouble {
        let Some(status) = self.ended() else {
            return LinkTrouble::Nonsense(format!("{PROGRAM} closed it but goes on")).into();
        };
        let complaints = self.complaints();
        // QEMU ends with 0 when it is asked to by a signal or a monitor; the image never asks it to.
        let asked = status.code() == Some(0);
        match status.signal() {
            Some(signal) if !is_failure(signal) => Trouble::Gone(format!("{PROGRAM} was ended by signal {signal}")),
            None if asked => Trouble::Gone(format!("{PROGRAM} was told to quit")),
            _ => {
                let words = if complaints.is_empty() { "without a word".into() } else { complaints };
                LinkTrouble::Crashed { words, after: format!(" ({PROGRAM}: {status})") }.into()
            }
        }
    }
}

/// Whether a process gets this signal for its own fault: SIGILL, SIGTRAP, SIGABRT, SIGBUS, SIGFPE, SIGSEGV, SIGSYS.
fn is_failure(signal: i32) -> bool {
    use rustix::process::Signal;
    let failures = [Signal::ILL, Signal::TRAP, Signal::ABORT, Signal::BUS, Signal::FPE, Signal::SEGV, Signal::SYS];
    failures.iter().any(|failure| failure.as_raw() == signal)
}

impl Line for Process {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.stream.write_all(bytes).map_err(|error| self.failed(&error))
    }

    fn receive(&mut self, buffer: &mut [u8]) -> Result<usize, Trouble> {
        loop {
            match self.stream.read(buffer) {
                Ok(0) => return Err(self.closed()),
                Ok(length) => return Ok(length),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(self.failed(&error)),
            }
        }
    }

    fn post_mortem(&mut self) -> String {
        match self.ended() {
            Some(status) => format!(" ({PROGRAM}: {status})"),
            None => format!(" ({PROGRAM} did not end)"),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
