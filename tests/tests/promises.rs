//! What the README promises, on fewer episodes.

mod common;

use std::path::Path;

use common::{json, succeed};
use composer_shared::policies;
use composer_shared::policy::{Policy, Task};

fn number(report: &serde_json::Value, key: &str) -> f64 {
    report[key].as_f64().unwrap_or_else(|| panic!("{key} is missing in {report}"))
}

/// Success that the manifest of a shipped policy states; none if the policy does not say which settings of its task that was for.
fn promised(name: &str, fault: &str, modules: i64) -> Option<f64> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/policies").join(format!("{name}.toml"));
    let manifest: toml::Table = toml::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    let row = manifest["measured"]
        .as_array()
        .unwrap()
        .iter()
        .find(|row| row["fault"].as_str() == Some(fault) && row["modules"].as_integer() == Some(modules));
    let known = Policy::parse(policies::shipped(name).unwrap()).unwrap().task_digest() != 0;
    row.filter(|_| known).map(|row| row["success_rate"].as_float().unwrap())
}

#[test]
fn the_shipped_policy_reaches_its_goals_and_the_bus_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| json(folder.path(), &[arguments, &["--episodes", "60", "--json"]].concat());
    let eval = run(&["eval", "goal-reaching"]);
    assert_eq!(number(&eval, "episodes"), 60.0);
    assert_eq!(number(&eval, "modules"), 8.0);
    assert_eq!(eval["fault"], "none");
    for key in ["success_low", "success_high", "distance_mean", "steps_mean", "cap"] {
        number(&eval, key);
    }
    let rate = number(&eval, "success_rate");
    assert!(rate >= promised("goal-reaching", "none", 8).unwrap_or(0.8) - 0.1, "{eval}");
    assert!(number(&eval, "success_low") < rate && rate <= number(&eval, "success_high"), "{eval}");
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
        // 60 episodes scatter by up to 0.06 in one of three.
        let promised = promised(name, "none", 8).unwrap_or(0.5);
        assert!(eval >= promised - 0.15 && (sil - eval).abs() <= 0.067, "{name}: {eval} and {sil} on the bus");
    }
}

#[test]
fn a_module_can_be_unplugged_on_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let run = |fault| json(folder.path(), &["sil", "goal-reaching", "--episodes", "60", "--fault", fault, "--json"]);
    let one = run("unplug:1");
    assert!(number(&one, "success_rate") >= promised("goal-reaching", "unplug:1", 8).unwrap_or(0.85) - 0.15, "{one}");
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
fn physics_can_be_varied_in_the_simulator_and_on_the_bus_alike() {
    let folder = tempfile::tempdir().unwrap();
    for verb in ["eval", "sil"] {
        let run = |more: &[&str]| {
            json(folder.path(), &[&[verb, "goal-reaching", "--episodes", "6", "--json"], more].concat())
        };
        let (nominal, same) = (run(&[]), run(&["--finer", "1"]));
        assert_eq!(nominal["steps_mean"], same["steps_mean"]);
        assert_eq!((&nominal["physics"], nominal["cap"].as_u64()), (&serde_json::Value::Null, Some(125)));
        let finer = run(&["--finer", "2"]);
        assert_eq!(finer["physics"], "finer=2");
        assert_ne!(finer["distance_mean"], nominal["distance_mean"]);
        if verb == "sil" {
            // The delay is the bus's and that of the robot's own step. Without motors, so that the episodes are equally long: the clocks drift on.
            let [finer, nominal] = ["2", "1"].map(|finer| run(&["--finer", finer, "--fault", "action:8"]));
            assert_eq!(finer["latent_age_max_ms"], nominal["latent_age_max_ms"]);
        }
        let varied = run(&["--vary", "friction_along=0.15", "--vary", "stiffness=70"]);
        assert_eq!(varied["physics"], "friction_along=0.15, stiffness=70");
        assert_ne!(varied["distance_mean"], nominal["distance_mean"]);
        assert_eq!(run(&["--modules", "16", "--fault", "action:16"])["cap"], 250);
    }
}

