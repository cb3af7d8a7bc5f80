//! `snakectl report robustness`: whether the policies that ship depend on the physics they were trained with.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policies;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::FaultPlan;
use serde::{Deserialize, Serialize};

use crate::cli::physics::Physics;
use crate::cli::task_by_name;
use crate::files::{self, create_folder, read_published, write_whole};
use crate::policy_source::PolicySource;
use crate::release::measured::{Measured, measured};
use crate::robot::Robot;
use crate::robot::Solver;
use crate::rows::Rows;
use crate::stats::with_interval;
use crate::tasks::task_name;

/// Arguments of `report robustness`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Episodes of each cell, the first of the published ones
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Threads [default: one a core]
    #[arg(long)]
    threads: Option<usize>,
    /// Folder of the rows that are done
    #[arg(long, value_name = "DIR", default_value = "runs/robustness")]
    runs: PathBuf,
    /// Folder for the table and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/physics")]
    out: PathBuf,
}

/// The rows: what they are called, and the physics.
fn variants(robot: &Robot) -> Vec<(String, Physics)> {
    let finer = |finer| Physics { finer, ..Physics::default() };
    let vary = |key: &str, value: f32| Physics { vary: vec![format!("{key}={value}")], ..Physics::default() };
    let mut rows = vec![("as trained".to_string(), finer(1))];
    rows.extend([2, 4, 8].map(|times| (format!("physics step / {times}"), finer(times))));
    rows.push(("solver tolerance / 100".into(), Physics { tolerance: Some(0.01), ..Physics::default() }));
    rows.push(("solver of rapier".into(), Physics { solver: Some(Solver::Rapier), ..Physics::default() }));
    for (key, words, values, was) in [
        ("friction_along", "friction along", [0.07, 0.15], robot.friction_along),
        ("friction_across", "friction across", [0.7, 1.3], robot.friction_across),
    ] {
        rows.extend(values.map(|value| (format!("{words} {value} instead of {was}"), vary(key, value))));
    }
    for (key, words, was) in
        [("link_mass", "mass of the links", robot.link_mass), ("stiffness", "stiffness of the joints", robot.stiffness)]
    {
        rows.extend([0.8, 1.2].map(|times| (format!("{words} x {times}"), vary(key, times * was))));
    }
    rows
}

/// What is published of a policy in a row: an element of the data, and what the table is made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Measurement {
    #[serde(rename = "policy", with = "task_name")]
    task: Task,
    /// What the row is called.
    row: String,
    /// The physics, as `--vary` and its companions have them.
    physics: String,
    measured: Measured,
}

/// What is published, in the folder for it, and the table made of it.
const DATA_FILE: &str = "policies.json";
const TABLE_FILE: &str = "policies.md";

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    // Read first: what cannot be read is said before it takes long.
    let before = read_published(&arguments.out.join(DATA_FILE), |_| true)?;
    let names: Vec<&str> = policies::NAMES
        .into_iter()
        .filter(|name| arguments.tasks.is_empty() || arguments.tasks.iter().any(|task| task.name() == *name))
        .collect();
    let mut shipped = Vec::new();
    for name in names {
        let source = PolicySource::load(name)?;
        let config = source.environment(None, None)?;
        shipped.push((config.task.task(), source, config));
    }
    let Some((_, _, first)) = shipped.first() else { bail!("no policy of these tasks ships with this version") };
    create_folder(&arguments.runs)?;
    create_folder(&arguments.out)?;
    let rows = Rows::open(&arguments.runs.join("rows.json"))?;
    let mut new = Vec::new();
    for (words, physics) in variants(&first.robot) {
        // A version without the solver or the tolerance has no such row.
        if let Err(reason) = physics.apply(first.clone()) {
            eprintln!("note: left out: {words}: {reason}");
            continue;
        }
        for (task, source, config) in &shipped {
            eprintln!("{words}: {task}");
            let size = (arguments.episodes, arguments.threads.unwrap_or_else(crate::cli::cores));
            let config = physics.apply(config.clone())?;
            let measured = measured(&rows, source, &config, &physics, &FaultPlan::default(), size)?;
            new.push(Measurement { task: *task, row: words.clone(), physics: physics.to_string(), measured });
        }
    }
    let data = with_new(before, new);
    let table = table(&data)?;
    write_whole(&arguments.out.join(DATA_FILE), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&arguments.out.join(TABLE_FILE), table.as_bytes())?;
    print!("{table}");
    println!("\nwritten to {}", arguments.out.display());
    Ok(())
}

