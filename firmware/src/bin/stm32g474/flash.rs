//! The regions of the flash that are not code, see [`composer_firmware::memory_map`]: the policies and the storage, which the module writes itself.
//!
//! The driver is written against the registers (RM0440, chapter 5): that of embassy-stm32 can panic, and stops all interrupts while it erases.
//! Code and these regions lie in different banks, so the processor goes on while they are erased, interrupts included, as long as it
//! touches neither policies nor storage. With the option bit DBANK cleared there is one bank, and it stands still for some 22 ms.
//!
//! A double word that lost its power while it was written has a wrong checksum when it is read; the chip tells by an exception, [`fail`](crate::fail) takes that back, and the
//! reading fails.

use composer_firmware::memory_map::{
    FLASH_ADDRESS, POLICY_ADDRESS, POLICY_SIZE, RECORDS_ADDRESS, SECTION_SIZE, STORAGE_ADDRESS,
};
use composer_firmware::storage::SECTIONS;
use composer_firmware::update::{self, PolicyFlash, image_in, slot_at};
use composer_shared::policy::{Policy, PolicyError};
use composer_shared::update::{SLOT_SIZE, Slot};
use embassy_stm32::Peri;
use embassy_stm32::pac::{FLASH, IWDG, iwdg};
use embassy_stm32::peripherals;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};

use crate::fail;

const _: () = assert!(update::SIZE == POLICY_SIZE && update::SECTION == SECTION_SIZE);
const _: () = assert!(RECORDS_ADDRESS == POLICY_ADDRESS + 2 * SLOT_SIZE as u32);

/// The policy in a slot, checked; it is read in place.
pub fn policy(slot: Slot) -> Result<Policy<'static>, PolicyError> {
    let region = bytes(slot_at(slot), SLOT_SIZE).unwrap_or_default();
    Policy::parse(image_in(region).unwrap_or_default())
}

/// So many bytes of the policies.
fn bytes(from: u32, length: usize) -> Option<&'static [u8]> {
    let end = (from as usize).checked_add(length)?;
    // SAFETY: this part of the flash is always readable, the linker places nothing there, and what a controller runs with is not written while it does.
    (end <= POLICY_SIZE as usize)
        .then(|| unsafe { core::slice::from_raw_parts((POLICY_ADDRESS as *const u8).add(from as usize), length) })
}

/// A page of the chip with two banks. One with a single bank has pages of [`SECTION_SIZE`], so a section is always one page, and in two banks
/// only its first half is used.
const PAGE_SIZE: u32 = 2048;
const BANK_SIZE: u32 = 256 * 1024;
const DOUBLE_WORD: u32 = 8;

/// Reads so many bytes from an address in the flash.
fn read(at: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
    fail::forget_checksum();
    for (at, byte) in (at..).zip(bytes) {
        // SAFETY: callers have checked that it lies in a region that is always readable.
        *byte = unsafe { (at as *const u8).read_volatile() };
    }
    if fail::checksum_was_wrong() { Err(NorFlashErrorKind::Other) } else { Ok(()) }
}

/// Erases the page at an address.
fn erase_page(at: u32) -> Result<(), NorFlashErrorKind> {
    let place = at - FLASH_ADDRESS;
    let banks = FLASH.optr().read().dbank();
    let page = if banks { place % BANK_SIZE / PAGE_SIZE } else { place / SECTION_SIZE };
    unlocked(|| {
        FLASH.cr().write(|w| {
            w.set_per(true);
            w.set_bker(banks && place >= BANK_SIZE);
            w.set_pnb(page as u8);
        });
        FLASH.cr().modify(|w| w.set_strt(true));
        finish()
    })
}

/// Writes a double word at an address.
fn write_word(at: u32, word: [u8; DOUBLE_WORD as usize]) -> Result<(), NorFlashErrorKind> {
    let [a, b, c, d, e, f, g, h] = word;
    let at = at as *mut u32;
    unlocked(|| {
        FLASH.cr().write(|w| w.set_pg(true));
        // SAFETY: within the policies or the storage, as callers have checked, and a multiple of 8.
        unsafe {
            at.write_volatile(u32::from_le_bytes([a, b, c, d]));
            at.add(1).write_volatile(u32::from_le_bytes([e, f, g, h]));
        }
        finish()
    })
}

/// The policies: two slots and their records, without gaps.
pub struct Policies(());

