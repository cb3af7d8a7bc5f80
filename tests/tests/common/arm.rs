//! Builds images of a module's firmware and runs them on the emulated board.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The target of all images.
const TARGET: &str = "thumbv7em-none-eabihf";

/// The linked image of a program of the firmware, built if it is not up to date.
pub fn image(program: &str, features: &str) -> PathBuf {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../firmware/Cargo.toml")
        .canonicalize()
        .expect("the firmware is beside the tests");
    // Images of another room get a folder of their own: `cargo qemu-image` would otherwise find them in its place.
    let folder = if features.contains("room-16") { "../target/room-16" } else { "../target" };
    let output = Command::new(env!("CARGO"))
        .args(["build", "--profile", "firmware", "--quiet", "--message-format=json", "--target", TARGET])
        .args(["--bin", program, "--features", features, "--manifest-path"])
        .arg(manifest)
        .arg("--target-dir")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder))
        .output()
        .expect("cargo can be started");
    assert!(output.status.success(), "{program} does not build:\n{}", String::from_utf8_lossy(&output.stderr));
    let messages = String::from_utf8(output.stdout).expect("UTF-8");
    let artifacts = messages.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let mut executables = artifacts.filter_map(|artifact| Some(PathBuf::from(artifact["executable"].as_str()?)));
    executables.next().unwrap_or_else(|| panic!("cargo built no {program}"))
}

/// Whether the image ended with success, and what it printed. It is killed after a minute.
pub fn emulate(image: &Path, more: &[&str]) -> (bool, String) {
    let mut child = Command::new("qemu-system-arm")
        .args(["-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none"])
        .args(["-semihosting-config", "enable=on,target=native", "-icount", "shift=0"])
        .args(more)
        .arg("-kernel")
        .arg(image)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("qemu-system-arm can be started (Debian and Ubuntu: apt-get install qemu-system-arm)");
    let start = Instant::now();
    while child.try_wait().expect("the emulator can be waited for").is_none() {
        if start.elapsed() > Duration::from_secs(60) {
            let _ = child.kill();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let output = child.wait_with_output().expect("the emulator can be waited for");
    // Semihosting prints to standard error.
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}
