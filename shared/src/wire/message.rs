//! The messages, one struct a frame.

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{Frame, Function, STATION, ServiceRequest, ServiceResponse, StopCount, WireError};
use crate::robot::{AXES, MAX_JOINTS, MAX_MODULES};
use crate::update::{CHUNKS_MAX, Chunk, ChunkRepr, PIECES};

/// One step of a joint angle in STATE, rad.
pub const ANGLE_LSB: f32 = core::f32::consts::PI / 2048.0;
/// One step of a coordinate in GOAL, robot units.
pub const GOAL_LSB: f32 = 1.0 / 256.0;
/// Bytes of a latent message without padding.
pub const LATENT_SIZE: usize = 52;
/// Classic frames that carry one latent message.
pub const FRAGMENTS: usize = LATENT_SIZE.div_ceil(FRAGMENT_BYTES);
/// Latent bytes in a fragment.
const FRAGMENT_BYTES: usize = 7;
/// Stands where a module number is expected and there is none.
pub const NOBODY: u8 = 0xff;

/// The joint angle (rad) that the neighbours read when a module publishes `angle`: rounded to [`ANGLE_LSB`], held within
/// -pi and pi - LSB. What is not a number reads as zero.
pub fn quantise_angle(angle: f32) -> f32 {
    f32::from(angle_steps(angle)) * ANGLE_LSB
}

fn angle_steps(angle: f32) -> i16 {
    // `as` turns a NaN into zero.
    libm::roundf((angle / ANGLE_LSB).clamp(-2048.0, 2047.0)) as i16
}

/// How a module is, in one byte: four flags, and the count of the last stop or release that it knows of ([`StopCount`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Health(pub u8);

impl Health {
    /// Bit 0: the module's sensors read something that can be true. If not, its angles and its latent are to be ignored.
    pub const SENSORS_PLAUSIBLE: Health = Health(1);
    /// Bit 1: its yaw motor does not give the torque that it is told.
    pub const YAW_DEAD: Health = Health(2);
    /// Bit 2: its emergency stop is latched.
    pub const EMERGENCY_STOP: Health = Health(4);
    /// Bit 3: its pitch motor does not give the torque that it is told.
    pub const PITCH_DEAD: Health = Health(8);

    /// Both.
    #[must_use]
    pub const fn with(self, other: Health) -> Health {
        Health(self.0 | other.0)
    }

    /// Whether all bits of `other` are set.
    pub const fn has(self, other: Health) -> bool {
        self.0 & other.0 == other.0
    }

    /// Whether the sensors are plausible, see [`Health::SENSORS_PLAUSIBLE`].
    pub const fn sensors_plausible(self) -> bool {
        self.has(Health::SENSORS_PLAUSIBLE)
    }

    /// Which motors work, yaw and pitch, see [`Health::YAW_DEAD`] and [`Health::PITCH_DEAD`].
    pub const fn motors_work(self) -> [bool; AXES] {
        [!self.has(Health::YAW_DEAD), !self.has(Health::PITCH_DEAD)]
    }

    /// The same with the stop count in bits 4 to 7.
    #[must_use]
    pub const fn with_stop_count(self, count: StopCount) -> Health {
        Health(self.0 & 0x0f | count.number() << 4)
    }

    /// The stop or release that it knows of: bits 4 to 7.
    pub const fn stop_count(self) -> StopCount {
        StopCount::new(self.0 >> 4)
    }
}

/// What an EMERGENCY_STOP frame asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StopCommand {
    /// Relax all motors and stay so.
    Stop = 1,
    /// The stop, and every other latch that a release clears, is over. Only the station may say so.
    Release = 2,
}

/// EMERGENCY_STOP: stops every module that hears it; latched until released.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EmergencyStop {
    /// 1 stop, 2 release ([`StopCommand`]).
    command: u8,
    /// The number of the fault that made the sender stop; 0: somebody asked for it.
    pub reason: u8,
    /// Which stop or release of this robot it is.
    counter: u8,
}

impl EmergencyStop {
    /// Stop number `count`, or release number `count`.
    pub const fn new(command: StopCommand, reason: u8, count: StopCount) -> Self {
        EmergencyStop { command: command as u8, reason, counter: count.number() }
    }

    /// What it asks for.
    pub const fn command(&self) -> StopCommand {
        if self.command == StopCommand::Release as u8 { StopCommand::Release } else { StopCommand::Stop }
    }

    /// Which stop or release it is; [`StopCount::UNKNOWN`]: the sender does not know, and means the next one.
    pub const fn count(&self) -> StopCount {
        StopCount::new(self.counter)
    }
}

