//! New policies over the bus: two slots in the flash, the records that say which of them counts, and how a new policy is received, verified, tried and
//! confirmed. `shared/update-format.md` has every byte, `threat-model.md` says against whom.
//!
//! A piece of flash of [`SIZE`] bytes holds both slots and the records ([`records`]). The slot that the module runs with, and, while a policy is on trial, the one that it
//! would go back to, are never written. A new policy goes into the other:
//!
//! 1. begin: the slot is erased as far as it is needed;
//! 2. chunks come in any order, are written as they come, and noted in a bit map;
//! 3. verify: the header, the keys, the security counter, the digest and the image are checked, all read back from the flash;
//! 4. commit: one record. From then on the policy will be tried at the next start, and not before;
//! 5. at that start a record says that it is tried, and the module runs with it, disarmed, for [`TRIAL_CYCLES`] control cycles at most;
//! 6. confirm: one record, written twice. Without it the module goes back to the policy of before, and so it does if it restarts on trial.
//!
//! Whenever the power goes, the module starts with the old policy or with the new one.
//!
//! [`Updater::work`] does one thing a call: at most one erasure, one chunk or one kilobyte of the digest, or the signature, which takes a Cortex-M4 at 170 MHz some
//! 20 ms. Between two of them the board feeds its watchdog.

pub mod records;
mod verify;

use composer_shared::policy::{IMAGE_SIZE, Policy};
use composer_shared::sha512::Sha512;
use composer_shared::update::{
    Assembly, CHUNK_SIZE, CHUNKS_MAX, ChunkRepr, DIGEST_SIZE, HEADER_SIZE, Header, HeaderError, HeaderRepr, Key,
    NO_KEY, Reason, Record, RecordKind, SLOT_SIZE, Slot, chunks,
};
use composer_shared::wire::{Piece, ServiceCode, ServiceRequest, UpdateStep};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};

use records::{Pending, Records};
pub use verify::verify;

/// Bytes of a section: what may have to be erased at once.
pub const SECTION: u32 = 4096;
/// Bytes of flash for all of it.
pub const SIZE: u32 = 2 * SLOT_SIZE as u32 + 2 * SECTION;
/// So many control cycles a policy may be on trial.
pub const TRIAL_CYCLES: u32 = 400;
/// Bytes of the digest at a time.
const HASHED: u32 = 1024;

/// Flash with policies, which can be read in place: bytes 0 to [`SIZE`].
pub trait PolicyFlash: NorFlash {
    /// So many bytes from there on, as they are now.
    fn bytes(&self, from: u32, length: usize) -> Option<&[u8]>;
}

/// Where a slot begins.
pub const fn slot_at(slot: Slot) -> u32 {
    slot as u32 * SLOT_SIZE as u32
}

/// The policy image in the bytes of a slot: behind a header, or by itself.
pub fn image_in(slot: &[u8]) -> Option<&[u8]> {
    match Header::new_checked(slot) {
        Ok(header) => slot.get(HEADER_SIZE..header.repr().total()),
        Err(HeaderError::Magic) => slot.get(..IMAGE_SIZE),
        Err(_) => None,
    }
}

/// The policy image in a slot, in place.
pub fn image_of<F: PolicyFlash>(flash: &F, slot: Slot) -> Option<&[u8]> {
    image_in(flash.bytes(slot_at(slot), SLOT_SIZE)?)
}

/// With which policy a module starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start {
    /// The slot.
    pub slot: Slot,
    /// On trial: nobody has confirmed it yet.
    pub trial: bool,
}

/// How far an update is.
#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Nothing was begun.
    Idle,
    /// The slot is erased, from this byte of it on.
    Erasing { at: u32, request: ServiceRequest },
    /// Chunks come.
    Receiving,
    /// The header is to be looked at.
    Looking { request: ServiceRequest },
    /// The image is hashed, from this byte of the slot on.
    Hashing { at: u32, request: ServiceRequest },
    /// The signature is to be checked, and the image as a policy.
    Checking { request: ServiceRequest },
    /// All is well with it.
    Verified,
    /// This record is to be written, so many times.
    Recording { record: Record, times: u8, request: Option<ServiceRequest> },
}

/// What comes, and what has come.
#[derive(Clone, Copy, Debug)]
struct Incoming {
    session: u16,
    /// Bytes of header and image.
    total: u32,
    /// Chunks that are there.
    there: [u32; CHUNKS_MAX / 32],
}

impl Incoming {
    fn has(&self, number: u16) -> bool {
        self.there.get(usize::from(number / 32)).is_some_and(|word| word >> (number % 32) & 1 != 0)
    }

