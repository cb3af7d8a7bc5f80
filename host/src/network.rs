//! The policy network in floating point: what training hands over, what evaluation runs, what [`crate::freeze`] turns
//! into integers.
//!
//! Plain loops over several modules at once, which the compiler vectorises; no external mathematics, so the same inputs
//! give the same bits on every machine. What a module computes alone (embedding, key, value) does not depend on how
//! many others there are.

use composer_shared::observation::{Observation, SIZE};
use composer_shared::policy::{CLIP, EMBED, HIDDEN, HIDDEN_IN, KEY, OBS, OUT, VALUE};
use composer_shared::robot::MAX_MODULES;
use serde::{Deserialize, Serialize};

/// A fully connected layer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Dense {
    /// Numbers that go in.
    pub inputs: usize,
    /// Numbers that come out.
    pub outputs: usize,
    /// Row-major, `[outputs][inputs]`.
    pub weights: Vec<f32>,
    /// One per output, or empty for a layer without.
    pub bias: Vec<f32>,
}

/// The network of one policy; all modules share it. `composer_shared::policy` has its equations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Network {
    /// Whether the hidden layer sees the attention's context; if not, its last [`VALUE`] columns are zero.
    pub attention: bool,
    /// Mean of each field of the observation.
    #[serde(with = "serde_big_array::BigArray")]
    pub mean: [f32; SIZE],
    /// Standard deviation of each field of the observation, positive.
    #[serde(with = "serde_big_array::BigArray")]
    pub std: [f32; SIZE],
    /// Observation to embedding.
    pub encoder: Dense,
    /// Embedding to query, no bias.
    pub query: Dense,
    /// Embedding to key, no bias.
    pub key: Dense,
    /// Embedding to value, no bias.
    pub value: Dense,
    /// Embedding and context to hidden.
    pub hidden: Dense,
    /// Hidden to action.
    pub output: Dense,
}

/// Why a network cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NetworkError {
    /// A layer has other dimensions than the layout has.
    #[error("{layer} layer: {found}, where {wanted} was expected")]
    Shape {
        /// Which layer.
        layer: &'static str,
        /// What it has.
        found: String,
        /// What it should have.
        wanted: String,
    },
    /// A number is infinite or not a number.
    #[error("{what} of the network contains {value}: training has diverged, use an earlier checkpoint")]
    NotFinite {
        /// Where.
        what: String,
        /// The first such number.
        value: f32,
    },
    /// A standard deviation is zero or negative.
    #[error("the standard deviation of observation field {field} is {value}, it must be positive")]
    Deviation {
        /// Name of the field.
        field: &'static str,
        /// The deviation.
        value: f32,
    },
}

/// What a module computes from its own observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoded {
    /// Embedding e.
    pub embedding: [f32; EMBED],
    /// Query q.
    pub query: [f32; KEY],
    /// Key k.
    pub key: [f32; KEY],
    /// Value v.
    pub value: [f32; VALUE],
}

impl Encoded {
    const ZERO: Encoded = Encoded { embedding: [0.0; EMBED], query: [0.0; KEY], key: [0.0; KEY], value: [0.0; VALUE] };
}

/// Modules that the widest kernel works on at once.
const LANES: usize = 8;

impl Dense {
    /// A layer of zeros.
    pub fn zeros(inputs: usize, outputs: usize, bias: bool) -> Self {
        Dense { inputs, outputs, weights: vec![0.0; inputs * outputs], bias: vec![0.0; if bias { outputs } else { 0 }] }
    }

