//! Untrained policies for tests.

use super::{
    CLIP, DISTANCE_BUCKETS, EMBED, FEATURES, GoalKnownTo, IMAGE_SIZE, ImageWriter, Layer, Meta, OBS, Shape, Task,
};
use crate::nn;
use crate::random::SplitMix64;
use crate::robot::{Geometry, Limits};

/// Limits in the header of a [`random_image`].
pub(super) const RANDOM_LIMITS: Limits =
    Limits { torque: 80.0, torque_slew: 400.0, joint_angle: 3.1, joint_speed: 3.0, temperature: 80.0 };

/// An untrained policy with weights drawn from `seed`, for tests: activations of about the size that trained networks
/// have, paper's robot, control period 50 ms, with attention, of the paper's protocol.
pub fn random_image(seed: u32, image: &mut [u8; IMAGE_SIZE]) {
    random_image_of(Shape::BASE, seed, image);
}

/// [`random_image`] of this shape; if that has a memory, with a bias by distance, too.
pub fn random_image_of(shape: Shape, seed: u32, image: &mut [u8; IMAGE_SIZE]) {
    let meta = Meta {
        task: Task::GoalReaching,
        goal_known_to: GoalKnownTo::All,
        attention: true,
        trained_with_faults: false,
        geometry: Geometry::default(),
        // Not the default, which may be tuned: the image's bits are pinned.
        limits: RANDOM_LIMITS,
        control_period_us: 50_000,
        relax_seconds: 0.25,
        task_digest: 0,
    };
    let mut random = SplitMix64(u64::from(seed));
    let mut next = move || random.byte() as i8;
    let mut writer = ImageWriter::new(&meta, shape, image);
    let (inputs, features) = (usize::from(shape.inputs), EMBED + usize::from(shape.memory));
    for field in 0..inputs {
        writer.input(field, 0.0, f32::from(nn::ONE) / CLIP);
    }
    // Logits differ by about two, in natural units.
    writer.softmax(1 << 27, 30);
    for layer in Layer::ALL {
        // Shifts such that sums of random terms come out near 1 in the fixed point of the result: Q16, int16, int8,
        // int8, Q16, Q15.
        let (multiplier, shift) = match layer {
            Layer::Encoder => (1 << 25, 30),
            Layer::Query => (1 << 20, 30),
            Layer::Key | Layer::Value => (1 << 20, 38),
            Layer::Hidden | Layer::Context => (1 << 23, 30),
            Layer::Output => (1 << 20, 30),
        };
        writer.shift(layer, shift);
        let columns = match layer.inputs() {
            FEATURES => features,
            OBS => inputs,
            columns => columns,
        };
        for output in 0..layer.outputs() {
            // As many are drawn as an embedding has, used or not: the pinned bits of old images depend on it.
            let mut weights = [0; FEATURES];
            weights.iter_mut().take(columns.max(EMBED)).for_each(|weight| *weight = next().max(-127));
            let bias = i32::from(next()) << 6;
            writer.row(layer, output, multiplier, bias, weights.get(..columns).unwrap_or_default());
        }
    }
    if shape.memory > 0 {
        for bucket in 0..DISTANCE_BUCKETS {
            writer.distance(bucket, i32::from(next()) << 14);
        }
    }
    // Its numbers are constants within range.
    let _ = writer.finish();
}
