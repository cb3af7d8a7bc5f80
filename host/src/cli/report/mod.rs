//! `snakectl report`: the published comparisons, from nothing. Killed, it goes on where it was; what is done is skipped.

mod attention_maps;
mod faults;
mod imagination;
mod paper;
mod physics;
mod policies;
mod robustness;
mod rows;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::policy::Task;
use serde_json::{Value, json};

use crate::eval::{PUBLISHED_EPISODES, PUBLISHED_SEED, Trial, healthy};
use crate::files::{create_folder, write_whole};
use crate::methods::Method;
use crate::plot::{Axes, Panel, common_grid, mean_and_error, mean_and_se, panels};
use crate::run::{Knows, RunConfig};
use crate::run_folder::{begun, load_run, metrics, trained};
use crate::side_by_side::side_by_side;

/// Metrics of the imagination policy: its reward, and how far the modules are from where it wanted them.
const IMAGINATION: [&str; 2] = ["imagination/reward", "imagination/follow_error"];
/// Episodes of a point of a learning curve, of each run its own.
const CURVE_EPISODES: u64 = 100;
/// What a run's final evaluation is kept in.
const RESULT_FILE: &str = "result.json";

/// Arguments of `report`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    #[command(subcommand)]
    which: Which,
}

/// What can be published.
#[derive(clap::Subcommand, Clone, Debug)]
enum Which {
    /// Goal Reaching: composer-neither against composer-no-imagination, goal known to all modules and to the head alone.
    Attention(Comparison),
    /// All five tasks: composer against itself without imagination and without attention (the paper's ablation), and where the
    /// modules of the complete method attend.
    Ablation(Comparison),
    /// The paper's comparison: COMPOSER, its ablations and five baselines on all five tasks.
    Paper(paper::Arguments),
    /// The policies that ship: trained with several seeds, frozen, measured; the one of the median success goes to shared/policies.
    Policies(policies::Arguments),
    /// The physics alone: open-loop experiments over steps, tolerances and solvers, against a far finer reference.
    Physics(physics::Arguments),
    /// The policies that ship on other physics: a finer step, another solver, other friction, mass and stiffness.
    Robustness(robustness::Arguments),
    /// The policies that ship with every module broken, and every pair: success as a map.
    Faults(faults::Arguments),
    /// Variants of the imagination policy against none, on the tasks where the paper finds it ahead.
    Imagination(imagination::Arguments),
}

/// Arguments of a comparison of methods.
#[derive(clap::Args, Clone, Debug)]
struct Comparison {
    /// Folder of the training runs [default: runs/WHAT]
    #[arg(long, value_name = "DIR")]
    runs: Option<PathBuf>,
    /// Folder for the figures, the table and the data [default: host/results/WHAT]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Environment steps of each run; of Block Pushing twice as many, as it takes so long to begin
    #[arg(long, default_value_t = 250_000)]
    steps: u64,
    /// Seeds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Episodes of the evaluations at the end, the first of the published ones
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Training runs side by side, each on its share of the cores: the fewer cores a run has, the less it waits for itself
    /// [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Train nothing: publish what the runs that are done come to
    #[arg(long)]
    so_far: bool,
}

/// The comparisons of methods.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    Attention,
    Ablation,
}

impl What {
    fn name(self) -> &'static str {
        match self {
            What::Attention => "attention",
            What::Ablation => "ablation",
        }
    }

    /// Faults of the final evaluations, and the table's headings for them.
    fn faults(self) -> Vec<(&'static str, &'static str)> {
        match self {
            What::Attention => vec![
                ("none", "success"),
                ("action:1", "one action"),
                ("action:2", "two action"),
                ("observation:1", "one observation"),
                ("unplug:1", "one unplugged"),
            ],
            What::Ablation => vec![("none", "success"), ("unplug:1", "one unplugged")],
        }
    }

    /// What the panels of the figure differ in.
    fn panels_are(self) -> &'static str {
        match self {
            What::Attention => "goal known to",
            What::Ablation => "task",
        }
    }

    fn methods(self) -> Vec<Method> {
        match self {
            What::Attention => vec![Method::ComposerNeither, Method::ComposerNoImagination],
            What::Ablation => vec![Method::Composer, Method::ComposerNoImagination, Method::ComposerNoAttention],
        }
    }

    /// Name in folders, words in tables, and the settings of each panel.
    fn panels(self) -> Vec<(&'static str, &'static str, RunConfig)> {
        match self {
            What::Attention => [("all", "all modules", Knows::All), ("head", "the head alone", Knows::Head)]
                .map(|(name, words, knows)| {
                    let mut config = RunConfig::default();
                    config.env.goal_known_to = knows;
                    (name, words, config)
                })
                .to_vec(),
            What::Ablation => Task::ALL
                .map(|task| {
                    let mut config = RunConfig::default();
                    config.task.name = task;
                    (task.name(), task.title(), config)
                })
                .to_vec(),
        }
    }
}

