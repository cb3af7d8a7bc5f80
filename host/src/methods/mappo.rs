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

use composer_shared::observation::BASE;

use super::layers::{Matrix, Network, Tape};
use super::layout::{Activation, Layout, Scheme};
use super::on_policy::collect::ACTIONS;
use super::on_policy::taped::{Deviation, Seen, TapedNetworks};
use super::on_policy::{Ratio, Valued};
use super::{Method, SavedWeights, TrainedPolicy};

/// Actor and critic.
#[derive(Clone, Debug)]
pub struct Mappo {
    /// Modules of every team: the critic's input has so many observations.
    pub modules: usize,
    /// Linear layer and layer normalisation of each hidden layer, by the names that they have in the original.
    layers: Vec<[&'static str; 2]>,
    width: usize,
    /// Name of log_std in the original, and what it stands for.
    log_std: (&'static str, Deviation),
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
        let log_std = ("actor.act.action_out.log_std", Deviation::Squashed);
        Self { modules, layers, width: 128, log_std, valued: Valued::Team }
    }

    /// The authors' own.
    pub fn on_policy(modules: usize) -> Self {
        let layers = vec![["base.mlp.fc1.0", "base.mlp.fc1.2"], ["base.mlp.fc2.0.0", "base.mlp.fc2.0.2"]];
        let log_std = ("actor.act.action_out.logstd._bias", Deviation::Exponential);
        Self { modules, layers, width: 64, log_std, valued: Valued::Module }
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

    fn through_base(&self, t: &mut Tape, w: Network, of: &str, x: Matrix) -> Matrix {
        let x = t.norm(w, &format!("{of}.base.feature_norm"), x);
        self.layers.iter().fold(x, |x, [linear, norm]| {
            let x = t.activated(w, &format!("{of}.{linear}"), Activation::Relu, x);
            t.norm(w, &format!("{of}.{norm}"), x)
        })
    }
}

impl TapedNetworks for Mappo {
    fn layouts(&self) -> [Layout; 2] {
        let (mut actor, mut critic) = (Layout::default(), Layout::default());
        self.base(&mut actor, "actor", BASE);
        actor.linear("actor.act.action_out.fc_mean", self.width, ACTIONS, Scheme::Orthogonal(0.01));
        let (log_std, deviation) = self.log_std;
        actor.vector(log_std, ACTIONS, if deviation == Deviation::Squashed { 1.0 } else { 0.0 });
        self.base(&mut critic, "critic", self.modules * BASE);
        critic.linear("critic.v_out", self.width, 1, Scheme::Orthogonal(1.0));
        [actor, critic]
    }

    fn log_std(&self) -> (&'static str, Deviation) {
        self.log_std
    }

    fn ratio(&self) -> Ratio {
        Ratio::Module
    }

    fn valued(&self) -> Valued {
        self.valued
    }

    fn entropy_sums(&self) -> [bool; 2] {
        [true, false]
    }

    fn means(&self, t: &mut Tape, w: Network, seen: &Seen, _actions: &[f32]) -> Matrix {
        let x = self.through_base(t, w, "actor", seen.observations);
        t.linear(w, "actor.act.action_out.fc_mean", x)
    }

    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
        let rows = if self.valued == Valued::Team { 1 } else { self.modules };
        let joint: Vec<f32> =
            seen.teams().flat_map(|(_, team)| std::iter::repeat_n(team, rows)).flatten().copied().collect();
        let joint = t.input(&joint, self.modules * BASE);
        let x = self.through_base(t, w, "critic", joint);
        t.linear(w, "critic.v_out", x)
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights { modules: self.modules, ..SavedWeights::raw(Method::Mappo, parameters) })
    }
}
