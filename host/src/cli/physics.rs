//! What an evaluation changes about the physics: `--finer`, `--tolerance`, `--solver`, `--vary`. The policy and the modules know nothing of it.

use std::fmt;

use anyhow::{Result, bail};

use crate::env::EnvConfig;
use crate::robot::{Robot, Solver};
use crate::vary::{LAB, LAB_NAME, Variation};

/// Fields of the robot that an evaluation cannot vary: the policy is made for them, or there is a flag of their own.
const KEPT: [&str; 8] = [
    "modules",
    "links_per_module",
    "link_length",
    "torque_limit",
    "torque_slew",
    "joint_speed_limit",
    "joint_angle_limit",
    "physics_step",
];

/// Changes of the physics for an evaluation.
#[derive(clap::Args, Clone, Debug, PartialEq)]
pub struct Physics {
    /// Divide the physics step by this: the same episodes and delays, less error of the step
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=1000))]
    pub finer: usize,
    /// Multiply the tolerance of the solver by this
    #[arg(long, value_name = "X")]
    pub tolerance: Option<f64>,
    /// Solver of the joints [default: the robot's]
    #[arg(long, value_name = "direct|rapier")]
    pub solver: Option<Solver>,
    /// Change a number of the robot, such as friction_along=0.15, or let every episode draw from the ranges of a file or of `vary-lab`; the
    /// policy is not told. May be repeated
    #[arg(long, value_name = "KEY=VALUE|FILE")]
    pub vary: Vec<String>,
}

impl Default for Physics {
    fn default() -> Self {
        Physics { finer: 1, tolerance: None, solver: None, vary: Vec::new() }
    }
}

impl fmt::Display for Physics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut changes = Vec::new();
        changes.extend((self.finer > 1).then(|| format!("finer={}", self.finer)));
        changes.extend(self.tolerance.map(|times| format!("tolerance={times}")));
        changes.extend(self.solver.map(|solver| format!("solver={}", solver.name())));
        changes.extend(self.vary.iter().cloned());
        f.write_str(&changes.join(", "))
    }
}

impl Physics {
    /// The environment with the changes. What the modules know of the robot stays as it was.
    pub fn apply(&self, mut config: EnvConfig) -> Result<EnvConfig> {
        let known = config.relax_seconds.unwrap_or_else(|| config.robot.relax_seconds());
        // By way of the text, in which a 32-bit number has no more digits than it needs.
        let mut fields: toml::Table = toml::from_str(&config.robot.fingerprint())?;
        let (assignments, files): (Vec<&String>, Vec<&String>) = self.vary.iter().partition(|vary| vary.contains('='));
        for assignment in assignments {
            vary(&mut fields, assignment)?;
        }
        if let Some(times) = self.tolerance {
            if !(times > 0.0 && times.is_finite()) {
                bail!(
                    "--tolerance {times} is not possible: it multiplies the tolerance, so it must be a number above zero"
                );
            }
            if let Some(toml::Value::Float(tolerance)) = fields.get_mut("solver_tolerance") {
                *tolerance *= times;
            }
        }
        if let Some(solver) = self.solver {
            fields.insert("solver".into(), solver.name().into());
        }
        let robot: Robot = fields
            .try_into()
            .map_err(|error: toml::de::Error| anyhow::anyhow!("no such robot can be: {}", error.message()))?;
        robot.validate()?;
        if robot != config.robot {
            config = EnvConfig { robot, relax_seconds: Some(known), ..config };
            config.task.validate(&config.robot).map_err(anyhow::Error::msg)?;
        }
        match files[..] {
            [] => {}
            [file] => config.vary = ranges(file, &config)?,
            _ => bail!("--vary {}: one set of ranges is possible, but several changes of the form KEY=VALUE", files[1]),
        }
        Ok(if self.finer > 1 { config.finer(self.finer) } else { config })
    }
}

