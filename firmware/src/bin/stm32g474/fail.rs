//! What happens when something goes very wrong: the motors are switched off, and the watchdog restarts the chip.
//!
//! flip-link puts the stack below all variables, at the start of the RAM: one that overflows runs out of the RAM, which is a fault, instead of
//! overwriting variables.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};
use embassy_stm32::pac;

unsafe extern "C" {
    /// Where the stack begins (its highest address), and where the variables begin.
    static _stack_start: u32;
    static __sdata: u32;
}

/// Lets a processor that locks up (a fault in the handler of a fault, such as a stack overflow) switch
/// the PWM off by hardware.
pub fn prepare() {
    if &raw const _stack_start > &raw const __sdata {
        defmt::warn!("linked without flip-link: a stack that overflows would overwrite variables");
    }
    embassy_stm32::pac::SYSCFG.cfgr2().modify(|w| w.set_cll(true));
}

/// Takes the force off both motors, by the registers alone: PWM outputs off, bridges asleep.
fn motors_off() {
    pac::TIM1.bdtr().modify(|w| w.set_moe(false));
    pac::GPIOB.bsrr().write(|w| {
        w.set_br(6, true);
        w.set_br(7, true);
    });
}

fn wait_for_watchdog() -> ! {
    loop {
        cortex_m::asm::nop();
    }
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    cortex_m::interrupt::disable();
    motors_off();
    defmt::error!("{}", defmt::Display2Format(info));
    wait_for_watchdog()
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    motors_off();
    defmt::error!("fault at {=u32:08x}", frame.pc());
    wait_for_watchdog()
}

#[exception]
unsafe fn DefaultHandler(exception: i16) {
    motors_off();
    defmt::error!("unexpected exception {=i16}", exception);
    wait_for_watchdog()
}

/// A double word had a wrong checksum when it was read.
static CHECKSUM: AtomicBool = AtomicBool::new(false);

/// Begins a reading of flash that may have lost its power.
pub fn forget_checksum() {
    CHECKSUM.store(false, Ordering::Relaxed);
}

/// Whether a double word had a wrong checksum since.
pub fn checksum_was_wrong() -> bool {
    // The exception comes with the reading; what is read is used only behind this.
    cortex_m::asm::dsb();
    CHECKSUM.load(Ordering::Relaxed)
}

/// A double word of storage or policies that lost its power while it was written has a wrong checksum, which the chip tells by this exception. The reader
/// asks for it, or finds out by a checksum of its own.
#[exception]
unsafe fn NonMaskableInt() {
    let checked = pac::FLASH.eccr().read();
    if checked.eccd() || checked.eccd2() {
        // Flags are cleared by writing ones.
        pac::FLASH.eccr().modify(|_| {});
        CHECKSUM.store(true, Ordering::Relaxed);
        return;
    }
    motors_off();
    defmt::error!("unexpected non-maskable interrupt");
    wait_for_watchdog()
}
