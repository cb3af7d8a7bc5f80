//! The policy network of COMPOSER in floating point, as data: what training hands over, what
//! [`FloatPolicy`](crate::methods::composer::float::FloatPolicy) runs, what [`crate::freeze`] turns into integers.

use composer_shared::observation::{BASE, SIZE};
use composer_shared::policy::{DISTANCE_BUCKETS, EMBED, HIDDEN, KEY, MEMORY, OUT, Shape, VALUE};
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
    /// Fields of the observation that it takes, from the first on: [`BASE`], the paper's, or [`SIZE`].
    #[serde(default = "base", skip_serializing_if = "is_base")]
    pub inputs: usize,
    /// Channels of its memory: 0 or [`MEMORY`].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub memory: usize,
    /// What is added to the scaled logit of a module by its distance along the chain
    /// ([`distance_bucket`](composer_shared::policy::distance_bucket)): [`DISTANCE_BUCKETS`] numbers, or none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub distance_bias: Vec<f32>,
    /// Mean of each field of the observation that it takes.
    pub mean: Vec<f32>,
    /// Standard deviation of each, positive.
    pub std: Vec<f32>,
    /// Observation to embedding.
    pub encoder: Dense,
    /// Embedding and memory to query, no bias.
    pub query: Dense,
    /// Embedding and memory to key, no bias.
    pub key: Dense,
    /// Embedding and memory to value, no bias.
    pub value: Dense,
    /// Embedding, memory and context to hidden.
    pub hidden: Dense,
    /// Hidden to action.
    pub output: Dense,
}

fn base() -> usize {
    BASE
}

fn is_base(inputs: &usize) -> bool {
    *inputs == BASE
}

