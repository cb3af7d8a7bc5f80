//! Where a policy comes from: a frozen image, a run folder, or one that ships.

use std::path::Path;

use anyhow::{Context, Result, bail};
use composer_shared::policy::{Policy, Task};

use crate::env::EnvConfig;
use crate::methods::TrainedPolicy;
use crate::policy;
use crate::robot::Robot;
use crate::run::RunConfig;
use crate::run_folder::load_run;
use crate::tasks::{AllRules, TaskConfig, TaskSettings};

/// A frozen policy.
pub struct Frozen {
    /// Where it comes from, for people.
    pub name: String,
    /// The image; it has been checked.
    pub image: Vec<u8>,
    /// The task by the manifest beside it, if there is one.
    pub manifest: Option<TaskConfig>,
}

impl Frozen {
    /// The settings of the task to evaluate it on, and what there is to say about that: those that it was trained for if image and manifest agree on
    /// them, else today's defaults.
    fn task(&self, policy: &Policy) -> (TaskConfig, Option<String>) {
        let (name, today, digest) = (&self.name, TaskConfig::new(policy.task()), policy.task_digest());
        match &self.manifest {
            Some(own) if own.digest() == digest => {
                let differences = own.differences(&today);
                let note = (!differences.is_empty()).then(|| {
                    format!(
                        "{name} is evaluated on the task it was trained for, not on today's defaults: {}",
                        differences.join(", ")
                    )
                });
                (own.clone(), note)
            }
            _ if digest == today.digest() => (today, None),
            Some(own) if digest == 0 => {
                let differences = today.differences(own);
                let note = (!differences.is_empty()).then(|| {
                    format!(
                        "{name} is evaluated on today's defaults, not on the task of its manifest, which the image does not vouch for: {}",
                        differences.join(", ")
                    )
                });
                (today, note)
            }
            None if digest == 0 => (today, None),
            _ => {
                let note = format!(
                    "{name} is evaluated on today's defaults, but was trained for other settings of the task, and no manifest beside it says which"
                );
                (today, Some(note))
            }
        }
    }
}

/// The task of a manifest: what it is, and its settings in the run that was frozen.
fn manifest_task(text: &str) -> Result<TaskConfig> {
    let mut manifest: toml::Table = toml::from_str(text).map_err(|e| anyhow::anyhow!("{}", e.message()))?;
    let run = manifest.get_mut("run").and_then(toml::Value::as_table_mut).context("it has no [run]")?;
    // Of the settings, no others than those of the task: a manifest outlives those of the learner.
    fn section<T: serde::de::DeserializeOwned>(run: &mut toml::Table, name: &str) -> Result<T> {
        let section = run.remove(name).with_context(|| format!("it has no [run.{name}]"))?;
        section.try_into().map_err(|e: toml::de::Error| anyhow::anyhow!("[run.{name}]: {}", e.message()))
    }
    let settings: TaskSettings = section(run, "task")?;
    let mut task = TaskConfig { settings, rules: AllRules::default() };
    let (name, rules) = (task.settings.name.name().replace('-', "_"), &mut task.rules);
    match task.settings.name {
        Task::GoalReaching => rules.goal_reaching = section(run, &name)?,
        Task::BlockPushing => rules.block_pushing = section(run, &name)?,
        Task::ShapeFormation => rules.shape_formation = section(run, &name)?,
        Task::TubeCrossing => rules.tube_crossing = section(run, &name)?,
        Task::WallClimbing => rules.wall_climbing = section(run, &name)?,
    }
    Ok(task)
}

/// The manifest of a policy that ships.
fn shipped_manifest(name: &str) -> Option<&'static str> {
    Some(match name {
        "goal-reaching" => include_str!("../../shared/policies/goal-reaching.toml"),
        "block-pushing" => include_str!("../../shared/policies/block-pushing.toml"),
        "shape-formation" => include_str!("../../shared/policies/shape-formation.toml"),
        "tube-crossing" => include_str!("../../shared/policies/tube-crossing.toml"),
        "wall-climbing" => include_str!("../../shared/policies/wall-climbing.toml"),
        _ => return None,
    })
}

/// Seed of the training of a policy that ships.
pub fn shipped_seed(name: &str) -> Result<u64> {
    let text = shipped_manifest(name).with_context(|| format!("no policy {name} ships"))?;
    let manifest: toml::Table = toml::from_str(text).context("a manifest that ships is TOML")?;
    let seed = manifest.get("run").and_then(|run| run.get("train")?.get("seed")?.as_integer());
    seed.and_then(|seed| u64::try_from(seed).ok()).with_context(|| format!("the manifest of {name} has no seed"))
}

