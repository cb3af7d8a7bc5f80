//! The rollout buffer: what every environment went through in one iteration, what each policy did in it, advantages over that, and batches
//! gathered from it.

use std::ops::Range;

use super::Valued;
use crate::environment::{Outcome, PRIVILEGED};

/// The steps of all environments in one iteration; entry i of each list is that of environment i.
#[derive(Clone, Debug, Default)]
pub struct RolloutBuffer {
    /// What happened.
    pub trajectories: Vec<Trajectory>,
    /// What the control policy did in it and got for it.
    pub control: Vec<Decisions>,
    /// The same of the policy beside it; empty if there is none.
    pub companion: Vec<Decisions>,
}

impl RolloutBuffer {
    /// Room for so many environments.
    pub fn new(environments: usize) -> Self {
        Self {
            trajectories: vec![Trajectory::default(); environments],
            control: vec![Decisions::default(); environments],
            companion: vec![Decisions::default(); environments],
        }
    }
}

/// The steps of one environment in one iteration, as every policy and critic sees them. Normalised with the statistics the policies
/// acted with.
#[derive(Clone, Debug, Default)]
pub struct Trajectory {
    /// Modules of this environment.
    pub modules: usize,
    /// Normalised observations `[step][module][inputs]`.
    pub observations: Vec<f32>,
    /// Normalised privileged numbers `[step][module][PRIVILEGED]`.
    pub privileged: Vec<f32>,
    /// Who heard whom `[step][module]`, own bit set.
    pub heard: Vec<u64>,
    /// Who acted `[step][module]`.
    pub acts: Vec<bool>,
    /// What the task paid for each step.
    pub rewards: Vec<f32>,
    /// By how much the plan of the policy beside the control policy was missed after each step; empty without one.
    pub companion_errors: Vec<f32>,
    /// Whether the episode ended there for good.
    pub terminated: Vec<bool>,
    /// Whether it was cut off there.
    pub truncated: Vec<bool>,
    /// What was seen after the last step of each episode that was cut off, and after the last step of all: observations like above, in
    /// order.
    pub final_observations: Vec<f32>,
    /// The same, privileged numbers.
    pub final_privileged: Vec<f32>,
    /// The same, who heard whom.
    pub final_heard: Vec<u64>,
    /// Outcomes of the episodes that ended.
    pub episodes: Vec<Outcome>,
}

/// What one policy did in a trajectory.
#[derive(Clone, Debug, Default)]
pub struct Decisions {
    /// Actions, unclipped, `[step][module][outputs]`.
    pub actions: Vec<f32>,
    /// Logarithm of their density `[step][module]`, or `[step][module][outputs]` where each action has a ratio of its own.
    pub log_probabilities: Vec<f32>,
    /// What the modules remembered before each step `[step][module][memory]`; empty for a policy that does not.
    pub memory: Vec<f32>,
    /// What the policy got for each step.
    pub rewards: Vec<f32>,
    /// What each module got for itself, at once, `[step][module]`; empty if nothing. It is added to its advantage.
    pub own: Vec<f32>,
    /// Whether what was decided in each step counted; empty if all did.
    pub counts: Vec<bool>,
    /// What the critic said of each step on its own scale, `[step]` or `[step][module]`, as the advantages and returns.
    pub values: Vec<f32>,
    /// Advantage of each step (see [`Decisions::estimate`]).
    pub advantages: Vec<f32>,
    /// Return of each step on the reward's scale.
    pub returns: Vec<f32>,
}

impl Trajectory {
    /// Empties it for an iteration of an environment with `modules` modules.
    pub fn clear(&mut self, modules: usize) {
        self.modules = modules;
        self.observations.clear();
        self.privileged.clear();
        self.heard.clear();
        self.acts.clear();
        self.rewards.clear();
        self.companion_errors.clear();
        self.terminated.clear();
        self.truncated.clear();
        self.final_observations.clear();
        self.final_privileged.clear();
        self.final_heard.clear();
        self.episodes.clear();
    }

    /// Steps in it.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }

    /// Values of a step.
    pub fn valued(&self, valued: Valued) -> usize {
        if valued == Valued::Team { 1 } else { self.modules }
    }
}

impl Decisions {
    /// Empties it.
    pub fn clear(&mut self) {
        self.actions.clear();
        self.log_probabilities.clear();
        self.memory.clear();
        self.own.clear();
        self.counts.clear();
        self.rewards.clear();
        self.values.clear();
        self.advantages.clear();
        self.returns.clear();
    }

    /// Whether what was decided in a step counted.
    pub fn counted(&self, step: usize) -> bool {
        self.counts.get(step).is_none_or(|counts| *counts)
    }

