//! The actor, the critic and their gradients once more, by burn's automatic differentiation: the reference for the gradients written by
//! hand ([`super::actor`], [`super::critic`]), and where to begin with a network of another kind.
//!
//! Samples are padded to the longest of the batch: tensors have one shape.

use burn::tensor::activation::softmax;
use burn::tensor::{Device, Int, Tensor, TensorData};

use composer_shared::policy::distance_bucket;

use super::actor::{ActorLayout, EMBED, KEY, LEAKS, LOG_DENSITY_CONSTANT, MEMORY, VALUE};
use super::critic::CriticLayout;
use super::fused::bias_tanh;
use crate::environment::PRIVILEGED;
use crate::methods::on_policy::{Batch, Gradient, LossSettings};
use crate::methods::parameters::Block;

/// Added to the score of a module that is not heard.
const UNHEARD: f32 = -1e9;

/// Rows of `columns` numbers with those of padding behind each sample's own: zeros.
fn padded(batch: &Batch, rows: &[f32], columns: usize) -> Vec<f32> {
    let longest = longest(batch);
    let mut out = vec![0.0; batch.samples() * longest * columns];
    let mut first = 0;
    for (out, modules) in out.chunks_exact_mut((longest * columns).max(1)).zip(&batch.modules) {
        out[..modules * columns].copy_from_slice(&rows[first * columns..(first + modules) * columns]);
        first += modules;
    }
    out
}

