//! `snakectl report faults`: a map of what each broken module costs, and each pair of them: what to look at before a robot is trusted.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use composer_shared::policies;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::{FaultKind, FaultPlan, PlannedFault, Target};
use serde_json::{Value, json};

use super::rows::{Rows, measured};
use crate::cli::export::Measured;
use crate::cli::{PolicySource, task_by_name};
use crate::eval::parallel;
use crate::files::{create_folder, write_whole};
use crate::plot::{Heatmap, MapWords, heatmaps};

/// Makes the fault of a module.
type Kind = fn(Target) -> FaultKind;

/// What can be broken about a module, from the start of the episode on.
const KINDS: [(&str, Kind); 3] = [
    ("unplugged", FaultKind::Unplug as Kind),
    ("motors dead", FaultKind::Action as Kind),
    ("sensors blind", FaultKind::Observation as Kind),
];

/// Arguments of `report faults`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Episodes of each module by itself, the first of the published ones
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Episodes of each pair of modules
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pair_episodes: u64,
    /// Threads [default: one a core]
    #[arg(long)]
    threads: Option<usize>,
    /// Folder of the cells that are done
    #[arg(long, value_name = "DIR", default_value = "runs/faults")]
    runs: PathBuf,
    /// Folder for figures, table and data
    #[arg(long, value_name = "DIR", default_value = "host/results/faults")]
    out: PathBuf,
}

/// A cell of a map: two modules, or the same one twice.
struct Cell {
    kind: usize,
    modules: [usize; 2],
}

impl Cell {
    /// Its faults, which hold from the start on.
    fn plan(&self) -> FaultPlan {
        let [a, b] = self.modules;
        let broken =
            |module| PlannedFault { kind: KINDS[self.kind].1(Target::Module(module)), at_ns: Some(0), until_ns: None };
        FaultPlan { faults: if a == b { vec![broken(a)] } else { vec![broken(a), broken(b)] } }
    }
}

/// All cells of a robot of so many modules: for each kind the upper triangle, row by row.
fn cells(modules: usize) -> Vec<Cell> {
    let pairs = move |kind| (0..modules).flat_map(move |a| (a..modules).map(move |b| Cell { kind, modules: [a, b] }));
    (0..KINDS.len()).flat_map(pairs).collect()
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    create_folder(&arguments.runs)?;
    create_folder(&arguments.out)?;
    let kept = Rows::open(&arguments.runs.join("rows.json"))?;
    let (mut table, mut data) = (String::new(), Vec::new());
    for name in policies::NAMES {
        let task = Task::from_name(name).context("policies are named after their task")?;
        if !arguments.tasks.is_empty() && !arguments.tasks.contains(&task) {
            continue;
        }
        let source = PolicySource::load(name)?;
        let config = source.environment(None, None)?;
        if config.robot.modules < 2 {
            bail!("a map of pairs needs a robot with two modules or more");
        }
        let cells = cells(config.robot.modules);
        let threads = arguments.threads.unwrap_or_else(crate::cli::cores);
        // A cell is small: one thread each.
        let found = parallel(cells.len(), threads, |number| {
            if number % 12 == 0 {
                eprintln!("{name}: {number} of {}", cells.len());
            }
            let (cell, plan) = (&cells[number], cells[number].plan());
            let alone = cell.modules[0] == cell.modules[1];
            let episodes = if alone { arguments.episodes } else { arguments.pair_episodes };
            measured(&kept, &source, &config, &plan, &plan, (episodes, 1))
        });
        let found = found.into_iter().collect::<Result<Vec<_>>>()?;
        let maps = maps(config.robot.modules, &cells, &found);
        let words = MapWords {
            title: format!("{}: success with broken modules", task.title()),
            columns: "module".into(),
            rows: "and module".into(),
            largest: Some(1.0),
        };
        write_whole(&arguments.out.join(format!("{name}.svg")), heatmaps(&maps, &words).as_bytes())?;
        rows(&mut table, task, config.robot.modules, &cells, &found)?;
        data.extend(cells.iter().zip(&found).map(|(cell, measured)| -> Value {
            json!({"policy": name, "kind": KINDS[cell.kind].0, "modules": cell.modules, "measured": measured})
        }));
    }
    publish(&table, &data, arguments)
}