    /// Generalised advantage estimation (Schulman et al. 2016) over the trajectory that they belong to.
    ///
    /// `values` of the steps and `final_values` of the final views, all on the reward's scale and `width` a step. An episode that was cut
    /// off is worth what the critic says of its last view; one that terminated is worth nothing more.
    pub fn estimate(
        &mut self,
        trajectory: &Trajectory,
        values: &[f32],
        final_values: &[f32],
        width: usize,
        gamma: f32,
        lambda: f32,
    ) {
        let steps = trajectory.steps();
        self.advantages.clear();
        self.advantages.resize(steps * width, 0.0);
        self.returns.clear();
        self.returns.resize(steps * width, 0.0);
        for column in 0..width {
            let mut finals = final_values.iter().skip(column).step_by(width).rev();
            // The last final view follows the last step; it is that of a cut-off episode if the trajectory happens to end with one.
            let mut next = finals.next().copied().unwrap_or(0.0);
            let mut advantage = 0.0;
            for t in (0..steps).rev() {
                if trajectory.terminated[t] {
                    (next, advantage) = (0.0, 0.0);
                } else if trajectory.truncated[t] {
                    if t + 1 < steps {
                        next = finals.next().copied().unwrap_or(0.0);
                    }
                    advantage = 0.0;
                }
                let at = t * width + column;
                advantage = self.rewards[t] + gamma * next - values[at] + gamma * lambda * advantage;
                self.advantages[at] = advantage;
                self.returns[at] = advantage + values[at];
                next = values[at];
            }
        }
    }
}

/// A batch of samples (one sample is one step of one environment) of any numbers of modules; a row is one module of one sample.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Modules of each sample.
    pub modules: Vec<usize>,
    /// Normalised observations, `[rows, inputs]`.
    pub observations: Vec<f32>,
    /// Normalised privileged numbers, `[rows, PRIVILEGED]`.
    pub privileged: Vec<f32>,
    /// Who hears whom, one mask a row, own bit set; bit i stands for module i of the sample.
    pub heard: Vec<u64>,
    /// What each module remembered before, `[rows, memory]`, as it was in the rollout; empty for a policy that does not.
    pub memory: Vec<f32>,
    /// Whether the sample follows the one before it in the same episode, so that what it remembers comes from there; empty if none does.
    pub follows: Vec<bool>,
    /// Weight of each row in the actor's loss: 0 for dead modules.
    pub weights: Vec<f32>,
    /// Actions taken, `[rows, outputs]`.
    pub actions: Vec<f32>,
    /// Logarithm of the density with which each was taken, `[rows]` or `[rows, outputs]`.
    pub log_probabilities: Vec<f32>,
    /// What is added to the advantage of each row; empty if nothing.
    pub own: Vec<f32>,
    /// Advantages, one a sample, or one a row where every module is valued.
    pub advantages: Vec<f32>,
    /// What the critic should say, on its own scale; as many.
    pub targets: Vec<f32>,
    /// What the critic said in the rollout, on its scale of then; as many.
    pub values: Vec<f32>,
}

impl Batch {
    /// Samples in the batch.
    pub fn samples(&self) -> usize {
        self.modules.len()
    }

    /// Modules of all samples together.
    pub fn rows(&self) -> usize {
        self.heard.len()
    }

    /// Some of its rows, which are those of some of its samples; `of_rows`: advantages and values are one a row.
    pub fn part(&self, rows: Range<usize>, samples: Range<usize>, of_rows: bool) -> Batch {
        let all = self.rows().max(1);
        let of = |numbers: &[f32]| {
            let width = numbers.len() / all;
            numbers[rows.start * width..rows.end * width].to_vec()
        };
        let valued = if of_rows { rows.clone() } else { samples.clone() };
        let valued = |numbers: &[f32]| numbers[valued.clone()].to_vec();
        Batch {
            modules: self.modules[samples.clone()].to_vec(),
            observations: of(&self.observations),
            privileged: of(&self.privileged),
            heard: self.heard[rows.clone()].to_vec(),
            memory: of(&self.memory),
            own: of(&self.own),
            follows: self.follows.get(samples.clone()).unwrap_or_default().to_vec(),
            weights: of(&self.weights),
            actions: of(&self.actions),
            log_probabilities: of(&self.log_probabilities),
            advantages: valued(&self.advantages),
            targets: valued(&self.targets),
            values: valued(&self.values),
        }
    }

