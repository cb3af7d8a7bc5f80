//! The frozen policy: a binary image of the integer network with all that a module must know to run it, read in place.
//!
//! `policy-format.md` beside this crate's manifest specifies every byte. [`Policy::parse`] checks an image once;
//! afterwards nothing can fail. [`ImageWriter`] is the other direction.
//!
//! The network (paper, section "Self-attention Mechanism"; shared by all modules) maps the observation x of a module to
//! its latent message (k, v), and its own latent with those it heard to its two torques:
//!
//! ```text
//! z = clip((x - mean) / std, -5, 5)          e = tanh(W_enc z + b_enc)
//! m <- m + leak (e - m)                      f = [e; m]
//! q = W_q f,   k = W_k f,   v = W_v f        w_j = softmax_j(q . k_j / sqrt(16) + b_d(j))
//! c = sum_j w_j v_j                          h = tanh(W_hid [f; c] + b_hid)          a = clip(W_out h + b_out, -1, 1)
//! ```
//!
//! m is the [`Memory`] of the module, over the first 16 channels of e; b is a bias by the distance along the chain ([`distance_bucket`]). A
//! network may have neither, and may take the first 40 fields of the observation alone ([`Shape`]): the paper's has and does so.

mod error;
mod image;
mod meta;
mod random;
#[cfg(test)]
mod tests;

pub use error::PolicyError;
pub use image::{IMAGE_SIZE, ImageWriter, Layer, seal};
pub use meta::{GoalKnownTo, Meta, Task};
pub use random::{random_image, random_image_of};

use crate::CRC_32;
use crate::nn::{self, Dense};
use crate::observation::{self, Observation};
use crate::robot::{AXES, Geometry, Limits, ROOM};
use image::*;

/// Version of the layout that this code reads and writes.
pub const VERSION: u16 = 4;
/// The first bytes of every image.
pub const MAGIC: [u8; 8] = *b"COMPOSER";

/// Width of the observation; a network may take the first [`observation::BASE`] fields alone.
pub const OBS: usize = observation::SIZE;
/// Width of the embedding.
pub const EMBED: usize = 64;
/// Width of query and key.
pub const KEY: usize = 16;
/// Width of the value.
pub const VALUE: usize = 32;
/// Width of the hidden layer.
pub const HIDDEN: usize = 64;
/// Width of the action: yaw and pitch torque.
pub const OUT: usize = AXES;
/// Channels of the memory.
pub const MEMORY: usize = 16;
/// Width of embedding and memory together: what query, key, value and hidden layer see.
pub const FEATURES: usize = EMBED + MEMORY;
/// Inputs of the hidden layer of a network without memory: embedding and context.
pub const HIDDEN_IN: usize = EMBED + VALUE;
/// Distances along the chain that the attention may tell apart: [`distance_bucket`].
pub const DISTANCE_BUCKETS: usize = 13;
/// Normalised observations are clipped to plus and minus this.
pub const CLIP: f32 = 5.0;

/// Widths of embedding, key, value, hidden layer and action.
const DIMENSIONS: [u16; 5] = [EMBED as u16, KEY as u16, VALUE as u16, HIDDEN as u16, OUT as u16];

/// Which of [`DISTANCE_BUCKETS`] the way along the chain from module `from` to module `to` falls into: 6 for itself, less towards the head, more
/// towards the tail; 1, 2, 3 to 4, 5 to 8, 9 to 16, 17 and more modules away.
pub const fn distance_bucket(from: usize, to: usize) -> usize {
    let ring = match from.abs_diff(to) {
        0 => 0,
        1 => 1,
        2 => 2,
        3..=4 => 3,
        5..=8 => 4,
        9..=16 => 5,
        _ => 6,
    };
    if to < from { 6 - ring } else { 6 + ring }
}

/// What networks of this layout may differ in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Shape {
    /// Fields of the observation that it takes, from the first on: [`observation::BASE`] or [`OBS`].
    pub inputs: u16,
    /// Channels of its memory: 0 or [`MEMORY`].
    pub memory: u8,
}

impl Shape {
    /// The paper's protocol.
    pub const BASE: Shape = Shape { inputs: observation::BASE as u16, memory: 0 };
    /// All there is.
    pub const FULL: Shape = Shape { inputs: OBS as u16, memory: MEMORY as u8 };

