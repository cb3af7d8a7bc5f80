//! Opens pages in a headless Chromium.

#![allow(dead_code)] // Each test file uses a part.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The text of the opened page after its script ran.
pub fn open(browser: &Path, page: &Path, hash: &str) -> String {
    let profile = tempfile::tempdir().expect("a folder for the browser's profile");
    let dump = profile.path().join("dom.html");
    let mut child = Command::new(browser)
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-unsafe-swiftshader",
            "--disable-quic",
            "--disable-sync",
            "--disable-background-networking",
            "--disable-component-update",
            "--no-first-run",
            "--window-size=1280,720",
            "--virtual-time-budget=2000",
            "--dump-dom",
        ])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg(format!("file://{}{hash}", page.display()))
        .stdout(fs::File::create(&dump).expect("a file for the page's text"))
        .stderr(Stdio::null())
        .spawn()
        .expect("the browser starts");
    let patience = Instant::now() + Duration::from_secs(180);
    let status = loop {
        if let Some(status) = child.try_wait().expect("the browser's exit status") {
            break status;
        }
        if Instant::now() > patience {
            child.kill().expect("the browser can be ended");
            child.wait().expect("the browser ends");
            panic!("the browser did not finish within three minutes");
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    assert!(status.success(), "the browser ended with {status}");
    fs::read_to_string(&dump).expect("the page's text")
}

/// The browser.
pub fn browser() -> PathBuf {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&path).flat_map(|d| names.map(|n| d.join(n))).find(|p| p.is_file());
    found.expect("no Chromium found: install it with `sudo apt-get install -y chromium`, the replay is tested in it")
}

/// An attribute of the page's root element.
pub fn attribute<'a>(dom: &'a str, name: &str) -> Option<&'a str> {
    let element = &dom[dom.find("<html")?..];
    let element = &element[..element.find('>')?];
    let value = &element[element.find(&format!("{name}=\""))? + name.len() + 2..];
    value.split('"').next()
}