    /// Empties the batch and keeps its memory.
    pub fn clear(&mut self) {
        let Self {
            modules, heard, observations, privileged, memory, follows, weights, actions, log_probabilities, ..
        } = self;
        modules.clear();
        heard.clear();
        follows.clear();
        for numbers in [observations, privileged, memory, weights, actions, log_probabilities] {
            numbers.clear();
        }
        for numbers in [&mut self.advantages, &mut self.targets, &mut self.values, &mut self.own] {
            numbers.clear();
        }
    }
}

/// Gathers (trajectory, step) samples into `batch` in place of what it held; decisions i belong to trajectory i.
///
/// `weight` is what a module that acts weighs in the actor's loss. Everything a policy was limited by in the rollout (who heard whom,
/// who acted) comes along, or the ratio of the new to the old policy would be wrong.
pub fn gather(
    (trajectories, decisions): (&[Trajectory], &[Decisions]),
    samples: &[(u32, u32)],
    valued: Valued,
    weight: f32,
    target: impl Fn(f32) -> f32,
    batch: &mut Batch,
) {
    batch.clear();
    let mut last = None;
    for (index, step) in samples {
        let (trajectory, decisions) = (&trajectories[*index as usize], &decisions[*index as usize]);
        let (n, step) = (trajectory.modules, *step as usize);
        let at = step * n..(step + 1) * n;
        let part = |all: &[f32]| {
            let width = all.len() / trajectory.steps();
            step * width..(step + 1) * width
        };
        batch.modules.push(n);
        batch.observations.extend_from_slice(&trajectory.observations[part(&trajectory.observations)]);
        batch.memory.extend_from_slice(&decisions.memory[part(&decisions.memory)]);
        batch.own.extend_from_slice(&decisions.own[part(&decisions.own)]);
        let ended = |step: usize| trajectory.terminated[step] || trajectory.truncated[step];
        batch.follows.push(step > 0 && last == Some((*index, step - 1)) && !ended(step - 1));
        last = Some((*index, step));
        batch.privileged.extend_from_slice(&trajectory.privileged[at.start * PRIVILEGED..at.end * PRIVILEGED]);
        batch.heard.extend_from_slice(&trajectory.heard[at.clone()]);
        let counted = decisions.counted(step);
        batch.weights.extend(trajectory.acts[at].iter().map(|acts| if *acts && counted { weight } else { 0.0 }));
        batch.actions.extend_from_slice(&decisions.actions[part(&decisions.actions)]);
        let log_probabilities = &decisions.log_probabilities;
        batch.log_probabilities.extend_from_slice(&log_probabilities[part(log_probabilities)]);
        let width = trajectory.valued(valued);
        let valued = step * width..(step + 1) * width;
        let of = |numbers: &[f32]| numbers.get(valued.clone()).map_or_else(|| vec![0.0; width], <[f32]>::to_vec);
        batch.advantages.extend(of(&decisions.advantages));
        batch.targets.extend(of(&decisions.returns).into_iter().map(&target));
        batch.values.extend(of(&decisions.values));
    }
}

#[cfg(test)]
mod tests {
    use composer_shared::observation::BASE;

    use super::*;

    #[test]
    fn advantages_by_hand_with_termination_and_truncation() {
        let rewards = vec![1.0, 2.0, 3.0, 4.0, 5.0];
        let mut decisions = Decisions { rewards: rewards.clone(), ..Decisions::default() };
        let trajectory = Trajectory {
            modules: 1,
            rewards,
            terminated: vec![false, true, false, false, false],
            truncated: vec![false, false, false, true, false],
            ..Trajectory::default()
        };
        // gamma 0.5, lambda 0.5; values 10, 20, 30, 40, 50; cut off at step 3 where the critic says 8; the trajectory goes on to 6.
        decisions.estimate(&trajectory, &[10.0, 20.0, 30.0, 40.0, 50.0], &[8.0, 6.0], 1, 0.5, 0.5);
        // Step 4: 5 + 0.5*6 - 50 = -42.  Step 3: 4 + 0.5*8 - 40 = -32, nothing of step 4.
        // Step 2: 3 + 0.5*40 - 30 + 0.25*-32 = -15.  Step 1: 2 - 20 = -18.  Step 0: 1 + 0.5*20 - 10 + 0.25*-18 = -3.5.
        assert_eq!(decisions.advantages, [-3.5, -18.0, -15.0, -32.0, -42.0]);
        assert_eq!(decisions.returns, [6.5, 2.0, 15.0, 8.0, 8.0]);
    }