/// SYNC: the time-keeper starts a control cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sync {
    /// Number of the cycle, wrapping. The other frames of this cycle carry its lower 8 bits.
    #[serde(with = "postcard::fixint::le")]
    pub cycle: u16,
    /// Modules that the time-keeper believes alive, itself included.
    pub alive: u8,
    /// Modules that the time-keeper believes the robot to have, plugged in or not.
    pub modules: u8,
}

impl Sync {
    /// The start of a cycle.
    pub const fn new(cycle: u16, alive: u8, modules: u8) -> Self {
        Sync { cycle, alive, modules }
    }
}

/// Points that GOAL frames can tell in one cycle.
pub const GOAL_POINTS: usize = 128;

/// GOAL: where the goal is, or another point of the scene, in the frame of the head link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Goal {
    /// Lower 8 bits of the cycle it belongs to.
    pub cycle: u8,
    /// Bit 0: the point is known. Bits 1 to 7: which point it is.
    flags: u8,
    /// Position in the frame of the head link, in steps of [`GOAL_LSB`].
    #[serde(with = "le_i16_3")]
    steps: [i16; 3],
}

impl Goal {
    /// Point number `point` (its lower 7 bits; [`crate::policy::Task::observed`] says what they mean, 0 is the goal) at `position`
    /// (robot units, frame of the head link), or not known. Held within +-128 units; a position that is not finite is not known.
    pub fn new(cycle: u8, point: u8, position: Option<[f32; 3]>) -> Self {
        let which = point << 1;
        match position.filter(|p| p.iter().all(|x| x.is_finite())) {
            // `as` saturates.
            Some(p) => Goal { cycle, flags: which | 1, steps: p.map(|x| libm::roundf(x / GOAL_LSB) as i16) },
            None => Goal { cycle, flags: which, steps: [0; 3] },
        }
    }

    /// Which point of the scene it is.
    pub const fn point(&self) -> u8 {
        self.flags >> 1
    }

    /// Where it is (robot units, frame of the head link), if that is known.
    pub fn position(&self) -> Option<[f32; 3]> {
        (self.flags & 1 != 0).then(|| self.steps.map(|s| f32::from(s) * GOAL_LSB))
    }
}

/// STATE: the joint angles of a module at the start of a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// Lower 8 bits of the cycle.
    pub cycle: u8,
    /// How the module is.
    pub health: Health,
    /// Four signed 12-bit angles in steps of [`ANGLE_LSB`], least significant bit first, joint 0 first.
    angles: [u8; 6],
}

impl State {
    /// The state of a module with these joint angles (rad), rounded as [`quantise_angle`] does.
    pub fn new(cycle: u8, health: Health, angles: &[f32; MAX_JOINTS]) -> Self {
        let [a, b, c, d] = angles.map(|angle| angle_steps(angle) as u16 & 0xfff);
        let pair = |low: u16, high: u16| [low as u8, (low >> 8 | high << 4) as u8, (high >> 4) as u8];
        let ([p, q, r], [s, t, u]) = (pair(a, b), pair(c, d));
        State { cycle, health, angles: [p, q, r, s, t, u] }
    }

    /// The joint angles, rad.
    pub fn angles(&self) -> [f32; MAX_JOINTS] {
        let [p, q, r, s, t, u] = self.angles.map(u16::from);
        // Shifted up to the sign bit and back down.
        let angle = |bits: u16| f32::from((bits << 4) as i16 >> 4) * ANGLE_LSB;
        [angle(p | q << 8), angle(q >> 4 | r << 4), angle(s | t << 8), angle(t >> 4 | u << 4)]
    }
}

/// LATENT: the key and value of a module, for its neighbours to attend over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LatentMessage {
    /// Lower 8 bits of the cycle.
    pub cycle: u8,
    /// How the module is.
    pub health: Health,
    /// Tag of the policy that made it; a latent of another policy means nothing.
    #[serde(with = "postcard::fixint::le")]
    pub policy: u16,
    /// The key.
    pub key: [i8; 16],
    /// The value.
    pub value: [i8; 32],
}

impl LatentMessage {
    /// The message in pieces, for a classic bus.
    pub fn fragments(&self) -> [Fragment; FRAGMENTS] {
        let bytes = encode::<_, { FRAGMENTS * FRAGMENT_BYTES }>(self);
        let mut index = 0;
        [(); FRAGMENTS].map(|()| {
            let mut data = [0; FRAGMENT_BYTES];
            for (to, from) in data.iter_mut().zip(bytes.iter().skip(index * FRAGMENT_BYTES)) {
                *to = *from;
            }
            let fragment = Fragment::new(index as u8, self.cycle, data);
            index += 1;
            fragment
        })
    }

