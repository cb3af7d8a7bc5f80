//! What a rollout leaves behind: one lane per environment and in it one track per policy, advantages over them, and batches gathered
//! from them.

use composer_shared::observation::SIZE;

use super::actor_critic::{Batch, OUT};
use super::imagination::DISPLACEMENT;
use crate::environment::{Outcome, PRIVILEGED};

/// The steps of all environments in one iteration; entry i of each list is that of environment i.
#[derive(Clone, Debug, Default)]
pub struct Experience {
    /// What happened.
    pub lanes: Vec<Lane>,
    /// What the control policy did in it and got for it.
    pub control: Vec<Track<OUT>>,
    /// The same of the imagination policy; empty tracks if there is none.
    pub imagination: Vec<Track<DISPLACEMENT>>,
}

impl Experience {
    /// Room for so many environments.
    pub fn new(environments: usize) -> Self {
        Self {
            lanes: vec![Lane::default(); environments],
            control: vec![Track::default(); environments],
            imagination: vec![Track::default(); environments],
        }
    }
}

/// The steps of one environment in one iteration, as every policy and critic sees them. Normalised with the statistics the policies
/// acted with.
#[derive(Clone, Debug, Default)]
pub struct Lane {
    /// Modules of this environment.
    pub modules: usize,
    /// Normalised observations `[step][module][SIZE]`.
    pub observations: Vec<f32>,
    /// Normalised privileged numbers `[step][module][PRIVILEGED]`.
    pub privileged: Vec<f32>,
    /// Who heard whom `[step][module]`, own bit set.
    pub heard: Vec<u64>,
    /// Who acted `[step][module]`.
    pub acts: Vec<bool>,
    /// What the task paid for each step.
    pub rewards: Vec<f32>,
    /// How far the modules were from where they had been imagined after each step, mean, units; empty without imagination.
    pub follow_errors: Vec<f32>,
    /// Whether the episode ended there for good.
    pub terminated: Vec<bool>,
    /// Whether it was cut off there.
    pub truncated: Vec<bool>,
    /// What was seen after the last step of each episode that was cut off, and after the last step of the lane: observations like
    /// above, in order.
    pub final_observations: Vec<f32>,
    /// The same, privileged numbers.
    pub final_privileged: Vec<f32>,
    /// Outcomes of the episodes that ended.
    pub episodes: Vec<Outcome>,
}

/// What one policy with `A` actions a module did in a lane.
#[derive(Clone, Debug, Default)]
pub struct Track<const A: usize> {
    /// Actions, unclipped, `[step][module]`.
    pub actions: Vec<[f32; A]>,
    /// Logarithm of their density `[step][module]`.
    pub log_probabilities: Vec<f32>,
    /// What the policy got for each step.
    pub rewards: Vec<f32>,
    /// Advantage of each step (see [`Track::estimate`]).
    pub advantages: Vec<f32>,
    /// Return of each step on the reward's scale.
    pub returns: Vec<f32>,
}

impl Lane {
    /// Empties the lane for an iteration of an environment with `modules` modules.
    pub fn clear(&mut self, modules: usize) {
        self.modules = modules;
        self.observations.clear();
        self.privileged.clear();
        self.heard.clear();
        self.acts.clear();
        self.rewards.clear();
        self.follow_errors.clear();
        self.terminated.clear();
        self.truncated.clear();
        self.final_observations.clear();
        self.final_privileged.clear();
        self.episodes.clear();
    }

    /// Steps in the lane.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }
}

impl<const A: usize> Track<A> {
    /// Empties the track.
    pub fn clear(&mut self) {
        self.actions.clear();
        self.log_probabilities.clear();
        self.rewards.clear();
        self.advantages.clear();
        self.returns.clear();
    }

    /// Generalised advantage estimation (Schulman et al. 2016) over the lane that the track belongs to.
    ///
    /// `values` of the steps and `final_values` of the final views, both on the reward's scale. An episode that was cut off is worth
    /// what the critic says of its last view; one that terminated is worth nothing more.
    pub fn estimate(&mut self, lane: &Lane, values: &[f32], final_values: &[f32], gamma: f32, lambda: f32) {
        let steps = lane.steps();
        self.advantages.clear();
        self.advantages.resize(steps, 0.0);
        self.returns.clear();
        self.returns.resize(steps, 0.0);
        let mut finals = final_values.iter().rev();
        // The last final view follows the last step; it is that of a cut-off episode if the lane happens to end with one.
        let mut next = finals.next().copied().unwrap_or(0.0);
        let mut advantage = 0.0;
        for t in (0..steps).rev() {
            if lane.terminated[t] {
                (next, advantage) = (0.0, 0.0);
            } else if lane.truncated[t] {
                if t + 1 < steps {
                    next = finals.next().copied().unwrap_or(0.0);
                }
                advantage = 0.0;
            }
            advantage = self.rewards[t] + gamma * next - values[t] + gamma * lambda * advantage;
            self.advantages[t] = advantage;
            self.returns[t] = advantage + values[t];
            next = values[t];
        }
    }
}

