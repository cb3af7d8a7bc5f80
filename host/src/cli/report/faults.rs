//! `snakectl report faults`: a map of what each broken module costs, and each pair of them: what to look at before a robot is trusted. With
//! `--specialists` also what the body could still do: for every fault of one module that is not mastered a policy is trained that knows it, because it
//! never sees anything else.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::CRC_32;
use composer_shared::policies;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::{FaultKind, FaultPlan, PlannedFault, Target};
use serde_json::{Value, json};

use super::rows::measured;
use crate::cli::export::Measured;
use crate::cli::{PolicySource, task_by_name};
use crate::eval::{PUBLISHED_SEED, Trial, parallel};
use crate::files::{create_folder, write_whole};
use crate::plot::{Heatmap, MapWords, heatmaps};
use crate::rows::Rows;
use crate::run::RunConfig;
use crate::run_folder::{load_config, load_run, trained};
use crate::side_by_side::side_by_side;

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
    /// Train a specialist for each fault of one module that is not mastered, and compare with it
    #[arg(long)]
    specialists: bool,
    /// Success from which on a fault is mastered
    #[arg(long, value_name = "SHARE", default_value_t = 0.9)]
    mastered: f64,
    /// Environment steps of a specialist
    #[arg(long, default_value_t = 500_000)]
    specialist_steps: u64,
    /// Folder of the settings, TASK.toml, from which a specialist takes the learner's
    #[arg(long, value_name = "DIR", default_value = "host/configs")]
    configs: PathBuf,
    /// Folder of finished runs, TASK: each specialist begins with the policy of the one of its task [default: from nothing]
    #[arg(long, value_name = "DIR")]
    start: Option<PathBuf>,
    /// Change one setting of every specialist, such as learning_rate=3e-4; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Specialists side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
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
        let bounds = match arguments.specialists {
            true => specialists(task, &cells, &found, &kept, arguments)?,
            false => vec![None; cells.len()],
        };
        if arguments.specialists {
            let compared = compared(config.robot.modules, &cells, &found, &bounds);
            let words = MapWords { title: format!("{}: of what a specialist can", task.title()), ..words };
            let file = arguments.out.join(format!("{name}-specialists.svg"));
            write_whole(&file, heatmaps(&compared, &words).as_bytes())?;
        }
        rows(&mut table, task, config.robot.modules, (&cells, &found, &bounds))?;
        data.extend(cells.iter().zip(&found).zip(&bounds).map(|((cell, measured), bound)| -> Value {
            json!({
                "policy": name, "kind": KINDS[cell.kind].0, "modules": cell.modules, "measured": measured, "specialist": bound,
            })
        }));
    }
    publish(&table, &data, arguments)
}

/// The settings of a specialist: those of the robust training on the robot's own length, with this fault in every episode and nothing else broken or
/// varied.
fn specialist(task: Task, plan: &FaultPlan, arguments: &Arguments) -> Result<RunConfig> {
    let mut config = load_config(&arguments.configs.join(format!("{task}.toml")))?.plain();
    if config.task.name != task {
        bail!("{} has settings for {}, not for {task}", arguments.configs.display(), config.task.name);
    }
    config.faults.fixed = plan.to_string();
    config.train.total_steps = arguments.specialist_steps;
    config.train.evaluate_every = 0;
    if let Some(folder) = &arguments.start {
        config.train.start = folder.join(task.name()).display().to_string();
    }
    for setting in &arguments.settings {
        config.set(setting)?;
    }
    config.validate()?;
    Ok(config)
}

/// What specialists reach, for each cell of one module that is not mastered.
fn specialists(
    task: Task,
    cells: &[Cell],
    measured: &[Measured],
    kept: &Rows,
    arguments: &Arguments,
) -> Result<Vec<Option<Measured>>> {
    let hard = |(_, (cell, measured)): &(usize, (&Cell, &Measured))| {
        cell.modules[0] == cell.modules[1] && measured.success_rate < arguments.mastered
    };
    let hard: Vec<usize> = cells.iter().zip(measured).enumerate().filter(hard).map(|(number, _)| number).collect();
    let mut runs = Vec::new();
    for &number in &hard {
        let plan = cells[number].plan();
        let name = format!("{task}-{}-{}", KINDS[cells[number].kind].0.replace(' ', "-"), cells[number].modules[0]);
        runs.push((arguments.runs.join("specialists").join(name), specialist(task, &plan, arguments)?, plan));
    }
    let folders: Vec<&Path> = runs.iter().map(|(folder, ..)| &**folder).collect();
    let key = |(_, config, plan): &(PathBuf, RunConfig, FaultPlan)| -> Result<String> {
        let digest = CRC_32.checksum(toml::to_string(config)?.as_bytes());
        Ok(format!("{task} specialist {digest:08x} {plan} episodes={}", arguments.episodes))
    };
    let evaluated = |run: &(PathBuf, RunConfig, FaultPlan), threads: usize| -> Result<Measured> {
        kept.get(&key(run)?, || {
            let (config, policy) = load_run(&run.0)?;
            let draw = |seed, modules| run.2.draw(seed, modules);
            let trial = Trial {
                config: &Arc::new(config.evaluation()),
                episodes: arguments.episodes as usize,
                seed: PUBLISHED_SEED,
                faults: &draw,
                threads,
            };
            Ok(trial.evaluate(&*policy.policy(), &run.2.to_string(), &|| {}).into())
        })
    };
    let finished = side_by_side(&folders, arguments.jobs, |number, threads| {
        let run = &runs[number];
        match trained(&run.0, &run.1, threads)? {
            true => evaluated(run, threads).map(drop),
            false => Ok(()),
        }
    })?;
    if !finished {
        bail!("stopped; the same command goes on from here");
    }
    let mut bounds = vec![None; cells.len()];
    for (number, run) in hard.into_iter().zip(&runs) {
        bounds[number] = Some(evaluated(run, 1)?);
    }
    Ok(bounds)
}

