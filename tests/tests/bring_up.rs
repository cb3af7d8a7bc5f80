//! `firmware/bring-up.md`: every command of the page runs against a simulated robot and prints what the page says; every fault is in its table.
#![cfg(unix)]

mod common;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use common::{Live, arm_image, command};
use composer_firmware::memory_map::FLASH_ADDRESS;
use composer_shared::wire::Fault;

/// A block of the page: what is written behind its fence, and its lines.
type Block = (String, Vec<String>);

fn page() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../firmware/bring-up.md");
    std::fs::read_to_string(path).unwrap()
}

fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    for line in page.lines() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(kind), None) => open = Some((kind.to_string(), Vec::new())),
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (None, Some((_, lines))) => lines.push(line.to_string()),
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "a block does not end");
    blocks
}

/// Whether a line is what a pattern says, in which `...` stands for anything and several spaces for one.
fn fits(pattern: &str, line: &str) -> bool {
    let one = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let (pattern, line) = (one(pattern), one(line));
    let mut parts = pattern.split("...");
    let Some(mut rest) = parts.next().and_then(|first| line.strip_prefix(first)) else { return false };
    let mut parts = parts.peekable();
    if parts.peek().is_none() {
        return rest.is_empty();
    }
    while let Some(part) = parts.next() {
        let part = part.trim();
        let last = parts.peek().is_none();
        match rest.find(part) {
            Some(_) if last && !part.is_empty() && !rest.ends_with(part) => return false,
            Some(at) => rest = &rest[at + part.len()..],
            None => return false,
        }
    }
    true
}

#[test]
fn patterns_fit_what_they_should() {
    for (pattern, line, good) in [
        ("a b", "a   b", true),
        ("a b", "a b c", false),
        ("a ...", "a b c", true),
        ("... c", "a b c", true),
        ("a ... c", "a b b c", true),
        ("a ... c", "a b c d", false),
        ("a ... c ...", "a b c d", true),
        ("...x...", "a b c", false),
    ] {
        assert_eq!(fits(pattern, line), good, "{pattern} {line}");
    }
}

#[test]
fn every_command_of_the_page_runs_against_the_simulated_robot() {
    let blocks = blocks(&page());
    let live: Vec<&Block> = blocks.iter().filter(|(kind, _)| kind == "live").collect();
    assert_eq!(live.len(), 1);
    // The page offers one terminal; the test's robot has it, and a second.
    let start = "snakectl sil goal-reaching --live slcan:bus ";
    let more = live[0].1[0].strip_prefix(start).unwrap_or_else(|| panic!("{:?}", live[0]));
    let live = Live::start(&more.split_whitespace().collect::<Vec<_>>());
    let folder = live.path();
    // Stand-ins for the debug probe and for the image that the firmware's own build makes.
    let tools = folder.join("tools");
    std::fs::create_dir(&tools).unwrap();
    std::fs::write(tools.join("probe-rs"), "#!/bin/sh\necho '[0]: STLINK-V3'\n").unwrap();
    std::fs::set_permissions(tools.join("probe-rs"), PermissionsExt::from_mode(0o755)).unwrap();
    let image = folder.join(composer_host::flash::IMAGE);
    std::fs::create_dir_all(image.parent().unwrap()).unwrap();
    std::fs::write(image, arm_image(FLASH_ADDRESS)).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap_or_default());

    let mut printed = String::new();
    let (mut commands, mut promises) = (0, 0);
    for (kind, lines) in &blocks {
        match kind.as_str() {
            "live" => {}
            "sh" => {
                printed.clear();
                for line in lines {
                    let line = line.replace("$BUS", "slcan:bus");
                    let words =
                        line.strip_prefix("snakectl ").unwrap_or_else(|| panic!("`{line}` is no command of snakectl"));
                    let words: Vec<&str> = words.split_whitespace().collect();
                    let output = command(folder, &words).env("PATH", &path).output().unwrap();
                    let complaint = String::from_utf8_lossy(&output.stderr);
                    assert!(output.status.success(), "`{line}`: {complaint}");
                    printed += &String::from_utf8(output.stdout).unwrap();
                    commands += 1;
                }
            }
            "out" => {
                let mut rest = printed.lines();
                for pattern in lines {
                    assert!(
                        pattern.trim() == "..." || rest.any(|line| fits(pattern, line)),
                        "the page promises {pattern:?}, but this is printed:\n{printed}"
                    );
                    promises += 1;
                }
            }
            other => panic!("a block of the page is {other:?}: only live, sh and out are run"),
        }
    }
    assert!(commands >= 20 && promises >= 40, "{commands} commands, {promises} lines promised");
}

#[test]
fn every_fault_and_nothing_else_is_in_its_table() {
    let page = page();
    let table = page.split("## By fault number").nth(1).unwrap();
    let rows = table.lines().filter_map(|line| {
        let name = line.strip_prefix("| ")?.split('|').next()?.trim().to_string();
        name.starts_with(char::is_numeric).then_some(name)
    });
    let faults: Vec<String> = Fault::ALL.iter().map(|fault| format!("{} {fault:?}", *fault as u8)).collect();
    assert_eq!(rows.collect::<Vec<_>>(), faults);
}