/// New measurements in the place of those of their tasks; what was published of the others stays. Task by task, in the order of the rows.
fn with_new(before: Vec<Measurement>, new: Vec<Measurement>) -> Vec<Measurement> {
    files::with_new(before, new, |one| one.task, |one| one.task as u8)
}

/// A row for each physics, a column for each task.
fn table(data: &[Measurement]) -> Result<String> {
    let tasks: Vec<Task> = Task::ALL.into_iter().filter(|task| data.iter().any(|m| m.task == *task)).collect();
    let titles: Vec<&str> = tasks.iter().map(|task| task.title()).collect();
    let mut table = format!("| physics | {} |\n|---|{}\n", titles.join(" | "), "---|".repeat(titles.len()));
    let mut rows: Vec<&str> = Vec::new();
    for measurement in data {
        if !rows.contains(&&*measurement.row) {
            rows.push(&measurement.row);
        }
    }
    for row in rows {
        let cells = tasks.iter().map(|task| {
            let of = data.iter().find(|m| m.task == *task && m.row == row);
            of.map_or_else(
                || "-".into(),
                |Measurement { measured: m, .. }| {
                    let success = with_interval(m.success_rate, m.success_low, m.success_high, 3);
                    format!("{success} in {:.1}", m.steps_mean)
                },
            )
        });
        writeln!(table, "| {row} | {} |", cells.collect::<Vec<_>>().join(" | "))?;
    }
    if let Some(Measurement { measured, .. }) = data.first() {
        writeln!(
            table,
            "\nSuccess over {} episodes, its 95 % interval (Wilson), and control steps, {} modules, at most {} control steps; the policies are not told.",
            measured.episodes, measured.modules, measured.cap
        )?;
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn published(file: &Path) -> Result<Vec<Measurement>> {
        read_published(file, |_| true)
    }

    #[test]
    fn a_task_that_was_not_asked_for_keeps_its_column() {
        let one = |task, row: &str, success_rate| Measurement {
            task,
            row: row.into(),
            physics: String::new(),
            measured: Measured { success_rate, ..Measured::default() },
        };
        let before = vec![one(Task::TubeCrossing, "as trained", 0.25), one(Task::WallClimbing, "as trained", 0.5)];
        let new = vec![one(Task::WallClimbing, "as trained", 0.75), one(Task::WallClimbing, "slower", 0.125)];
        let table = table(&with_new(before, new)).unwrap();
        assert!(table.contains("| physics | Tube Crossing | Wall Climbing |"), "{table}");
        assert!(table.contains("| as trained | 0.250 [") && table.contains("| 0.750 ["), "{table}");
        assert!(table.contains("| slower | - | 0.125 [") && !table.contains("0.500"), "{table}");
    }

    #[test]
    fn what_is_published_reads_back_to_the_table_beside_it() {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/results/physics"));
        let data = published(&folder.join(DATA_FILE)).unwrap();
        assert_eq!(table(&data).unwrap(), std::fs::read_to_string(folder.join(TABLE_FILE)).unwrap());
        let damaged = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(damaged.path(), "[{}]").unwrap();
        let error = published(damaged.path()).unwrap_err().to_string();
        assert!(error.ends_with("is not what this program publishes: delete it"), "{error}");
    }
}
