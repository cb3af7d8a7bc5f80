//! Integer kernels of the frozen network: the same bits on every target.
//!
//! Numbers: weights are int8 with one scale per output channel, activations int16 where 32767 ([`ONE`]) is 1.0 (Q15),
//! sums int32. Floating point appears once, in [`quantise`], as one subtraction, one product and one addition of IEEE
//! 754 singles, which every target rounds alike.
//!
//! **No sum can overflow.** The widest layer has 80 inputs, so |sum| <= 80 * 128 * 32768 < 2^29. [`Dense`] refuses at
//! compile time to be wider than 512 inputs, where the bound is 2^31. A requantised sum is |sum * multiplier| <= 2^31 *
//! 2^31 = 2^62 before rounding adds at most 2^61, less than an i64 holds. Biases are added after requantisation and
//! saturate.
//!
//! **Two ways, the same bits.** Sums and products of vectors have a portable way, the reference, and one for the DSP extension of
//! Cortex-M4 and M7 (SMLAD: two products an instruction, `nn/dsp.rs`). Integer sums do not depend on their order, so both give the same
//! bits; `tests/tests/arm_kernels.rs` compares them on the emulated processor. Weights are row-major (`[output][input]`), rows whole words;
//! activations are brought into the order in which SXTB16 takes words of weights apart once a layer.
//!
//! Instructions as QEMU 7.2 counts them (`snakectl bench firmware`: mps2-an386, Cortex-M4F, `-icount shift=0`; rustc 1.95, profile
//! `firmware`), the shipped policy:
//!
//! | what | instructions |
//! |---|---|
//! | fully connected 64 x 64, requantised, with bias | 6,670, or 0.614 MAC an instruction |
//! | the same, portable, the image compiled with `opt-level = 3` | 14,808, or 0.277 |
//! | [`Policy::encode`](crate::policy::Policy::encode) | 18,468; with a memory and the whole observation 24,201 |
//! | [`Policy::attend`](crate::policy::Policy::attend) over 8, 16, 32, 64 modules | 3,660, 5,888, 10,344, 19,256 |
//! | [`Policy::act`](crate::policy::Policy::act) without the attention | 14,193 |
//!
//! With int8 weights a load, two SXTB16 and two SMLAD make 4 products: 0.8 is the bound.

#[cfg(dsp)]
pub mod dsp;

/// 1.0 in the fixed point of activations (Q15, symmetric: -1.0 is -32767).
pub const ONE: i16 = 32767;

/// Fraction bits of the argument of [`tanh`] (Q16).
pub const ARGUMENT_BITS: u32 = 16;

/// Largest shift that [`requantise`] takes; the smallest is 1.
pub const MAX_SHIFT: u8 = 62;

/// `(x - mean) * gain`, rounded to the nearest integer (halves away from zero) and saturated to +-32767. What is not a
/// number becomes 0.
pub fn quantise(x: f32, mean: f32, gain: f32) -> i16 {
    let scaled = (x - mean) * gain;
    let half = if scaled < 0.0 { -0.5 } else { 0.5 };
    // `as` saturates, truncates towards zero and turns NaN into 0, by definition of the language.
    ((scaled + half) as i32).clamp(-i32::from(ONE), i32::from(ONE)) as i16
}

/// `sum * multiplier / 2^shift`, rounded to the nearest integer (halves up) and saturated to an i32.
///
/// `shift` counts from 1 to [`MAX_SHIFT`]; values outside act as the nearest of these.
#[inline(never)]
pub fn requantise(sum: i32, multiplier: i32, shift: u8) -> i32 {
    let shift = shift.clamp(1, MAX_SHIFT);
    let product = i64::from(sum) * i64::from(multiplier);
    let rounded = (product + (1i64 << (shift - 1))) >> shift;
    rounded.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32
}

/// Saturates to an activation, +-32767.
pub fn saturate16(value: i32) -> i16 {
    value.clamp(-i32::from(ONE), i32::from(ONE)) as i16
}

/// Saturates to an int8, +-127.
pub fn saturate8(value: i32) -> i8 {
    value.clamp(-127, 127) as i8
}

