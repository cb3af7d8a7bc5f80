//! The critic: layout of its parameters, values of whole teams, and the gradient of their squared error, derived by hand.
//!
//! It sees the whole team: the same two layers for every module, then the mean over the modules beside the head module's embedding, so that
//! it works for any number of modules.

use super::actor::{EMBED, HIDDEN};
use crate::environment::PRIVILEGED;
use crate::methods::kernels::{Start, bias_tanh_backward, dense, dense_weights, head, head_backward, tanh};
use crate::methods::on_policy::{Batch, Gradient};
use crate::methods::parameters::{Block, lay_out, orthogonal, room, transpose, transpose_back};
use crate::methods::random::{Stream, stream};

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

impl CriticLayout {
    /// The layout of a critic that takes so many numbers of an observation, the first, and all privileged ones.
    pub fn new(inputs: usize) -> Self {
        let ([first, first_bias, second, second_bias, team, team_bias, value, value_bias], len) = lay_out([
            ("first.weight", EMBED, inputs + PRIVILEGED),
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

    /// Numbers of an observation that it takes.
    fn inputs(&self) -> usize {
        self.first.columns - PRIVILEGED
    }

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

/// A critic's weights, ready for both ways.
#[derive(Clone, Debug)]
pub struct Critic {
    layout: CriticLayout,
    /// As in the layout, one row per output.
    parameters: Vec<f32>,
    /// The same with one row per input in the matrices of [`matrices`].
    transposed: Vec<f32>,
}

/// Working memory of a critic: what its layers put out, and the gradients of that. `rows` are modules of all teams together.
#[derive(Clone, Debug, Default)]
pub struct CriticScratch {
    /// Values on the critic's scale, one a team; longer than that after a larger batch.
    pub values: Vec<f32>,
    /// `[rows, EMBED]`
    first: Vec<f32>,
    /// `[rows, EMBED]`
    second: Vec<f32>,
    /// Mean embedding and the head's, `[teams, 2 EMBED]`
    pooled: Vec<f32>,
    /// `[teams, HIDDEN]`
    team: Vec<f32>,
    of_values: Vec<f32>,
    of_first: Vec<f32>,
    of_second: Vec<f32>,
    of_pooled: Vec<f32>,
    of_team: Vec<f32>,
}

/// The matrices that are kept transposed.
fn matrices(layout: &CriticLayout) -> [Block; 3] {
    [layout.first, layout.second, layout.team]
}

impl Critic {
    /// A critic with these parameters.
    pub fn new(layout: CriticLayout, parameters: &[f32]) -> Self {
        let mut critic = Self { layout, parameters: vec![0.0; layout.len], transposed: vec![0.0; layout.len] };
        critic.load(parameters);
        critic
    }

    /// The parameters, in the order of the layout.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Where things are in the parameters.
    pub fn layout(&self) -> &CriticLayout {
        &self.layout
    }

    /// Takes other parameters.
    pub fn load(&mut self, parameters: &[f32]) {
        self.parameters.copy_from_slice(parameters);
        transpose(parameters, &matrices(&self.layout), &mut self.transposed);
    }

    /// Values of some teams on the critic's scale: `observations` are `[rows, inputs]`, `privileged` numbers `[rows, PRIVILEGED]`, both
    /// normalised; `modules` of each team.
    pub fn values<'a>(
        &self,
        observations: &[f32],
        privileged: &[f32],
        modules: &[usize],
        scratch: &'a mut CriticScratch,
    ) -> &'a [f32] {
        let inputs = self.layout.inputs();
        let (rows, teams) = (observations.len() / inputs, modules.len());
        let CriticScratch { values, first, second, pooled, team, .. } = scratch;
        let layout = &self.layout;
        let bias = |block: Block| &self.parameters[block.range()];
        let matrix = |block: Block| &self.transposed[block.range()];
        let (of_observations, of_privileged) = matrix(layout.first).split_at(inputs * EMBED);
        let first = room(first, rows * EMBED);
        dense(observations, inputs, of_observations, Start::Bias(bias(layout.first_bias)), first);
        dense(privileged, PRIVILEGED, of_privileged, Start::Sum, first);
        tanh(first);
        let second = room(second, rows * EMBED);
        dense(first, EMBED, matrix(layout.second), Start::Bias(bias(layout.second_bias)), second);
        tanh(second);
        let pooled = room(pooled, teams * 2 * EMBED);
        let mut rest = &*second;
        for (pooled, n) in pooled.chunks_exact_mut(2 * EMBED).zip(modules) {
            let (embeddings, others) = rest.split_at(n * EMBED);
            let (mean, of_head) = pooled.split_at_mut(EMBED);
            of_head.copy_from_slice(&embeddings[..EMBED]);
            mean.fill(0.0);
            for embedding in embeddings.chunks_exact(EMBED) {
                mean.iter_mut().zip(embedding).for_each(|(mean, x)| *mean += x);
            }
            mean.iter_mut().for_each(|mean| *mean *= 1.0 / *n as f32);
            rest = others;
        }
        let team = room(team, teams * HIDDEN);
        dense(pooled, 2 * EMBED, matrix(layout.team), Start::Bias(bias(layout.team_bias)), team);
        tanh(team);
        let values = room(values, teams);
        head::<HIDDEN>(team, bias(layout.value), bias(layout.value_bias), values);
        values
    }

    /// Adds half the squared error over a batch times `weight` to `sum`, and its gradient, transposed: see [`Critic::finish`].
    pub fn gradient(&self, batch: &Batch, weight: f32, scratch: &mut CriticScratch, sum: &mut Gradient) {
        self.values(&batch.observations, &batch.privileged, &batch.modules, scratch);
        let (rows, teams) = (batch.rows(), batch.samples());
        let layout = &self.layout;
        let CriticScratch { values, first, second, pooled, team, of_values, of_first, of_second, of_pooled, of_team } =
            scratch;
        let of_values = room(of_values, teams);
        for ((of_value, value), target) in of_values.iter_mut().zip(values.iter()).zip(&batch.targets) {
            let error = value - target;
            sum.value_loss += f64::from(0.5 * weight * error * error);
            *of_value = weight * error;
        }

        let gradient = &mut sum.gradient;
        let weights = |block: Block| &self.parameters[block.range()];
        let (first, second, team) = (&first[..rows * EMBED], &second[..rows * EMBED], &team[..teams * HIDDEN]);
        let of_team = room(of_team, teams * HIDDEN);
        let (of_value_weights, of_bias) = gradient[layout.value.offset..].split_at_mut(layout.value.len());
        head_backward::<HIDDEN>(team, weights(layout.value), of_values, of_team, of_value_weights, &mut of_bias[..1]);
        bias_tanh_backward(of_team, team, &mut gradient[layout.team_bias.range()]);
        dense_weights(&pooled[..teams * 2 * EMBED], 2 * EMBED, of_team, &mut gradient[layout.team.range()]);
        let of_pooled = room(of_pooled, teams * 2 * EMBED);
        dense(of_team, HIDDEN, weights(layout.team), Start::Zero, of_pooled);
        let of_second = room(of_second, rows * EMBED);
        let mut rest = &mut *of_second;
        for (of_pooled, n) in of_pooled.chunks_exact(2 * EMBED).zip(&batch.modules) {
            let (of_embeddings, others) = rest.split_at_mut(n * EMBED);
            let (of_mean, of_head) = of_pooled.split_at(EMBED);
            for of_embedding in of_embeddings.chunks_exact_mut(EMBED) {
                of_embedding.iter_mut().zip(of_mean).for_each(|(to, x)| *to = x * (1.0 / *n as f32));
            }
            of_embeddings.iter_mut().zip(of_head).for_each(|(to, x)| *to += x);
            rest = others;
        }
        bias_tanh_backward(of_second, second, &mut gradient[layout.second_bias.range()]);
        dense_weights(first, EMBED, of_second, &mut gradient[layout.second.range()]);
        let of_first = room(of_first, rows * EMBED);
        dense(of_second, EMBED, weights(layout.second), Start::Zero, of_first);
        bias_tanh_backward(of_first, first, &mut gradient[layout.first_bias.range()]);
        let (of_observations, of_privileged) = gradient[layout.first.range()].split_at_mut(layout.inputs() * EMBED);
        dense_weights(&batch.observations, layout.inputs(), of_first, of_observations);
        dense_weights(&batch.privileged, PRIVILEGED, of_first, of_privileged);
    }

    /// Writes a sum of gradients to `to` in the order of the parameters. The sum is in that order already (`ordered`) or as [`Critic::gradient`] makes it.
    pub fn finish(&self, sum: &[f32], ordered: bool, to: &mut Vec<f32>) {
        to.clear();
        to.extend_from_slice(sum);
        if !ordered {
            transpose_back(sum, &matrices(&self.layout), to);
        }
    }
}