    fn count(&self) -> u32 {
        self.there.iter().map(|word| word.count_ones()).sum()
    }
}

/// What [`Updater::work`] came to: the request that is answered, and how.
pub type Done = (ServiceRequest, Result<u32, ServiceCode>);

/// The policies of one module.
#[derive(Clone)]
pub struct Updater {
    records: Records,
    start: Start,
    keys: [Key; 2],
    incoming: Option<Incoming>,
    stage: Stage,
    assembly: Assembly,
    /// A chunk that is to be written.
    chunk: Option<ChunkRepr>,
    sha: Option<Sha512>,
    /// The policy that was verified last: lower 24 bits of its CRC-32 are in its records.
    verified: u32,
    /// The trial was given up: the module is to restart.
    given_up: bool,
    errors: u32,
}

impl core::fmt::Debug for Updater {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Updater").field("start", &self.start).field("stage", &self.stage).finish_non_exhaustive()
    }
}

impl Updater {
    /// Finds out with which policy the module starts, and notes that where it must be noted. `usable` says whether what lies in a slot is a policy that runs. `keys` are
    /// those of the node page.
    pub fn start<F: PolicyFlash>(flash: &mut F, keys: [Key; 2], usable: impl Fn(&F, Slot) -> bool) -> Self {
        let mut records = Records::open(flash);
        records.mend(flash);
        let own = records.state().own;
        let mut start = Start { slot: own, trial: false };
        if let Some(Pending { slot, policy, tried }) = records.state().pending {
            let reason = if tried {
                Some(Reason::Restarted)
            } else if !usable(flash, slot) {
                Some(Reason::Unusable)
            } else {
                None
            };
            let record = match reason {
                Some(reason) => Record { kind: RecordKind::Revert, slot, value: reason as u32 },
                None => Record { kind: RecordKind::Try, slot, value: policy },
            };
            // A trial that could not be noted might last for ever.
            let noted = records.append(flash, record).is_ok();
            if noted && reason.is_none() {
                start = Start { slot, trial: true };
            }
        }
        Updater {
            records,
            start,
            keys,
            incoming: None,
            stage: Stage::Idle,
            assembly: Assembly::EMPTY,
            chunk: None,
            sha: None,
            verified: 0,
            given_up: false,
            errors: 0,
        }
    }

    /// With which policy the module runs.
    pub fn started(&self) -> Start {
        self.start
    }

    /// Whether it takes policies that nobody signed: it has no key.
    pub fn lab(&self) -> bool {
        self.keys == [NO_KEY; 2]
    }

    /// Whether its policy is on trial.
    pub fn on_trial(&self) -> bool {
        self.start.trial
    }

    /// Whether the module is to restart, because its trial is over.
    pub fn given_up(&self) -> bool {
        self.given_up
    }

    /// What the records say.
    pub fn records(&self) -> &Records {
        &self.records
    }

    /// Writes and erasures that failed.
    pub fn errors(&self) -> u32 {
        self.errors
    }

    /// Whether something is on its way, to be gone on with by [`Updater::work`].
    pub fn is_busy(&self) -> bool {
        self.chunk.is_some() || !matches!(self.stage, Stage::Idle | Stage::Receiving | Stage::Verified)
    }

    /// The slot that may be written.
    fn idle(&self) -> Slot {
        self.start.slot.other()
    }

