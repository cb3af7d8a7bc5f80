//! The frozen policy: a binary image of the integer network with all that a module must know to run it, read in place.
//!
//! `policy-format.md` beside this crate's manifest specifies every byte. [`Policy::parse`] checks an image once; afterwards nothing can fail.
//! [`ImageWriter`] is the other direction.
//!
//! The network (paper, section "Method"; all modules share it) maps the observation x of a module to its latent message (k, v), and its own latent with
//! those it heard to its two torques:
//!
//! ```text
//! z = clip((x - mean) / std, -5, 5)          e = tanh(W_enc z + b_enc)
//! q = W_q e,   k = W_k e,   v = W_v e        w_j = softmax_j(q . k_j / sqrt(16))
//! c = sum_j w_j v_j                          h = tanh(W_hid [e; c] + b_hid)          a = clip(W_out h + b_out, -1, 1)
//! ```

use core::fmt;

use crc::{CRC_32_ISO_HDLC, Crc};

use crate::nn::{self, Dense};
use crate::observation::{self, Observation};
use crate::robot::{AXES, Geometry, Limits, MAX_JOINTS, MAX_MODULES};

/// Version of the layout that this code reads and writes.
pub const VERSION: u16 = 1;
/// The first bytes of every image.
pub const MAGIC: [u8; 8] = *b"COMPOSER";

/// Width of the observation.
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
/// Inputs of the hidden layer: embedding, then context.
pub const HIDDEN_IN: usize = EMBED + VALUE;
/// Normalised observations are clipped to plus and minus this.
pub const CLIP: f32 = 5.0;

const DIMENSIONS: [u16; 6] = [OBS as u16, EMBED as u16, KEY as u16, VALUE as u16, HIDDEN as u16, OUT as u16];

/// What the policy was trained to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Task {
    /// Bring the head to a goal.
    GoalReaching = 0,
    /// Push a block to a goal.
    BlockPushing = 1,
    /// Take a given shape.
    ShapeFormation = 2,
    /// Go through a tube.
    TubeCrossing = 3,
    /// Get over a wall.
    WallClimbing = 4,
}

impl Task {
    /// All tasks, in the order of their numbers.
    pub const ALL: [Task; 5] =
        [Task::GoalReaching, Task::BlockPushing, Task::ShapeFormation, Task::TubeCrossing, Task::WallClimbing];

    /// The name on the command line and in file names.
    pub const fn name(self) -> &'static str {
        match self {
            Task::GoalReaching => "goal-reaching",
            Task::BlockPushing => "block-pushing",
            Task::ShapeFormation => "shape-formation",
            Task::TubeCrossing => "tube-crossing",
            Task::WallClimbing => "wall-climbing",
        }
    }

    /// The task of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Task::ALL.into_iter().find(|task| task.name() == name)
    }

    fn from_number(number: u8) -> Option<Self> {
        Task::ALL.into_iter().find(|task| *task as u8 == number)
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Which modules are told where the goal is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum GoalKnownTo {
    /// Every module (the paper's setting).
    All = 0,
    /// The head alone; attention has to carry it along.
    Head = 1,
}

impl GoalKnownTo {
    /// The name on the command line: `all` or `head`.
    pub const fn name(self) -> &'static str {
        match self {
            GoalKnownTo::All => "all",
            GoalKnownTo::Head => "head",
        }
    }

    /// The setting of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [GoalKnownTo::All, GoalKnownTo::Head].into_iter().find(|setting| setting.name() == name)
    }
}

impl fmt::Display for GoalKnownTo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What an image says about itself besides its numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Meta {
    /// What it was trained to do.
    pub task: Task,
    /// Who is told the goal.
    pub goal_known_to: GoalKnownTo,
    /// Whether the hidden layer sees the context (`composer`) or the embedding alone (`mappo`).
    pub attention: bool,
    /// Whether it was trained with modules that fail.
    pub trained_with_faults: bool,
    /// The chain it was trained on.
    pub geometry: Geometry,
    /// The limits it was trained with.
    pub limits: Limits,
    /// Time from one action to the next, in microseconds.
    pub control_period_us: u32,
    /// Time constant with which the joints of a module without torque straighten, in seconds
    /// ([`Chain::miss`](crate::kinematics::Chain::miss)).
    pub relax_seconds: f32,
}

