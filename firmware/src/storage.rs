//! What a module keeps through a loss of power: its [node page](crate::node_page), and the log of its faults.
//!
//! Both lie in one region of NOR flash, four sections of equal size, each of which can be erased alone:
//!
//! | section | content |
//! |---|---|
//! | 0, 1 | the fault log, in turn |
//! | 2 | a copy of the node page |
//! | 3 | the node page |
//!
//! # Loss of power
//!
//! A section that loses its power while it is erased or written may read as anything afterwards. So the two places of the node page are
//! never written at the same time: first the copy, then the page itself ([`Save`]); the one that is read is the page if its checksum is
//! right, the copy otherwise ([`read_page`]). Whenever the power goes, the module starts with the old page or with the new one. An entry of the log
//! has a checksum of its own; one that was cut short is skipped.
//!
//! # Time
//!
//! Erasing a section takes some 20 ms, in which the processor may stand still. [`Save::step`] and [`FaultLog::work`] do one thing
//! a call, at most one erasure, and the log erases only when it may: while the module is disarmed. A log that is full while
//! the module is armed waits in memory.

use composer_shared::CRC_32;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_write};

use crate::node_page::{self, NodePage, NodePageError};

const LOG: [u32; 2] = [0, 1];
const COPY: u32 = 2;
const PAGE: u32 = 3;
/// Sections of the region.
pub const SECTIONS: u32 = 4;

/// Bytes of a log entry; a multiple of 8, the least that the flash writes.
pub const ENTRY_SIZE: usize = 16;
/// Entries that wait in memory to be written.
const WAITING: usize = 8;

/// What erased flash reads.
const ERASED: u8 = 0xff;

/// The flash could not be written or erased, or does not read what was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StorageError;

fn section_size(flash: &impl ReadNorFlash) -> u32 {
    flash.capacity() as u32 / SECTIONS
}

fn erase<F: NorFlash>(flash: &mut F, section: u32) -> Result<(), StorageError> {
    let size = section_size(flash);
    let from = section.saturating_mul(size);
    flash.erase(from, from.saturating_add(size)).map_err(|_| StorageError)
}

fn read_slot<F: NorFlash>(flash: &mut F, section: u32) -> Result<NodePage, NodePageError> {
    let mut bytes = [0; node_page::SIZE];
    let at = section.saturating_mul(section_size(flash));
    // What cannot be read is as good as not there.
    flash.read(at, &mut bytes).map_err(|_| NodePageError::TooShort { length: 0 })?;
    NodePage::parse(&bytes)
}

/// The node page: itself, or its copy if it is damaged. If both are, says what is wrong with the page itself.
pub fn read_page<F: NorFlash>(flash: &mut F) -> Result<NodePage, NodePageError> {
    read_slot(flash, PAGE).or_else(|error| read_slot(flash, COPY).map_err(|_| error))
}

/// Whether page and copy are both good and the same. If not, the last [`Save`] was cut short, or a debug probe wrote the page.
pub fn is_doubled<F: NorFlash>(flash: &mut F) -> bool {
    match (read_slot(flash, PAGE), read_slot(flash, COPY)) {
        (Ok(page), Ok(copy)) => page == copy,
        _ => false,
    }
}

/// A node page on its way into the flash.
#[derive(Clone, Copy, Debug)]
pub struct Save {
    /// The two places, in the order in which they are written: a good one last.
    order: [u32; 2],
    steps: u8,
}

impl Save {
    /// Begins to keep a page.
    pub fn new<F: NorFlash>(flash: &mut F) -> Self {
        let order = if read_slot(flash, PAGE).is_ok() { [COPY, PAGE] } else { [PAGE, COPY] };
        Save { order, steps: 0 }
    }

    /// Goes on by one erasure or one write. `page` must be the same in all steps. Gives nothing as long as there is more to do.
    pub fn step<F: NorFlash>(&mut self, flash: &mut F, page: &NodePage) -> Option<Result<(), StorageError>> {
        let [first, second] = self.order;
        let result = match self.steps {
            0 => erase(flash, first),
            1 => write_slot(flash, first, page),
            2 => erase(flash, second),
            _ => write_slot(flash, second, page),
        };
        self.steps = self.steps.saturating_add(1);
        if result.is_ok() && self.steps < 4 { None } else { Some(result) }
    }
}