/// Gathers (lane, step) samples into `batch` in place of what it held; track i belongs to lane i.
///
/// `weight` is what a module that acts weighs in the actor's loss. Everything a policy was limited by in the rollout (who heard whom,
/// who acted) comes along, or the ratio of the new to the old policy would be wrong.
pub fn gather<const A: usize>(
    (lanes, tracks): (&[Lane], &[Track<A>]),
    samples: &[(u32, u32)],
    weight: f32,
    target: impl Fn(f32) -> f32,
    batch: &mut Batch,
) {
    batch.clear();
    for (lane, step) in samples {
        let (lane, track, step) = (&lanes[*lane as usize], &tracks[*lane as usize], *step as usize);
        let n = lane.modules;
        let at = step * n..(step + 1) * n;
        batch.modules.push(n);
        batch.observations.extend_from_slice(&lane.observations[at.start * SIZE..at.end * SIZE]);
        batch.privileged.extend_from_slice(&lane.privileged[at.start * PRIVILEGED..at.end * PRIVILEGED]);
        batch.heard.extend_from_slice(&lane.heard[at.clone()]);
        batch.weights.extend(lane.acts[at.clone()].iter().map(|acts| if *acts { weight } else { 0.0 }));
        batch.actions.extend_from_slice(track.actions[at.clone()].as_flattened());
        batch.log_probabilities.extend_from_slice(&track.log_probabilities[at]);
        batch.advantages.push(track.advantages.get(step).copied().unwrap_or(0.0));
        batch.targets.push(target(track.returns.get(step).copied().unwrap_or(0.0)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_by_hand_with_termination_and_truncation() {
        let rewards = vec![1.0, 2.0, 3.0, 4.0, 5.0];
        let mut track = Track::<1> { rewards: rewards.clone(), ..Track::default() };
        let lane = Lane {
            modules: 1,
            rewards,
            terminated: vec![false, true, false, false, false],
            truncated: vec![false, false, false, true, false],
            ..Lane::default()
        };
        // gamma 0.5, lambda 0.5; values 10, 20, 30, 40, 50; cut off at step 3 where the critic says 8; the lane goes on to 6.
        track.estimate(&lane, &[10.0, 20.0, 30.0, 40.0, 50.0], &[8.0, 6.0], 0.5, 0.5);
        // Step 4: 5 + 0.5*6 - 50 = -42.  Step 3: 4 + 0.5*8 - 40 = -32, nothing of step 4.
        // Step 2: 3 + 0.5*40 - 30 + 0.25*-32 = -15.  Step 1: 2 - 20 = -18.  Step 0: 1 + 0.5*20 - 10 + 0.25*-18 = -3.5.
        assert_eq!(track.advantages, [-3.5, -18.0, -15.0, -32.0, -42.0]);
        assert_eq!(track.returns, [6.5, 2.0, 15.0, 8.0, 8.0]);
    }

    #[test]
    fn a_lane_that_ends_with_an_episode_uses_that_final_view() {
        let mut track = Track::<1> { rewards: vec![0.0, 1.0], ..Track::default() };
        let mut lane = Lane {
            modules: 1,
            rewards: vec![0.0, 1.0],
            terminated: vec![false, false],
            truncated: vec![true, true],
            ..Lane::default()
        };
        track.estimate(&lane, &[1.0, 2.0], &[10.0, 20.0], 1.0, 1.0);
        assert_eq!(track.advantages, [9.0, 19.0]);
        lane.terminated[1] = true;
        // A terminated end needs no value, but its place among the final views is kept.
        lane.truncated[1] = false;
        track.estimate(&lane, &[1.0, 2.0], &[10.0, 0.0], 1.0, 1.0);
        assert_eq!(track.advantages, [9.0, -1.0]);
    }

    #[test]
    fn samples_of_different_lengths_lie_one_after_the_other() {
        let lane = |modules: usize| Lane {
            modules,
            rewards: vec![0.0; 2],
            observations: (0..2 * modules * SIZE).map(|i| i as f32).collect(),
            privileged: (0..2 * modules * PRIVILEGED).map(|i| -(i as f32)).collect(),
            heard: (0..2 * modules as u64).collect(),
            acts: (0..2 * modules).map(|i| i != 1).collect(),
            ..Lane::default()
        };
        let track = |modules: usize| Track {
            actions: (0..2 * modules).map(|i| [i as f32, 0.5]).collect(),
            log_probabilities: (0..2 * modules).map(|i| i as f32).collect(),
            advantages: vec![1.0, 2.0],
            returns: vec![3.0, 4.0],
            ..Track::default()
        };
        let (lanes, tracks) = ([lane(3), lane(2)], [track(3), track(2)]);
        // What an earlier batch left behind does not matter.
        let mut batch = Batch { modules: vec![7], weights: vec![7.0], ..Batch::default() };
        gather((&lanes, &tracks), &[(1, 0), (0, 1)], 0.25, |r| r * 2.0, &mut batch);
        assert_eq!((batch.samples(), batch.rows()), (2, 5));
        assert_eq!(batch.modules, [2, 3]);
        assert_eq!(batch.weights, [0.25, 0.0, 0.25, 0.25, 0.25]);
        assert_eq!(batch.heard, [0, 1, 3, 4, 5]);
        assert_eq!(batch.targets, [6.0, 8.0]);
        assert_eq!(batch.advantages, [1.0, 2.0]);
        assert_eq!(batch.log_probabilities, [0.0, 1.0, 3.0, 4.0, 5.0]);
        assert_eq!(batch.actions[2..6], [1.0, 0.5, 3.0, 0.5]);
        assert_eq!(batch.observations.len(), 5 * SIZE);
        assert_eq!(batch.observations[2 * SIZE], (3 * SIZE) as f32);
        assert_eq!(batch.privileged[2 * PRIVILEGED + 1], -((3 * PRIVILEGED + 1) as f32));
    }
}
