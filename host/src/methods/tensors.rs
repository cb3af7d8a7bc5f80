//! Networks on burn's tensors over flat parameters, for methods that leave their gradients to automatic differentiation.
//!
//! Layers are found by their names ([`layout`](super::layout)).

use std::collections::HashMap;

use burn::tensor::activation::{gelu, relu, softmax};
use burn::tensor::{Device, Tensor, TensorData};

use super::layout::{Activation, Entry, Layout};

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
        Self { tensors: layout.entries().iter().map(tensor).collect() }
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
        let mut flat = vec![0.0; layout.len()];
        for entry in layout.entries() {
            if let Some(gradient) = self.tensors[&entry.name].grad_remove(gradients) {
                flat[entry.range()].copy_from_slice(&floats(gradient));
            }
        }
        flat
    }
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