/// The sums `weights * input` of a layer, one per row, on any processor: what the kernels of some processors must agree with. A
/// weight is the two's complement of its byte.
pub fn accumulate_portable<const IN: usize>(weights: &[[u8; IN]], input: &[i16; IN], sums: &mut [i32]) {
    for (sum, row) in sums.iter_mut().zip(weights) {
        *sum = row.iter().zip(input).map(|(&weight, &x)| i32::from(weight as i8) * i32::from(x)).sum();
    }
}

/// From the sums of a layer to the fixed point of its result: `requantise(sum) + bias`, saturated.
#[inline(never)]
fn scale(sums: &mut [i32], multipliers: &[[u8; 4]], bias: Option<&[[u8; 4]]>, shift: u8) {
    if (33..=MAX_SHIFT).contains(&shift) {
        // Almost every layer. The rounding of `requantise` takes place in the upper half of the product, which alone is an i32.
        let (half, shift) = (1 << (shift - 33), shift - 32);
        let upper = |sum: i32, multiplier| ((i64::from(sum) * i64::from(multiplier)) >> 32) as i32;
        scale_by(sums, multipliers, bias, |sum, multiplier| (upper(sum, multiplier) + half) >> shift);
    } else {
        scale_by(sums, multipliers, bias, |sum, multiplier| requantise(sum, multiplier, shift));
    }
}

#[inline(always)]
fn scale_by(sums: &mut [i32], multipliers: &[[u8; 4]], bias: Option<&[[u8; 4]]>, requantise: impl Fn(i32, i32) -> i32) {
    let sums = sums.iter_mut().zip(multipliers.iter().map(|m| i32::from_le_bytes(*m)));
    if let Some(bias) = bias {
        for ((sum, multiplier), bias) in sums.zip(bias) {
            *sum = requantise(*sum, multiplier).saturating_add(i32::from_le_bytes(*bias));
        }
    } else {
        for (sum, multiplier) in sums {
            *sum = requantise(*sum, multiplier);
        }
    }
}

/// A fully connected layer, a view into a policy image.
#[derive(Clone, Copy, Debug)]
pub struct Dense<'a, const IN: usize, const OUT: usize> {
    /// Row-major weights, int8 in two's complement.
    pub weights: &'a [[u8; IN]; OUT],
    /// One multiplier per output for [`requantise`], little-endian i32.
    pub multipliers: &'a [[u8; 4]; OUT],
    /// One bias per output, in the fixed point of the result, little-endian i32; `None` for a layer without.
    pub bias: Option<&'a [[u8; 4]; OUT]>,
    /// The shift of all outputs for [`requantise`].
    pub shift: u8,
    /// Inputs that count, from the first on; those behind must be zero, and need not be looked at.
    pub columns: usize,
}

impl<const IN: usize, const OUT: usize> Dense<'_, IN, OUT> {
    /// `out = requantise(weights * input) + bias`, in the fixed point that multipliers and shift were chosen for.
    #[inline]
    pub fn forward(&self, input: &[i16; IN], out: &mut [i32; OUT]) {
        #[cfg(dsp)]
        dsp::accumulate(self.weights, input, out, self.columns);
        #[cfg(not(dsp))]
        accumulate_portable(self.weights, input, out);
        self.scale(out);
    }

    /// [`Dense::forward`] and `activation` on each result.
    pub fn forward_to<T>(&self, input: &[i16; IN], out: &mut [T; OUT], activation: impl Fn(i32) -> T) {
        let mut sums = [0; OUT];
        self.forward(input, &mut sums);
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = activation(sum);
        }
    }

    /// [`Dense::forward`] with [`accumulate_portable`] on every processor: the same bits.
    pub fn forward_portable(&self, input: &[i16; IN], out: &mut [i32; OUT]) {
        accumulate_portable(self.weights, input, out);
        self.scale(out);
    }

    #[inline]
    fn scale(&self, sums: &mut [i32; OUT]) {
        const { assert!(IN <= 512 && IN.is_multiple_of(4), "sums could overflow, or rows are not whole words") };
        scale(sums, self.multipliers, self.bias.map(|bias| &bias[..]), self.shift);
    }
}