fn is_zero(memory: &usize) -> bool {
    *memory == 0
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
    /// It takes a part of the observation that no module could give it.
    #[error("the network takes {0} fields of the observation, a module gives it the first {BASE} or all {SIZE}")]
    Inputs(usize),
    /// It remembers more or less than a module has room for.
    #[error("the network has a memory of {0} channels, the image of a module has room for {MEMORY} or none")]
    Memory(usize),
    /// Too many or too few numbers.
    #[error("the network has {found} {what}, {wanted} were expected")]
    Count {
        /// Of what.
        what: &'static str,
        /// How many it has.
        found: usize,
        /// How many it should have.
        wanted: usize,
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

impl Dense {
    /// A layer of zeros.
    pub fn zeros(inputs: usize, outputs: usize, bias: bool) -> Self {
        Dense { inputs, outputs, weights: vec![0.0; inputs * outputs], bias: vec![0.0; if bias { outputs } else { 0 }] }
    }
}

impl Network {
    /// A network of zeros of the paper's protocol that does not normalise its observations.
    pub fn zeros(attention: bool) -> Self {
        Network::zeros_of(attention, BASE, 0)
    }

    /// The same with so many inputs and channels of memory.
    pub fn zeros_of(attention: bool, inputs: usize, memory: usize) -> Self {
        let features = EMBED + memory;
        Network {
            attention,
            inputs,
            memory,
            distance_bias: Vec::new(),
            mean: vec![0.0; inputs],
            std: vec![1.0; inputs],
            encoder: Dense::zeros(inputs, EMBED, true),
            query: Dense::zeros(features, KEY, false),
            key: Dense::zeros(features, KEY, false),
            value: Dense::zeros(features, VALUE, false),
            hidden: Dense::zeros(features + VALUE, HIDDEN, true),
            output: Dense::zeros(HIDDEN, OUT, true),
        }
    }

    /// Width of embedding and memory together.
    pub fn features(&self) -> usize {
        EMBED + self.memory
    }

    /// What it says of itself in an image; it has been checked.
    pub fn shape(&self) -> Shape {
        Shape { inputs: self.inputs as u16, memory: self.memory as u8 }
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
        if ![BASE, SIZE].contains(&self.inputs) {
            return Err(NetworkError::Inputs(self.inputs));
        }
        self.check_numbers(OUT)
    }

    /// The same but for the inputs, of a network with so many outputs.
    pub fn check_numbers(&self, outputs: usize) -> Result<(), NetworkError> {
        if ![0, MEMORY].contains(&self.memory) {
            return Err(NetworkError::Memory(self.memory));
        }
        let biases = if self.distance_bias.is_empty() { 0 } else { DISTANCE_BUCKETS };
        for (what, numbers, wanted) in [
            ("biases of distance", &self.distance_bias, biases),
            ("means of observation fields", &self.mean, self.inputs),
            ("standard deviations of observation fields", &self.std, self.inputs),
        ] {
            if numbers.len() != wanted {
                return Err(NetworkError::Count { what, found: numbers.len(), wanted });
            }
        }
        let shape = |dense: &Dense| (dense.inputs, dense.outputs, dense.weights.len(), dense.bias.len());
        let mut zeros = Network::zeros_of(self.attention, self.inputs, self.memory);
        zeros.output = Dense::zeros(HIDDEN, outputs, true);
        for ((name, dense), (_, wanted)) in self.layers().into_iter().zip(zeros.layers()) {
            let (found, wanted) = (shape(dense), shape(wanted));
            if found != wanted {
                let say = |(inputs, outputs, weights, biases): (usize, usize, usize, usize)| {
                    format!("{inputs} inputs, {outputs} outputs, {weights} weights and {biases} biases")
                };
                return Err(NetworkError::Shape { layer: name, found: say(found), wanted: say(wanted) });
            }
            finite(dense.weights.iter().chain(&dense.bias), || format!("the {name} layer"))?;
        }
        finite(self.distance_bias.iter(), || "the bias of distance".into())?;
        finite(self.mean.iter().chain(&self.std), || "the observation statistics".into())?;
        match self.std.iter().zip(composer_shared::observation::NAMES).find(|(std, _)| **std <= 0.0) {
            Some((&value, field)) => Err(NetworkError::Deviation { field, value }),
            None => Ok(()),
        }
    }
}

fn finite<'a>(mut numbers: impl Iterator<Item = &'a f32>, what: impl Fn() -> String) -> Result<(), NetworkError> {
    match numbers.find(|x| !x.is_finite()) {
        Some(&value) => Err(NetworkError::NotFinite { what: what(), value }),
        None => Ok(()),
    }
}

#[cfg(test)]
pub(crate) mod testing {
    //! Networks and observations that are random but of realistic size.

    use composer_shared::observation::Observation;
    use composer_shared::random::SplitMix64;

    use super::*;

    /// Normally distributed numbers from a seed (SplitMix64, sum of twelve).
    pub struct Normal(SplitMix64);

    impl Normal {
        pub fn new(seed: u64) -> Self {
            Normal(SplitMix64(seed))
        }

        fn uniform(&mut self) -> f32 {
            (self.0.next_u64() >> 40) as f32 / (1u32 << 24) as f32
        }

        pub fn sample(&mut self) -> f32 {
            (0..12).map(|_| self.uniform()).sum::<f32>() - 6.0
        }
    }

    /// Weights as after training: pre-activations around 1, queries and keys large enough that attention is not
    /// uniform.
    pub fn random_network(seed: u64, attention: bool) -> Network {
        random_network_of(seed, attention, BASE, 0)
    }

    /// The same of another shape; with a memory, it has a bias of distance, too.
    pub fn random_network_of(seed: u64, attention: bool, inputs: usize, memory: usize) -> Network {
        let mut normal = Normal::new(seed);
        let mut network = Network::zeros_of(attention, inputs, memory);
        if memory > 0 {
            network.distance_bias = (0..DISTANCE_BUCKETS).map(|_| normal.sample()).collect();
        }
        for i in 0..inputs {
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
            let features = network.features();
            network.hidden.weights.chunks_mut(features + VALUE).for_each(|row| row[features..].fill(0.0));
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
    use super::testing::{random_network, random_network_of};
    use super::*;

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
        let said = Network::zeros_of(true, BASE, 32).check().unwrap_err().to_string();
        assert_eq!(said, "the network has a memory of 32 channels, the image of a module has room for 16 or none");
        let said = Network::zeros_of(true, 44, 0).check().unwrap_err().to_string();
        assert_eq!(said, "the network takes 44 fields of the observation, a module gives it the first 40 or all 48");
        let mut network = random_network_of(4, true, SIZE, MEMORY);
        network.check().unwrap();
        network.distance_bias.pop();
        assert_eq!(network.check().unwrap_err().to_string(), "the network has 12 biases of distance, 13 were expected");
    }

    #[test]
    fn it_survives_a_round_trip_through_serde() {
        for network in [random_network(5, true), random_network_of(5, true, SIZE, MEMORY)] {
            let text = serde_json::to_string(&network).unwrap();
            assert_eq!(serde_json::from_str::<Network>(&text).unwrap(), network);
            // The file of a network of the paper's protocol is what it was before there were others.
            assert_eq!(text.contains("inputs\":48"), network.inputs == SIZE);
            assert_eq!(text.contains("memory") || text.contains("distance"), network.memory > 0);
        }
    }
}
