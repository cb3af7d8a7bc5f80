//! What the actor and the critic are made of: layouts of their flat parameter vectors, batches of experience, and losses with gradients.
//!
//! The actor of the control policy is the network of [`crate::network`]: encoder, optional attention, hidden layer, two outputs a module,
//! and a standard deviation that does not depend on the state. That of the imagination policy is the same without attention and with
//! three outputs. The critic sees the whole team: the same two layers for every module, then the mean
//! over the modules beside the head module's embedding, so that it works for any number of modules.
//!
//! [`super::actor`] and [`super::critic`] compute them and their gradients; [`super::autodiff`] does it once more with burn.

use composer_shared::observation::SIZE;

use super::imagination::DISPLACEMENT;
use super::{Block, Method, Stream, lay_out, orthogonal, stream};
use crate::environment::PRIVILEGED;
use crate::network::{Dense, Network};

/// Size of a module's embedding.
pub const EMBED: usize = 64;
/// Size of a latent's key and of a query.
pub const KEY: usize = 16;
/// Size of a latent's value.
pub const VALUE: usize = 32;
/// Size of the hidden layer.
pub const HIDDEN: usize = 64;
/// Actions of a module under the control policy: yaw and pitch torque as a fraction of the limit.
pub const OUT: usize = 2;
/// What the critic knows of a module.
pub const CRITIC_INPUT: usize = SIZE + PRIVILEGED;

/// Where things are in an actor's parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorLayout {
    /// `[EMBED, SIZE]` weights of the encoder.
    pub encoder: Block,
    /// Its bias.
    pub encoder_bias: Block,
    /// Query, key and value weights, one below the other: `[2 KEY + VALUE, EMBED]`. Empty without attention.
    pub attention: Block,
    /// Weights of the hidden layer over the own embedding.
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
    /// Length of the parameter vector.
    pub len: usize,
}

impl ActorLayout {
    /// The layout of a method's control policy.
    pub fn control(method: Method) -> Self {
        Self::new(method.attention(), OUT)
    }

    /// The layout of the imagination policy, which has no attention: it never leaves the training, where nobody has to talk.
    pub fn imagination() -> Self {
        Self::new(false, DISPLACEMENT)
    }

    fn new(attention: bool, outputs: usize) -> Self {
        let attention = usize::from(attention);
        let (
            [encoder, encoder_bias, attention, hidden, hidden_context, hidden_bias, output, output_bias, log_sigma],
            len,
        ) = lay_out([
            ("encoder.weight", EMBED, SIZE),
            ("encoder.bias", 1, EMBED),
            ("attention.weight", attention * (2 * KEY + VALUE), EMBED),
            ("hidden.weight", HIDDEN, EMBED),
            ("hidden.context_weight", HIDDEN, attention * VALUE),
            ("hidden.bias", 1, HIDDEN),
            ("output.weight", outputs, HIDDEN),
            ("output.bias", 1, outputs),
            ("log_sigma", 1, outputs),
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
            len,
        }
    }

    /// Actions of a module.
    pub fn outputs(&self) -> usize {
        self.output.rows
    }

    /// All blocks in order.
    pub fn blocks(&self) -> [Block; 9] {
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
        ]
    }

    /// Initial parameters: orthogonal, gain sqrt 2 (1 for query, key and value, 0.01 for the outputs), zero bias.
    pub fn initial(&self, seed: u64, sigma: f32) -> Vec<f32> {
        let mut p = vec![0.0; self.len];
        let mut rng = stream(seed, Stream::Weights, 0, 0);
        let root2 = std::f32::consts::SQRT_2;
        p[self.encoder.range()].copy_from_slice(&orthogonal(EMBED, SIZE, root2, &mut rng));
        if !self.attention.is_empty() {
            let parts = [(0, KEY), (KEY, KEY), (2 * KEY, VALUE)];
            for (start, rows) in parts {
                let from = self.attention.offset + start * EMBED;
                p[from..from + rows * EMBED].copy_from_slice(&orthogonal(rows, EMBED, 1.0, &mut rng));
            }
        }
        let context = self.hidden_context.columns;
        let hidden = orthogonal(HIDDEN, EMBED + context, root2, &mut rng);
        for (row, weights) in hidden.chunks_exact(EMBED + context).enumerate() {
            p[self.hidden.offset + row * EMBED..][..EMBED].copy_from_slice(&weights[..EMBED]);
            p[self.hidden_context.offset + row * context..][..context].copy_from_slice(&weights[EMBED..]);
        }
        p[self.output.range()].copy_from_slice(&orthogonal(self.outputs(), HIDDEN, 0.01, &mut rng));
        p[self.log_sigma.range()].fill(sigma.ln());
        p
    }

