//! The actor: layout of its parameters, its forward pass, the same for rollouts, updates and evaluation, and the gradient of PPO's clipped
//! loss, derived by hand.
//!
//! It is the network of [`crate::network`]: encoder, optional attention, hidden layer, two outputs a module, and a standard deviation that
//! does not depend on the state. That of the imagination policy is the same without attention and with three outputs.
//!
//! With a memory, `m <- m + leak (e - m)` over the first channels of the embedding e ([`LEAKS`]), and query, key, value and hidden layer see e and m side
//! by side. It is linear and each channel is by itself, so the gradient goes back through it in one scan against the time:
//!
//! ```text
//! dm_t = (what the layers say of m_t) + (1 - leak) dm_{t+1}        de_t += leak dm_t
//! ```
//!
//! With a bias of distance the score of a module is the scaled product of query and key plus a number for how far along the chain it is
//! ([`distance_bucket`]).
//!
//! Plain f32 over whole teams, no tensor library, no allocation once the working memory has grown. What a module does depends on its own
//! team alone, bit for bit: a batch of many teams and a rollout of one agree.

use composer_shared::observation::BASE;
use composer_shared::policy::{DISTANCE_BUCKETS, distance_bucket, leak};
pub use composer_shared::policy::{EMBED, HIDDEN, KEY, MEMORY, VALUE};

use crate::methods::kernels::{Start, bias_tanh_backward, dense, dense_weights, dot, head, head_backward, tanh};
use crate::methods::on_policy::{Batch, Gradient, LossSettings};
use crate::methods::parameters::{Block, lay_out, orthogonal, room, transpose, transpose_back};
use crate::methods::random::{Stream, stream};
use crate::methods::simd::{Vector, vectorise};
use crate::network::{Dense, Network};

/// Share of the way to the embedding that each channel of the memory goes in a control step.
pub const LEAKS: [f32; MEMORY] = {
    let mut leaks = [0.0; MEMORY];
    let mut channel = 0;
    while channel < MEMORY {
        leaks[channel] = 1.0 / (1 << leak(channel)) as f32;
        channel += 1;
    }
    leaks
};

/// What an actor is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Whether it attends to other modules.
    pub attention: bool,
    /// Actions of a module.
    pub outputs: usize,
    /// Numbers of an observation that it takes, the first.
    pub inputs: usize,
    /// Channels that it remembers: none or [`MEMORY`].
    pub memory: usize,
    /// Whether attention has a bias by distance along the chain.
    pub distance_bias: bool,
}

impl Shape {
    /// That of a network.
    pub fn of(network: &Network) -> Self {
        Self {
            attention: network.attention,
            outputs: network.output.outputs,
            inputs: network.inputs,
            memory: network.memory,
            distance_bias: network.attention && !network.distance_bias.is_empty(),
        }
    }

    /// The paper's: the first numbers of the observation, no memory, no bias.
    pub fn paper(attention: bool, outputs: usize) -> Self {
        Self { attention, outputs, inputs: BASE, memory: 0, distance_bias: false }
    }
}

/// Where things are in an actor's parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorLayout {
    /// `[EMBED, inputs]` weights of the encoder.
    pub encoder: Block,
    /// Its bias.
    pub encoder_bias: Block,
    /// Query, key and value weights, one below the other: `[2 KEY + VALUE, EMBED + memory]`. Empty without attention.
    pub attention: Block,
    /// Weights of the hidden layer over the own embedding and memory.
    pub hidden: Block,
    /// Weights of the hidden layer over what attention gathered. Empty without attention.
    pub hidden_context: Block,
    /// Bias of the hidden layer.
    pub hidden_bias: Block,
    /// Weights of the outputs.
    pub output: Block,
    /// Bias of the outputs.
    pub output_bias: Block,
    /// Logarithm of the standard deviation of each action.
    pub log_sigma: Block,
    /// Bias of attention by distance, one number a bucket. Empty without.
    pub distance_bias: Block,
    /// Length of the parameter vector.
    pub len: usize,
}

