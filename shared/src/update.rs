//! New policies over the bus: the signed header before a policy image, the chunks in which both travel, and the records by which a module knows
//! which of its policies counts.
//!
//! `update-format.md` beside this crate's manifest specifies every byte. Each format has a view, which checks bytes in place, and a `Repr`, which is what they
//! say and writes them. No bytes make them panic.

use core::fmt;

use crate::CRC_32;
use crate::policy::Task;

/// The first bytes of every header.
pub const MAGIC: [u8; 8] = *b"COMPSIGN";
/// Version of the header's layout.
pub const VERSION: u16 = 1;
/// Bytes of a header: three chunks.
pub const HEADER_SIZE: usize = 168;
/// Bytes of it that are signed: all before the signature.
pub const SIGNED: usize = 104;
/// Bytes of a slot: header and image have room in it.
pub const SLOT_SIZE: usize = 28 * 1024;
/// Most bytes of an image.
pub const IMAGE_MAX: usize = SLOT_SIZE - HEADER_SIZE;
/// Bytes of a SHA-512.
pub const DIGEST_SIZE: usize = 64;
/// Bytes of an Ed25519 signature.
pub const SIGNATURE_SIZE: usize = 64;
/// Bytes of an Ed25519 public key.
pub const KEY_SIZE: usize = 32;
/// Bytes of a key that a header names it by: its first.
pub const KEY_ID_SIZE: usize = 8;
/// The largest security counter.
pub const COUNTER_MAX: u32 = 0x00ff_ffff;

/// An Ed25519 public key as a module keeps it. All zeros: there is none.
pub type Key = [u8; KEY_SIZE];
/// No key.
pub const NO_KEY: Key = [0; KEY_SIZE];

/// What a policy is for. A module takes only what is for its own class.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Class {
    /// A module of the snake: four joints, two motors, the integer network.
    SnakeModule = 1,
}

const CLASS_AT: usize = 10;
const LENGTH_AT: usize = 12;
const COUNTER_AT: usize = 16;
const EDITION_AT: usize = 20;
const TASK_AT: usize = 24;
const RESERVED_AT: usize = 25;
const CRC_AT: usize = 28;
const DIGEST_AT: usize = 32;
const KEY_AT: usize = DIGEST_AT + DIGEST_SIZE;
const _: () = assert!(KEY_AT + KEY_ID_SIZE == SIGNED && SIGNED + SIGNATURE_SIZE == HEADER_SIZE);
const _: () = assert!(HEADER_SIZE.is_multiple_of(CHUNK_SIZE) && CHUNKS_MAX * CHUNK_SIZE == SLOT_SIZE);

/// Why bytes are no header that this firmware understands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeaderError {
    /// Fewer bytes than a header has.
    TooShort {
        /// Bytes given.
        length: usize,
    },
    /// The first bytes are not [`MAGIC`].
    Magic,
    /// Another layout.
    Version {
        /// The version it has.
        found: u16,
    },
    /// For another kind of device.
    Class {
        /// The class it is for.
        found: u16,
    },
    /// An image of no bytes, or of more than fit.
    Length {
        /// As stated.
        stated: u32,
    },
    /// More than [`COUNTER_MAX`].
    Counter {
        /// As stated.
        stated: u32,
    },
    /// No task has this number.
    Task(u8),
    /// Reserved bytes are not zero.
    Reserved,
    /// A signature without a key, or a key without a signature.
    HalfSigned,
}

