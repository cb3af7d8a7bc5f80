//! Settings of a training run, one TOML document: the learner's, the task's, the faults', the robot's.

use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::policy::{GoalKnownTo, Meta};
use composer_sim_bridge::faults::FaultPlan;
use composer_sim_bridge::sensor_model::SensorModel;
use serde::{Deserialize, Serialize};

use crate::env::{EnvConfig, FaultTraining, knows_fault};
use crate::methods::TrainConfig;
use crate::methods::curriculum::{CurriculumConfig, Pretraining, SecondStage};
use crate::robot::Robot;
use crate::tasks::block_pushing::BlockPushing;
use crate::tasks::goal_reaching::GoalReaching;
use crate::tasks::shape_formation::ShapeFormation;
use crate::tasks::tube_crossing::TubeCrossing;
use crate::tasks::wall_climbing::WallClimbing;
use crate::tasks::{AllRules, TaskConfig, TaskSettings};
use crate::vary::Variation;

/// Who is told the goal, in settings files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Knows {
    /// Every module (the paper's).
    #[default]
    All,
    /// The head alone, a camera in it, say: attention must carry the goal along.
    Head,
}

impl From<Knows> for GoalKnownTo {
    fn from(knows: Knows) -> Self {
        match knows {
            Knows::All => GoalKnownTo::All,
            Knows::Head => GoalKnownTo::Head,
        }
    }
}

impl From<GoalKnownTo> for Knows {
    fn from(known: GoalKnownTo) -> Self {
        match known {
            GoalKnownTo::All => Knows::All,
            GoalKnownTo::Head => Knows::Head,
        }
    }
}

/// Settings of the environment that belong to no single task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnvSettings {
    /// Who is told the goal.
    pub goal_known_to: Knows,
    /// Control period, s.
    pub control_period: f32,
    /// Physics steps from sampling the sensors to the new torque, least and most, drawn for each episode: a bus delays by one
    /// or two.
    pub delay: [usize; 2],
    /// Lengths to train on, in modules; environments take them in turn, so that a length that stands here twice is trained on twice as often. Longer ones
    /// cost more time a step. Empty: the robot's own.
    pub lengths: Vec<usize>,
}

impl Default for EnvSettings {
    fn default() -> Self {
        EnvSettings { goal_known_to: Knows::All, control_period: 0.05, delay: [1, 3], lengths: Vec::new() }
    }
}

/// Everything that defines a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// The learner.
    pub train: TrainConfig,
    /// The environment.
    pub env: EnvSettings,
    /// Which task, and what all tasks have.
    pub task: TaskSettings,
    /// Goal Reaching.
    pub goal_reaching: GoalReaching,
    /// Block Pushing.
    pub block_pushing: BlockPushing,
    /// Shape Formation.
    pub shape_formation: ShapeFormation,
    /// Tube Crossing.
    pub tube_crossing: TubeCrossing,
    /// Wall Climbing.
    pub wall_climbing: WallClimbing,
    /// Faults drawn in training.
    pub faults: FaultTraining,
    /// The modules' sensors.
    pub sensors: SensorModel,
    /// What every episode of the training draws anew: robot, ground, sensors.
    pub vary: Variation,
    /// The robot.
    pub robot: Robot,
}

