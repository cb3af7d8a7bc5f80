//! MAPPO (Yu et al. 2022): PPO with one actor shared by all modules, each acting on its own observation, and a central critic over the
//! joint observation. Ratio and clip are one a module, over all of its actions.
//!
//! Two sets of networks and settings are here. [`Mappo::harl`] has those that PKU-MARL/HARL tuned for torques (its Ant 4x2): three layers of
//! 128 with ReLU and layer normalisation, sigma = 0.5 sigmoid(log_std), one value a team; they are what `--method mappo` trains, for the
//! authors' own code has no continuous control. [`Mappo::on_policy`] has the authors' (marlbenchmark/on-policy): two layers of 64, sigma =
//! exp(log_std), the critic's row repeated for every module.
//!
//! As there: actor and critic have an Adam and a limit of the gradient each; ValueNorm, Huber's loss, values clipped like ratios; observations
//! go in raw, behind a layer normalisation. The critic sees all observations side by side, so it is tied to a number of modules; the
//! actor is not.
//!
//! Mended here as in all baselines: an episode cut off by the time limit is worth what the critic says of its last view (the code lets the
//! step teach nothing). Mended for MAPPO: on-policy's buffer repeats the joint density for every action, which makes the policy's loss as
//! many times too large.

use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use composer_shared::observation::BASE;

use super::on_policy::autodiff::{Evaluation, Seen, TensorNetworks};
use super::on_policy::collect::ACTIONS;
use super::on_policy::losses::ValueLoss;
use super::on_policy::{Ratio, Valued};
use super::tensors::{Activation, Layout, Scheme, Weights};
use super::{Method, SavedWeights, TrainedPolicy, mat};

/// Actor and critic.
#[derive(Clone, Debug)]
pub struct Mappo {
    /// Modules of every team: the critic's input has so many observations.
    pub modules: usize,
    /// Linear layer and layer normalisation of each hidden layer, by the names that they have in the original.
    layers: Vec<[&'static str; 2]>,
    width: usize,
    /// sigma = 0.5 sigmoid(log_std), else exp(log_std).
    squashed: bool,
    /// One value a team, or the same repeated for every module.
    pub valued: Valued,
}

impl Mappo {
    /// HARL's, tuned for torques.
    pub fn harl(modules: usize) -> Self {
        let layers = vec![
            ["base.mlp.fc.0", "base.mlp.fc.2"],
            ["base.mlp.fc.3", "base.mlp.fc.5"],
            ["base.mlp.fc.6", "base.mlp.fc.8"],
        ];
        Self { modules, layers, width: 128, squashed: true, valued: Valued::Team }
    }

    /// The authors' own.
    pub fn on_policy(modules: usize) -> Self {
        let layers = vec![["base.mlp.fc1.0", "base.mlp.fc1.2"], ["base.mlp.fc2.0.0", "base.mlp.fc2.0.2"]];
        Self { modules, layers, width: 64, squashed: false, valued: Valued::Module }
    }

    /// Name of log_std in the original.
    fn log_std(&self) -> &'static str {
        if self.squashed { "actor.act.action_out.log_std" } else { "actor.act.action_out.logstd._bias" }
    }

    fn base(&self, layout: &mut Layout, of: &str, inputs: usize) {
        layout.layer_norm(&format!("{of}.base.feature_norm"), inputs);
        let mut inputs = inputs;
        for [linear, norm] in &self.layers {
            let gain = Scheme::Orthogonal(std::f32::consts::SQRT_2);
            layout.linear(&format!("{of}.{linear}"), inputs, self.width, gain);
            layout.layer_norm(&format!("{of}.{norm}"), self.width);
            inputs = self.width;
        }
    }

    fn through_base(&self, w: &Weights, of: &str, x: Tensor<2>) -> Tensor<2> {
        let x = w.layer_norm(&format!("{of}.base.feature_norm"), x);
        self.layers.iter().fold(x, |x, [linear, norm]| {
            w.layer_norm(&format!("{of}.{norm}"), Activation::Relu.apply(w.linear(&format!("{of}.{linear}"), x)))
        })
    }
}

impl TensorNetworks for Mappo {
    fn layouts(&self) -> [Layout; 2] {
        let (mut actor, mut critic) = (Layout::default(), Layout::default());
        self.base(&mut actor, "actor", BASE);
        actor.linear("actor.act.action_out.fc_mean", self.width, ACTIONS, Scheme::Orthogonal(0.01));
        actor.vector(self.log_std(), ACTIONS, if self.squashed { 1.0 } else { 0.0 });
        self.base(&mut critic, "critic", self.modules * BASE);
        critic.linear("critic.v_out", self.width, 1, Scheme::Orthogonal(1.0));
        [actor, critic]
    }

    fn ratio(&self) -> Ratio {
        Ratio::Module
    }

    fn valued(&self) -> Valued {
        self.valued
    }

    fn value_loss(&self) -> ValueLoss {
        ValueLoss { coefficient: 1.0, huber: Some(10.0) }
    }

    fn entropy_sums(&self) -> [bool; 2] {
        [true, false]
    }

    fn evaluate(&self, w: &Weights, seen: &Seen, _actions: Tensor<2>) -> Evaluation {
        let (means, sigma) = self.distribution(w, seen);
        Evaluation { means, sigma, values: self.values(w, seen) }
    }

    fn values(&self, w: &Weights, seen: &Seen) -> Tensor<2> {
        let joint = seen.observations.clone().reshape([seen.teams, seen.modules * BASE]);
        let values = w.linear("critic.v_out", self.through_base(w, "critic", joint));
        match self.valued {
            Valued::Team => values,
            Valued::Module => values.repeat(&[1, seen.modules]).reshape([seen.teams * seen.modules, 1]),
        }
    }

    fn distribution(&self, w: &Weights, seen: &Seen) -> (Tensor<2>, Tensor<2>) {
        let x = self.through_base(w, "actor", seen.observations.clone());
        let log_std = w.get(self.log_std());
        let sigma = if self.squashed { sigmoid(log_std) * 0.5 } else { log_std.exp() };
        (w.linear("actor.act.action_out.fc_mean", x), sigma)
    }

    fn log_sigma(&self, actor: &[f32]) -> Vec<f32> {
        let log_std = &actor[self.layouts()[0].range(self.log_std())];
        if self.squashed { mat::log_of_sigma(log_std) } else { log_std.to_vec() }
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights { modules: self.modules, ..SavedWeights::raw(Method::Mappo, parameters) })
    }
}
