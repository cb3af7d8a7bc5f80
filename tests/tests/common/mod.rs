//! Runs `snakectl` as a user does.

#![allow(dead_code)] // Each test file uses a part.

use std::path::Path;
use std::process::{Command, Output};

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
