//! A bounded study: can an imagination policy help? Variants of it, one by one, against none, on the tasks where the paper finds it ahead; eight healthy
//! modules, several seeds, every run published.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::policy::Task;
use serde::{Deserialize, Serialize};

use crate::eval::{PUBLISHED_SEED, Trial, healthy};
use crate::files::write_whole;
use crate::methods::Method;
use crate::plot::mean_and_error;
use crate::run::RunConfig;
use crate::run_folder::{begun, load_run, trained};
use crate::side_by_side::side_by_side;
use crate::tasks::Reward;

/// Tasks where the paper finds imagination ahead.
pub const TASKS: [Task; 3] = [Task::ShapeFormation, Task::TubeCrossing, Task::WallClimbing];

/// A way to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// In folders.
    pub name: &'static str,
    /// In tables.
    pub words: &'static str,
    /// What it is compared with, by name; none: it is what others are compared with.
    pub against: Option<&'static str>,
}

/// All variants in the order of the table. From the third on each is the second's with what its words say.
pub const VARIANTS: [Variant; 10] = [
    Variant { name: "without", words: "without imagination", against: None },
    Variant { name: "as-it-is", words: "as it is: a target a step", against: Some("without") },
    Variant {
        name: "held",
        words: "targets held 10 steps, paid for coming nearer, clipped at walls",
        against: Some("without"),
    },
    Variant {
        name: "without-table-one",
        words: "without imagination, the task pays Table I's quantity",
        against: None,
    },
    Variant {
        name: "held-table-one",
        words: "held, the task pays Table I's quantity",
        against: Some("without-table-one"),
    },
    Variant { name: "each", words: "held, every module pays for itself", against: Some("without") },
    Variant {
        name: "own-targets",
        words: "held, imagined by each module's own place (tube and wall have no other)",
        against: Some("without"),
    },
    Variant { name: "feasible", words: "held, imagination pays for what was missed", against: Some("without") },
    Variant { name: "attends", words: "held, the imagination attends", against: Some("without") },
    Variant { name: "told", words: "held, the control policy is told what is imagined", against: Some("without") },
];

impl Variant {
    /// Whether it differs from the others on a task: a module has a place of its own to be imagined at only in these two.
    fn concerns(&self, task: Task) -> bool {
        self.name != "own-targets" || matches!(task, Task::ShapeFormation | Task::BlockPushing)
    }

    /// The settings of a run: the defaults, which are eight healthy modules and nothing varied, at the shipped policies' learning rate.
    pub fn settings(&self, task: Task, seed: u64, steps: u64) -> RunConfig {
        let mut config = RunConfig::default();
        config.task.name = task;
        config.train.seed = seed;
        config.train.total_steps = steps;
        config.train.learning_rate = 7e-4;
        config.train.evaluate_every = 0;
        if self.name.starts_with("without") {
            config.train.method = Method::ComposerNoImagination;
        }
        let imagination = &mut config.train.imagination;
        if !self.name.starts_with("without") && self.name != "as-it-is" {
            (imagination.hold, imagination.bound, imagination.follow) = (10, 3.0, 1.0);
            (imagination.telescope, imagination.clip) = (true, true);
        }
        match self.name {
            "each" => imagination.each = true,
            "own-targets" => imagination.own_targets = true,
            "feasible" => imagination.feasible = 0.5,
            "attends" => imagination.attention = true,
            "told" => imagination.told = true,
            _ => {}
        }
        if self.name.ends_with("table-one") {
            config.task.reward = Reward::Paper;
        }
        config
    }
}

/// A run of the study.
#[derive(Clone, Debug)]
pub struct Run {
    /// Number of the variant.
    pub variant: usize,
    /// The task.
    pub task: Task,
    /// Its folder.
    pub folder: PathBuf,
    /// Its settings.
    pub config: RunConfig,
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// The variant's name.
    pub variant: String,
    /// The task's.
    pub task: String,
    /// Seed.
    pub seed: u64,
    /// Success of the float policy on published episodes.
    pub success: f64,
    /// Control steps, mean.
    pub steps: f64,
    /// Episodes.
    pub episodes: u64,
}

/// All runs, one seed after the other.
pub fn runs(folder: &Path, tasks: &[Task], seeds: u64, steps: u64) -> Vec<Run> {
    let of = |seed: u64| {
        tasks.iter().flat_map(move |&task| {
            VARIANTS.iter().enumerate().filter(move |(_, v)| v.concerns(task)).map(move |(variant, v)| Run {
                variant,
                task,
                folder: folder.join(format!("{}-{task}-{seed}", v.name)),
                config: v.settings(task, seed, steps),
            })
        })
    };
    (1..=seeds).flat_map(of).collect()
}

