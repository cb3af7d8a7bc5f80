//! A trained network of COMPOSER in 32-bit floats: what evaluation runs and what freezing is measured by. The forward pass is that of the
//! training ([`Actor`]).

use composer_shared::observation::{Observation, SIZE};
use composer_shared::policy::{CLIP, OUT};
use composer_shared::robot::MAX_MODULES;

use super::actor::{Actor, ActorLayout, ActorScratch, LATENT, Remembered, Shape};
use crate::environment::View;
use crate::network::Network;
use crate::policy::Policy;

/// A network, ready to run.
#[derive(Clone, Debug)]
pub struct FloatPolicy {
    actor: Actor,
    attention: bool,
    mean: [f32; SIZE],
    std: [f32; SIZE],
}

impl FloatPolicy {
    /// Of this network, which has been checked.
    pub fn new(network: &Network) -> Self {
        let layout = ActorLayout::new(Shape::of(network));
        let actor = Actor::new(layout, &layout.parameters(network));
        Self { actor, attention: network.attention, mean: network.mean, std: network.std }
    }

    /// Normalised observations, one after the other; what is no number is 0.
    fn normalised(&self, observations: &[Observation]) -> Vec<f32> {
        let of = |(i, x): (usize, &f32)| {
            let z = (x - self.mean[i]) / self.std[i];
            if z.is_nan() { 0.0 } else { z.clamp(-CLIP, CLIP) }
        };
        let inputs = self.actor.layout().inputs();
        observations.iter().flat_map(|observation| observation[..inputs].iter().enumerate().map(of)).collect()
    }

    /// The actions of all modules of one robot, yaw and pitch torque as a fraction of the limit, each within -1 to 1.
    ///
    /// `heard[i]` bit `j`: module `i` has the message of module `j`; its own bit is implied, bits beyond the last
    /// module are ignored. `attention` receives the weights, row `i` for module `i`, row-major n x n; without attention
    /// each module has all of its own.
    ///
    /// # Panics
    /// If there are more than 64 modules, or if the slices' lengths differ.
    pub fn act(
        &self,
        observations: &[Observation],
        heard: &[u64],
        actions: &mut [[f32; OUT]],
        attention: Option<&mut [f32]>,
    ) {
        let n = observations.len();
        assert!(n <= MAX_MODULES, "{n} modules, at most {MAX_MODULES} are possible");
        assert!(heard.len() == n && actions.len() == n, "one mask and one action for each of {n} modules");
        let heard: Vec<u64> = heard.iter().enumerate().map(|(module, heard)| heard | 1 << module).collect();
        let mut scratch = ActorScratch::default();
        let means = self.actor.means(&self.normalised(observations), &heard, &[n], Remembered::default(), &mut scratch);
        for (action, mean) in actions.iter_mut().zip(means.as_chunks::<OUT>().0) {
            *action = mean.map(|torque| torque.clamp(-1.0, 1.0));
        }
        if let Some(weights) = attention {
            assert_eq!(weights.len(), n * n, "attention weights are {n} x {n}");
            if self.attention {
                weights.copy_from_slice(&scratch.attention[..n * n]);
            } else {
                weights.iter_mut().enumerate().for_each(|(i, w)| *w = f32::from(u8::from(i % n == i / n)));
            }
        }
    }

    /// Query, key and value of every module, side by side; nothing without attention.
    pub fn latents(&self, observations: &[Observation]) -> Vec<[f32; LATENT]> {
        if !self.attention {
            return Vec::new();
        }
        let mut scratch = ActorScratch::default();
        let (n, normalised) = (observations.len(), self.normalised(observations));
        // Whom they hear does not matter to what they say.
        self.actor.means(&normalised, &vec![u64::MAX; n], &vec![1; n], Remembered::default(), &mut scratch);
        scratch.latent.as_chunks::<LATENT>().0[..n].to_vec()
    }
}

impl Policy for FloatPolicy {
    fn act(&self, view: &View, _noise: u64, actions: &mut Vec<[f32; 2]>, attention: Option<&mut Vec<f32>>) {
        let modules = view.observations.len();
        actions.clear();
        actions.resize(modules, [0.0; 2]);
        let attention = attention.map(|weights| {
            weights.clear();
            weights.resize(modules * modules, 0.0);
            weights.as_mut_slice()
        });
        FloatPolicy::act(self, &view.observations, &view.heard, actions, attention);
    }
}

#[cfg(test)]
mod tests {
    use composer_shared::policy::VALUE;

    use super::*;
    use crate::network::Dense;
    use crate::network::testing::{observations, random_network};

