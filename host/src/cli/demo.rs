//! `snakectl` without a verb: every policy that ships, on the simulated bus, with a module unplugged on the way. `snakectl demo TASK`: one of
//! them in more detail.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::policies;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::FaultPlan;

use super::common::{REPLAYED, episode_bar, write_replay};
use super::task_by_name;
use crate::bus_trial::{BusReport, BusSettings, BusTrial, Written};
use crate::env::EnvConfig;
use crate::eval::DEFAULT_SEED;
use crate::policy_source::PolicySource;
use crate::replay::Episode;
use crate::stats::with_interval;
use crate::vary::{self, Variation};

/// Arguments of the demonstration.
#[derive(clap::Args, Clone, Debug)]
// `demo` has them beside its own: clap refuses two groups of one name in a build with debug assertions.
#[group(skip)]
pub struct Arguments {
    /// Episodes of each row of the table
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Seed of the episodes
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// The page to look at afterwards
    #[arg(long, value_name = "FILE", default_value = "demonstration.html")]
    replay: PathBuf,
}

/// Arguments of `demo`.
#[derive(clap::Args, Clone, Debug)]
pub struct OneTask {
    /// goal-reaching, block-pushing, shape-formation, tube-crossing or wall-climbing
    #[arg(value_parser = task_by_name)]
    task: Task,
    #[command(flatten)]
    arguments: Arguments,
}

/// A row of the table for one task: what it is called, what goes wrong, and whether every episode has another robot and floor ([`vary::LAB`]).
type Row = (&'static str, &'static str, bool);

/// The rows of the table for one task; the first three are those of the table of all.
const ROWS: [Row; 6] = [
    ("all modules", "none", false),
    ("one unplugged on the way", "unplug:1", false),
    ("another robot and floor", "none", true),
    ("two unplugged on the way", "unplug:2", false),
    ("the head unplugged at 1 s", "unplug:#0@1s", false),
    ("5 % of frames lost", "drop:0.05", false),
];

/// A shipped policy and the environment it is made for.
struct Shipped {
    name: &'static str,
    image: &'static [u8],
    config: Arc<EnvConfig>,
}

impl Shipped {
    fn new(name: &'static str) -> Result<Self> {
        let Some(image) = policies::shipped(name) else {
            bail!("no policy for {name} ships with this version; these do: {}", policies::NAMES.join(", "));
        };
        let config = Arc::new(PolicySource::load(name)?.environment(None, None)?);
        Ok(Shipped { name, image, config })
    }

    /// Runs the episodes of a row; the first `record` of them are recorded.
    fn run(&self, arguments: &Arguments, (_, fault, varied): Row, record: usize) -> Result<(BusReport, Vec<Episode>)> {
        let fault: FaultPlan = fault.parse().with_context(|| format!("the fault {fault}"))?;
        let mut config = self.config.clone();
        if varied {
            Arc::make_mut(&mut config).vary = Variation::from_toml(vary::LAB).map_err(anyhow::Error::msg)?;
        }
        let trial = BusTrial {
            config,
            image: self.image,
            episodes: arguments.episodes as usize,
            seed: arguments.seed,
            fault: &fault,
            bus: BusSettings::default(),
            physics: String::new(),
            threads: super::cores(),
            record,
            qemu: None,
            parity: false,
            elsewhere: None,
        };
        let bar = episode_bar(self.name, arguments.episodes);
        let result = trial.run(&Written::default(), &|| bar.inc(1));
        bar.finish_and_clear();
        result
    }
}

/// Runs the demonstration of all tasks.
pub fn run(arguments: &Arguments) -> Result<()> {
    let shipped = policies::NAMES.into_iter().map(Shipped::new).collect::<Result<Vec<_>>>()?;
    let Some(first) = shipped.first() else { bail!("no policy ships with this version") };
    println!(
        "{} modules, each running the frozen policy of the task in its own controller, on a simulated CAN-FD bus (1M/5M).\n",
        first.config.robot.modules
    );
    header();
    let mut to_replay = Vec::new();
    for policy in &shipped {
        for shown in &ROWS[..3] {
            let (label, fault, varied) = *shown;
            let (report, recorded) = policy.run(arguments, *shown, usize::from(fault != "none" || varied))?;
            println!("{}", row(&format!("{}, {label}", policy.name), &report));
            to_replay.extend(recorded);
        }
    }
    write_replay(&first.config, "COMPOSER on the simulated bus", to_replay, "all that ship", &arguments.replay)?;
    footer(arguments, first.config.cap(), "an episode of every task with a module unplugged, and one on another robot");
    Ok(())
}

/// Runs the demonstration of one task.
pub fn run_one(one: &OneTask) -> Result<()> {
    let (policy, arguments) = (Shipped::new(one.task.name())?, &one.arguments);
    println!(
        "{} modules, each running the frozen {} policy ({} bytes) in its own controller, on a simulated CAN-FD bus (1M/5M).\n",
        policy.config.robot.modules,
        policy.name,
        policy.image.len()
    );
    header();
    let mut to_replay = Vec::new();
    for shown in ROWS {
        let (label, fault, _) = shown;
        let (report, recorded) = policy.run(arguments, shown, if fault == "unplug:1" { REPLAYED } else { 0 })?;
        println!("{}", row(label, &report));
        to_replay.extend(recorded);
    }
    let title = format!("{} on the simulated bus", one.task.title());
    write_replay(&policy.config, &title, to_replay, policy.name, &arguments.replay)?;
    footer(arguments, policy.config.cap(), "the first episodes with a module unplugged");
    Ok(())
}

fn header() {
    println!(
        "{:<42} {:>17} {:>14} {:>16} {:>9} {:>10}",
        "", "success", "distance/units", "control steps", "bus load", "real time"
    );
}

fn footer(arguments: &Arguments, cap: u32, shown: &str) {
    println!(
        "\n{} episodes a row; success with its 95 % interval (Wilson), the others with their standard error; at most {} control steps. {} shows {shown}: open it in any browser.",
        arguments.episodes,
        cap,
        arguments.replay.display()
    );
}

fn row(label: &str, report: &BusReport) -> String {
    let task = &report.task;
    format!(
        "{label:<42} {:>17} {:>6.2} +- {:.2} {:>7.1} +- {:<4.1} {:>7.1} % {:>8.0} x",
        with_interval(task.success_rate, task.success_low, task.success_high, 2),
        task.distance_mean,
        task.distance_se,
        task.steps_mean,
        task.steps_se,
        100.0 * report.bus_load,
        report.realtime_factor
    )
}