/// One training run of a comparison.
struct Run {
    folder: PathBuf,
    config: RunConfig,
    panel: usize,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    match &arguments.which {
        Which::Attention(arguments) => compare(What::Attention, arguments),
        Which::Ablation(arguments) => compare(What::Ablation, arguments),
        Which::Paper(arguments) => paper::run(arguments),
        Which::Policies(arguments) => policies::run(arguments),
        Which::Physics(arguments) => physics::run(arguments),
        Which::Robustness(arguments) => robustness::run(arguments),
        Which::Faults(arguments) => faults::run(arguments),
        Which::Imagination(arguments) => imagination::run(arguments),
    }
}

/// Makes a comparison of methods.
fn compare(what: What, arguments: &Comparison) -> Result<()> {
    let folder = arguments.runs.clone().unwrap_or_else(|| Path::new("runs").join(what.name()));
    let out = arguments.out.clone().unwrap_or_else(|| Path::new("host/results").join(what.name()));
    let mut runs = Vec::new();
    for seed in 1..=arguments.seeds {
        for (panel, (name, _, config)) in what.panels().into_iter().enumerate() {
            for method in what.methods() {
                let mut config = config.clone();
                config.train.method = method;
                config.train.seed = seed;
                let longer = if config.task.name == Task::BlockPushing { 2 } else { 1 };
                config.train.total_steps = arguments.steps.saturating_mul(longer);
                config.train.evaluate_every = (config.train.total_steps / 10).max(1);
                if what == What::Ablation {
                    // Short runs, at the rate of the shipped policies.
                    config.train.learning_rate = 7e-4;
                }
                config.train.evaluation_episodes = CURVE_EPISODES;
                runs.push(Run { folder: folder.join(format!("{method}-{name}-{seed}")), config, panel });
            }
        }
    }
    // The long ones last.
    runs.sort_by_key(|run| run.config.train.total_steps);
    if arguments.so_far {
        let all = runs.len();
        runs.retain(|run| run.folder.join(RESULT_FILE).exists());
        if runs.is_empty() {
            bail!("none of the {all} runs in {} is done: without --so-far they are trained", folder.display());
        }
        println!("{} of {all} runs are done\n", runs.len());
    }
    create_folder(&out)?;
    if !arguments.so_far && !finish_all(what, &runs, arguments)? {
        bail!("stopped; the same command goes on from here");
    }
    publish(what, &runs, &out)?;
    if what == What::Ablation {
        for task in [Task::GoalReaching, Task::WallClimbing, Task::TubeCrossing] {
            let complete = |run: &&Run| run.config.task.name == task && run.config.train.method == Method::Composer;
            let Some(run) = runs.iter().find(complete) else { continue };
            let (config, policy) = load_run(&run.folder)?;
            let path = out.join(format!("attention-{task}.svg"));
            attention_maps::write(&config, &*policy.policy(), &path)?;
        }
    }
    let seeds = if arguments.so_far { "those".into() } else { arguments.seeds.to_string() };
    println!("\nmean and standard error over {seeds} seeds; written to {}", out.display());
    Ok(())
}

/// Trains and evaluates all runs, some at a time. False: interrupted.
fn finish_all(what: What, runs: &[Run], arguments: &Comparison) -> Result<bool> {
    let folders: Vec<&Path> = runs.iter().map(|run| &*run.folder).collect();
    side_by_side(&folders, arguments.jobs, |number, threads| finish(what, &runs[number], arguments.episodes, threads))
}

/// Trains and evaluates a run on `threads` threads unless that is done; interrupted, it leaves the rest to the next time.
fn finish(what: What, run: &Run, episodes: u64, threads: usize) -> Result<()> {
    let result = run.folder.join(RESULT_FILE);
    begun(&run.folder, &run.config)?;
    if result.exists() || !trained(&run.folder, &run.config, threads)? {
        return Ok(());
    }
    let (config, policy) = load_run(&run.folder)?;
    let env = Arc::new(config.evaluation());
    let trial = Trial { config: &env, episodes: episodes as usize, seed: PUBLISHED_SEED, faults: &healthy, threads };
    let runs = policy.policy();
    let mut results = serde_json::Map::new();
    for (fault, _) in what.faults() {
        let plan: composer_sim_bridge::faults::FaultPlan =
            fault.parse().with_context(|| format!("the fault {fault}"))?;
        let draw = |seed, modules| plan.draw(seed, modules);
        let report = Trial { faults: &draw, ..trial }.evaluate(&*runs, fault, &|| {});
        results.insert(fault.into(), serde_json::to_value(report)?);
    }
    write_whole(&result, serde_json::to_string_pretty(&results)?.as_bytes())
}

