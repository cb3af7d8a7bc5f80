//! `snakectl report policies`: every policy that ships, from nothing. Each task is trained with several seeds; the policy of the median success over all rows on the robot's own length ships,
//! and its manifest says what the others can do.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use composer_shared::CRC_32;
use composer_shared::policy::{Policy, Task};
use serde::{Deserialize, Serialize};

use crate::cli::export::{Exported, Measured, SeedRows, measure, rows};
use crate::cli::task_by_name;
use crate::eval::PUBLISHED_EPISODES;
use crate::files::{create_folder, write_whole};
use crate::freeze::Parity;
use crate::rows::Rows;
use crate::run::RunConfig;
use crate::run_folder::{
    CALIBRATION_EPISODES, CONFIG_FILE, NETWORK_FILE, begun, freeze_run, load_config, metrics_with_pretraining, trained,
    wall_seconds,
};
use crate::side_by_side::side_by_side;
use crate::stats::with_interval;
use crate::tasks::task_name;

/// The image of a run that has been trained to its end, in its folder.
const IMAGE_FILE: &str = "frozen.policy";
/// What was measured of it.
const ROWS_FILE: &str = "measured.json";
/// What every seed came to, in the folder for the tables.
const DATA_FILE: &str = "seeds.json";
/// Most bytes of the metrics that ship with a policy.
const METRICS_BYTES: usize = 300_000;

/// Arguments of `report policies`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Seeds, from 1 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Training runs side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Train nothing: freeze, measure and ship what the runs have come to
    #[arg(long)]
    only_freeze: bool,
    /// Change one setting of every run, such as total_steps=4096; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Episodes of each row, the first of the published ones
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Folder of the settings, TASK.toml
    #[arg(long, value_name = "DIR", default_value = "host/configs")]
    configs: PathBuf,
    /// Folder of the training runs
    #[arg(long, value_name = "DIR", default_value = "runs/policies")]
    runs: PathBuf,
    /// Folder that the policies ship from
    #[arg(long, value_name = "DIR", default_value = "shared/policies")]
    ship: PathBuf,
    /// Folder for the tables and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/policies")]
    out: PathBuf,
}

/// A task with one seed.
struct Run {
    task: Task,
    folder: PathBuf,
    config: RunConfig,
}

/// What a run came to.
struct Done<'a> {
    run: &'a Run,
    config: RunConfig,
    image: Vec<u8>,
    parity: Parity,
    measured: Vec<Measured>,
}

impl Done<'_> {
    fn overall(&self) -> f64 {
        overall(&self.measured)
    }

    fn seed(&self) -> u64 {
        self.config.train.seed
    }
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let tasks = if arguments.tasks.is_empty() { Task::ALL.to_vec() } else { arguments.tasks.clone() };
    let mut runs = Vec::new();
    for &task in &tasks {
        let file = arguments.configs.join(format!("{task}.toml"));
        let mut config = load_config(&file)?;
        if config.task.name != task {
            bail!("{} has settings for {}, not for {task}", file.display(), config.task.name);
        }
        for setting in &arguments.settings {
            config.set(setting)?;
        }
        for seed in 1..=arguments.seeds {
            config.train.seed = seed;
            config.validate()?;
            let folder = arguments.runs.join(format!("{task}-{seed}"));
            runs.push(Run { task, folder, config: config.clone() });
        }
    }
    if arguments.only_freeze {
        runs.retain(|run| run.folder.join(NETWORK_FILE).exists());
        if let Some(task) = tasks.iter().find(|task| !runs.iter().any(|run| run.task == **task)) {
            bail!("{} holds no run of {task} to freeze: without --only-freeze it is trained", arguments.runs.display());
        }
    }
    // Read first: what cannot be read is said before hours of training.
    let before = published(&arguments.out.join(DATA_FILE))?;
    // The longest first, so that none is left to run alone at the end.
    runs.sort_by_key(|run| std::cmp::Reverse(run.config.environment_steps()));
    for folder in [&arguments.runs, &arguments.ship, &arguments.out] {
        create_folder(folder)?;
    }
    let folders: Vec<&Path> = runs.iter().map(|run| &*run.folder).collect();
    let finished =
        side_by_side(&folders, arguments.jobs, |number, threads| finish(&runs[number], arguments, threads).map(drop))?;
    if !finished {
        bail!("stopped; the same command goes on from here");
    }
    let mut shipped = Vec::new();
    for task in tasks {
        let mut done = Vec::new();
        for run in runs.iter().filter(|run| run.task == task) {
            // Everything is there already, so that this only reads.
            done.push(finish(run, arguments, crate::cli::cores())?.context("a run is not finished")?);
        }
        done.sort_by_key(Done::seed);
        shipped.push(ship(done, &arguments.ship)?);
    }
    publish(&shipped, before, &arguments.out)
}