    /// A step of an update. None: the answer comes from [`Updater::work`]. `policy` is the CRC-32 of the policy that the module runs with.
    pub fn serve(&mut self, request: &ServiceRequest, policy: u32) -> Result<Option<u32>, ServiceCode> {
        let step = UpdateStep::from_number(request.index).ok_or(ServiceCode::NoSuchRegister)?;
        if self.is_busy() {
            return Err(ServiceCode::Busy);
        }
        let value = request.value;
        let request = *request;
        let known = self.records.state().pending.filter(|pending| !pending.tried);
        match step {
            UpdateStep::Begin => {
                self.at_peace()?;
                let (session, total) = (value as u16, value >> 16);
                if (total as usize) <= HEADER_SIZE || total as usize > SLOT_SIZE {
                    return Err(ServiceCode::OutOfRange);
                }
                let same = |incoming: &Incoming| (incoming.session, incoming.total) == (session, total);
                if self.incoming.as_ref().is_some_and(same) {
                    return Ok(Some(1));
                }
                self.incoming = Some(Incoming { session, total, there: [0; CHUNKS_MAX / 32] });
                self.assembly = Assembly::EMPTY;
                self.stage = match known {
                    // What was to be tried is overwritten.
                    Some(pending) => {
                        let record =
                            Record { kind: RecordKind::Revert, slot: pending.slot, value: Reason::Replaced as u32 };
                        Stage::Recording { record, times: 1, request: Some(request) }
                    }
                    None => Stage::Erasing { at: 0, request },
                };
                Ok(None)
            }
            UpdateStep::Verify => {
                self.at_peace()?;
                let incoming = self.incoming.as_ref().ok_or(ServiceCode::NoUpdate)?;
                if incoming.count() as usize != chunks(incoming.total as usize) {
                    return Err(ServiceCode::Missing);
                }
                self.stage = Stage::Looking { request };
                Ok(None)
            }
            UpdateStep::Commit => {
                self.at_peace()?;
                let low = value & 0x00ff_ffff;
                if known.is_some_and(|pending| pending.policy == low) {
                    return Ok(Some(value));
                }
                if !matches!(self.stage, Stage::Verified) || self.verified != value {
                    return Err(ServiceCode::NoUpdate);
                }
                let record = Record { kind: RecordKind::Commit, slot: self.idle(), value: low };
                self.stage = Stage::Recording { record, times: 1, request: Some(request) };
                Ok(None)
            }
            UpdateStep::Confirm if value != policy => Err(ServiceCode::NoUpdate),
            UpdateStep::Confirm if !self.start.trial => Ok(Some(value)),
            UpdateStep::Confirm => {
                // The counter is looked up when it is written.
                let record = Record { kind: RecordKind::Confirm, slot: self.start.slot, value: 0 };
                self.stage = Stage::Recording { record, times: 2, request: Some(request) };
                Ok(None)
            }
            UpdateStep::Abandon => {
                self.at_peace()?;
                self.incoming = None;
                self.stage = Stage::Idle;
                let Some(pending) = known else { return Ok(Some(0)) };
                let record = Record { kind: RecordKind::Revert, slot: pending.slot, value: Reason::Replaced as u32 };
                self.stage = Stage::Recording { record, times: 1, request: Some(request) };
                Ok(None)
            }
        }
    }

    /// While a policy is on trial both slots are needed.
    fn at_peace(&self) -> Result<(), ServiceCode> {
        if self.start.trial { Err(ServiceCode::OnTrial) } else { Ok(()) }
    }

    /// The trial has taken too long: the old policy is to come back.
    pub fn give_up(&mut self) {
        if self.start.trial && !self.given_up && !self.is_busy() {
            let record = Record { kind: RecordKind::Revert, slot: self.start.slot, value: Reason::NotConfirmed as u32 };
            self.stage = Stage::Recording { record, times: 1, request: None };
        }
    }

    /// Takes a chunk. What nobody waits for, or was there before, is left alone.
    pub fn hear_chunk(&mut self, chunk: &ChunkRepr) {
        let Some(incoming) = &self.incoming else { return };
        let wanted = chunk.session == incoming.session
            && usize::from(chunk.number) < chunks(incoming.total as usize)
            && !incoming.has(chunk.number);
        if wanted && matches!(self.stage, Stage::Receiving) && self.chunk.is_none() {
            self.chunk = Some(*chunk);
        }
    }

    /// Takes a ninth of a chunk.
    pub fn hear_piece(&mut self, piece: &Piece) {
        if self.incoming.is_some()
            && let Some(chunk) = self.assembly.push(&piece.0)
        {
            self.hear_chunk(&chunk);
        }
    }

    /// An item of UPDATE_STATUS.
    ///
    /// | item | what |
    /// |---|---|
    /// | 0 to 15 | bit n of word w: chunk 32 w + n is there |
    /// | 16 | bits 0 to 2 stage: 0 nothing was begun, 1 chunks come, 2 busy, 3 verified, 4 to be tried at the next start; bit 3 on trial; bit 4 slot it runs with; bit 5 and 6 which keys it has |
    /// | 17 | its security counter |
    /// | 18 | session (bits 0 to 15) and bytes (16 to 31) of what was begun; 0 nothing |
    /// | 19 | chunks that are there |
    /// | 20 | records since the section was begun |
    /// | 21, 22 | first four bytes of key A, key B |
    /// | 23 | number of the task of the policy that it runs with |
    pub fn item(&self, item: u8) -> Option<u32> {
        let incoming = self.incoming.as_ref();
        let [first, second] = &self.keys;
        Some(match item {
            0..=15 => incoming.and_then(|incoming| incoming.there.get(usize::from(item)).copied()).unwrap_or(0),
            16 => {
                let pending = self.records.state().pending.is_some_and(|pending| !pending.tried);
                let stage = match self.stage {
                    _ if pending => 4,
                    Stage::Idle => 0,
                    Stage::Receiving => 1,
                    Stage::Verified => 3,
                    _ => 2,
                };
                let keys = u32::from(*first != NO_KEY) | u32::from(*second != NO_KEY) << 1;
                stage | u32::from(self.start.trial) << 3 | (self.start.slot as u32) << 4 | keys << 5
            }
            17 => self.records.state().counter,
            18 => incoming.map_or(0, |incoming| u32::from(incoming.session) | incoming.total << 16),
            19 => incoming.map_or(0, Incoming::count),
            20 => self.records.count(),
            21 | 22 => {
                let [a, b, c, d, ..] = *if item == 21 { first } else { second };
                u32::from_le_bytes([a, b, c, d])
            }
            _ => return None,
        })
    }