    /// `weights * input + bias` for `L` modules side by side. Every module's sum is added up in the order of the
    /// inputs.
    fn forward<const L: usize, const IN: usize, const OUT: usize>(&self, input: &[[f32; L]; IN]) -> [[f32; L]; OUT] {
        const ROWS: usize = 4;
        let mut out = [[0.0; L]; OUT];
        let (rows, _) = self.weights.as_chunks::<IN>();
        let (blocks, rest) = rows.as_chunks::<ROWS>();
        let (out_blocks, out_rest) = out.as_chunks_mut::<ROWS>();
        for (block, out) in blocks.iter().zip(out_blocks) {
            let mut sums = [[0.0; L]; ROWS];
            for (i, x) in input.iter().enumerate() {
                for (sum, row) in sums.iter_mut().zip(block) {
                    for (sum, x) in sum.iter_mut().zip(x) {
                        *sum += row[i] * x;
                    }
                }
            }
            *out = sums;
        }
        for (row, sum) in rest.iter().zip(out_rest) {
            for (weight, x) in row.iter().zip(input) {
                for (sum, x) in sum.iter_mut().zip(x) {
                    *sum += weight * x;
                }
            }
        }
        for (out, bias) in out.iter_mut().zip(&self.bias) {
            out.iter_mut().for_each(|out| *out += bias);
        }
        out
    }
}

impl Network {
    /// A network of zeros that does not normalise its observations.
    pub fn zeros(attention: bool) -> Self {
        Network {
            attention,
            mean: [0.0; SIZE],
            std: [1.0; SIZE],
            encoder: Dense::zeros(OBS, EMBED, true),
            query: Dense::zeros(EMBED, KEY, false),
            key: Dense::zeros(EMBED, KEY, false),
            value: Dense::zeros(EMBED, VALUE, false),
            hidden: Dense::zeros(HIDDEN_IN, HIDDEN, true),
            output: Dense::zeros(HIDDEN, OUT, true),
        }
    }