fn write_slot<F: NorFlash>(flash: &mut F, section: u32, page: &NodePage) -> Result<(), StorageError> {
    let bytes = page.encode().map_err(|_| StorageError)?;
    let at = section.saturating_mul(section_size(flash));
    flash.write(at, &bytes).map_err(|_| StorageError)?;
    let mut read = [0; node_page::SIZE];
    flash.read(at, &mut read).map_err(|_| StorageError)?;
    if read == bytes { Ok(()) } else { Err(StorageError) }
}

/// An entry of the fault log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Entry {
    /// Its number, counting from 1.
    pub number: u32,
    /// When, in ms since the module started.
    pub time_ms: u32,
    /// In which start since the log was new, counting from 1; wraps.
    pub boot: u16,
    /// The number of the fault; 0: the module started.
    pub fault: u8,
    /// What belongs to it, see [`crate::service`].
    pub data: u16,
}

impl Entry {
    fn encode(&self) -> [u8; ENTRY_SIZE] {
        let [n0, n1, n2, n3] = self.number.to_le_bytes();
        let [t0, t1, t2, t3] = self.time_ms.to_le_bytes();
        let ([b0, b1], [d0, d1]) = (self.boot.to_le_bytes(), self.data.to_le_bytes());
        let body = [n0, n1, n2, n3, t0, t1, t2, t3, b0, b1, self.fault, 0, d0, d1];
        let [c0, c1] = check(&body);
        [n0, n1, n2, n3, t0, t1, t2, t3, b0, b1, self.fault, 0, d0, d1, c0, c1]
    }

    fn decode(bytes: &[u8; ENTRY_SIZE]) -> Option<Self> {
        let [body @ .., c0, c1] = *bytes;
        if check(&body) != [c0, c1] {
            return None;
        }
        let [n0, n1, n2, n3, t0, t1, t2, t3, b0, b1, fault, _, d0, d1] = body;
        Some(Entry {
            number: u32::from_le_bytes([n0, n1, n2, n3]),
            time_ms: u32::from_le_bytes([t0, t1, t2, t3]),
            boot: u16::from_le_bytes([b0, b1]),
            fault,
            data: u16::from_le_bytes([d0, d1]),
        })
    }
}

/// The lower half of the checksum that node pages have.
fn check(body: &[u8; 14]) -> [u8; 2] {
    let [low, high, _, _] = CRC_32.checksum(body).to_le_bytes();
    [low, high]
}

/// The fault log. It keeps at least the entries that fill three quarters of a section, at most two sections.
#[derive(Clone, Debug)]
pub struct FaultLog {
    boot: u16,
    /// Number of the newest entry in the flash; 0 if there is none.
    newest: u32,
    /// Section, and place in it, of the next entry.
    section: u32,
    place: u32,
    /// The other section is erased.
    ready: bool,
    /// Sections that are still to be erased because the log is to be forgotten.
    clearing: u8,
    /// Entries that a section has room for.
    places: u32,
    waiting: [Entry; WAITING],
    count: usize,
    lost: u32,
    errors: u32,
}

impl FaultLog {
    /// Finds the end of the log, and counts this start of the module.
    pub fn open<F: NorFlash>(flash: &mut F) -> Self {
        let mut log = FaultLog {
            boot: 0,
            newest: 0,
            section: 0,
            place: 0,
            ready: false,
            clearing: 0,
            places: places(flash),
            waiting: [Entry::default(); WAITING],
            count: 0,
            lost: 0,
            errors: 0,
        };
        // Where the entries of each section end, and the newest that it has.
        let mut sections = [(0, Entry::default()); 2];
        for (section, (end, newest)) in LOG.into_iter().zip(&mut sections) {
            for place in 0..places(flash) {
                let bytes = read_entry(flash, section, place);
                if bytes != [ERASED; ENTRY_SIZE] {
                    *end = place + 1;
                }
                if let Some(entry) = Entry::decode(&bytes).filter(|entry| entry.number > newest.number) {
                    *newest = entry;
                }
            }
        }
        let [(first_end, first), (second_end, second)] = sections;
        let (section, place, other, newest) = if second.number > first.number {
            (1, second_end, first_end, second)
        } else {
            (0, first_end, second_end, first)
        };
        log.section = section;
        log.place = place;
        log.ready = other == 0;
        log.newest = newest.number;
        log.boot = newest.boot.wrapping_add(1);
        log
    }