    /// The network that these parameters of a control policy are, with the statistics of its observations.
    pub fn network(&self, parameters: &[f32], mean: [f32; SIZE], std: [f32; SIZE]) -> Network {
        let dense =
            |weights: Vec<f32>, inputs: usize, outputs: usize, bias: Vec<f32>| Dense { inputs, outputs, weights, bias };
        let part = |block: Block| parameters[block.range()].to_vec();
        let attention = !self.attention.is_empty();
        let qkv = if attention { part(self.attention) } else { vec![0.0; (2 * KEY + VALUE) * EMBED] };
        let mut hidden = vec![0.0; HIDDEN * (EMBED + VALUE)];
        for row in 0..HIDDEN {
            let to = &mut hidden[row * (EMBED + VALUE)..][..EMBED + VALUE];
            to[..EMBED].copy_from_slice(&parameters[self.hidden.offset + row * EMBED..][..EMBED]);
            if attention {
                to[EMBED..].copy_from_slice(&parameters[self.hidden_context.offset + row * VALUE..][..VALUE]);
            }
        }
        Network {
            attention,
            mean,
            std,
            encoder: dense(part(self.encoder), SIZE, EMBED, part(self.encoder_bias)),
            query: dense(qkv[..KEY * EMBED].to_vec(), EMBED, KEY, Vec::new()),
            key: dense(qkv[KEY * EMBED..2 * KEY * EMBED].to_vec(), EMBED, KEY, Vec::new()),
            value: dense(qkv[2 * KEY * EMBED..].to_vec(), EMBED, VALUE, Vec::new()),
            hidden: dense(hidden, EMBED + VALUE, HIDDEN, part(self.hidden_bias)),
            output: dense(part(self.output), HIDDEN, OUT, part(self.output_bias)),
        }
    }
}

/// Where things are in the critic's parameters.
#[derive(Clone, Copy, Debug)]
pub struct CriticLayout {
    /// First layer, over one module.
    pub first: Block,
    /// Its bias.
    pub first_bias: Block,
    /// Second layer, over one module: the module's embedding.
    pub second: Block,
    /// Its bias.
    pub second_bias: Block,
    /// Third layer, over the mean embedding and the head's.
    pub team: Block,
    /// Its bias.
    pub team_bias: Block,
    /// Output.
    pub value: Block,
    /// Its bias.
    pub value_bias: Block,
    /// Length of the parameter vector.
    pub len: usize,
}

impl Default for CriticLayout {
    fn default() -> Self {
        let ([first, first_bias, second, second_bias, team, team_bias, value, value_bias], len) = lay_out([
            ("first.weight", EMBED, CRITIC_INPUT),
            ("first.bias", 1, EMBED),
            ("second.weight", EMBED, EMBED),
            ("second.bias", 1, EMBED),
            ("team.weight", HIDDEN, 2 * EMBED),
            ("team.bias", 1, HIDDEN),
            ("value.weight", 1, HIDDEN),
            ("value.bias", 1, 1),
        ]);
        Self { first, first_bias, second, second_bias, team, team_bias, value, value_bias, len }
    }
}

impl CriticLayout {
    /// All blocks in order.
    pub fn blocks(&self) -> [Block; 8] {
        [
            self.first,
            self.first_bias,
            self.second,
            self.second_bias,
            self.team,
            self.team_bias,
            self.value,
            self.value_bias,
        ]
    }

    /// Initial parameters: orthogonal, gain sqrt 2 (`value_gain` for the output), zero bias.
    pub fn initial(&self, seed: u64, value_gain: f32) -> Vec<f32> {
        let mut p = vec![0.0; self.len];
        let mut rng = stream(seed, Stream::Weights, 1, 0);
        for (block, gain) in [
            (self.first, std::f32::consts::SQRT_2),
            (self.second, std::f32::consts::SQRT_2),
            (self.team, std::f32::consts::SQRT_2),
            (self.value, value_gain),
        ] {
            p[block.range()].copy_from_slice(&orthogonal(block.rows, block.columns, gain, &mut rng));
        }
        p
    }

    /// Changes the output layer so that its values stay the same on the reward's scale while the scale of the critic moves from
    /// (`mean`, `std`) to (`new_mean`, `new_std`): the "preserving outputs" half of PopArt.
    pub fn rescale(&self, parameters: &mut [f32], [mean, std]: [f32; 2], [new_mean, new_std]: [f32; 2]) {
        let ratio = std / new_std;
        parameters[self.value.range()].iter_mut().for_each(|w| *w *= ratio);
        let bias = &mut parameters[self.value_bias.offset];
        *bias = (std * *bias + mean - new_mean) / new_std;
    }
}

