//! The actor and the critic as burn computes their gradients, over flat parameter vectors.
//!
//! The actor of the control policy is the network of [`crate::network`]: encoder, optional attention, hidden layer, two outputs a module,
//! and a standard deviation that does not depend on the state. That of the imagination policy is the same without attention and with
//! three outputs. The critic sees the whole team: the same two layers for every module, then the mean
//! over the modules beside the head module's embedding, so that it works for any number of modules.

use burn::tensor::activation::softmax;
use burn::tensor::{Device, Tensor, TensorData};
use composer_shared::observation::SIZE;

use super::fused::bias_tanh;
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

/// Added to the score of a module that is not heard.
const UNHEARD: f32 = -1e9;

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

/// A batch of samples (one sample is one step of one environment), padded to the same number of modules.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Samples.
    pub samples: usize,
    /// Modules in each, with padding.
    pub modules: usize,
    /// Normalised observations, `[samples, modules, SIZE]`.
    pub observations: Vec<f32>,
    /// Normalised observation and privileged numbers, `[samples, modules, CRITIC_INPUT]`.
    pub critic_inputs: Vec<f32>,
    /// Who hears whom, one mask a module, own bit set.
    pub heard: Vec<u64>,
    /// Modules present in each sample; those behind them are padding.
    pub present: Vec<usize>,
    /// Weight of each module in the actor's loss: 0 for dead modules and padding.
    pub weights: Vec<f32>,
    /// Actions taken, `[samples, modules, outputs]`.
    pub actions: Vec<f32>,
    /// Logarithm of the density with which each was taken, `[samples, modules]`.
    pub log_probabilities: Vec<f32>,
    /// Advantage of each sample.
    pub advantages: Vec<f32>,
    /// What the critic should say of each sample, on the critic's scale.
    pub targets: Vec<f32>,
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
    /// Adds another batch's.
    pub fn add(&mut self, other: &Gradient) {
        if self.gradient.is_empty() {
            self.gradient = other.gradient.clone();
        } else {
            self.gradient.iter_mut().zip(&other.gradient).for_each(|(a, b)| *a += b);
        }
        self.loss += other.loss;
        self.kl += other.kl;
        self.clipped += other.clipped;
    }
}

/// A tensor for each block that has any numbers; they require gradients if the device does autodiff.
fn tensors<const N: usize>(parameters: &[f32], blocks: [Block; N], device: &Device) -> [Option<Tensor<2>>; N] {
    blocks.map(|block| {
        (!block.is_empty()).then(|| {
            let data = TensorData::new(parameters[block.range()].to_vec(), [block.rows, block.columns]);
            let tensor = Tensor::from_data(data, device);
            if tensor.is_autodiff() { tensor.require_grad() } else { tensor }
        })
    })
}

fn floats<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().expect("the flex backend computes in f32")
}

/// Reads the gradients of `tensors` out, in the order of `blocks`.
fn collect<const N: usize>(
    loss: &Tensor<1>,
    tensors: [Option<Tensor<2>>; N],
    blocks: [Block; N],
    len: usize,
) -> Vec<f32> {
    let mut gradients = loss.backward();
    let mut flat = vec![0.0; len];
    for (tensor, block) in tensors.into_iter().zip(blocks) {
        if let Some(gradient) = tensor.and_then(|tensor| tensor.grad_remove(&mut gradients)) {
            flat[block.range()].copy_from_slice(&floats(gradient));
        }
    }
    flat
}

/// What PPO's clipped loss needs besides the batch.
#[derive(Clone, Copy, Debug)]
pub struct PpoLoss {
    /// Ratios are clipped to 1 +- this.
    pub clip: f32,
}