/// A matrix for each kind: single modules on the diagonal, pairs on either side of it.
fn maps(modules: usize, cells: &[Cell], measured: &[Measured]) -> Vec<Heatmap> {
    let mut maps: Vec<Heatmap> = KINDS
        .iter()
        .map(|(words, _)| Heatmap { title: (*words).into(), modules, weights: vec![0.0; modules * modules] })
        .collect();
    for (cell, measured) in cells.iter().zip(measured) {
        let [a, b] = cell.modules;
        for index in [a * modules + b, b * modules + a] {
            maps[cell.kind].weights[index] = measured.success_rate as f32;
        }
    }
    maps
}

/// Rows of the table: success by module, the mean and the worst of the pairs.
fn rows(table: &mut String, task: Task, modules: usize, cells: &[Cell], measured: &[Measured]) -> Result<()> {
    if table.is_empty() {
        let numbers: Vec<String> = (0..modules).map(|module| module.to_string()).collect();
        writeln!(
            table,
            "| task | broken | {} | pairs, mean | worst pair |\n|{}",
            numbers.join(" | "),
            "---|".repeat(modules + 4)
        )?;
    }
    for (kind, (words, _)) in KINDS.iter().enumerate() {
        let of_kind = || cells.iter().zip(measured).filter(move |(cell, _)| cell.kind == kind);
        let single = of_kind().filter(|(cell, _)| cell.modules[0] == cell.modules[1]);
        let single: Vec<String> = single.map(|(_, m)| format!("{:.2}", m.success_rate)).collect();
        let pairs: Vec<_> = of_kind().filter(|(cell, _)| cell.modules[0] != cell.modules[1]).collect();
        let mean = pairs.iter().map(|(_, m)| m.success_rate).sum::<f64>() / pairs.len() as f64;
        let worst = pairs.iter().min_by(|a, b| a.1.success_rate.total_cmp(&b.1.success_rate));
        let worst = worst.map_or(String::new(), |(cell, m)| {
            format!("{:.2} ({} and {})", m.success_rate, cell.modules[0], cell.modules[1])
        });
        writeln!(table, "| {} | {words} | {} | {mean:.2} | {worst} |", task.title(), single.join(" | "))?;
    }
    Ok(())
}

fn publish(table: &str, data: &[Value], arguments: &Arguments) -> Result<()> {
    let out: &Path = &arguments.out;
    let table = format!(
        "{table}\nSuccess with module 0 (head) to the last broken from the start of the episode on, {} published episodes each; of pairs {}.\n",
        arguments.episodes, arguments.pair_episodes
    );
    write_whole(&out.join("map.json"), serde_json::to_string_pretty(data)?.as_bytes())?;
    write_whole(&out.join("table.md"), table.as_bytes())?;
    print!("{table}");
    println!("\nwritten to {}", out.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_sim_bridge::faults::Fault;

    #[test]
    fn every_module_and_every_pair_of_every_kind_has_a_cell() {
        let cells = cells(8);
        assert_eq!(cells.len(), 3 * 36);
        let drawn = |cell: &Cell| cell.plan().draw(5, 8);
        assert_eq!(drawn(&cells[0]).len(), 1);
        let pair = cells.iter().find(|cell| cell.kind == 1 && cell.modules == [2, 5]).unwrap();
        let faults = drawn(pair);
        assert_eq!(
            faults.iter().map(|f| (f.fault, f.at_ns)).collect::<Vec<_>>(),
            [(Fault::ActuatorDead(2), 0), (Fault::ActuatorDead(5), 0)]
        );
        // What is written in the key reads back as the same faults.
        let again: FaultPlan = pair.plan().to_string().parse().unwrap();
        assert_eq!(again.draw(5, 8), faults);
    }
}