    /// All layers with their names.
    pub fn layers(&self) -> [(&'static str, &Dense); 6] {
        [
            ("encoder", &self.encoder),
            ("query", &self.query),
            ("key", &self.key),
            ("value", &self.value),
            ("hidden", &self.hidden),
            ("output", &self.output),
        ]
    }

    /// Whether all dimensions are those of the layout and all numbers finite.
    pub fn check(&self) -> Result<(), NetworkError> {
        let shape = |dense: &Dense| (dense.inputs, dense.outputs, dense.weights.len(), dense.bias.len());
        for ((name, dense), (_, wanted)) in self.layers().into_iter().zip(Network::zeros(self.attention).layers()) {
            let (found, wanted) = (shape(dense), shape(wanted));
            if found != wanted {
                let say = |(inputs, outputs, weights, biases): (usize, usize, usize, usize)| {
                    format!("{inputs} inputs, {outputs} outputs, {weights} weights and {biases} biases")
                };
                return Err(NetworkError::Shape { layer: name, found: say(found), wanted: say(wanted) });
            }
            finite(dense.weights.iter().chain(&dense.bias), || format!("the {name} layer"))?;
        }
        finite(self.mean.iter().chain(&self.std), || "the observation statistics".into())?;
        match self.std.iter().zip(composer_shared::observation::NAMES).find(|(std, _)| **std <= 0.0) {
            Some((&value, field)) => Err(NetworkError::Deviation { field, value }),
            None => Ok(()),
        }
    }

    /// What each module computes from its own observation. Without attention query, key and value are zero.
    pub fn encode(&self, observations: &[Observation]) -> Vec<Encoded> {
        let mut encoded = vec![Encoded::ZERO; observations.len()];
        let mut rest = observations;
        let mut to = &mut encoded[..];
        while !rest.is_empty() {
            let count = rest.len().min(LANES);
            let (now, later) = rest.split_at(count);
            let (to_now, to_later) = to.split_at_mut(count);
            if count <= LANES / 2 {
                self.encode_lanes::<{ LANES / 2 }>(now, to_now);
            } else {
                self.encode_lanes::<LANES>(now, to_now);
            }
            (rest, to) = (later, to_later);
        }
        encoded
    }

    fn encode_lanes<const L: usize>(&self, observations: &[Observation], encoded: &mut [Encoded]) {
        let mut input = [[0.0; L]; OBS];
        for (lane, observation) in observations.iter().enumerate() {
            for (i, x) in observation.iter().enumerate() {
                let z = (x - self.mean[i]) / self.std[i];
                input[i][lane] = if z.is_nan() { 0.0 } else { z.clamp(-CLIP, CLIP) };
            }
        }
        let mut embedding: [[f32; L]; EMBED] = self.encoder.forward(&input);
        embedding.as_flattened_mut().iter_mut().for_each(|x| *x = tanh(*x));
        scatter(&embedding, encoded, |to| &mut to.embedding);
        if self.attention {
            scatter::<L, KEY>(&self.query.forward(&embedding), encoded, |to| &mut to.query);
            scatter::<L, KEY>(&self.key.forward(&embedding), encoded, |to| &mut to.key);
            scatter::<L, VALUE>(&self.value.forward(&embedding), encoded, |to| &mut to.value);
        }
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
        self.act_encoded(&self.encode(observations), heard, actions, attention);
    }

    /// [`Network::act`] from what [`Network::encode`] gave.
    ///
    /// # Panics
    /// As [`Network::act`].
    pub fn act_encoded(
        &self,
        encoded: &[Encoded],
        heard: &[u64],
        actions: &mut [[f32; OUT]],
        mut attention: Option<&mut [f32]>,
    ) {
        let n = encoded.len();
        assert!(n <= MAX_MODULES, "{n} modules, at most {MAX_MODULES} are possible");
        assert!(heard.len() == n && actions.len() == n, "one mask and one action for each of {n} modules");
        if let Some(weights) = &attention {
            assert_eq!(weights.len(), n * n, "attention weights are {n} x {n}");
        }
        let mut at = 0;
        while at < n {
            let count = (n - at).min(LANES);
            if count <= LANES / 2 {
                self.act_lanes::<{ LANES / 2 }>(encoded, heard, at, &mut actions[at..at + count], &mut attention);
            } else {
                self.act_lanes::<LANES>(encoded, heard, at, &mut actions[at..at + count], &mut attention);
            }
            at += count;
        }
    }

    fn act_lanes<const L: usize>(
        &self,
        encoded: &[Encoded],
        heard: &[u64],
        first: usize,
        actions: &mut [[f32; OUT]],
        attention: &mut Option<&mut [f32]>,
    ) {
        let n = encoded.len();
        let mut input = [[0.0; L]; HIDDEN_IN];
        for lane in 0..actions.len() {
            let own = first + lane;
            for (x, e) in input.iter_mut().zip(&encoded[own].embedding) {
                x[lane] = *e;
            }
            let mut weights = [0.0; MAX_MODULES];
            if self.attention {
                let context = attend(encoded, own, heard[own] | 1 << own, &mut weights);
                for (x, c) in input[EMBED..].iter_mut().zip(context) {
                    x[lane] = c;
                }
            } else {
                weights[own] = 1.0;
            }
            if let Some(attention) = attention {
                attention[own * n..(own + 1) * n].copy_from_slice(&weights[..n]);
            }
        }
        let mut hidden: [[f32; L]; HIDDEN] = self.hidden.forward(&input);
        hidden.as_flattened_mut().iter_mut().for_each(|x| *x = tanh(*x));
        let out: [[f32; L]; OUT] = self.output.forward(&hidden);
        for (lane, action) in actions.iter_mut().enumerate() {
            for (action, out) in action.iter_mut().zip(&out) {
                *action = out[lane].clamp(-1.0, 1.0);
            }
        }
    }
}

/// The context of module `own` and, in `weights`, whom it attends to.
fn attend(encoded: &[Encoded], own: usize, mask: u64, weights: &mut [f32; MAX_MODULES]) -> [f32; VALUE] {
    let present = |j: usize| mask >> j & 1 == 1;
    let query = &encoded[own].query;
    let mut largest = f32::NEG_INFINITY;
    for (j, (weight, other)) in weights.iter_mut().zip(encoded).enumerate() {
        if present(j) {
            // Four partial sums, which the processor can work on at once.
            let mut sums = [0.0f32; 4];
            for (q, k) in query.as_chunks::<4>().0.iter().zip(other.key.as_chunks::<4>().0) {
                for (sum, (q, k)) in sums.iter_mut().zip(q.iter().zip(k)) {
                    *sum += q * k;
                }
            }
            *weight = ((sums[0] + sums[1]) + (sums[2] + sums[3])) * const { 1.0 / 4.0 };
            largest = largest.max(*weight);
        }
    }
    const { assert!(KEY == 16, "the logits' scale is 1 / sqrt(KEY)") };
    let mut context = [0.0; VALUE];
    let mut total = 0.0;
    for (j, (weight, other)) in weights.iter_mut().zip(encoded).enumerate() {
        if present(j) {
            *weight = exp(*weight - largest);
            total += *weight;
            for (c, v) in context.iter_mut().zip(&other.value) {
                *c += *weight * v;
            }
        }
    }
    // The largest term is 1, so the total is at least that.
    weights.iter_mut().chain(&mut context).for_each(|x| *x /= total);
    context
}

fn scatter<const L: usize, const N: usize>(
    from: &[[f32; L]; N],
    encoded: &mut [Encoded],
    field: impl Fn(&mut Encoded) -> &mut [f32; N],
) {
    for (lane, to) in encoded.iter_mut().enumerate() {
        for (to, from) in field(to).iter_mut().zip(from) {
            *to = from[lane];
        }
    }
}

fn finite<'a>(mut numbers: impl Iterator<Item = &'a f32>, what: impl Fn() -> String) -> Result<(), NetworkError> {
    match numbers.find(|x| !x.is_finite()) {
        Some(&value) => Err(NetworkError::NotFinite { what: what(), value }),
        None => Ok(()),
    }
}