/// A policy to evaluate or to run.
pub enum PolicySource {
    /// A frozen integer policy image.
    Image(Box<Frozen>),
    /// The policy of a training run, with its settings.
    Run(Box<(TrainedPolicy, RunConfig)>),
    /// No policy: baselines.
    Still,
    /// No policy: baselines.
    Random,
}

impl PolicySource {
    /// Finds a policy: a file, a run folder, the name of a task whose policy ships, or a baseline (`still`, `random`).
    pub fn load(name: &str) -> Result<Self> {
        let path = Path::new(name);
        if path.is_dir() {
            let (config, policy) = load_run(path)?;
            return Ok(PolicySource::Run(Box::new((policy, config))));
        }
        if path.is_file() {
            let image = std::fs::read(path).with_context(|| format!("cannot read {name}"))?;
            Policy::parse(&image).map_err(|e| anyhow::anyhow!("{name} is not a usable policy image: {e}"))?;
            let file = path.with_extension("toml");
            let manifest = match std::fs::read_to_string(&file) {
                Err(_) => None,
                Ok(text) => manifest_task(&text)
                    .inspect_err(|e| eprintln!("note: {} is not used: it is no manifest, {e:#}", file.display()))
                    .ok(),
            };
            return Ok(PolicySource::Image(Box::new(Frozen { name: name.into(), image, manifest })));
        }
        match name {
            "still" => Ok(PolicySource::Still),
            "random" => Ok(PolicySource::Random),
            _ => match composer_shared::policies::shipped(name) {
                Some(image) => Ok(PolicySource::Image(Box::new(Frozen {
                    name: name.into(),
                    image: image.to_vec(),
                    manifest: shipped_manifest(name).map(manifest_task).transpose()?,
                }))),
                None => bail!(
                    "there is no policy {name}: give an image file, a run folder, still, random, or one that ships ({})",
                    composer_shared::policies::NAMES.join(", ")
                ),
            },
        }
    }

    /// The image, if it is one.
    pub fn image(&self) -> Option<&[u8]> {
        match self {
            PolicySource::Image(frozen) => Some(&frozen.image),
            _ => None,
        }
    }

    /// What decides the torques. The image has been checked when it was loaded.
    pub fn policy(&self) -> Result<Box<dyn policy::Policy + '_>> {
        Ok(match self {
            PolicySource::Image(frozen) => Box::new(Policy::parse(&frozen.image).map_err(|e| anyhow::anyhow!("{e}"))?),
            PolicySource::Run(run) => run.0.policy(),
            PolicySource::Still => Box::new(policy::Still),
            PolicySource::Random => Box::new(policy::Random),
        })
    }

    /// The task that the policy was made for; baselines are made for none.
    fn task(&self) -> Result<Option<Task>> {
        Ok(match self {
            PolicySource::Image(frozen) => {
                Some(Policy::parse(&frozen.image).map_err(|e| anyhow::anyhow!("{e}"))?.task())
            }
            PolicySource::Run(run) => Some(run.1.task.name),
            PolicySource::Still | PolicySource::Random => None,
        })
    }

    /// The environment that the policy was made for, on `robot` (default: the one it was trained with, else the paper's). `task` is
    /// what is to be done: a policy of another task is refused, a baseline does anything.
    pub fn environment(&self, task: Option<Task>, robot: Option<&Robot>) -> Result<EnvConfig> {
        if let (Some(wanted), Some(made_for)) = (task, self.task()?)
            && wanted != made_for
        {
            bail!("the policy was trained for {made_for} and cannot do {wanted}: choose a policy of that task");
        }
        let config = self.any_environment(task, robot)?;
        config.task.validate(&config.robot).map_err(anyhow::Error::msg)?;
        Ok(config)
    }

    fn any_environment(&self, task: Option<Task>, robot: Option<&Robot>) -> Result<EnvConfig> {
        match self {
            PolicySource::Image(frozen) => {
                let policy = Policy::parse(&frozen.image).map_err(|e| anyhow::anyhow!("{e}"))?;
                let mut config = EnvConfig::new(policy.task(), robot.cloned().unwrap_or_default());
                check(&policy, &config.robot)?;
                let (task, note) = frozen.task(&policy);
                if let Some(note) = note {
                    eprintln!("note: {note}");
                }
                config.task = task;
                config.goal_known_to = policy.goal_known_to();
                config.control_period = policy.control_period_us() as f32 * 1e-6;
                Ok(config)
            }
            PolicySource::Run(run) => {
                let mut config = run.1.evaluation();
                if let Some(robot) = robot {
                    config.robot = robot.clone();
                }
                Ok(config)
            }
            PolicySource::Still | PolicySource::Random => {
                Ok(EnvConfig::new(task.unwrap_or(Task::GoalReaching), robot.cloned().unwrap_or_default()))
            }
        }
    }
}