#[test]
fn the_demonstration_prints_a_table_and_writes_a_page_and_a_capture_is_a_candump_log() {
    let folder = tempfile::tempdir().unwrap();
    let table = succeed(folder.path(), &["--episodes", "2", "--replay", "page.html"]);
    assert!(table.contains("one unplugged on the way") && table.contains("another robot and floor"), "{table}");
    let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
    assert!(page.contains("<html") && page.len() > 100_000);
    // Without motors, so that the episode has its whole length.
    succeed(folder.path(), &["sil", "goal-reaching", "--episodes", "1", "--fault", "action:8", "--capture", "bus.log"]);
    let log = std::fs::read_to_string(folder.path().join("bus.log")).unwrap();
    let first = log.lines().next().unwrap();
    assert!(first.starts_with('(') && first.contains(" can0 080##1"), "the first frame is SYNC of module 0: {first}");
    assert!(log.lines().count() > 500);
    let dbc = succeed(folder.path(), &["dbc"]);
    assert!(dbc.contains("BO_ ") && dbc.contains("VFrameFormat"), "{dbc}");
}

#[test]
fn the_policies_that_ship_are_made_from_nothing_and_the_median_of_the_seeds_ships() {
    let folder = tempfile::tempdir().unwrap();
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/configs");
    let configs = configs.to_str().unwrap();
    let report = |more: &[&str]| {
        let arguments: [&[&str]; 4] = [
            &["report", "policies", "--tasks", "goal-reaching,shape-formation", "--seeds", "3", "--episodes", "2"],
            &["--configs", configs, "--runs", "r", "--out", "o", "--ship", "s", "--set", "total_steps=512"],
            &[
                "--set",
                "environments=4",
                "--set",
                "rollout_steps=32",
                "--set",
                "evaluation_episodes=1",
                "--set",
                "pretraining.steps=128",
                "--set",
                "pretraining.environments=4",
            ],
            more,
        ];
        succeed(folder.path(), &arguments.concat())
    };
    let table = report(&[]);
    assert!(table.contains("| Goal Reaching | 3") && table.matches(", ships |").count() == 2, "{table}");
    let read = |path: &str| std::fs::read(folder.path().join(path)).unwrap();
    let manifest: toml::Table = toml::from_str(&String::from_utf8(read("s/shape-formation.toml")).unwrap()).unwrap();
    let seeds: Vec<_> = manifest["seeds"].as_array().unwrap().iter().map(|s| s["seed"].as_integer()).collect();
    assert_eq!(seeds, [Some(1), Some(2), Some(3)]);
    assert_eq!(manifest["measured"].as_array().unwrap().len(), 13);
    let image = read("s/shape-formation.policy");
    let policy = Policy::parse(&image).unwrap();
    assert_eq!(manifest["task_digest"].as_str(), Some(format!("{:08x}", policy.task_digest()).as_str()));
    assert_ne!(policy.task_digest(), 0);
    assert!(read("s/goal-reaching.metrics.jsonl").len() <= 300_000);
    let data: serde_json::Value = serde_json::from_slice(&read("o/seeds.json")).unwrap();
    assert_eq!(data.as_array().unwrap().len(), 6);
    // What is done is not done again, and comes to the same.
    let network = read("r/goal-reaching-2/network.json");
    assert_eq!(report(&[]), table);
    assert_eq!(report(&["--only-freeze"]), table);
    assert_eq!((read("s/shape-formation.policy"), read("r/goal-reaching-2/network.json")), (image, network));
}

#[test]
fn robustness_is_a_table_of_all_policies_that_ship() {
    let folder = tempfile::tempdir().unwrap();
    let arguments =
        ["report", "robustness", "--tasks", "goal-reaching", "--episodes", "2", "--runs", "r", "--out", "o"];
    let table = succeed(folder.path(), &arguments);
    for row in
        ["| as trained |", "| physics step / 8 |", "| friction along 0.07 instead", "| stiffness of the joints x 1.2 |"]
    {
        assert!(table.contains(row), "{table}");
    }
    assert_eq!(succeed(folder.path(), &arguments), table);
}
