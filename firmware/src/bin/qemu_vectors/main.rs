//! Compares the kernels of the emulated Cortex-M4F with the host's results, bit by bit: `tests/tests/arm_kernels.rs` runs it with a file of
//! inputs and results loaded at [`cases::ADDRESS`]. Exits with failure at the first difference, and says which it is.
#![no_std]
#![no_main]

mod cases;

use core::slice;

use cases::{ADDRESS, CAPACITY, MAGIC, Side};
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};

/// Reads inputs, compares results.
struct Check {
    rest: &'static [u8],
    round: u32,
    results: u32,
}

fn fail(why: core::fmt::Arguments<'_>) -> ! {
    hprintln!("{}", why);
    loop {
        debug::exit(debug::EXIT_FAILURE);
    }
}

impl Check {
    fn take(&mut self, length: usize) -> &'static [u8] {
        let Some((taken, rest)) = self.rest.split_at_checked(length) else {
            fail(format_args!("the file of cases ends within round {}", self.round))
        };
        self.rest = rest;
        taken
    }
}

impl Side for Check {
    fn input(&mut self, bytes: &mut [u8]) {
        bytes.copy_from_slice(self.take(bytes.len()));
    }

    fn result(&mut self, case: &'static str, bytes: &[u8]) {
        let expected = self.take(bytes.len());
        self.results += 1;
        if let Some(at) = expected.iter().zip(bytes).position(|(a, b)| a != b) {
            fail(format_args!(
                "round {}, {case}: byte {at} of {} is {:02x} and should be {:02x}",
                self.round,
                bytes.len(),
                bytes[at],
                expected[at]
            ));
        }
    }
}

#[entry]
fn main() -> ! {
    // SAFETY: RAM of the board that nothing else uses (`boards/qemu.x` ends far below); the loader filled it before the processor started.
    let file: &'static [u8] = unsafe { slice::from_raw_parts(ADDRESS as *const u8, CAPACITY) };
    let mut check = Check { rest: file, round: 0, results: 0 };
    if check.take(MAGIC.len()) != MAGIC {
        fail(format_args!("there is no file of cases at {ADDRESS:#x}"));
    }
    let mut rounds = [0; 4];
    check.input(&mut rounds);
    while check.round < u32::from_le_bytes(rounds) {
        cases::round(&mut check);
        check.round += 1;
    }
    hprintln!("{} results of {} rounds agree", check.results, check.round);
    loop {
        debug::exit(debug::EXIT_SUCCESS);
    }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo) -> ! {
    fail(format_args!("{info}"))
}