impl Meta {
    fn check(&self) -> Result<(), PolicyError> {
        let Geometry { links_per_module, link_length } = self.geometry;
        let limits = &self.limits;
        let within = |value: f32, low: f32, high: f32| value >= low && value <= high;
        let checks = [
            ((2..=MAX_JOINTS).contains(&usize::from(links_per_module)), "links per module", "2 to 4"),
            (within(link_length, 1e-3, 1e3), "link length", "0.001 to 1000 robot units"),
            (within(limits.torque, 1e-6, 1e6), "torque limit", "0.000001 to 1000000"),
            (within(limits.torque_slew, 1e-6, 1e9), "torque slew limit", "0.000001 to 1000000000 per second"),
            (within(limits.joint_angle, 1e-3, 10.0), "joint angle limit", "0.001 to 10 rad"),
            (within(limits.joint_speed, 1e-3, 1e4), "joint speed limit", "0.001 to 10000 rad/s"),
            (within(limits.temperature, -100.0, 1000.0), "temperature limit", "-100 to 1000 degrees Celsius"),
            ((1_000..=10_000_000).contains(&self.control_period_us), "control period", "1000 to 10000000 us"),
            (within(self.relax_seconds, 1e-4, 1e3), "relaxation time", "0.0001 to 1000 s"),
        ];
        match checks.into_iter().find(|(good, ..)| !good) {
            Some((_, field, range)) => Err(PolicyError::Value { field, range }),
            None => Ok(()),
        }
    }
}

/// Why an image is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyError {
    /// Fewer bytes than an image has.
    TooShort {
        /// Bytes given.
        length: usize,
    },
    /// More bytes than an image has.
    TooLong {
        /// Bytes given.
        length: usize,
    },
    /// The first bytes are not [`MAGIC`].
    Magic,
    /// Another layout version.
    Version {
        /// The version it has.
        found: u16,
    },
    /// Another network: widths of observation, embedding, key, value, hidden layer and action.
    Dimensions {
        /// The widths it has.
        found: [u16; 6],
    },
    /// The length it states is not that of its layout.
    Length {
        /// The length it states.
        stated: u32,
    },
    /// The checksum at the end is not that of the bytes before it.
    Checksum {
        /// As stored.
        stored: u32,
        /// As computed.
        computed: u32,
    },
    /// A task that this code does not know.
    Task(u8),
    /// A number that can only be 0 or 1, or must be 0 (reserved).
    Flag {
        /// Its name in `policy-format.md`.
        field: &'static str,
        /// Its value.
        found: u8,
    },
    /// A quantity that is not finite or out of its range.
    Value {
        /// What it is.
        field: &'static str,
        /// The range it must lie in.
        range: &'static str,
    },
}

impl fmt::Display for PolicyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooShort { length } => {
                write!(f, "the policy image is cut short: it has {length} bytes where {IMAGE_SIZE} are needed")
            }
            Self::TooLong { length } => {
                write!(f, "the policy image is too long: it has {length} bytes where {IMAGE_SIZE} are needed")
            }
            Self::Magic => write!(f, "this is not a policy image: it does not begin with COMPOSER"),
            Self::Version { found } => write!(
                f,
                "the policy image has layout version {found}, this build reads version {VERSION}: export the policy again"
            ),
            Self::Dimensions { found } => write!(
                f,
                "the policy image holds a network of dimensions {found:?}, this build runs {DIMENSIONS:?} \
                 (observation, embedding, key, value, hidden, action)"
            ),
            Self::Length { stated } => {
                write!(f, "the policy image says it is {stated} bytes long, layout version {VERSION} is {IMAGE_SIZE}")
            }
            Self::Checksum { stored, computed } => write!(
                f,
                "the policy image is damaged: its CRC-32 should be {stored:08x} and is {computed:08x}"
            ),
            Self::Task(found) => {
                write!(f, "the policy image is for task {found}, this build knows tasks 0 to {}", Task::ALL.len() - 1)
            }
            Self::Flag { field, found } => {
                write!(f, "the policy image has {found} in field `{field}`, which layout version {VERSION} does not define")
            }
            Self::Value { field, range } => {
                write!(f, "the policy image has a {field} that is not a number from {range}")
            }
        }
    }
}

