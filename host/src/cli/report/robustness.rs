//! `snakectl report robustness`: whether the policies that ship depend on the physics they were trained with.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use composer_shared::policies;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::FaultPlan;
use serde_json::{Value, json};

use crate::cli::physics::Physics;
use crate::cli::task_by_name;
use crate::files::{create_folder, write_whole};
use crate::policy_source::PolicySource;
use crate::release::measured::{Measured, measured};
use crate::robot::Robot;
use crate::robot::Solver;
use crate::rows::Rows;
use crate::stats::with_interval;

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

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let names: Vec<&str> = policies::NAMES
        .into_iter()
        .filter(|name| arguments.tasks.is_empty() || arguments.tasks.iter().any(|task| task.name() == *name))
        .collect();
    let mut shipped = Vec::new();
    for name in names {
        let source = PolicySource::load(name)?;
        let config = source.environment(None, None)?;
        shipped.push((name, source, config));
    }
    let Some((_, _, first)) = shipped.first() else { bail!("no policy of these tasks ships with this version") };
    create_folder(&arguments.runs)?;
    create_folder(&arguments.out)?;
    let rows = Rows::open(&arguments.runs.join("rows.json"))?;
    let (mut results, mut left_out) = (Vec::new(), Vec::new());
    for (words, physics) in variants(&first.robot) {
        // A version without the solver or the tolerance has no such row.
        if let Err(reason) = physics.apply(first.clone()) {
            left_out.push(format!("{words}: {reason}"));
            continue;
        }
        let mut cells = Vec::new();
        for (name, source, config) in &shipped {
            eprintln!("{words}: {name}");
            let size = (arguments.episodes, arguments.threads.unwrap_or_else(crate::cli::cores));
            let config = physics.apply(config.clone())?;
            cells.push(measured(&rows, source, &config, &physics, &FaultPlan::default(), size)?);
        }
        results.push((words, physics, cells));
    }
    let names: Vec<&str> = shipped.iter().map(|(name, ..)| *name).collect();
    publish(&names, &results, &left_out, &arguments.out)
}

/// The table and the data.
fn publish(
    names: &[&str],
    results: &[(String, Physics, Vec<Measured>)],
    left_out: &[String],
    out: &Path,
) -> Result<()> {
    let titles: Vec<&str> = names.iter().filter_map(|name| Task::from_name(name)).map(Task::title).collect();
    let mut table = format!("| physics | {} |\n|---|{}\n", titles.join(" | "), "---|".repeat(titles.len()));
    let mut data: Vec<Value> = Vec::new();
    for (words, physics, cells) in results {
        let success = cells.iter().map(|m| {
            let success = with_interval(m.success_rate, m.success_low, m.success_high, 3);
            format!("{success} in {:.1}", m.steps_mean)
        });
        writeln!(table, "| {words} | {} |", success.collect::<Vec<_>>().join(" | "))?;
        for (name, measured) in names.iter().zip(cells) {
            data.push(json!({"policy": name, "row": words, "physics": physics.to_string(), "measured": measured}));
        }
    }
    if let Some(measured) = results.iter().find_map(|(_, _, cells)| cells.first()) {
        writeln!(
            table,
            "\nSuccess over {} episodes, its 95 % interval (Wilson), and control steps, {} modules, at most {} control steps; the policies are not told.",
            measured.episodes, measured.modules, measured.cap
        )?;
    }
    for line in left_out {
        eprintln!("note: left out: {line}");
    }
    write_whole(&out.join("policies.json"), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join("policies.md"), table.as_bytes())?;
    print!("{table}");
    println!("\nwritten to {}", out.display());
    Ok(())
}