    /// Does one thing that is due.
    pub fn work<F: PolicyFlash>(&mut self, flash: &mut F) -> Option<Done> {
        if let Some(chunk) = self.chunk.take() {
            self.write_chunk(flash, &chunk);
            return None;
        }
        match self.stage {
            Stage::Idle | Stage::Receiving | Stage::Verified => None,
            Stage::Erasing { at, request } => {
                let from = slot_at(self.idle()).saturating_add(at);
                if flash.erase(from, from.saturating_add(SECTION)).is_err() {
                    return self.failed(request);
                }
                let at = at.saturating_add(SECTION);
                if self.incoming.as_ref().is_some_and(|incoming| at < incoming.total) {
                    self.stage = Stage::Erasing { at, request };
                    return None;
                }
                self.stage = Stage::Receiving;
                Some((request, Ok(0)))
            }
            Stage::Looking { request } => match self.look(flash) {
                Ok(()) => {
                    self.sha = Some(Sha512::new());
                    self.stage = Stage::Hashing { at: HEADER_SIZE as u32, request };
                    None
                }
                Err(code) => self.refused(request, code),
            },
            Stage::Hashing { at, request } => {
                let total = self.incoming.as_ref().map_or(0, |incoming| incoming.total);
                let length = HASHED.min(total.saturating_sub(at));
                if length == 0 {
                    self.stage = Stage::Checking { request };
                    return None;
                }
                let (from, sha) = (slot_at(self.idle()).saturating_add(at), self.sha.as_mut());
                let (Some(bytes), Some(sha)) = (flash.bytes(from, length as usize), sha) else {
                    return self.refused(request, ServiceCode::StorageFailed);
                };
                sha.update(bytes);
                self.stage = Stage::Hashing { at: at.saturating_add(length), request };
                None
            }
            Stage::Checking { request } => match self.check(flash) {
                Ok(crc) => {
                    self.verified = crc;
                    self.stage = Stage::Verified;
                    Some((request, Ok(crc)))
                }
                Err(code) => self.refused(request, code),
            },
            Stage::Recording { record, times, request } => self.record(flash, record, times, request),
        }
    }

    fn write_chunk<F: PolicyFlash>(&mut self, flash: &mut F, chunk: &ChunkRepr) {
        let Some(incoming) = &mut self.incoming else { return };
        let offset = u32::from(chunk.number).saturating_mul(CHUNK_SIZE as u32);
        let from = slot_at(self.start.slot.other()).saturating_add(offset);
        let mut read = [0; CHUNK_SIZE];
        let written =
            flash.write(from, &chunk.data).is_ok() && flash.read(from, &mut read).is_ok() && read == chunk.data;
        if !written {
            // Flash that was written cannot be written again: all of the slot has to be erased.
            self.errors = self.errors.saturating_add(1);
            self.incoming = None;
            self.stage = Stage::Idle;
        } else if let Some(word) = incoming.there.get_mut(usize::from(chunk.number / 32)) {
            *word |= 1 << (chunk.number % 32);
        }
    }

    fn failed(&mut self, request: ServiceRequest) -> Option<Done> {
        self.errors = self.errors.saturating_add(1);
        self.refused(request, ServiceCode::StorageFailed)
    }

    /// What was received is forgotten: the same bytes would be refused again.
    fn refused(&mut self, request: ServiceRequest, code: ServiceCode) -> Option<Done> {
        self.incoming = None;
        self.sha = None;
        self.stage = Stage::Idle;
        Some((request, Err(code)))
    }

    /// The header: is it one, and may its policy come?
    fn look<F: PolicyFlash>(&self, flash: &F) -> Result<(), ServiceCode> {
        let header = header_of(flash, self.idle()).map_err(|error| match error {
            HeaderError::Class { .. } => ServiceCode::WrongClass,
            _ => ServiceCode::NotSignedPolicy,
        })?;
        let repr = header.repr();
        let total = self.incoming.as_ref().map_or(0, |incoming| incoming.total);
        if repr.total() != total as usize {
            return Err(ServiceCode::NotSignedPolicy);
        }
        if header.signature().is_none() && !self.lab() {
            return Err(ServiceCode::Unsigned);
        }
        if repr.counter < self.records.state().counter {
            return Err(ServiceCode::OldCounter);
        }
        Ok(())
    }

