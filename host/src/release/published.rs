//! What is published of every seed, and the tables made of it.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Result, bail};
use composer_shared::policy::Task;
use serde::{Deserialize, Serialize};

use super::measured::Measured;
use crate::files::read_published;
use crate::freeze::Parity;
use crate::stats::with_interval;
use crate::tasks::task_name;

/// What a seed came to, as published: a line of the data, and what the tables are made of.
#[derive(Clone, Serialize, Deserialize)]
pub struct Published {
    /// Task.
    #[serde(with = "task_name")]
    pub task: Task,
    /// Seed of its training.
    pub seed: u64,
    /// Whether it is the one that ships.
    pub ships: bool,
    /// The image's digest, hexadecimal.
    pub crc32: String,
    /// Environment steps of its training, the run before it included.
    pub environment_steps: u64,
    /// Wall time of them on the machine that trained it, s.
    pub wall_seconds: f64,
    /// Floats against integers.
    pub parity: Parity,
    /// Its rows.
    pub measured: Vec<Measured>,
}

/// What is published already, nothing where there is nothing.
pub fn published(data_file: &Path) -> Result<Vec<Published>> {
    read_published(data_file, |one: &Published| !one.measured.is_empty())
}

/// In the order of the tasks, new ones in the place of those published before.
pub fn with_new(before: Vec<Published>, new: Vec<Published>) -> Vec<Published> {
    crate::files::with_new(before, new, |one| one.task, |one| (one.task as u8, one.seed))
}

/// What a row is called in the table.
fn heading(row: &Measured) -> String {
    match (&*row.fault, &*row.on) {
        ("none", "") => format!("{} modules, at most {} steps", row.modules, row.cap),
        ("none", on) => format!("{} modules, {on}", row.modules),
        (fault, _) => format!("`{fault}`"),
    }
}

fn success(row: &Measured, digits: usize) -> String {
    with_interval(row.success_rate, row.success_low, row.success_high, digits)
}

/// What ships, then all seeds.
pub fn tables(data: &[Published]) -> Result<String> {
    let chosen: Vec<&Published> = data.iter().filter(|one| one.ships).collect();
    let line = |cell: &dyn Fn(&Published) -> String| chosen.iter().map(|one| cell(one)).collect::<Vec<_>>().join(" | ");
    let Some(first) = chosen.first() else { bail!("there is no policy to publish") };
    let episodes = first.measured.first().map_or(0, |row| row.episodes);
    let mut table = format!(
        "{episodes} episodes a row, 95 % interval (Wilson); the seed of the median success over all rows with the robot's own modules ships.\n\n"
    );
    writeln!(table, "| | {} |\n|---|{}", line(&|one| one.task.title().into()), "---|".repeat(chosen.len()))?;
    // A task may have a row that the others do not have.
    let mut names: Vec<(String, usize)> = Vec::new();
    for row in chosen.iter().flat_map(|one| &one.measured) {
        if !names.iter().any(|(name, _)| *name == heading(row)) {
            names.push((heading(row), names.len()));
        }
    }
    for (name, number) in &names {
        let cell = |one: &Published| {
            let row = one.measured.iter().find(|row| heading(row) == *name);
            row.map_or_else(|| "-".into(), |row| success(row, 3))
        };
        writeln!(table, "| {name} | {} |", line(&cell))?;
        if *number == 0 {
            writeln!(table, "| control steps | {} |", line(&|one| format!("{:.1}", one.measured[0].steps_mean)))?;
        }
    }
    writeln!(table, "| seed that ships | {} |", line(&|one| one.seed.to_string()))?;
    let million = |one: &Published| format!("{:.1}", one.environment_steps as f64 * 1e-6);
    writeln!(table, "| trained for, million steps | {} |", line(&million))?;
    writeln!(table, "| in | {} |\n", line(&|one| format!("{:.0} min", one.wall_seconds / 60.0)))?;

    let faults: Vec<&Measured> = first.measured.iter().filter(|row| row.fault != "none").collect();
    let headings: Vec<String> = faults.iter().map(|row| format!("`{}`", row.fault)).collect();
    writeln!(
        table,
        "| task | seed | success | steps | {} |\n|{}",
        headings.join(" | "),
        "---|".repeat(4 + faults.len())
    )?;
    for one in data {
        let ships = if one.ships { ", ships" } else { "" };
        let healthy = &one.measured[0];
        let others =
            one.measured.iter().filter(|row| row.fault != "none").map(|row| format!("{:.3}", row.success_rate));
        writeln!(
            table,
            "| {} | {}{ships} | {} | {:.1} of {} | {} |",
            one.task.title(),
            one.seed,
            success(healthy, 3),
            healthy.steps_mean,
            healthy.cap,
            others.collect::<Vec<_>>().join(" | ")
        )?;
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_that_was_not_asked_for_keeps_what_was_published() {
        let one = |task: Task, seed, ships, success_rate| Published {
            task,
            seed,
            ships,
            crc32: String::new(),
            environment_steps: 1_000_000,
            wall_seconds: 60.0,
            parity: Parity::of(vec![0.0]),
            measured: vec![Measured { modules: 8, fault: "none".into(), success_rate, ..Measured::default() }],
        };
        let before = vec![one(Task::GoalReaching, 1, true, 0.25), one(Task::WallClimbing, 1, true, 0.5)];
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("seeds.json");
        assert!(published(&file).unwrap().is_empty());
        std::fs::write(&file, serde_json::to_string(&before).unwrap()).unwrap();
        let before = published(&file).unwrap();
        let new = vec![one(Task::WallClimbing, 2, true, 0.75), one(Task::WallClimbing, 1, false, 0.625)];
        let data = with_new(before, new);
        let order: Vec<(&str, u64)> = data.iter().map(|one| (one.task.name(), one.seed)).collect();
        assert_eq!(order, [("goal-reaching", 1), ("wall-climbing", 1), ("wall-climbing", 2)]);
        let table = tables(&data).unwrap();
        assert!(table.contains("| Goal Reaching | 1, ships | 0.250 "), "{table}");
        assert!(table.contains("| Wall Climbing | 2, ships | 0.750 "), "{table}");
        for damaged in ["[{}]", "[", &*serde_json::to_string(&data).unwrap().replace("[{\"fault", "[],\"x\":[{\"fault")]
        {
            std::fs::write(&file, damaged).unwrap();
            let error = published(&file).err().unwrap().to_string();
            assert!(error.ends_with("seeds.json is not what this program publishes: delete it"), "{error}");
        }
        assert!(!table.contains("0.500 [") && table.contains("| seed that ships | 1 | 2 |"), "{table}");
    }
}
