//! Where a policy comes from: a frozen image, a run folder, or one that ships.

use std::path::Path;

use anyhow::{Context, Result, bail};
use composer_shared::policy::{Policy, Task};

use crate::env::EnvConfig;
use crate::eval::Pilot;
use crate::network::Network;
use crate::robot::Robot;
use crate::run::RunConfig;

/// A policy to evaluate or to run.
pub enum PolicySource {
    /// A frozen integer policy image.
    Image(Vec<u8>),
    /// The float network of a training run, with its settings.
    Run(Box<(Network, RunConfig)>),
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
            let (config, network) = load_run(path)?;
            return Ok(PolicySource::Run(Box::new((network, config))));
        }
        if path.is_file() {
            let image = std::fs::read(path).with_context(|| format!("cannot read {name}"))?;
            Policy::parse(&image).map_err(|e| anyhow::anyhow!("{name} is not a usable policy image: {e}"))?;
            return Ok(PolicySource::Image(image));
        }
        match name {
            "still" => Ok(PolicySource::Still),
            "random" => Ok(PolicySource::Random),
            _ => match composer_shared::policies::shipped(name) {
                Some(image) => Ok(PolicySource::Image(image.to_vec())),
                None => bail!(
                    "there is no policy {name}: give an image file, a run folder, still, random, or one that ships ({})",
                    composer_shared::policies::NAMES.join(", ")
                ),
            },
        }
    }

    /// The pilot that flies it. The image has been checked when it was loaded.
    pub fn pilot(&self) -> Result<Pilot<'_>> {
        Ok(match self {
            PolicySource::Image(image) => Pilot::Integer(Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?),
            PolicySource::Run(run) => Pilot::Float(&run.0),
            PolicySource::Still => Pilot::Still,
            PolicySource::Random => Pilot::Random,
        })
    }

    /// The task that the policy was made for; baselines are made for none.
    fn task(&self) -> Result<Option<Task>> {
        Ok(match self {
            PolicySource::Image(image) => Some(Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?.task()),
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
            PolicySource::Image(image) => {
                let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
                let mut config = EnvConfig::new(policy.task(), robot.cloned().unwrap_or_default());
                check(&policy, &config.robot)?;
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

/// Settings of a run, in its folder.
pub const CONFIG_FILE: &str = "config.toml";
/// Float network of a run as of its last evaluation, in its folder.
pub const NETWORK_FILE: &str = "network.json";

/// Reads a settings file.
pub fn load_config(path: &Path) -> Result<RunConfig> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read the settings {}", path.display()))?;
    toml::from_str(&text)
        .map_err(|e| anyhow::anyhow!("{} has settings that do not fit: {}", path.display(), e.message()))
}

/// The settings and the network of a run folder.
pub fn load_run(folder: &Path) -> Result<(RunConfig, Network)> {
    let config = load_config(&folder.join(CONFIG_FILE))
        .with_context(|| format!("{} is no folder of a training run", folder.display()))?;
    let path = folder.join(NETWORK_FILE);
    let text = std::fs::read(&path).with_context(|| {
        format!("cannot read {}; a run writes it at its first evaluation and at its end", path.display())
    })?;
    let network: Network = serde_json::from_slice(&text).with_context(|| format!("{} is damaged", path.display()))?;
    network.check().with_context(|| format!("{} is damaged", path.display()))?;
    Ok((config, network))
}
