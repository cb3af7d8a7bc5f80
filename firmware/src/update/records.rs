//! The records of a module: which of its slots counts, what is to be tried, and the security counter.
//!
//! Two sections of flash, in turn. In each the first two places have its Begin, and records follow one another from place 2 on. `shared/update-format.md` has the
//! bytes and the rules.
//!
//! # Loss of power
//!
//! A word that loses its power while it is written may read as erased and yet not be writable, as anything, as what was to be written, or now like this and now like
//! that, or reading it may fail. So a place counts only if it reads the same four times and its checksum is right; a place that is not erased, and one that
//! cannot be written, are skipped; and what must not be lost again once it was seen, Begin and Confirm, is written twice, the second time at the next start if the power
//! went in between.

use composer_shared::update::{RECORD_SIZE, Record, RecordKind, SLOT_SIZE, Slot};
use embedded_storage::nor_flash::NorFlash;

use super::SECTION;
use crate::storage::StorageError;

/// Where the records begin.
const RECORDS_AT: u32 = 2 * SLOT_SIZE as u32;
/// Places of a section.
pub const PLACES: u32 = SECTION / RECORD_SIZE as u32;
/// The first place after the two of Begin.
const FIRST: u32 = 2;
/// With fewer places than this the other section is begun.
const SPARE: u32 = 16;
/// How often a place must read the same.
const LOOKS: usize = 4;
const ERASED: [u8; RECORD_SIZE] = [0xff; RECORD_SIZE];

/// A policy that is to be tried, or is tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pending {
    /// Where it lies.
    pub slot: Slot,
    /// Lower 24 bits of its CRC-32.
    pub policy: u32,
    /// The module has started with it.
    pub tried: bool,
}

/// What the records come to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct State {
    /// The slot that counts.
    pub own: Slot,
    /// Somebody confirmed it; if not, it is the policy that the module was made with.
    pub confirmed: bool,
    /// The security counter.
    pub counter: u32,
    /// What is under way.
    pub pending: Option<Pending>,
}

impl State {
    /// Of a module that has no records.
    const NEW: State = State { own: Slot::A, confirmed: false, counter: 0, pending: None };

    fn take(&mut self, record: Record) {
        let Record { kind, slot, value } = record;
        match kind {
            RecordKind::Begin => {}
            RecordKind::Commit if slot != self.own => {
                self.pending = Some(Pending { slot, policy: value, tried: false })
            }
            RecordKind::Commit => {}
            RecordKind::Try => {
                if let Some(pending) = self.pending.as_mut().filter(|pending| pending.slot == slot) {
                    pending.tried = true;
                }
            }
            RecordKind::Confirm => {
                (self.own, self.confirmed, self.counter) = (slot, true, self.counter.max(value));
                self.pending = self.pending.filter(|pending| pending.slot != slot);
            }
            RecordKind::Revert => self.pending = self.pending.filter(|pending| pending.slot != slot),
        }
    }

    fn confirmation(&self) -> Option<Record> {
        self.confirmed.then_some(Record { kind: RecordKind::Confirm, slot: self.own, value: self.counter })
    }
}

/// The records of a module.
#[derive(Clone, Copy, Debug)]
pub struct Records {
    section: u32,
    /// Where the next record goes.
    next: u32,
    /// Of the section; 0: there is none that counts.
    generation: u32,
    state: State,
    /// Begin, and the last Confirm, are there twice.
    begun_twice: bool,
    confirmed_twice: bool,
}

/// Bytes of [`of_new_module`].
pub const NEW_SIZE: usize = SECTION as usize + 2 * RECORD_SIZE;

/// What a debug probe writes where the records begin, so that slot A counts, with this security counter, whatever was there before. The first section has no room left (a
/// word that a probe has written with ones cannot be written again), so that the first record begins the second.
pub fn of_new_module(counter: u32) -> [u8; NEW_SIZE] {
    let mut bytes = [0; NEW_SIZE];
    let begin = Record { kind: RecordKind::Begin, slot: Slot::A, value: 1 }.emit();
    let confirm = Record { kind: RecordKind::Confirm, slot: Slot::A, value: counter }.emit();
    let records = [begin, begin, confirm, confirm];
    bytes.iter_mut().zip(records.as_flattened()).for_each(|(to, from)| *to = *from);
    bytes
}

fn place_at(section: u32, place: u32) -> u32 {
    let places = section.saturating_mul(PLACES).saturating_add(place);
    RECORDS_AT.saturating_add(places.saturating_mul(RECORD_SIZE as u32))
}

/// What a place holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Erased,
    /// Something that says nothing.
    Spoilt,
    Record(Record),
}

fn look<F: NorFlash>(flash: &mut F, section: u32, place: u32) -> Place {
    let at = place_at(section, place);
    let mut first = ERASED;
    let mut same = flash.read(at, &mut first).is_ok();
    for _ in 1..LOOKS {
        let mut again = ERASED;
        same &= flash.read(at, &mut again).is_ok() && again == first;
    }
    match (same, Record::parse(&first)) {
        (false, _) => Place::Spoilt,
        (true, Some(record)) => Place::Record(record),
        (true, None) if first == ERASED => Place::Erased,
        (true, None) => Place::Spoilt,
    }
}

