//! `snakectl mjcf`: robot and scene as a model for MuJoCo.

use std::path::PathBuf;

use anyhow::Result;
use composer_shared::policy::Task;

use super::task_by_name;
use crate::env::EnvConfig;
use crate::eval::episode_seed;
use crate::files::write_whole;
use crate::mjcf::{Options, mjcf};
use crate::robot::Robot;
use crate::sim::Scene;

/// Arguments of `mjcf`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Robot file [default: the paper's 8 x 4 links]
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Modules of the snake, 1 to 64 [default: the robot's]
    #[arg(long)]
    modules: Option<usize>,
    /// Put in the scene of this task [default: bare ground]
    #[arg(long, value_parser = task_by_name)]
    task: Option<Task>,
    /// Which scene: that of the first episode that `eval` and `sil` run with this seed
    #[arg(long, default_value_t = 1, requires = "task")]
    seed: u64,
    /// Put a motor on every joint; without, torques are applied to the joints
    #[arg(long)]
    motors: bool,
    /// Write to this file [default: standard output]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let mut robot = arguments.robot.as_deref().map(Robot::load).transpose()?.unwrap_or_default();
    if let Some(modules) = arguments.modules {
        robot = robot.with_modules(modules)?;
    }
    let scene = match arguments.task {
        None => Scene::default(),
        Some(task) => {
            let config = EnvConfig::new(task, robot.clone());
            config.task.validate(&robot).map_err(anyhow::Error::msg)?;
            config.task.rules().course(episode_seed(arguments.seed, 0), &robot).scene
        }
    };
    let xml = mjcf(&robot, &scene, Options { motors: arguments.motors });
    match &arguments.output {
        Some(path) => {
            write_whole(path, xml.as_bytes())?;
            println!("written: {}", path.display());
        }
        None => print!("{xml}"),
    }
    Ok(())
}