    fn check(self) -> Result<(), PolicyError> {
        if !matches!(usize::from(self.inputs), observation::BASE | OBS) {
            return Err(PolicyError::Inputs(self.inputs));
        }
        if !matches!(usize::from(self.memory), 0 | MEMORY) {
            return Err(PolicyError::Memory(self.memory));
        }
        Ok(())
    }
}

/// Fraction bits of a [`Memory`] beyond those of an activation: the leak moves it even where it nearly is what it follows.
pub const MEMORY_BITS: u32 = 12;

/// How far a channel of the memory goes in one control step: `2^-leak` of the way.
pub const fn leak(channel: usize) -> u32 {
    if channel < MEMORY / 2 { 2 } else { 4 }
}

/// What a module remembers from one control step to the next: leaky means of the first channels of its embedding, the first half of them over
/// about 4 steps, the second over about 16. Empty at power-up and at the start of an episode. It never leaves the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory([i32; MEMORY]);

impl Memory {
    /// Nothing has been seen.
    pub const EMPTY: Memory = Memory([0; MEMORY]);

    /// One more step.
    fn update(&mut self, embedding: &[i16; EMBED]) {
        for (channel, (mean, now)) in self.0.iter_mut().zip(embedding).enumerate() {
            *mean += ((i32::from(*now) << MEMORY_BITS) - *mean) >> leak(channel);
        }
    }

    /// As activations, Q15.
    pub fn activations(&self) -> [i16; MEMORY] {
        self.0.map(|mean| nn::saturate16((mean + (1 << (MEMORY_BITS - 1))) >> MEMORY_BITS))
    }
}

impl Default for Memory {
    fn default() -> Self {
        Memory::EMPTY
    }
}

/// The message a module sends to the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latent {
    /// What it offers, compared with the queries of the others.
    pub key: [i8; KEY],
    /// What it says.
    pub value: [i8; VALUE],
}

impl Latent {
    /// All zeros.
    pub const ZERO: Latent = Latent { key: [0; KEY], value: [0; VALUE] };
}

impl Default for Latent {
    fn default() -> Self {
        Latent::ZERO
    }
}

/// What a module keeps of its observation for [`Policy::act`], and what it sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// Embedding and memory.
    features: [i16; FEATURES],
    query: [i16; KEY],
    /// The message for the others.
    pub latent: Latent,
}

/// A checked view into a policy image.
#[derive(Clone, Copy, Debug)]
pub struct Policy<'a> {
    meta: Meta,
    shape: Shape,
    crc: u32,
    mean: &'a [[u8; 4]; OBS],
    gain: &'a [[u8; 4]; OBS],
    softmax: (i32, u8),
    /// None if all are zero.
    distance: Option<&'a [[u8; 4]; DISTANCE_BUCKETS]>,
    encoder: Dense<'a, OBS, EMBED>,
    query: Dense<'a, FEATURES, KEY>,
    key: Dense<'a, FEATURES, KEY>,
    value: Dense<'a, FEATURES, VALUE>,
    hidden: Dense<'a, FEATURES, HIDDEN>,
    context: Dense<'a, VALUE, HIDDEN>,
    output: Dense<'a, HIDDEN, OUT>,
}

impl<'a> Policy<'a> {
    /// Checks an image and gives a view into it. The slice must be exactly [`IMAGE_SIZE`] long; it may lie at any
    /// address.
    pub fn parse(image: &'a [u8]) -> Result<Self, PolicyError> {
        let too_short = PolicyError::TooShort { length: image.len() };
        // What a foreign or older file says about itself comes before its length, so that the reason given is the true
        // one.
        let (magic, rest) = image.split_first_chunk::<8>().ok_or(too_short)?;
        if *magic != MAGIC {
            return Err(PolicyError::Magic);
        }
        let (version, _) = rest.split_first_chunk::<2>().ok_or(too_short)?;
        match u16::from_le_bytes(*version) {
            VERSION => {}
            found => return Err(PolicyError::Version { found }),
        }
        let found: &[u8; 10] = bytes(image, DIMENSIONS_AT + 2).ok_or(too_short)?;
        let mut dimensions = [0; 5];
        for (dimension, bytes) in dimensions.iter_mut().zip(found.as_chunks().0) {
            *dimension = u16::from_le_bytes(*bytes);
        }
        if dimensions != DIMENSIONS {
            return Err(PolicyError::Dimensions { found: dimensions });
        }
        let [memory] = *bytes(image, MEMORY_AT).ok_or(too_short)?;
        let shape = Shape { inputs: u16::from_le_bytes(*bytes(image, DIMENSIONS_AT).ok_or(too_short)?), memory };
        shape.check()?;
        let stated = u32::from_le_bytes(*bytes(image, LENGTH_AT).ok_or(too_short)?);
        if stated as usize != IMAGE_SIZE {
            return Err(PolicyError::Length { stated });
        }
        if image.len() > IMAGE_SIZE {
            return Err(PolicyError::TooLong { length: image.len() });
        }
        let image: &[u8; IMAGE_SIZE] = image.try_into().map_err(|_| too_short)?;
        Self::parse_whole(image, shape).unwrap_or(Err(too_short))
    }

