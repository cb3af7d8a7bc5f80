//! What the README promises, on fewer episodes.

mod common;

use common::{json, refuse, succeed};
use composer_shared::policies;
use composer_shared::policy::Task;

fn number(report: &serde_json::Value, key: &str) -> f64 {
    report[key].as_f64().unwrap_or_else(|| panic!("{key} is missing in {report}"))
}

#[test]
fn the_shipped_policy_reaches_its_goals_and_the_bus_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| json(folder.path(), &[arguments, &["--episodes", "60", "--json"]].concat());
    let eval = run(&["eval", "goal-reaching"]);
    assert_eq!(number(&eval, "episodes"), 60.0);
    assert_eq!(number(&eval, "modules"), 8.0);
    assert_eq!(eval["fault"], "none");
    for key in ["success_rate_se", "distance_mean", "steps_mean"] {
        number(&eval, key);
    }
    // 0.95 is promised over 200 episodes; 60 scatter by 0.03.
    assert!(number(&eval, "success_rate") >= 0.88, "{eval}");
    assert!(number(&eval, "low_share") >= 0.95, "{eval}");
    for bus in ["fd", "classic"] {
        let sil = run(&["sil", "goal-reaching", "--bus", bus]);
        for key in ["bus_load", "latent_age_max_ms", "deadline_misses", "realtime_factor"] {
            number(&sil, key);
        }
        let difference = number(&sil, "success_rate") - number(&eval, "success_rate");
        assert!(difference.abs() <= 0.067, "{bus}: {sil}");
        assert_eq!(number(&sil, "deadline_misses"), 0.0, "{bus}: {sil}");
    }
}

#[test]
fn every_policy_that_ships_does_its_task_and_on_the_bus_as_well() {
    let folder = tempfile::tempdir().unwrap();
    for name in policies::NAMES {
        let run = |verb| json(folder.path(), &[verb, name, "--episodes", "60", "--json"]);
        let [eval, sil] = ["eval", "sil"].map(|verb| number(&run(verb), "success_rate"));
        // 0.95 or 0.90 is promised over 200 episodes; 60 scatter by up to 0.04.
        let promised = if ["goal-reaching", "shape-formation"].contains(&name) { 0.95 } else { 0.90 };
        assert!(eval >= promised - 0.08 && (sil - eval).abs() <= 0.067, "{name}: {eval} and {sil} on the bus");
    }
}

#[test]
fn a_module_can_be_unplugged_on_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let run = |fault| json(folder.path(), &["sil", "goal-reaching", "--episodes", "60", "--fault", fault, "--json"]);
    let one = run("unplug:1");
    assert!(number(&one, "success_rate") >= 0.75, "{one}");
    let head = run("unplug:#0@1s");
    assert!(number(&head, "success_rate") >= 0.6, "{head}");
}

#[test]
fn the_same_seed_gives_the_same_result_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    for verb in [&["eval", "goal-reaching"][..], &["sil", "goal-reaching", "--drop", "0.05"]] {
        let run = |threads, seed| {
            let more = ["--fault", "unplug:2", "--episodes", "6", "--json", "--threads", threads, "--seed", seed];
            let mut report = json(folder.path(), &[verb, &more].concat());
            report.as_object_mut().unwrap().remove("realtime_factor");
            report
        };
        assert_eq!(run("1", "7"), run("3", "7"));
        assert_ne!(run("1", "7"), run("1", "8"));
    }
}

#[test]
fn baselines_do_not_reach_and_other_lengths_run() {
    let folder = tempfile::tempdir().unwrap();
    for task in Task::ALL {
        for baseline in ["still", "random"] {
            let report = json(folder.path(), &["eval", baseline, "--task", task.name(), "--episodes", "40", "--json"]);
            assert!(number(&report, "success_rate") <= 0.05, "{task}: {report}");
        }
    }
    for modules in ["1", "2", "11", "16"] {
        let report = json(folder.path(), &["sil", "goal-reaching", "--modules", modules, "--episodes", "2", "--json"]);
        assert_eq!(report["modules"].to_string(), modules);
    }
}

#[test]
fn the_demonstration_prints_a_table_and_writes_a_page_and_a_capture_is_a_candump_log() {
    let folder = tempfile::tempdir().unwrap();
    let table = succeed(folder.path(), &["--episodes", "2", "--replay", "page.html"]);
    assert!(table.contains("one unplugged on the way"), "{table}");
    let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
    assert!(page.contains("<html") && page.len() > 100_000);
    succeed(folder.path(), &["sil", "goal-reaching", "--episodes", "1", "--capture", "bus.log"]);
    let log = std::fs::read_to_string(folder.path().join("bus.log")).unwrap();
    let first = log.lines().next().unwrap();
    assert!(first.starts_with('(') && first.contains(" can0 080##1"), "the first frame is SYNC of module 0: {first}");
    assert!(log.lines().count() > 500);
    let dbc = succeed(folder.path(), &["dbc"]);
    assert!(dbc.contains("BO_ ") && dbc.contains("VFrameFormat"), "{dbc}");
}

#[test]
fn a_comparison_is_made_from_nothing_and_what_is_done_is_not_done_again() {
    let folder = tempfile::tempdir().unwrap();
    let report = |steps| {
        ["report", "attention", "--steps", steps, "--seeds", "1", "--episodes", "2", "--runs", "r", "--out", "o"]
    };
    refuse(folder.path(), &[&report("2048")[..], &["--so-far"]].concat(), &["none of the 4 runs in r is done"]);
    let table = succeed(folder.path(), &report("2048"));
    for method in ["| mappo |", "| composer-no-imagination |"] {
        assert_eq!(table.matches(method).count(), 2, "{table}");
    }
    let read = |name: &str| std::fs::read_to_string(folder.path().join("o").join(name)).unwrap();
    assert!(read("learning-curves.svg").contains("composer-no-imagination") && table.contains(&read("table.md")));
    let runs: serde_json::Value = serde_json::from_str(&read("runs.json")).unwrap();
    for run in runs.as_array().unwrap() {
        assert_eq!(run["curve"][1][0], 2048.0, "{run}");
        assert_eq!(run["final"]["none"]["episodes"], 2, "{run}");
    }
    // A run that was killed before its judgement ended is judged again and comes to the same.
    let run = folder.path().join("r/mappo-head-1");
    let (result, metrics) = (std::fs::read(run.join("result.json")).unwrap(), std::fs::read(run.join("metrics.jsonl")));
    std::fs::remove_file(run.join("result.json")).unwrap();
    let so_far = succeed(folder.path(), &[&report("2048")[..], &["--so-far"]].concat());
    assert!(so_far.contains("3 of 4 runs are done") && so_far.matches("| mappo |").count() == 1, "{so_far}");
    assert_eq!(succeed(folder.path(), &report("2048")), table);
    assert_eq!(std::fs::read(run.join("result.json")).unwrap(), result);
    assert_eq!(std::fs::read(run.join("metrics.jsonl")).unwrap(), metrics.unwrap());
    refuse(folder.path(), &report("4096"), &["holds a run with other settings", "--runs"]);
}