impl core::error::Error for PolicyError {}

/// A layer of the network; the layers lie in the image in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// Observation to embedding, then tanh.
    Encoder,
    /// Embedding to query, no bias.
    Query,
    /// Embedding to key, no bias.
    Key,
    /// Embedding to value, no bias.
    Value,
    /// Embedding and context to hidden, then tanh.
    Hidden,
    /// Hidden to action.
    Output,
}

impl Layer {
    /// All layers in the order of the image.
    pub const ALL: [Layer; 6] =
        [Layer::Encoder, Layer::Query, Layer::Key, Layer::Value, Layer::Hidden, Layer::Output];

    /// Numbers that go in.
    pub const fn inputs(self) -> usize {
        match self {
            Layer::Encoder => OBS,
            Layer::Query | Layer::Key | Layer::Value => EMBED,
            Layer::Hidden => HIDDEN_IN,
            Layer::Output => HIDDEN,
        }
    }

    /// Numbers that come out.
    pub const fn outputs(self) -> usize {
        match self {
            Layer::Encoder => EMBED,
            Layer::Query | Layer::Key => KEY,
            Layer::Value => VALUE,
            Layer::Hidden => HIDDEN,
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

    const fn size(self) -> usize {
        let words = 1 + self.outputs() + if self.has_bias() { self.outputs() } else { 0 };
        4 * words + self.inputs() * self.outputs()
    }
}

// Offsets of the header's fields; `policy-format.md` has the same table.
const VERSION_AT: usize = 8;
const TASK_AT: usize = 10;
const GOAL_KNOWN_TO_AT: usize = 11;
const LENGTH_AT: usize = 12;
const DIMENSIONS_AT: usize = 16;
const ATTENTION_AT: usize = 28;
const FAULTS_AT: usize = 29;
const LINKS_AT: usize = 30;
const RESERVED_AT: usize = 31;
const LINK_LENGTH_AT: usize = 32;
const LIMITS_AT: usize = 36;
const PERIOD_AT: usize = 56;
const RELAX_AT: usize = 60;
const MEAN_AT: usize = 64;
const GAIN_AT: usize = MEAN_AT + 4 * OBS;
const SOFTMAX_AT: usize = GAIN_AT + 4 * OBS;
const LAYERS_AT: usize = SOFTMAX_AT + 8;
const CRC_AT: usize = Layer::Output.offset() + Layer::Output.size();

/// Bytes of an image.
pub const IMAGE_SIZE: usize = CRC_AT + 4;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

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
    embedding: [i16; EMBED],
    query: [i16; KEY],
    /// The message for the others.
    pub latent: Latent,
}

/// A checked view into a policy image.
#[derive(Clone, Copy, Debug)]
pub struct Policy<'a> {
    meta: Meta,
    crc: u32,
    mean: &'a [[u8; 4]; OBS],
    gain: &'a [[u8; 4]; OBS],
    softmax: (i32, u8),
    encoder: Dense<'a, OBS, EMBED>,
    query: Dense<'a, EMBED, KEY>,
    key: Dense<'a, EMBED, KEY>,
    value: Dense<'a, EMBED, VALUE>,
    hidden: Dense<'a, HIDDEN_IN, HIDDEN>,
    output: Dense<'a, HIDDEN, OUT>,
}