    #[test]
    fn a_trajectory_that_ends_with_an_episode_uses_that_final_view() {
        let mut decisions = Decisions { rewards: vec![0.0, 1.0], ..Decisions::default() };
        let mut trajectory = Trajectory {
            modules: 1,
            rewards: vec![0.0, 1.0],
            terminated: vec![false, false],
            truncated: vec![true, true],
            ..Trajectory::default()
        };
        decisions.estimate(&trajectory, &[1.0, 2.0], &[10.0, 20.0], 1, 1.0, 1.0);
        assert_eq!(decisions.advantages, [9.0, 19.0]);
        trajectory.terminated[1] = true;
        // A terminated end needs no value, but its place among the final views is kept.
        trajectory.truncated[1] = false;
        decisions.estimate(&trajectory, &[1.0, 2.0], &[10.0, 0.0], 1, 1.0, 1.0);
        assert_eq!(decisions.advantages, [9.0, -1.0]);
    }

    #[test]
    fn samples_of_different_lengths_lie_one_after_the_other() {
        let trajectory = |modules: usize| Trajectory {
            modules,
            rewards: vec![0.0; 2],
            observations: (0..2 * modules * BASE).map(|i| i as f32).collect(),
            privileged: (0..2 * modules * PRIVILEGED).map(|i| -(i as f32)).collect(),
            heard: (0..2 * modules as u64).collect(),
            acts: (0..2 * modules).map(|i| i != 1).collect(),
            ..Trajectory::default()
        };
        let decisions = |modules: usize| Decisions {
            actions: (0..2 * modules).flat_map(|i| [i as f32, 0.5]).collect(),
            log_probabilities: (0..2 * modules).map(|i| i as f32).collect(),
            advantages: vec![1.0, 2.0],
            returns: vec![3.0, 4.0],
            ..Decisions::default()
        };
        let (trajectories, decisions) = ([trajectory(3), trajectory(2)], [decisions(3), decisions(2)]);
        // What an earlier batch left behind does not matter.
        let mut batch = Batch { modules: vec![7], weights: vec![7.0], ..Batch::default() };
        gather((&trajectories, &decisions), &[(1, 0), (0, 1)], Valued::Team, 0.25, |r| r * 2.0, &mut batch);
        assert_eq!((batch.samples(), batch.rows()), (2, 5));
        assert_eq!(batch.modules, [2, 3]);
        assert_eq!(batch.weights, [0.25, 0.0, 0.25, 0.25, 0.25]);
        assert_eq!(batch.heard, [0, 1, 3, 4, 5]);
        assert_eq!(batch.targets, [6.0, 8.0]);
        assert_eq!(batch.advantages, [1.0, 2.0]);
        assert_eq!(batch.log_probabilities, [0.0, 1.0, 3.0, 4.0, 5.0]);
        assert_eq!(batch.actions[2..6], [1.0, 0.5, 3.0, 0.5]);
        assert_eq!(batch.observations.len(), 5 * BASE);
        assert_eq!(batch.observations[2 * BASE], (3 * BASE) as f32);
        assert_eq!(batch.privileged[2 * PRIVILEGED + 1], -((3 * PRIVILEGED + 1) as f32));
    }

    #[test]
    fn every_module_can_have_a_value_of_its_own() {
        let rewards = vec![1.0, 2.0];
        let mut decisions = Decisions { rewards: rewards.clone(), ..Decisions::default() };
        let trajectory = Trajectory {
            modules: 2,
            rewards,
            terminated: vec![false; 2],
            truncated: vec![false; 2],
            observations: vec![0.0; 4 * BASE],
            privileged: vec![0.0; 4 * PRIVILEGED],
            heard: vec![3; 4],
            acts: vec![true; 4],
            ..Trajectory::default()
        };
        decisions.actions = vec![0.0; 8];
        decisions.log_probabilities = (0..8).map(|i| i as f32).collect();
        decisions.estimate(&trajectory, &[10.0, 20.0, 30.0, 40.0], &[4.0, 6.0], 2, 0.5, 0.5);
        // Module 0: step 1: 2 + 2 - 30, step 0: 1 + 15 - 10 + 0.25 of that. Module 1: 2 + 3 - 40, 1 + 20 - 20 + 0.25 of that.
        assert_eq!(decisions.advantages, [-0.5, -7.75, -26.0, -35.0]);
        let mut batch = Batch::default();
        gather((&[trajectory], &[decisions]), &[(0, 1)], Valued::Module, 1.0, |r| r, &mut batch);
        assert_eq!((batch.advantages, batch.targets), (vec![-26.0, -35.0], vec![4.0, 5.0]));
        assert_eq!(batch.log_probabilities, [4.0, 5.0, 6.0, 7.0]);
    }
}