impl ActorLayout {
    /// Means of the actions, `[samples * modules, outputs]`.
    fn forward(&self, p: &[Option<Tensor<2>>; 9], batch: &Batch, device: &Device) -> Tensor<2> {
        let [encoder, encoder_bias, attention, hidden, hidden_context, hidden_bias, output, output_bias, _] = p;
        let [Some(encoder), Some(encoder_bias), Some(hidden), Some(hidden_bias), Some(output), Some(output_bias)] =
            [encoder, encoder_bias, hidden, hidden_bias, output, output_bias].map(Clone::clone)
        else {
            unreachable!("only the blocks of attention may be empty");
        };
        let (samples, modules) = (batch.samples, batch.modules);
        let rows = samples * modules;
        let x = Tensor::<2>::from_data(TensorData::new(batch.observations.clone(), [rows, SIZE]), device);
        let e = bias_tanh(x.matmul(encoder.transpose()), encoder_bias);
        let mut h = e.clone().matmul(hidden.transpose());
        if let (Some(attention), Some(hidden_context)) = (attention.clone(), hidden_context.clone()) {
            let qkv = e.matmul(attention.transpose()).reshape([samples, modules, 2 * KEY + VALUE]);
            let q = qkv.clone().slice([0..samples, 0..modules, 0..KEY]);
            let k = qkv.clone().slice([0..samples, 0..modules, KEY..2 * KEY]);
            let v = qkv.slice([0..samples, 0..modules, 2 * KEY..2 * KEY + VALUE]);
            let mut mask = vec![0.0f32; rows * modules];
            for (row, heard) in batch.heard.iter().enumerate() {
                for other in 0..modules {
                    if heard >> other & 1 == 0 {
                        mask[row * modules + other] = UNHEARD;
                    }
                }
            }
            let mask = Tensor::<3>::from_data(TensorData::new(mask, [samples, modules, modules]), device);
            let scores = q.matmul(k.swap_dims(1, 2)) * (KEY as f32).sqrt().recip() + mask;
            let context = softmax(scores, 2).matmul(v).reshape([rows, VALUE]);
            h = h + context.matmul(hidden_context.transpose());
        }
        bias_tanh(h, hidden_bias).matmul(output.transpose()) + output_bias
    }

    /// Means of the actions of a batch, without gradients: what training believes the policy says.
    pub fn means(&self, parameters: &[f32], batch: &Batch) -> Vec<f32> {
        let device = Device::flex();
        floats(self.forward(&tensors(parameters, self.blocks(), &device), batch, &device))
    }

    /// PPO's clipped loss over a batch, and its gradient.
    pub fn gradient(&self, parameters: &[f32], batch: &Batch, loss: PpoLoss) -> Gradient {
        let device = Device::flex().autodiff();
        let rows = batch.samples * batch.modules;
        let tensors = tensors(parameters, self.blocks(), &device);
        let mean = self.forward(&tensors, batch, &device);
        let column =
            |data: Vec<f32>, columns: usize| Tensor::<2>::from_data(TensorData::new(data, [rows, columns]), &device);
        let Some(log_sigma) = tensors[8].clone() else { unreachable!("log sigma is never empty") };
        let actions = column(batch.actions.clone(), self.outputs());
        let advantages = batch.advantages.iter().flat_map(|a| std::iter::repeat_n(*a, batch.modules)).collect();
        let advantages = column(advantages, 1);
        let weights = column(batch.weights.clone(), 1);
        // Constants of the density cancel in the ratio, but log sigma does not: it is being learnt.
        let constant = self.outputs() as f32 * LOG_DENSITY_CONSTANT;
        let offset = batch.log_probabilities.iter().map(|l| l + constant).collect();
        let distance = (actions - mean) * log_sigma.clone().neg().exp();
        let log_ratio = (distance.clone() * distance).sum_dim(1) * -0.5 - log_sigma.sum_dim(1) - column(offset, 1);
        let ratio = log_ratio.clone().exp();
        let gain = ratio.clone() * advantages.clone();
        let clipped = ratio.clone().clamp(1.0 - loss.clip, 1.0 + loss.clip) * advantages;
        let total = (gain.min_pair(clipped) * weights).sum().neg();
        let log_ratio = floats(log_ratio.inner());
        let gradient = collect(&total, tensors, self.blocks(), self.len);
        let mut result = Gradient { gradient, loss: f64::from(total.into_scalar::<f32>()), ..Gradient::default() };
        for (log_ratio, weight) in log_ratio.iter().zip(&batch.weights) {
            let (log_ratio, weight) = (f64::from(*log_ratio), f64::from(*weight));
            let ratio = log_ratio.exp();
            result.kl += weight * (ratio - 1.0 - log_ratio);
            if (ratio - 1.0).abs() > f64::from(loss.clip) {
                result.clipped += weight;
            }
        }
        result
    }
}

