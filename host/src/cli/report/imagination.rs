//! `snakectl report imagination`: variants of the imagination policy against none ([`crate::study`]).

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use crate::cli::task_by_name;
use crate::eval::PUBLISHED_EPISODES;
use crate::files::{create_folder, write_whole};
use crate::plot::mean_and_error;
use crate::study::{Found, Run, TASKS, Variant, ahead, found, runs, wins, work};

/// Arguments of `report imagination`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: shape-formation, tube-crossing, wall-climbing]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Seeds, from 1 on
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Environment steps of each run
    #[arg(long, default_value_t = 200_000, value_parser = clap::value_parser!(u64).range(1..))]
    steps: u64,
    /// Episodes of each evaluation, the first of the published ones
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Runs side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Train nothing: publish what the runs that are done come to
    #[arg(long)]
    so_far: bool,
    /// Folder of the training runs
    #[arg(long, value_name = "DIR", default_value = "runs/imagination")]
    runs: PathBuf,
    /// Folder for the table and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/imagination")]
    out: PathBuf,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let tasks = if arguments.tasks.is_empty() { TASKS.to_vec() } else { arguments.tasks.clone() };
    let all = runs(&arguments.runs, &tasks, arguments.seeds, arguments.steps);
    if !arguments.so_far && !work(&all, arguments.episodes, arguments.jobs)? {
        bail!("stopped; the same command goes on from here");
    }
    let done = all.iter().map(found).collect::<Result<Vec<Option<Found>>>>()?;
    let done: Vec<(&Run, Found)> = all.iter().zip(done).filter_map(|(run, found)| Some((run, found?))).collect();
    if done.is_empty() {
        bail!(
            "none of the {} runs in {} is done: without --so-far they are trained",
            all.len(),
            arguments.runs.display()
        );
    }
    let found: Vec<Found> = done.iter().map(|(_, found)| found.clone()).collect();
    let table = table(&tasks, &found, arguments)?;
    create_folder(&arguments.out)?;
    write_whole(&arguments.out.join("table.md"), table.as_bytes())?;
    write_whole(&arguments.out.join("runs.json"), serde_json::to_string_pretty(&found)?.as_bytes())?;
    print!("{table}");
    println!("\n{} of {} runs; written to {}", done.len(), all.len(), arguments.out.display());
    Ok(())
}

fn table(tasks: &[Task], found: &[Found], arguments: &Arguments) -> Result<String> {
    let titles: Vec<&str> = tasks.iter().map(|task| task.title()).collect();
    let mut table = format!("| | {} | ahead by | of |\n|---|{}\n", titles.join(" | "), "---|".repeat(tasks.len() + 2));
    let mut winners = Vec::new();
    for variant in Variant::ALL {
        let cells = tasks.iter().map(|task| {
            let of = found.iter().filter(|found| found.variant == variant && found.task == *task);
            let success: Vec<f64> = of.map(|found| found.success).collect();
            let (mean, error) = mean_and_error(&success);
            if success.is_empty() { "-".into() } else { format!("{mean:.2} +- {error:.2} ({})", success.len()) }
        });
        let cells: Vec<String> = cells.collect();
        let ahead = ahead(variant, found);
        if ahead.is_some_and(wins) {
            winners.push(variant.words());
        }
        let [by, pairs] = ahead.map_or(["-".into(), "-".into()], |(mean, error, pairs)| {
            [format!("{mean:+.3} +- {error:.3}"), format!("{pairs} pairs")]
        });
        writeln!(table, "| {} | {} | {by} | {pairs} |", variant.words(), cells.join(" | "))?;
    }
    writeln!(
        table,
        "\nSuccess of the float policy over {} published episodes, mean and standard error (seeds); eight healthy modules, {} environment steps a run. \
         Ahead: of the same task and seed without imagination. {}",
        arguments.episodes,
        arguments.steps,
        if winners.is_empty() {
            "None is ahead by more than two standard errors.".into()
        } else {
            format!("Ahead by more than two standard errors: {}.", winners.join("; "))
        }
    )?;
    Ok(table)
}
