//! The paper's comparison: COMPOSER, its ablations and five baselines on five tasks, each with three seeds, by one protocol ([`protocol`]).
//!
//! A comparison is a list of runs in a fixed order ([`Comparison::runs`]). Whoever works on it, one process or many on many machines, trains each
//! run in a folder of its own, all of a run's files in it, so that outputs are merged by being looked at together.

pub mod gather;
pub mod measure;
pub mod protocol;
pub mod publish;
pub mod published;
pub mod sections;
pub mod tune;
pub mod work;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use self::measure::Point;
use self::tune::Tuned;
use crate::methods::Method;
use crate::run::RunConfig;

/// What is compared.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Methods, in the order in which they are worked on.
    pub methods: Vec<Method>,
    /// Tasks.
    pub tasks: Vec<Task>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Environment steps of each run, if not the protocol's; of Block Pushing twice as many.
    pub steps: Option<u64>,
    /// Settings of every run that are not the protocol's, `key=value`.
    pub settings: Vec<String>,
    /// Settings that have been tuned: every run is there once more with those of its method and task.
    pub tuned: Option<Tuned>,
}

impl Default for Comparison {
    fn default() -> Self {
        Comparison {
            methods: protocol::METHODS.to_vec(),
            tasks: Task::ALL.to_vec(),
            seeds: protocol::SEEDS.to_vec(),
            steps: None,
            settings: Vec::new(),
            tuned: None,
        }
    }
}

/// One training run of a comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// Name of its folder: task, method and seed.
    pub name: String,
    /// All settings.
    pub config: RunConfig,
    /// Whether they have been tuned.
    pub tuned: bool,
}

impl Run {
    /// Its folder in an output.
    pub fn folder(&self, out: &Path) -> PathBuf {
        out.join(&self.name)
    }

    /// What is trained.
    pub fn method(&self) -> Method {
        self.config.train.method
    }

    /// For what.
    pub fn task(&self) -> Task {
        self.config.task.name
    }

    /// What is measured of it: with tuned settings, success alone.
    pub fn points(&self) -> Vec<Point> {
        let all = Point::all(self.task());
        if self.tuned { all[..1].to_vec() } else { all }
    }

    /// With which seed.
    pub fn seed(&self) -> u64 {
        self.config.train.seed
    }
}

impl Comparison {
    /// All runs: those of the first seed, then of the next; of one seed method by method, the cheap ones first. Whatever is stopped, all methods
    /// that are done have the same tasks and seeds behind them. Then once more those for which tuning has found other
    /// settings.
    ///
    /// # Errors
    ///
    /// If a setting is not possible.
    pub fn runs(&self) -> Result<Vec<Run>> {
        let mut runs = Vec::new();
        for &seed in &self.seeds {
            for &method in &self.methods {
                for &task in &self.tasks {
                    let mut config = protocol::settings(task, method, seed, self.steps);
                    for setting in &self.settings {
                        config.set(setting)?;
                    }
                    config.validate()?;
                    runs.push(Run { name: format!("{task}-{method}-{seed}"), config, tuned: false });
                }
            }
        }
        if let Some(tuned) = &self.tuned {
            let mut any = false;
            for mut run in runs.clone() {
                let Some(settings) = tuned.of(run.task(), run.method()) else { continue };
                any = true;
                // With its own settings a method has a run already.
                if settings.is_empty() {
                    continue;
                }
                for setting in settings {
                    run.config.set(setting)?;
                }
                run.config.validate()?;
                run.name = format!("{}-{}-tuned-{}", run.task(), run.method(), run.seed());
                run.tuned = true;
                runs.push(run);
            }
            if !any {
                bail!("none of these methods has been tuned on any of these tasks");
            }
        }
        if let Some(twice) =
            runs.iter().enumerate().find(|(i, run)| runs[..*i].iter().any(|other| other.name == run.name))
        {
            bail!("{} is asked for twice; name every method, task and seed once", twice.1.name);
        }
        Ok(runs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shard::Shard;

    #[test]
    fn every_run_is_in_one_shard_whatever_their_number() {
        let runs = Comparison::default().runs().unwrap();
        assert_eq!(runs.len(), 8 * 5 * 3);
        assert!(runs.windows(2).all(|pair| pair[0].seed() <= pair[1].seed()));
        assert_eq!(
            (runs[0].name.as_str(), runs[39].name.as_str()),
            ("goal-reaching-composer-1", "wall-climbing-smp-1")
        );
        for of in [1, 2, 7, 120, 500] {
            let mut parts: Vec<String> =
                (1..=of).flat_map(|index| Shard { index, of }.select(runs.clone()).map(|run| run.name)).collect();
            parts.sort();
            let mut all: Vec<String> = runs.iter().map(|run| run.name.clone()).collect();
            all.sort();
            assert_eq!(parts, all);
        }
        assert_eq!("2/8".parse(), Ok(Shard { index: 2, of: 8 }));
        for text in ["0/8", "9/8", "1/0", "3", "a/b", "-1/4"] {
            let error = text.parse::<Shard>().unwrap_err();
            assert!(error.contains(text) && !error.contains('\n'), "{error}");
        }
        let settings = [(
            Task::GoalReaching.name().into(),
            [("mat".into(), vec!["mat.clip=0.1".into()]), ("smp".into(), vec![])].into(),
        )]
        .into();
        let tuned = Some(Tuned { trials: 1, settings });
        let runs = Comparison { tuned: tuned.clone(), ..Comparison::default() }.runs().unwrap();
        assert_eq!(
            (runs.len(), &*runs[120].name, runs[120].config.train.mat.clip),
            (123, "goal-reaching-mat-tuned-1", 0.1)
        );
        let elsewhere = Comparison { tuned, tasks: vec![Task::WallClimbing], ..Comparison::default() };
        assert!(elsewhere.runs().unwrap_err().to_string().contains("has been tuned"));
        let twice = Comparison { seeds: vec![1, 1], ..Comparison::default() };
        assert!(twice.runs().unwrap_err().to_string().contains("asked for twice"));
    }
}
