//! MAT_dec (Wen et al. 2022): MAT without its decoder. Every module acts on its own observation alone, by one network shared by all; the
//! encoder of [`mat`](super::mat) stays for the values, so training is central and acting is not.
//!
//! As in the authors' code (PKU-MARL/Multi-Agent-Transformer, every launch script sets `share_actor`): layer normalisation of the raw
//! observation, two layers of 64 with GELU and layer normalisation; distribution, ratio, losses and the one optimiser are MAT's. Mended:
//! what is mended in MAT.

use composer_shared::observation::BASE;

use super::layers::{Matrix, Network, Tape};
use super::layout::{Activation, Layout, Scheme};
use super::mat::{GAINS, WIDTH, encoder_layout, values};
use super::on_policy::collect::ACTIONS;
use super::on_policy::taped::{LOG_STD, Seen, TapedNetworks};
use super::{Method, SavedWeights, TrainedPolicy};

/// Encoder for the values, a small network for the actions.
#[derive(Clone, Copy, Debug, Default)]
pub struct MatDec;

impl TapedNetworks for MatDec {
    fn layouts(&self) -> [Layout; 2] {
        let mut layout = Layout::default();
        encoder_layout(&mut layout);
        layout.vector(LOG_STD, ACTIONS, 1.0);
        layout.layer_norm("decoder.mlp.0", BASE);
        layout.linear("decoder.mlp.1", BASE, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.mlp.3", WIDTH);
        layout.linear("decoder.mlp.4", WIDTH, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.mlp.6", WIDTH);
        layout.linear("decoder.mlp.7", WIDTH, ACTIONS, Scheme::Orthogonal(GAINS[1]));
        [layout, Layout::default()]
    }

    fn means(&self, t: &mut Tape, w: Network, seen: &Seen, _actions: &[f32]) -> Matrix {
        let x = t.norm(w, "decoder.mlp.0", seen.observations);
        let x = t.activated(w, "decoder.mlp.1", Activation::Gelu, x);
        let x = t.norm(w, "decoder.mlp.3", x);
        let x = t.activated(w, "decoder.mlp.4", Activation::Gelu, x);
        let x = t.norm(w, "decoder.mlp.6", x);
        t.linear(w, "decoder.mlp.7", x)
    }

    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
        values(t, w, seen)
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights::raw(Method::MatDec, parameters))
    }
}