    /// The message from the joined data of its [`FRAGMENTS`] fragments; the error names [`Function::LatentFragment`].
    pub fn from_fragments(data: &[[u8; 7]; FRAGMENTS]) -> Result<Self, WireError> {
        let bytes = data.as_flattened();
        let function = Function::LatentFragment;
        let (body, padding) = bytes.split_at_checked(LATENT_SIZE).ok_or(WireError::ReservedBits(function))?;
        if padding.iter().any(|b| *b != 0) {
            return Err(WireError::ReservedBits(function));
        }
        decode(function, body)
    }
}

/// LATENT_FRAGMENT: seven bytes of a LATENT.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fragment {
    /// Bit 7 zero, bits 4 to 6 index, bits 0 to 3 the lower 4 bits of the cycle.
    header: u8,
    /// Bytes `7 * index ..` of the LATENT payload; zero beyond its end.
    pub data: [u8; 7],
}

impl Fragment {
    /// Piece number `index` (0 to 7) of the latent of `cycle`.
    pub const fn new(index: u8, cycle: u8, data: [u8; 7]) -> Self {
        Fragment { header: (index & 7) << 4 | (cycle & 15), data }
    }

    /// Which piece it is, 0 to 7.
    pub const fn index(&self) -> u8 {
        (self.header >> 4) & 7
    }

    /// The lower 4 bits of the cycle.
    pub const fn cycle4(&self) -> u8 {
        self.header & 15
    }
}

/// TELEMETRY: what a module is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Torque commanded, yaw and pitch, 1/127 of the limit.
    pub torque: [i8; AXES],
    /// Motor temperature, degrees Celsius, held within -128 and 127.
    pub temperature: i8,
    /// What holds the torque back ([`super::LimitedBy`]).
    pub limited_by: u8,
    /// Modules attended over in the last cycle, the own one included.
    pub heard: u8,
    /// Cycles in which a live neighbour's latent was missing at the deadline, wrapping.
    pub deadline_misses: u8,
    /// The other module that this one attends to most, or [`NOBODY`].
    pub attends_to: u8,
    /// With which weight, 1/255.
    pub attention: u8,
}

/// What a module is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Mode {
    /// Listening; no cycle has started since power-up.
    Boot = 0,
    /// Taking part in the control cycle, motors on.
    Active = 1,
    /// Armed and taking part, motors relaxed (see the fault).
    Relaxed = 2,
    /// Hears nobody, acts alone for a while.
    Alone = 3,
    /// Taking part, motors relaxed until the station arms the module.
    Disarmed = 4,
    /// An emergency stop is latched: motors relaxed, and not to be armed before a release.
    Stopped = 5,
    /// Disarmed, and one axis moves as the station asks for it.
    Service = 6,
}

impl Mode {
    /// All of them.
    pub const ALL: [Mode; 7] =
        [Mode::Boot, Mode::Active, Mode::Relaxed, Mode::Alone, Mode::Disarmed, Mode::Stopped, Mode::Service];

    /// The mode with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|mode| *mode as u8 == number)
    }

    /// Its name, in lower case.
    pub const fn name(self) -> &'static str {
        match self {
            Mode::Boot => "boot",
            Mode::Active => "active",
            Mode::Relaxed => "relaxed",
            Mode::Alone => "alone",
            Mode::Disarmed => "disarmed",
            Mode::Stopped => "stopped",
            Mode::Service => "service",
        }
    }
}

/// HEARTBEAT: how a module is, also when its motors are relaxed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Heartbeat {
    /// What the module is at ([`Mode`], bits 0 to 3), and what it says of its policy (bits 4 to 7, [`Heartbeat::LAB`] and [`Heartbeat::TRIAL`]).
    pub mode: u8,
    /// The most serious active fault (lowest number of [`super::Fault`]), or 0.
    pub fault: u8,
    /// How it is.
    pub health: Health,
    /// Whose SYNC it follows, or [`NOBODY`].
    pub time_keeper: u8,
    /// [`super::PROTOCOL_VERSION`].
    pub protocol: u8,
    /// Version of the firmware: major in the upper, minor in the lower 4 bits.
    pub firmware: u8,
    /// Tag of its policy.
    #[serde(with = "postcard::fixint::le")]
    pub policy: u16,
}

impl Heartbeat {
    /// In [`Heartbeat::mode`]: the module has no key and takes policies that are not signed.
    pub const LAB: u8 = 1 << 4;
    /// In [`Heartbeat::mode`]: its policy is on trial.
    pub const TRIAL: u8 = 1 << 5;