impl ActorLayout {
    /// The layout of an actor of this shape.
    pub fn new(shape: Shape) -> Self {
        let attention = usize::from(shape.attention);
        let features = EMBED + shape.memory;
        let (
            [
                encoder,
                encoder_bias,
                attention,
                hidden,
                hidden_context,
                hidden_bias,
                output,
                output_bias,
                log_sigma,
                distance_bias,
            ],
            len,
        ) = lay_out([
            ("encoder.weight", EMBED, shape.inputs),
            ("encoder.bias", 1, EMBED),
            ("attention.weight", attention * (2 * KEY + VALUE), features),
            ("hidden.weight", HIDDEN, features),
            ("hidden.context_weight", HIDDEN, attention * VALUE),
            ("hidden.bias", 1, HIDDEN),
            ("output.weight", shape.outputs, HIDDEN),
            ("output.bias", 1, shape.outputs),
            ("log_sigma", 1, shape.outputs),
            ("attention.distance_bias", 1, attention * usize::from(shape.distance_bias) * DISTANCE_BUCKETS),
        ]);
        Self {
            encoder,
            encoder_bias,
            attention,
            hidden,
            hidden_context,
            hidden_bias,
            output,
            output_bias,
            log_sigma,
            distance_bias,
            len,
        }
    }

    /// Numbers of an observation that it takes.
    pub fn inputs(&self) -> usize {
        self.encoder.columns
    }

    /// Channels that it remembers.
    pub fn memory(&self) -> usize {
        self.hidden.columns - EMBED
    }

    /// Numbers that query, key, value and hidden layer see of a module: its embedding, and what it remembers.
    fn features(&self) -> usize {
        self.hidden.columns
    }

    /// Actions of a module.
    pub fn outputs(&self) -> usize {
        self.output.rows
    }

    /// All blocks in order.
    pub fn blocks(&self) -> [Block; 10] {
        [
            self.encoder,
            self.encoder_bias,
            self.attention,
            self.hidden,
            self.hidden_context,
            self.hidden_bias,
            self.output,
            self.output_bias,
            self.log_sigma,
            self.distance_bias,
        ]
    }

    /// Initial parameters: orthogonal, gain sqrt 2 (1 for query, key and value, 0.01 for the outputs), zero bias.
    pub fn initial(&self, seed: u64, sigma: f32) -> Vec<f32> {
        let mut p = vec![0.0; self.len];
        let mut rng = stream(seed, Stream::Weights, 0, 0);
        let root2 = std::f32::consts::SQRT_2;
        p[self.encoder.range()].copy_from_slice(&orthogonal(EMBED, self.inputs(), root2, &mut rng));
        let features = self.features();
        if !self.attention.is_empty() {
            let parts = [(0, KEY), (KEY, KEY), (2 * KEY, VALUE)];
            for (start, rows) in parts {
                let from = self.attention.offset + start * features;
                p[from..from + rows * features].copy_from_slice(&orthogonal(rows, features, 1.0, &mut rng));
            }
        }
        let context = self.hidden_context.columns;
        let hidden = orthogonal(HIDDEN, features + context, root2, &mut rng);
        for (row, weights) in hidden.chunks_exact(features + context).enumerate() {
            p[self.hidden.offset + row * features..][..features].copy_from_slice(&weights[..features]);
            p[self.hidden_context.offset + row * context..][..context].copy_from_slice(&weights[features..]);
        }
        p[self.output.range()].copy_from_slice(&orthogonal(self.outputs(), HIDDEN, 0.01, &mut rng));
        p[self.log_sigma.range()].fill(sigma.ln());
        p
    }

    /// The parameters that a network of this layout has; the standard deviation of its actions, which it does not have, is 1.
    pub fn parameters(&self, network: &Network) -> Vec<f32> {
        let mut p = vec![0.0; self.len];
        let mut put = |block: Block, from: &[f32]| p[block.range()].copy_from_slice(from);
        put(self.encoder, &network.encoder.weights);
        put(self.encoder_bias, &network.encoder.bias);
        if !self.attention.is_empty() {
            put(self.attention, &[&network.query.weights[..], &network.key.weights, &network.value.weights].concat());
        }
        if !self.distance_bias.is_empty() {
            put(self.distance_bias, &network.distance_bias);
        }
        put(self.hidden_bias, &network.hidden.bias);
        put(self.output, &network.output.weights);
        put(self.output_bias, &network.output.bias);
        let (features, context) = (self.features(), self.hidden_context.columns);
        for (row, weights) in network.hidden.weights.chunks_exact(features + VALUE).enumerate() {
            let (of_features, of_context) = weights.split_at(features);
            p[self.hidden.offset + row * features..][..features].copy_from_slice(of_features);
            p[self.hidden_context.offset + row * context..][..context].copy_from_slice(&of_context[..context]);
        }
        p
    }

