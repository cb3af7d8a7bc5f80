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

use composer_shared::observation::BASE;

use super::layers::{Matrix, Network, Past, Query, Tape};
use super::layout::{Activation, Layout, Scheme};
use super::on_policy::collect::ACTIONS;
use super::on_policy::taped::{LOG_STD, Seen, TapedNetworks, draw};
use super::{Method, SavedWeights, TrainedPolicy};

/// Width of everything.
pub const WIDTH: usize = 64;
/// Gains of the initial weights: in front of an activation, and at an output.
pub const GAINS: [f32; 2] = [std::f32::consts::SQRT_2, 0.01];

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

/// The output of a feed-forward step.
fn forward(t: &mut Tape, w: Network, name: &str, x: Matrix) -> Matrix {
    let x = t.activated(w, &format!("{name}.0"), Activation::Gelu, x);
    t.linear(w, &format!("{name}.2"), x)
}

/// The layers of a head with so many outputs.
fn head(layout: &mut Layout, name: &str, outputs: usize) {
    layout.linear(&format!("{name}.0"), WIDTH, WIDTH, Scheme::Orthogonal(GAINS[0]));
    layout.layer_norm(&format!("{name}.2"), WIDTH);
    layout.linear(&format!("{name}.3"), WIDTH, outputs, Scheme::Orthogonal(GAINS[1]));
}

