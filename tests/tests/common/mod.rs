//! Runs `snakectl` as a user does.

#![allow(dead_code)] // Each test file uses a part.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// The program, in an empty folder of its own.
pub fn snakectl(folder: &Path, arguments: &[&str]) -> Output {
    command(folder, arguments).output().expect("the program can be started")
}

/// The same, not yet started.
pub fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_snakectl-under-test"));
    command.current_dir(folder).args(arguments);
    command
}

/// Standard output of a run that must succeed.
pub fn succeed(folder: &Path, arguments: &[&str]) -> String {
    let output = snakectl(folder, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// The JSON object of a run that must succeed; nothing else may be printed.
pub fn json(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let text = succeed(folder, arguments);
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{arguments:?} printed {text:?}: {e}"))
}

/// The complaint of a run that must fail: one line that contains every word, on standard error, and nothing on standard output.
pub fn refuse(folder: &Path, arguments: &[&str], words: &[&str]) -> String {
    let output = snakectl(folder, arguments);
    let complaint = String::from_utf8_lossy(&output.stderr).trim().to_string();
    assert!(!output.status.success(), "{arguments:?} was accepted");
    assert!(output.stdout.is_empty(), "{arguments:?} printed {}", String::from_utf8_lossy(&output.stdout));
    assert!(!complaint.contains("panicked"), "{complaint}");
    for word in words {
        assert!(complaint.contains(word), "{arguments:?}: {complaint:?} does not say {word:?}");
    }
    complaint
}

/// An ARM program of 16 bytes that is loaded to `address`.
pub fn arm_image(address: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.extend(b"\x7fELF\x01\x01\x01\0\0\0\0\0\0\0\0\0");
    let half = |value: u16| value.to_le_bytes();
    let word = |value: u32| value.to_le_bytes();
    // An executable for ARM; entry, program headers at 52, no sections; 52 bytes of header, one program header of 32.
    bytes.extend([half(2), half(40)].concat());
    bytes.extend([word(1), word(address), word(52), word(0), word(0x0500_0000)].concat());
    bytes.extend([half(52), half(32), half(1), half(40), half(0), half(0)].concat());
    // To be loaded: offset, virtual and physical address, size in file and memory, readable and executable, alignment.
    bytes.extend([word(1), word(84), word(address), word(address), word(16), word(16), word(5), word(4)].concat());
    bytes.extend([0; 16]);
    bytes
}

/// A simulated robot on a bus in real time, at `bus` and `bus2` in a folder of its own. It ends with this.
pub struct Live {
    folder: tempfile::TempDir,
    process: Child,
    /// What it says on standard error, line by line.
    said: std::sync::mpsc::Receiver<String>,
    control: std::cell::OnceCell<String>,
}

impl Live {
    /// `snakectl sil goal-reaching --live ...` with anything else that `more` asks for.
    pub fn start(more: &[&str]) -> Self {
        Live::start_with("goal-reaching", more)
    }

    /// The same with another policy.
    pub fn start_with(policy: &str, more: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let start = ["sil", policy, "--live", "slcan:bus", "--live", "slcan:bus2", "--seed", "5"];
        let mut process = command(folder.path(), &[&start, more].concat())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (tell, said) = std::sync::mpsc::channel();
        let complaints = BufReader::new(process.stderr.take().unwrap());
        std::thread::spawn(move || complaints.lines().map_while(Result::ok).try_for_each(|line| tell.send(line)));
        let patience = Instant::now();
        while !folder.path().join("bus2").exists() {
            if let Some(status) = process.try_wait().unwrap() {
                panic!("it ended: {status}, {}", said.iter().collect::<Vec<_>>().join("\n"));
            }
            assert!(patience.elapsed() < Duration::from_secs(60));
            std::thread::sleep(Duration::from_millis(5));
        }
        Live { folder, process, said, control: std::cell::OnceCell::new() }
    }

    /// Where it takes commands.
    pub fn control(&self) -> String {
        let wait = || loop {
            let line = self.said.recv_timeout(Duration::from_secs(60)).expect("it says where it takes commands");
            if let Some(address) = line.strip_prefix("commands are taken at ") {
                return address.to_string();
            }
        };
        self.control.get_or_init(wait).clone()
    }

    /// Its folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// `snakectl bus slcan:bus ...`, not yet started.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = command(self.path(), &[&["bus", "slcan:bus"], arguments].concat());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    /// The same, run, which must succeed.
    pub fn bus(&self, arguments: &[&str]) -> String {
        succeed(self.path(), &[&["bus", "slcan:bus"], arguments].concat())
    }

    /// The same, which must fail.
    pub fn refuse(&self, arguments: &[&str], words: &[&str]) -> String {
        refuse(self.path(), &[&["bus", "slcan:bus"], arguments].concat(), words)
    }

    /// Ctrl-C; what it has to say.
    pub fn interrupt(mut self) -> String {
        signal(&self.process, "INT");
        let status = self.process.wait().unwrap();
        let text = std::io::read_to_string(self.process.stdout.take().unwrap()).unwrap();
        assert!(status.success(), "{status}");
        assert!(std::fs::symlink_metadata(self.path().join("bus")).is_err(), "the link is left");
        text
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Sends a signal.
pub fn signal(process: &Child, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &process.id().to_string()]).status().unwrap();
    assert!(status.success());
}
