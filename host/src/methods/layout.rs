//! Where the parameters of a network are in a flat vector, by the names of its layers, and how they begin.
//!
//! Weights are `[outputs, inputs]`, as in the authors' PyTorch, so that numbers of theirs fit as they are. A network computes with them on the
//! tape ([`layers`](super::layers)) or on burn's tensors ([`tensors`](super::tensors)).

use rand::{Rng, RngExt};

use super::parameters::orthogonal;

/// How the numbers of an entry begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Initial {
    /// All the same.
    Constant(f32),
    /// A (semi-)orthogonal matrix times this.
    Orthogonal(f32),
    /// Uniform within this of 0.
    Uniform(f32),
}

/// One named matrix of a [`Layout`]; a vector is one of a single row.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Rows: outputs.
    pub rows: usize,
    /// Columns: inputs.
    pub columns: usize,
    /// Where it starts.
    pub offset: usize,
    /// Whether it is the matrix of a linear layer, which may have a single row too.
    pub(super) matrix: bool,
    initial: Initial,
}

impl Entry {
    /// Its place in the flat parameters.
    pub fn range(&self) -> std::ops::Range<usize> {
        self.offset..self.offset + self.rows * self.columns
    }
}

/// What the initial weights of a linear layer are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scheme {
    /// Orthogonal times this, zero bias.
    Orthogonal(f32),
    /// Weights and bias uniform within one over the root of the inputs, PyTorch's default.
    Uniform,
}

/// Where things are in a flat parameter vector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layout {
    entries: Vec<Entry>,
    len: usize,
}

impl Layout {
    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// All entries in order.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The place of an entry.
    ///
    /// # Panics
    ///
    /// If there is none of that name.
    pub fn range(&self, name: &str) -> std::ops::Range<usize> {
        self.entries.iter().find(|entry| entry.name == name).expect("a layer of this network").range()
    }

    fn add(&mut self, name: String, [rows, columns]: [usize; 2], matrix: bool, initial: Initial) {
        self.entries.push(Entry { name, rows, columns, offset: self.len, matrix, initial });
        self.len += rows * columns;
    }

    /// A vector.
    pub fn vector(&mut self, name: &str, size: usize, value: f32) {
        self.add(name.into(), [1, size], false, Initial::Constant(value));
    }

    /// A linear layer: `NAME.weight` and `NAME.bias`.
    pub fn linear(&mut self, name: &str, inputs: usize, outputs: usize, scheme: Scheme) {
        let (weight, bias) = match scheme {
            Scheme::Orthogonal(gain) => (Initial::Orthogonal(gain), Initial::Constant(0.0)),
            Scheme::Uniform => {
                let within = Initial::Uniform((inputs as f32).sqrt().recip());
                (within, within)
            }
        };
        self.add(format!("{name}.weight"), [outputs, inputs], true, weight);
        self.add(format!("{name}.bias"), [1, outputs], false, bias);
    }

    /// Layer normalisation: `NAME.weight` and `NAME.bias`.
    pub fn layer_norm(&mut self, name: &str, size: usize) {
        self.add(format!("{name}.weight"), [1, size], false, Initial::Constant(1.0));
        self.add(format!("{name}.bias"), [1, size], false, Initial::Constant(0.0));
    }

    /// Another behind this one.
    pub fn followed_by(mut self, other: &Layout) -> Self {
        let from = self.len;
        let moved = |entry: &Entry| Entry { offset: from + entry.offset, ..entry.clone() };
        self.entries.extend(other.entries.iter().map(moved));
        self.len += other.len;
        self
    }

    /// Initial parameters.
    pub fn initial(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut parameters = Vec::with_capacity(self.len);
        for Entry { rows, columns, initial, .. } in &self.entries {
            match initial {
                Initial::Constant(value) => parameters.extend(std::iter::repeat_n(*value, rows * columns)),
                Initial::Orthogonal(gain) => parameters.extend(orthogonal(*rows, *columns, *gain, rng)),
                Initial::Uniform(within) => {
                    parameters.extend((0..rows * columns).map(|_| rng.random_range(-within..=*within)));
                }
            }
        }
        parameters
    }
}

/// What comes between two layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// Hyperbolic tangent.
    Tanh,
    /// 0 below 0.
    Relu,
    /// The Gaussian error linear unit, exact.
    Gelu,
}