/// On the diagonal the share of a specialist's success that the one policy has, 1 where the fault is mastered.
fn compared(modules: usize, cells: &[Cell], measured: &[Measured], bounds: &[Option<Measured>]) -> Vec<Heatmap> {
    let mut maps = maps(modules, cells, measured);
    maps.iter_mut().for_each(|map| map.weights.fill(f32::NAN));
    for ((cell, measured), bound) in cells.iter().zip(measured).zip(bounds) {
        if cell.modules[0] == cell.modules[1] {
            let share = bound.as_ref().map_or(1.0, |bound| measured.success_rate / bound.success_rate.max(1e-9));
            maps[cell.kind].weights[cell.modules[0] * (modules + 1)] = share.min(1.0) as f32;
        }
    }
    maps
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
fn rows(
    table: &mut String,
    task: Task,
    modules: usize,
    (cells, measured, bounds): (&[Cell], &[Measured], &[Option<Measured>]),
) -> Result<()> {
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
        let single = cells.iter().zip(measured).zip(bounds);
        let single = single.filter(|((cell, _), _)| cell.kind == kind && cell.modules[0] == cell.modules[1]);
        let single = single.map(|((_, m), bound)| match bound {
            Some(bound) => format!("{:.2} of {:.2}", m.success_rate, bound.success_rate),
            None => format!("{:.2}", m.success_rate),
        });
        let single: Vec<String> = single.collect();
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
    let specialists = match (arguments.specialists, &arguments.start) {
        (false, _) => String::new(),
        (true, start) => format!(
            " Behind \"of\" the success of a specialist, for faults below {}: a float policy trained for {} environment steps with that fault alone, {}.",
            arguments.mastered,
            arguments.specialist_steps,
            if start.is_some() { "from the one policy on" } else { "from nothing" }
        ),
    };
    let table = format!(
        "{table}\nSuccess with module 0 (head) to the last broken from the start of the episode on, {} published episodes each; of pairs {}.{}\n",
        arguments.episodes, arguments.pair_episodes, specialists
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
    use clap::Parser;
    use composer_sim_bridge::faults::Fault;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        arguments: Arguments,
    }

    /// The whole of it, with a training of two iterations for each fault that is not mastered; a second call finds everything done.
    #[test]
    fn a_specialist_is_trained_for_what_is_not_mastered_and_only_once() {
        let folder = tempfile::tempdir().unwrap();
        let configs = concat!(env!("CARGO_MANIFEST_DIR"), "/configs");
        let line = |mastered: &str| {
            let set = ["environments=4", "rollout_steps=32", "minibatches=2", "epochs=1", "critic_epochs=1"];
            let set = set.map(|setting| format!("--set={setting}"));
            let fixed =
                ["x", "--specialists", "--episodes=2", "--specialist-steps=256", "--configs", configs, "--mastered"];
            let mut arguments =
                Line::parse_from(fixed.into_iter().chain([mastered]).chain(set.iter().map(|s| &**s))).arguments;
            arguments.runs = folder.path().into();
            arguments
        };
        let cells: Vec<Cell> = cells(8).into_iter().filter(|cell| cell.modules[0] < 2 && cell.kind == 1).collect();
        let kept = Rows::open(&folder.path().join("rows.json")).unwrap();
        let success = |rate: f64| Measured { success_rate: rate, ..Measured::default() };
        // Of the first two modules' dead motors the first is not mastered; pairs have no specialist.
        let found: Vec<Measured> =
            cells.iter().map(|cell| success(if cell.modules == [1, 1] { 0.95 } else { 0.5 })).collect();
        let task = Task::GoalReaching;
        let bounds = specialists(task, &cells, &found, &kept, &line("0.9")).unwrap();
        let trained: Vec<usize> = (0..cells.len()).filter(|number| bounds[*number].is_some()).collect();
        assert_eq!(trained.len(), 1);
        assert_eq!(cells[trained[0]].modules, [0, 0]);
        let run = folder.path().join("specialists/goal-reaching-motors-dead-0");
        let config = load_config(&run.join("config.toml")).unwrap();
        assert_eq!((config.faults.fixed.as_str(), config.faults.probability), ("action:#0@0s", 0.0));
        let metrics = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
        assert_eq!(metrics.lines().count(), 2);
        assert_eq!(specialists(task, &cells, &found, &kept, &line("0.9")).unwrap(), bounds);
        assert_eq!(std::fs::read_to_string(run.join("metrics.jsonl")).unwrap(), metrics);
        assert!(specialists(task, &cells, &found, &kept, &line("0.1")).unwrap().iter().all(Option::is_none));
        // On the map: a share of what it can, 1 where nothing is to be gained.
        let bound = vec![Some(success(0.8)), None];
        let two = [Cell { kind: 1, modules: [0, 0] }, Cell { kind: 1, modules: [1, 1] }];
        let maps = compared(8, &two, &[success(0.6), success(0.95)], &bound);
        assert_eq!((maps[1].weights[0], maps[1].weights[9]), (0.75, 1.0));
    }

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