    /// `None` cannot happen: all offsets lie within the image. It saves the control path from a panic.
    fn parse_whole(image: &'a [u8; IMAGE_SIZE], shape: Shape) -> Option<Result<Self, PolicyError>> {
        let byte = |at: usize| image.get(at).copied();
        let u32_at = |at: usize| bytes(image, at).map(|b| u32::from_le_bytes(*b));
        let f32_at = |at: usize| u32_at(at).map(f32::from_bits);

        let computed = CRC_32.checksum(image.get(..CRC_AT)?);
        let stored = u32_at(CRC_AT)?;
        if stored != computed {
            return Some(Err(PolicyError::Checksum { stored, computed }));
        }

        let Some(task) = Task::from_number(byte(TASK_AT)?) else {
            return Some(Err(PolicyError::Task(byte(TASK_AT)?)));
        };
        let flags = [
            ("goal known to", GOAL_KNOWN_TO_AT, 1),
            ("attention", ATTENTION_AT, 1),
            ("trained with faults", FAULTS_AT, 1),
            ("reserved", RESERVED_AT, 0),
            ("reserved", RESERVED_2_AT, 0),
            ("reserved", RESERVED_2_AT + 1, 0),
            ("reserved", RESERVED_2_AT + 2, 0),
        ];
        for (field, at, largest) in flags {
            let found = byte(at)?;
            if found > largest {
                return Some(Err(PolicyError::Flag { field, found }));
            }
        }
        let meta = Meta {
            task,
            goal_known_to: if byte(GOAL_KNOWN_TO_AT)? == 0 { GoalKnownTo::All } else { GoalKnownTo::Head },
            attention: byte(ATTENTION_AT)? == 1,
            trained_with_faults: byte(FAULTS_AT)? == 1,
            geometry: Geometry { links_per_module: byte(LINKS_AT)?, link_length: f32_at(LINK_LENGTH_AT)? },
            limits: Limits {
                torque: f32_at(LIMITS_AT)?,
                torque_slew: f32_at(LIMITS_AT + 4)?,
                joint_angle: f32_at(LIMITS_AT + 8)?,
                joint_speed: f32_at(LIMITS_AT + 12)?,
                temperature: f32_at(LIMITS_AT + 16)?,
            },
            control_period_us: u32_at(PERIOD_AT)?,
            relax_seconds: f32_at(RELAX_AT)?,
            task_digest: u32_at(DIGEST_AT)?,
        };
        if let Err(error) = meta.check() {
            return Some(Err(error));
        }

        let mean = rows::<4, OBS>(image, MEAN_AT)?;
        let gain = rows::<4, OBS>(image, GAIN_AT)?;
        for (mean, gain) in mean.iter().zip(gain) {
            if let Err(error) = check_input(f32::from_le_bytes(*mean), f32::from_le_bytes(*gain)) {
                return Some(Err(error));
            }
        }
        let (multiplier, shift) = (u32_at(SOFTMAX_AT)? as i32, u32_at(SOFTMAX_AT + 4)?);
        if let Err(error) = check_softmax(multiplier, shift) {
            return Some(Err(error));
        }
        let distance = rows::<4, DISTANCE_BUCKETS>(image, DISTANCE_AT)?;
        for bias in distance {
            if let Err(error) = check_distance(i32::from_le_bytes(*bias)) {
                return Some(Err(error));
            }
        }
        for layer in Layer::ALL {
            if let Err(error) = check_shift(u32_at(layer.offset())?) {
                return Some(Err(error));
            }
        }
        let (inputs, features) = (usize::from(shape.inputs), EMBED + usize::from(shape.memory));
        Some(Ok(Policy {
            meta,
            shape,
            crc: stored,
            mean,
            gain,
            softmax: (multiplier, shift as u8),
            distance: distance.iter().any(|bias| *bias != [0; 4]).then_some(distance),
            encoder: dense(image, Layer::Encoder, inputs)?,
            query: dense(image, Layer::Query, features)?,
            key: dense(image, Layer::Key, features)?,
            value: dense(image, Layer::Value, features)?,
            hidden: dense(image, Layer::Hidden, features)?,
            context: dense(image, Layer::Context, VALUE)?,
            output: dense(image, Layer::Output, HIDDEN)?,
        }))
    }

