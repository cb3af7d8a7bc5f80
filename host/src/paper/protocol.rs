//! How everything in the comparison is trained: the paper's protocol (section IV), the same for every method.
//!
//! - Eight modules, nothing broken, no latent missed, every module told the goal; nominal robot, its sensors as their datasheets have them.
//! - Every method gets the same environment steps and the same reward, that of the policies that ship: progress, with their penalty on rearing up.
//! - Each method has its authors' settings ([`crate::methods::config`]), COMPOSER and its ablations the learning rate of the policies that ship.
//! - SMP has fewer updates and narrower networks than its authors gave it ([`SMP_WIDTHS`]); with theirs, an update takes longer than a hundred
//!   environment steps.
//! - Three seeds, and for each run learning curves on episodes of its own.

use composer_shared::policy::Task;

use crate::methods::Method;
use crate::run::RunConfig;

/// The methods, the cheap ones first.
pub const METHODS: [Method; 8] = [
    Method::Composer,
    Method::ComposerNoImagination,
    Method::ComposerNoAttention,
    Method::Mappo,
    Method::Ppo,
    Method::MatDec,
    Method::Mat,
    Method::Smp,
];
/// The seeds.
pub const SEEDS: [u64; 3] = [1, 2, 3];
/// Environment steps of a run.
pub const STEPS: u64 = 500_000;
/// Points of a learning curve after its start.
pub const CURVE_POINTS: u64 = 10;
/// Episodes of a point: of at most 125 steps, so that all points together take less than a tenth of the steps of the run.
pub const CURVE_EPISODES: u64 = 40;
/// Learning rate of COMPOSER and its ablations at the start: that of the policies that ship.
pub const COMPOSER_RATE: f64 = 7e-4;
/// Widths of the hidden layers of SMP's networks on the way down; its authors' are 400 and 300.
pub const SMP_WIDTHS: [usize; 2] = [64, 64];
/// SMP's updates for each environment step; its authors' is 1.
pub const SMP_UPDATES_PER_STEP: f64 = 0.05;
/// SMP's replay buffer, transitions; its authors' holds a million.
const SMP_REPLAY: usize = 100_000;

/// Environment steps for a task where every other one gets `steps`: of Block Pushing twice as many, as it takes so long to begin.
pub fn steps(task: Task, steps: u64) -> u64 {
    steps.saturating_mul(if task == Task::BlockPushing { 2 } else { 1 })
}

/// What a unit of rearing up costs a control step, as for the policies that ship.
fn rearing_penalty(task: Task) -> f32 {
    match task {
        Task::GoalReaching => 0.4,
        Task::ShapeFormation => 0.1,
        Task::TubeCrossing => 0.2,
        Task::BlockPushing | Task::WallClimbing => 0.0,
    }
}

/// All settings of a run; `each`: environment steps of each run, of Block Pushing twice as many.
pub fn settings(task: Task, method: Method, seed: u64, each: Option<u64>) -> RunConfig {
    let mut config = RunConfig::default();
    config.task.name = task;
    config.task.rearing_penalty = rearing_penalty(task);
    let train = &mut config.train;
    train.method = method;
    train.seed = seed;
    train.total_steps = steps(task, each.unwrap_or(STEPS));
    train.evaluate_every = (train.total_steps / CURVE_POINTS).max(1);
    train.evaluation_episodes = CURVE_EPISODES;
    train.learning_rate = COMPOSER_RATE;
    if method == Method::Smp {
        train.smp.widths = SMP_WIDTHS;
        train.smp.updates_per_step = SMP_UPDATES_PER_STEP;
        train.smp.replay = SMP_REPLAY;
        // The whole buffer goes into it.
        train.checkpoint_seconds = 600.0;
    }
    config
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::FaultTraining;
    use crate::run::EnvSettings;
    use crate::tasks::Reward;
    use crate::vary::Variation;

    #[test]
    fn every_method_learns_the_same_task_on_healthy_snakes_for_as_long() {
        for task in Task::ALL {
            let first = settings(task, METHODS[0], 1, None);
            for method in METHODS {
                let config = settings(task, method, 1, None);
                config.validate().unwrap();
                assert_eq!((config.train.method, config.train.total_steps), (method, first.train.total_steps));
                assert_eq!(RunConfig { train: first.train.clone(), ..config.clone() }, first);
                assert_eq!(config.robot.modules, 8);
                assert_eq!((&config.env, &config.vary), (&EnvSettings::default(), &Variation::default()));
                assert_eq!(
                    config.faults,
                    FaultTraining { probability: 0.0, missed_latents: 0.0, ..config.faults.clone() }
                );
                assert_eq!(config.task.reward, Reward::Progress);
                // The points of the curves cost less than a tenth of the steps.
                let of_curve = CURVE_POINTS * CURVE_EPISODES * u64::from(config.task.cap_for(8));
                assert!(10 * of_curve <= config.train.total_steps, "{task}: {of_curve}");
            }
        }
    }
}