impl fmt::Display for HeaderError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            HeaderError::TooShort { length } => {
                write!(
                    f,
                    "the signed policy is cut short: it has {length} bytes where the header alone has {HEADER_SIZE}"
                )
            }
            HeaderError::Magic => {
                write!(f, "this is no signed policy: it does not begin with COMPSIGN; `snakectl sign` makes one")
            }
            HeaderError::Version { found } => {
                write!(
                    f,
                    "the signed policy has header version {found}, this build reads version {VERSION}: sign it again"
                )
            }
            HeaderError::Class { found } => write!(
                f,
                "the signed policy is for device class {found}, and a module of the snake is class {}",
                Class::SnakeModule as u16
            ),
            HeaderError::Length { stated } => {
                write!(f, "the signed policy states an image of {stated} bytes: 1 to {IMAGE_MAX} have room in a slot")
            }
            HeaderError::Counter { stated } => {
                write!(f, "the signed policy has security counter {stated}: it is at most {COUNTER_MAX}")
            }
            HeaderError::Task(found) => write!(f, "the signed policy is for task {found}, which does not exist"),
            HeaderError::Reserved => write!(f, "the signed policy has reserved bytes set that must be zero"),
            HeaderError::HalfSigned => {
                write!(f, "the signed policy has a key without a signature, or a signature without a key")
            }
        }
    }
}

impl core::error::Error for HeaderError {}

fn array<const N: usize>(bytes: &[u8], at: usize) -> Option<&[u8; N]> {
    bytes.get(at..)?.first_chunk()
}

/// A header in place, checked.
#[derive(Clone, Copy, Debug)]
pub struct Header<'a> {
    bytes: &'a [u8; HEADER_SIZE],
    repr: HeaderRepr,
}

impl<'a> Header<'a> {
    /// The header at the beginning of these bytes; what comes after it is ignored.
    pub fn new_checked(bytes: &'a [u8]) -> Result<Self, HeaderError> {
        let short = HeaderError::TooShort { length: bytes.len() };
        let (magic, _) = bytes.split_first_chunk::<8>().ok_or(short)?;
        if *magic != MAGIC {
            return Err(HeaderError::Magic);
        }
        let header: &[u8; HEADER_SIZE] = bytes.first_chunk().ok_or(short)?;
        let half = |at| array(header, at).map(|b| u16::from_le_bytes(*b)).ok_or(short);
        let word = |at| array(header, at).map(|b| u32::from_le_bytes(*b)).ok_or(short);
        let found = half(8)?;
        if found != VERSION {
            return Err(HeaderError::Version { found });
        }
        let found = half(CLASS_AT)?;
        if found != Class::SnakeModule as u16 {
            return Err(HeaderError::Class { found });
        }
        let length = word(LENGTH_AT)?;
        if length == 0 || length as usize > IMAGE_MAX {
            return Err(HeaderError::Length { stated: length });
        }
        let counter = word(COUNTER_AT)?;
        if counter > COUNTER_MAX {
            return Err(HeaderError::Counter { stated: counter });
        }
        let [number, reserved @ ..]: &[u8; 4] = array(header, TASK_AT).ok_or(short)?;
        let task = Task::ALL.into_iter().find(|task| *task as u8 == *number).ok_or(HeaderError::Task(*number))?;
        if *reserved != [0; CRC_AT - RESERVED_AT] {
            return Err(HeaderError::Reserved);
        }
        let key_id = *array(header, KEY_AT).ok_or(short)?;
        let signature: &[u8; SIGNATURE_SIZE] = array(header, SIGNED).ok_or(short)?;
        if (key_id == [0; KEY_ID_SIZE]) != (*signature == [0; SIGNATURE_SIZE]) {
            return Err(HeaderError::HalfSigned);
        }
        let digest = *array(header, DIGEST_AT).ok_or(short)?;
        let repr = HeaderRepr { length, counter, edition: word(EDITION_AT)?, task, crc: word(CRC_AT)?, digest, key_id };
        Ok(Header { bytes: header, repr })
    }

    /// What it says.
    pub fn repr(&self) -> &HeaderRepr {
        &self.repr
    }