/// The generation of a section, and whether it says so twice.
fn begun<F: NorFlash>(flash: &mut F, section: u32) -> Option<(u32, bool)> {
    let generation = |place: Place| match place {
        Place::Record(Record { kind: RecordKind::Begin, value, .. }) if value > 0 => Some(value),
        _ => None,
    };
    let [first, second] = [0, 1].map(|place| generation(look(flash, section, place)));
    first.or(second).map(|value| (value, first == second))
}

impl Records {
    /// Reads them.
    pub fn open<F: NorFlash>(flash: &mut F) -> Self {
        let mut records = Records {
            section: 0,
            next: PLACES,
            generation: 0,
            state: State::NEW,
            begun_twice: false,
            confirmed_twice: true,
        };
        for section in 0..2 {
            if let Some((generation, twice)) = begun(flash, section)
                && generation > records.generation
            {
                (records.section, records.generation, records.begun_twice) = (section, generation, twice);
            }
        }
        if records.generation == 0 {
            return records;
        }
        records.next = FIRST;
        let mut last = None;
        for place in FIRST..PLACES {
            let seen = look(flash, records.section, place);
            if seen != Place::Erased {
                records.next = place + 1;
            }
            if let Place::Record(record) = seen {
                records.state.take(record);
                if record.kind == RecordKind::Confirm {
                    records.confirmed_twice = last == Some(record);
                    last = Some(record);
                }
            }
        }
        records
    }

    /// What they come to.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Places of the section that are taken.
    pub fn count(&self) -> u32 {
        if self.generation == 0 { 0 } else { self.next.saturating_sub(FIRST) }
    }

    /// The record that is `back` before the newest place; a place that says nothing gives none.
    pub fn back<F: NorFlash>(&self, flash: &mut F, back: u32) -> Option<Record> {
        let place =
            self.next.checked_sub(back.checked_add(1)?).filter(|place| *place >= FIRST && back < self.count())?;
        match look(flash, self.section, place) {
            Place::Record(record) => Some(record),
            _ => None,
        }
    }

    /// Writes what a loss of power left undone. If that fails, it is tried again with the next record.
    pub fn mend<F: NorFlash>(&mut self, flash: &mut F) {
        if self.generation == 0 {
            return;
        }
        if !self.begun_twice {
            // The place may have lost its power, too: then the other section is begun.
            let begin = self.begin_record(self.generation);
            self.begun_twice = [0, 1].into_iter().any(|place| {
                look(flash, self.section, place) == Place::Erased && write(flash, self.section, place, begin).is_ok()
            });
            if !self.begun_twice && self.turn(flash).is_err() {
                return;
            }
        }
        if !self.confirmed_twice
            && let Some(confirmation) = self.state.confirmation()
        {
            let _ = self.append(flash, confirmation);
        }
    }

    fn begin_record(&self, generation: u32) -> Record {
        Record { kind: RecordKind::Begin, slot: Slot::A, value: generation }
    }

    /// Writes a record, behind which the records say what it says.
    pub fn append<F: NorFlash>(&mut self, flash: &mut F, record: Record) -> Result<(), StorageError> {
        if PLACES.saturating_sub(self.next) < SPARE || !self.begun_twice {
            self.turn(flash)?;
        }
        self.put(flash, record)?;
        self.confirmed_twice = record.kind != RecordKind::Confirm || self.state.confirmation() == Some(record);
        self.state.take(record);
        Ok(())
    }

    /// At the next place that can be written.
    fn put<F: NorFlash>(&mut self, flash: &mut F, record: Record) -> Result<(), StorageError> {
        while self.next < PLACES {
            let place = self.next;
            self.next += 1;
            if write(flash, self.section, place, record).is_ok() {
                return Ok(());
            }
        }
        Err(StorageError)
    }

    /// Begins the other section with what counts.
    fn turn<F: NorFlash>(&mut self, flash: &mut F) -> Result<(), StorageError> {
        let section = if self.generation == 0 { 0 } else { self.section ^ 1 };
        let from = place_at(section, 0);
        flash.erase(from, from.saturating_add(SECTION)).map_err(|_| StorageError)?;
        let mut new = Records { section, next: FIRST, begun_twice: true, confirmed_twice: true, ..*self };
        new.generation = self.generation.saturating_add(1);
        if let Some(confirmation) = self.state.confirmation() {
            new.put(flash, confirmation)?;
            new.put(flash, confirmation)?;
        }
        if let Some(Pending { slot, policy, tried }) = self.state.pending {
            new.put(flash, Record { kind: RecordKind::Commit, slot, value: policy })?;
            if tried {
                new.put(flash, Record { kind: RecordKind::Try, slot, value: policy })?;
            }
        }
        let begin = self.begin_record(new.generation);
        write(flash, section, 0, begin)?;
        // From here on the new section counts, at the next start, too.
        *self = new;
        self.begun_twice = false;
        write(flash, section, 1, begin)?;
        self.begun_twice = true;
        Ok(())
    }
}

fn write<F: NorFlash>(flash: &mut F, section: u32, place: u32, record: Record) -> Result<(), StorageError> {
    flash.write(place_at(section, place), &record.emit()).map_err(|_| StorageError)?;
    if look(flash, section, place) == Place::Record(record) { Ok(()) } else { Err(StorageError) }
}