/// Refuses a policy of a robot that its modules could not control.
fn check(policy: &Policy, robot: &Robot) -> Result<()> {
    if policy.geometry() != robot.geometry() || policy.limits() != robot.limits() {
        bail!(
            "the policy was trained for modules with {:?} and {:?}; the robot {} has {:?} and {:?}",
            policy.geometry(),
            policy.limits(),
            robot.name,
            robot.geometry(),
            robot.limits()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::policies;
    use composer_shared::policy::{IMAGE_SIZE, ImageWriter, Meta, Shape, random_image};

    /// An image that says it was trained for this task.
    fn image(task: &TaskConfig, digest: u32) -> Vec<u8> {
        let mut image = [0; IMAGE_SIZE];
        random_image(1, &mut image);
        let meta = Policy::parse(&image).unwrap().meta();
        let limits = Robot::default().limits();
        let meta = Meta { task: task.task(), task_digest: digest, limits, ..meta };
        let mut writer = ImageWriter::new(&meta, Shape::FULL, &mut image);
        (0..composer_shared::policy::OBS).for_each(|field| writer.input(field, 0.0, 1.0));
        writer.finish().unwrap();
        image.to_vec()
    }

    fn manifest(task: &TaskConfig) -> String {
        let run = RunConfig {
            task: task.settings.clone(),
            block_pushing: task.rules.block_pushing.clone(),
            ..RunConfig::default()
        };
        let text = toml::to_string(&toml::Table::from_iter([("run".into(), toml::Value::try_from(run).unwrap())]));
        // A setting of the learner that this version does not know.
        text.unwrap().replace("[run.train]", "[run.train]\nforgotten = 1")
    }

    #[test]
    fn a_policy_is_evaluated_on_the_task_of_its_manifest_if_the_image_vouches_for_it() {
        let today = TaskConfig::new(Task::BlockPushing);
        let mut own = today.clone();
        own.rules.block_pushing.success_distance = 1.5;
        own.settings.cap = 150;
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("x.policy");
        let load = |digest: u32, manifest: Option<String>| {
            std::fs::write(&file, image(&own, digest)).unwrap();
            let beside = file.with_extension("toml");
            let _ = std::fs::remove_file(&beside);
            if let Some(text) = manifest {
                std::fs::write(&beside, text).unwrap();
            }
            let PolicySource::Image(frozen) = PolicySource::load(file.to_str().unwrap()).unwrap() else {
                unreachable!()
            };
            let (task, note) = frozen.task(&Policy::parse(&frozen.image).unwrap());
            assert_eq!(PolicySource::Image(frozen).environment(None, None).unwrap().task, task);
            (task, note.unwrap_or_default())
        };
        let (task, note) = load(own.digest(), Some(manifest(&own)));
        assert_eq!(task.judged(), own.judged());
        assert!(
            note.contains("success_distance = 1.5 instead of 1.0") && note.contains("cap = 150 instead of 125"),
            "{note}"
        );
        assert_eq!(load(today.digest(), Some(manifest(&today))), (today.clone(), String::new()));
        assert_eq!(load(today.digest(), None), (today.clone(), String::new()));
        for (digest, manifest, words) in [
            // A manifest of another image, one that is none, and none at all.
            (own.digest(), Some(manifest(&today)), "no manifest beside it"),
            (own.digest(), Some("x = 1".into()), "no manifest beside it"),
            (own.digest(), None, "no manifest beside it"),
            (0, Some(manifest(&own)), "success_distance = 1.0 instead of 1.5"),
        ] {
            let (task, note) = load(digest, manifest);
            assert!(task == today && note.contains(words) && !note.contains('\n'), "{note}");
        }
        assert_eq!(load(0, None), (today, String::new()));
    }

    #[test]
    fn the_manifest_of_every_policy_that_ships_is_of_its_image() {
        for name in policies::NAMES {
            let policy = Policy::parse(policies::shipped(name).unwrap()).unwrap();
            let text = shipped_manifest(name).unwrap();
            let table: toml::Table = toml::from_str(text).unwrap();
            assert_eq!(table["crc32"].as_str(), Some(format!("{:08x}", policy.crc()).as_str()), "{name}");
            assert_eq!(table["task_digest"].as_str(), Some(format!("{:08x}", policy.task_digest()).as_str()), "{name}");
            let task = manifest_task(text).unwrap();
            assert_eq!(task.task(), policy.task());
            assert!([0, task.digest()].contains(&policy.task_digest()), "{name}");
        }
    }
}