    /// Digest, signature, image: the CRC-32 of the policy if all are right.
    fn check<F: PolicyFlash>(&mut self, flash: &F) -> Result<u32, ServiceCode> {
        let digest: [u8; DIGEST_SIZE] = self.sha.take().ok_or(ServiceCode::NoUpdate)?.finalize();
        let header = header_of(flash, self.idle()).map_err(|_| ServiceCode::NotSignedPolicy)?;
        let repr = *header.repr();
        if !self.is_authentic(&header, &repr) {
            return Err(ServiceCode::BadSignature);
        }
        if repr.digest != digest {
            return Err(ServiceCode::BadDigest);
        }
        let policy = image_of(flash, self.idle()).map(Policy::parse);
        let Some(Ok(policy)) = policy else { return Err(ServiceCode::BadPolicy) };
        // A header that says something else of its image than the image itself.
        if (policy.crc(), policy.task()) != (repr.crc, repr.task) {
            return Err(ServiceCode::NotSignedPolicy);
        }
        Ok(repr.crc)
    }

    fn is_authentic(&self, header: &Header<'_>, repr: &HeaderRepr) -> bool {
        if self.lab() {
            // Nobody can tell good signatures from bad ones.
            return true;
        }
        let Some(signature) = header.signature() else { return false };
        let named = |key: &&Key| **key != NO_KEY && key.first_chunk() == Some(&repr.key_id);
        self.keys.iter().filter(named).any(|key| verify(key, header.signed_part(), signature))
    }

    fn record<F: PolicyFlash>(
        &mut self,
        flash: &mut F,
        record: Record,
        times: u8,
        request: Option<ServiceRequest>,
    ) -> Option<Done> {
        let mut record = record;
        if record.kind == RecordKind::Confirm {
            // A policy without a header was never received, so it has none to confirm.
            let counter = header_of(flash, record.slot).map_or(0, |header| header.repr().counter);
            record.value = counter.max(self.records.state().counter);
        }
        let written = self.records.append(flash, record);
        if written.is_err() {
            self.errors = self.errors.saturating_add(1);
            // The old policy comes back either way: a trial that was noted is not begun twice.
            self.given_up |= record.kind == RecordKind::Revert && self.start.trial;
            self.stage = Stage::Idle;
            return request.map(|request| (request, Err(ServiceCode::StorageFailed)));
        }
        if times > 1 {
            self.stage = Stage::Recording { record, times: times.saturating_sub(1), request };
            return None;
        }
        self.stage = Stage::Idle;
        match record.kind {
            RecordKind::Confirm => self.start.trial = false,
            RecordKind::Revert if self.start.trial => self.given_up = true,
            _ => {}
        }
        let request = request?;
        if request.index == UpdateStep::Begin as u8 {
            self.stage = Stage::Erasing { at: 0, request };
            return None;
        }
        if record.kind == RecordKind::Commit {
            // It is in the records now; its chunks are not needed any more.
            self.incoming = None;
        }
        Some((request, Ok(request.value)))
    }
}

/// The header in a slot.
pub fn header_of<F: PolicyFlash>(flash: &F, slot: Slot) -> Result<Header<'_>, HeaderError> {
    Header::new_checked(flash.bytes(slot_at(slot), HEADER_SIZE).unwrap_or(&[]))
}

/// No flash for policies: for a module that keeps the one that it has.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoPolicies;

impl ErrorType for NoPolicies {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for NoPolicies {
    const READ_SIZE: usize = 1;

    fn read(&mut self, _: u32, _: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        Err(NorFlashErrorKind::OutOfBounds)
    }

    fn capacity(&self) -> usize {
        0
    }
}

impl NorFlash for NoPolicies {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = SECTION as usize;

    fn erase(&mut self, _: u32, _: u32) -> Result<(), NorFlashErrorKind> {
        Err(NorFlashErrorKind::OutOfBounds)
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), NorFlashErrorKind> {
        Err(NorFlashErrorKind::OutOfBounds)
    }
}

impl PolicyFlash for NoPolicies {
    fn bytes(&self, _: u32, _: usize) -> Option<&[u8]> {
        None
    }
}

#[cfg(test)]
pub(crate) mod model;
#[cfg(test)]
pub(crate) mod tests;
