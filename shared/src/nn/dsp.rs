#![allow(unsafe_code)]
//! Integer kernels for processors with the DSP extension of ARMv7E-M (Cortex-M4, M7): the same sums as the portable ones in
//! [`super`], two products an instruction.
//!
//! The intrinsics for these instructions are not stable in Rust, inline assembler is. On other processors this module does not exist.

use core::arch::asm;

/// One instruction that computes a register from others.
macro_rules! compute {
    ($instruction:literal, $($operand:expr),+) => {{
        let result;
        // SAFETY: reads and writes the registers named, and no flag but Q.
        unsafe { asm!($instruction, lateout(reg) result, $(in(reg) $operand),+, options(pure, nomem, nostack)) }
        result
    }};
}

/// Bytes 0 and 2 of `x`, each extended to 16 bits with its sign.
#[inline(always)]
fn sxtb16(x: u32) -> u32 {
    compute!("sxtb16 {}, {}", x)
}

/// Bytes 1 and 3 of `x`, each extended to 16 bits with its sign.
#[inline(always)]
fn sxtb16_ror8(x: u32) -> u32 {
    compute!("sxtb16 {}, {}, ror #8", x)
}

/// The lower half of `low` below the lower half of `high`.
#[inline(always)]
fn pkhbt(low: u32, high: u32) -> u32 {
    compute!("pkhbt {}, {}, {}, lsl #16", low, high)
}

/// The upper half of `low` below the upper half of `high`.
#[inline(always)]
fn pkhtb(high: u32, low: u32) -> u32 {
    compute!("pkhtb {}, {}, {}, asr #16", high, low)
}

/// `sum` plus the products of the lower and of the upper halves of `a` and `b`, signed. The sum wraps, and nobody reads the Q flag that
/// says so.
#[inline(always)]
fn smlad(a: u32, b: u32, sum: i32) -> i32 {
    compute!("smlad {}, {}, {}, {}", a, b, sum)
}

/// Activations in the order in which `sxtb16` takes weights apart: of four in a row 0, 2, 1, 3.
#[repr(align(4))]
struct Shuffled<const N: usize>([[u8; 2]; N]);

impl<const N: usize> Shuffled<N> {
    #[inline(always)]
    fn fill(&mut self, input: &[i16; N]) {
        for (to, from) in self.0.as_flattened_mut().as_chunks_mut().0.iter_mut().zip(input.as_chunks().0) {
            let [a, b, c, d] = *from;
            let (first, second) = (pair(a, b), pair(c, d));
            *to = (u64::from(pkhbt(first, second)) | u64::from(pkhtb(second, first)) << 32).to_le_bytes();
        }
    }
}

#[inline(always)]
fn pair(low: i16, high: i16) -> u32 {
    u32::from(low as u16) | u32::from(high as u16) << 16
}

/// Four sums at once over the first `turns` turns of the loop, so that an activation is loaded once for four products. 21 instructions for
/// 16 products, and 2 more where the loop goes round.
///
/// It is one block because the compiler, given the instructions singly, orders them so that it runs out of registers.
#[inline(always)]
fn four_rows<const IN: usize>(weights: &[[u8; IN]; 4], input: &Shuffled<IN>, turns: usize) -> [i32; 4] {
    const { assert!(IN > 0 && IN.is_multiple_of(4) && 3 * IN < 4096, "rows are not whole words, or too far apart") };
    let (mut a, mut b, mut c, mut d) = (0, 0, 0, 0);
    let turns = turns.clamp(1, IN / turn(IN));
    // SAFETY: reads the first columns of all four rows, four bytes at a time, and as many activations. They end after a whole number of turns
    // of the loop, at least one and no more than the IN columns have, so the pointers meet. LDR may be unaligned; LDRD must not, and
    // `Shuffled` is aligned. The sums wrap, and nobody reads the Q flag that says so.
    unsafe {
        asm!(
            "2:",
            ".rept {unrolled}",
            "ldrd {even}, {odd}, [{input}], #8",
            "ldr {w}, [{row}], #4",
            "sxtb16 {t}, {w}",
            "sxtb16 {w}, {w}, ror #8",
            "smlad {a}, {t}, {even}, {a}",
            "smlad {a}, {w}, {odd}, {a}",
            "ldr {w}, [{row}, #{row1}]",
            "sxtb16 {t}, {w}",
            "sxtb16 {w}, {w}, ror #8",
            "smlad {b}, {t}, {even}, {b}",
            "smlad {b}, {w}, {odd}, {b}",
            "ldr {w}, [{row}, #{row2}]",
            "sxtb16 {t}, {w}",
            "sxtb16 {w}, {w}, ror #8",
            "smlad {c}, {t}, {even}, {c}",
            "smlad {c}, {w}, {odd}, {c}",
            "ldr {w}, [{row}, #{row3}]",
            "sxtb16 {t}, {w}",
            "sxtb16 {w}, {w}, ror #8",
            "smlad {d}, {t}, {even}, {d}",
            "smlad {d}, {w}, {odd}, {d}",
            ".endr",
            "cmp {input}, {end}",
            "bne 2b",
            unrolled = const turn(IN) / 4,
            row1 = const IN - 4,
            row2 = const 2 * IN - 4,
            row3 = const 3 * IN - 4,
            input = inout(reg) input.0.as_ptr() => _,
            end = in(reg) input.0.as_ptr().add(turns * turn(IN)),
            row = inout(reg) weights.as_ptr() => _,
            even = out(reg) _,
            odd = out(reg) _,
            w = out(reg) _,
            t = out(reg) _,
            a = inout(reg) a,
            b = inout(reg) b,
            c = inout(reg) c,
            d = inout(reg) d,
            options(pure, readonly, nostack),
        );
    }
    [a, b, c, d]
}

