//! Networks that leave their gradients to automatic differentiation: a method says how its networks compute, the rest of an
//! [`ActorCritic`] is here. The place to begin for a new method.

use burn::tensor::Tensor;
use composer_shared::observation::BASE;

use super::collect::ACTIONS;
use super::losses::{ValueLoss, entropy, log_density, policy_loss, value_loss};
use super::{ActorCritic, Batch, Gradient, Learner, LossSettings, Part, Ratio, Teams, Valued};
use crate::methods::TrainedPolicy;
use crate::methods::layout::Layout;
use crate::methods::normalise::Forgetting;
use crate::methods::tensors::{Weights, floats, scalar};

/// What some teams of equal length see, as tensors.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Teams.
    pub teams: usize,
    /// Modules of each.
    pub modules: usize,
    /// Observations, `[teams * modules, BASE]`.
    pub observations: Tensor<2>,
    /// Added to the score that module i (second index) gives module j: 0, or -1e9 where it is not heard; `[teams, modules, modules]`.
    pub mask: Tensor<3>,
}

/// What the losses need of the networks.
pub struct Evaluation {
    /// Means of the actions, `[rows, outputs]`.
    pub means: Tensor<2>,
    /// Their standard deviations, `[rows or 1, outputs]`.
    pub sigma: Tensor<2>,
    /// Values, `[teams or rows, 1]`.
    pub values: Tensor<2>,
}

/// The networks of a method, as functions of their weights.
pub trait TensorNetworks: Clone + Send + Sync + 'static {
    /// The actor's parameters and the critic's, or all and none where one optimiser steps both.
    fn layouts(&self) -> [Layout; 2];

    /// What the ratio is taken over.
    fn ratio(&self) -> Ratio;

    /// What is valued.
    fn valued(&self) -> Valued;

    /// The loss of the values.
    fn value_loss(&self) -> ValueLoss;

    /// Whether entropies are summed over the actions of a row (else their mean counts), and over the rows of a team.
    fn entropy_sums(&self) -> [bool; 2];

    /// Actions of a module.
    fn outputs(&self) -> usize {
        ACTIONS
    }

    /// Means and standard deviations of the actions, and the values, given the actions that were taken, `[rows, outputs]`.
    fn evaluate(&self, weights: &Weights, seen: &Seen, actions: Tensor<2>) -> Evaluation;

    /// The values alone.
    fn values(&self, weights: &Weights, seen: &Seen) -> Tensor<2>;

    /// Means and standard deviations of the actions, where no action depends on another: what [`TensorNetworks::act`] needs.
    fn distribution(&self, weights: &Weights, seen: &Seen) -> (Tensor<2>, Tensor<2>);

    /// Actions and the logarithms of their densities, both `[rows, outputs]`, with standard normal `noise`.
    fn act(&self, weights: &Weights, seen: &Seen, noise: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let (means, sigma) = self.distribution(weights, seen);
        let actions = means.clone() + sigma.clone() * noise;
        (actions.clone(), log_density(actions, means, sigma))
    }

    /// Logarithm of the standard deviation of each action in the actor's parameters.
    fn log_sigma(&self, actor: &[f32]) -> Vec<f32>;

    /// What evaluation runs.
    fn policy(&self, parameters: &[f32], mean: &[f32], std: &[f32]) -> TrainedPolicy;
}

/// An [`ActorCritic`] out of [`TensorNetworks`].
#[derive(Clone, Debug)]
pub struct Autodiff<N> {
    /// The networks.
    pub networks: N,
    /// The layout of all parameters, the actor's part first.
    layout: Layout,
    /// Numbers in the actor's part.
    of_actor: usize,
    parameters: Vec<f32>,
    weights: Weights,
}

impl<N: TensorNetworks> Autodiff<N> {
    /// Networks with these parameters, the actor's part first.
    pub fn new(networks: N, parameters: Vec<f32>) -> Self {
        let [actor, critic] = networks.layouts();
        let of_actor = actor.len();
        let layout = actor.followed_by(&critic);
        Self { weights: Weights::new(&layout, &parameters), networks, layout, of_actor, parameters }
    }

    /// The layout of all parameters, the actor's part first.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// The weights as they are.
    pub fn weights(&self) -> &Weights {
        &self.weights
    }
}

/// Added to the score of a module that is not heard.
const UNHEARD: f32 = -1e9;

/// What some teams of `modules` modules each see, beside `weights`.
pub fn seen(weights: &Weights, observations: &[f32], heard: &[u64], modules: usize) -> Seen {
    let teams = heard.len() / modules;
    let of = |heard: &u64| {
        let heard = *heard;
        (0..modules).map(move |other| if heard >> other & 1 == 0 { UNHEARD } else { 0.0 })
    };
    let mask: Vec<f32> = heard.iter().flat_map(of).collect();
    Seen {
        teams,
        modules,
        observations: weights.tensor(observations, [heard.len(), BASE]),
        mask: weights.tensor(&mask, [teams, modules, modules]),
    }
}

/// Runs of teams of equal length, in order: (modules, first row, rows, first team, teams).
fn runs(modules: &[usize]) -> Vec<(usize, std::ops::Range<usize>, std::ops::Range<usize>)> {
    let mut runs: Vec<(usize, std::ops::Range<usize>, std::ops::Range<usize>)> = Vec::new();
    let mut row = 0;
    for (team, n) in modules.iter().enumerate() {
        match runs.last_mut() {
            Some((length, rows, teams)) if length == n => (rows.end, teams.end) = (row + n, team + 1),
            _ => runs.push((*n, row..row + n, team..team + 1)),
        }
        row += n;
    }
    runs
}

