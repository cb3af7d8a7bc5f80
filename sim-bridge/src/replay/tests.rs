//! What was written down of whole robots, run again one module at a time.

use super::*;
use crate::capture::{Capture, Format};
use crate::computer::InProcess;
use crate::faults::FaultPlan;
use crate::sil::tests::{Toy, image};
use crate::sil::{SilConfig, run_watched};
use composer_firmware::controller::BusKind;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_shared::wire::StopCommand;

/// Log and transcript of runs with these faults.
fn record(bus: BusKind, plans: &[&str]) -> (String, String) {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let launcher = InProcess::new(policy);
    let (mut log, mut transcript) = (Vec::new(), Vec::new());
    let heading = Heading::new("random", &policy, 5);
    let capture = Capture::new(&mut log, Format::Candump).unwrap().with_transcript(&mut transcript, &heading);
    for (number, plan) in plans.iter().enumerate() {
        let plan: FaultPlan = plan.parse().unwrap();
        let mut config = SilConfig { faults: plan.draw(number as u64, 5), seed: number as u64, ..SilConfig::new(bus) };
        // The first is stopped and released on the way, and its stop input opens.
        if number == 0 {
            config.commands = vec![(600_000_000, StopCommand::Stop), (900_000_000, StopCommand::Release)];
            config.presses = vec![(1_500_000_000, 2)];
        }
        capture.begin_run();
        let recording = capture.recording(&launcher);
        run_watched(&recording, &mut Toy::new(5, 40), policy, &config, None, &mut &capture).unwrap();
    }
    capture.finish().unwrap();
    (String::from_utf8(log).unwrap(), String::from_utf8(transcript).unwrap())
}

fn again(image: &[u8; IMAGE_SIZE], log: &str, transcript: &str, node: u8) -> Result<Verdict, ReplayError> {
    let launcher = InProcess::new(Policy::parse(image).unwrap());
    let mut lines = transcript.as_bytes();
    assert_eq!(heading(&mut lines)?.modules, 5);
    replay(&launcher, &Log::parse(log).unwrap(), &mut lines, node)
}

#[test]
fn a_module_does_the_same_again_whatever_happened_to_it() {
    let plans = [
        "none",
        "unplug:#2@0.3s..0.8s,drop:0.1",
        "brownout:#2@0.5s..0.6s,delay:4ms",
        "observation:#2,corrupt:0.05,duplicate:0.1",
        "cut:1@0.4s..1.1s,stuck:#2@1s,corrupt:0.2#2",
    ];
    for bus in [BusKind::Fd, BusKind::Classic] {
        let (log, transcript) = record(bus, &plans);
        for node in 0..5 {
            let verdict = again(&image(), &log, &transcript, node).unwrap();
            assert_eq!((&verdict.first, &verdict.ended), (&None, &None), "node {node}");
            // Plugged in again twice.
            assert!(verdict.interrupts >= 2, "{verdict:?}");
            assert_eq!((verdict.runs, verdict.starts), (5, if node == 2 { 7 } else { 5 }));
            assert!(verdict.frames >= 5 * 30 * 2 && verdict.torques == 2 * verdict.polls, "{verdict:?}");
        }
    }
}

#[test]
fn the_first_difference_is_found_and_placed() {
    let (log, transcript) = record(BusKind::Fd, &["none", "none"]);
    let mut other = [0; IMAGE_SIZE];
    random_image(2, &mut other);
    let verdict = again(&other, &log, &transcript, 1).unwrap();
    assert!(verdict.torques_different > 20 && verdict.frames_different > 20 && verdict.foreign > 20, "{verdict:?}");
    // One bit of one torque, in the second run.
    let second = transcript.find("\"run\":1").unwrap();
    let computer = transcript[second..].find("\"node\":3").map(|at| second + at).unwrap();
    let id = transcript[..computer].rsplit("\"computer\":").next().unwrap().trim_end_matches(',');
    let polled = format!("{{\"computer\":{id},\"now\"");
    let torques: Vec<usize> = transcript
        .match_indices("\"torque\":\"")
        .map(|(at, found)| at + found.len())
        .filter(|at| *at > computer && transcript[..*at].rsplit('\n').next().unwrap().starts_with(&polled))
        .collect();
    let at = torques[10] + 7;
    let digit = if &transcript[at..=at] == "0" { "1" } else { "0" };
    let changed = format!("{}{digit}{}", &transcript[..at], &transcript[at + 1..]);
    let verdict = again(&image(), &log, &changed, 3).unwrap();
    let first = verdict.first.clone().unwrap();
    assert_eq!((first.place.run, verdict.frames_different, verdict.foreign), (1, 0, 0));
    assert_eq!(first.place.transcript_line, 1 + transcript[..at].matches('\n').count() as u64);
    assert!(first.what.starts_with("its torque in yaw is "), "{first:?}");
    let words = first.place.to_string();
    assert!(words.starts_with("in run 1 when its clock showed ") && words.contains(" of the log"), "{words}");
    // A frame that nobody sent.
    let at = log.match_indices(" can0 183#").nth(20).unwrap().0;
    let line = 1 + log[..at].matches('\n').count() as u64;
    let end = at + log[at..].find('\n').unwrap();
    let forged = format!("{}{}{}", &log[..end - 2], if log[..end].ends_with("00") { "01" } else { "00" }, &log[end..]);
    let verdict = again(&image(), &forged, &transcript, 3).unwrap();
    assert_eq!((verdict.foreign, verdict.first.unwrap().place.log_line), (1, Some(line)));
}

#[test]
fn what_was_cut_off_is_compared_up_to_there() {
    let (log, transcript) = record(BusKind::Fd, &["none"]);
    let whole = again(&image(), &log, &transcript, 2).unwrap();
    let half = again(&image(), &log[..log.len() / 2], &transcript, 2).unwrap();
    assert!(half.same() && half.polls > whole.polls / 3 && half.polls < whole.polls * 2 / 3, "{half:?}");
    assert!(half.ended.unwrap().starts_with("the log ends before its line "));
    let half = again(&image(), &log, &transcript[..transcript.len() / 2], 2).unwrap();
    assert!(half.same() && half.polls > whole.polls / 3 && half.polls < whole.polls * 2 / 3, "{half:?}");
    assert!(half.ended.unwrap().starts_with("the transcript ends in the middle of line "));
}

#[test]
fn what_is_no_transcript_is_refused() {
    let (log, transcript) = record(BusKind::Fd, &["none"]);
    let refused = |transcript: &str, node| again(&image(), &log, transcript, node).unwrap_err().to_string();
    assert_eq!(refused(&transcript, 7), "the transcript has no node 7; it has 0, 1, 2, 3, 4");
    assert!(refused(&log, 1).starts_with("this is no transcript of version 1"));
    assert!(refused(&transcript.replacen("\"transcript\":1", "\"transcript\":2", 1), 1).contains("version 1"));
    let with = |line: &str| format!("{}\n{line}\n", transcript.lines().take(3).collect::<Vec<_>>().join("\n"));
    for line in ["{\"run\":1}", "nonsense", "{\"computer\":0,\"node\":0,\"start\":\"zz\"}", "[]"] {
        let sentence = refused(&with(line), 0);
        assert!(sentence.starts_with("line 4 of the transcript makes no sense: "), "{line}: {sentence}");
    }
}