/// Trains, freezes and measures a run as far as that is not done; none if it was interrupted.
fn finish<'a>(run: &'a Run, arguments: &Arguments, threads: usize) -> Result<Option<Done<'a>>> {
    let (image_file, folder) = (run.folder.join(IMAGE_FILE), &run.folder);
    begun(folder, &run.config)?;
    let rows_kept = |folder: &Path| Rows::open(&folder.join(ROWS_FILE));
    let freeze = || -> Result<(RunConfig, Vec<u8>, Parity)> { freeze_run(folder, CALIBRATION_EPISODES, threads) };
    let (config, image, parity) = match std::fs::read(&image_file) {
        Ok(image) if Policy::parse(&image).is_ok() && !arguments.only_freeze => {
            let parity = rows_kept(folder)?.get(&parity_key(&image), || Ok(freeze()?.2))?;
            (load_config(&folder.join(CONFIG_FILE))?, image, parity)
        }
        _ => {
            if !arguments.only_freeze && !trained(folder, &run.config, threads)? {
                return Ok(None);
            }
            let (config, image, parity) = freeze()?;
            rows_kept(folder)?.get(&parity_key(&image), || Ok(parity))?;
            if !arguments.only_freeze {
                write_whole(&image_file, &image)?;
            }
            (config, image, parity)
        }
    };
    let (kept, env) = (rows_kept(folder)?, config.evaluation());
    let world = world(&env);
    let measured = rows(config.task.name, config.robot.modules)
        .into_iter()
        .map(|row| {
            let key = format!("{:08x} {row} episodes={} world={world:08x}", crc(&image), arguments.episodes);
            kept.get(&key, || measure(&env, &image, row, arguments.episodes, threads))
        })
        .collect::<Result<Vec<_>>>()?;
    Ok(Some(Done { run, config, image, parity, measured }))
}

fn parity_key(image: &[u8]) -> String {
    format!("{:08x} parity", crc(image))
}

fn crc(image: &[u8]) -> u32 {
    Policy::parse(image).map_or(0, |policy| policy.crc())
}

/// What an evaluation depends on besides the policy: robot, task, delay, sensors.
pub(super) fn world(env: &crate::env::EnvConfig) -> u32 {
    let text = format!(
        "{} {:08x} {:?} {:?} {:?}",
        env.robot.fingerprint(),
        env.task.digest(),
        env.delay,
        env.relax_seconds,
        env.sensors
    );
    CRC_32.checksum(text.as_bytes())
}

/// Mean success over the rows on the robot's own length, whole and broken, nominal and varied. The healthy row alone would choose by chance among seeds
/// that nearly always succeed.
fn overall(measured: &[Measured]) -> f64 {
    let own = measured.first().map_or(0, |row| row.modules);
    let rows = || measured.iter().filter(|row| row.modules == own);
    rows().map(|row| row.success_rate).sum::<f64>() / rows().count().max(1) as f64
}

/// The number of the median success; of an even number the lower one, of equals the earlier seed.
fn median(success: &[f64]) -> usize {
    let mut order: Vec<usize> = (0..success.len()).collect();
    order.sort_by(|a, b| success[*a].total_cmp(&success[*b]));
    order[(order.len() - 1) / 2]
}

/// A task with all its seeds; the number of the one that ships.
struct Shipped<'a> {
    seeds: Vec<Done<'a>>,
    chosen: usize,
}

/// Writes the policy of the median success ([`overall`]).
fn ship<'a>(seeds: Vec<Done<'a>>, to: &Path) -> Result<Shipped<'a>> {
    let chosen = median(&seeds.iter().map(Done::overall).collect::<Vec<_>>());
    let rows = seeds.iter().map(|done| SeedRows { seed: done.seed(), measured: done.measured.clone() }).collect();
    let done = &seeds[chosen];
    let folder = &done.run.folder;
    let metrics = metrics_with_pretraining(folder)?;
    let exported = Exported {
        config: done.config.clone(),
        run: folder,
        image: &done.image,
        parity: done.parity,
        measured: done.measured.clone(),
        seeds: rows,
    };
    let path = to.join(format!("{}.policy", done.run.task));
    exported.write(&path, thinned(&metrics, METRICS_BYTES).as_bytes())?;
    Ok(Shipped { seeds, chosen })
}