    /// Which of the networks of this layout it is.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Whether the attention has a bias by distance along the chain.
    pub fn distance_bias(&self) -> bool {
        self.distance.is_some()
    }

    /// All that the image says about itself.
    pub fn meta(&self) -> Meta {
        self.meta
    }

    /// What it was trained to do.
    pub fn task(&self) -> Task {
        self.meta.task
    }

    /// Who is told the goal.
    pub fn goal_known_to(&self) -> GoalKnownTo {
        self.meta.goal_known_to
    }

    /// Whether it attends to the latents of other modules.
    pub fn attention(&self) -> bool {
        self.meta.attention
    }

    /// Whether it was trained with modules that fail.
    pub fn trained_with_faults(&self) -> bool {
        self.meta.trained_with_faults
    }

    /// The chain it was trained on.
    pub fn geometry(&self) -> Geometry {
        self.meta.geometry
    }

    /// The limits it was trained with.
    pub fn limits(&self) -> Limits {
        self.meta.limits
    }

    /// Time from one action to the next, in microseconds.
    pub fn control_period_us(&self) -> u32 {
        self.meta.control_period_us
    }

    /// Time constant with which the joints of a module without torque straighten, in seconds.
    pub fn relax_seconds(&self) -> f32 {
        self.meta.relax_seconds
    }

    /// Digest of the settings of the task that it was trained for; 0: not known.
    pub fn task_digest(&self) -> u32 {
        self.meta.task_digest
    }

    /// CRC-32 of the image.
    pub fn crc(&self) -> u32 {
        self.crc
    }

    /// The low 16 bits of the CRC-32. It travels in every LATENT, so that modules with different policies ignore each
    /// other.
    pub fn tag(&self) -> u16 {
        self.crc as u16
    }

    /// One control step of a module, up to its message: from its observation to embedding, query and latent. `memory` is that of this module; it
    /// goes on by a step, if the network has one. Call it once a control cycle.
    ///
    /// Values more than five standard deviations from the mean saturate there, infinite ones too; what is not a number
    /// counts as the mean.
    pub fn encode(&self, memory: &mut Memory, observation: &Observation) -> Encoded {
        let mut input = [0; OBS];
        let fields = input.iter_mut().zip(observation).take(usize::from(self.shape.inputs));
        for ((x, value), (mean, gain)) in fields.zip(self.mean.iter().zip(self.gain)) {
            *x = nn::quantise(*value, f32::from_le_bytes(*mean), f32::from_le_bytes(*gain));
        }
        let mut embedding = [0; EMBED];
        self.encoder.forward_to(&input, &mut embedding, nn::tanh);
        let mut encoded = Encoded { features: [0; FEATURES], query: [0; KEY], latent: Latent::ZERO };
        let remembered = if self.shape.memory > 0 {
            memory.update(&embedding);
            memory.activations()
        } else {
            [0; MEMORY]
        };
        for (feature, x) in encoded.features.iter_mut().zip(embedding.into_iter().chain(remembered)) {
            *feature = x;
        }
        if self.meta.attention {
            self.query.forward_to(&encoded.features, &mut encoded.query, nn::saturate16);
            self.key.forward_to(&encoded.features, &mut encoded.latent.key, nn::saturate8);
            self.value.forward_to(&encoded.features, &mut encoded.latent.value, nn::saturate8);
        }
        encoded
    }