/// The output of a head.
fn through_head(t: &mut Tape, w: Network, name: &str, x: Matrix) -> Matrix {
    let x = t.activated(w, &format!("{name}.0"), Activation::Gelu, x);
    let x = t.norm(w, &format!("{name}.2"), x);
    t.linear(w, &format!("{name}.3"), x)
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

/// What the encoder makes of the observations, `[rows, WIDTH]`.
fn encode(t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
    let x = t.norm(w, "encoder.obs_encoder.0", seen.observations);
    let x = t.activated(w, "encoder.obs_encoder.1", Activation::Gelu, x);
    let x = t.norm(w, "encoder.ln", x);
    let attended = t.attention(w, "encoder.blocks.0.attn", x, x, &seen.heard);
    let x = t.residual_norm(w, "encoder.blocks.0.ln1", x, attended);
    let more = forward(t, w, "encoder.blocks.0.mlp", x);
    t.residual_norm(w, "encoder.blocks.0.ln2", x, more)
}

/// The values, `[rows, 1]`.
pub fn values(t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
    let encoded = encode(t, w, seen);
    through_head(t, w, "encoder.head", encoded)
}

/// Means of the actions of some modules, `[rows, ACTIONS]`, given what the encoder made of their observations and the action of the module
/// before each. `attend` is the attention of that name, asking with one matrix for what is in the other.
fn decode(
    t: &mut Tape,
    w: Network,
    encoded: Matrix,
    told: &[f32],
    mut attend: impl FnMut(&mut Tape, &'static str, [Matrix; 2]) -> Matrix,
) -> Matrix {
    let told = t.input(told, ACTIONS);
    let x = t.activated(w, "decoder.action_encoder.0", Activation::Gelu, told);
    let x = t.norm(w, "decoder.ln", x);
    let attended = attend(t, ATTENTIONS[0], [x, x]);
    let x = t.residual_norm(w, "decoder.blocks.0.ln1", x, attended);
    let attended = attend(t, ATTENTIONS[1], [encoded, x]);
    let x = t.residual_norm(w, "decoder.blocks.0.ln2", encoded, attended);
    let more = forward(t, w, "decoder.blocks.0.mlp", x);
    let x = t.residual_norm(w, "decoder.blocks.0.ln3", x, more);
    through_head(t, w, "decoder.head", x)
}

/// The same of all modules at once, where the actions of all are known.
fn decode_at_once(t: &mut Tape, w: Network, seen: &Seen, encoded: Matrix, actions: &[f32]) -> Matrix {
    let told: Vec<f32> = seen.before.iter().enumerate().flat_map(|(row, query)| told(actions, query, row)).collect();
    let attend = |t: &mut Tape, name: &str, [query, x]: [Matrix; 2]| t.attention(w, name, query, x, &seen.before);
    decode(t, w, encoded, &told, attend)
}

/// The attentions of the decoder.
const ATTENTIONS: [&str; 2] = ["decoder.blocks.0.attn1", "decoder.blocks.0.attn2"];

/// What the module of a row is told, given the actions of all: that of the one before it, the first zeros.
fn told(actions: &[f32], query: &Query, row: usize) -> [f32; ACTIONS] {
    if row == query.first { [0.0; ACTIONS] } else { actions.as_chunks::<ACTIONS>().0[row - 1] }
}

impl TapedNetworks for Mat {
    fn layouts(&self) -> [Layout; 2] {
        let mut layout = Layout::default();
        encoder_layout(&mut layout);
        layout.vector(LOG_STD, ACTIONS, 1.0);
        layout.linear("decoder.action_encoder.0", ACTIONS, WIDTH, Scheme::Orthogonal(GAINS[0]));
        layout.layer_norm("decoder.ln", WIDTH);
        for norm in ["ln1", "ln2", "ln3"] {
            layout.layer_norm(&format!("decoder.blocks.0.{norm}"), WIDTH);
        }
        ATTENTIONS.iter().for_each(|name| attention(&mut layout, name));
        feed_forward(&mut layout, "decoder.blocks.0.mlp");
        head(&mut layout, "decoder.head", ACTIONS);
        [layout, Layout::default()]
    }

    fn means(&self, t: &mut Tape, w: Network, seen: &Seen, actions: &[f32]) -> Matrix {
        let encoded = encode(t, w, seen);
        decode_at_once(t, w, seen, encoded, actions)
    }

    /// Means and values out of one encoding.
    fn evaluate(&self, t: &mut Tape, w: Network, seen: &Seen, actions: &[f32]) -> [Matrix; 2] {
        let encoded = encode(t, w, seen);
        let values = through_head(t, w, "encoder.head", encoded);
        [decode_at_once(t, w, seen, encoded, actions), values]
    }

    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
        values(t, w, seen)
    }

    /// One module after the other, those of all teams together.
    fn act(&self, t: &mut Tape, w: Network, seen: &Seen, noise: &[f32], sigma: &[f32]) -> [Vec<f32>; 2] {
        let encoded = encode(t, w, seen);
        let encoded = t.numbers(encoded);
        let (mut means, mut actions) = (vec![0.0; noise.len()], vec![0.0; noise.len()]);
        let mut pasts = ATTENTIONS.map(|name| (name, Past::default()));
        for module in 0..seen.modules.iter().copied().max().unwrap_or(0) {
            let (rows, queries): (Vec<usize>, Vec<Query>) =
                seen.before.iter().copied().enumerate().filter(|(row, query)| row - query.first == module).unzip();
            let told: Vec<f32> =
                rows.iter().zip(&queries).flat_map(|(row, query)| told(&actions, query, *row)).collect();
            let own: Vec<f32> = rows.iter().flat_map(|row| &encoded[row * WIDTH..][..WIDTH]).copied().collect();
            let own = t.input(&own, WIDTH);
            let found = decode(t, w, own, &told, |t, name, x| {
                let (_, past) = pasts.iter_mut().find(|(of, _)| *of == name).expect("an attention of the decoder");
                t.attention_by_rows(w, name, x, (&rows, &queries), past)
            });
            for (row, mean) in rows.iter().zip(t.numbers(found).as_chunks::<ACTIONS>().0) {
                let at = row * ACTIONS..(row + 1) * ACTIONS;
                means[at.clone()].copy_from_slice(mean);
                actions[at.clone()].copy_from_slice(&draw(mean, &noise[at], sigma));
            }
        }
        [means, actions]
    }

    fn policy(&self, parameters: &[f32], _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights::raw(Method::Mat, parameters))
    }
}