/// Hyperbolic tangent, off by at most 5e-7; without branches, so that it vectorises.
///
/// A rational minimax approximation, odd of degree 13 over even of degree 6 (that of the Eigen library).
pub fn tanh(x: f32) -> f32 {
    // Beyond this the approximation would leave -1 to 1 by rounding.
    let x = x.clamp(-7.905_311, 7.905_311);
    let y = x * x;
    let p = -2.760_768_5e-16;
    let p = p * y + 2.000_188e-13;
    let p = p * y - 8.604_672e-11;
    let p = p * y + 5.122_297e-8;
    let p = p * y + 1.485_722_4e-5;
    let p = p * y + 6.372_619_3e-4;
    let p = p * y + 4.893_524_6e-3;
    let q = 1.198_258_4e-6;
    let q = q * y + 1.185_347e-4;
    let q = q * y + 2.268_434_6e-3;
    let q = q * y + 4.893_525e-3;
    (x * p / q).clamp(-1.0, 1.0)
}

/// Exponential function for arguments up to 0, relative error at most 3e-7; below -87 it is about 1e-38.
fn exp(x: f32) -> f32 {
    // 2^n * e^r with |r| <= ln(2) / 2: adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.max(-87.0);
    let shifted = x * core::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln(2) in two parts, the first exact in few bits.
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    let p = 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127);
    p * f32::from_bits(exponent << 23)
}

#[cfg(test)]
pub(crate) mod testing {
    //! Networks and observations that are random but of realistic size.

    use super::*;

    /// Normally distributed numbers from a seed (SplitMix64, sum of twelve).
    pub struct Normal(u64);

    impl Normal {
        pub fn new(seed: u64) -> Self {
            Normal(seed)
        }

        fn uniform(&mut self) -> f32 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (z >> 40) as f32 / (1u32 << 24) as f32
        }

