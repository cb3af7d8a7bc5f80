//! MAT, the multi-agent transformer (Wen et al. 2022): an encoder over the observations of all modules, whose outputs are also the values,
//! and a decoder that draws the actions one module after the other, each knowing those before it.
//!
//! As in the authors' code (PKU-MARL/Multi-Agent-Transformer):
//!
//! - One block, width 64, one head, normalisation after each residual, GELU, a feed-forward layer of factor 1; the second attention of the
//!   decoder asks with the encoder's output and keeps that as its residual, so the actions reach the output only through attention.
//! - sigma = 0.5 sigmoid(log_std), log_std from 1, shared by all modules and states; the raw sample is stored, scored and told to the next
//!   module.
//! - The ratio is one an action, the clipped gains are summed over a module's actions; a value for every module, with its own advantage;
//!   ValueNorm, Huber's loss, values clipped; one Adam and one limit of the gradient for everything.
//! - Observations go in raw: the layer normalisation at the door is all there is.
//!
//! Where the authors' paper and code differ, the code counts: no target network, generalised advantages instead of one-step errors.
//!
//! Mended here as in all baselines: an episode cut off by the time limit is worth what the critic says of its last view (the code takes it
//! for a termination); Huber's loss acts on both sides (the code lets errors below -10 cost nothing). Not taken over: the one-hot id of the agent and
//! the standardisation of each single observation, which are those of its environment and would tie the weights to a number of modules.
//! The order is head to tail. A module that is not heard is masked in every attention; later ones are still told the action of one whose
//! motors are dead.

use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use composer_shared::observation::BASE;

use super::on_policy::autodiff::{Evaluation, Seen, TensorNetworks};
use super::on_policy::collect::ACTIONS;
use super::on_policy::losses::{ValueLoss, log_density};
use super::on_policy::{Ratio, Valued};
use super::tensors::{Activation, Layout, Scheme, Weights};
use super::{Method, SavedWeights, TrainedPolicy};

/// Width of everything.
pub const WIDTH: usize = 64;
/// Gains of the initial weights: in front of an activation, and at an output.
pub const GAINS: [f32; 2] = [std::f32::consts::SQRT_2, 0.01];
/// Added to the score of a module that comes later.
const LATER: f32 = -1e9;

/// Encoder and decoder.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mat;

/// The layers of an attention.
fn attention(layout: &mut Layout, name: &str) {
    for part in ["query", "key", "value", "proj"] {
        layout.linear(&format!("{name}.{part}"), WIDTH, WIDTH, Scheme::Orthogonal(GAINS[1]));
    }
}

/// The layers of a feed-forward step.
fn feed_forward(layout: &mut Layout, name: &str) {
    layout.linear(&format!("{name}.0"), WIDTH, WIDTH, Scheme::Orthogonal(GAINS[0]));
    layout.linear(&format!("{name}.2"), WIDTH, WIDTH, Scheme::Orthogonal(GAINS[1]));
}

/// The layers of a head with so many outputs.
fn head(layout: &mut Layout, name: &str, outputs: usize) {
    layout.linear(&format!("{name}.0"), WIDTH, WIDTH, Scheme::Orthogonal(GAINS[0]));
    layout.layer_norm(&format!("{name}.2"), WIDTH);
    layout.linear(&format!("{name}.3"), WIDTH, outputs, Scheme::Orthogonal(GAINS[1]));
}

/// The output of a head.
fn through_head(w: &Weights, name: &str, x: Tensor<2>) -> Tensor<2> {
    let x = Activation::Gelu.apply(w.linear(&format!("{name}.0"), x));
    w.linear(&format!("{name}.3"), w.layer_norm(&format!("{name}.2"), x))
}

/// Adds the layers of the encoder.
pub fn encoder_layout(layout: &mut Layout) {
    layout.layer_norm("encoder.obs_encoder.0", BASE);
    layout.linear("encoder.obs_encoder.1", BASE, WIDTH, Scheme::Orthogonal(GAINS[0]));
    layout.layer_norm("encoder.ln", WIDTH);
    layout.layer_norm("encoder.blocks.0.ln1", WIDTH);
    layout.layer_norm("encoder.blocks.0.ln2", WIDTH);
    attention(layout, "encoder.blocks.0.attn");
    feed_forward(layout, "encoder.blocks.0.mlp");
    head(layout, "encoder.head", 1);
}

/// What the encoder makes of the observations, and the values: `[rows, WIDTH]` and `[rows, 1]`.
pub fn encode(w: &Weights, seen: &Seen) -> (Tensor<2>, Tensor<2>) {
    let x = w.layer_norm("encoder.obs_encoder.0", seen.observations.clone());
    let x = Activation::Gelu.apply(w.linear("encoder.obs_encoder.1", x));
    let x = w.layer_norm("encoder.ln", x);
    let attended = w.attention("encoder.blocks.0.attn", x.clone(), x.clone(), seen.mask.clone());
    let x = w.layer_norm("encoder.blocks.0.ln1", x + attended);
    let forward = w.mlp(&["encoder.blocks.0.mlp.0", "encoder.blocks.0.mlp.2"], Activation::Gelu, x.clone());
    let x = w.layer_norm("encoder.blocks.0.ln2", x + forward);
    let values = through_head(w, "encoder.head", x.clone());
    (x, values)
}

/// The standard deviation that a `log_std` of this family stands for.
pub fn sigma(w: &Weights) -> Tensor<2> {
    sigmoid(w.get("decoder.log_std")) * 0.5
}