    /// The network that these parameters of a control policy are, with the statistics of the observations that it takes.
    pub fn network(&self, parameters: &[f32], mean: &[f32], std: &[f32]) -> Network {
        let dense =
            |weights: Vec<f32>, inputs: usize, outputs: usize, bias: Vec<f32>| Dense { inputs, outputs, weights, bias };
        let part = |block: Block| parameters[block.range()].to_vec();
        let attention = !self.attention.is_empty();
        let features = self.features();
        let qkv = if attention { part(self.attention) } else { vec![0.0; (2 * KEY + VALUE) * features] };
        let mut hidden = vec![0.0; HIDDEN * (features + VALUE)];
        for (row, to) in hidden.chunks_exact_mut(features + VALUE).enumerate() {
            to[..features].copy_from_slice(&parameters[self.hidden.offset + row * features..][..features]);
            if attention {
                to[features..].copy_from_slice(&parameters[self.hidden_context.offset + row * VALUE..][..VALUE]);
            }
        }
        Network {
            attention,
            inputs: self.inputs(),
            memory: self.memory(),
            distance_bias: part(self.distance_bias),
            mean: mean.to_vec(),
            std: std.to_vec(),
            encoder: dense(part(self.encoder), self.inputs(), EMBED, part(self.encoder_bias)),
            query: dense(qkv[..KEY * features].to_vec(), features, KEY, Vec::new()),
            key: dense(qkv[KEY * features..2 * KEY * features].to_vec(), features, KEY, Vec::new()),
            value: dense(qkv[2 * KEY * features..].to_vec(), features, VALUE, Vec::new()),
            hidden: dense(hidden, features + VALUE, HIDDEN, part(self.hidden_bias)),
            output: dense(part(self.output), HIDDEN, self.outputs(), part(self.output_bias)),
        }
    }
}

/// Query, key and value of one module in a row.
pub const LATENT: usize = 2 * KEY + VALUE;

/// An actor's weights, ready for both ways.
#[derive(Clone, Debug)]
pub struct Actor {
    layout: ActorLayout,
    /// As in the layout, one row per output.
    parameters: Vec<f32>,
    /// The same with one row per input in the matrices of [`matrices`].
    transposed: Vec<f32>,
}

/// Working memory of an actor: what its layers put out, and the gradients of that. `rows` are modules of all teams together.
#[derive(Clone, Debug, Default)]
pub struct ActorScratch {
    /// Means of the actions, `[rows, outputs]`; longer than that after a larger batch.
    pub means: Vec<f32>,
    /// `[rows, EMBED]`
    embedding: Vec<f32>,
    /// Embedding and memory, `[rows, EMBED + MEMORY]`, of an actor that remembers.
    pub(super) features: Vec<f32>,
    /// `[rows, LATENT]`
    pub(super) latent: Vec<f32>,
    /// Weights of attention: `[modules, modules]` for each team.
    pub(super) attention: Vec<f32>,
    /// `[rows, VALUE]`
    context: Vec<f32>,
    /// `[rows, HIDDEN]`
    hidden: Vec<f32>,
    of_means: Vec<f32>,
    of_embedding: Vec<f32>,
    of_features: Vec<f32>,
    of_latent: Vec<f32>,
    of_context: Vec<f32>,
    of_hidden: Vec<f32>,
}

impl ActorScratch {
    /// Writes what the modules of the last pass remember now, `[rows, MEMORY]`.
    pub fn remembered(&self, memory: &mut [f32]) {
        let features = self.features.as_chunks::<{ EMBED + MEMORY }>().0;
        for (memory, features) in memory.as_chunks_mut::<MEMORY>().0.iter_mut().zip(features) {
            memory.copy_from_slice(&features[EMBED..]);
        }
    }
}

/// The matrices that are kept transposed. The output layer is too narrow to gain by it.
fn matrices(layout: &ActorLayout) -> [Block; 4] {
    [layout.encoder, layout.attention, layout.hidden, layout.hidden_context]
}