    /// What the module is at.
    pub fn mode(&self) -> Option<Mode> {
        Mode::from_number(self.mode & 15)
    }

    /// Whether it has no key and takes policies that are not signed.
    pub const fn lab(&self) -> bool {
        self.mode & Heartbeat::LAB != 0
    }

    /// Whether its policy is on trial.
    pub const fn on_trial(&self) -> bool {
        self.mode & Heartbeat::TRIAL != 0
    }
}

/// UPDATE_PIECE: a ninth of an UPDATE_CHUNK, see [`crate::update::Assembly`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Piece(pub [u8; 8]);

/// Every message there is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(clippy::large_enum_variant)] // No heap to box the large one on.
pub enum Message {
    /// Stop or release.
    EmergencyStop(EmergencyStop),
    /// A cycle starts.
    Sync(Sync),
    /// Where the goal is.
    Goal(Goal),
    /// Joint angles.
    State(State),
    /// A latent, whole.
    Latent(LatentMessage),
    /// A piece of a latent.
    LatentFragment(Fragment),
    /// The station asks for something.
    ServiceRequest(ServiceRequest),
    /// A module answers.
    ServiceResponse(ServiceResponse),
    /// What a module is doing.
    Telemetry(Telemetry),
    /// How a module is.
    Heartbeat(Heartbeat),
    /// A piece of a new policy.
    UpdateChunk(ChunkRepr),
    /// A ninth of it.
    UpdatePiece(Piece),
}

impl Message {
    /// Which function carries it.
    pub fn function(&self) -> Function {
        match self {
            Message::EmergencyStop(_) => Function::EmergencyStop,
            Message::Sync(_) => Function::Sync,
            Message::Goal(_) => Function::Goal,
            Message::State(_) => Function::State,
            Message::Latent(_) => Function::Latent,
            Message::LatentFragment(_) => Function::LatentFragment,
            Message::ServiceRequest(_) => Function::ServiceRequest,
            Message::ServiceResponse(_) => Function::ServiceResponse,
            Message::Telemetry(_) => Function::Telemetry,
            Message::Heartbeat(_) => Function::Heartbeat,
            Message::UpdateChunk(_) => Function::UpdateChunk,
            Message::UpdatePiece(_) => Function::UpdatePiece,
        }
    }

    /// The frame in which `module` (or the station) says this, classic or FD with bit-rate switch. A LATENT and an UPDATE_CHUNK need FD
    /// and are always FD frames; on a classic bus send [`LatentMessage::fragments`] and [`ChunkRepr::pieces`].
    pub fn emit(&self, module: u8, fd: bool) -> Frame {
        let mut data = [0; 64];
        let size = match self {
            Message::EmergencyStop(m) => encode_into(m, &mut data),
            Message::Sync(m) => encode_into(m, &mut data),
            Message::Goal(m) => encode_into(m, &mut data),
            Message::State(m) => encode_into(m, &mut data),
            Message::Latent(m) => encode_into(m, &mut data),
            Message::LatentFragment(m) => encode_into(m, &mut data),
            Message::ServiceRequest(m) => encode_into(m, &mut data),
            Message::ServiceResponse(m) => encode_into(m, &mut data),
            Message::Telemetry(m) => encode_into(m, &mut data),
            Message::Heartbeat(m) => encode_into(m, &mut data),
            Message::UpdateChunk(m) => {
                let bytes = m.emit();
                data.iter_mut().zip(bytes).for_each(|(to, from)| *to = from);
                bytes.len()
            }
            Message::UpdatePiece(m) => encode_into(m, &mut data),
        };
        let function = self.function();
        let fd = fd || matches!(function, Function::Latent | Function::UpdateChunk);
        let len = Frame::padded_len(size, fd).unwrap_or(8);
        Frame { id: function.id(module), fd, brs: fd, len, data }
    }

