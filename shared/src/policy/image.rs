//! The bytes of an image: where what lies, which numbers are allowed, and the writer.

use super::{
    DIMENSIONS, DISTANCE_BUCKETS, EMBED, FEATURES, HIDDEN, KEY, MAGIC, Meta, OBS, OUT, PolicyError, Shape, VALUE,
    VERSION,
};
use crate::CRC_32;
use crate::nn;
use crate::robot::Limits;

/// A layer of the network; the layers lie in the image in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// Observation to embedding, then tanh.
    Encoder,
    /// Embedding and memory to query, no bias.
    Query,
    /// Embedding and memory to key, no bias.
    Key,
    /// Embedding and memory to value, no bias.
    Value,
    /// Embedding and memory to hidden.
    Hidden,
    /// Context to hidden, no bias: the sum of both goes through tanh. Apart from [`Layer::Hidden`] because embedding
    /// and context differ in size, so that a common scale of the weights would cost one of them bits. All zero without
    /// attention.
    Context,
    /// Hidden to action.
    Output,
}

impl Layer {
    /// All layers in the order of the image.
    pub const ALL: [Layer; 7] =
        [Layer::Encoder, Layer::Query, Layer::Key, Layer::Value, Layer::Hidden, Layer::Context, Layer::Output];

    /// Numbers that go in.
    pub const fn inputs(self) -> usize {
        match self {
            Layer::Encoder => OBS,
            Layer::Query | Layer::Key | Layer::Value | Layer::Hidden => FEATURES,
            Layer::Context => VALUE,
            Layer::Output => HIDDEN,
        }
    }

    /// Numbers that come out.
    pub const fn outputs(self) -> usize {
        match self {
            Layer::Encoder => EMBED,
            Layer::Query | Layer::Key => KEY,
            Layer::Value => VALUE,
            Layer::Hidden | Layer::Context => HIDDEN,
            Layer::Output => OUT,
        }
    }

    /// Whether it has a bias.
    pub const fn has_bias(self) -> bool {
        matches!(self, Layer::Encoder | Layer::Hidden | Layer::Output)
    }

    /// Where its bytes begin in the image: shift, multipliers, biases if any, weights.
    pub const fn offset(self) -> usize {
        let mut offset = LAYERS_AT;
        let mut i = 0;
        while i < self as usize {
            offset += Layer::ALL[i].size();
            i += 1;
        }
        offset
    }

    pub(super) const fn size(self) -> usize {
        let words = 1 + self.outputs() + if self.has_bias() { self.outputs() } else { 0 };
        4 * words + self.inputs() * self.outputs()
    }
}

// Offsets of the header's fields; `policy-format.md` has the same table.
pub(super) const VERSION_AT: usize = 8;
pub(super) const TASK_AT: usize = 10;
pub(super) const GOAL_KNOWN_TO_AT: usize = 11;
pub(super) const LENGTH_AT: usize = 12;
pub(super) const DIMENSIONS_AT: usize = 16;
pub(super) const ATTENTION_AT: usize = 28;
pub(super) const FAULTS_AT: usize = 29;
pub(super) const LINKS_AT: usize = 30;
pub(super) const RESERVED_AT: usize = 31;
pub(super) const LINK_LENGTH_AT: usize = 32;
pub(super) const LIMITS_AT: usize = 36;
pub(super) const PERIOD_AT: usize = 56;
pub(super) const RELAX_AT: usize = 60;
pub(super) const DIGEST_AT: usize = 64;
pub(super) const MEMORY_AT: usize = 68;
pub(super) const RESERVED_2_AT: usize = 69;
pub(super) const MEAN_AT: usize = 72;
pub(super) const GAIN_AT: usize = MEAN_AT + 4 * OBS;
pub(super) const SOFTMAX_AT: usize = GAIN_AT + 4 * OBS;
pub(super) const DISTANCE_AT: usize = SOFTMAX_AT + 8;
pub(super) const LAYERS_AT: usize = DISTANCE_AT + 4 * DISTANCE_BUCKETS;
pub(super) const CRC_AT: usize = Layer::Output.offset() + Layer::Output.size();

/// Bytes of an image.
pub const IMAGE_SIZE: usize = CRC_AT + 4;

pub(super) fn check_input(mean: f32, gain: f32) -> Result<(), PolicyError> {
    if !(-1e6..=1e6).contains(&mean) {
        return Err(PolicyError::Value { field: "input mean", range: "-1000000 to 1000000" });
    }
    if !(0.0..=1e9).contains(&gain) {
        return Err(PolicyError::Value { field: "input gain", range: "0 to 1000000000" });
    }
    Ok(())
}

pub(super) fn check_softmax(multiplier: i32, shift: u32) -> Result<(), PolicyError> {
    if multiplier < 0 {
        return Err(PolicyError::Value { field: "softmax multiplier", range: "0 to 2147483647" });
    }
    check_shift(shift)
}

/// Largest bias of a logit; logits have to lie within +-2^30.
pub(super) const DISTANCE_BIAS_MAX: i32 = 1 << 29;

pub(super) fn check_distance(bias: i32) -> Result<(), PolicyError> {
    if !(-DISTANCE_BIAS_MAX..=DISTANCE_BIAS_MAX).contains(&bias) {
        return Err(PolicyError::Value { field: "distance bias", range: "-536870912 to 536870912" });
    }
    Ok(())
}

