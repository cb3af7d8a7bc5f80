//! Nothing that comes in from outside makes a reader panic: frames, policy images, captures and their transcripts, lines of a serial adapter, faults, commands.

#[path = "../../shared/fuzz/checks.rs"]
mod checks;
#[path = "fuzzing/mod.rs"]
mod fuzzing;

use std::path::Path;

use composer_shared::policies;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image, seal};
use composer_sim_bridge::candump::{Log, parse_frame, write_entry};
use composer_sim_bridge::computer::InProcess;
use composer_sim_bridge::faults::FaultPlan;
use composer_sim_bridge::slcan::{self, Adapter, Lines, Received};
use composer_sim_bridge::{control, replay};
use fuzzing::{Target, corpus, fuzz};

/// Half of the images with the right checksum, or most would go no further.
fn image(input: &[u8]) {
    match <&[u8; IMAGE_SIZE]>::try_from(input) {
        Ok(image) if image[100] & 1 == 0 => {
            let mut sealed = *image;
            seal(&mut sealed);
            checks::image(&sealed);
        }
        _ => checks::image(input),
    }
}

/// What is read of a capture is written again as it was.
fn capture(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    if let Ok(log) = Log::parse(&text) {
        for (_, entry) in &log.entries {
            let mut line = Vec::new();
            write_entry(&mut line, entry.at_us.saturating_mul(1000), &entry.interface, &entry.frame).unwrap();
            let again = Log::parse(std::str::from_utf8(&line).unwrap()).unwrap();
            assert_eq!(again.entries[0].1.frame, entry.frame);
        }
    }
    let _ = parse_frame(&text);
}

fn serial(input: &[u8]) {
    let (mut lines, mut adapter) = (Lines::default(), Adapter::new(input.len().is_multiple_of(2)));
    for byte in input {
        if let Some(Ok(Received::Line(line))) = lines.push(*byte) {
            let _ = adapter.obey(&line);
            if let Ok(frame) = slcan::frame(&line) {
                let mut written = Vec::new();
                slcan::write_frame(&mut written, &frame);
                assert_eq!(slcan::frame(written.strip_suffix(b"\r").unwrap()), Ok(frame));
            }
        }
    }
}

fn faults(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    if let Ok(plan) = text.parse::<FaultPlan>() {
        assert_eq!(plan.to_string().parse(), Ok(plan.clone()), "{text}");
        if plan.check(8).is_ok() {
            plan.draw(1, 8);
        }
    }
}

fn command(input: &[u8]) {
    let _ = control::parse(&String::from_utf8_lossy(input));
}

/// A transcript is refused, or a module does something on it.
fn transcript(input: &[u8]) {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    let launcher = InProcess::new(Policy::parse(&image).unwrap());
    let mut lines = input;
    if replay::heading(&mut lines).is_ok() {
        let _ = replay::replay(&launcher, &Log::default(), &mut lines, 2);
    }
}

#[test]
fn readers_take_anything() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus");
    let target = |name, share, run, words| Target { name, share, run, corpus: corpus(&folder.join(name)), words };
    let policies = ["goal-reaching", "wall-climbing"].map(|name| policies::shipped(name).unwrap().to_vec());
    let numbers: &[&str] = &["0", "-1", "1e999", "NaN", "99999999999999999999", "0x", "#", "@", "..", ","];
    let json: &[&str] = &["null", "{}", "[]", "\"", "1e400", "\"line\":1", "\"told\":\"123#\"", "\"room\":99999"];
    let targets = [
        target("frames", 820_000, checks::frame as fn(&[u8]), &[][..]),
        target("slcan", 100_000, serial, &["\r", "t1230", "d7FFF", "O\r", "S8\r"]),
        target("candump", 55_000, capture, &["(0.000001)", " can0 ", "##1", "#R", "\n", "800", "123#"]),
        target("faults", 14_000, faults, numbers),
        target("control", 9_500, command, numbers),
        Target { name: "images", share: 1_000, run: image, corpus: policies.to_vec(), words: &[] },
        target("transcript", 500, transcript, json),
    ];
    let all = fuzz(&targets, 400_000);
    assert!(all >= 300_000, "{all}");
}