    /// Which start this is since the log was new, counting from 1; wraps.
    pub fn boot(&self) -> u16 {
        self.boot
    }

    /// Number of the newest entry in the flash; 0 if there is none.
    pub fn newest(&self) -> u32 {
        self.newest
    }

    /// Entries that were lost because too many waited.
    pub fn lost(&self) -> u32 {
        self.lost
    }

    /// Writes and erasures that failed.
    pub fn errors(&self) -> u32 {
        self.errors
    }

    /// Whether entries wait to be written, or sections to be erased.
    pub fn is_busy(&self) -> bool {
        self.count > 0 || self.clearing > 0
    }

    /// Whether [`FaultLog::work`] has nothing to do: nothing is on its way, and there is room for more.
    pub fn is_idle(&self) -> bool {
        !self.is_busy() && (self.ready || self.place < self.spare())
    }

    /// From this place on there should be room in the other section. A quarter is spare, so that a robot that is armed for long has room.
    fn spare(&self) -> u32 {
        self.places - self.places / 4
    }

    /// Adds an entry; it is written by [`FaultLog::work`].
    pub fn push(&mut self, time_ms: u32, fault: u8, data: u16) {
        match self.waiting.get_mut(self.count) {
            Some(slot) => {
                *slot = Entry { number: 0, time_ms, boot: self.boot, fault, data };
                self.count += 1;
            }
            None => self.lost = self.lost.saturating_add(1),
        }
    }

    /// Forgets all entries. How often the module was started is not forgotten.
    pub fn clear(&mut self, time_ms: u32) {
        self.clearing = 2;
        self.count = 0;
        self.push(time_ms, 0, 0);
    }

    /// Does one thing that is due: writes one entry, or erases one section, if that may be now.
    pub fn work<F: NorFlash>(&mut self, flash: &mut F, may_erase: bool) {
        if self.clearing > 0 {
            if may_erase {
                // First the one with the newest entries, so that a log that was cleared in part does not seem to go on.
                self.erase_other_or_own(flash, self.clearing == 2);
            }
            return;
        }
        if self.place >= self.places && self.ready {
            self.section ^= 1;
            self.place = 0;
            self.ready = false;
        }
        if may_erase && !self.ready && self.place >= self.spare() {
            if erase(flash, self.section ^ 1).is_ok() {
                self.ready = true;
            } else {
                self.errors = self.errors.saturating_add(1);
            }
            return;
        }
        if self.place < self.places
            && let [first, rest @ ..] = &self.waiting
            && self.count > 0
        {
            let entry = Entry { number: self.newest.saturating_add(1), ..*first };
            let mut moved = [Entry::default(); WAITING];
            moved.iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
            let at = position(flash, self.section, self.place);
            if flash.write(at, &entry.encode()).is_err() {
                self.errors = self.errors.saturating_add(1);
                self.lost = self.lost.saturating_add(1);
            } else {
                self.newest = entry.number;
            }
            // Also after a failure: what lies there now is not known.
            self.place += 1;
            self.waiting = moved;
            self.count -= 1;
        }
    }

    fn erase_other_or_own<F: NorFlash>(&mut self, flash: &mut F, own: bool) {
        let section = if own { self.section } else { self.section ^ 1 };
        if erase(flash, section).is_err() {
            self.errors = self.errors.saturating_add(1);
        }
        self.clearing -= 1;
        if self.clearing == 0 {
            (self.place, self.newest, self.ready) = (0, 0, true);
        }
    }