    /// The equations, written down naively in double precision.
    fn reference(network: &Network, observations: &[Observation], heard: &[u64]) -> (Vec<[f64; OUT]>, Vec<f64>) {
        let dense = |dense: &Dense, x: &[f64]| -> Vec<f64> {
            let rows = dense.weights.chunks(dense.inputs).enumerate();
            rows.map(|(o, row)| {
                let sum: f64 = row.iter().zip(x).map(|(w, x)| f64::from(*w) * x).sum();
                sum + f64::from(dense.bias.get(o).copied().unwrap_or(0.0))
            })
            .collect()
        };
        let tanh = |x: Vec<f64>| x.into_iter().map(f64::tanh).collect::<Vec<_>>();
        let n = observations.len();
        let embeddings: Vec<Vec<f64>> = observations
            .iter()
            .map(|o| {
                let z: Vec<f64> = (0..SIZE)
                    .map(|i| (f64::from(o[i] - network.mean[i]) / f64::from(network.std[i])).clamp(-5.0, 5.0))
                    .collect();
                tanh(dense(&network.encoder, &z))
            })
            .collect();
        let (mut actions, mut attention) = (vec![], vec![0.0; n * n]);
        for i in 0..n {
            let mut input = embeddings[i].clone();
            let mut context = vec![0.0; VALUE];
            if network.attention {
                let q = dense(&network.query, &embeddings[i]);
                let mut terms = vec![0.0; n];
                for j in 0..n {
                    let k = dense(&network.key, &embeddings[j]);
                    if j == i || heard[i] >> j & 1 == 1 {
                        terms[j] = (q.iter().zip(&k).map(|(q, k)| q * k).sum::<f64>() / 4.0).exp();
                    }
                }
                let total: f64 = terms.iter().sum();
                for j in 0..n {
                    attention[i * n + j] = terms[j] / total;
                    let v = dense(&network.value, &embeddings[j]);
                    context.iter_mut().zip(v).for_each(|(c, v)| *c += terms[j] / total * v);
                }
            } else {
                attention[i * n + i] = 1.0;
            }
            input.extend(context);
            let a = dense(&network.output, &tanh(dense(&network.hidden, &input)));
            actions.push([a[0].clamp(-1.0, 1.0), a[1].clamp(-1.0, 1.0)]);
        }
        (actions, attention)
    }

    #[test]
    fn it_agrees_with_the_equations_for_any_number_of_modules() {
        let mut worst = 0.0f64;
        for (seed, n) in [1, 2, 4, 5, 8, 9, 11, 13, 16, 64].into_iter().enumerate() {
            for attention in [true, false] {
                let network = random_network(seed as u64, attention);
                network.check().unwrap();
                let o = observations(seed as u64, n);
                let heard: Vec<u64> = (0..n as u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15)).collect();
                let (mut actions, mut weights) = (vec![[0.0; 2]; n], vec![0.0; n * n]);
                FloatPolicy::new(&network).act(&o, &heard, &mut actions, Some(&mut weights));
                let (expected, expected_weights) = reference(&network, &o, &heard);
                for (a, e) in actions.as_flattened().iter().zip(expected.as_flattened()) {
                    worst = worst.max((f64::from(*a) - e).abs());
                }
                for (a, e) in weights.iter().zip(&expected_weights) {
                    worst = worst.max((f64::from(*a) - e).abs());
                }
            }
        }
        println!("largest difference from the equations: {worst:.1e}");
        assert!(worst < 2e-5, "{worst}");
    }

    #[test]
    fn what_a_module_computes_alone_does_not_depend_on_the_others() {
        let policy = FloatPolicy::new(&random_network(3, true));
        let o = observations(3, 13);
        let together = policy.latents(&o);
        for (i, latent) in together.iter().enumerate() {
            assert_eq!(policy.latents(&o[i..=i])[0], *latent);
        }
        let (mut alone, mut masked) = ([[0.0; 2]; 1], vec![[0.0; 2]; 13]);
        policy.act(&o[..1], &[0], &mut alone, None);
        policy.act(&o, &[0; 13], &mut masked, None);
        // A query of a module alone has one key to choose from, as one that hears nobody has.
        assert!(alone[0].iter().zip(masked[0]).all(|(a, m)| (a - m).abs() < 1e-6));
        let mut broken = o.clone();
        broken[2][5] = f32::NAN;
        policy.act(&broken, &[0; 13], &mut masked, None);
        assert!(masked.as_flattened().iter().all(|a| a.is_finite()));
    }

    #[test]
    fn parameters_and_network_are_the_same_numbers() {
        for attention in [true, false] {
            let network = random_network(5, attention);
            let layout = ActorLayout::new(Shape::of(&network));
            let parameters = layout.parameters(&network);
            let back = layout.network(&parameters, network.mean, network.std);
            assert_eq!((back.encoder, back.hidden, back.output), (network.encoder, network.hidden, network.output));
            if attention {
                assert_eq!((back.query, back.key, back.value), (network.query, network.key, network.value));
            }
        }
    }
}