    /// The action of a module, yaw and pitch torque as a fraction of the limit, each within -1 to 1.
    ///
    /// `own` is what [`Policy::encode`] gave. Bit `j` of `heard` says that `latents[j]` is the message of module `j`
    /// for this control cycle; the own message is always part of it and taken from `own`, whatever `heard` and
    /// `latents` say at `own_index`. An index beyond the last counts as the last. `attention` receives the weight of
    /// each module in Q15 (32767 is 1), together about 32767; a policy without attention puts all of it on itself.
    pub fn act(
        &self,
        own: &Encoded,
        latents: &[Latent; ROOM],
        heard: u64,
        attention: Option<&mut [u16; ROOM]>,
        own_index: usize,
    ) -> [f32; AXES] {
        let own_index = own_index.min(ROOM - 1);
        let mut hidden = [0; HIDDEN];
        self.hidden.forward(&own.features, &mut hidden);
        if self.meta.attention {
            let (context, weights) = self.attend(own, latents, heard, own_index);
            let mut more = [0; HIDDEN];
            self.context.forward(&context, &mut more);
            for (sum, more) in hidden.iter_mut().zip(more) {
                *sum = sum.saturating_add(more);
            }
            if let Some(attention) = attention {
                *attention = weights;
            }
        } else if let Some(attention) = attention {
            *attention = [0; ROOM];
            if let Some(weight) = attention.get_mut(own_index) {
                *weight = nn::ONE as u16;
            }
        }
        let mut activations = [0; HIDDEN];
        for (activation, sum) in activations.iter_mut().zip(hidden) {
            *activation = nn::tanh(sum);
        }
        let mut action = [0; OUT];
        self.output.forward_to(&activations, &mut action, nn::saturate16);
        action.map(|action| f32::from(action) / f32::from(nn::ONE))
    }

    /// The attention of [`Policy::act`] alone: the context, in steps of 2^-8 of an int8 value, and the weight of each module in Q15.
    /// A policy without attention does not use it.
    pub fn attend(
        &self,
        own: &Encoded,
        latents: &[Latent; ROOM],
        heard: u64,
        own_index: usize,
    ) -> ([i16; VALUE], [u16; ROOM]) {
        let own_index = own_index.min(ROOM - 1);
        let mask = heard | 1u64 << own_index;
        let latent = |j: usize| if j == own_index { &own.latent } else { latents.get(j).unwrap_or(&Latent::ZERO) };
        let mut logits = [0; ROOM];
        let query = nn::Query::new(&own.query);
        for j in nn::ones(mask) {
            if let Some(logit) = logits.get_mut(j) {
                *logit = query.dot(&latent(j).key);
                // Both are far from what an i32 holds: |q . k| <= 2^26, |bias| <= 2^29.
                if let Some(bias) = self.distance.and_then(|bias| bias.get(distance_bucket(own_index, j))) {
                    *logit = logit.saturating_add(i32::from_le_bytes(*bias));
                }
            }
        }
        let weights = nn::softmax(&logits, mask, self.softmax.0, self.softmax.1);
        // |sum| <= 128 * (32767 + 32), far from overflow.
        let mut sums = [0; VALUE];
        let mut modules = nn::ones(mask);
        let weight = |j: usize| weights.get(j).map_or(0, |w| *w as i16);
        while let Some(j) = modules.next() {
            // Two at a time; the last of an odd number with nobody.
            let (other, other_weight) = modules.next().map_or((j, 0), |other| (other, weight(other)));
            nn::add_weighted(&mut sums, [weight(j), other_weight], [&latent(j).value, &latent(other).value]);
        }
        let mut context = [0; VALUE];
        for (context, sum) in context.iter_mut().zip(sums) {
            *context = nn::saturate16((sum + (1 << (CONTEXT_SHIFT - 1))) >> CONTEXT_SHIFT);
        }
        (context, weights)
    }
}

/// The context is the weighted sum of values (Q15 weights times int8), shifted right by this: int8 value 1 becomes
/// about 256.
pub const CONTEXT_SHIFT: u32 = 7;

/// The `N` bytes at `at`.
fn bytes<const N: usize>(image: &[u8], at: usize) -> Option<&[u8; N]> {
    image.get(at..)?.first_chunk()
}

/// `OUT` rows of `IN` bytes from `at` on.
fn rows<const IN: usize, const OUT: usize>(image: &[u8], at: usize) -> Option<&[[u8; IN]; OUT]> {
    image.get(at..)?.as_chunks().0.first_chunk()
}

/// A view of a layer of which the first `columns` inputs count.
fn dense<const IN: usize, const OUT: usize>(image: &[u8], layer: Layer, columns: usize) -> Option<Dense<'_, IN, OUT>> {
    let shift = u32::from_le_bytes(*bytes(image, layer.offset())?) as u8;
    let multipliers_at = layer.offset() + 4;
    let bias_at = multipliers_at + 4 * OUT;
    let weights_at = if layer.has_bias() { bias_at + 4 * OUT } else { bias_at };
    Some(Dense {
        weights: rows(image, weights_at)?,
        multipliers: rows(image, multipliers_at)?,
        bias: if layer.has_bias() { Some(rows(image, bias_at)?) } else { None },
        shift,
        columns,
    })
}