/// How many of so many columns to take between two branches: whole words, and a divisor.
const fn turn(columns: usize) -> usize {
    if columns.is_multiple_of(16) {
        16
    } else if columns.is_multiple_of(12) {
        12
    } else {
        4
    }
}

/// One sum, of a row that is left over.
#[inline(always)]
fn one_row<const IN: usize>(weights: &[u8; IN], input: &Shuffled<IN>) -> i32 {
    let words = weights.as_chunks().0.iter().zip(input.0.as_flattened().as_chunks().0);
    words.fold(0, |sum, (weights, inputs)| {
        let (weights, inputs) = (u32::from_le_bytes(*weights), u64::from_le_bytes(*inputs));
        smlad(sxtb16_ror8(weights), (inputs >> 32) as u32, smlad(sxtb16(weights), inputs as u32, sum))
    })
}

/// [`super::accumulate_portable`] where all inputs but the first `columns` are zero. One copy of the code for all layers of the same width: of
/// slices, so that the compiler cannot unroll the rows as well.
#[inline(never)]
pub(super) fn accumulate<const IN: usize>(weights: &[[u8; IN]], input: &[i16; IN], sums: &mut [i32], columns: usize) {
    let mut shuffled = Shuffled([[0; 2]; IN]);
    shuffled.fill(input);
    let (blocks, rest) = sums.as_chunks_mut::<4>();
    let (weights, last_weights) = weights.as_chunks::<4>();
    let turns = columns.div_ceil(turn(IN));
    for (sums, weights) in blocks.iter_mut().zip(weights) {
        *sums = four_rows(weights, &shuffled, turns);
    }
    for (sum, weights) in rest.iter_mut().zip(last_weights) {
        *sum = one_row(weights, &shuffled);
    }
}

/// [`super::PortableQuery`].
pub struct Query<const N: usize>(Shuffled<N>);

impl<const N: usize> Query<N> {
    /// See [`super::PortableQuery::new`].
    #[inline(always)]
    pub fn new(query: &[i16; N]) -> Self {
        const { assert!(N <= 512 && N.is_multiple_of(4), "the product could overflow, or is not of whole words") };
        let mut shuffled = Shuffled([[0; 2]; N]);
        shuffled.fill(query);
        Query(shuffled)
    }

    /// See [`super::PortableQuery::dot`].
    #[inline(always)]
    pub fn dot(&self, key: &[i8; N]) -> i32 {
        one_row(&key.map(|k| k as u8), &self.0)
    }
}

/// [`super::add_weighted_portable`]: 20 instructions for 8 products.
#[inline(always)]
pub(super) fn add_weighted<const N: usize>(sums: &mut [i32; N], weights: [i16; 2], values: [&[i8; N]; 2]) {
    const { assert!(N > 0 && N.is_multiple_of(4), "vectors are not whole words") };
    let range = sums.as_mut_ptr_range();
    // SAFETY: reads the N values of both vectors, and adds to the N sums, four at a time; N is a multiple of 4. LDR may be unaligned;
    // LDRD and STRD need words, which the sums are. The sums wrap, and nobody reads the Q flag that says so.
    unsafe {
        asm!(
            "2:",
            "ldr {a}, [{from_a}], #4",
            "ldr {b}, [{from_b}], #4",
            "sxtb16 {t}, {a}",
            "sxtb16 {u}, {b}",
            "pkhbt {v}, {t}, {u}, lsl #16",
            "pkhtb {u}, {u}, {t}, asr #16",
            "sxtb16 {a}, {a}, ror #8",
            "sxtb16 {b}, {b}, ror #8",
            "pkhbt {t}, {a}, {b}, lsl #16",
            "pkhtb {b}, {b}, {a}, asr #16",
            "ldrd {x}, {y}, [{sums}]",
            "smlad {x}, {v}, {weights}, {x}",
            "smlad {y}, {t}, {weights}, {y}",
            "strd {x}, {y}, [{sums}], #8",
            "ldrd {x}, {y}, [{sums}]",
            "smlad {x}, {u}, {weights}, {x}",
            "smlad {y}, {b}, {weights}, {y}",
            "strd {x}, {y}, [{sums}], #8",
            "cmp {sums}, {end}",
            "bne 2b",
            sums = inout(reg) range.start => _,
            end = in(reg) range.end,
            from_a = inout(reg) values[0].as_ptr() => _,
            from_b = inout(reg) values[1].as_ptr() => _,
            weights = in(reg) pair(weights[0], weights[1]),
            a = out(reg) _,
            b = out(reg) _,
            t = out(reg) _,
            u = out(reg) _,
            v = out(reg) _,
            x = out(reg) _,
            y = out(reg) _,
            options(nostack),
        );
    }
}
