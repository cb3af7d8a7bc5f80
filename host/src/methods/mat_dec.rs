//! MAT_dec (Wen et al. 2022): MAT without its decoder. Every module acts on its own observation alone, by one network shared by all; the
//! encoder of [`mat`](super::mat) stays for the values, so training is central and acting is not.
//!
//! As in the authors' code (PKU-MARL/Multi-Agent-Transformer, every launch script sets `share_actor`): layer normalisation of the raw
//! observation, two layers of 64 with GELU and layer normalisation; distribution, ratio, losses and the one optimiser are MAT's. Mended:
//! what is mended in MAT.

use burn::tensor::Tensor;
use composer_shared::observation::BASE;

use super::mat::{GAINS, WIDTH, encode, encoder_layout, log_of_sigma, sigma, value_cost};
use super::on_policy::autodiff::{Evaluation, Seen, TensorNetworks};
use super::on_policy::collect::ACTIONS;
use super::on_policy::losses::ValueLoss;
use super::on_policy::{Ratio, Valued};
use super::tensors::{Activation, Layout, Scheme, Weights};
use super::{Method, SavedWeights, TrainedPolicy};

/// Encoder for the values, a small network for the actions.
#[derive(Clone, Copy, Debug, Default)]
pub struct MatDec;

impl TensorNetworks for MatDec {
    fn layouts(&self) -> [Layout; 2] {
        let mut layout = Layout::default();
        encoder_layout(&mut layout);
        layout.vector("decoder.log_std", ACTIONS, 1.0);
        layout.layer_norm("decoder.mlp.0", BASE);
        layout.linear("decoder.mlp.1", BASE, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.mlp.3", WIDTH);
        layout.linear("decoder.mlp.4", WIDTH, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.mlp.6", WIDTH);
        layout.linear("decoder.mlp.7", WIDTH, ACTIONS, Scheme::Orthogonal(GAINS[1]));
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

    fn evaluate(&self, w: &Weights, seen: &Seen, _actions: Tensor<2>) -> Evaluation {
        let (means, sigma) = self.distribution(w, seen);
        Evaluation { means, sigma, values: self.values(w, seen) }
    }

    fn values(&self, w: &Weights, seen: &Seen) -> Tensor<2> {
        encode(w, seen).1
    }

    fn distribution(&self, w: &Weights, seen: &Seen) -> (Tensor<2>, Tensor<2>) {
        let x = w.layer_norm("decoder.mlp.0", seen.observations.clone());
        let x = Activation::Gelu.apply(w.linear("decoder.mlp.1", x));
        let x = Activation::Gelu.apply(w.linear("decoder.mlp.4", w.layer_norm("decoder.mlp.3", x)));
        (w.linear("decoder.mlp.7", w.layer_norm("decoder.mlp.6", x)), sigma(w))
    }

    fn log_sigma(&self, parameters: &[f32]) -> Vec<f32> {
        log_of_sigma(&parameters[self.layouts()[0].range("decoder.log_std")])
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights::raw(Method::MatDec, parameters))
    }
}
