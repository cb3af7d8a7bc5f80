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

use core::fmt;

use crate::CRC_32;
use crate::nn::{self, Dense};
use crate::observation::{self, Observation, POINTS, Seeker};
use crate::random::SplitMix64;
use crate::robot::{AXES, Geometry, Limits, MAX_JOINTS, ROOM};

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

    /// The paper's name of it.
    pub const fn title(self) -> &'static str {
        match self {
            Task::GoalReaching => "Goal Reaching",
            Task::BlockPushing => "Block Pushing",
            Task::ShapeFormation => "Shape Formation",
            Task::TubeCrossing => "Tube Crossing",
            Task::WallClimbing => "Wall Climbing",
        }
    }

    /// The task of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Task::ALL.into_iter().find(|task| task.name() == name)
    }

    /// Points of the scene that the station tells a robot of `modules` modules in each cycle.
    pub const fn points(self, modules: u8) -> u8 {
        match self {
            Task::GoalReaching => 1,
            Task::BlockPushing => 2,
            Task::ShapeFormation => modules,
            Task::TubeCrossing | Task::WallClimbing => 3,
        }
    }

    /// Which points module `module` of `modules` observes as its first, second and third.
    ///
    /// | task | first, the goal | second | third |
    /// |---|---|---|---|
    /// | goal-reaching | 0, the goal | | |
    /// | block-pushing | 0, the goal of the block | 1, the block's centre | |
    /// | shape-formation | its own target | the target of the next module towards the head | towards the tail |
    /// | tube-crossing | 0, the goal behind the exit | 1, the entrance's centre | 2, the middle of the tube |
    /// | wall-climbing | 0, the goal behind the wall | 1, the foot of the wall's near face, nearest to the head | 2, the top above it |
    pub const fn observed(self, module: u8, modules: u8) -> [Option<u8>; POINTS] {
        match self {
            Task::GoalReaching => [Some(0), None, None],
            Task::BlockPushing => [Some(0), Some(1), None],
            Task::ShapeFormation => {
                [Some(module), module.checked_sub(1), if module + 1 < modules { Some(module + 1) } else { None }]
            }
            Task::TubeCrossing | Task::WallClimbing => [Some(0), Some(1), Some(2)],
        }
    }

    /// Who is to come to the goal.
    pub const fn seeker(self) -> Seeker {
        match self {
            Task::ShapeFormation => Seeker::Each,
            _ => Seeker::Head,
        }
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
    /// Digest of the settings of the task that it was trained for; 0: not known. A module only carries it: whoever evaluates the policy
    /// can tell whether it does so on the same task.
    pub task_digest: u32,
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
    /// Another network: widths of embedding, key, value, hidden layer and action.
    Dimensions {
        /// The widths it has.
        found: [u16; 5],
    },
    /// It takes another number of fields of the observation.
    Inputs(u16),
    /// It has a memory of another number of channels.
    Memory(u8),
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

/// `[1, 2]`, without the code of `Debug`, which is large for a microcontroller.
fn list(f: &mut fmt::Formatter<'_>, numbers: &[u16]) -> fmt::Result {
    for (i, number) in numbers.iter().enumerate() {
        f.write_str(if i == 0 { "[" } else { ", " })?;
        write!(f, "{number}")?;
    }
    f.write_str("]")
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
                "the policy image has layout version {found}, this build reads version {VERSION}: \
                 export the policy again"
            ),
            Self::Dimensions { found } => {
                f.write_str("the policy image holds a network of dimensions ")?;
                list(f, &found)?;
                f.write_str(", this build runs ")?;
                list(f, &DIMENSIONS)?;
                f.write_str(" (embedding, key, value, hidden, action)")
            }
            Self::Inputs(found) => write!(
                f,
                "the policy image holds a network of {found} inputs, this build knows the first {} fields of the observation or all {OBS}",
                observation::BASE
            ),
            Self::Memory(found) => write!(
                f,
                "the policy image holds a network with a memory of {found} channels, there is room for {MEMORY} or none"
            ),
            Self::Length { stated } => {
                write!(f, "the policy image says it is {stated} bytes long, layout version {VERSION} is {IMAGE_SIZE}")
            }
            Self::Checksum { stored, computed } => {
                write!(f, "the policy image is damaged: its CRC-32 should be {stored:08x} and is {computed:08x}")
            }
            Self::Task(found) => {
                write!(f, "the policy image is for task {found}, this build knows tasks 0 to {}", Task::ALL.len() - 1)
            }
            Self::Flag { field, found } => {
                write!(
                    f,
                    "the policy image has {found} in field `{field}`, which layout version {VERSION} does not define"
                )
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
const DIGEST_AT: usize = 64;
const MEMORY_AT: usize = 68;
const RESERVED_2_AT: usize = 69;
const MEAN_AT: usize = 72;
const GAIN_AT: usize = MEAN_AT + 4 * OBS;
const SOFTMAX_AT: usize = GAIN_AT + 4 * OBS;
const DISTANCE_AT: usize = SOFTMAX_AT + 8;
const LAYERS_AT: usize = DISTANCE_AT + 4 * DISTANCE_BUCKETS;
const CRC_AT: usize = Layer::Output.offset() + Layer::Output.size();

/// Bytes of an image.
pub const IMAGE_SIZE: usize = CRC_AT + 4;

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

fn check_input(mean: f32, gain: f32) -> Result<(), PolicyError> {
    if !(-1e6..=1e6).contains(&mean) {
        return Err(PolicyError::Value { field: "input mean", range: "-1000000 to 1000000" });
    }
    if !(0.0..=1e9).contains(&gain) {
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

/// Largest bias of a logit; logits have to lie within +-2^30.
const DISTANCE_BIAS_MAX: i32 = 1 << 29;

fn check_distance(bias: i32) -> Result<(), PolicyError> {
    if !(-DISTANCE_BIAS_MAX..=DISTANCE_BIAS_MAX).contains(&bias) {
        return Err(PolicyError::Value { field: "distance bias", range: "-536870912 to 536870912" });
    }
    Ok(())
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

    /// What is added to the logit of a module at this distance, in units of a logit: see [`distance_bucket`].
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

    /// Seals the image, or says which of its numbers [`Policy::parse`] would refuse.
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

/// Limits in the header of a [`random_image`].
const RANDOM_LIMITS: Limits =
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::MAX_MODULES;
    use proptest::prelude::*;
    use std::boxed::Box;
    use std::string::{String, ToString};
    use std::vec::Vec;

    fn random(seed: u32) -> Box<[u8; IMAGE_SIZE]> {
        let mut image = Box::new([0; IMAGE_SIZE]);
        random_image(seed, &mut image);
        image
    }

    /// Observations of eight modules, from integers alone.
    fn observations(seed: u32) -> [Observation; 8] {
        let mut state = seed.wrapping_mul(2_654_435_761) | 1;
        core::array::from_fn(|_| {
            let base: [f32; observation::BASE] = core::array::from_fn(|_| {
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                (state >> 16) as f32 / 16384.0 - 2.0
            });
            core::array::from_fn(|i| base.get(i).copied().unwrap_or(-base[i % observation::BASE]))
        })
    }

    fn encode_all(policy: &Policy, observations: &[Observation; 8]) -> ([Encoded; 8], [Latent; MAX_MODULES]) {
        let encoded = observations.each_ref().map(|o| policy.encode(&mut Memory::default(), o));
        let mut latents = [Latent::ZERO; MAX_MODULES];
        latents.iter_mut().zip(&encoded).for_each(|(to, from)| *to = from.latent);
        (encoded, latents)
    }

    #[test]
    fn a_written_image_reads_back() {
        let image = random(1);
        let policy = Policy::parse(&image[..]).unwrap();
        assert_eq!(policy.task(), Task::GoalReaching);
        assert_eq!(policy.geometry(), Geometry::default());
        assert_eq!(policy.limits(), RANDOM_LIMITS);
        assert_eq!((policy.control_period_us(), policy.relax_seconds()), (50_000, 0.25));
        assert_eq!(u32::from(policy.tag()), policy.crc() & 0xffff);
        assert_ne!(policy.tag(), Policy::parse(&random(2)[..]).unwrap().tag());

        let meta = Meta {
            task: Task::WallClimbing,
            goal_known_to: GoalKnownTo::Head,
            attention: false,
            trained_with_faults: true,
            geometry: Geometry { links_per_module: 3, link_length: 0.25 },
            limits: Limits { torque: 1.0, torque_slew: 2.0, joint_angle: 3.0, joint_speed: 4.0, temperature: 5.0 },
            control_period_us: 12_345,
            relax_seconds: 0.5,
            task_digest: 0x89ab_cdef,
        };
        let mut image = Box::new([0; IMAGE_SIZE]);
        let mut writer = ImageWriter::new(&meta, Shape::FULL, &mut image);
        writer.input(3, 1.5, 2.5);
        writer.shift(Layer::Output, 9);
        writer.row(Layer::Output, 1, -7, 77, &[-5; HIDDEN]);
        writer.row(Layer::Value, 31, 3, 99, &[6; EMBED]);
        writer.distance(12, -8);
        writer.finish().unwrap();
        let policy = Policy::parse(&image[..]).unwrap();
        assert_eq!((policy.meta(), policy.shape()), (meta, Shape::FULL));
        assert_eq!(policy.distance.unwrap()[11..], [[0; 4], (-8i32).to_le_bytes()]);
        assert!(policy.distance_bias());
        assert_eq!((f32::from_le_bytes(policy.mean[3]), f32::from_le_bytes(policy.gain[3])), (1.5, 2.5));
        assert_eq!((policy.output.shift, policy.output.weights[1]), (9, [0xfb; HIDDEN]));
        assert_eq!(policy.output.multipliers[1], (-7i32).to_le_bytes());
        assert_eq!(policy.output.bias.unwrap()[1], 77i32.to_le_bytes());
        let sixes = core::array::from_fn(|i| if i < EMBED { 6 } else { 0 });
        assert_eq!((policy.value.weights[31], policy.value.weights[30]), (sixes, [0; FEATURES]));
        assert!(policy.value.bias.is_none());
    }

    #[test]
    fn the_layout_is_the_documented_one() {
        assert_eq!(Layer::ALL.map(Layer::offset), [516, 4104, 5452, 6800, 9492, 15128, 17436]);
        assert_eq!((IMAGE_SIZE, MEAN_AT, SOFTMAX_AT, CRC_AT), (17588, 72, 456, 17584));
        assert_eq!(CRC_32.checksum(b"123456789"), 0xcbf4_3926);
        let document = include_str!("../policy-format.md");
        for layer in Layer::ALL {
            let (outputs, inputs, multipliers) = (layer.outputs(), layer.inputs(), layer.offset() + 4);
            let after = multipliers + 4 * outputs;
            let (biases, weights) =
                if layer.has_bias() { (after.to_string(), after + 4 * outputs) } else { ("-".into(), after) };
            let name = std::format!("{layer:?}").to_lowercase();
            let row = std::format!(
                "| {} | {name} | {outputs} x {inputs} | {multipliers} | {biases} | {weights} |",
                layer.offset()
            );
            assert!(document.contains(&row), "{row}");
        }
        for (at, field) in [
            (TASK_AT, "u8 | task"),
            (GOAL_KNOWN_TO_AT, "u8 | goal known to"),
            (LENGTH_AT, "u32 | length"),
            (DIMENSIONS_AT, "u16[6] | dimensions"),
            (ATTENTION_AT, "u8 | attention"),
            (FAULTS_AT, "u8 | trained with faults"),
            (LINKS_AT, "u8 | links per module"),
            (LINK_LENGTH_AT, "f32 | link length"),
            (LIMITS_AT, "f32 | torque limit"),
            (PERIOD_AT, "u32 | control period"),
            (RELAX_AT, "f32 | relaxation time"),
            (DIGEST_AT, "u32 | task digest"),
            (MEMORY_AT, "u8 | memory"),
            (RESERVED_2_AT, "u8[3] | reserved"),
            (MEAN_AT, "f32[48] | mean"),
            (GAIN_AT, "f32[48] | gain"),
            (SOFTMAX_AT, "i32 | softmax multiplier"),
            (DISTANCE_AT, "i32[13] | distance bias"),
            (CRC_AT, "u32 | checksum"),
        ] {
            assert!(document.contains(&std::format!("| {at} | {field} |")), "{field}");
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn every_damage_is_refused() {
        let mut image = random(3);
        for byte in 0..IMAGE_SIZE {
            // All bits of header and checksum; of the bulk between, one bit a byte.
            let all = !(LAYERS_AT..CRC_AT).contains(&byte);
            for bit in (0..8).filter(|bit| all || byte % 8 == *bit) {
                image[byte] ^= 1 << bit;
                assert!(Policy::parse(&image[..]).is_err(), "byte {byte} bit {bit}");
                image[byte] ^= 1 << bit;
            }
        }
        for length in 0..IMAGE_SIZE {
            assert_eq!(Policy::parse(&image[..length]).unwrap_err(), PolicyError::TooShort { length });
        }
        assert!(Policy::parse(&image[..]).is_ok());
    }

    #[test]
    fn each_reason_is_one_clear_sentence() {
        let said = |at: usize, bytes: &[u8]| -> String {
            let mut image = random(4);
            image[at..at + bytes.len()].copy_from_slice(bytes);
            seal(&mut image);
            Policy::parse(&image[..]).unwrap_err().to_string()
        };
        assert_eq!(said(0, b"ELF"), "this is not a policy image: it does not begin with COMPOSER");
        assert_eq!(
            said(VERSION_AT, &[3]),
            "the policy image has layout version 3, this build reads version 4: export the policy again"
        );
        assert!(said(DIMENSIONS_AT + 2, &[128]).contains("dimensions [128, 16, 32, 64, 2], this build runs [64, 16"));
        assert_eq!(
            said(DIMENSIONS_AT, &[41]),
            "the policy image holds a network of 41 inputs, this build knows the first 40 fields of the observation or all 48"
        );
        assert_eq!(
            said(MEMORY_AT, &[32]),
            "the policy image holds a network with a memory of 32 channels, there is room for 16 or none"
        );
        assert_eq!(said(LENGTH_AT, &[0, 0]), "the policy image says it is 0 bytes long, layout version 4 is 17588");
        assert_eq!(said(TASK_AT, &[5]), "the policy image is for task 5, this build knows tasks 0 to 4");
        assert!(said(GOAL_KNOWN_TO_AT, &[2]).contains("2 in field `goal known to`"));
        assert!(said(ATTENTION_AT, &[2]).contains("`attention`"));
        assert!(said(FAULTS_AT, &[2]).contains("`trained with faults`"));
        assert!(said(RESERVED_AT, &[1]).contains("`reserved`"));
        assert!(said(RESERVED_2_AT + 2, &[1]).contains("`reserved`"));
        let (nan, infinite) = (f32::NAN.to_le_bytes(), f32::INFINITY.to_le_bytes());
        assert!(said(LINKS_AT, &[5]).contains("links per module that is not a number from 2 to 4"));
        for (at, field) in [
            (LINK_LENGTH_AT, "link length"),
            (LIMITS_AT, "torque limit"),
            (LIMITS_AT + 4, "torque slew limit"),
            (LIMITS_AT + 8, "joint angle limit"),
            (LIMITS_AT + 12, "joint speed limit"),
            (LIMITS_AT + 16, "temperature limit"),
            (RELAX_AT, "relaxation time"),
            (MEAN_AT + 4 * 47, "input mean"),
            (GAIN_AT + 4 * 47, "input gain"),
        ] {
            assert!(said(at, &nan).contains(field) && said(at, &infinite).contains(field), "{field}");
        }
        assert!(said(PERIOD_AT, &[0; 4]).contains("control period that is not a number from 1000 to"));
        assert!(said(SOFTMAX_AT + 3, &[0x80]).contains("softmax multiplier"));
        assert!(said(SOFTMAX_AT + 4, &[0]).contains("shift that is not a number from 1 to 62"));
        assert!(said(DISTANCE_AT + 4 * 12 + 3, &[0x40]).contains("distance bias that is not a number from -536870912"));
        assert!(said(Layer::Context.offset(), &[63]).contains("shift"));

        let mut image = random(4);
        image[5000] ^= 4;
        assert!(
            Policy::parse(&image[..]).unwrap_err().to_string().starts_with("the policy image is damaged: its CRC-32")
        );
        let cut = Policy::parse(&image[..9000]).unwrap_err().to_string();
        assert_eq!(cut, "the policy image is cut short: it has 9000 bytes where 17588 are needed");
        let long: Vec<u8> = image.iter().copied().chain([0]).collect();
        assert!(Policy::parse(&long).unwrap_err().to_string().contains("too long"));
    }

    #[test]
    fn the_writer_refuses_what_the_reader_would() {
        let mut image = Box::new([0; IMAGE_SIZE]);
        let good = Policy::parse(&random(1)[..]).unwrap().meta();
        let relax = Meta { relax_seconds: -1.0, ..good };
        assert!(ImageWriter::new(&relax, Shape::BASE, &mut image).finish().is_err());
        let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
        writer.input(0, f32::NAN, 1.0);
        writer.input(1, 0.0, 1.0);
        assert!(writer.finish().is_err());
        assert!(Policy::parse(&image[..]).is_err());
        let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
        writer.softmax(-1, 5);
        assert!(writer.finish().is_err());
        let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
        writer.shift(Layer::Key, 0);
        assert!(writer.finish().is_err());
        let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
        writer.distance(0, i32::MIN);
        assert!(writer.finish().is_err());
        assert!(ImageWriter::new(&good, Shape { inputs: 44, ..Shape::BASE }, &mut image).finish().is_err());
        assert!(ImageWriter::new(&good, Shape { memory: 8, ..Shape::BASE }, &mut image).finish().is_err());
        // What does not exist is ignored.
        let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
        writer.input(OBS, f32::NAN, 0.0);
        writer.distance(DISTANCE_BUCKETS, i32::MIN);
        writer.row(Layer::Output, OUT, 1, 1, &[1; 200]);
        writer.finish().unwrap();
        assert!(Policy::parse(&image[..]).is_ok());
    }

    #[test]
    fn every_point_that_a_module_observes_is_told() {
        for task in Task::ALL {
            for modules in [1, 2, 8, MAX_MODULES as u8] {
                assert!(usize::from(task.points(modules)) <= crate::wire::GOAL_POINTS);
                let mut seen = 0u64;
                for module in 0..modules {
                    let observed = task.observed(module, modules);
                    assert!(observed[0].is_some());
                    for point in observed.into_iter().flatten() {
                        assert!(point < task.points(modules), "{task} {module} of {modules}");
                        seen |= 1 << point;
                    }
                }
                assert_eq!(seen.count_ones(), u32::from(task.points(modules)), "{task}");
            }
        }
    }

    #[test]
    fn names_round_trip() {
        for task in Task::ALL {
            assert_eq!(Task::from_name(task.name()), Some(task));
        }
        assert_eq!((Task::from_name("dancing"), GoalKnownTo::from_name("head")), (None, Some(GoalKnownTo::Head)));
        assert_eq!((GoalKnownTo::from_name("tail"), GoalKnownTo::All.to_string().as_str()), (None, "all"));
    }

    /// Pins the bits: other targets run the same test, and a kernel that is made faster must still pass it.
    #[test]
    fn the_bits_are_pinned() {
        let image = random(7);
        let policy = Policy::parse(&image[..]).unwrap();
        let (encoded, latents) = encode_all(&policy, &observations(7));
        let mut digest = CRC_32.digest();
        for (i, own) in encoded.iter().enumerate() {
            own.latent.key.iter().chain(&own.latent.value).for_each(|x| digest.update(&x.to_le_bytes()));
            let mut attention = [0; MAX_MODULES];
            let action = policy.act(own, &latents, 0xdb, Some(&mut attention), i);
            attention.iter().for_each(|x| digest.update(&x.to_le_bytes()));
            action.iter().for_each(|x| digest.update(&x.to_bits().to_le_bytes()));
        }
        assert_eq!((policy.crc(), digest.finalize()), (2_477_611_875, 3_900_035_348));
    }

    /// The same for memory, bias and the whole observation.
    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn the_bits_of_a_memory_are_pinned() {
        let mut image = Box::new([0; IMAGE_SIZE]);
        random_image_of(Shape::FULL, 7, &mut image);
        let policy = Policy::parse(&image[..]).unwrap();
        let (mut memories, mut digest) = ([Memory::EMPTY; 8], CRC_32.digest());
        for step in 0..20 {
            let mut latents = [Latent::ZERO; MAX_MODULES];
            let observations = observations(7 + step);
            let encoded: [Encoded; 8] = core::array::from_fn(|i| policy.encode(&mut memories[i], &observations[i]));
            latents.iter_mut().zip(&encoded).for_each(|(to, from)| *to = from.latent);
            for (i, own) in encoded.iter().enumerate() {
                let action = policy.act(own, &latents, 0xff, None, i);
                action.iter().for_each(|x| digest.update(&x.to_bits().to_le_bytes()));
            }
        }
        assert_eq!((policy.crc(), digest.finalize()), (1_128_826_676, 3_867_806_610));
    }

    #[test]
    fn buckets_of_distance_are_the_documented_ones() {
        let away = [0, 1, 2, 3, 4, 5, 8, 9, 16, 17, 63];
        assert_eq!(away.map(|j| distance_bucket(0, j)), [6, 7, 8, 9, 9, 10, 10, 11, 11, 12, 12]);
        assert_eq!(away.map(|j| distance_bucket(j, 0)), [6, 5, 4, 3, 3, 2, 2, 1, 1, 0, 0]);
        assert_eq!((distance_bucket(40, 37), distance_bucket(20, 21)), (3, 7));
    }

    /// A bias of the size of the logits' range decides alone whom a module attends to.
    #[test]
    fn a_bias_by_distance_turns_the_attention() {
        let mut image = random(7);
        let bias = DISTANCE_AT + 4 * distance_bucket(5, 3);
        image[bias..bias + 4].copy_from_slice(&DISTANCE_BIAS_MAX.to_le_bytes());
        seal(&mut image);
        let policy = Policy::parse(&image[..]).unwrap();
        assert!(policy.distance_bias() && !Policy::parse(&random(7)[..]).unwrap().distance_bias());
        let (encoded, latents) = encode_all(&policy, &observations(3));
        let mut attention = [0; MAX_MODULES];
        policy.act(&encoded[5], &latents, 0xff, Some(&mut attention), 5);
        assert!(attention[3] > 32000, "{attention:?}");
        // Modules 4 and 3 lie towards the head of module 6 at the same distance as bucket 4 and 3.
        policy.act(&encoded[4], &latents, 0b1000_0000, Some(&mut attention), 4);
        assert!(attention[4] > 0 && attention[7] > 0, "nobody is two ahead: {attention:?}");
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn a_memory_leaks_without_stalling_and_starts_empty() {
        for now in [nn::ONE, -nn::ONE, 1, -1, 12_345] {
            let mut memory = Memory::default();
            let embedding = [now; EMBED];
            let mut exact = [0.0f64; MEMORY];
            for step in 0..400 {
                memory.update(&embedding);
                for (channel, (mean, got)) in exact.iter_mut().zip(memory.activations()).enumerate() {
                    *mean += (f64::from(now) - *mean) / f64::from(1 << leak(channel));
                    assert!(
                        (*mean - f64::from(got)).abs() < 0.51,
                        "{now}, step {step}, channel {channel}: {mean} {got}"
                    );
                }
            }
            assert_eq!(memory.activations(), [now; MEMORY]);
        }
        assert_eq!(Memory::default().activations(), [0; MEMORY]);
    }

    #[test]
    fn a_memory_is_the_modules_own_and_only_where_the_network_has_one() {
        let (base, mut full) = (random(5), Box::new([0; IMAGE_SIZE]));
        random_image_of(Shape::FULL, 5, &mut full);
        let (base, full) = (Policy::parse(&base[..]).unwrap(), Policy::parse(&full[..]).unwrap());
        let [first, second, ..] = observations(5);
        let mut memory = Memory::default();
        let fresh = base.encode(&mut memory, &first);
        assert_eq!((memory, base.encode(&mut memory, &first)), (Memory::EMPTY, fresh));
        // Fields behind those it takes do not count.
        let mut other = first;
        other[observation::BASE..].fill(9.0);
        assert_eq!(base.encode(&mut memory, &other), fresh);
        let fresh = full.encode(&mut Memory::default(), &first);
        assert_ne!(full.encode(&mut Memory::default(), &other), fresh);
        full.encode(&mut memory, &second);
        assert_ne!(full.encode(&mut memory, &first), fresh, "what was seen before counts");
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn random_policies_are_alive() {
        let mut largest = 0.0f32;
        for seed in 0..20 {
            let image = random(seed);
            let policy = Policy::parse(&image[..]).unwrap();
            let (encoded, latents) = encode_all(&policy, &observations(seed));
            let actions = core::array::from_fn::<_, 8, _>(|i| policy.act(&encoded[i], &latents, 0xff, None, i));
            assert!(actions.iter().any(|a| *a != actions[0]));
            let saturated = encoded.iter().flat_map(|e| e.features).filter(|e| e.abs() == nn::ONE).count();
            assert!(saturated < 50, "{saturated} of 512");
            let mut attention = [0; MAX_MODULES];
            policy.act(&encoded[0], &latents, 0xff, Some(&mut attention), 0);
            largest = actions.as_flattened().iter().fold(largest, |m, a| m.max(a.abs()));
            assert!(attention[..8].iter().max() > attention[..8].iter().min());
        }
        assert!(largest > 0.3, "{largest}");
    }

    #[test]
    fn nonsense_in_an_observation_becomes_something_finite() {
        let image = random(8);
        let policy = Policy::parse(&image[..]).unwrap();
        let nan = policy.encode(&mut Memory::default(), &[f32::NAN; OBS]);
        assert_eq!(nan, policy.encode(&mut Memory::default(), &[0.0; OBS]), "the means are 0");
        let encode = |x| policy.encode(&mut Memory::default(), &[x; OBS]);
        assert_eq!(encode(f32::INFINITY), encode(5.0));
        assert_eq!(encode(f32::NEG_INFINITY), encode(-1e9));
        let action = policy.act(&nan, &[Latent::ZERO; MAX_MODULES], u64::MAX, None, usize::MAX);
        assert!(action.iter().all(|a| a.is_finite()));
    }

    #[test]
    fn without_attention_the_others_do_not_matter() {
        let mut image = random(9);
        image[ATTENTION_AT] = 0;
        seal(&mut image);
        let policy = Policy::parse(&image[..]).unwrap();
        let (encoded, latents) = encode_all(&policy, &observations(9));
        assert_eq!(encoded[0].latent, Latent::ZERO);
        let mut attention = [1; MAX_MODULES];
        let action = policy.act(&encoded[2], &latents, 0xff, Some(&mut attention), 2);
        assert_eq!(action, policy.act(&encoded[2], &[Latent { key: [9; 16], value: [9; 32] }; 64], 0, None, 2));
        assert_eq!(attention, core::array::from_fn(|j| if j == 2 { 32767 } else { 0 }));
    }

    fn latents() -> impl Strategy<Value = [Latent; MAX_MODULES]> {
        any::<u64>().prop_map(|seed| {
            let mut state = seed;
            let mut next = move || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 56) as i8
            };
            core::array::from_fn(|_| Latent {
                key: core::array::from_fn(|_| next()),
                value: core::array::from_fn(|_| next()),
            })
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn parsing_never_panics(bytes in proptest::collection::vec(any::<u8>(), 0..400), keep in 0usize..200) {
            prop_assert!(Policy::parse(&bytes).is_err());
            let mut image = random(1);
            let end = (keep + bytes.len()).min(IMAGE_SIZE);
            image[keep..end].copy_from_slice(&bytes[..end - keep]);
            let _ = Policy::parse(&image[..]);
        }

        /// Whatever numbers an image holds: if it is accepted, it runs (overflow traps in debug builds).
        #[test]
        fn an_accepted_image_never_panics(seed in any::<u64>(), others in latents(), heard in any::<u64>()) {
            let mut image = random(1);
            let mut state = seed | 1;
            for at in SOFTMAX_AT..CRC_AT {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                image[at] = if seed % 3 == 0 { [0x80, 0x7f][(state & 1) as usize] } else { state as u8 };
            }
            image[SOFTMAX_AT + 3] &= 0x7f;
            for bucket in 0..DISTANCE_BUCKETS {
                image[DISTANCE_AT + 4 * bucket + 3] = [0x1f, 0xe0][bucket % 2];
            }
            image[MEMORY_AT] = [0, MEMORY as u8][seed as usize % 2];
            for at in Layer::ALL.map(Layer::offset).into_iter().chain([SOFTMAX_AT + 4]) {
                state = state.rotate_left(17).wrapping_mul(5);
                let shift = 1 + (state % 62) as u32;
                image[at..at + 4].copy_from_slice(&shift.to_le_bytes());
            }
            seal(&mut image);
            let policy = Policy::parse(&image[..]).unwrap();
            let mut memory = Memory::default();
            for observation in observations(seed as u32) {
                let own = policy.encode(&mut memory, &observation);
                let action = policy.act(&own, &others, heard, None, seed as usize % 70);
                prop_assert!(action.iter().all(|a| a.abs() <= 1.0));
            }
        }

        #[test]
        fn neighbours_have_no_order_and_the_masked_no_say(
            seed in 0u32..50, mut others in latents(), heard in any::<u64>(), own_index in 0usize..64, turn in 1u32..64,
        ) {
            let image = random(seed);
            let policy = Policy::parse(&image[..]).unwrap();
            let own = policy.encode(&mut Memory::default(), &observations(seed)[0]);
            let mut attention = [7; MAX_MODULES];
            let action = policy.act(&own, &others, heard, Some(&mut attention), own_index);
            prop_assert_eq!(policy.act(&own, &others, heard, None, own_index), action);

            let mask = heard | 1 << own_index;
            let total: i32 = attention.iter().map(|w| i32::from(*w)).sum();
            prop_assert!((total - 32767).abs() <= 32, "{}", total);
            prop_assert!((0..64).all(|j| mask >> j & 1 == 1 || attention[j] == 0));

            // Everybody moves to another slot.
            let mut turned = others;
            turned.rotate_right(turn as usize);
            let moved = (own_index + turn as usize) % 64;
            prop_assert_eq!(policy.act(&own, &turned, heard.rotate_left(turn), None, moved), action);

            // Who is not heard, and what lies in the own slot, does not count.
            for (j, latent) in others.iter_mut().enumerate() {
                if j == own_index || mask >> j & 1 == 0 {
                    *latent = Latent { key: [127; KEY], value: [-128; VALUE] };
                }
            }
            prop_assert_eq!(policy.act(&own, &others, heard, None, own_index), action);
            prop_assert_eq!(policy.act(&own, &others, mask, None, own_index), action);
            let alone = policy.act(&own, &others, 0, None, own_index);
            prop_assert_eq!(policy.act(&own, &others, 1 << own_index, None, own_index), alone);
        }
    }
}