impl Actor {
    /// An actor with these parameters.
    pub fn new(layout: ActorLayout, parameters: &[f32]) -> Self {
        let mut actor = Self { layout, parameters: vec![0.0; layout.len], transposed: vec![0.0; layout.len] };
        actor.load(parameters);
        actor
    }

    /// The network that it is, with the statistics of the observations that it takes.
    pub fn network(&self, mean: &[f32], std: &[f32]) -> Network {
        self.layout.network(&self.parameters, mean, std)
    }

    /// The parameters, in the order of the layout.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Takes other parameters.
    pub fn load(&mut self, parameters: &[f32]) {
        self.parameters.copy_from_slice(parameters);
        transpose(parameters, &matrices(&self.layout), &mut self.transposed);
    }

    /// Logarithm of the standard deviation of each action.
    pub fn log_sigma(&self) -> &[f32] {
        &self.parameters[self.layout.log_sigma.range()]
    }

    /// Where things are in the parameters.
    pub fn layout(&self) -> &ActorLayout {
        &self.layout
    }

    fn has_attention(&self) -> bool {
        !self.layout.attention.is_empty()
    }

    fn bias_of_distance(&self) -> &[f32] {
        &self.parameters[self.layout.distance_bias.range()]
    }

    /// Means of the actions of some teams, `[rows, outputs]`: `observations` normalised, `[rows, inputs]`; `heard` one mask a row, own bit
    /// set; `modules` of each team; `memory` what they remember from the step before.
    pub fn means<'a>(
        &self,
        observations: &[f32],
        heard: &[u64],
        modules: &[usize],
        memory: Remembered,
        scratch: &'a mut ActorScratch,
    ) -> &'a [f32] {
        let rows = heard.len();
        let ActorScratch { means, embedding, features, latent, attention, context, hidden, .. } = scratch;
        let layout = &self.layout;
        let bias = |block: Block| &self.parameters[block.range()];
        let matrix = |block: Block| &self.transposed[block.range()];
        let embedding = room(embedding, rows * EMBED);
        dense(observations, layout.inputs(), matrix(layout.encoder), Start::Bias(bias(layout.encoder_bias)), embedding);
        tanh(embedding);
        let width = layout.features();
        let features = if layout.memory() == 0 {
            &*embedding
        } else {
            let features = room(features, rows * width);
            remember(embedding, modules, memory, features);
            &*features
        };
        let hidden = room(hidden, rows * HIDDEN);
        dense(features, width, matrix(layout.hidden), Start::Bias(bias(layout.hidden_bias)), hidden);
        if self.has_attention() {
            let latent = room(latent, rows * LATENT);
            dense(features, width, matrix(layout.attention), Start::Zero, latent);
            let attention = room(attention, modules.iter().map(|n| n * n).sum());
            let context = room(context, rows * VALUE);
            attend(latent, heard, modules, self.bias_of_distance(), attention, context);
            dense(context, VALUE, matrix(layout.hidden_context), Start::Sum, hidden);
        }
        tanh(hidden);
        let means = room(means, rows * layout.outputs());
        head::<HIDDEN>(hidden, bias(layout.output), bias(layout.output_bias), means);
        means
    }

    /// Adds PPO's clipped loss over a batch to `sum`, and its gradient, transposed: see [`Actor::finish`].
    pub fn gradient(&self, batch: &Batch, loss: LossSettings, scratch: &mut ActorScratch, sum: &mut Gradient) {
        let memory = Remembered { before: &batch.memory, follows: &batch.follows };
        self.means(&batch.observations, &batch.heard, &batch.modules, memory, scratch);
        let (layout, rows) = (&self.layout, batch.rows());
        let ActorScratch {
            means,
            embedding,
            features,
            latent,
            attention,
            context,
            hidden,
            of_means,
            of_embedding,
            of_features,
            of_latent,
            of_context,
            of_hidden,
        } = scratch;
        let of_means = room(of_means, rows * layout.outputs());
        clipped_loss(batch, &means[..rows * layout.outputs()], self.log_sigma(), loss, of_means, layout, sum);

        let gradient = &mut sum.gradient;
        let weights = |block: Block| &self.parameters[block.range()];
        let (embedding, hidden) = (&embedding[..rows * EMBED], &hidden[..rows * HIDDEN]);
        let (width, remembers) = (layout.features(), layout.memory() > 0);
        let features = if remembers { &features[..rows * width] } else { embedding };
        let of_hidden = room(of_hidden, rows * HIDDEN);
        let (of_output, of_bias) = gradient[layout.output.offset..].split_at_mut(layout.output.len());
        let of_bias = &mut of_bias[..layout.outputs()];
        head_backward::<HIDDEN>(hidden, weights(layout.output), of_means, of_hidden, of_output, of_bias);
        bias_tanh_backward(of_hidden, hidden, &mut gradient[layout.hidden_bias.range()]);
        dense_weights(features, width, of_hidden, &mut gradient[layout.hidden.range()]);
        let of_features = room(of_features, rows * width);
        dense(of_hidden, HIDDEN, weights(layout.hidden), Start::Zero, of_features);
        if self.has_attention() {
            let (latent, context) = (&latent[..rows * LATENT], &context[..rows * VALUE]);
            let (of_latent, of_context) = (room(of_latent, rows * LATENT), room(of_context, rows * VALUE));
            dense_weights(context, VALUE, of_hidden, &mut gradient[layout.hidden_context.range()]);
            dense(of_hidden, HIDDEN, weights(layout.hidden_context), Start::Zero, of_context);
            let of_distance = &mut gradient[layout.distance_bias.range()];
            attend_backward(latent, &batch.heard, &batch.modules, attention, of_context, of_latent, of_distance);
            dense_weights(features, width, of_latent, &mut gradient[layout.attention.range()]);
            dense(of_latent, LATENT, weights(layout.attention), Start::Sum, of_features);
        }
        let of_embedding = if remembers {
            let of_embedding = room(of_embedding, rows * EMBED);
            remember_backward(of_features, &batch.modules, &batch.follows, of_embedding);
            of_embedding
        } else {
            of_features
        };
        bias_tanh_backward(of_embedding, embedding, &mut gradient[layout.encoder_bias.range()]);
        dense_weights(&batch.observations, layout.inputs(), of_embedding, &mut gradient[layout.encoder.range()]);
    }

    /// Writes a sum of gradients to `to` in the order of the parameters. The sum is in that order already (`ordered`) or as [`Actor::gradient`] makes it.
    pub fn finish(&self, sum: &[f32], ordered: bool, to: &mut Vec<f32>) {
        to.clear();
        to.extend_from_slice(sum);
        if !ordered {
            transpose_back(sum, &matrices(&self.layout), to);
        }
    }
}

