//! The regions of the flash that are not code, see [`composer_firmware::memory_map`]: the policy, which is only read, and the storage, which is
//! written, too.
//!
//! The driver is written against the registers (RM0440, chapter 5): that of embassy-stm32 can panic, and stops all interrupts while it erases.
//! Code and storage lie in different banks, so the processor goes on while the storage is erased, interrupts included, as long as it
//! touches neither policy nor storage. With the option bit DBANK cleared there is one bank, and it stands still for some 22 ms.

use composer_firmware::memory_map::{FLASH_ADDRESS, POLICY_ADDRESS, POLICY_SIZE, SECTION_SIZE, STORAGE_ADDRESS};
use composer_firmware::storage::SECTIONS;
use composer_shared::policy::{IMAGE_SIZE, Policy, PolicyError};
use embassy_stm32::Peri;
use embassy_stm32::pac::FLASH;
use embassy_stm32::peripherals;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};

const _: () = assert!(IMAGE_SIZE <= POLICY_SIZE as usize);

/// The policy, checked; it is read in place.
pub fn policy() -> Result<Policy<'static>, PolicyError> {
    // SAFETY: this part of the flash is always readable, the linker places nothing there, and nobody writes it while the program runs.
    Policy::parse(unsafe { core::slice::from_raw_parts(POLICY_ADDRESS as *const u8, IMAGE_SIZE) })
}

/// A page of the chip with two banks. One with a single bank has pages of [`SECTION_SIZE`], so a section is always one page, and in two banks
/// only its first half is used.
const PAGE_SIZE: u32 = 2048;
const BANK_SIZE: u32 = 256 * 1024;
const DOUBLE_WORD: u32 = 8;

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
        for (offset, byte) in (offset..).zip(bytes) {
            // SAFETY: within the storage, as was checked. A double word that lost its power reads as anything, and the chip notes a wrong checksum, which
            // `fail` takes back.
            *byte = unsafe { (address(offset) as *const u8).read_volatile() };
        }
        Ok(())
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
        for offset in (from..to).step_by(PAGE_SIZE as usize) {
            let place = address(offset) - FLASH_ADDRESS;
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
            })?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let (words, _) = bytes.as_chunks::<{ DOUBLE_WORD as usize }>();
        for (offset, word) in (offset..).step_by(DOUBLE_WORD as usize).zip(words) {
            let [a, b, c, d, e, f, g, h] = *word;
            let at = address(offset) as *mut u32;
            unlocked(|| {
                FLASH.cr().write(|w| w.set_pg(true));
                // SAFETY: within the storage, as was checked, and a multiple of 8.
                unsafe {
                    at.write_volatile(u32::from_le_bytes([a, b, c, d]));
                    at.add(1).write_volatile(u32::from_le_bytes([e, f, g, h]));
                }
                finish()
            })?;
        }
        Ok(())
    }
}
