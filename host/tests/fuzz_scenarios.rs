//! Nothing that a scenario file or a schedule of a campaign may say makes its reader panic. How: `sim-bridge/tests/fuzzing`.

#[path = "../../sim-bridge/tests/fuzzing/mod.rs"]
mod fuzzing;

use std::path::Path;

use composer_host::campaign::Schedule;
use composer_host::scenario::Scenario;
use fuzzing::{Target, corpus, fuzz};

fn scenario(input: &[u8]) {
    if let Err(error) = Scenario::parse(&String::from_utf8_lossy(input)) {
        assert!(!format!("{error:#}").contains('\n'), "{error:#}");
    }
}

fn schedule(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    if let Ok(schedule) = text.parse::<Schedule>() {
        let again: Schedule = schedule.to_string().parse().unwrap();
        assert_eq!(again.to_string(), schedule.to_string());
        let _ = schedule.check(8);
    }
}

#[test]
fn scenarios_and_schedules_may_say_anything() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let scenarios = corpus(&root.join("tests/scenarios"));
    let schedules = ["stop@1s,release@1.5s,clock:#3/150ppm,classic", "unplug:#3@100ms..1s,drop:0.05@0s..2s", "none"];
    let words: &[&str] =
        &["\n[expect]\n", "\"1s\"", "= 1e308\n", "-1", "[[inject]]\n", "times = 18446744073709551615\n", "{", "="];
    let targets = [
        Target { name: "scenarios", share: 800_000, run: scenario, corpus: scenarios, words },
        Target {
            name: "schedules",
            share: 200_000,
            run: schedule,
            corpus: schedules.map(|text| text.as_bytes().to_vec()).to_vec(),
            words: &["@", "ms", "-1ppm", "#64", "..", ",", "99999999999999999999"],
        },
    ];
    fuzz(&targets, 20_000);
}
