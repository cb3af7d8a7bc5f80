//! An actor as it runs in rollouts: plain f32, one environment at a time, no allocation, no tensor library.
//!
//! The arithmetic of a row never depends on how many rows there are, so the same observation always gives the same action.

use composer_shared::observation::SIZE;

use super::actor_critic::{ActorLayout, EMBED, HIDDEN, KEY, VALUE};
use super::kernels::{dense, tanh};

/// Query, key and value of one module in a row.
const LATENT: usize = 2 * KEY + VALUE;

/// The weights of an actor with `A` actions a module, laid out for the inner loops: one row per input.
#[derive(Clone, Debug)]
pub struct Inference<const A: usize> {
    encoder: Vec<f32>,
    encoder_bias: Vec<f32>,
    attention: Vec<f32>,
    hidden: Vec<f32>,
    hidden_context: Vec<f32>,
    hidden_bias: Vec<f32>,
    output: Vec<f32>,
    output_bias: [f32; A],
    /// Logarithm of the standard deviation of each action.
    pub log_sigma: [f32; A],
}

/// Working memory for [`Inference::means`].
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    embedding: Vec<f32>,
    latent: Vec<f32>,
    context: Vec<f32>,
    hidden: Vec<f32>,
    weights: Vec<f32>,
}

fn transpose(weights: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    (0..rows * columns).map(|i| weights[i % rows * columns + i / rows]).collect()
}

impl<const A: usize> Inference<A> {
    /// Copies the weights out of the actor's parameters.
    ///
    /// # Panics
    /// If the layout has another number of actions.
    pub fn new(layout: &ActorLayout, parameters: &[f32]) -> Self {
        assert_eq!(layout.outputs(), A, "actions of the layout");
        let transposed = |block: super::Block| transpose(&parameters[block.range()], block.rows, block.columns);
        let vector = |block: super::Block| std::array::from_fn(|i| parameters[block.offset + i]);
        Self {
            encoder: transposed(layout.encoder),
            encoder_bias: parameters[layout.encoder_bias.range()].to_vec(),
            attention: transposed(layout.attention),
            hidden: transposed(layout.hidden),
            hidden_context: transposed(layout.hidden_context),
            hidden_bias: parameters[layout.hidden_bias.range()].to_vec(),
            output: parameters[layout.output.range()].to_vec(),
            output_bias: vector(layout.output_bias),
            log_sigma: vector(layout.log_sigma),
        }
    }

    /// Means of the actions of a team: `observations` normalised, `[modules][SIZE]`; `heard` one mask a module, own bit set.
    pub fn means(&self, observations: &[f32], heard: &[u64], means: &mut [[f32; A]], scratch: &mut Scratch) {
        let n = heard.len();
        let Scratch { embedding, latent, context, hidden, weights } = scratch;
        embedding.resize(n * EMBED, 0.0);
        hidden.resize(n * HIDDEN, 0.0);
        dense::<EMBED>(observations, SIZE, &self.encoder, Some(&self.encoder_bias), embedding);
        tanh(embedding);
        dense::<HIDDEN>(embedding, EMBED, &self.hidden, Some(&self.hidden_bias), hidden);
        if !self.attention.is_empty() {
            latent.clear();
            latent.resize(n * LATENT, 0.0);
            dense::<LATENT>(embedding, EMBED, &self.attention, None, latent);
            context.clear();
            context.resize(n * VALUE, 0.0);
            for i in 0..n {
                attend(latent, i, heard[i], weights, &mut context[i * VALUE..(i + 1) * VALUE]);
            }
            dense::<HIDDEN>(context, VALUE, &self.hidden_context, None, hidden);
        }
        tanh(hidden);
        for (h, mean) in hidden.chunks_exact(HIDDEN).zip(means) {
            for (i, mean) in mean.iter_mut().enumerate() {
                let row = &self.output[i * HIDDEN..(i + 1) * HIDDEN];
                let mut lanes = [0.0f32; 8];
                for (h, w) in h.chunks_exact(8).zip(row.chunks_exact(8)) {
                    for j in 0..8 {
                        lanes[j] += h[j] * w[j];
                    }
                }
                *mean = self.output_bias[i] + lanes.iter().sum::<f32>();
            }
        }
    }
}

/// Attention of module `i` over those it hears, into `context`.
fn attend(latent: &[f32], i: usize, heard: u64, weights: &mut Vec<f32>, context: &mut [f32]) {
    let query = &latent[i * LATENT..][..KEY];
    weights.clear();
    let mut largest = f32::NEG_INFINITY;
    for (j, other) in latent.chunks_exact(LATENT).enumerate() {
        let mut score = f32::NEG_INFINITY;
        if heard >> j & 1 == 1 {
            score =
                query.iter().zip(&other[KEY..2 * KEY]).map(|(q, k)| q * k).sum::<f32>() * (KEY as f32).sqrt().recip();
        }
        weights.push(score);
        largest = largest.max(score);
    }
    let mut total = 0.0;
    for weight in weights.iter_mut() {
        *weight = (*weight - largest).exp();
        total += *weight;
    }
    for (weight, other) in weights.iter().zip(latent.chunks_exact(LATENT)) {
        let weight = weight / total;
        for (c, v) in context.iter_mut().zip(&other[2 * KEY..]) {
            *c += weight * v;
        }
    }
}