/// The set of ranges in a file, or the one that ships.
fn ranges(file: &str, config: &EnvConfig) -> Result<Variation> {
    let text = match std::fs::read_to_string(file) {
        Ok(text) => text,
        Err(_) if file == LAB_NAME => LAB.into(),
        Err(error) => bail!(
            "--vary {file}: no such set of ranges ({error}); write KEY=VALUE, such as friction_along=0.15, or name a file such as host/configs/vary-lab.toml"
        ),
    };
    let set = Variation::from_toml(&text).map_err(|error| anyhow::anyhow!("--vary {file}: {error}"))?;
    set.check(config).map_err(|error| anyhow::anyhow!("--vary {file}: {error}"))?;
    Ok(set)
}

/// Changes one number of a robot.
fn vary(fields: &mut toml::Table, assignment: &str) -> Result<()> {
    let Some((key, text)) = assignment.split_once('=') else {
        bail!("--vary {assignment}: write KEY=VALUE, such as friction_along=0.15");
    };
    let (key, text) = (key.trim(), text.trim());
    let can_be: Vec<String> = fields
        .iter()
        .filter(|(name, value)| (value.is_float() || value.is_integer()) && !KEPT.contains(&name.as_str()))
        .map(|(name, _)| name.clone())
        .collect();
    let field = fields.get_mut(key).filter(|_| can_be.iter().any(|name| name == key));
    let Some(field) = field else { bail!("--vary cannot change `{key}`; it can change {}", can_be.join(", ")) };
    let new = match field {
        toml::Value::Integer(_) => text.parse().ok().map(toml::Value::Integer),
        _ => text.parse().ok().map(toml::Value::Float),
    };
    *field = match new {
        Some(new) => new,
        None => bail!("--vary {key}={text}: the value must be a number such as {field}"),
    };
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::policy::Task;

    fn apply(physics: Physics) -> Result<EnvConfig, String> {
        physics.apply(EnvConfig::new(Task::GoalReaching, Robot::default())).map_err(|error| error.to_string())
    }

    fn varied(assignments: &[&str]) -> Result<EnvConfig, String> {
        apply(Physics { vary: assignments.iter().map(|s| s.to_string()).collect(), ..Physics::default() })
    }

    #[test]
    fn numbers_of_the_robot_are_varied_and_the_modules_are_not_told() {
        let nominal = EnvConfig::new(Task::GoalReaching, Robot::default());
        assert_eq!(apply(Physics::default()), Ok(nominal.clone()));
        let config =
            varied(&["friction_along=0.15", "stiffness = 70", "link_mass=0.0035", "solver_iterations=8"]).unwrap();
        let robot = &config.robot;
        assert_eq!((robot.friction_along, robot.stiffness, robot.link_mass), (0.15, 70.0, 0.0035));
        assert_eq!(robot.solver_iterations, 8);
        assert_eq!(config.relax_seconds, Some(nominal.robot.relax_seconds()));
        assert_eq!(robot.limits(), nominal.robot.limits());
        let both = Physics { finer: 2, vary: vec!["gravity=100".into()], ..Physics::default() };
        assert_eq!(both.to_string(), "finer=2, gravity=100");
        let config = apply(both).unwrap();
        assert_eq!((config.robot.gravity, config.delay, config.substeps()), (100.0, [2, 2], 20));
    }

    #[test]
    fn what_cannot_be_varied_is_refused_in_one_sentence() {
        for key in ["modules", "torque_limit", "physics_step", "name", "scale", "frictoin"] {
            let message = varied(&[&format!("{key}=1")]).unwrap_err();
            assert!(
                message.contains(&format!("`{key}`; it can change")) && message.contains("friction_along, "),
                "{message}"
            );
        }
        for (assignment, words) in [
            ("gravity", "--vary gravity: no such set of ranges"),
            ("gravity=down", "gravity=down: the value must be a number such as 196.2"),
            ("solver_iterations=1.5", "must be a number such as 60"),
            ("link_mass=-1", "link_mass = -1"),
        ] {
            let message = varied(&[assignment]).unwrap_err();
            assert!(message.contains(words) && !message.contains('\n'), "{message}");
        }
        let message = apply(Physics { tolerance: Some(0.0), ..Physics::default() }).unwrap_err();
        assert!(message.contains("above zero"), "{message}");
    }
}