/// A vector of activations made ready for products with many int8 vectors: the query of the attention.
#[cfg(not(dsp))]
pub type Query<const N: usize> = PortableQuery<N>;
/// A vector of activations made ready for products with many int8 vectors: the query of the attention.
#[cfg(dsp)]
pub type Query<const N: usize> = dsp::Query<N>;

/// [`Query`] on any processor.
#[derive(Clone, Copy, Debug)]
pub struct PortableQuery<const N: usize>([i16; N]);

impl<const N: usize> PortableQuery<N> {
    /// Takes the vector; `N` is a multiple of 4 and at most 512.
    pub fn new(query: &[i16; N]) -> Self {
        const { assert!(N <= 512 && N.is_multiple_of(4), "the product could overflow, or is not of whole words") };
        PortableQuery(*query)
    }

    /// The scalar product, at most `N * 2^22` in magnitude.
    pub fn dot(&self, key: &[i8; N]) -> i32 {
        self.0.iter().zip(key).map(|(&q, &k)| i32::from(q) * i32::from(k)).sum()
    }
}

/// Adds the weighted sum of two int8 vectors; the caller sees to it that the sums do not overflow.
pub fn add_weighted<const N: usize>(sums: &mut [i32; N], weights: [i16; 2], values: [&[i8; N]; 2]) {
    const { assert!(N.is_multiple_of(4), "vectors are not whole words") };
    #[cfg(dsp)]
    dsp::add_weighted(sums, weights, values);
    #[cfg(not(dsp))]
    add_weighted_portable(sums, weights, values);
}

/// [`add_weighted`] on any processor.
pub fn add_weighted_portable<const N: usize>(sums: &mut [i32; N], weights: [i16; 2], values: [&[i8; N]; 2]) {
    for ((sum, &a), &b) in sums.iter_mut().zip(values[0]).zip(values[1]) {
        *sum += i32::from(weights[0]) * i32::from(a) + i32::from(weights[1]) * i32::from(b);
    }
}

/// Intervals of the table of [`tanh`] per unit of its argument.
const TANH_STEPS: usize = 64;
/// From here on [`tanh`] is 1.
const TANH_END: usize = 6;
const TANH: [i16; TANH_STEPS * TANH_END + 1] = {
    let mut table = [0; TANH_STEPS * TANH_END + 1];
    let mut i = 0;
    while i < table.len() {
        let e = exp(-2.0 * i as f64 / TANH_STEPS as f64);
        table[i] = ((1.0 - e) / (1.0 + e) * ONE as f64 + 0.5) as i16;
        i += 1;
    }
    table
};

/// `exp(x)` for x <= 0, at compile time.
const fn exp(x: f64) -> f64 {
    // exp(x) = exp(x / 64)^64; ten terms of the series are exact to a double's rounding for the arguments used here.
    let x = x / 64.0;
    let mut term = 1.0;
    let mut sum = 1.0;
    let mut n = 1;
    while n <= 10 {
        term *= x / n as f64;
        sum += term;
        n += 1;
    }
    let mut squarings = 0;
    while squarings < 6 {
        sum *= sum;
        squarings += 1;
    }
    sum
}

/// Hyperbolic tangent: argument in Q16, result in Q15, by linear interpolation in a table of 385 entries.
///
/// Off by at most 5.1e-5 (1.7 units of the last place); odd and monotonous.
pub fn tanh(argument: i32) -> i16 {
    const FRACTION: u32 = ARGUMENT_BITS - TANH_STEPS.ilog2();
    let magnitude = argument.unsigned_abs();
    let index = (magnitude >> FRACTION) as usize;
    let value = match (TANH.get(index), TANH.get(index + 1)) {
        (Some(&low), Some(&high)) => {
            let fraction = (magnitude & ((1 << FRACTION) - 1)) as i32;
            let rise = (i32::from(high) - i32::from(low)) * fraction;
            low + ((rise + (1 << (FRACTION - 1))) >> FRACTION) as i16
        }
        _ => ONE,
    };
    if argument < 0 { -value } else { value }
}

