//! A trained network of COMPOSER in 32-bit floats: what evaluation runs and what freezing is measured by. The forward pass is that of the
//! training ([`Actor`]).

use composer_shared::observation::Observation;
use composer_shared::policy::{CLIP, MEMORY, OUT};
use composer_shared::robot::MAX_MODULES;

use super::actor::{Actor, ActorLayout, ActorScratch, LATENT, Remembered, Shape};
use crate::environment::{View, with_itself};
use crate::network::Network;
use crate::policy::{Memories, Policy, still};

/// A network, ready to run.
#[derive(Clone, Debug)]
pub struct FloatPolicy {
    actor: Actor,
    attention: bool,
    mean: Vec<f32>,
    std: Vec<f32>,
}

impl FloatPolicy {
    /// Of this network, which has been checked.
    pub fn new(network: &Network) -> Self {
        let layout = ActorLayout::new(Shape::of(network));
        let actor = Actor::new(layout, &layout.parameters(network));
        Self { actor, attention: network.attention, mean: network.mean.clone(), std: network.std.clone() }
    }

    /// Normalised observations, one after the other; what is no number is 0.
    fn normalised(&self, observations: &[Observation]) -> Vec<f32> {
        let of = |((x, mean), std): ((&f32, &f32), &f32)| {
            let z = (x - mean) / std;
            if z.is_nan() { 0.0 } else { z.clamp(-CLIP, CLIP) }
        };
        observations.iter().flat_map(|observation| observation.iter().zip(&self.mean).zip(&self.std).map(of)).collect()
    }