impl RunConfig {
    /// Changes one setting: `section.key=value`, or `key=value` where only one section, or that of the task, has such a key; a setting
    /// of a section within a section is `inner.key=value`. The value is TOML; a bare word is a string.
    pub fn set(&mut self, assignment: &str) -> Result<()> {
        let Some((key, value)) = assignment.split_once('=') else {
            bail!("`{assignment}` is no setting: write key=value, such as train.learning_rate=3e-4");
        };
        let (key, value) = (key.trim(), value.trim());
        let mut document = toml::Table::try_from(&*self).context("the settings cannot be written as TOML")?;
        let tables = |table: &toml::Table| -> Vec<(String, toml::Table)> {
            table.iter().filter_map(|(name, value)| Some((name.clone(), value.as_table()?.clone()))).collect()
        };
        let mut places: Vec<Vec<String>> = Vec::new();
        for (section, table) in tables(&document) {
            for name in table.keys().filter(|name| !table[*name].is_table()) {
                if key == name || key == format!("{section}.{name}") {
                    places.push(vec![section.clone(), name.clone()]);
                }
            }
            for (inner, table) in tables(&table) {
                for name in table.keys() {
                    if key == format!("{inner}.{name}") || key == format!("{section}.{inner}.{name}") {
                        places.push(vec![section.clone(), inner.clone(), name.clone()]);
                    }
                }
            }
        }
        let of_task = self.task.name.name().replace('-', "_");
        if places.len() > 1 && places.iter().any(|place| place[0] == of_task) {
            places.retain(|place| place[0] == of_task);
        }
        let place = match &places[..] {
            [place] => place,
            [] => bail!("there is no setting `{key}`; config.toml in any run folder lists them all"),
            several => bail!(
                "`{key}` could be {}; say which",
                several.iter().map(|place| place.join(".")).collect::<Vec<_>>().join(" or ")
            ),
        };
        let mut new = match toml::from_str::<toml::Table>(&format!("x = {value}")) {
            Ok(mut parsed) => parsed.remove("x").unwrap_or_else(|| toml::Value::String(value.into())),
            Err(_) => toml::Value::String(value.into()),
        };
        let (first, rest) = (&place[0], &place[1..]);
        let old = rest.iter().fold(&mut document[first], |table, name| &mut table[name]);
        // 1 is as good as 1.0 where a number with a point belongs.
        if let (toml::Value::Float(_), toml::Value::Integer(i)) = (&*old, &new) {
            new = toml::Value::Float(*i as f64);
        }
        *old = new;
        *self = document
            .try_into()
            .map_err(|error| anyhow::anyhow!("{key}={value} is not possible: {}", error.message()))?;
        Ok(())
    }

    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        self.train.validate()?;
        if let Some(before) = self.pretraining() {
            before.validate().context("the pretraining")?;
        }
        self.robot.validate()?;
        let substeps = self.env.control_period / self.robot.physics_step;
        if !(1.0..=100.0).contains(&substeps) || (substeps - substeps.round()).abs() > 1e-3 {
            bail!(
                "control_period = {}; it must be a whole number of physics steps of {} s",
                self.env.control_period,
                self.robot.physics_step
            );
        }
        let [least, most] = self.env.delay;
        if least > most || most as f32 >= substeps {
            bail!(
                "delay = [{least}, {most}]; it must rise and stay below the {substeps:.0} physics steps of a control step"
            );
        }
        let task = self.task();
        task.validate(&self.robot).map_err(anyhow::Error::msg)?;
        for &modules in &self.env.lengths {
            task.validate(&self.robot.with_modules(modules)?).map_err(anyhow::Error::msg)?;
        }
        self.sensors.check().map_err(|error| anyhow::anyhow!("sensors.{error}"))?;
        self.vary.check(&self.evaluation()).map_err(|error| anyhow::anyhow!("vary.{error}"))?;
        let faults = &self.faults;
        if !(0.0..=1.0).contains(&faults.probability) || !(0.0..1.0).contains(&faults.missed_latents) {
            bail!("faults.probability and faults.missed_latents are shares: 0 to 1");
        }
        if !(0.0..=3600.0).contains(&faults.latest) {
            bail!("faults.latest = {}; it must be from 0 to 3600 s", faults.latest);
        }
        if !faults.fixed.is_empty() {
            let plan: FaultPlan = faults.fixed.parse().map_err(|error| anyhow::anyhow!("faults.fixed: {error}"))?;
            if let Some(planned) = plan.faults.iter().find(|planned| !knows_fault(&planned.kind)) {
                bail!(
                    "faults.fixed = {:?}; training knows unplug, action, observation and cut",
                    planned.kind.to_string()
                );
            }
        }
        if faults.weights.iter().any(|w| w.is_nan() || *w < 0.0) || faults.weights.iter().sum::<f32>() <= 0.0 {
            bail!("faults.weights = {:?}; they must be zero or more, one of them above zero", faults.weights);
        }
        Ok(())
    }

    /// The run that comes before this one, if one does (`[train.pretraining]`): by the paper's protocol.
    pub fn pretraining(&self) -> Option<RunConfig> {
        let Pretraining { steps, learning_rate, sigma, environments, minibatches, blind } = self.train.pretraining;
        (steps > 0).then(|| {
            let mut config = self.plain();
            config.train =
                TrainConfig { total_steps: steps, learning_rate, sigma, environments, minibatches, ..config.train };
            if blind > 0.0 {
                config.faults = FaultTraining {
                    probability: blind as f32,
                    most: 1,
                    weights: [0.0, 1.0, 0.0],
                    ..FaultTraining::default()
                };
            }
            config
        })
    }

    /// The same in one stage on the robot as it should be: of its own length, nothing broken, nothing varied, no message lost.
    pub fn plain(&self) -> RunConfig {
        let train = TrainConfig {
            pretraining: Pretraining::default(),
            curriculum: CurriculumConfig::default(),
            second: SecondStage::default(),
            ..self.train.clone()
        };
        let env = EnvSettings { lengths: Vec::new(), ..self.env.clone() };
        RunConfig { train, env, faults: FaultTraining::default(), vary: Variation::default(), ..self.clone() }
    }

    /// Environment steps of the run and of the one before it.
    pub fn environment_steps(&self) -> u64 {
        self.train.total_steps + self.train.pretraining.steps
    }

    /// The environment that training number `index` works in.
    pub fn environment(&self, index: usize) -> Result<Arc<EnvConfig>> {
        let robot = match &self.env.lengths[..] {
            [] => self.robot.clone(),
            lengths => self.robot.with_modules(lengths[index % lengths.len()])?,
        };
        let faults = self.faults.clone();
        Ok(Arc::new(EnvConfig { robot, faults, delay: self.env.delay, vary: self.vary.clone(), ..self.evaluation() }))
    }

    /// The environment that evaluations start from. It is easier than the one of the training: the least delay of those trained with, no missed
    /// latents, no faults, nothing varied, and the robot's own length.
    pub fn evaluation(&self) -> EnvConfig {
        EnvConfig {
            task: self.task(),
            goal_known_to: self.env.goal_known_to.into(),
            control_period: self.env.control_period,
            delay: [self.env.delay[0]; 2],
            sensors: self.sensors,
            ..EnvConfig::new(self.task.name, self.robot.clone())
        }
    }

    /// The task with all settings.
    pub fn task(&self) -> TaskConfig {
        TaskConfig {
            settings: self.task.clone(),
            rules: AllRules {
                goal_reaching: self.goal_reaching.clone(),
                block_pushing: self.block_pushing.clone(),
                shape_formation: self.shape_formation.clone(),
                tube_crossing: self.tube_crossing.clone(),
                wall_climbing: self.wall_climbing.clone(),
            },
        }
    }

    /// What a frozen policy of this run says about itself.
    pub fn meta(&self) -> Meta {
        Meta {
            task: self.task.name,
            goal_known_to: self.env.goal_known_to.into(),
            attention: self.train.method.attention(),
            trained_with_faults: self.faults.probability > 0.0,
            geometry: self.robot.geometry(),
            limits: self.robot.limits(),
            control_period_us: (self.env.control_period * 1e6).round() as u32,
            relax_seconds: self.robot.relax_seconds(),
            task_digest: self.task().digest(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_found_by_their_name_and_checked() {
        let mut config = RunConfig::default();
        config.set("learning_rate=1").unwrap();
        config.set("goal_reaching.goal_distance=[4, 15]").unwrap();
        config.set("goal_known_to=head").unwrap();
        assert_eq!((config.train.learning_rate, config.goal_reaching.goal_distance), (1.0, [4.0, 15.0]));
        assert_eq!(config.env.goal_known_to, Knows::Head);
        // The section of the task comes first.
        config.set("task.name=block-pushing").unwrap();
        config.set("goal_distance=[5, 6]").unwrap();
        assert_eq!(config.block_pushing.goal_distance, [5.0, 6.0]);
        assert!(config.set("task.name=dancing").unwrap_err().to_string().contains("no task `dancing`"));
        config.set("task.name=shape-formation").unwrap();
        assert!(config.set("goal_bearing=5").unwrap_err().to_string().contains("say which"));
        config.set("imagination.follow=1").unwrap();
        config.set("train.imagination.bound=0.25").unwrap();
        config.set("sigma=0.3").unwrap();
        let imagination = &config.train.imagination;
        assert_eq!((imagination.follow, imagination.bound, config.train.sigma), (1.0, 0.25, 0.3));
        assert!(config.set("imagination=1").unwrap_err().to_string().contains("no setting"));
        assert!(config.set("imagination.folow=1").unwrap_err().to_string().contains("no setting"));
        assert!(config.set("nonsense=1").unwrap_err().to_string().contains("no setting `nonsense`"));
        assert!(config.set("cap=-1").unwrap_err().to_string().contains("cap=-1 is not possible"));
        assert!(config.set("cap").unwrap_err().to_string().contains("key=value"));
        config.set("delay=[1, 10]").unwrap();
        assert!(config.validate().unwrap_err().to_string().contains("delay = [1, 10]"));
    }
}