    /// The entry that is `back` before the newest one in the flash.
    pub fn entry<F: NorFlash>(&self, flash: &mut F, back: u32) -> Option<Entry> {
        let number = self.newest.checked_sub(back).filter(|number| *number > 0)?;
        let places = places(flash);
        // Where it is if all writes succeeded, or else further back.
        let (mut section, mut place) = (self.section, self.place);
        let mut skip = back + 1;
        for _ in 0..2 {
            if skip <= place {
                place -= skip;
                while place < places {
                    let entry = Entry::decode(&read_entry(flash, section, place));
                    if let Some(entry) = entry.filter(|entry| entry.number <= number) {
                        return (entry.number == number).then_some(entry);
                    }
                    match place.checked_sub(1) {
                        Some(before) => place = before,
                        None => break,
                    }
                }
                skip = 1;
            } else {
                skip -= place;
            }
            section ^= 1;
            place = places;
        }
        None
    }
}

/// Entries that a section has room for.
fn places(flash: &impl ReadNorFlash) -> u32 {
    section_size(flash) / ENTRY_SIZE as u32
}

fn position(flash: &impl ReadNorFlash, section: u32, place: u32) -> u32 {
    section.saturating_mul(section_size(flash)).saturating_add(place.saturating_mul(ENTRY_SIZE as u32))
}

/// What cannot be read is no entry.
fn read_entry<F: NorFlash>(flash: &mut F, section: u32, place: u32) -> [u8; ENTRY_SIZE] {
    let mut bytes = [0; ENTRY_SIZE];
    let at = position(flash, section, place);
    match flash.read(at, &mut bytes) {
        Ok(()) => bytes,
        Err(_) => [0; ENTRY_SIZE],
    }
}

/// Flash that is none: memory that behaves like it, for modules that are emulated or simulated. It has `N` bytes in [`SECTIONS`] sections, can
/// only be written where it is erased, and starts erased.
#[derive(Clone, Debug)]
pub struct RamFlash<const N: usize> {
    bytes: [u8; N],
}

impl<const N: usize> RamFlash<N> {
    /// Erased flash.
    pub const ERASED: Self = RamFlash { bytes: [ERASED; N] };

    fn range(&mut self, from: u32, length: usize) -> Result<&mut [u8], NorFlashErrorKind> {
        let from = from as usize;
        let range = from..from.saturating_add(length);
        self.bytes.get_mut(range).ok_or(NorFlashErrorKind::OutOfBounds)
    }
}

impl<const N: usize> ErrorType for RamFlash<N> {
    type Error = NorFlashErrorKind;
}

impl<const N: usize> ReadNorFlash for RamFlash<N> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let source = self.range(offset, bytes.len())?;
        bytes.iter_mut().zip(source).for_each(|(to, from)| *to = *from);
        Ok(())
    }

    fn capacity(&self) -> usize {
        N
    }
}

impl<const N: usize> NorFlash for RamFlash<N> {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = N / SECTIONS as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        self.range(from, to.saturating_sub(from) as usize)?.fill(ERASED);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let target = self.range(offset, bytes.len())?;
        if target.iter().any(|byte| *byte != ERASED) {
            return Err(NorFlashErrorKind::Other);
        }
        target.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::node_page::tests::page;
    use proptest::prelude::*;
    use std::vec::Vec;

    const SIZE: usize = 4 * 512;

    /// Flash that loses its power after so many double words were programmed or erased: the one at which it happens, and the rest of an
    /// erasure, read as anything afterwards.
    #[derive(Clone, Debug)]
    pub struct Dying {
        pub flash: RamFlash<SIZE>,
        pub left: usize,
        pub noise: u32,
    }

    impl Dying {
        fn noise(&mut self) -> u8 {
            self.noise = self.noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (self.noise >> 24) as u8
        }

        fn garble(&mut self, from: usize, to: usize) {
            for at in from..to {
                self.flash.bytes[at] &= self.noise();
            }
        }
    }

    impl ErrorType for Dying {
        type Error = NorFlashErrorKind;
    }

    impl ReadNorFlash for Dying {
        const READ_SIZE: usize = 1;

        fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
            self.flash.read(offset, bytes)
        }

