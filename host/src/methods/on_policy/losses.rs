//! The clipped losses of PPO and its relatives on tensors. Rows of modules that do not act weigh nothing.

use burn::tensor::Tensor;

use super::{Batch, Ratio, Valued};
use crate::methods::tensors::floats;

/// ln(2 pi) / 2.
pub(super) const LOG_ROOT_TAU: f32 = 0.918_938_5;

/// The loss of the values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValueLoss {
    /// Its weight beside the policy's; of no effect where the critic has an optimiser of its own and its norm is not clipped.
    pub coefficient: f32,
    /// Huber's: beyond this error the loss is linear. Else it is the square.
    pub huber: Option<f32>,
}

/// Logarithm of the density of each action, `[rows, outputs]`, under normals of `mean` and standard deviation `sigma`, `[rows or 1, outputs]`.
pub fn log_density(actions: Tensor<2>, mean: Tensor<2>, sigma: Tensor<2>) -> Tensor<2> {
    let distance = (actions - mean) / sigma.clone();
    distance.clone() * distance * -0.5 - sigma.log() - LOG_ROOT_TAU
}

/// Entropy of each action of normals, in the shape of `sigma`.
pub fn entropy(sigma: Tensor<2>) -> Tensor<2> {
    sigma.log() + (0.5 + LOG_ROOT_TAU)
}

/// A number of each row, once for each.
pub fn per_row(numbers: &[f32], modules: usize, of: Valued) -> Vec<f32> {
    match of {
        Valued::Module => numbers.to_vec(),
        Valued::Team => numbers.iter().flat_map(|x| std::iter::repeat_n(*x, modules)).collect(),
    }
}

/// What the clipped loss of a batch comes to.
pub struct PolicyLoss {
    /// The loss.
    pub loss: Tensor<1>,
    /// Weighted estimate of the KL divergence from the old policy.
    pub kl: f64,
    /// Weighted share of clipped ratios.
    pub clipped: f64,
    /// All ratios: `[rows, 1]`, `[rows, outputs]` or `[teams, 1]`.
    pub ratios: Vec<f32>,
}

/// The clipped loss of teams of `modules` modules: `log_probabilities` now, `[rows, outputs]`. `to_tensor` makes tensors beside them.
pub fn policy_loss(
    log_probabilities: Tensor<2>,
    batch: &Batch,
    modules: usize,
    (ratio, valued): (Ratio, Valued),
    clip: f32,
    team_weight: f32,
    to_tensor: impl Fn(&[f32], [usize; 2]) -> Tensor<2>,
) -> PolicyLoss {
    let [rows, outputs] = log_probabilities.dims();
    let teams = rows / modules;
    // The logarithm of the new ratio to the old density, and what each of its rows weighs.
    let (log_ratio, weights, advantages) = match ratio {
        Ratio::Dimension => {
            let old = to_tensor(&batch.log_probabilities, [rows, outputs]);
            (log_probabilities - old, batch.weights.clone(), per_row(&batch.advantages, modules, valued))
        }
        Ratio::Module => {
            let old = to_tensor(&batch.log_probabilities, [rows, 1]);
            let new = log_probabilities.sum_dim(1);
            (new - old, batch.weights.clone(), per_row(&batch.advantages, modules, valued))
        }
        Ratio::Team => {
            let acts: Vec<f32> = batch.weights.iter().map(|w| f32::from(u8::from(*w > 0.0))).collect();
            let old = to_tensor(&batch.log_probabilities, [rows, 1]);
            let each = (log_probabilities.sum_dim(1) - old) * to_tensor(&acts, [rows, 1]);
            let advantages = match valued {
                Valued::Team => batch.advantages.clone(),
                Valued::Module => batch
                    .advantages
                    .chunks_exact(modules)
                    .map(|team| team.iter().sum::<f32>() / modules as f32)
                    .collect(),
            };
            (each.reshape([teams, modules]).sum_dim(1), vec![team_weight; teams], advantages)
        }
    };
    let [rows, _] = log_ratio.dims();
    let ratios = log_ratio.clone().exp();
    let advantage = to_tensor(&advantages, [rows, 1]);
    let gain = ratios.clone() * advantage.clone();
    let held = ratios.clamp(1.0 - clip, 1.0 + clip) * advantage;
    let loss = (gain.min_pair(held).sum_dim(1) * to_tensor(&weights, [rows, 1])).sum().neg();
    let log_ratio = floats(log_ratio.inner());
    let width = log_ratio.len() / rows;
    let (mut kl, mut clipped) = (0.0, 0.0);
    for (row, weight) in log_ratio.chunks_exact(width).zip(&weights) {
        for log_ratio in row {
            let (log_ratio, weight) = (f64::from(*log_ratio), f64::from(*weight));
            let ratio = log_ratio.exp();
            kl += weight * (ratio - 1.0 - log_ratio);
            clipped += if (ratio - 1.0).abs() > f64::from(clip) { weight / width as f64 } else { 0.0 };
        }
    }
    PolicyLoss { loss, kl, clipped, ratios: log_ratio.iter().map(|l| l.exp()).collect() }
}

/// The loss of the values of a batch, without its coefficient: `values` now, `[teams or rows, 1]`. A value may leave the old one by `clip` at
/// most, and the worse of both counts.
pub fn value_loss(
    values: Tensor<2>,
    batch: &Batch,
    (huber, valued): (Option<f32>, Valued),
    clip: f32,
    team_weight: f32,
    to_tensor: impl Fn(&[f32], [usize; 2]) -> Tensor<2>,
) -> Tensor<1> {
    let [rows, _] = values.dims();
    let (old, target) = (to_tensor(&batch.values, [rows, 1]), to_tensor(&batch.targets, [rows, 1]));
    let weights = match valued {
        Valued::Module => batch.weights.clone(),
        Valued::Team => vec![team_weight; rows],
    };
    let of = |error: Tensor<2>| match huber {
        None => error.clone() * error * 0.5,
        Some(delta) => {
            // Half the square up to delta, then on with its slope there.
            let size = error.abs();
            let within = size.clone().clamp_max(delta);
            within.clone() * within.clone() * 0.5 + (size - within) * delta
        }
    };
    let held = old.clone() + (values.clone() - old).clamp(-clip, clip);
    let worse = of(values - target.clone()).max_pair(of(held - target));
    (worse * to_tensor(&weights, [rows, 1])).sum()
}
