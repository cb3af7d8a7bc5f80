//! `snakectl campaign`: random schedules of faults, rules that must hold, and the smallest schedule for each that does not.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::Mutex;

use anyhow::{Context, Result, bail};
use composer_shared::policy::Policy;
use composer_sim_bridge::computer::InProcess;
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

use crate::campaign::{Broken, Campaign, Schedule};
use crate::eval::{DEFAULT_SEED, parallel};
use crate::files::{create_folder, write_whole};
use crate::policy_source::PolicySource;
use crate::robot::Robot;
use crate::shard::Shard;
use crate::train::Signals;

/// Schedules between two looks at whether somebody wants to stop.
const BATCH: usize = 64;

/// Arguments of `campaign`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// A policy image or the name of a shipped policy
    #[arg(default_value = "goal-reaching")]
    policy: String,
    /// Schedules in all
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    schedules: u64,
    /// Seed of the campaign
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// Modules of the snake [default: the robot's]
    #[arg(long)]
    modules: Option<usize>,
    /// Run part I of N of the schedules, I from 1
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// What has been run, one line a schedule; the same command goes on from there [default: runs/campaign.jsonl, of a shard runs/campaign-I-of-N.jsonl]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Put the files of shards together: the result is that of one process
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "shard", requires = "out")]
    merge: Vec<PathBuf>,
    /// Run this one schedule, as a campaign printed it
    #[arg(long, value_name = "TEXT", conflicts_with_all = ["merge", "shard", "out"], requires = "number")]
    schedule: Option<Schedule>,
    /// The number that it was drawn with
    #[arg(long)]
    number: Option<u64>,
    /// Write all frames of that schedule, as a candump log
    #[arg(long, value_name = "FILE", requires = "schedule")]
    capture: Option<PathBuf>,
    /// Threads [default: one a core]; the result does not depend on it
    #[arg(long)]
    threads: Option<usize>,
}

/// A line of the file: a schedule that has been run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    number: u64,
    /// What makes it break a rule, and how, if it does: the smallest schedule found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    broken: Option<Found>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Found {
    #[serde(flatten)]
    broken: Broken,
    schedule: String,
    items: usize,
}

/// What a file is of; its first line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Heading {
    policy: String,
    crc32: String,
    seed: u64,
    modules: usize,
    schedules: u64,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let source = PolicySource::load(&arguments.policy)?;
    let image = source
        .image()
        .with_context(|| format!("{} is no policy image: a campaign tests what is flashed", arguments.policy))?;
    let robot = arguments.modules.map(|modules| Robot::default().with_modules(modules)).transpose()?;
    let config = Arc::new(source.environment(None, robot.as_ref())?);
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let launcher = InProcess::new(policy);
    let campaign = Campaign { config: config.clone(), policy, launcher: &launcher, seed: arguments.seed };
    if let (Some(schedule), Some(number)) = (&arguments.schedule, arguments.number) {
        schedule.check(config.robot.modules)?;
        let mut log = arguments.capture.as_ref().map(|_| Vec::new());
        let broken = campaign.run_captured(schedule, number, log.as_mut().map(|log| log as &mut dyn Write))?;
        if let (Some(path), Some(log)) = (&arguments.capture, log) {
            write_whole(path, &log)?;
        }
        return match broken {
            None => {
                println!("no rule is broken");
                Ok(())
            }
            Some(broken) => bail!("{}: {}", broken.rule, broken.what),
        };
    }
    let heading = Heading {
        policy: arguments.policy.clone(),
        crc32: format!("{:08x}", policy.crc()),
        seed: arguments.seed,
        modules: config.robot.modules,
        schedules: arguments.schedules,
    };
    let out = match (&arguments.out, arguments.shard) {
        (Some(out), _) => out.clone(),
        (None, None) => PathBuf::from("runs/campaign.jsonl"),
        (None, Some(Shard { index, of })) => PathBuf::from(format!("runs/campaign-{index}-of-{of}.jsonl")),
    };
    if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        create_folder(folder)?;
    }
    let lines = if arguments.merge.is_empty() {
        work(&campaign, &heading, &out, arguments)?
    } else {
        let mut lines = Vec::new();
        for file in &arguments.merge {
            lines.extend(read(file, &heading)?.with_context(|| format!("there is no file {}", file.display()))?);
        }
        write_whole(&out, text(&heading, &mut lines)?.as_bytes())?;
        lines
    };
    report(&lines, arguments, &out)
}

