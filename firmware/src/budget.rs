//! What a control step may cost on the processor of a module: a promise that `tests/tests/bench_firmware.rs` holds against the emulated
//! Cortex-M4F, and the time that computing takes in the simulator.

use crate::controller::Micros;

/// Clock of the processor, Hz.
pub const CLOCK_HZ: u32 = 170_000_000;

/// Cycles an instruction takes at most, in hundredths: QEMU counts instructions and knows no wait states of the flash.
pub const CYCLES_PER_100_INSTRUCTIONS: u32 = 150;

/// Instructions of one whole control step at most: everything that a module computes in a cycle, received frames included. Each module of the
/// robot adds two frames, a place in the chain and a share of the attention.
pub const fn step_instructions(modules: u8) -> u32 {
    40_600 + 4_300 * modules as u32
}

/// Time of one whole control step at most, us.
pub const fn step_us(modules: u8) -> Micros {
    let cycles = step_instructions(modules) as u64 * CYCLES_PER_100_INSTRUCTIONS as u64 / 100;
    (cycles * 1_000_000).div_ceil(CLOCK_HZ as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eight_modules_have_75_000_instructions() {
        assert_eq!(step_instructions(8), 75_000);
        assert_eq!([8, 64].map(step_us), [662, 2787]);
    }
}