/// Success at each evaluation of a run: (environment steps, share).
fn curve(metrics: &[Value]) -> Vec<(f64, f64)> {
    let evaluations = metrics
        .iter()
        .filter_map(|line| Some((line["global_step"].as_f64()?, line["evaluation/success_rate"].as_f64()?)));
    std::iter::once((0.0, 0.0)).chain(evaluations).collect()
}

/// Mean of a metric over the last tenth of a run; none if it has no such metric.
fn at_the_end(metrics: &[Value], key: &str) -> Option<f64> {
    let last = metrics.len().div_ceil(10);
    let values: Vec<f64> = metrics[metrics.len() - last..].iter().filter_map(|line| line[key].as_f64()).collect();
    (!values.is_empty()).then(|| mean_and_error(&values).0)
}

/// Mean and standard error.
fn spread(values: &[f64], digits: usize) -> String {
    let (mean, se) = mean_and_error(values);
    format!("{mean:.digits$} +- {se:.digits$}")
}

/// Figure, table and data.
fn publish(what: What, runs: &[Run], out: &Path) -> Result<()> {
    let mut figure = Vec::new();
    let mut data = Vec::new();
    let faults = what.faults();
    let headings: Vec<&str> = faults.iter().map(|(_, heading)| *heading).collect();
    let rule = "---|".repeat(headings.len() + 3);
    let mut table = format!("| {} | method | {} | steps |\n|{rule}\n", what.panels_are(), headings.join(" | "));
    let mut following = String::new();
    for (panel, (_, words, _)) in what.panels().into_iter().enumerate() {
        let mut series = Vec::new();
        for (colour, method) in what.methods().into_iter().enumerate() {
            let of: Vec<&Run> = runs.iter().filter(|r| r.panel == panel && r.config.train.method == method).collect();
            if of.is_empty() {
                continue;
            }
            let logs = of.iter().map(|r| metrics(&r.folder)).collect::<Result<Vec<_>>>()?;
            let curves: Vec<_> = logs.iter().map(|log| curve(log)).collect();
            let mut mean = mean_and_se(&curves, &common_grid(&curves, 11));
            mean.name = method.name().into();
            mean.colour = colour;
            series.push(mean);
            let mut results = Vec::new();
            let mut imagined = [Vec::new(), Vec::new()];
            for ((run, log), curve) in of.iter().zip(&logs).zip(&curves) {
                let [earned, missed] = IMAGINATION.map(|key| at_the_end(log, key));
                imagined[0].extend(earned);
                imagined[1].extend(missed);
                let text = std::fs::read(run.folder.join(RESULT_FILE))?;
                let result: Value = serde_json::from_slice(&text)?;
                data.push(json!({
                    "method": method.name(), what.panels_are(): words, "seed": run.config.train.seed,
                    "environment_steps": run.config.train.total_steps, "curve": curve, "final": result,
                    IMAGINATION[0]: earned, IMAGINATION[1]: missed,
                }));
                results.push(result);
            }
            let column = |fault: &str, key: &str, digits: usize| {
                let values: Vec<f64> = results.iter().filter_map(|r| r[fault][key].as_f64()).collect();
                spread(&values, digits)
            };
            let success: Vec<String> = faults.iter().map(|(fault, _)| column(fault, "success_rate", 2)).collect();
            let steps = column("none", "steps_mean", 1);
            writeln!(table, "| {words} | {method} | {} | {steps} |", success.join(" | "))?;
            if imagined.iter().all(|values| !values.is_empty()) {
                let [earned, missed] = imagined.map(|values| spread(&values, 3));
                writeln!(following, "| {words} | {method} | {earned} | {missed} |")?;
            }
        }
        let axes = Axes {
            title: if what == What::Attention { format!("Goal known to {words}") } else { words.into() },
            x_label: "environment steps".into(),
            y_label: "success rate".into(),
            x_range: None,
            y_range: Some((0.0, 1.0)),
        };
        figure.push(Panel { axes, series });
    }
    if !following.is_empty() {
        let bound = RunConfig::default().train.imagination.bound;
        write!(
            table,
            "\nImagination policies in the last tenth of training; units a control step, the imagined step is at most {bound} long:\n\n\
             | {} | method | comes nearer by | missed by the modules by |\n|---|---|---|---|\n{following}",
            what.panels_are()
        )?;
    }
    write_whole(&out.join("learning-curves.svg"), panels(&figure).as_bytes())?;
    write_whole(&out.join("runs.json"), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join("table.md"), table.as_bytes())?;
    print!("{table}");
    Ok(())
}