impl<'a> Policy<'a> {
    /// Checks an image and gives a view into it. The slice must be exactly [`IMAGE_SIZE`] long; it may lie at any address.
    pub fn parse(image: &'a [u8]) -> Result<Self, PolicyError> {
        let too_short = PolicyError::TooShort { length: image.len() };
        // What a foreign or older file says about itself comes before its length, so that the reason given is the true one.
        let (magic, rest) = image.split_first_chunk::<8>().ok_or(too_short)?;
        if *magic != MAGIC {
            return Err(PolicyError::Magic);
        }
        let (version, _) = rest.split_first_chunk::<2>().ok_or(too_short)?;
        match u16::from_le_bytes(*version) {
            VERSION => {}
            found => return Err(PolicyError::Version { found }),
        }
        let found: &[u8; 12] = bytes(image, DIMENSIONS_AT).ok_or(too_short)?;
        let mut dimensions = [0; 6];
        for (dimension, bytes) in dimensions.iter_mut().zip(found.as_chunks().0) {
            *dimension = u16::from_le_bytes(*bytes);
        }
        if dimensions != DIMENSIONS {
            return Err(PolicyError::Dimensions { found: dimensions });
        }
        let stated = u32::from_le_bytes(*bytes(image, LENGTH_AT).ok_or(too_short)?);
        if stated as usize != IMAGE_SIZE {
            return Err(PolicyError::Length { stated });
        }
        if image.len() > IMAGE_SIZE {
            return Err(PolicyError::TooLong { length: image.len() });
        }
        let image: &[u8; IMAGE_SIZE] = image.try_into().map_err(|_| too_short)?;
        Self::parse_whole(image).unwrap_or(Err(too_short))
    }