    /// The bytes that are signed.
    pub fn signed_part(&self) -> &'a [u8] {
        self.bytes.get(..SIGNED).unwrap_or(self.bytes)
    }

    /// The signature; none if the policy is not signed.
    pub fn signature(&self) -> Option<&'a [u8; SIGNATURE_SIZE]> {
        let signature = array(self.bytes, SIGNED)?;
        (*signature != [0; SIGNATURE_SIZE]).then_some(signature)
    }
}

/// What a header says, the signature apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeaderRepr {
    /// Bytes of the image.
    pub length: u32,
    /// Security counter: a module refuses a lower one than that of a policy which was confirmed before.
    pub counter: u32,
    /// Which edition of the policy it is; nobody compares it.
    pub edition: u32,
    /// What the policy is for.
    pub task: Task,
    /// CRC-32 that the image ends with: the policy's name on the bus.
    pub crc: u32,
    /// SHA-512 of the image.
    pub digest: [u8; DIGEST_SIZE],
    /// The first bytes of the key that signed it; zeros if none did.
    pub key_id: [u8; KEY_ID_SIZE],
}

impl HeaderRepr {
    /// The bytes of the header, with this signature; `None` for one that is not signed.
    pub fn emit(&self, signature: Option<&[u8; SIGNATURE_SIZE]>) -> [u8; HEADER_SIZE] {
        let mut bytes = [0; HEADER_SIZE];
        let mut put = |at: usize, what: &[u8]| {
            bytes.iter_mut().skip(at).zip(what).for_each(|(to, from)| *to = *from);
        };
        put(0, &MAGIC);
        put(8, &VERSION.to_le_bytes());
        put(CLASS_AT, &(Class::SnakeModule as u16).to_le_bytes());
        put(LENGTH_AT, &self.length.to_le_bytes());
        put(COUNTER_AT, &self.counter.to_le_bytes());
        put(EDITION_AT, &self.edition.to_le_bytes());
        put(TASK_AT, &[self.task as u8]);
        put(CRC_AT, &self.crc.to_le_bytes());
        put(DIGEST_AT, &self.digest);
        if let Some(signature) = signature {
            put(KEY_AT, &self.key_id);
            put(SIGNED, signature);
        }
        bytes
    }

    /// Bytes of header and image together.
    pub fn total(&self) -> usize {
        HEADER_SIZE + self.length as usize
    }
}

/// Bytes of header and image in a chunk: seven double words of the flash.
pub const CHUNK_SIZE: usize = 56;
/// Most chunks of a policy: they fill a slot.
pub const CHUNKS_MAX: usize = 512;
/// Bytes of a chunk with its number and its session.
pub const CHUNK_FRAME: usize = CHUNK_SIZE + 4;
/// Classic frames that carry one chunk.
pub const PIECES: usize = CHUNK_FRAME.div_ceil(PIECE_SIZE);
/// Bytes of a chunk in a classic frame.
pub const PIECE_SIZE: usize = 7;

/// Chunks of so many bytes of header and image.
pub const fn chunks(total: usize) -> usize {
    total.div_ceil(CHUNK_SIZE)
}

/// The number by which chunks of one policy are told from those of another: from all its bytes, so that an update that was interrupted can go on.
pub fn session(package: &[u8]) -> u16 {
    CRC_32.checksum(package) as u16
}

/// A chunk in place.
#[derive(Clone, Copy, Debug)]
pub struct Chunk<'a> {
    bytes: &'a [u8; CHUNK_FRAME],
}

impl<'a> Chunk<'a> {
    /// The chunk that these bytes are; `None` if they are not exactly as many, or the number is none that a slot has.
    pub fn new_checked(bytes: &'a [u8]) -> Option<Self> {
        let chunk = Chunk { bytes: bytes.try_into().ok()? };
        (usize::from(chunk.repr().number) < CHUNKS_MAX).then_some(chunk)
    }

    /// What it says.
    pub fn repr(&self) -> ChunkRepr {
        let [a, b, c, d, data @ ..] = *self.bytes;
        ChunkRepr { session: u16::from_le_bytes([a, b]), number: u16::from_le_bytes([c, d]), data }
    }
}