        fn capacity(&self) -> usize {
            SIZE
        }
    }

    impl NorFlash for Dying {
        const WRITE_SIZE: usize = 8;
        const ERASE_SIZE: usize = SIZE / 4;

        fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
            let words = (to - from) as usize / 8;
            if self.left < words {
                let done = from as usize + 8 * self.left;
                self.flash.bytes[from as usize..done].fill(ERASED);
                self.garble(done, to as usize);
                self.left = 0;
                return Err(NorFlashErrorKind::Other);
            }
            self.left -= words;
            self.flash.erase(from, to)
        }

        fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
            for (i, word) in bytes.chunks(8).enumerate() {
                let at = offset + 8 * i as u32;
                if self.left == 0 {
                    self.garble(at as usize, at as usize + 8);
                    return Err(NorFlashErrorKind::Other);
                }
                self.left -= 1;
                self.flash.write(at, word)?;
            }
            Ok(())
        }
    }

    fn saved<F: NorFlash>(flash: &mut F, page: &NodePage) -> Result<(), StorageError> {
        let mut save = Save::new(flash);
        loop {
            if let Some(result) = save.step(flash, page) {
                return result;
            }
        }
    }

    #[test]
    fn a_page_is_read_as_it_was_saved() {
        let mut flash = RamFlash::<SIZE>::ERASED;
        assert_eq!(read_page(&mut flash), Err(NodePageError::Empty));
        for node in [3, 4, 5] {
            let page = NodePage { node, ..page() };
            assert_eq!(saved(&mut flash, &page), Ok(()));
            assert_eq!(read_page(&mut flash), Ok(page));
            assert!(is_doubled(&mut flash));
        }
        // A damaged page is read from its copy, and the next one is saved with the copy still there.
        flash.bytes[3 * SIZE / 4 + 20] ^= 1;
        assert_eq!(read_page(&mut flash).map(|page| page.node), Ok(5));
        assert!(!is_doubled(&mut flash));
        assert_eq!(Save::new(&mut flash).order, [PAGE, COPY]);
        assert_eq!(saved(&mut flash, &page()), Ok(()));
        assert!(is_doubled(&mut flash));
    }

    /// The power goes at every moment of a save, and then at every moment of the save that mends it.
    #[test]
    fn whenever_the_power_goes_the_old_or_the_new_page_is_read() {
        let (old, new) = (page(), NodePage { node: 7, ..page() });
        let mut flash = RamFlash::<SIZE>::ERASED;
        saved(&mut flash, &old).unwrap();
        let (mut kept, mut changed) = (0, 0);
        for left in 0.. {
            let mut dying = Dying { flash: flash.clone(), left, noise: left as u32 };
            let done = saved(&mut dying, &new).is_ok();
            let read = read_page(&mut dying.flash).unwrap_or_else(|e| panic!("after {left}: {e}"));
            assert!(read == old || read == new, "after {left}");
            assert!(!done || read == new);
            if read == old {
                kept += 1
            } else {
                changed += 1
            }
            for again in (0..400).step_by(7) {
                let mut second = Dying { flash: dying.flash.clone(), left: again, noise: again as u32 };
                let _ = saved(&mut second, &new);
                let read = read_page(&mut second.flash).unwrap_or_else(|e| panic!("after {left} and {again}: {e}"));
                assert!(read == old || read == new, "after {left} and {again}");
            }
            if done {
                break;
            }
        }
        assert!(kept > 50 && changed > 50, "{kept} {changed}");
    }

    fn all<F: NorFlash>(log: &FaultLog, flash: &mut F) -> Vec<Entry> {
        (0..).map_while(|back| log.entry(flash, back)).collect()
    }

    #[test]
    fn the_log_outlives_the_power_and_counts_starts() {
        let mut flash = RamFlash::<SIZE>::ERASED;
        for boot in 1..=3u16 {
            let mut log = FaultLog::open(&mut flash);
            assert_eq!(log.boot(), boot);
            log.push(0, 0, 0);
            log.push(1000 + u32::from(boot), 37, 900);
            while log.is_busy() {
                log.work(&mut flash, false);
            }
            let entries = all(&log, &mut flash);
            assert_eq!(entries.len(), 2 * usize::from(boot));
            let newest =
                Entry { number: 2 * u32::from(boot), time_ms: 1000 + u32::from(boot), boot, fault: 37, data: 900 };
            assert_eq!(entries[0], newest);
            assert!(entries.windows(2).all(|pair| pair[0].number == pair[1].number + 1));
        }
    }

    #[test]
    fn the_log_goes_round_and_keeps_the_newest() {
        let mut flash = RamFlash::<SIZE>::ERASED;
        let mut log = FaultLog::open(&mut flash);
        for i in 1..=500u32 {
            log.push(i, 40, 0);
            for _ in 0..3 {
                log.work(&mut flash, true);
            }
            assert!(!log.is_busy());
            let entries = all(&log, &mut flash);
            let times: Vec<u32> = entries.iter().map(|e| e.time_ms).collect();
            assert_eq!(times, (1..=i).rev().take(times.len()).collect::<Vec<_>>());
            // 32 a section, of which a quarter is erased ahead.
            assert!(times.len() >= 24.min(i as usize), "{i}: {}", times.len());
            if i % 37 == 0 {
                let boot = log.boot();
                log = FaultLog::open(&mut flash);
                assert_eq!((log.newest(), log.boot()), (i, boot + 1));
            }
        }
        assert_eq!((log.lost(), log.errors()), (0, 0));
    }

    #[test]
    fn an_armed_module_erases_nothing_and_its_log_waits() {
        let mut flash = RamFlash::<SIZE>::ERASED;
        let mut log = FaultLog::open(&mut flash);
        // Both sections are erased: 64 entries, 8 that wait.
        for i in 1..=80 {
            log.push(i, 40, 0);
            log.work(&mut flash, false);
        }
        assert_eq!((log.newest(), log.lost()), (64, 8));
        while log.is_busy() {
            log.work(&mut flash, true);
        }
        assert_eq!((log.newest(), all(&log, &mut flash)[0].time_ms), (72, 72));
    }

    #[test]
    fn what_was_cleared_is_gone_and_starts_are_still_counted() {
        let mut flash = RamFlash::<SIZE>::ERASED;
        for _ in 0..4 {
            let mut log = FaultLog::open(&mut flash);
            (0..20).for_each(|i| {
                log.push(i, 38, 0);
                log.work(&mut flash, true);
                log.work(&mut flash, true);
            });
        }
        let mut log = FaultLog::open(&mut flash);
        log.clear(77);
        log.work(&mut flash, false);
        assert!(log.is_busy(), "it waits until the module is disarmed");
        while log.is_busy() {
            log.work(&mut flash, true);
        }
        assert_eq!(all(&log, &mut flash), [Entry { number: 1, time_ms: 77, boot: 5, fault: 0, data: 0 }]);
        assert_eq!(FaultLog::open(&mut flash).boot(), 6);
    }

    proptest! {
        /// Whenever the power goes while the log is written or erased: what is read is a part of what was written, in its order, and the log goes on.
        #[test]
        fn a_log_that_was_cut_short_is_read_and_goes_on(left in 0usize..600, entries in 1u32..150) {
            let mut dying = Dying { flash: RamFlash::ERASED, left, noise: left as u32 ^ entries << 10 };
            let mut log = FaultLog::open(&mut dying);
            for i in 1..=entries {
                log.push(i, 40, (i * 7) as u16);
                log.work(&mut dying, true);
                log.work(&mut dying, true);
                if dying.left == 0 {
                    break;
                }
            }
            let mut flash = dying.flash;
            let mut log = FaultLog::open(&mut flash);
            let read = all(&log, &mut flash);
            for entry in &read {
                prop_assert_eq!((entry.fault, entry.data), (40, (entry.time_ms * 7) as u16));
            }
            prop_assert!(read.windows(2).all(|pair| pair[0].time_ms > pair[1].time_ms));
            log.push(1_000, 41, 0);
            for _ in 0..4 {
                log.work(&mut flash, true);
            }
            prop_assert_eq!(log.entry(&mut flash, 0).map(|e| e.time_ms), Some(1_000));
            prop_assert_eq!(FaultLog::open(&mut flash).newest(), log.newest());
        }
    }
}