    /// Reads a frame. Strict: identifier, sender, length, reserved bits, padding and enumerated values must all be right.
    /// Short messages may come as classic or as FD frames.
    pub fn parse(frame: &Frame) -> Result<Self, WireError> {
        if frame.id >= 1 << 11 {
            return Err(WireError::Identifier(frame.id));
        }
        let function = frame.function().ok_or(WireError::UnknownFunction((frame.id >> 7) as u8))?;
        let module = frame.module();
        if usize::from(module) >= MAX_MODULES && module != STATION {
            return Err(WireError::UnknownModule(module));
        }
        let layout = super::layout::of(function);
        if !layout.senders.may_send(module) {
            return Err(WireError::WrongSender { function, module });
        }
        let expected = layout.wire_len();
        if frame.len != expected {
            return Err(WireError::WrongLength { function, got: frame.len, expected });
        }
        let (body, padding) = frame.payload().split_at_checked(layout.size).unwrap_or((frame.payload(), &[]));
        if padding.iter().any(|b| *b != 0) {
            return Err(WireError::ReservedBits(function));
        }
        let reserved = |set: u8| if set == 0 { Ok(()) } else { Err(WireError::ReservedBits(function)) };
        let wrong = |field, value| Err(WireError::WrongValue { function, field, value });
        let module_or_none = |field, value: u8| {
            let possible = usize::from(value) < MAX_MODULES || value == NOBODY;
            if possible { Ok(()) } else { Err(WireError::WrongValue { function, field, value }) }
        };
        Ok(match function {
            Function::EmergencyStop => {
                let m: EmergencyStop = decode(function, body)?;
                match m.command {
                    1 => {}
                    2 if module == STATION => {}
                    2 => return Err(WireError::WrongSender { function, module }),
                    value => return wrong("command", value),
                }
                if m.counter > StopCount::LAST {
                    return wrong("counter", m.counter);
                }
                Message::EmergencyStop(m)
            }
            Function::Sync => {
                let m: Sync = decode(function, body)?;
                if m.modules == 0 || usize::from(m.modules) > MAX_MODULES {
                    return wrong("modules", m.modules);
                }
                Message::Sync(m)
            }
            Function::Goal => Message::Goal(decode(function, body)?),
            Function::State => Message::State(decode(function, body)?),
            Function::Latent => Message::Latent(decode(function, body)?),
            Function::LatentFragment => {
                let m: Fragment = decode(function, body)?;
                reserved(m.header & 0x80)?;
                Message::LatentFragment(m)
            }
            Function::ServiceRequest => {
                let m: ServiceRequest = decode(function, body)?;
                module_or_none("destination", m.destination)?;
                Message::ServiceRequest(m)
            }
            Function::ServiceResponse => Message::ServiceResponse(decode(function, body)?),
            Function::Telemetry => {
                let m: Telemetry = decode(function, body)?;
                module_or_none("module", m.attends_to)?;
                Message::Telemetry(m)
            }
            Function::Heartbeat => {
                let m: Heartbeat = decode(function, body)?;
                module_or_none("time-keeper", m.time_keeper)?;
                if m.mode().is_none() {
                    return wrong("mode", m.mode);
                }
                reserved(m.mode & !(15 | Heartbeat::LAB | Heartbeat::TRIAL))?;
                Message::Heartbeat(m)
            }
            Function::UpdateChunk => {
                let [_, _, low, high, ..] = frame.data;
                let number = u16::from_le_bytes([low, high]);
                match Chunk::new_checked(body) {
                    Some(chunk) => Message::UpdateChunk(chunk.repr()),
                    None if usize::from(number) >= CHUNKS_MAX => return wrong("number", high),
                    None => return Err(WireError::WrongLength { function, got: frame.len, expected }),
                }
            }
            Function::UpdatePiece => {
                let m: Piece = decode(function, body)?;
                let [head, ..] = m.0;
                if usize::from(head >> 4) >= PIECES {
                    return wrong("index", head >> 4);
                }
                Message::UpdatePiece(m)
            }
        })
    }
}

/// Serialises into `out`; the structs have fixed sizes that fit, so the only error (no room) cannot happen.
fn encode_into<T: Serialize>(message: &T, out: &mut [u8; 64]) -> usize {
    postcard::to_slice(message, out).map_or(0, |used| used.len())
}

fn encode<T: Serialize, const N: usize>(message: &T) -> [u8; N] {
    let mut out = [0; N];
    // The size is checked at compile time below.
    let _ = postcard::to_slice(message, &mut out);
    out
}

fn decode<T: DeserializeOwned>(function: Function, bytes: &[u8]) -> Result<T, WireError> {
    // Plain integers only: any bytes of the right length are a value.
    let short = WireError::WrongLength { function, got: bytes.len() as u8, expected: size_of::<T>() as u8 };
    postcard::from_bytes(bytes).map_err(|_| short)
}

/// Serde for three little-endian `i16`.
mod le_i16_3 {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(v: &[i16; 3], s: S) -> Result<S::Ok, S::Error> {
        v.map(i16::to_le_bytes).serialize(s)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(d: D) -> Result<[i16; 3], D::Error> {
        Ok(<[[u8; 2]; 3]>::deserialize(d)?.map(i16::from_le_bytes))
    }
}