/// A batch of samples (one sample is one step of one environment) of any numbers of modules; a row is one module of one sample.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Modules of each sample.
    pub modules: Vec<usize>,
    /// Normalised observations, `[rows, SIZE]`.
    pub observations: Vec<f32>,
    /// Normalised privileged numbers, `[rows, PRIVILEGED]`.
    pub privileged: Vec<f32>,
    /// Who hears whom, one mask a row, own bit set; bit i stands for module i of the sample.
    pub heard: Vec<u64>,
    /// Weight of each row in the actor's loss: 0 for dead modules.
    pub weights: Vec<f32>,
    /// Actions taken, `[rows, outputs]`.
    pub actions: Vec<f32>,
    /// Logarithm of the density with which each was taken, `[rows]`.
    pub log_probabilities: Vec<f32>,
    /// Advantage of each sample.
    pub advantages: Vec<f32>,
    /// What the critic should say of each sample, on the critic's scale.
    pub targets: Vec<f32>,
}

impl Batch {
    /// Samples in the batch.
    pub fn samples(&self) -> usize {
        self.modules.len()
    }

    /// Modules of all samples together.
    pub fn rows(&self) -> usize {
        self.heard.len()
    }

    /// Empties the batch and keeps its memory.
    pub fn clear(&mut self) {
        let Self { modules, observations, privileged, heard, weights, actions, log_probabilities, advantages, targets } =
            self;
        modules.clear();
        heard.clear();
        for numbers in [observations, privileged, weights, actions, log_probabilities, advantages, targets] {
            numbers.clear();
        }
    }
}

/// The same parameters with each of `blocks` the other way round: one row per input where there was one per output.
pub(crate) fn transpose(parameters: &[f32], blocks: &[Block], to: &mut [f32]) {
    for block in blocks {
        let (from, to) = (&parameters[block.range()], &mut to[block.range()]);
        for (row, from) in from.chunks_exact(block.columns.max(1)).enumerate() {
            for (column, x) in from.iter().enumerate() {
                to[column * block.rows + row] = *x;
            }
        }
    }
}

/// Undoes [`transpose`].
pub(crate) fn transpose_back(transposed: &[f32], blocks: &[Block], to: &mut [f32]) {
    for block in blocks {
        let (from, to) = (&transposed[block.range()], &mut to[block.range()]);
        for (row, to) in to.chunks_exact_mut(block.columns.max(1)).enumerate() {
            for (column, x) in to.iter_mut().enumerate() {
                *x = from[column * block.rows + row];
            }
        }
    }
}

/// The first `len` numbers of `memory`, which grows if it must and is not cleared.
pub(crate) fn room(memory: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if memory.len() < len {
        memory.resize(len, 0.0);
    }
    &mut memory[..len]
}

/// A loss summed over a batch, its gradient, and what else is told about it.
#[derive(Clone, Debug, Default)]
pub struct Gradient {
    /// Gradient of the loss over the flat parameters.
    pub gradient: Vec<f32>,
    /// The loss.
    pub loss: f64,
    /// Weighted sum of (ratio - 1) - ln ratio: an estimate of the KL divergence between the old and the new policy.
    pub kl: f64,
    /// Weighted share of ratios that were clipped.
    pub clipped: f64,
}

impl Gradient {
    /// Nothing yet, over `len` parameters.
    pub fn clear(&mut self, len: usize) {
        self.gradient.clear();
        self.gradient.resize(len, 0.0);
        (self.loss, self.kl, self.clipped) = (0.0, 0.0, 0.0);
    }

    /// Adds another batch's.
    pub fn add(&mut self, other: &Gradient) {
        self.gradient.iter_mut().zip(&other.gradient).for_each(|(a, b)| *a += b);
        self.loss += other.loss;
        self.kl += other.kl;
        self.clipped += other.clipped;
    }
}

/// What PPO's clipped loss needs besides the batch.
#[derive(Clone, Copy, Debug)]
pub struct PpoLoss {
    /// Ratios are clipped to 1 +- this.
    pub clip: f32,
}

/// ln(2 pi) / 2, for each action dimension. Its last digit does not count: it cancels in every ratio.
pub(crate) const LOG_DENSITY_CONSTANT: f32 = 0.918_938_6;

/// Logarithm of the density of `action` under independent normals of mean `mean` and standard deviation exp(`log_sigma`).
pub fn log_probability<const A: usize>(action: [f32; A], mean: [f32; A], log_sigma: [f32; A]) -> f32 {
    let mut sum = -(A as f32 * LOG_DENSITY_CONSTANT);
    for i in 0..A {
        let distance = (action[i] - mean[i]) * (-log_sigma[i]).exp();
        sum -= 0.5 * distance * distance + log_sigma[i];
    }
    sum
}