    /// The layers for some observations of teams of so many modules, with what their modules remember, which goes on by a step.
    fn pass<'a>(
        &self,
        memories: &mut [[f32; MEMORY]],
        observations: &[Observation],
        heard: &[u64],
        modules: &[usize],
        scratch: &'a mut ActorScratch,
    ) -> &'a ActorScratch {
        let follows = vec![false; modules.len()];
        let remembered = match self.actor.layout().memory() {
            0 => Remembered::default(),
            _ => Remembered { before: memories.as_flattened(), follows: &follows },
        };
        self.actor.means(&self.normalised(observations), heard, modules, remembered, scratch);
        if self.actor.layout().memory() > 0 {
            scratch.remembered(memories.as_flattened_mut());
        }
        scratch
    }

    /// The actions of all modules of one robot, yaw and pitch torque as a fraction of the limit, each within -1 to 1.
    ///
    /// `memories` has one a module, which goes on by a step: zeros at the start of an episode. `heard[i]` bit `j`: module `i` has the
    /// message of module `j`; its own bit is implied, bits beyond the last module are ignored. `attention` receives the weights, row `i` for
    /// module `i`, row-major n x n; without attention each module has all of its own.
    ///
    /// # Panics
    /// If there are more than 64 modules, or if the slices' lengths differ.
    pub fn act(
        &self,
        memories: &mut [[f32; MEMORY]],
        observations: &[Observation],
        heard: &[u64],
        actions: &mut [[f32; OUT]],
        attention: Option<&mut [f32]>,
    ) {
        let n = observations.len();
        assert!(n <= MAX_MODULES, "{n} modules, at most {MAX_MODULES} are possible");
        assert!(heard.len() == n && actions.len() == n, "one mask and one action for each of {n} modules");
        assert_eq!(memories.len(), n, "one memory for each module");
        let heard: Vec<u64> = with_itself(heard).collect();
        let mut scratch = ActorScratch::default();
        let scratch = self.pass(memories, observations, &heard, &[n], &mut scratch);
        for (action, mean) in actions.iter_mut().zip(scratch.means.as_chunks::<OUT>().0) {
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

    /// What its outputs are for one robot, unclipped, `[module][outputs]`, without a memory.
    pub fn means(&self, view: &View) -> Vec<f32> {
        let heard: Vec<u64> = with_itself(&view.heard).collect();
        let (n, mut scratch) = (heard.len(), ActorScratch::default());
        self.pass(&mut vec![[0.0; MEMORY]; n], &view.observations, &heard, &[n], &mut scratch);
        scratch.means.truncate(n * self.actor.layout().outputs());
        scratch.means
    }

    /// Query, key and value of every module, side by side, a step after these memories; nothing without attention.
    pub fn latents(&self, memories: &mut [[f32; MEMORY]], observations: &[Observation]) -> Vec<[f32; LATENT]> {
        if !self.attention {
            return Vec::new();
        }
        let mut scratch = ActorScratch::default();
        let n = observations.len();
        // Whom they hear does not matter to what they say.
        let scratch = self.pass(memories, observations, &vec![u64::MAX; n], &vec![1; n], &mut scratch);
        scratch.latent.as_chunks::<LATENT>().0[..n].to_vec()
    }
}

impl Policy for FloatPolicy {
    fn act(
        &self,
        view: &View,
        _noise: u64,
        memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        attention: Option<&mut Vec<f32>>,
    ) {
        let modules = view.observations.len();
        memories.follow(view);
        still(view, actions);
        let attention = attention.map(|weights| {
            weights.clear();
            weights.resize(modules * modules, 0.0);
            weights.as_mut_slice()
        });
        FloatPolicy::act(self, &mut memories.float, &view.observations, &view.heard, actions, attention);
    }
}

#[cfg(test)]
mod tests {
    use composer_shared::observation::{BASE, SIZE};
    use composer_shared::policy::{VALUE, distance_bucket};

    use super::*;
    use crate::network::Dense;
    use crate::network::testing::{observations, random_network, random_network_of};

    /// The equations, written down naively in double precision.
    fn reference(
        network: &Network,
        memories: &mut [[f64; MEMORY]],
        observations: &[Observation],
        heard: &[u64],
    ) -> (Vec<[f64; OUT]>, Vec<f64>) {
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
            .zip(memories)
            .map(|(o, memory)| {
                let z: Vec<f64> = (0..network.inputs)
                    .map(|i| (f64::from(o[i] - network.mean[i]) / f64::from(network.std[i])).clamp(-5.0, 5.0))
                    .collect();
                let mut features = tanh(dense(&network.encoder, &z));
                if network.memory > 0 {
                    for c in 0..MEMORY {
                        memory[c] += if c < 8 { 0.25 } else { 0.0625 } * (features[c] - memory[c]);
                    }
                    features.extend_from_slice(memory);
                }
                features
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
                    let bias = network.distance_bias.get(distance_bucket(i, j)).map_or(0.0, |b| f64::from(*b));
                    if j == i || heard[i] >> j & 1 == 1 {
                        terms[j] = (q.iter().zip(&k).map(|(q, k)| q * k).sum::<f64>() / 4.0 + bias).exp();
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
            for (attention, inputs, memory) in
                [(true, BASE, 0), (false, BASE, 0), (true, SIZE, MEMORY), (false, SIZE, MEMORY)]
            {
                let network = random_network_of(seed as u64, attention, inputs, memory);
                network.check().unwrap();
                let heard: Vec<u64> = (0..n as u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15)).collect();
                let (mut actions, mut weights) = (vec![[0.0; 2]; n], vec![0.0; n * n]);
                let (mut memories, mut expected_memories) = (vec![[0.0; MEMORY]; n], vec![[0.0; MEMORY]; n]);
                for step in 0..5 {
                    let o = observations(seed as u64 + 1000 * step, n);
                    FloatPolicy::new(&network).act(&mut memories, &o, &heard, &mut actions, Some(&mut weights));
                    let (expected, expected_weights) = reference(&network, &mut expected_memories, &o, &heard);
                    for (a, e) in actions.as_flattened().iter().zip(expected.as_flattened()) {
                        worst = worst.max((f64::from(*a) - e).abs());
                    }
                    for (a, e) in weights.iter().zip(&expected_weights) {
                        worst = worst.max((f64::from(*a) - e).abs());
                    }
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
        let mut memories = [[0.0; MEMORY]; 13];
        let together = policy.latents(&mut memories, &o);
        for (i, latent) in together.iter().enumerate() {
            assert_eq!(policy.latents(&mut memories[..1], &o[i..=i])[0], *latent);
        }
        let (mut alone, mut masked) = ([[0.0; 2]; 1], vec![[0.0; 2]; 13]);
        policy.act(&mut memories[..1], &o[..1], &[0], &mut alone, None);
        policy.act(&mut memories, &o, &[0; 13], &mut masked, None);
        // A query of a module alone has one key to choose from, as one that hears nobody has.
        assert!(alone[0].iter().zip(masked[0]).all(|(a, m)| (a - m).abs() < 1e-6));
        let mut broken = o.clone();
        broken[2][5] = f32::NAN;
        policy.act(&mut memories, &broken, &[0; 13], &mut masked, None);
        assert!(masked.as_flattened().iter().all(|a| a.is_finite()));
    }

    #[test]
    fn parameters_and_network_are_the_same_numbers() {
        for (attention, inputs, memory) in
            [(true, BASE, 0), (false, BASE, 0), (true, SIZE, MEMORY), (false, BASE, MEMORY)]
        {
            let mut network = random_network_of(5, attention, inputs, memory);
            if !attention {
                // Of no use to it.
                network.distance_bias.clear();
                for layer in [&mut network.query, &mut network.key, &mut network.value] {
                    layer.weights.fill(0.0);
                }
            }
            let layout = ActorLayout::new(Shape::of(&network));
            let parameters = layout.parameters(&network);
            assert_eq!(layout.network(&parameters, &network.mean, &network.std), network);
        }
    }
}