/// Modules of the longest sample.
fn longest(batch: &Batch) -> usize {
    batch.modules.iter().copied().max().unwrap_or(0)
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

/// Embedding and memory side by side: the samples of a batch one after the other, each with what the one before it remembered or with what was kept.
fn remembering(embedding: Tensor<2>, batch: &Batch, device: &Device) -> Tensor<2> {
    let modules = longest(batch);
    let kept = Tensor::<2>::from_data(
        TensorData::new(padded(batch, &batch.memory, MEMORY), [batch.samples() * modules, MEMORY]),
        device,
    );
    let leaks = Tensor::<2>::from_data(TensorData::new(LEAKS.to_vec(), [1, MEMORY]), device);
    let mut memories: Vec<Tensor<2>> = Vec::new();
    for (sample, follows) in batch.follows.iter().enumerate() {
        let rows = sample * modules..(sample + 1) * modules;
        let before = match memories.last() {
            Some(last) if *follows => last.clone(),
            _ => kept.clone().slice([rows.clone(), 0..MEMORY]),
        };
        let e = embedding.clone().slice([rows, 0..MEMORY]);
        memories.push(before.clone() + (e - before) * leaks.clone());
    }
    Tensor::cat(vec![embedding, Tensor::cat(memories, 0)], 1)
}

impl ActorLayout {
    /// Means of the actions, `[samples * modules, outputs]`.
    fn forward(&self, p: &[Option<Tensor<2>>; 10], batch: &Batch, device: &Device) -> Tensor<2> {
        let [
            encoder,
            encoder_bias,
            attention,
            hidden,
            hidden_context,
            hidden_bias,
            output,
            output_bias,
            _,
            distance_bias,
        ] = p;
        let [Some(encoder), Some(encoder_bias), Some(hidden), Some(hidden_bias), Some(output), Some(output_bias)] =
            [encoder, encoder_bias, hidden, hidden_bias, output, output_bias].map(Clone::clone)
        else {
            unreachable!("only the blocks of attention may be empty");
        };
        let (samples, modules) = (batch.samples(), longest(batch));
        let rows = samples * modules;
        let observations = padded(batch, &batch.observations, self.inputs());
        let x = Tensor::<2>::from_data(TensorData::new(observations, [rows, self.inputs()]), device);
        let mut e = bias_tanh(x.matmul(encoder.transpose()), encoder_bias);
        if self.memory() > 0 {
            e = remembering(e, batch, device);
        }
        let mut h = e.clone().matmul(hidden.transpose());
        if let (Some(attention), Some(hidden_context)) = (attention.clone(), hidden_context.clone()) {
            let qkv = e.matmul(attention.transpose()).reshape([samples, modules, 2 * KEY + VALUE]);
            let q = qkv.clone().slice([0..samples, 0..modules, 0..KEY]);
            let k = qkv.clone().slice([0..samples, 0..modules, KEY..2 * KEY]);
            let v = qkv.slice([0..samples, 0..modules, 2 * KEY..2 * KEY + VALUE]);
            // Padding is heard by nobody, because no mask has its bit, and hears everybody: its attention must not divide by zero.
            let mut mask = vec![0.0f32; rows * modules];
            let mut heard = batch.heard.iter();
            for (mask, present) in mask.chunks_exact_mut(modules * modules).zip(&batch.modules) {
                for (mask, heard) in mask.chunks_exact_mut(modules).zip(heard.by_ref().take(*present)) {
                    for (other, mask) in mask.iter_mut().enumerate() {
                        *mask = if heard >> other & 1 == 0 { UNHEARD } else { 0.0 };
                    }
                }
            }
            let mask = Tensor::<3>::from_data(TensorData::new(mask, [samples, modules, modules]), device);
            let mut scores = q.matmul(k.swap_dims(1, 2)) * (KEY as f32).sqrt().recip() + mask;
            if let Some(bias) = distance_bias.clone() {
                let of = |from| (0..modules).map(move |to| distance_bucket(from, to) as i32);
                let buckets: Vec<i32> = (0..modules).flat_map(of).collect();
                let buckets = Tensor::<1, Int>::from_data(TensorData::new(buckets, [modules * modules]), device);
                scores = scores + bias.select(1, buckets).reshape([1, modules, modules]);
            }
            let context = softmax(scores, 2).matmul(v).reshape([rows, VALUE]);
            h = h + context.matmul(hidden_context.transpose());
        }
        bias_tanh(h, hidden_bias).matmul(output.transpose()) + output_bias
    }

    /// PPO's clipped loss over a batch, and its gradient, by automatic differentiation.
    pub fn autodiff(&self, parameters: &[f32], batch: &Batch, loss: LossSettings) -> Gradient {
        let device = Device::flex().autodiff();
        let modules = longest(batch);
        let rows = batch.samples() * modules;
        let tensors = tensors(parameters, self.blocks(), &device);
        let mean = self.forward(&tensors, batch, &device);
        let column =
            |data: Vec<f32>, columns: usize| Tensor::<2>::from_data(TensorData::new(data, [rows, columns]), &device);
        let Some(log_sigma) = tensors[8].clone() else { unreachable!("log sigma is never empty") };
        let actions = column(padded(batch, &batch.actions, self.outputs()), self.outputs());
        let mut advantages: Vec<f32> = batch.advantages.iter().flat_map(|a| std::iter::repeat_n(*a, modules)).collect();
        if !batch.own.is_empty() {
            advantages.iter_mut().zip(padded(batch, &batch.own, 1)).for_each(|(advantage, own)| *advantage += own);
        }
        let advantages = column(advantages, 1);
        // Padding weighs nothing.
        let row_weights = padded(batch, &batch.weights, 1);
        let weights = column(row_weights.clone(), 1);
        // Constants of the density cancel in the ratio, but log sigma does not: it is being learnt.
        let constant = self.outputs() as f32 * LOG_DENSITY_CONSTANT;
        let offset = padded(batch, &batch.log_probabilities, 1).iter().map(|l| l + constant).collect();
        let distance = (actions - mean) * log_sigma.clone().neg().exp();
        let log_ratio = (distance.clone() * distance).sum_dim(1) * -0.5 - log_sigma.sum_dim(1) - column(offset, 1);
        let ratio = log_ratio.clone().exp();
        let gain = ratio.clone() * advantages.clone();
        let clipped = ratio.clone().clamp(1.0 - loss.clip, 1.0 + loss.clip) * advantages;
        let total = (gain.min_pair(clipped) * weights).sum().neg();
        let log_ratio = floats(log_ratio.inner());
        let gradient = collect(&total, tensors, self.blocks(), self.len);
        let mut result =
            Gradient { gradient, policy_loss: f64::from(total.into_scalar::<f32>()), ..Gradient::default() };
        for (log_ratio, weight) in log_ratio.iter().zip(&row_weights).filter(|(_, weight)| **weight > 0.0) {
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
        let (samples, modules) = (batch.samples(), longest(batch));
        let rows = samples * modules;
        let part = |numbers: &[f32], columns| {
            Tensor::<2>::from_data(TensorData::new(padded(batch, numbers, columns), [rows, columns]), device)
        };
        let x = Tensor::cat(
            vec![part(&batch.observations, self.first.columns - PRIVILEGED), part(&batch.privileged, PRIVILEGED)],
            1,
        );
        let h = bias_tanh(x.matmul(first.transpose()), first_bias);
        let h = bias_tanh(h.matmul(second.transpose()), second_bias).reshape([samples, modules, EMBED]);
        // Row 0 takes the mean over the modules that are there, row 1 the head.
        let mut pool = vec![0.0f32; 2 * rows];
        for (pool, present) in pool.chunks_exact_mut(2 * modules).zip(&batch.modules) {
            pool[..*present].fill(1.0 / *present as f32);
            pool[modules] = 1.0;
        }
        let pool = Tensor::<3>::from_data(TensorData::new(pool, [samples, 2, modules]), device);
        let pooled = pool.matmul(h).reshape([samples, 2 * EMBED]);
        let h = bias_tanh(pooled.matmul(team.transpose()), team_bias);
        h.matmul(value.transpose()) + value_bias
    }

    /// Half the squared error over a batch times `weight`, and its gradient, by automatic differentiation.
    pub fn autodiff(&self, parameters: &[f32], batch: &Batch, weight: f32) -> Gradient {
        let device = Device::flex().autodiff();
        let tensors = tensors(parameters, self.blocks(), &device);
        let targets = Tensor::<2>::from_data(TensorData::new(batch.targets.clone(), [batch.samples(), 1]), &device);
        let error = self.forward(&tensors, batch, &device) - targets;
        let loss = (error.clone() * error).sum() * (0.5 * weight);
        let gradient = collect(&loss, tensors, self.blocks(), self.len);
        Gradient { gradient, value_loss: f64::from(loss.into_scalar::<f32>()), ..Gradient::default() }
    }
}
