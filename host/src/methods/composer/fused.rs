//! `tanh(x + bias)` as one differentiable operation of burn.
//!
//! Composed of burn's own operations it would cost three passes over memory forth and four back, and a call of libm's tanh per number:
//! more time than all matrix products of an update together.

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::{DType, Shape, Tensor};

use crate::methods::kernels;

type Primitive = FloatTensor<Flex>;

/// `tanh(x + bias)`: `x` is `[rows, columns]`, `bias` is `[1, columns]`.
///
/// # Panics
///
/// If the tensors are on another device than flex, or only one of them is made for autodiff.
pub fn bias_tanh(x: Tensor<2>, bias: Tensor<2>) -> Tensor<2> {
    const WRONG: &str = "both tensors live on the flex device, with autodiff or both without";
    if !x.is_autodiff() {
        let x = x.try_into_primitive::<Flex>().expect(WRONG);
        let bias = bias.try_into_primitive::<Flex>().expect(WRONG);
        return Tensor::from_primitive::<Flex>(forward(x, &bias));
    }
    let (x, x_node) = x.try_into_primitive::<Autodiff<Flex>>().expect(WRONG).into_parts();
    let (bias, bias_node) = bias.try_into_primitive::<Autodiff<Flex>>().expect(WRONG).into_parts();
    let output = forward(x, &bias);
    let prepared = BiasTanh.prepare::<NoCheckpointing>([x_node, bias_node]).compute_bound().stateful();
    Tensor::from_primitive::<Autodiff<Flex>>(match prepared {
        OpsKind::Tracked(preparation) => preparation.finish(output.clone(), output),
        OpsKind::UnTracked(preparation) => preparation.finish(output),
    })
}

fn forward(x: Primitive, bias: &Primitive) -> Primitive {
    let mut x = contiguous(x);
    let bias = contiguous(bias.clone());
    kernels::bias_tanh(x.storage_mut(), bias.storage());
    x
}

/// The tensor with its numbers in order from the start of its storage.
fn contiguous(x: Primitive) -> Primitive {
    match x.layout().contiguous_offsets() {
        Some((0, end)) if end == x.storage::<f32>().len() => x,
        _ => x.to_contiguous(),
    }
}

#[derive(Debug)]
struct BiasTanh;

impl Backward<Flex, 2> for BiasTanh {
    /// The output.
    type State = Primitive;

    fn backward(self, ops: Ops<Primitive, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let mut gradient = contiguous(grads.consume::<Flex>(&ops.node));
        let output = contiguous(ops.state);
        let columns = output.shape()[1];
        let mut of_bias = Primitive::zeros(Shape::new([1, columns]), DType::F32);
        kernels::bias_tanh_backward(gradient.storage_mut(), output.storage(), of_bias.storage_mut());
        let [x, bias] = ops.parents;
        if let Some(x) = x {
            grads.register::<Flex>(x.id, gradient);
        }
        if let Some(bias) = bias {
            grads.register::<Flex>(bias.id, of_bias);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    fn tensor(device: &Device, rows: usize, columns: usize, seed: f32) -> Tensor<2> {
        let numbers: Vec<f32> = (0..rows * columns).map(|i| 2.0 * (i as f32 * seed).sin()).collect();
        Tensor::from_data(TensorData::new(numbers, [rows, columns]), device)
    }

    fn largest_difference(a: Tensor<2>, b: Tensor<2>) -> f32 {
        (a - b).abs().max().into_scalar()
    }

    #[test]
    fn agrees_with_burns_own_operations_forth_and_back() {
        let device = Device::flex().autodiff();
        for (rows, columns) in [(1, 3), (5, 64), (33, 20)] {
            let w = tensor(&device, 7, columns, 0.9).require_grad();
            let b = tensor(&device, 1, columns, 0.7).require_grad();
            let x = tensor(&device, rows, 7, 0.3);
            let weights = tensor(&device, rows, columns, 1.3);
            let losses = [
                (x.clone().matmul(w.clone()) + b.clone()).tanh() * weights.clone(),
                bias_tanh(x.clone().matmul(w.clone()), b.clone()) * weights,
            ];
            let outputs = losses.clone().map(Tensor::inner);
            assert!(largest_difference(outputs[0].clone(), outputs[1].clone()) < 1e-6);
            let [expected, found] = losses.map(|loss| {
                let gradients = loss.sum().backward();
                [w.grad(&gradients).unwrap(), b.grad(&gradients).unwrap()]
            });
            for (expected, found) in expected.into_iter().zip(found) {
                assert!(largest_difference(expected, found) < 1e-4);
            }
        }
    }

    #[test]
    fn works_without_autodiff_and_on_views() {
        let device = Device::flex();
        let x = tensor(&device, 6, 4, 0.3);
        let bias = tensor(&device, 1, 6, 0.2);
        let expected = (x.clone().transpose() + bias.clone()).tanh();
        assert!(largest_difference(bias_tanh(x.clone().transpose(), bias), expected) < 1e-6);
        // The input is still what it was.
        assert_eq!(largest_difference(x, tensor(&device, 6, 4, 0.3)), 0.0);
    }
}