/// Runs what is not done yet.
fn work(campaign: &Campaign<InProcess>, heading: &Heading, out: &Path, arguments: &Arguments) -> Result<Vec<Line>> {
    let mut lines = read(out, heading)?.unwrap_or_default();
    let done: BTreeSet<u64> = lines.iter().map(|line| line.number).collect();
    let shard = arguments.shard.unwrap_or(Shard::WHOLE);
    let left: Vec<u64> = shard.select(0..arguments.schedules).filter(|number| !done.contains(number)).collect();
    let bar = ProgressBar::new(left.len() as u64);
    if let Ok(style) = ProgressStyle::with_template("{msg} [{bar:40}] {pos}/{len} schedules, {eta} left") {
        bar.set_style(style);
    }
    let stop = Signals::new()?;
    let mut file = std::fs::OpenOptions::new()
        .create(true)
        .append(true)
        .open(out)
        .with_context(|| format!("cannot write {}", out.display()))?;
    if lines.is_empty() && file.metadata()?.len() == 0 {
        writeln!(file, "{}", serde_json::to_string(heading)?)?;
    }
    let file = Mutex::new(file);
    let threads = arguments.threads.unwrap_or_else(super::cores);
    for batch in left.chunks(BATCH) {
        if stop.raised() {
            bail!("stopped; the same command goes on from here: {}", out.display());
        }
        let found = parallel(batch.len(), threads, |index| -> Result<Line> {
            let number = batch[index];
            let schedule = campaign.schedule(number);
            let broken = match campaign.run(&schedule, number)? {
                None => None,
                Some(broken) => {
                    let (schedule, broken) = campaign.shrink(&schedule, number, &broken)?;
                    Some(Found { broken, items: schedule.items.len(), schedule: schedule.to_string() })
                }
            };
            bar.inc(1);
            Ok(Line { number, broken })
        });
        // A batch goes into the file as a whole, and in order.
        let found = found.into_iter().collect::<Result<Vec<_>>>()?;
        let mut text = String::new();
        for line in &found {
            writeln!(text, "{}", serde_json::to_string(line)?)?;
        }
        file.lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .write_all(text.as_bytes())
            .with_context(|| format!("cannot write {}", out.display()))?;
        lines.extend(found);
    }
    bar.finish_and_clear();
    Ok(lines)
}

/// The file as one process writes it.
fn text(heading: &Heading, lines: &mut Vec<Line>) -> Result<String> {
    lines.sort_by_key(|line| line.number);
    lines.dedup();
    let mut text = serde_json::to_string(heading)? + "\n";
    for line in lines {
        writeln!(text, "{}", serde_json::to_string(line)?)?;
    }
    Ok(text)
}

/// What a file holds; none if there is none. A last line that was cut off is left out, and run again.
fn read(path: &Path, heading: &Heading) -> Result<Option<Vec<Line>>> {
    let Ok(text) = std::fs::read_to_string(path) else { return Ok(None) };
    let Some((first, rest)) = text.split_once('\n') else {
        bail!("{} is no campaign: its first line is missing", path.display())
    };
    let of: Heading = serde_json::from_str(first).with_context(|| format!("{} is no campaign", path.display()))?;
    if of != *heading {
        bail!(
            "{} is of another campaign ({first}): choose another file, or the same policy, seed, modules and schedules",
            path.display()
        );
    }
    let mut lines = Vec::new();
    for (number, line) in rest.split_inclusive('\n').enumerate() {
        match serde_json::from_str(line) {
            Ok(line) => lines.push(line),
            Err(_) if !line.ends_with('\n') => {
                write_whole(path, &text.as_bytes()[..text.len() - line.len()])?;
            }
            Err(error) => bail!("line {} of {} is damaged: {error}", number + 2, path.display()),
        }
    }
    Ok(Some(lines))
}

/// What was found.
fn report(lines: &[Line], arguments: &Arguments, out: &Path) -> Result<()> {
    let broken: Vec<(&u64, &Found)> =
        lines.iter().filter_map(|line| Some((&line.number, line.broken.as_ref()?))).collect();
    let rules: BTreeSet<&str> = broken.iter().map(|(_, found)| &*found.broken.rule).collect();
    for rule in rules {
        let of: Vec<_> = broken.iter().filter(|(_, found)| found.broken.rule == rule).collect();
        println!("{rule}: {} schedules", of.len());
        // The shortest say most.
        let mut shortest = of.clone();
        shortest.sort_by_key(|(number, found)| (found.items, found.schedule.len(), **number));
        for (number, found) in shortest.into_iter().take(3) {
            println!("  {}", found.broken.what);
            let modules = arguments.modules.map_or(String::new(), |modules| format!(" --modules {modules}"));
            println!(
                "    snakectl campaign {} --seed {}{modules} --number {number} --schedule '{}'",
                arguments.policy, arguments.seed, found.schedule
            );
            let modules = arguments.modules.unwrap_or(Robot::default().modules);
            println!(
                "    to keep it, for tests/campaign/corpus.txt: {} {} {modules} {number} {}",
                arguments.policy, arguments.seed, found.schedule
            );
        }
    }
    println!("{} schedules, {} break a rule: {}", lines.len(), broken.len(), out.display());
    if !broken.is_empty() {
        bail!("rules are broken by {} of {} schedules", broken.len(), lines.len());
    }
    Ok(())
}
