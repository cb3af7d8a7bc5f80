//! Where the modules attend during one successful episode: the paper's attention figure (section IV-D).

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};

use crate::env::SnakeEnv;
use crate::environment::{Environment, View};
use crate::eval::{DEFAULT_SEED, episode_seed};
use crate::files::write_whole;
use crate::plot::{Heatmap, MapWords, heatmaps};
use crate::policy::{Memories, Policy};
use crate::run::RunConfig;

/// Matrices in the figure, evenly over the episode.
const MAPS: usize = 5;
/// Episodes that are tried for a successful one.
const TRIED: u64 = 100;

/// Draws the attention matrices of the first successful episode of a policy; without one there is no figure, and a line says so.
pub fn write(config: &RunConfig, policy: &dyn Policy, path: &Path) -> Result<()> {
    let env = Arc::new(config.evaluation());
    for index in 0..TRIED {
        let Some(matrices) = successful(&env, policy, episode_seed(DEFAULT_SEED, index))? else { continue };
        let last = matrices.len() - 1;
        let maps = (0..MAPS).map(|k| {
            let step = k * last / (MAPS - 1);
            Heatmap {
                title: format!("t = {:.2} s", step as f32 * config.env.control_period),
                modules: env.robot.modules,
                weights: matrices[step].clone(),
            }
        });
        let words = MapWords {
            title: format!("{}: attention in a successful episode", config.task.name.title()),
            columns: "module attended to".into(),
            rows: "attending module".into(),
            largest: None,
        };
        return write_whole(path, heatmaps(&maps.collect::<Vec<_>>(), &words).as_bytes());
    }
    eprintln!("note: {} succeeded in none of {TRIED} episodes, so there is no attention figure", config.task.name);
    Ok(())
}

/// The attention matrix of every control step of an episode, if it succeeds.
fn successful(env: &Arc<crate::env::EnvConfig>, policy: &dyn Policy, seed: u64) -> Result<Option<Vec<Vec<f32>>>> {
    let mut env = SnakeEnv::new(env.clone());
    env.reset_with(seed, &[]);
    let (mut view, mut actions, mut matrices) = (View::default(), Vec::new(), Vec::new());
    let mut memories = Memories::default();
    loop {
        let mut attention = Vec::new();
        env.view(&mut view);
        policy.act(&view, 0, &mut memories, &mut actions, Some(&mut attention));
        if attention.is_empty() {
            bail!("the policy has no attention to draw");
        }
        matrices.push(attention);
        let outcome = env.step(&actions);
        if outcome.terminated || outcome.truncated {
            return Ok(outcome.success.then_some(matrices));
        }
    }
}
