//! What outlasts a reset: two words of RAM that the start-up code leaves alone. They keep while the chip has power, and for a moment without.

use core::mem::MaybeUninit;
use core::ptr;

use composer_firmware::boot::{Boot, ResetCause, Retained};
use embassy_stm32::pac;

#[unsafe(link_section = ".uninit.retained")]
static mut WORDS: MaybeUninit<[u32; 2]> = MaybeUninit::uninit();

/// Why the chip started, and what it still knows. Once, at the start.
pub fn boot() -> Boot {
    let flags = pac::RCC.csr().read();
    // The reset pin is pulled by every reset, so its flag comes last.
    let said = if flags.iwdgrstf() || flags.wwdgrstf() {
        ResetCause::Watchdog
    } else if flags.sftrstf() {
        ResetCause::Software
    } else if flags.borrstf() {
        ResetCause::PowerOn
    } else if flags.lpwrrstf() || flags.oblrstf() {
        ResetCause::Other
    } else if flags.pinrstf() {
        ResetCause::Pin
    } else {
        ResetCause::Other
    };
    pac::RCC.csr().modify(|w| w.set_rmvf(true));
    // SAFETY: any bits are two words, and nobody else has them.
    let words = unsafe { ptr::read_volatile((&raw const WORDS).cast::<[u32; 2]>()) };
    Boot::new(said, words)
}

/// Keeps this for the next start.
pub fn keep(retained: Retained) {
    // SAFETY: only the main loop writes them. Between the two words they do not check, and the module would have been switched on.
    unsafe { ptr::write_volatile((&raw mut WORDS).cast::<[u32; 2]>(), retained.words()) };
}