pub(super) fn check_shift(shift: u32) -> Result<(), PolicyError> {
    if !(1..=u32::from(nn::MAX_SHIFT)).contains(&shift) {
        return Err(PolicyError::Value { field: "shift", range: "1 to 62" });
    }
    Ok(())
}

/// Writes an image; every part that is not written stays zero. [`ImageWriter::finish`] checks the numbers and adds the
/// checksum.
pub struct ImageWriter<'a> {
    image: &'a mut [u8; IMAGE_SIZE],
    error: Option<PolicyError>,
}

impl<'a> ImageWriter<'a> {
    /// Begins an image with its header.
    pub fn new(meta: &Meta, shape: Shape, image: &'a mut [u8; IMAGE_SIZE]) -> Self {
        image.fill(0);
        let mut writer = ImageWriter { image, error: meta.check().and(shape.check()).err() };
        writer.put(0, &MAGIC);
        writer.put(VERSION_AT, &VERSION.to_le_bytes());
        writer.put(TASK_AT, &[meta.task as u8, meta.goal_known_to as u8]);
        writer.put(LENGTH_AT, &(IMAGE_SIZE as u32).to_le_bytes());
        for (i, dimension) in [shape.inputs].iter().chain(&DIMENSIONS).enumerate() {
            writer.put(DIMENSIONS_AT + 2 * i, &dimension.to_le_bytes());
        }
        writer.put(MEMORY_AT, &[shape.memory]);
        writer.put(
            ATTENTION_AT,
            &[u8::from(meta.attention), u8::from(meta.trained_with_faults), meta.geometry.links_per_module, 0],
        );
        writer.put(LINK_LENGTH_AT, &meta.geometry.link_length.to_le_bytes());
        let Limits { torque, torque_slew, joint_angle, joint_speed, temperature } = meta.limits;
        for (i, limit) in [torque, torque_slew, joint_angle, joint_speed, temperature].iter().enumerate() {
            writer.put(LIMITS_AT + 4 * i, &limit.to_le_bytes());
        }
        writer.put(PERIOD_AT, &meta.control_period_us.to_le_bytes());
        writer.put(RELAX_AT, &meta.relax_seconds.to_le_bytes());
        writer.put(DIGEST_AT, &meta.task_digest.to_le_bytes());
        for layer in Layer::ALL {
            writer.put(layer.offset(), &1u32.to_le_bytes());
        }
        writer.put(SOFTMAX_AT + 4, &1u32.to_le_bytes());
        writer
    }

    /// Normalisation of one field of the observation: see [`nn::quantise`].
    pub fn input(&mut self, field: usize, mean: f32, gain: f32) {
        if field < OBS {
            self.note(check_input(mean, gain));
            self.put(MEAN_AT + 4 * field, &mean.to_le_bytes());
            self.put(GAIN_AT + 4 * field, &gain.to_le_bytes());
        }
    }

    /// Scale of the logits: see [`nn::softmax`].
    pub fn softmax(&mut self, multiplier: i32, shift: u8) {
        self.note(check_softmax(multiplier, shift.into()));
        self.put(SOFTMAX_AT, &multiplier.to_le_bytes());
        self.put(SOFTMAX_AT + 4, &u32::from(shift).to_le_bytes());
    }

    /// What is added to the logit of a module at this distance, in units of a logit: see [`distance_bucket`](super::distance_bucket).
    pub fn distance(&mut self, bucket: usize, bias: i32) {
        if bucket < DISTANCE_BUCKETS {
            self.note(check_distance(bias));
            self.put(DISTANCE_AT + 4 * bucket, &bias.to_le_bytes());
        }
    }

    /// The shift of a layer: see [`nn::Dense`].
    pub fn shift(&mut self, layer: Layer, shift: u8) {
        self.note(check_shift(shift.into()));
        self.put(layer.offset(), &u32::from(shift).to_le_bytes());
    }

    /// One output of a layer. The bias of a layer without one is ignored, as are an output and weights that the layer
    /// does not have. Weights that are not given are zero.
    pub fn row(&mut self, layer: Layer, output: usize, multiplier: i32, bias: i32, weights: &[i8]) {
        if output >= layer.outputs() {
            return;
        }
        let mut at = layer.offset() + 4;
        self.put(at + 4 * output, &multiplier.to_le_bytes());
        at += 4 * layer.outputs();
        if layer.has_bias() {
            self.put(at + 4 * output, &bias.to_le_bytes());
            at += 4 * layer.outputs();
        }
        at += layer.inputs() * output;
        for (i, weight) in weights.iter().take(layer.inputs()).enumerate() {
            self.put(at + i, &weight.to_le_bytes());
        }
    }

    /// Seals the image, or says which of its numbers [`Policy::parse`](super::Policy::parse) would refuse.
    pub fn finish(self) -> Result<(), PolicyError> {
        if let Some(error) = self.error {
            return Err(error);
        }
        seal(self.image);
        Ok(())
    }

    fn note(&mut self, checked: Result<(), PolicyError>) {
        self.error = self.error.or(checked.err());
    }

    fn put(&mut self, at: usize, bytes: &[u8]) {
        if let Some(slot) = self.image.get_mut(at..at + bytes.len()) {
            slot.copy_from_slice(bytes);
        }
    }
}

/// Writes the checksum over everything before it.
pub fn seal(image: &mut [u8; IMAGE_SIZE]) {
    if let Some((body, checksum)) = image.split_last_chunk_mut::<4>() {
        *checksum = CRC_32.checksum(body).to_le_bytes();
    }
}
