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

/// How many more they are at most where the policy has a memory, a bias by distance and takes the whole observation.
pub const MEMORY_INSTRUCTIONS: u32 = 15_000;

/// Time of one whole control step at most, us; `memory`: of a policy that has one.
pub const fn step_us(modules: u8, memory: bool) -> Micros {
    let instructions = step_instructions(modules) + if memory { MEMORY_INSTRUCTIONS } else { 0 };
    let cycles = instructions as u64 * CYCLES_PER_100_INSTRUCTIONS as u64 / 100;
    (cycles * 1_000_000).div_ceil(CLOCK_HZ as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eight_modules_have_75_000_instructions_and_with_a_memory_90_000() {
        assert_eq!((step_instructions(8), step_instructions(8) + MEMORY_INSTRUCTIONS), (75_000, 90_000));
        assert_eq!([8, 64].map(|modules| step_us(modules, false)), [662, 2787]);
        assert_eq!([8, 64].map(|modules| step_us(modules, true)), [795, 2919]);
    }
}