impl<N: TensorNetworks> ActorCritic for Autodiff<N> {
    type Scratch = ();

    const TOGETHER: usize = 8;

    fn block(&self) -> usize {
        64
    }

    fn outputs(&self) -> usize {
        self.networks.outputs()
    }

    fn ratio(&self) -> Ratio {
        self.networks.ratio()
    }

    fn valued(&self) -> Valued {
        self.networks.valued()
    }

    fn log_sigma(&self) -> Vec<f32> {
        self.networks.log_sigma(&self.parameters[..self.of_actor])
    }

    fn load(&mut self, part: Part, parameters: &[f32]) {
        let (actor, critic) = self.parameters.split_at_mut(self.of_actor);
        match part {
            Part::Actor => actor.copy_from_slice(parameters),
            Part::Critic => critic.copy_from_slice(parameters),
        }
        self.weights = Weights::new(&self.layout, &self.parameters);
    }

    fn sample(
        &self,
        teams: Teams,
        noise: &[f32],
        _scratch: &mut (),
        actions: &mut Vec<f32>,
        log_probabilities: &mut Vec<f32>,
    ) {
        let outputs = self.outputs();
        for (modules, rows, _) in runs(teams.modules) {
            let observations = &teams.observations[rows.start * BASE..rows.end * BASE];
            let seen = seen(&self.weights, observations, &teams.heard[rows.clone()], modules);
            let noise = &noise[rows.start * outputs..rows.end * outputs];
            let noise = self.weights.tensor(noise, [rows.len(), outputs]);
            let (drawn, densities) = self.networks.act(&self.weights, &seen, noise);
            actions.extend(floats(drawn));
            log_probabilities.extend(floats(match self.ratio() {
                Ratio::Dimension => densities,
                Ratio::Module | Ratio::Team => densities.sum_dim(1),
            }));
        }
    }

    fn values(&self, teams: Teams, _scratch: &mut (), values: &mut Vec<f32>) {
        for (modules, rows, _) in runs(teams.modules) {
            let observations = &teams.observations[rows.start * BASE..rows.end * BASE];
            let seen = seen(&self.weights, observations, &teams.heard[rows], modules);
            values.extend(floats(self.networks.values(&self.weights, &seen)));
        }
    }

    fn gradient(
        &self,
        batch: &Batch,
        loss: LossSettings,
        _scratch: &mut (),
        actor: Option<&mut Gradient>,
        critic: Option<&mut Gradient>,
    ) {
        let (networks, outputs) = (&self.networks, self.outputs());
        let mut sum = Gradient::default();
        sum.clear(self.layout.len());
        for (modules, rows, teams) in runs(&batch.modules) {
            let batch = batch.part(rows, teams, networks.valued() == Valued::Module);
            let weights = Weights::tracked(&self.layout, &self.parameters);
            let seen = seen(&weights, &batch.observations, &batch.heard, modules);
            let actions = weights.tensor(&batch.actions, [batch.rows(), outputs]);
            let Evaluation { means, sigma, values } = networks.evaluate(&weights, &seen, actions.clone());
            let to_tensor = |numbers: &[f32], shape: [usize; 2]| weights.tensor(numbers, shape);
            let over = (networks.ratio(), networks.valued());
            let densities = log_density(actions, means, sigma.clone());
            let policy = policy_loss(densities, &batch, modules, over, loss.clip, loss.team_weight, to_tensor);
            let over_values = (networks.value_loss().huber, networks.valued());
            let of_values = value_loss(values, &batch, over_values, loss.clip, loss.team_weight, to_tensor);
            let [over_actions, over_rows] = networks.entropy_sums();
            // What a row weighs in the mean over the minibatch; a dead module has no entropy.
            let weight = |w: &f32| if over_rows && *w > 0.0 { loss.team_weight } else { *w };
            let of_rows: Vec<f32> = batch.weights.iter().map(weight).collect();
            let bonus = if over_actions { entropy(sigma).sum_dim(1) } else { entropy(sigma).mean_dim(1) };
            let bonus = (bonus * to_tensor(&of_rows, [of_rows.len(), 1])).sum();
            sum.policy_loss += scalar(&policy.loss.clone().inner());
            sum.value_loss += scalar(&of_values.clone().inner());
            sum.kl += policy.kl;
            sum.clipped += policy.clipped;
            let total = policy.loss - bonus * loss.entropy + of_values * networks.value_loss().coefficient;
            let gradient = weights.gradients(&self.layout, &total);
            sum.gradient.iter_mut().zip(&gradient).for_each(|(a, b)| *a += b);
        }
        sum.hand_over(self.of_actor, actor, critic);
    }

    fn policy(&self, mean: &[f32], std: &[f32]) -> TrainedPolicy {
        self.networks.policy(&self.parameters, mean, std)
    }
}

/// A learner of `networks` that has learnt nothing.
pub fn learner<N: TensorNetworks>(networks: N, seed: u64, forgetting: Forgetting, rate: f64) -> Learner<Autodiff<N>> {
    Learner::untrained(networks.layouts(), |parameters| Autodiff::new(networks, parameters), seed, forgetting, rate)
}