/// ln(2 pi) / 2, for each action dimension. Its last digit does not count: it cancels in every ratio.
const LOG_DENSITY_CONSTANT: f32 = 0.918_938_6;

/// Logarithm of the density of `action` under independent normals of mean `mean` and standard deviation exp(`log_sigma`).
pub fn log_probability<const A: usize>(action: [f32; A], mean: [f32; A], log_sigma: [f32; A]) -> f32 {
    let mut sum = -(A as f32 * LOG_DENSITY_CONSTANT);
    for i in 0..A {
        let distance = (action[i] - mean[i]) * (-log_sigma[i]).exp();
        sum -= 0.5 * distance * distance + log_sigma[i];
    }
    sum
}

impl CriticLayout {
    /// Values of a batch on the critic's scale, `[samples, 1]`.
    fn forward(&self, p: &[Option<Tensor<2>>; 8], batch: &Batch, device: &Device) -> Tensor<2> {
        let [
            Some(first),
            Some(first_bias),
            Some(second),
            Some(second_bias),
            Some(team),
            Some(team_bias),
            Some(value),
            Some(value_bias),
        ] = p.each_ref().map(|tensor| tensor.clone())
        else {
            unreachable!("no block of the critic is empty");
        };
        let (samples, modules) = (batch.samples, batch.modules);
        let rows = samples * modules;
        let x = Tensor::<2>::from_data(TensorData::new(batch.critic_inputs.clone(), [rows, CRITIC_INPUT]), device);
        let h = bias_tanh(x.matmul(first.transpose()), first_bias);
        let h = bias_tanh(h.matmul(second.transpose()), second_bias).reshape([samples, modules, EMBED]);
        // Row 0 takes the mean over the modules that are there, row 1 the head.
        let mut pool = vec![0.0f32; 2 * rows];
        for (pool, present) in pool.chunks_exact_mut(2 * modules).zip(&batch.present) {
            pool[..*present].fill(1.0 / *present as f32);
            pool[modules] = 1.0;
        }
        let pool = Tensor::<3>::from_data(TensorData::new(pool, [samples, 2, modules]), device);
        let pooled = pool.matmul(h).reshape([samples, 2 * EMBED]);
        let h = bias_tanh(pooled.matmul(team.transpose()), team_bias);
        h.matmul(value.transpose()) + value_bias
    }

    /// Values of a batch on the critic's scale.
    pub fn values(&self, parameters: &[f32], batch: &Batch) -> Vec<f32> {
        let device = Device::flex();
        floats(self.forward(&tensors(parameters, self.blocks(), &device), batch, &device))
    }

    /// Half the squared error over a batch times `weight`, and its gradient.
    pub fn gradient(&self, parameters: &[f32], batch: &Batch, weight: f32) -> Gradient {
        let device = Device::flex().autodiff();
        let tensors = tensors(parameters, self.blocks(), &device);
        let targets = Tensor::<2>::from_data(TensorData::new(batch.targets.clone(), [batch.samples, 1]), &device);
        let error = self.forward(&tensors, batch, &device) - targets;
        let loss = (error.clone() * error).sum() * (0.5 * weight);
        let gradient = collect(&loss, tensors, self.blocks(), self.len);
        Gradient { gradient, loss: f64::from(loss.into_scalar::<f32>()), ..Gradient::default() }
    }
}