    /// `None` cannot happen: all offsets lie within the image. It saves the control path from a panic.
    fn parse_whole(image: &'a [u8; IMAGE_SIZE]) -> Option<Result<Self, PolicyError>> {
        let byte = |at: usize| image.get(at).copied();
        let u32_at = |at: usize| bytes(image, at).map(|b| u32::from_le_bytes(*b));
        let f32_at = |at: usize| u32_at(at).map(f32::from_bits);

        let computed = CRC.checksum(image.get(..CRC_AT)?);
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
        for layer in Layer::ALL {
            if let Err(error) = check_shift(u32_at(layer.offset())?) {
                return Some(Err(error));
            }
        }
        Some(Ok(Policy {
            meta,
            crc: stored,
            mean,
            gain,
            softmax: (multiplier, shift as u8),
            encoder: dense(image, Layer::Encoder)?,
            query: dense(image, Layer::Query)?,
            key: dense(image, Layer::Key)?,
            value: dense(image, Layer::Value)?,
            hidden: dense(image, Layer::Hidden)?,
            output: dense(image, Layer::Output)?,
        }))
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

    /// CRC-32 of the image.
    pub fn crc(&self) -> u32 {
        self.crc
    }

    /// The low 16 bits of the CRC-32. It travels in every LATENT, so that modules with different policies ignore each other.
    pub fn tag(&self) -> u16 {
        self.crc as u16
    }

    /// From the observation of a module to its embedding, query and latent message.
    ///
    /// Values outside of five standard deviations saturate there, infinite ones too; what is not a number counts as -5 to 5's middle, the mean.
    pub fn encode(&self, observation: &Observation) -> Encoded {
        let mut input = [0; OBS];
        for ((x, value), (mean, gain)) in input.iter_mut().zip(observation).zip(self.mean.iter().zip(self.gain)) {
            *x = nn::quantise(*value, f32::from_le_bytes(*mean), f32::from_le_bytes(*gain));
        }
        let embedding = self.encoder.forward(&input).map(nn::tanh);
        if !self.meta.attention {
            return Encoded { embedding, query: [0; KEY], latent: Latent::ZERO };
        }
        Encoded {
            query: self.query.forward(&embedding).map(nn::saturate16),
            latent: Latent {
                key: self.key.forward(&embedding).map(nn::saturate8),
                value: self.value.forward(&embedding).map(nn::saturate8),
            },
            embedding,
        }
    }

    /// The action of a module, yaw and pitch torque as a fraction of the limit, each within -1 to 1.
    ///
    /// `own` is what [`Policy::encode`] gave. Bit `j` of `heard` says that `latents[j]` is the message of module `j` for this control cycle; the
    /// own message is always part of it and taken from `own`, whatever `heard` and `latents` say at `own_index`. An index beyond the last counts as the
    /// last. `attention` receives the weight of each module in Q15 (32767 is 1), together about 32767; a policy without attention puts all of it on itself.
    pub fn act(
        &self,
        own: &Encoded,
        latents: &[Latent; MAX_MODULES],
        heard: u64,
        attention: Option<&mut [u16; MAX_MODULES]>,
        own_index: usize,
    ) -> [f32; AXES] {
        let own_index = own_index.min(MAX_MODULES - 1);
        let own_bit = 1u64 << own_index;
        let mut input = [0; HIDDEN_IN];
        let (embedding, context) = input.split_at_mut(EMBED);
        for (x, value) in embedding.iter_mut().zip(own.embedding) {
            *x = value;
        }
        if self.meta.attention {
            let mask = heard | own_bit;
            let latent =
                |j: usize| if j == own_index { &own.latent } else { latents.get(j).unwrap_or(&Latent::ZERO) };
            let mut logits = [0; MAX_MODULES];
            for j in nn::ones(mask) {
                if let Some(logit) = logits.get_mut(j) {
                    *logit = dot(&own.query, &latent(j).key);
                }
            }
            let weights = nn::softmax(&logits, mask, self.softmax.0, self.softmax.1);
            // |sum| <= 128 * (32767 + 32), far from overflow.
            let mut sums = [0i32; VALUE];
            for j in nn::ones(mask) {
                let weight = weights.get(j).map_or(0, |w| i32::from(*w));
                for (sum, value) in sums.iter_mut().zip(latent(j).value) {
                    *sum += weight * i32::from(value);
                }
            }
            for (x, sum) in context.iter_mut().zip(sums) {
                *x = nn::saturate16((sum + (1 << (CONTEXT_SHIFT - 1))) >> CONTEXT_SHIFT);
            }
            if let Some(attention) = attention {
                *attention = weights;
            }
        } else if let Some(attention) = attention {
            *attention = [0; MAX_MODULES];
            if let Some(weight) = attention.get_mut(own_index) {
                *weight = nn::ONE as u16;
            }
        }
        let hidden = self.hidden.forward(&input).map(nn::tanh);
        self.output.forward(&hidden).map(|action| f32::from(nn::saturate16(action)) / f32::from(nn::ONE))
    }
}

/// The context is the weighted sum of values (Q15 weights times int8), shifted right by this: int8 value 1 becomes about 256.
pub const CONTEXT_SHIFT: u32 = 7;

/// |result| <= 16 * 32767 * 128, below 2^27.
fn dot(query: &[i16; KEY], key: &[i8; KEY]) -> i32 {
    query.iter().zip(key).map(|(&q, &k)| i32::from(q) * i32::from(k)).sum()
}

fn check_input(mean: f32, gain: f32) -> Result<(), PolicyError> {
    if !(mean >= -1e6 && mean <= 1e6) {
        return Err(PolicyError::Value { field: "input mean", range: "-1000000 to 1000000" });
    }
    if !(gain >= 0.0 && gain <= 1e9) {
        return Err(PolicyError::Value { field: "input gain", range: "0 to 1000000000" });
    }
    Ok(())
}

fn check_softmax(multiplier: i32, shift: u32) -> Result<(), PolicyError> {
    if multiplier < 0 {
        return Err(PolicyError::Value { field: "softmax multiplier", range: "0 to 2147483647" });
    }
    check_shift(shift)
}

fn check_shift(shift: u32) -> Result<(), PolicyError> {
    if !(1..=u32::from(nn::MAX_SHIFT)).contains(&shift) {
        return Err(PolicyError::Value { field: "shift", range: "1 to 62" });
    }
    Ok(())
}

/// The `N` bytes at `at`.
fn bytes<const N: usize>(image: &[u8], at: usize) -> Option<&[u8; N]> {
    image.get(at..)?.first_chunk()
}

/// `OUT` rows of `IN` bytes from `at` on.
fn rows<const IN: usize, const OUT: usize>(image: &[u8], at: usize) -> Option<&[[u8; IN]; OUT]> {
    image.get(at..)?.as_chunks().0.first_chunk()
}

/// A view of a layer.
fn dense<const IN: usize, const OUT: usize>(image: &[u8], layer: Layer) -> Option<Dense<'_, IN, OUT>> {
    let shift = u32::from_le_bytes(*bytes(image, layer.offset())?) as u8;
    let multipliers_at = layer.offset() + 4;
    let bias_at = multipliers_at + 4 * OUT;
    let weights_at = if layer.has_bias() { bias_at + 4 * OUT } else { bias_at };
    Some(Dense {
        weights: rows(image, weights_at)?,
        multipliers: rows(image, multipliers_at)?,
        bias: if layer.has_bias() { Some(rows(image, bias_at)?) } else { None },
        shift,
    })
}