/// What modules remember from the step before: nothing at all by default, for an actor that does not.
#[derive(Clone, Copy, Debug, Default)]
pub struct Remembered<'a> {
    /// As it was kept, `[rows, MEMORY]`.
    pub before: &'a [f32],
    /// For each team whether it is the one before it a step later, so that what it remembers comes from there instead.
    pub follows: &'a [bool],
}

/// Puts embedding and memory side by side, `[rows, EMBED + MEMORY]`, the memory after the step.
fn remember(embedding: &[f32], modules: &[usize], memory: Remembered, features: &mut [f32]) {
    const WIDTH: usize = EMBED + MEMORY;
    let (embedding, features) = (embedding.as_chunks::<EMBED>().0, features.as_chunks_mut::<WIDTH>().0);
    let before = memory.before.as_chunks::<MEMORY>().0;
    let mut first = 0;
    for (n, follows) in modules.iter().zip(memory.follows) {
        for row in first..first + n {
            let mut memory =
                if *follows { std::array::from_fn(|channel| features[row - n][EMBED + channel]) } else { before[row] };
            for ((m, e), leak) in memory.iter_mut().zip(&embedding[row]).zip(LEAKS) {
                *m += leak * (e - *m);
            }
            features[row][..EMBED].copy_from_slice(&embedding[row]);
            features[row][EMBED..].copy_from_slice(&memory);
        }
        first += n;
    }
}