impl Policies {
    /// Those of this chip. Beside its [`Storage`], because both are written with the same registers, one after the other.
    pub fn new(_: &Storage) -> Self {
        Policies(())
    }
}

impl PolicyFlash for Policies {
    fn bytes(&self, from: u32, length: usize) -> Option<&[u8]> {
        bytes(from, length)
    }
}

impl ErrorType for Policies {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Policies {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        read(POLICY_ADDRESS + offset, bytes)
    }

    fn capacity(&self) -> usize {
        POLICY_SIZE as usize
    }
}

impl NorFlash for Policies {
    const WRITE_SIZE: usize = DOUBLE_WORD as usize;
    const ERASE_SIZE: usize = SECTION_SIZE as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        for offset in (from..to).step_by(SECTION_SIZE as usize) {
            erase_page(POLICY_ADDRESS + offset)?;
            if FLASH.optr().read().dbank() {
                // Two pages take up to 50 ms, the patience of the watchdog. The main loop fed it before.
                IWDG.kr().write(|w| w.set_key(iwdg::vals::Key::RESET));
                erase_page(POLICY_ADDRESS + offset + PAGE_SIZE)?;
            }
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let words = bytes.as_chunks::<{ DOUBLE_WORD as usize }>().0;
        (offset..)
            .step_by(DOUBLE_WORD as usize)
            .zip(words)
            .try_for_each(|(at, word)| write_word(POLICY_ADDRESS + at, *word))
    }
}

/// The storage. Its sections follow one another without a gap, whatever the pages of the chip.
pub struct Storage {
    _flash: Peri<'static, peripherals::FLASH>,
}

impl Storage {
    /// The storage of this chip.
    pub fn new(flash: Peri<'static, peripherals::FLASH>) -> Self {
        Storage { _flash: flash }
    }
}

/// Where a byte of the storage lies.
fn address(offset: u32) -> u32 {
    STORAGE_ADDRESS + offset / PAGE_SIZE * SECTION_SIZE + offset % PAGE_SIZE
}

/// Waits for the end of what was begun: at most 25 ms for an erasure, 0.1 ms for a double word. Longer, and the watchdog restarts the chip.
fn finish() -> Result<(), NorFlashErrorKind> {
    while FLASH.sr().read().bsy() {}
    let status = FLASH.sr().read();
    let failed =
        status.operr() || status.progerr() || status.wrperr() || status.pgaerr() || status.sizerr() || status.pgserr();
    if failed { Err(NorFlashErrorKind::Other) } else { Ok(()) }
}

/// Lets `work` change the flash: unlocks it, forgets old errors, and locks it again.
fn unlocked(work: impl FnOnce() -> Result<(), NorFlashErrorKind>) -> Result<(), NorFlashErrorKind> {
    while FLASH.sr().read().bsy() {}
    if FLASH.cr().read().lock() {
        FLASH.keyr().write_value(0x4567_0123);
        FLASH.keyr().write_value(0xcdef_89ab);
    }
    // Flags are cleared by writing ones.
    FLASH.sr().modify(|_| {});
    let result = work();
    FLASH.cr().write(|w| w.set_lock(true));
    // What the data cache has of the flash may be out of date.
    FLASH.acr().modify(|w| w.set_dcen(false));
    FLASH.acr().modify(|w| w.set_dcrst(true));
    FLASH.acr().modify(|w| w.set_dcrst(false));
    FLASH.acr().modify(|w| w.set_dcen(true));
    result
}

impl ErrorType for Storage {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Storage {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        // Pages of the chip follow one another with gaps; nothing that is read crosses one.
        let (first, rest) = bytes.split_at_mut(bytes.len().min((PAGE_SIZE - offset % PAGE_SIZE) as usize));
        read(address(offset), first)?;
        if rest.is_empty() { Ok(()) } else { self.read(offset + first.len() as u32, rest) }
    }

    fn capacity(&self) -> usize {
        (SECTIONS * PAGE_SIZE) as usize
    }
}

impl NorFlash for Storage {
    const WRITE_SIZE: usize = DOUBLE_WORD as usize;
    const ERASE_SIZE: usize = PAGE_SIZE as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        (from..to).step_by(PAGE_SIZE as usize).try_for_each(|offset| erase_page(address(offset)))
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let words = bytes.as_chunks::<{ DOUBLE_WORD as usize }>().0;
        (offset..).step_by(DOUBLE_WORD as usize).zip(words).try_for_each(|(at, word)| write_word(address(at), *word))
    }
}