/// Intervals of the table of [`exp2_neg`].
const EXP2_STEPS: usize = 64;
const EXP2: [u32; EXP2_STEPS + 1] = {
    let mut table = [0; EXP2_STEPS + 1];
    let mut i = 0;
    while i < table.len() {
        let x = i as f64 / EXP2_STEPS as f64;
        table[i] = (exp(-x * core::f64::consts::LN_2) * (1u32 << 24) as f64 + 0.5) as u32;
        i += 1;
    }
    table
};

/// `2^-x`: argument in Q16, result in Q16 (65536 is 1.0), off by at most 2.3e-5.
pub fn exp2_neg(x: u32) -> u32 {
    const FRACTION: u32 = 16 - EXP2_STEPS.ilog2();
    let whole = x >> 16;
    // 2^-18 and less rounds to nothing.
    if whole > 17 {
        return 0;
    }
    let index = ((x & 0xffff) >> FRACTION) as usize;
    let fraction = x & ((1 << FRACTION) - 1);
    let (Some(&high), Some(&low)) = (EXP2.get(index), EXP2.get(index + 1)) else { return 0 };
    // The table is in Q24; a step of it is below 2^18, so the product fits.
    let value = high - (((high - low) * fraction) >> FRACTION);
    let shift = whole + 8;
    (value + (1 << (shift - 1))) >> shift
}

/// The indices of the bits set in `mask`, lowest first.
pub fn ones(mask: u64) -> impl Iterator<Item = usize> {
    let mut left = mask;
    core::iter::from_fn(move || {
        let next = left.trailing_zeros();
        left &= left.wrapping_sub(1);
        (next < u64::BITS).then_some(next as usize)
    })
}