/// The way back of [`remember`]: from the gradient of embedding and memory, which is changed, to that of the embedding.
fn remember_backward(of_features: &mut [f32], modules: &[usize], follows: &[bool], of_embedding: &mut [f32]) {
    const WIDTH: usize = EMBED + MEMORY;
    let of_features = of_features.as_chunks_mut::<WIDTH>().0;
    let of_embedding = of_embedding.as_chunks_mut::<EMBED>().0;
    let mut end = of_features.len();
    for (n, follows) in modules.iter().zip(follows).rev() {
        for row in end - n..end {
            of_embedding[row].copy_from_slice(&of_features[row][..EMBED]);
            for (channel, leak) in LEAKS.into_iter().enumerate() {
                let of_memory = of_features[row][EMBED + channel];
                of_embedding[row][channel] += leak * of_memory;
                if *follows {
                    of_features[row - n][EMBED + channel] += (1.0 - leak) * of_memory;
                }
            }
        }
        end -= n;
    }
}

/// Adds PPO's clipped loss to `sum`, with its gradient over log sigma; that over the means goes into `of_means`.
fn clipped_loss(
    batch: &Batch,
    means: &[f32],
    log_sigma: &[f32],
    loss: LossSettings,
    of_means: &mut [f32],
    layout: &ActorLayout,
    sum: &mut Gradient,
) {
    let outputs = log_sigma.len();
    // Constants of the density cancel in the ratio, but log sigma does not: it is being learnt.
    let constant = outputs as f32 * LOG_DENSITY_CONSTANT + log_sigma.iter().sum::<f32>();
    let of_log_sigma = &mut sum.gradient[layout.log_sigma.range()];
    let advantages = batch.advantages.iter().zip(&batch.modules).flat_map(|(a, n)| std::iter::repeat_n(*a, *n));
    let actions = batch.actions.chunks_exact(outputs).zip(means.chunks_exact(outputs));
    let rows = actions.zip(of_means.chunks_exact_mut(outputs)).zip(advantages);
    for (row, ((((actions, means), of_means), advantage), (weight, old))) in
        rows.zip(batch.weights.iter().zip(&batch.log_probabilities)).enumerate()
    {
        let advantage = batch.own.get(row).map_or(advantage, |own| advantage + own);
        of_means.fill(0.0);
        if *weight == 0.0 {
            continue;
        }
        let mut log_ratio = -constant - old;
        for i in 0..outputs {
            // Kept where the gradient will be: (action - mean) / sigma.
            of_means[i] = (actions[i] - means[i]) * (-log_sigma[i]).exp();
            log_ratio -= 0.5 * of_means[i] * of_means[i];
        }
        let exact = f64::from(log_ratio).exp();
        let ratio = exact as f32;
        let (gain, clipped) = (ratio * advantage, ratio.clamp(1.0 - loss.clip, 1.0 + loss.clip) * advantage);
        sum.policy_loss -= f64::from(gain.min(clipped) * weight);
        sum.kl += f64::from(*weight) * (exact - 1.0 - f64::from(log_ratio));
        if (exact - 1.0).abs() > f64::from(loss.clip) {
            sum.clipped += f64::from(*weight);
        }
        // Where the clip holds the gain down, nothing is gained by moving.
        let of_log_ratio = if gain <= clipped { -weight * gain } else { 0.0 };
        for i in 0..outputs {
            let distance = of_means[i];
            of_log_sigma[i] += of_log_ratio * (distance * distance - 1.0);
            of_means[i] = of_log_ratio * distance * (-log_sigma[i]).exp();
        }
    }
}

vectorise! {
    /// Attention of every module over those of its team that it hears: `latent` is `[rows, LATENT]`; its weights go into `attention`, what
    /// they gather into `context`, `[rows, VALUE]`.
    fn attend(
        latent: &[f32], heard: &[u64], modules: &[usize], bias: &[f32], attention: &mut [f32], context: &mut [f32]
    ) = attend_body
}