/// What a run is kept in, in its folder.
const FOUND_FILE: &str = "found.json";

/// What a run came to, if it is done.
pub fn found(run: &Run) -> Result<Option<Found>> {
    let path = run.folder.join(FOUND_FILE);
    match std::fs::read(&path) {
        Ok(text) => Ok(Some(
            serde_json::from_slice(&text).with_context(|| format!("{} is damaged: delete it", path.display()))?,
        )),
        Err(_) => Ok(None),
    }
}

/// Trains and evaluates what is not done, `jobs` runs at a time. False: interrupted, the same call goes on.
pub fn work(runs: &[Run], episodes: u64, jobs: Option<u64>) -> Result<bool> {
    let folders: Vec<&Path> = runs.iter().map(|run| &*run.folder).collect();
    side_by_side(&folders, jobs, |number, threads| {
        let run = &runs[number];
        begun(&run.folder, &run.config)?;
        if found(run)?.is_some_and(|found| found.episodes == episodes) || !trained(&run.folder, &run.config, threads)? {
            return Ok(());
        }
        let (config, policy) = load_run(&run.folder)?;
        let env = Arc::new(config.evaluation());
        let trial =
            Trial { config: &env, episodes: episodes as usize, seed: PUBLISHED_SEED, faults: &healthy, threads };
        let report = trial.evaluate(&*policy.policy(), "none", &|| {});
        let found = Found {
            variant: VARIANTS[run.variant].name.into(),
            task: run.task.name().into(),
            seed: config.train.seed,
            success: report.success_rate,
            steps: report.steps_mean,
            episodes,
        };
        write_whole(&run.folder.join(FOUND_FILE), serde_json::to_string_pretty(&found)?.as_bytes())
    })
}

/// By how much a variant is ahead of what it is compared with: mean and standard error over the pairs of a task and a seed, and their number. None
/// without pairs, and for what is compared with nothing.
pub fn ahead(variant: &Variant, all: &[Found]) -> Option<(f64, f64, usize)> {
    let other = variant.against?;
    let of = |name: &str, like: &Found| {
        all.iter().find(|f| f.variant == name && f.task == like.task && f.seed == like.seed).map(|f| f.success)
    };
    let differences: Vec<f64> = all
        .iter()
        .filter(|found| found.variant == variant.name)
        .filter_map(|found| Some(found.success - of(other, found)?))
        .collect();
    let (mean, error) = mean_and_error(&differences);
    (!differences.is_empty()).then_some((mean, error, differences.len()))
}

/// Whether that is to be adopted: ahead by more than two standard errors.
pub fn wins((mean, error, pairs): (f64, f64, usize)) -> bool {
    pairs > 1 && mean > 2.0 * error
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variant_differs_from_all_others_and_can_be_trained() {
        let settings: Vec<RunConfig> =
            VARIANTS.iter().map(|variant| variant.settings(Task::ShapeFormation, 1, 1000)).collect();
        for (number, config) in settings.iter().enumerate() {
            config.validate().unwrap();
            assert!(settings[..number].iter().all(|other| other != config), "{}", VARIANTS[number].name);
            assert!(config.env.lengths.is_empty() && config.faults.probability == 0.0 && config.vary.is_none());
        }
        for variant in VARIANTS {
            assert!(variant.against.is_none_or(|name| VARIANTS.iter().any(|other| other.name == name)));
        }
        assert_eq!(runs(Path::new("x"), &TASKS, 6, 1000).len(), (10 + 9 + 9) * 6);
    }

    #[test]
    fn a_variant_wins_by_more_than_two_standard_errors_of_the_pairs() {
        let found = |variant: &str, seed, success| Found {
            variant: variant.into(),
            task: "tube-crossing".into(),
            seed,
            success,
            steps: 1.0,
            episodes: 1,
        };
        let mut all =
            vec![found("without", 1, 0.5), found("without", 2, 0.7), found("held", 1, 0.6), found("held", 2, 0.8)];
        let held = VARIANTS.iter().find(|variant| variant.name == "held").unwrap();
        let (mean, error, pairs) = ahead(held, &all).unwrap();
        assert!((mean - 0.1).abs() < 1e-12 && error < 1e-12 && pairs == 2 && wins((mean, error, pairs)));
        all[3].success = 0.6;
        assert!(!wins(ahead(held, &all).unwrap()));
        // A seed whose other half is missing does not count.
        all.push(found("held", 3, 1.0));
        assert_eq!(ahead(held, &all).unwrap().2, 2);
        assert_eq!((ahead(&VARIANTS[0], &all), ahead(&VARIANTS[8], &all)), (None, None));
    }
}