/// Softmax over those `logits` whose bit is set in `mask`: weights in Q15 that sum to about 32767 (each is rounded by
/// itself, to within half a unit); the others are 0, and all of them if the mask is empty.
///
/// A logit difference of `d` counts as `requantise(d, multiplier, shift)` in Q16 of base-2 logarithms. Logits must lie
/// within +-2^30, so that their differences fit. The largest logit is subtracted first: its term is 1, so the sum is
/// never zero.
pub fn softmax<const N: usize>(logits: &[i32; N], mask: u64, multiplier: i32, shift: u8) -> [u16; N] {
    let mut weights = [0; N];
    let mut terms = [0u32; N];
    let largest = ones(mask).filter_map(|j| logits.get(j)).max().copied().unwrap_or(0);
    let mut sum = 0;
    for j in ones(mask) {
        if let (Some(term), Some(logit)) = (terms.get_mut(j), logits.get(j)) {
            let below = requantise(largest.saturating_sub(*logit), multiplier, shift).max(0) as u32;
            *term = exp2_neg(below);
            sum += *term;
        }
    }
    let sum = sum.max(1);
    for j in ones(mask) {
        if let (Some(weight), Some(term)) = (weights.get_mut(j), terms.get(j)) {
            // At most 65536 * 32767 + 2^21, which a u32 holds.
            *weight = ((term * ONE as u32 + sum / 2) / sum) as u16;
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::{println, vec::Vec};

    #[test]
    fn tanh_agrees_with_libm() {
        let mut worst = 0.0f64;
        let mut previous = -ONE;
        for argument in (-(8 << 16)..=(8 << 16)).step_by(if cfg!(miri) { 4099 } else { 1 }) {
            let value = tanh(argument);
            let exact = libm::tanh(f64::from(argument) / 65536.0);
            worst = worst.max((f64::from(value) / f64::from(ONE) - exact).abs());
            assert!(value >= previous && tanh(-argument) == -value, "{argument}");
            previous = value;
        }
        println!("tanh: largest error {worst:.2e}");
        assert!(worst < 5.1e-5, "{worst}");
        assert_eq!((tanh(i32::MAX), tanh(i32::MIN), tanh(0)), (ONE, -ONE, 0));
    }

    #[test]
    fn exp2_agrees_with_libm() {
        let mut worst = 0.0f64;
        let mut previous = 65536;
        for x in (0..=(20 << 16)).step_by(if cfg!(miri) { 4099 } else { 1 }) {
            let value = exp2_neg(x);
            assert!(value <= previous, "{x}");
            previous = value;
            worst = worst.max((f64::from(value) / 65536.0 - libm::exp2(-f64::from(x) / 65536.0)).abs());
        }
        println!("exp2: largest error {worst:.2e}");
        assert!(worst < 2.3e-5, "{worst}");
        assert_eq!((exp2_neg(0), exp2_neg(1 << 16), exp2_neg(u32::MAX)), (65536, 32768, 0));
    }

    #[test]
    fn quantise_rounds_saturates_and_swallows_nonsense() {
        assert_eq!(quantise(1.5, 1.0, 3.0), 2);
        assert_eq!(quantise(0.5, 1.0, 3.0), -2);
        assert_eq!(quantise(1e30, 0.0, 1e30), ONE);
        assert_eq!(quantise(f32::NEG_INFINITY, 0.0, 1.0), -ONE);
        assert_eq!(quantise(f32::INFINITY, 0.0, 0.0), 0);
        assert_eq!(quantise(f32::NAN, 0.0, 1.0), 0);
    }

    #[test]
    fn requantise_rounds_to_nearest() {
        assert_eq!(requantise(3, 1, 1), 2);
        assert_eq!(requantise(-3, 1, 1), -1);
        assert_eq!(requantise(-5, 1, 2), -1);
        assert_eq!(requantise(i32::MIN, i32::MIN, 1), i32::MAX);
        assert_eq!(requantise(i32::MIN, i32::MAX, 62), -1);
        assert_eq!(requantise(1, 1, 0), 1);
        assert_eq!(requantise(1, 1, 255), 0);
    }

    #[test]
    fn the_widest_sum_does_not_overflow() {
        // Debug builds trap on overflow; all terms have the same sign and the largest magnitude.
        let mut sum = [0];
        accumulate_portable(&[[0x80; 512]], &[i16::MIN + 1; 512], &mut sum);
        assert_eq!(sum, [512 * 128 * 32767]);
        accumulate_portable(&[[0x7f; 64]], &[-ONE; 64], &mut sum);
        assert_eq!(sum, [-64 * 127 * 32767]);
    }

    #[test]
    fn ones_lists_the_bits() {
        assert_eq!(ones(0).count(), 0);
        assert_eq!(ones(1 << 63 | 0b101).collect::<Vec<_>>(), [0, 2, 63]);
        assert_eq!(ones(u64::MAX).count(), 64);
    }

    proptest! {
        #[test]
        fn softmax_agrees_with_floating_point(
            logits in proptest::array::uniform32(-(1i32 << 27)..(1 << 27)), mask in 1u64.., shift in 10u8..30,
        ) {
            let logits: [i32; 64] = core::array::from_fn(|j| logits[j % 32].wrapping_add(j as i32));
            // 2^-shift * 2^30 of a base-2 logarithm in Q16 per unit.
            let weights = softmax(&logits, mask, 1 << 12, shift);
            let scale = libm::exp2(12.0 - 16.0 - f64::from(shift));
            let largest = ones(mask).map(|j| logits[j]).max().unwrap();
            let term = |j: usize| libm::exp2(scale * (f64::from(logits[j]) - f64::from(largest)));
            let sum: f64 = ones(mask).map(term).sum();
            for (j, &weight) in weights.iter().enumerate() {
                let expected = if mask >> j & 1 == 1 { term(j) / sum } else { 0.0 };
                prop_assert!((f64::from(weight) / 32767.0 - expected).abs() < 1e-4, "{j}: {weight} {expected}");
            }
            let total: i32 = weights.iter().map(|&w| i32::from(w)).sum();
            prop_assert!((total - 32767).abs() <= 32, "{total}");
        }
    }

    #[test]
    fn softmax_of_nothing_is_nothing() {
        assert_eq!(softmax(&[5; 64], 0, 1 << 20, 20), [0; 64]);
        assert_eq!(softmax(&[i32::MAX; 64], 1 << 7, i32::MAX, 1)[7], 32767);
    }
}