/// The same of the numbers of a log_std, as its logarithm.
pub fn log_of_sigma(log_std: &[f32]) -> Vec<f32> {
    log_std.iter().map(|x| 0.5f32.ln() - (1.0 + (-x).exp()).ln()).collect()
}

/// What the critic of this family costs.
pub fn value_cost() -> ValueLoss {
    ValueLoss { coefficient: 1.0, huber: Some(10.0) }
}

impl Mat {
    /// Means of the actions, given what the encoder made of the observations and the actions of all modules.
    fn decode(self, w: &Weights, seen: &Seen, encoded: Tensor<2>, actions: Tensor<2>) -> Tensor<2> {
        let (teams, n) = (seen.teams, seen.modules);
        // Everyone is told the action of the one before; the first is told zeros.
        let first = actions.clone().reshape([teams, n, ACTIONS]).narrow(1, 0, 1) * 0.0;
        let told = Tensor::cat(vec![first, actions.reshape([teams, n, ACTIONS]).narrow(1, 0, n - 1)], 1);
        self.decode_told(w, seen, encoded, told.reshape([teams * n, ACTIONS]))
    }

    fn decode_told(self, w: &Weights, seen: &Seen, encoded: Tensor<2>, told: Tensor<2>) -> Tensor<2> {
        let n = seen.modules;
        let later: Vec<f32> = (0..n * n).map(|i| if i % n > i / n { LATER } else { 0.0 }).collect();
        let mask = seen.mask.clone() + w.tensor(&later, [1, n, n]);
        let x = Activation::Gelu.apply(w.linear("decoder.action_encoder.0", told));
        let x = w.layer_norm("decoder.ln", x);
        let attended = w.attention("decoder.blocks.0.attn1", x.clone(), x.clone(), mask.clone());
        let x = w.layer_norm("decoder.blocks.0.ln1", x + attended);
        let attended = w.attention("decoder.blocks.0.attn2", encoded.clone(), x, mask);
        let x = w.layer_norm("decoder.blocks.0.ln2", encoded + attended);
        let forward = w.mlp(&["decoder.blocks.0.mlp.0", "decoder.blocks.0.mlp.2"], Activation::Gelu, x.clone());
        let x = w.layer_norm("decoder.blocks.0.ln3", x + forward);
        through_head(w, "decoder.head", x)
    }
}

impl TensorNetworks for Mat {
    fn layouts(&self) -> [Layout; 2] {
        let mut layout = Layout::default();
        encoder_layout(&mut layout);
        layout.vector("decoder.log_std", ACTIONS, 1.0);
        layout.linear("decoder.action_encoder.0", ACTIONS, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.ln", WIDTH);
        for norm in ["ln1", "ln2", "ln3"] {
            layout.layer_norm(&format!("decoder.blocks.0.{norm}"), WIDTH);
        }
        attention(&mut layout, "decoder.blocks.0.attn1");
        attention(&mut layout, "decoder.blocks.0.attn2");
        feed_forward(&mut layout, "decoder.blocks.0.mlp");
        head(&mut layout, "decoder.head", ACTIONS);
        [layout, Layout::default()]
    }

    fn ratio(&self) -> Ratio {
        Ratio::Dimension
    }

    fn valued(&self) -> Valued {
        Valued::Module
    }

    fn value_loss(&self) -> ValueLoss {
        value_cost()
    }

    fn entropy_sums(&self) -> [bool; 2] {
        [false, false]
    }

    fn evaluate(&self, w: &Weights, seen: &Seen, actions: Tensor<2>) -> Evaluation {
        let (encoded, values) = encode(w, seen);
        Evaluation { means: self.decode(w, seen, encoded, actions), sigma: sigma(w), values }
    }

    fn values(&self, w: &Weights, seen: &Seen) -> Tensor<2> {
        encode(w, seen).1
    }

    /// Of the first round: as if all modules before did nothing.
    fn distribution(&self, w: &Weights, seen: &Seen) -> (Tensor<2>, Tensor<2>) {
        let nothing = w.tensor(&vec![0.0; seen.teams * seen.modules * ACTIONS], [seen.teams * seen.modules, ACTIONS]);
        (self.decode(w, seen, encode(w, seen).0, nothing), sigma(w))
    }

    fn act(&self, w: &Weights, seen: &Seen, noise: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let (teams, n) = (seen.teams, seen.modules);
        let (encoded, _) = encode(w, seen);
        let noise = noise.reshape([teams, n, ACTIONS]);
        let sigma = sigma(w);
        // One after the other. What comes later is masked, so that anything may stand there meanwhile.
        let mut actions = noise.clone() * 0.0;
        let mut means = actions.clone();
        for module in 0..n {
            let all = self.decode(w, seen, encoded.clone(), actions.clone().reshape([teams * n, ACTIONS]));
            let mean = all.reshape([teams, n, ACTIONS]).narrow(1, module, 1);
            let drawn = mean.clone() + noise.clone().narrow(1, module, 1) * sigma.clone().reshape([1, 1, ACTIONS]);
            let place = [0..teams, module..module + 1, 0..ACTIONS];
            actions = actions.slice_assign(place.clone(), drawn);
            means = means.slice_assign(place, mean);
        }
        let rows = [teams * n, ACTIONS];
        let (actions, means) = (actions.reshape(rows), means.reshape(rows));
        (actions.clone(), log_density(actions, means, sigma))
    }

    fn log_sigma(&self, parameters: &[f32]) -> Vec<f32> {
        log_of_sigma(&parameters[self.layouts()[0].range("decoder.log_std")])
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights::raw(Method::Mat, parameters))
    }
}
