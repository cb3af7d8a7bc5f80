//! Vector registers, and one function compiled for several widths of them.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// A register of numbers.
///
/// # Safety
///
/// The functions of an implementation may only run where the processor has its instructions; [`vectorise!`] sees to that.
pub unsafe trait Vector: Copy {
    /// Numbers in a register.
    const LANES: usize;
    /// Registers there are.
    const REGISTERS: usize;

    /// `a b + c`, rounded as [`Vector::multiply_add`] does.
    fn scalar(a: f32, b: f32, c: f32) -> f32;

    /// The numbers from `from` on.
    ///
    /// # Safety
    ///
    /// `LANES` numbers must be readable there, and the processor must have the register.
    unsafe fn load(from: *const f32) -> Self;

    /// Writes the numbers to `to`.
    ///
    /// # Safety
    ///
    /// `LANES` numbers must be writable there, and the processor must have the register.
    unsafe fn store(self, to: *mut f32);

    /// The same number everywhere.
    ///
    /// # Safety
    ///
    /// The processor must have the register.
    unsafe fn splat(x: f32) -> Self;

    /// `self b + c`.
    ///
    /// # Safety
    ///
    /// The processor must have the register.
    unsafe fn multiply_add(self, b: Self, c: Self) -> Self;
}

/// Without any special instructions. Product and sum are rounded each: a fused one would be a call of a function.
// SAFETY: runs everywhere.
unsafe impl Vector for [f32; 8] {
    const LANES: usize = 8;
    const REGISTERS: usize = 16;

    #[inline(always)]
    fn scalar(a: f32, b: f32, c: f32) -> f32 {
        a * b + c
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<Self>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<Self>().write_unaligned(self) }
    }

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        [x; 8]
    }

    #[inline(always)]
    unsafe fn multiply_add(self, b: Self, c: Self) -> Self {
        std::array::from_fn(|i| self[i] * b[i] + c[i])
    }
}

#[cfg(target_arch = "x86_64")]
macro_rules! x86 {
    ($register:ty, $lanes:literal, $registers:literal, $load:ident, $store:ident, $splat:ident, $fma:ident) => {
        // SAFETY: the intrinsics ask for nothing but what the trait does.
        unsafe impl Vector for $register {
            const LANES: usize = $lanes;
            const REGISTERS: usize = $registers;

            #[inline(always)]
            fn scalar(a: f32, b: f32, c: f32) -> f32 {
                a.mul_add(b, c)
            }

            #[inline(always)]
            unsafe fn load(from: *const f32) -> Self {
                // SAFETY: the caller's promise.
                unsafe { $load(from) }
            }

            #[inline(always)]
            unsafe fn store(self, to: *mut f32) {
                // SAFETY: the caller's promise.
                unsafe { $store(to, self) }
            }

            #[inline(always)]
            unsafe fn splat(x: f32) -> Self {
                // SAFETY: the caller's promise.
                unsafe { $splat(x) }
            }

            #[inline(always)]
            unsafe fn multiply_add(self, b: Self, c: Self) -> Self {
                // SAFETY: the caller's promise.
                unsafe { $fma(self, b, c) }
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
x86!(__m256, 8, 16, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_set1_ps, _mm256_fmadd_ps);
#[cfg(target_arch = "x86_64")]
x86!(__m512, 16, 32, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_set1_ps, _mm512_fmadd_ps);

/// Makes a function of a body that is generic over the [`Vector`]: it calls the copy that suits the processor.
macro_rules! vectorise {
    ($(#[$meta:meta])* $vis:vis fn $name:ident $([const $n:ident: usize])? ($($arg:ident: $type:ty),* $(,)?) = $body:ident) => {
        $(#[$meta])*
        $vis fn $name $(<const $n: usize>)? ($($arg: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx2,fma")]
                fn avx512 $(<const $n: usize>)? ($($arg: $type),*) {
                    $body::<std::arch::x86_64::__m512 $(, $n)?>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2 $(<const $n: usize>)? ($($arg: $type),*) {
                    $body::<std::arch::x86_64::__m256 $(, $n)?>($($arg),*)
                }
                if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                    if std::arch::is_x86_feature_detected!("avx512f") {
                        // SAFETY: the processor has them.
                        return unsafe { avx512 $(::<$n>)? ($($arg),*) };
                    }
                    // SAFETY: the processor has them.
                    return unsafe { avx2 $(::<$n>)? ($($arg),*) };
                }
            }
            $body::<[f32; 8] $(, $n)?>($($arg),*)
        }
    };
}
pub(crate) use vectorise;