/// Writes an image; every part that is not written stays zero. [`ImageWriter::finish`] checks the numbers and adds the checksum.
pub struct ImageWriter<'a> {
    image: &'a mut [u8; IMAGE_SIZE],
    error: Option<PolicyError>,
}

impl<'a> ImageWriter<'a> {
    /// Begins an image with its header.
    pub fn new(meta: &Meta, image: &'a mut [u8; IMAGE_SIZE]) -> Self {
        image.fill(0);
        let mut writer = ImageWriter { image, error: meta.check().err() };
        writer.put(0, &MAGIC);
        writer.put(VERSION_AT, &VERSION.to_le_bytes());
        writer.put(TASK_AT, &[meta.task as u8, meta.goal_known_to as u8]);
        writer.put(LENGTH_AT, &(IMAGE_SIZE as u32).to_le_bytes());
        for (i, dimension) in DIMENSIONS.iter().enumerate() {
            writer.put(DIMENSIONS_AT + 2 * i, &dimension.to_le_bytes());
        }
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

    /// The shift of a layer: see [`nn::Dense`].
    pub fn shift(&mut self, layer: Layer, shift: u8) {
        self.note(check_shift(shift.into()));
        self.put(layer.offset(), &u32::from(shift).to_le_bytes());
    }

    /// One output of a layer. The bias of a layer without one is ignored, as are an output and weights that the layer does not have.
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

    /// Seals the image, or says which of its numbers [`Policy::parse`] would refuse.
    pub fn finish(mut self) -> Result<(), PolicyError> {
        if let Some(error) = self.error {
            return Err(error);
        }
        seal(&mut self.image);
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
fn seal(image: &mut [u8; IMAGE_SIZE]) {
    if let Some((body, checksum)) = image.split_last_chunk_mut::<4>() {
        *checksum = CRC.checksum(body).to_le_bytes();
    }
}

/// An untrained policy with weights drawn from `seed`, for tests: activations of about the size that trained networks have, paper's
/// robot, control period 50 ms, with attention.
pub fn random_image(seed: u32, image: &mut [u8; IMAGE_SIZE]) {
    let meta = Meta {
        task: Task::GoalReaching,
        goal_known_to: GoalKnownTo::All,
        attention: true,
        trained_with_faults: false,
        geometry: Geometry::default(),
        limits: Limits::default(),
        control_period_us: 50_000,
        relax_seconds: 0.25,
    };
    // SplitMix64.
    let mut state = u64::from(seed);
    let mut next = move || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z >> 56) as i8
    };
    let mut writer = ImageWriter::new(&meta, image);
    for field in 0..OBS {
        writer.input(field, 0.0, f32::from(nn::ONE) / CLIP);
    }
    // Logits differ by about two, in natural units.
    writer.softmax(1 << 27, 30);
    for layer in Layer::ALL {
        // Shifts such that sums of random terms come out near 1 in the fixed point of the result: Q16, int16, int8, int8, Q16, Q15.
        let (multiplier, shift) = match layer {
            Layer::Encoder => (1 << 25, 30),
            Layer::Query => (1 << 20, 30),
            Layer::Key | Layer::Value => (1 << 20, 38),
            Layer::Hidden => (1 << 23, 30),
            Layer::Output => (1 << 20, 30),
        };
        writer.shift(layer, shift);
        for output in 0..layer.outputs() {
            let mut weights = [0; HIDDEN_IN];
            weights.fill_with(|| next().max(-127));
            let bias = i32::from(next()) << 6;
            writer.row(layer, output, multiplier, bias, &weights);
        }
    }
    // Its numbers are constants within range.
    let _ = writer.finish();
}