        pub fn sample(&mut self) -> f32 {
            (0..12).map(|_| self.uniform()).sum::<f32>() - 6.0
        }
    }

    /// Weights as after training: pre-activations around 1, queries and keys large enough that attention is not
    /// uniform.
    pub fn random_network(seed: u64, attention: bool) -> Network {
        let mut normal = Normal::new(seed);
        let mut network = Network::zeros(attention);
        for i in 0..SIZE {
            network.mean[i] = 0.3 * normal.sample();
            network.std[i] = 0.1 + 0.5 * normal.sample().abs();
        }
        let layers = [
            (&mut network.encoder, 1.0),
            (&mut network.query, 1.5),
            (&mut network.key, 1.5),
            (&mut network.value, 1.0),
            (&mut network.hidden, 1.2),
            (&mut network.output, 0.8),
        ];
        for (layer, gain) in layers {
            let scale = gain / (layer.inputs as f32).sqrt();
            layer.weights.iter_mut().for_each(|w| *w = scale * normal.sample());
            layer.bias.iter_mut().for_each(|b| *b = 0.2 * normal.sample());
        }
        if !attention {
            network.hidden.weights.chunks_mut(HIDDEN_IN).for_each(|row| row[EMBED..].fill(0.0));
        }
        network
    }

    /// Observations of `n` modules, with about the mean and deviation of [`random_network`] for the same fields.
    pub fn observations(seed: u64, n: usize) -> Vec<Observation> {
        let mut normal = Normal::new(seed ^ 0x5555_0000);
        (0..n).map(|_| std::array::from_fn(|_| 0.5 * normal.sample())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::testing::{observations, random_network};
    use super::*;

    #[test]
    fn tanh_and_exp_are_accurate() {
        let (mut worst_tanh, mut worst_exp) = (0.0f64, 0.0f64);
        for i in -1_000_000..=1_000_000 {
            let x = i as f32 * 1e-5;
            worst_tanh = worst_tanh.max((f64::from(tanh(x)) - f64::from(x).tanh()).abs());
            assert_eq!(tanh(-x), -tanh(x));
        }
        for i in 0..=870_000 {
            let x = i as f32 * -1e-4;
            worst_exp = worst_exp.max((f64::from(exp(x)) / f64::from(x).exp() - 1.0).abs());
        }
        println!("largest errors: tanh {worst_tanh:.1e}, exp {worst_exp:.1e} (relative)");
        assert!(worst_tanh < 5e-7 && worst_exp < 3e-7);
        assert_eq!((tanh(f32::INFINITY), tanh(-1e30), exp(0.0)), (1.0, -1.0, 1.0));
        assert!(exp(f32::NEG_INFINITY) < 1e-37);
    }

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
                network.act(&o, &heard, &mut actions, Some(&mut weights));
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
        let network = random_network(3, true);
        let o = observations(3, 13);
        let together = network.encode(&o);
        for (i, encoded) in together.iter().enumerate() {
            assert_eq!(network.encode(&o[i..=i])[0], *encoded);
        }
        let (mut alone, mut masked) = ([[0.0; 2]; 1], vec![[0.0; 2]; 13]);
        network.act(&o[..1], &[0], &mut alone, None);
        network.act(&o, &[0; 13], &mut masked, None);
        assert_eq!(alone[0], masked[0]);
    }

    #[test]
    fn broken_networks_are_refused_in_one_sentence() {
        let mut network = random_network(4, true);
        network.hidden.weights[7] = f32::NAN;
        let said = network.check().unwrap_err().to_string();
        assert_eq!(
            said,
            "the hidden layer of the network contains NaN: training has diverged, use an earlier checkpoint"
        );
        let mut network = random_network(4, true);
        network.std[7] = 0.0;
        let said = network.check().unwrap_err().to_string();
        assert_eq!(said, "the standard deviation of observation field goal_known is 0, it must be positive");
        let mut network = random_network(4, true);
        network.key = Dense::zeros(64, 8, false);
        assert!(network.check().unwrap_err().to_string().starts_with("key layer: 64 inputs, 8 outputs"));
    }

    #[test]
    fn it_survives_a_round_trip_through_serde() {
        fn both<T: Serialize + for<'a> Deserialize<'a>>(_: &T) {}
        both(&random_network(5, true));
    }
}