/// Bytes `56 number` to `56 number + 55` of header and image; beyond their end zeros.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChunkRepr {
    /// Of which update ([`session`]).
    pub session: u16,
    /// Which chunk, from 0.
    pub number: u16,
    /// The bytes.
    pub data: [u8; CHUNK_SIZE],
}

impl ChunkRepr {
    /// Chunk `number` of header and image; `None` beyond their end.
    pub fn of(package: &[u8], session: u16, number: u16) -> Option<Self> {
        let rest = package.get(usize::from(number) * CHUNK_SIZE..).filter(|rest| !rest.is_empty())?;
        let mut data = [0; CHUNK_SIZE];
        data.iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
        Some(ChunkRepr { session, number, data })
    }

    /// Its bytes.
    pub fn emit(&self) -> [u8; CHUNK_FRAME] {
        let mut bytes = [0; CHUNK_FRAME];
        let head = self.session.to_le_bytes().into_iter().chain(self.number.to_le_bytes());
        bytes.iter_mut().zip(head.chain(self.data)).for_each(|(to, from)| *to = from);
        bytes
    }

    /// The same in pieces, for a classic bus: the first byte of each says which piece (bits 4 to 7) of which chunk (bits 0 to 3, its lower ones) it is.
    pub fn pieces(&self) -> [[u8; 1 + PIECE_SIZE]; PIECES] {
        let bytes = self.emit();
        let mut index = 0usize;
        [(); PIECES].map(|()| {
            let mut piece = [0; 1 + PIECE_SIZE];
            let head = (index as u8) << 4 | self.number as u8 & 15;
            let body = bytes.iter().skip(index * PIECE_SIZE).copied();
            piece.iter_mut().zip(core::iter::once(head).chain(body)).for_each(|(to, from)| *to = from);
            index += 1;
            piece
        })
    }
}

/// Puts the pieces of a chunk together. One chunk is on its way at a time; one whose pieces are not all there is lost when the next begins.
#[derive(Clone, Copy, Debug)]
pub struct Assembly {
    /// The lower four bits of the chunk's number.
    low: u8,
    /// Pieces that are there, as a bit mask.
    there: u16,
    bytes: [[u8; PIECE_SIZE]; PIECES],
}

impl Assembly {
    /// Nothing came yet.
    pub const EMPTY: Self = Assembly { low: 0, there: 0, bytes: [[0; PIECE_SIZE]; PIECES] };

    /// Takes a piece, and gives the chunk that it completes.
    pub fn push(&mut self, piece: &[u8; 1 + PIECE_SIZE]) -> Option<ChunkRepr> {
        let [head, body @ ..] = *piece;
        let (index, low) = (head >> 4, head & 15);
        let slot = self.bytes.get_mut(usize::from(index))?;
        if low != self.low {
            (self.low, self.there) = (low, 0);
        }
        *slot = body;
        self.there |= 1 << index;
        if self.there != (1 << PIECES) - 1 {
            return None;
        }
        self.there = 0;
        let (chunk, padding) = self.bytes.as_flattened().split_at_checked(CHUNK_FRAME)?;
        if padding.iter().any(|byte| *byte != 0) {
            return None;
        }
        Chunk::new_checked(chunk).map(|chunk| chunk.repr()).filter(|chunk| chunk.number as u8 & 15 == low)
    }
}

/// One of the two places for a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Slot {
    /// The first.
    A = 0,
    /// The second.
    B = 1,
}

impl Slot {
    /// The other one.
    pub const fn other(self) -> Self {
        match self {
            Slot::A => Slot::B,
            Slot::B => Slot::A,
        }
    }

    /// Its name.
    pub const fn name(self) -> &'static str {
        match self {
            Slot::A => "A",
            Slot::B => "B",
        }
    }

    /// The slot with this number.
    pub const fn from_number(number: u8) -> Option<Self> {
        match number {
            0 => Some(Slot::A),
            1 => Some(Slot::B),
            _ => None,
        }
    }
}

