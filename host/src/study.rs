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
use crate::tasks::{Reward, task_name};

/// Tasks where the paper finds imagination ahead.
pub const TASKS: [Task; 3] = [Task::ShapeFormation, Task::TubeCrossing, Task::WallClimbing];

/// A way to train. From [`Variant::Each`] on each is [`Variant::Held`] with what its words say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// No imagination policy.
    Without,
    /// As the methods have it by default.
    AsItIs,
    /// Targets of several steps.
    Held,
    /// No imagination policy, on the paper's reward.
    WithoutTableOne,
    /// Targets of several steps, on the paper's reward.
    HeldTableOne,
    /// Every module is paid for its own following.
    Each,
    /// Every module imagines where itself is to be.
    OwnTargets,
    /// The imagination pays for what could not be followed.
    Feasible,
    /// The imagination attends over the modules.
    Attends,
    /// What is imagined is an input of the control policy.
    Told,
}

impl Variant {
    /// In the order of the table.
    pub const ALL: [Variant; 10] = [
        Variant::Without,
        Variant::AsItIs,
        Variant::Held,
        Variant::WithoutTableOne,
        Variant::HeldTableOne,
        Variant::Each,
        Variant::OwnTargets,
        Variant::Feasible,
        Variant::Attends,
        Variant::Told,
    ];

    /// In folders.
    pub fn name(self) -> &'static str {
        match self {
            Variant::Without => "without",
            Variant::AsItIs => "as-it-is",
            Variant::Held => "held",
            Variant::WithoutTableOne => "without-table-one",
            Variant::HeldTableOne => "held-table-one",
            Variant::Each => "each",
            Variant::OwnTargets => "own-targets",
            Variant::Feasible => "feasible",
            Variant::Attends => "attends",
            Variant::Told => "told",
        }
    }

    /// In tables.
    pub fn words(self) -> &'static str {
        match self {
            Variant::Without => "without imagination",
            Variant::AsItIs => "as it is: a target a step",
            Variant::Held => "targets held 10 steps, paid for coming nearer, clipped at walls",
            Variant::WithoutTableOne => "without imagination, the task pays Table I's quantity",
            Variant::HeldTableOne => "held, the task pays Table I's quantity",
            Variant::Each => "held, every module pays for itself",
            Variant::OwnTargets => "held, imagined by each module's own place (tube and wall have no other)",
            Variant::Feasible => "held, imagination pays for what was missed",
            Variant::Attends => "held, the imagination attends",
            Variant::Told => "held, the control policy is told what is imagined",
        }
    }

    /// What it is compared with; none: others are compared with it.
    pub fn against(self) -> Option<Variant> {
        match self {
            Variant::Without | Variant::WithoutTableOne => None,
            Variant::HeldTableOne => Some(Variant::WithoutTableOne),
            _ => Some(Variant::Without),
        }
    }

    /// Whether it differs from the others on a task: a module has a place of its own to be imagined at only where each has its own goal.
    fn concerns(self, task: Task) -> bool {
        self != Variant::OwnTargets || matches!(task, Task::ShapeFormation | Task::BlockPushing)
    }

    /// The settings of a run: the defaults, which are eight healthy modules and nothing varied, at the shipped policies' learning rate.
    pub fn settings(self, task: Task, seed: u64, steps: u64) -> RunConfig {
        let mut config = RunConfig::default();
        config.task.name = task;
        config.train.seed = seed;
        config.train.total_steps = steps;
        config.train.learning_rate = 7e-4;
        config.train.evaluate_every = 0;
        if self.against().is_none() {
            config.train.method = Method::ComposerNoImagination;
        }
        if matches!(self, Variant::WithoutTableOne | Variant::HeldTableOne) {
            config.task.reward = Reward::Paper;
        }
        let imagination = &mut config.train.imagination;
        if self.against().is_some() && self != Variant::AsItIs {
            (imagination.hold, imagination.bound, imagination.follow) = (10, 3.0, 1.0);
            (imagination.telescope, imagination.clip) = (true, true);
        }
        match self {
            Variant::Each => imagination.each = true,
            Variant::OwnTargets => imagination.own_targets = true,
            Variant::Feasible => imagination.feasible = 0.5,
            Variant::Attends => imagination.attention = true,
            Variant::Told => imagination.told = true,
            _ => {}
        }
        config
    }
}

/// A run of the study.
#[derive(Clone, Debug)]
pub struct Run {
    /// The variant.
    pub variant: Variant,
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
    /// The variant.
    pub variant: Variant,
    /// The task.
    #[serde(with = "task_name")]
    pub task: Task,
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
            Variant::ALL.into_iter().filter(move |variant| variant.concerns(task)).map(move |variant| Run {
                variant,
                task,
                folder: folder.join(format!("{}-{task}-{seed}", variant.name())),
                config: variant.settings(task, seed, steps),
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
            variant: run.variant,
            task: run.task,
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
pub fn ahead(variant: Variant, all: &[Found]) -> Option<(f64, f64, usize)> {
    let other = variant.against()?;
    let of = |variant: Variant, like: &Found| {
        all.iter().find(|f| f.variant == variant && f.task == like.task && f.seed == like.seed).map(|f| f.success)
    };
    let differences: Vec<f64> = all
        .iter()
        .filter(|found| found.variant == variant)
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
            Variant::ALL.into_iter().map(|variant| variant.settings(Task::ShapeFormation, 1, 1000)).collect();
        for (number, config) in settings.iter().enumerate() {
            config.validate().unwrap();
            assert!(settings[..number].iter().all(|other| other != config), "{:?}", Variant::ALL[number]);
            assert!(config.env.lengths.is_empty() && config.faults.probability == 0.0 && config.vary.is_none());
        }
        // Results are read back by the name that folders have.
        for variant in Variant::ALL {
            assert_eq!(serde_json::to_value(variant).unwrap(), variant.name());
        }
        assert_eq!(runs(Path::new("x"), &TASKS, 6, 1000).len(), (10 + 9 + 9) * 6);
    }

    #[test]
    fn a_variant_wins_by_more_than_two_standard_errors_of_the_pairs() {
        let found = |variant, seed, success| Found {
            variant,
            task: Task::TubeCrossing,
            seed,
            success,
            steps: 1.0,
            episodes: 1,
        };
        let mut all = vec![
            found(Variant::Without, 1, 0.5),
            found(Variant::Without, 2, 0.7),
            found(Variant::Held, 1, 0.6),
            found(Variant::Held, 2, 0.8),
        ];
        let (mean, error, pairs) = ahead(Variant::Held, &all).unwrap();
        assert!((mean - 0.1).abs() < 1e-12 && error < 1e-12 && pairs == 2 && wins((mean, error, pairs)));
        all[3].success = 0.6;
        assert!(!wins(ahead(Variant::Held, &all).unwrap()));
        // A seed whose other half is missing does not count.
        all.push(found(Variant::Held, 3, 1.0));
        assert_eq!(ahead(Variant::Held, &all).unwrap().2, 2);
        assert_eq!((ahead(Variant::Without, &all), ahead(Variant::Attends, &all)), (None, None));
    }
}
