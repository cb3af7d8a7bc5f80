//! Networks on burn's tensors over flat parameters, for methods that leave their gradients to automatic differentiation.
//!
//! Layers are found by their names. Weights are `[outputs, inputs]`, as in the authors' PyTorch, so that numbers of theirs fit as they are.

use std::collections::HashMap;

use burn::tensor::activation::{gelu, relu, softmax};
use burn::tensor::{Device, Tensor, TensorData};
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

/// The parameters of a network as tensors, by their names.
#[derive(Clone, Debug)]
pub struct Weights {
    tensors: HashMap<String, Tensor<2>>,
}

impl Weights {
    /// Parameters to compute with.
    pub fn new(layout: &Layout, parameters: &[f32]) -> Self {
        Self::on(layout, parameters, &Device::flex())
    }

    /// Parameters to differentiate by.
    pub fn tracked(layout: &Layout, parameters: &[f32]) -> Self {
        let Self { mut tensors } = Self::on(layout, parameters, &Device::flex().autodiff());
        tensors.values_mut().for_each(|tensor| *tensor = tensor.clone().require_grad());
        Self { tensors }
    }

    fn on(layout: &Layout, parameters: &[f32], device: &Device) -> Self {
        let tensor = |entry: &Entry| {
            let data = TensorData::new(parameters[entry.range()].to_vec(), [entry.rows, entry.columns]);
            (entry.name.clone(), Tensor::from_data(data, device))
        };
        Self { tensors: layout.entries.iter().map(tensor).collect() }
    }

    /// A matrix or vector.
    ///
    /// # Panics
    ///
    /// If there is none of that name.
    pub fn get(&self, name: &str) -> Tensor<2> {
        self.tensors.get(name).expect("a layer of this network").clone()
    }

    /// Where the tensors are.
    pub fn device(&self) -> Device {
        self.tensors.values().next().map_or_else(Device::flex, |tensor| tensor.device())
    }

    /// Numbers as a tensor on the same device.
    pub fn tensor<const D: usize>(&self, numbers: &[f32], shape: [usize; D]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(numbers.to_vec(), shape), &self.device())
    }

    /// A linear layer: `[rows, inputs]` to `[rows, outputs]`.
    pub fn linear(&self, name: &str, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.get(&format!("{name}.weight")).transpose()) + self.get(&format!("{name}.bias"))
    }

    /// Layer normalisation over each row.
    pub fn layer_norm(&self, name: &str, x: Tensor<2>) -> Tensor<2> {
        let x = x.clone() - x.mean_dim(1);
        let variance = (x.clone() * x.clone()).mean_dim(1);
        x / (variance + 1e-5).sqrt() * self.get(&format!("{name}.weight")) + self.get(&format!("{name}.bias"))
    }

    /// Attention with one head over `[teams, modules]` rows of queries from `query` and keys and values from `x`; `mask` is added to the
    /// scores, `[teams, modules, modules]`. Projections `NAME.query`, `.key`, `.value`, `.proj`.
    pub fn attention(&self, name: &str, query: Tensor<2>, x: Tensor<2>, mask: Tensor<3>) -> Tensor<2> {
        let [teams, modules, _] = mask.dims();
        let [rows, width] = x.dims();
        let layer =
            |part: &str, x: Tensor<2>| self.linear(&format!("{name}.{part}"), x).reshape([teams, modules, width]);
        let (q, k, v) = (layer("query", query), layer("key", x.clone()), layer("value", x));
        let scores = q.matmul(k.swap_dims(1, 2)) * (width as f32).sqrt().recip() + mask;
        self.linear(&format!("{name}.proj"), softmax(scores, 2).matmul(v).reshape([rows, width]))
    }

    /// A multilayer perceptron of the layers `names`, with an activation in between.
    pub fn mlp(&self, names: &[&str], activation: Activation, x: Tensor<2>) -> Tensor<2> {
        let last = names.len() - 1;
        names.iter().enumerate().fold(x, |x, (i, name)| {
            let x = self.linear(name, x);
            if i < last { activation.apply(x) } else { x }
        })
    }

    /// The gradients of `loss`, in the order of the layout; 0 where it does not depend on an entry.
    pub fn gradients(self, layout: &Layout, loss: &Tensor<1>) -> Vec<f32> {
        let mut gradients = loss.backward();
        self.take(layout, &mut gradients)
    }

    /// The same out of gradients that are there already.
    pub fn take(self, layout: &Layout, gradients: &mut burn::tensor::Gradients) -> Vec<f32> {
        let mut flat = vec![0.0; layout.len];
        for entry in &layout.entries {
            if let Some(gradient) = self.tensors[&entry.name].grad_remove(gradients) {
                flat[entry.range()].copy_from_slice(&floats(gradient));
            }
        }
        flat
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

impl Activation {
    /// Applies it to every number.
    pub fn apply<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Activation::Tanh => x.tanh(),
            Activation::Relu => relu(x),
            Activation::Gelu => gelu(x),
        }
    }
}

/// The numbers of a tensor in order.
pub fn floats<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().expect("the flex backend computes in f32")
}

/// The only number of a tensor.
pub fn scalar(tensor: &Tensor<1>) -> f64 {
    f64::from(tensor.clone().into_scalar::<f32>())
}
