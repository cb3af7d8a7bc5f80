//! The image of an emulated module: QEMU's `mps2-an386`, a Cortex-M4F. Its only peripheral is a UART, the link to the simulator.
#![no_std]
#![no_main]

use core::panic::PanicInfo;
use core::slice;

use composer_firmware::emulated::Lasting;
use composer_firmware::link::{FromModule, MESSAGE_MAX, Receiver, Text, decode, encode, module};
use composer_firmware::update::{PolicyFlash, SECTION, SIZE, image_in, slot_at};
use composer_shared::policy::Policy;
use composer_shared::update::{SLOT_SIZE, Slot};
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m_rt::{ExceptionFrame, entry, exception};
use cortex_m_semihosting::debug;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use uart::Uart;

#[entry]
fn main() -> ! {
    let mut uart = Uart::new();
    let mut flash = Flash;
    let policy = Policy::parse(flash.lasting(Slot::A).unwrap_or_default());
    send(&module::hello(policy.as_ref().ok()));
    let mut module = match policy {
        Ok(policy) => module::Module::new(policy, flash),
        Err(error) => {
            send(&FromModule::Refused(Text::of(error).as_str()));
            loop {
                uart.read();
            }
        }
    };
    let mut receiver = Receiver::default();
    loop {
        if let Some(message) = receiver.push(uart.read()) {
            module.serve(message.and_then(decode), &mut send);
        }
    }
}

/// The flash of the policies. This machine's is RAM, so it is emulated: words are written where it is erased, once.
#[derive(Debug)]
struct Flash;

impl Flash {
    /// Where it begins.
    fn start() -> *mut u8 {
        unsafe extern "C" {
            /// From `boards/qemu.x`: an address, not a variable.
            static mut _policy_start: u8;
        }
        &raw mut _policy_start
    }

    /// Bytes that lie in it.
    fn slice<'a>(from: u32, length: usize) -> Option<&'a [u8]> {
        let end = (from as usize).checked_add(length)?;
        // SAFETY: the linker script reserves these bytes, and nobody writes what a controller runs with: `Updater` writes the other slot.
        (end <= SIZE as usize).then(|| unsafe { slice::from_raw_parts(Flash::start().add(from as usize), length) })
    }

    fn put(at: u32, byte: u8) {
        // SAFETY: callers have checked that it lies in the region, which nothing else writes; there is one core and no interrupt handler.
        unsafe { Flash::start().add(at as usize).write_volatile(byte) }
    }
}

impl Lasting<'static> for Flash {
    fn lasting(&mut self, slot: Slot) -> Option<&'static [u8]> {
        image_in(Flash::slice(slot_at(slot), SLOT_SIZE)?)
    }
}

impl PolicyFlash for Flash {
    fn bytes(&self, from: u32, length: usize) -> Option<&[u8]> {
        Flash::slice(from, length)
    }
}

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        let from = Flash::slice(offset, bytes.len()).ok_or(NorFlashErrorKind::OutOfBounds)?;
        bytes.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SIZE as usize
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = SECTION as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        (from..to).for_each(|at| Flash::put(at, 0xff));
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let there = Flash::slice(offset, bytes.len()).ok_or(NorFlashErrorKind::OutOfBounds)?;
        if there.iter().any(|byte| *byte != 0xff) {
            return Err(NorFlashErrorKind::Other);
        }
        (offset..).zip(bytes).for_each(|(at, byte)| Flash::put(at, *byte));
        Ok(())
    }
}

fn send(message: &FromModule<'_>) {
    let mut buffer = [0; MESSAGE_MAX];
    encode(message, &mut buffer).iter().for_each(|byte| uart::write(*byte));
}

/// Says why on the link and ends the emulator with status 1.
fn die(words: &Text) -> ! {
    // Perhaps it never came to be enabled.
    uart::enable();
    // Ends a message that was on its way.
    uart::write(0);
    send(&FromModule::LastWords(words.as_str()));
    loop {
        debug::exit(debug::EXIT_FAILURE);
    }
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    die(&Text::of(info))
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    die(&Text::of(format_args!("hard fault at {:#010x}, called from {:#010x}", frame.pc(), frame.lr())))
}