/// What a record says. Numbers never change their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum RecordKind {
    /// This section of records counts; the value is its generation, and the highest wins.
    Begin = 1,
    /// The policy in the slot is to be tried; the value is the lower 24 bits of its CRC-32.
    Commit = 2,
    /// The module starts with it for the first time; the value as above.
    Try = 3,
    /// The station has confirmed it: the slot is the module's own from now on; the value is its security counter.
    Confirm = 4,
    /// It is not to be tried any more; the value is a [`Reason`].
    Revert = 5,
}

impl RecordKind {
    /// All of them.
    pub const ALL: [RecordKind; 5] =
        [RecordKind::Begin, RecordKind::Commit, RecordKind::Try, RecordKind::Confirm, RecordKind::Revert];
}

/// Why a policy is not tried any more. Numbers never change their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// The station did not confirm it in time.
    NotConfirmed = 1,
    /// The module restarted before it was confirmed.
    Restarted = 2,
    /// What lies in the slot is no policy that runs.
    Unusable = 3,
    /// The station began another update.
    Replaced = 4,
}

impl Reason {
    /// All of them.
    pub const ALL: [Reason; 4] = [Reason::NotConfirmed, Reason::Restarted, Reason::Unusable, Reason::Replaced];

    /// In words.
    pub const fn text(self) -> &'static str {
        match self {
            Reason::NotConfirmed => "the station did not confirm it in time",
            Reason::Restarted => "the module restarted before it was confirmed",
            Reason::Unusable => "what lies in the slot is no policy that runs",
            Reason::Replaced => "another update was begun",
        }
    }
}

/// Bytes of a record: what the flash writes at once.
pub const RECORD_SIZE: usize = 8;

/// A record: what happened to a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// What happened.
    pub kind: RecordKind,
    /// To which slot; A for [`RecordKind::Begin`].
    pub slot: Slot,
    /// Depends on the kind, 24 bits.
    pub value: u32,
}

impl Record {
    /// Reads a record; `None` if the checksum or a number is wrong, erased flash among them.
    pub fn parse(bytes: &[u8; RECORD_SIZE]) -> Option<Self> {
        let [head, a, b, c, check @ ..] = *bytes;
        if CRC_32.checksum(&[head, a, b, c]).to_le_bytes() != check {
            return None;
        }
        let kind = RecordKind::ALL.into_iter().find(|kind| *kind as u8 == head & 15)?;
        Some(Record { kind, slot: Slot::from_number(head >> 4)?, value: u32::from_le_bytes([a, b, c, 0]) })
    }

    /// Its bytes.
    pub fn emit(&self) -> [u8; RECORD_SIZE] {
        let [a, b, c, _] = self.value.to_le_bytes();
        let head = self.kind as u8 | (self.slot as u8) << 4;
        let [w, x, y, z] = CRC_32.checksum(&[head, a, b, c]).to_le_bytes();
        [head, a, b, c, w, x, y, z]
    }
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (slot, value) = (self.slot.name(), self.value);
        match self.kind {
            RecordKind::Begin => write!(f, "these records begin, generation {value}"),
            RecordKind::Commit => write!(f, "policy ..{value:06x} in slot {slot} is to be tried"),
            RecordKind::Try => write!(f, "policy ..{value:06x} in slot {slot} is tried"),
            RecordKind::Confirm => write!(f, "slot {slot} is confirmed, security counter {value}"),
            RecordKind::Revert => {
                let reason = Reason::ALL.into_iter().find(|reason| *reason as u32 == value);
                let text = reason.map_or("for a reason that this program does not know", Reason::text);
                write!(f, "slot {slot} is given up: {text}")
            }
        }
    }
}

#[cfg(test)]
mod tests;
