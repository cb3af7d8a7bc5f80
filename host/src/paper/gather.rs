//! Everything that outputs of a comparison hold, read and checked: nothing is computed anew, so that one output and its parts give the same bytes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use composer_shared::policy::Task;
use serde::Serialize;
use serde_json::Value;

use super::measure::{Attended, Cell, Measured, Point, kept};
use super::work::{Progress, attends, policy_digest, progress, robust, robust_name};
use super::{Comparison, Run};
use crate::plot::mean_and_error;
use crate::run_folder::{load_run, metrics};
use crate::stats::{Line, weighted_line};

/// Share of a run at whose end the slope of its curve is taken.
const LAST: f64 = 0.2;
/// Metrics of the imagination policy: its reward, and how far the modules are from where it wanted them.
const IMAGINATION: [&str; 2] = ["imagination/reward", "imagination/follow_error"];

/// What came of a policy.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// The task.
    pub task: TaskName,
    /// Method, or `robust` for the policy that ships.
    pub method: String,
    /// Seed of its run; 0 for the policy that ships.
    pub seed: u64,
    /// Whether it was trained with tuned settings.
    pub tuned: bool,
    /// Environment steps that it was trained for; 0 if the run is not part of the comparison.
    pub environment_steps: u64,
    /// Learning curve: environment steps and success, on episodes that are the run's own.
    pub curve: Vec<(f64, f64)>,
    /// Success of the training's own episodes, with their noise, in the last fifth of the run: at its end, and how much it rose in 100,000 steps.
    pub end: Option<Line>,
    /// Of the imagination policy in the last tenth of the run, in units a control step: by how much nearer to the goal it imagines the modules, and by how much they miss
    /// where it imagines them.
    pub imagined: Option<[f64; 2]>,
    /// The points of the tables, by their names.
    pub cells: BTreeMap<String, Cell>,
    /// Why there is nothing on the bus, if there is not.
    pub not_on_the_bus: Option<String>,
    /// Where its modules attended, if that is wanted and an episode succeeded.
    pub attention: Option<Attended>,
    /// An episode for the replay page.
    #[serde(skip)]
    pub replay: Option<String>,
}

/// A task, by its name in files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskName(pub Task);

impl Serialize for TaskName {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.0.name())
    }
}

impl Outcome {
    /// A cell of a table.
    pub fn cell(&self, point: Point) -> Option<&Cell> {
        self.cells.get(&point.to_string())
    }
}

/// Everything that is known of a comparison.
#[derive(Clone, Debug)]
pub struct Results {
    /// What is compared.
    pub comparison: Comparison,
    /// Episodes of a point.
    pub episodes: u64,
    /// Runs that there are to be.
    pub wanted: usize,
    /// Those that are there, in their order.
    pub runs: Vec<Outcome>,
    /// The policies that ship.
    pub robust: Vec<Outcome>,
}

/// Learning curve of a run: environment steps and success of each evaluation.
fn curve(metrics: &[Value]) -> Vec<(f64, f64)> {
    let evaluations = metrics
        .iter()
        .filter_map(|line| Some((line["global_step"].as_f64()?, line["evaluation/success_rate"].as_f64()?)));
    std::iter::once((0.0, 0.0)).chain(evaluations).collect()
}

/// Success of the training's own episodes at the end of a run, and its slope; none without episodes.
fn end(metrics: &[Value]) -> Option<Line> {
    let last = metrics.last()?["global_step"].as_f64()?;
    let points = metrics.iter().filter_map(|line| {
        let at = (line["global_step"].as_f64()? - last) / 1e5;
        let episodes = line["charts/episodes"].as_f64()?;
        Some((at, line["charts/success_rate"].as_f64()?, episodes))
    });
    weighted_line(&points.filter(|point| point.0 >= -LAST * last / 1e5).collect::<Vec<_>>())
}

/// Mean of a metric over the last tenth of a run; none if it has no such metric.
fn at_the_end(metrics: &[Value], key: &str) -> Option<f64> {
    let last = metrics.len().div_ceil(10);
    let values: Vec<f64> = metrics[metrics.len() - last..].iter().filter_map(|line| line[key].as_f64()).collect();
    (!values.is_empty()).then(|| mean_and_error(&values).0)
}

/// What the imagination policy came to, if there is one.
fn imagined(metrics: &[Value]) -> Option<[f64; 2]> {
    let [reward, missed] = IMAGINATION.map(|key| at_the_end(metrics, key));
    Some([reward?, missed?])
}

/// The output that holds a run to its end, if one does.
fn found<'a>(run: &Run, outs: &'a [PathBuf]) -> Result<Option<&'a Path>> {
    let mut holds: Option<(&Path, String)> = None;
    for out in outs {
        if progress(run, out)? == Progress::Trained {
            let digest = policy_digest(&run.folder(out))?;
            match &holds {
                Some((other, of_other)) if *of_other != digest => bail!(
                    "{} and {} hold different policies of the run {}; merge outputs of one comparison",
                    other.display(),
                    out.display(),
                    run.name
                ),
                Some(_) => {}
                None => holds = Some((out, digest)),
            }
        }
    }
    Ok(holds.map(|(out, _)| out))
}