/// UART 0 of the board (Arm Cortex-M System Design Kit, APB UART): no FIFO, one byte each way.
mod uart {
    use super::*;
    use core::ptr;

    const BASE: usize = 0x4000_4000;
    const DATA: usize = BASE;
    const STATE: usize = BASE + 0x04;
    const STATE_TX_FULL: u32 = 1;
    const STATE_RX_FULL: u32 = 1 << 1;
    const CTRL: usize = BASE + 0x08;
    const CTRL_TX_ENABLE: u32 = 1;
    const CTRL_RX_ENABLE: u32 = 1 << 1;
    const CTRL_RX_INTERRUPT: u32 = 1 << 3;
    const INTCLEAR: usize = BASE + 0x0c;
    const INT_RX: u32 = 1 << 1;
    const BAUDDIV: usize = BASE + 0x10;

    /// Seconds of silence after which the module gives up: its simulator is gone without having ended it.
    const PATIENCE: u32 = 120;
    /// Ticks of the core's clock, 25 MHz, in half a second: SysTick counts 24 bits.
    const TICK: u32 = 12_500_000;

    fn get(register: usize) -> u32 {
        // SAFETY: `register` is one of the registers above, which can be read at any time.
        unsafe { ptr::read_volatile(register as *const u32) }
    }

    fn set(register: usize, value: u32) {
        // SAFETY: `register` is one of the registers above, which can be written at any time.
        unsafe { ptr::write_volatile(register as *mut u32, value) }
    }

    /// The interrupt of received bytes.
    #[derive(Clone, Copy)]
    struct Received;

    // SAFETY: the board has interrupt 0, and nothing else has this number.
    unsafe impl cortex_m::interrupt::InterruptNumber for Received {
        fn number(self) -> u16 {
            0
        }
    }

    /// The receiving half. There are no interrupt handlers: with interrupts disabled a pending one still wakes the core from sleep, and that is all
    /// they are for.
    pub struct Uart {
        core: cortex_m::Peripherals,
        silent: u32,
    }

    impl Uart {
        pub fn new() -> Self {
            cortex_m::interrupt::disable();
            // SAFETY: the only instance; the macro of the runtime has taken none.
            let mut core = unsafe { cortex_m::Peripherals::steal() };
            enable();
            // SAFETY: no handler runs, see above.
            unsafe { cortex_m::peripheral::NVIC::unmask(Received) };
            core.SYST.set_clock_source(SystClkSource::Core);
            core.SYST.set_reload(TICK - 1);
            core.SYST.clear_current();
            core.SYST.enable_counter();
            core.SYST.enable_interrupt();
            Uart { core, silent: 0 }
        }

        fn received(&mut self) -> Option<u8> {
            (get(STATE) & STATE_RX_FULL != 0).then(|| {
                self.silent = 0;
                get(DATA) as u8
            })
        }

        /// Waits for a byte.
        pub fn read(&mut self) -> u8 {
            loop {
                if let Some(byte) = self.received() {
                    return byte;
                }
                // Then look again: a byte that comes from here on leaves the interrupt pending, and `wfi` returns at once.
                set(INTCLEAR, INT_RX);
                cortex_m::peripheral::NVIC::unpend(Received);
                if let Some(byte) = self.received() {
                    return byte;
                }
                cortex_m::asm::wfi();
                if self.core.SYST.has_wrapped() {
                    self.silent += 1;
                    cortex_m::peripheral::SCB::clear_pendst();
                    if self.silent > 2 * PATIENCE {
                        die(&Text::of(format_args!("nothing came from the simulator for {PATIENCE} s")));
                    }
                }
            }
        }
    }

    /// Switches the UART on.
    pub fn enable() {
        // The smallest divisor that is allowed. QEMU passes bytes on at once anyway.
        set(BAUDDIV, 16);
        set(CTRL, CTRL_TX_ENABLE | CTRL_RX_ENABLE | CTRL_RX_INTERRUPT);
    }

    /// Sends a byte.
    pub fn write(byte: u8) {
        while get(STATE) & STATE_TX_FULL != 0 {}
        set(DATA, byte.into());
    }
}
