//! The policy network of COMPOSER in floating point, as data: what training hands over, what
//! [`FloatPolicy`](crate::methods::composer::float::FloatPolicy) runs, what [`crate::freeze`] turns into integers.

use composer_shared::observation::SIZE;
use composer_shared::policy::{EMBED, HIDDEN, HIDDEN_IN, KEY, OBS, OUT, VALUE};
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

impl Dense {
    /// A layer of zeros.
    pub fn zeros(inputs: usize, outputs: usize, bias: bool) -> Self {
        Dense { inputs, outputs, weights: vec![0.0; inputs * outputs], bias: vec![0.0; if bias { outputs } else { 0 }] }
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
    use super::testing::random_network;
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
    }

    #[test]
    fn it_survives_a_round_trip_through_serde() {
        fn both<T: Serialize + for<'a> Deserialize<'a>>(_: &T) {}
        both(&random_network(5, true));
    }
}