/// Reads all outputs. What is missing or half written is left out `so_far`, else refused.
///
/// # Errors
///
/// If an output is of other settings or damaged, if two disagree, or if something is missing that must not be.
pub fn gather(comparison: &Comparison, outs: &[PathBuf], episodes: u64, so_far: bool) -> Result<Results> {
    if let Some(out) = outs.iter().find(|out| !out.is_dir()) {
        bail!("there is no folder {}", out.display());
    }
    let runs = comparison.runs()?;
    let words: Vec<String> = outs.iter().map(|out| out.display().to_string()).collect();
    let mut results =
        Results { comparison: comparison.clone(), episodes, wanted: runs.len(), runs: Vec::new(), robust: Vec::new() };
    for run in &runs {
        let Some(out) = found(run, outs)? else {
            if so_far {
                continue;
            }
            let begun = outs.iter().find(|out| matches!(progress(run, out), Ok(Progress::Begun)));
            match begun {
                Some(out) => bail!(
                    "{} is half written: the command that began it goes on with it (--so-far publishes without it)",
                    run.folder(out).display()
                ),
                None => bail!("{} holds no run {} (--so-far publishes without it)", words.join(" or "), run.name),
            }
        };
        let folder = run.folder(out);
        let (config, policy) = load_run(&folder)?;
        let log = metrics(&folder)?;
        let env = config.evaluation();
        let rows = kept(&folder)?;
        let measured = Measured { rows: &rows, digest: &policy_digest(&folder)?, env: &env, episodes };
        let not_on_the_bus = policy.runs_on_modules().err().map(|why| why.to_string());
        let attends = attends(run);
        let mut outcome = Outcome {
            task: TaskName(run.task()),
            method: run.method().name().into(),
            seed: run.seed(),
            tuned: run.tuned,
            environment_steps: config.train.total_steps,
            curve: curve(&log),
            end: end(&log),
            imagined: imagined(&log),
            cells: BTreeMap::new(),
            not_on_the_bus,
            attention: measured.found_attention().filter(|_| attends).flatten(),
            replay: measured.found_replay(),
        };
        let complete = read_cells(&measured, &run.points(), &mut outcome);
        let attended = !attends || measured.found_attention().is_some();
        let measured = complete && attended && outcome.replay.is_some();
        if !so_far && !measured {
            bail!(
                "{} is half written: it is not measured with {episodes} episodes yet; the command that began it goes on with it (--so-far \
                 publishes without it)",
                folder.display()
            );
        }
        results.runs.push(outcome);
    }
    for &task in &comparison.tasks {
        let (env, _, digest) = robust(task)?;
        let mut outcome = Outcome {
            task: TaskName(task),
            method: "robust".into(),
            seed: 0,
            tuned: false,
            environment_steps: 0,
            curve: Vec::new(),
            end: None,
            imagined: None,
            cells: BTreeMap::new(),
            not_on_the_bus: None,
            attention: None,
            replay: None,
        };
        let mut complete = false;
        for out in outs.iter().map(|out| out.join(robust_name(task))).filter(|out| out.is_dir()) {
            let rows = kept(&out)?;
            let measured = Measured { rows: &rows, digest: &digest, env: &env, episodes };
            complete |= read_cells(&measured, &Point::all(task), &mut outcome);
            outcome.replay = outcome.replay.take().or(measured.found_replay());
        }
        if !complete && !so_far {
            bail!(
                "{} holds no measurement of the policy of {task} that ships with {episodes} episodes (--so-far publishes without it)",
                words.join(" or ")
            );
        }
        results.robust.push(outcome);
    }
    Ok(results)
}

/// Reads all points that have been measured; whether none is missing.
fn read_cells(measured: &Measured, points: &[Point], outcome: &mut Outcome) -> bool {
    let mut complete = true;
    for point in points {
        match measured.found(*point) {
            Some(cell) => drop(outcome.cells.insert(point.to_string(), cell)),
            None => complete &= point.bus && outcome.not_on_the_bus.is_some(),
        }
    }
    complete
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_slope_is_that_of_the_last_fifth() {
        let line = |step: u64, success: Option<f64>, episodes: u64| json!({"global_step": step, "charts/success_rate": success, "charts/episodes": episodes});
        // Steep at first, then .1 in 100,000 steps; an iteration without episodes says nothing.
        let mut lines: Vec<Value> = (1..=8).map(|k| line(k * 100_000, Some(0.1 * k as f64), 10)).collect();
        lines.extend([line(850_000, Some(0.84), 7), line(900_000, None, 0), line(1_000_000, Some(0.99), 20)]);
        let Line { end, slope } = end(&lines).unwrap();
        assert!((slope - 0.1).abs() < 0.01 && (end - 0.99).abs() < 0.01, "{end} {slope}");
        assert_eq!(super::end(&[]), None);
    }
}