/// As many lines of metrics as fit into so many bytes: those with an evaluation and the last, and of the others every second, third and so on. If that is
/// too much still, of those with an evaluation as well.
fn thinned(metrics: &str, most: usize) -> String {
    let lines: Vec<&str> = metrics.lines().collect();
    for every in 1..=lines.len() {
        for keep_evaluations in [true, false] {
            let kept = lines.iter().enumerate().filter(|(number, line)| {
                number % every == 0 || *number + 1 == lines.len() || keep_evaluations && line.contains("\"evaluation/")
            });
            let text: String = kept.map(|(_, line)| format!("{line}\n")).collect();
            // Evaluations go only when hardly anything else is left.
            if text.len() <= most && (keep_evaluations || every >= 50 || every == lines.len()) {
                return text;
            }
        }
    }
    String::new()
}

/// What a seed came to, as published: a line of the data, and what the tables are made of.
#[derive(Clone, Serialize, Deserialize)]
struct Published {
    #[serde(with = "task_name")]
    task: Task,
    seed: u64,
    ships: bool,
    crc32: String,
    environment_steps: u64,
    wall_seconds: f64,
    parity: Parity,
    measured: Vec<Measured>,
}

impl Published {
    fn of(done: &Done, ships: bool) -> Published {
        Published {
            task: done.run.task,
            seed: done.seed(),
            ships,
            crc32: format!("{:08x}", crc(&done.image)),
            environment_steps: done.config.environment_steps(),
            wall_seconds: wall_seconds(&done.run.folder),
            parity: done.parity,
            measured: done.measured.clone(),
        }
    }
}

/// What is published already, nothing where there is nothing.
fn published(data_file: &Path) -> Result<Vec<Published>> {
    let Ok(text) = std::fs::read(data_file) else { return Ok(Vec::new()) };
    serde_json::from_slice(&text)
        .ok()
        .filter(|data: &Vec<Published>| data.iter().all(|one| !one.measured.is_empty()))
        .with_context(|| format!("{} is not what this program publishes: delete it", data_file.display()))
}

/// The tables and the data. Of tasks that were not asked for what was published before stays.
fn publish(shipped: &[Shipped], before: Vec<Published>, out: &Path) -> Result<()> {
    let new = shipped.iter().flat_map(|task| {
        task.seeds.iter().enumerate().map(move |(number, done)| Published::of(done, number == task.chosen))
    });
    let data = with_new(before, new.collect());
    let table = tables(&data)?;
    write_whole(&out.join(DATA_FILE), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join("table.md"), table.as_bytes())?;
    print!("{table}");
    println!("\nwritten to {}", out.display());
    Ok(())
}

/// In the order of the tasks, new ones in the place of those published before.
fn with_new(mut data: Vec<Published>, new: Vec<Published>) -> Vec<Published> {
    data.retain(|before| new.iter().all(|new| new.task != before.task));
    data.extend(new);
    data.sort_by_key(|one| (one.task as u8, one.seed));
    data
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
fn tables(data: &[Published]) -> Result<String> {
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
    fn the_median_ships() {
        let row = |modules, success_rate| Measured { modules, success_rate, ..Measured::default() };
        assert_eq!(overall(&[row(8, 1.0), row(8, 0.5), row(16, 0.0)]), 0.75);
        assert_eq!(median(&[0.9, 0.2, 0.5]), 2);
        assert_eq!(median(&[0.9, 0.2]), 1);
        assert_eq!((median(&[0.7]), median(&[0.5, 0.5, 0.5])), (0, 1));
    }

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
        let file = folder.path().join(DATA_FILE);
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

    #[test]
    fn metrics_are_thinned_to_the_evaluations_and_evenly() {
        let line = |n: usize| match n % 50 {
            0 => format!("{{\"step\":{n},\"evaluation/success_rate\":0.5}}\n"),
            _ => format!("{{\"step\":{n},\"charts/success_rate\":0.5}}\n"),
        };
        let metrics: String = (0..1001).map(line).collect();
        assert_eq!(thinned(&metrics, metrics.len()), metrics);
        let short = thinned(&metrics, 10_000);
        assert!(short.len() <= 10_000 && short.len() > 6_000, "{}", short.len());
        assert_eq!(short.matches("evaluation/").count(), 21);
        assert!(short.ends_with(&line(1000)) && short.starts_with(&line(0)));
        assert!(thinned(&metrics, 500).len() <= 500 && thinned(&metrics, 500).contains("\"step\":1000,"));
    }
}