#[inline(always)]
fn attend_body<V: Vector>(
    latent: &[f32],
    heard: &[u64],
    modules: &[usize],
    bias: &[f32],
    attention: &mut [f32],
    context: &mut [f32],
) {
    let (latent, context) = (latent.as_chunks::<LATENT>().0, context.as_chunks_mut::<VALUE>().0);
    let scale = (KEY as f32).sqrt().recip();
    let (mut first, mut at) = (0, 0);
    for n in modules {
        let team = &latent[first..first + n];
        for i in 0..*n {
            let weights = &mut attention[at + i * n..at + (i + 1) * n];
            let query = &team[i][..KEY];
            let mut largest = f32::NEG_INFINITY;
            for (j, (weight, other)) in weights.iter_mut().zip(team).enumerate() {
                let audible = heard[first + i] >> j & 1 == 1;
                *weight = if audible { dot::<V>(query, &other[KEY..2 * KEY]) * scale } else { f32::NEG_INFINITY };
                if !bias.is_empty() {
                    *weight += bias[distance_bucket(i, j)];
                }
                largest = largest.max(*weight);
            }
            let mut total = 0.0;
            for weight in weights.iter_mut() {
                *weight = (*weight - largest).exp();
                total += *weight;
            }
            let mut sum = [0.0; VALUE];
            for (weight, other) in weights.iter_mut().zip(team) {
                *weight /= total;
                let value = &other[2 * KEY..];
                for k in 0..VALUE {
                    sum[k] = V::scalar(*weight, value[k], sum[k]);
                }
            }
            context[first + i] = sum;
        }
        (first, at) = (first + n, at + n * n);
    }
}

vectorise! {
    /// The way back of [`attend`]: from the gradient of what was gathered to that of the latents.
    fn attend_backward(
        latent: &[f32], heard: &[u64], modules: &[usize], attention: &[f32], of_context: &[f32], of_latent: &mut [f32],
        of_bias: &mut [f32]
    ) = attend_backward_body
}

#[inline(always)]
fn attend_backward_body<V: Vector>(
    latent: &[f32],
    heard: &[u64],
    modules: &[usize],
    attention: &[f32],
    of_context: &[f32],
    of_latent: &mut [f32],
    of_bias: &mut [f32],
) {
    let (latent, of_context) = (latent.as_chunks::<LATENT>().0, of_context.as_chunks::<VALUE>().0);
    let of_latent = of_latent.as_chunks_mut::<LATENT>().0;
    let scale = (KEY as f32).sqrt().recip();
    let (mut first, mut at) = (0, 0);
    for n in modules {
        let (team, of_team) = (&latent[first..first + n], &mut of_latent[first..first + n]);
        of_team.fill([0.0; LATENT]);
        for i in 0..*n {
            let weights = &attention[at + i * n..at + (i + 1) * n];
            let (query, of_context) = (&team[i][..KEY], &of_context[first + i]);
            let mut of_weights = [0.0f32; u64::BITS as usize];
            let mut mean = 0.0;
            for (j, other) in team.iter().enumerate() {
                if heard[first + i] >> j & 1 == 1 {
                    of_weights[j] = dot::<V>(of_context, &other[2 * KEY..]);
                    mean = V::scalar(weights[j], of_weights[j], mean);
                    let of_value = &mut of_team[j][2 * KEY..];
                    for k in 0..VALUE {
                        of_value[k] = V::scalar(weights[j], of_context[k], of_value[k]);
                    }
                }
            }
            let mut of_query = [0.0; KEY];
            for (j, other) in team.iter().enumerate() {
                if heard[first + i] >> j & 1 == 1 {
                    let of_score = scale * weights[j] * (of_weights[j] - mean);
                    if !of_bias.is_empty() {
                        of_bias[distance_bucket(i, j)] += weights[j] * (of_weights[j] - mean);
                    }
                    let (key, of_key) = (&other[KEY..2 * KEY], &mut of_team[j][KEY..2 * KEY]);
                    for k in 0..KEY {
                        of_query[k] = V::scalar(of_score, key[k], of_query[k]);
                        of_key[k] = V::scalar(of_score, query[k], of_key[k]);
                    }
                }
            }
            of_team[i][..KEY].copy_from_slice(&of_query);
        }
        (first, at) = (first + n, at + n * n);
    }
}

/// ln(2 pi) / 2, for each action dimension. Its last digit does not count: it cancels in every ratio.
pub(crate) const LOG_DENSITY_CONSTANT: f32 = 0.918_938_6;

/// Logarithm of the density of `action` under independent normals of mean `mean` and standard deviation exp(`log_sigma`).
pub fn log_probability(action: &[f32], mean: &[f32], log_sigma: &[f32]) -> f32 {
    let mut sum = -(action.len() as f32 * LOG_DENSITY_CONSTANT);
    for i in 0..action.len() {
        let distance = (action[i] - mean[i]) * (-log_sigma[i]).exp();
        sum -= 0.5 * distance * distance + log_sigma[i];
    }
    sum
}
