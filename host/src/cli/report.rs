//! `snakectl report`: the published comparisons, from nothing. Killed, it goes on where it was; what is done is skipped.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde_json::{Value, json};

use super::policy_file::{CONFIG_FILE, load_config, load_run};
use super::train::train_in;
use crate::eval::{Pilot, Trial, healthy};
use crate::files::{create_folder, write_whole};
use crate::methods::Method;
use crate::plot::{Axes, Panel, common_grid, mean_and_se, panels};
use crate::run::{Knows, RunConfig};

/// Seed of the final evaluations.
const FINAL_SEED: u64 = 1;
/// What a run's final evaluation is kept in.
const RESULT_FILE: &str = "result.json";

/// Arguments of `report`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Which comparison
    #[arg(value_enum)]
    what: What,
    /// Folder of the training runs
    #[arg(long, value_name = "DIR", default_value = "runs/attention")]
    runs: PathBuf,
    /// Folder for the figure, the table and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/attention")]
    out: PathBuf,
    /// Environment steps of each run
    #[arg(long, default_value_t = 300_000)]
    steps: u64,
    /// Seeds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Episodes of the evaluations at the end
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// mappo against composer-no-imagination, goal known to all modules and to the head alone
    Attention,
}

/// One training run of a comparison.
struct Run {
    folder: PathBuf,
    method: Method,
    knows: Knows,
    seed: u64,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let What::Attention = arguments.what;
    create_folder(&arguments.out)?;
    let mut runs = Vec::new();
    for seed in 1..=arguments.seeds {
        for knows in [Knows::All, Knows::Head] {
            for method in [Method::Mappo, Method::ComposerNoImagination] {
                let name = format!("{method}-{}-{seed}", if knows == Knows::All { "all" } else { "head" });
                runs.push(Run { folder: arguments.runs.join(name), method, knows, seed });
            }
        }
    }
    for (number, run) in runs.iter().enumerate() {
        eprintln!("run {} of {}: {}", number + 1, runs.len(), run.folder.display());
        if !finish(run, arguments)? {
            bail!("stopped; the same command goes on from here");
        }
    }
    publish(&runs, arguments)
}

/// Trains and evaluates a run unless that is done. False: interrupted.
fn finish(run: &Run, arguments: &Arguments) -> Result<bool> {
    let result = run.folder.join(RESULT_FILE);
    if result.exists() {
        return Ok(true);
    }
    let mut config = RunConfig::default();
    config.train.method = run.method;
    config.train.seed = run.seed;
    config.train.total_steps = arguments.steps;
    config.train.evaluate_every = (arguments.steps / 10).max(1);
    config.env.goal_known_to = run.knows;
    config.task.reward = crate::tasks::Reward::Progress;
    let resuming = run.folder.join(CONFIG_FILE).exists();
    if resuming && load_config(&run.folder.join(CONFIG_FILE))? != config {
        bail!("{} holds a run with other settings; choose another --runs folder", run.folder.display());
    }
    if train_in(&config, &run.folder, resuming)?.interrupted {
        return Ok(false);
    }
    let (config, network) = load_run(&run.folder)?;
    let env = Arc::new(config.evaluation());
    let trial = Trial {
        config: &env,
        episodes: arguments.episodes as usize,
        seed: FINAL_SEED,
        faults: &healthy,
        threads: super::cores(),
    };
    let mut results = serde_json::Map::new();
    for fault in ["none", "action:1", "action:2", "observation:1", "unplug:1"] {
        let plan: composer_sim_bridge::faults::FaultPlan =
            fault.parse().with_context(|| format!("the fault {fault}"))?;
        let draw = |seed, modules| plan.draw(seed, modules);
        let report = Trial { faults: &draw, ..trial }.evaluate(Pilot::Float(&network), fault, &|| {});
        results.insert(fault.into(), serde_json::to_value(report)?);
    }
    write_whole(&result, serde_json::to_string_pretty(&results)?.as_bytes())?;
    Ok(true)
}

/// Success at each evaluation of a run: (environment steps, share).
fn curve(folder: &Path) -> Result<Vec<(f64, f64)>> {
    let path = folder.join("metrics.jsonl");
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut points = vec![(0.0, 0.0)];
    for line in text.lines() {
        let line: Value = serde_json::from_str(line).with_context(|| format!("{} is damaged", path.display()))?;
        if let (Some(x), Some(y)) = (line["global_step"].as_f64(), line["evaluation/success_rate"].as_f64()) {
            points.push((x, y));
        }
    }
    Ok(points)
}

/// Figure, table and data.
fn publish(runs: &[Run], arguments: &Arguments) -> Result<()> {
    let mut figure = Vec::new();
    let mut data = Vec::new();
    let mut table = String::from(
        "| goal known to | method | success | one action | two action | one observation | one unplugged | steps |\n|---|---|---|---|---|---|---|---|\n",
    );
    for (knows, words) in [(Knows::All, "all modules"), (Knows::Head, "the head alone")] {
        let mut series = Vec::new();
        for (colour, method) in [Method::Mappo, Method::ComposerNoImagination].into_iter().enumerate() {
            let of: Vec<&Run> = runs.iter().filter(|r| r.knows == knows && r.method == method).collect();
            let curves = of.iter().map(|r| curve(&r.folder)).collect::<Result<Vec<_>>>()?;
            let mut mean = mean_and_se(&curves, &common_grid(&curves, 11));
            mean.name = method.name().into();
            mean.colour = colour;
            series.push(mean);
            let mut results = Vec::new();
            for (run, curve) in of.iter().zip(&curves) {
                let text = std::fs::read(run.folder.join(RESULT_FILE))?;
                let result: Value = serde_json::from_slice(&text)?;
                data.push(json!({
                    "method": method.name(), "goal_known_to": words, "seed": run.seed, "curve": curve, "final": result,
                }));
                results.push(result);
            }
            let column = |fault: &str, key: &str, digits: usize| {
                let values: Vec<f64> = results.iter().filter_map(|r| r[fault][key].as_f64()).collect();
                let n = values.len() as f64;
                let mean = values.iter().sum::<f64>() / n;
                let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
                format!("{mean:.digits$} +- {:.digits$}", (variance / n).sqrt())
            };
            let success = |fault| column(fault, "success_rate", 2);
            writeln!(
                table,
                "| {words} | {method} | {} | {} | {} | {} | {} | {} |",
                success("none"),
                success("action:1"),
                success("action:2"),
                success("observation:1"),
                success("unplug:1"),
                column("none", "steps_mean", 1)
            )?;
        }
        let axes = Axes {
            title: format!("Goal known to {words}"),
            x_label: "environment steps".into(),
            y_label: "success rate".into(),
            x_range: None,
            y_range: Some((0.0, 1.0)),
        };
        figure.push(Panel { axes, series });
    }
    let out = &arguments.out;
    write_whole(&out.join("learning-curves.svg"), panels(&figure).as_bytes())?;
    write_whole(&out.join("runs.json"), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join("table.md"), table.as_bytes())?;
    print!("{table}");
    println!("\nmean and standard error over {} seeds; written to {}", arguments.seeds, out.display());
    Ok(())
}
