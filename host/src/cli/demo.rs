//! `snakectl` without a verb: the whole on the simulated bus, with a module unplugged on the way.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result};
use composer_sim_bridge::faults::FaultPlan;

use super::PolicySource;
use super::eval::Common;
use super::sil::{BusOptions, BusReport, BusTrial, REPLAYED, write_replay};

/// Arguments of the demonstration.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Episodes of each row of the table
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Seed of the episodes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The page to look at afterwards
    #[arg(long, value_name = "FILE", default_value = "demonstration.html")]
    replay: PathBuf,
}

/// Runs the demonstration.
pub fn run(arguments: &Arguments) -> Result<()> {
    let name = "goal-reaching";
    let source = PolicySource::load(name)?;
    let PolicySource::Image(image) = &source else { anyhow::bail!("{name} ships as an image") };
    let config = Arc::new(source.environment(None)?);
    println!(
        "{} modules, each running the frozen {name} policy ({} bytes) in its own controller, on a simulated CAN-FD bus (1M/5M).\n",
        config.robot.modules,
        image.len()
    );
    println!(
        "{:<28} {:>14} {:>14} {:>16} {:>9} {:>10}",
        "", "success", "distance/units", "control steps", "bus load", "real time"
    );
    let rows = [
        ("all modules", "none"),
        ("one unplugged on the way", "unplug:1"),
        ("two unplugged on the way", "unplug:2"),
        ("the head unplugged at 1 s", "unplug:#0@1s"),
        ("5 % of frames lost", "drop:0.05"),
    ];
    let mut to_replay = Vec::new();
    for (label, fault) in rows {
        let fault: FaultPlan = fault.parse().with_context(|| format!("the fault {fault}"))?;
        let common = Common {
            policy: name.into(),
            episodes: arguments.episodes,
            modules: None,
            robot: None,
            fault,
            seed: arguments.seed,
            json: false,
            threads: None,
        };
        let bus = BusOptions::default();
        let record = if label.starts_with("one") { REPLAYED } else { 0 };
        let trial =
            BusTrial { config: config.clone(), image, common: &common, bus: &bus, record, qemu: None, parity: false };
        let bar = common.bar();
        let (report, recorded) = trial.run(None, &|| bar.inc(1))?;
        bar.finish_and_clear();
        println!("{}", row(label, &report));
        to_replay.extend(recorded);
    }
    write_replay(&config, to_replay, name, &arguments.replay)?;
    println!(
        "\n{} episodes a row; mean and standard error. {} shows the first with a module unplugged: open it in any browser.",
        arguments.episodes,
        arguments.replay.display()
    );
    Ok(())
}

fn row(label: &str, report: &BusReport) -> String {
    let task = &report.task;
    format!(
        "{label:<28} {:>6.2} +- {:.2} {:>6.2} +- {:.2} {:>7.1} +- {:<4.1} {:>7.1} % {:>8.0} x",
        task.success_rate,
        task.success_rate_se,
        task.distance_mean,
        task.distance_se,
        task.steps_mean,
        task.steps_se,
        100.0 * report.bus_load,
        report.realtime_factor
    )
}
