//! Sine and cosine in single precision: the same bits on every target, made for processors whose floating-point unit knows singles only.
//!
//! It uses nothing but IEEE 754 additions, multiplications, conversions and comparisons of singles, in the order written; Rust
//! neither fuses nor reorders them. (`libm` computes in double precision inside, which a Cortex-M4F has to emulate: about 2,200
//! instructions a call instead of 40. Its square root and logarithm are single precision throughout, and good as they are.)

/// Sine and cosine of an angle in radians.
///
/// Within +-1000 rad both are off by at most 8e-8, and by 1.6 units of the last place where they exceed 0.001. Beyond +-10,000 rad the
/// result loses its meaning, but stays within -1 and 1. What is not a number counts as 0.
#[inline]
pub fn sin_cos(x: f32) -> (f32, f32) {
    /// Half pi in three parts; the first two have so few bits that their products with a number of quarter turns are exact.
    const HALF_PI: [f32; 3] = [1.570_312_5, 4.837_513e-4, 7.549_79e-8];
    let quarters = x * core::f32::consts::FRAC_2_PI;
    // `as` truncates, saturates, and turns NaN into 0.
    let quarters = (quarters + if quarters < 0.0 { -0.5 } else { 0.5 }) as i32;
    let n = quarters as f32;
    let rest = ((x - n * HALF_PI[0]) - n * HALF_PI[1]) - n * HALF_PI[2];
    // No further from 0 than an eighth of a turn, or x was too large to say. The comparisons are false for NaN.
    let r = if rest > -0.8 && rest < 0.8 { rest } else { 0.0 };

    // Minimax polynomials within +-pi/4 (Moshier, Cephes, sinf.c).
    let z = r * r;
    let sin = ((-1.951_529_6e-4 * z + 8.332_161e-3) * z - 1.666_665_5e-1) * z * r + r;
    let cos = ((2.443_315_7e-5 * z - 1.388_731_6e-3) * z + 4.166_664_6e-2) * z * z - 0.5 * z + 1.0;

    let (sin, cos) = if quarters & 1 == 0 { (sin, cos) } else { (cos, -sin) };
    if quarters & 2 == 0 { (sin, cos) } else { (-sin, -cos) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::println;

    /// Largest error of sine and cosine over `count` angles within +-`range`, and in units of the last place where the value exceeds 1e-3.
    fn worst(range: f32, count: i32) -> (f64, f64) {
        let (mut worst, mut worst_ulp) = (0.0f64, 0.0f64);
        for i in -count..=count {
            let x = range * i as f32 / count as f32;
            let (sin, cos) = sin_cos(x);
            for (value, exact) in [(sin, libm::sin(x.into())), (cos, libm::cos(x.into()))] {
                let error = (f64::from(value) - exact).abs();
                worst = worst.max(error);
                if exact.abs() > 1e-3 {
                    let ulp = f64::from((exact.abs() as f32).next_up()) - f64::from(exact.abs() as f32);
                    worst_ulp = worst_ulp.max(error / ulp);
                }
                assert!(value.abs() <= 1.0);
            }
        }
        (worst, worst_ulp)
    }

    #[test]
    fn sine_and_cosine_agree_with_libm() {
        // Miri takes a thousand times as long.
        let count = if cfg!(miri) { 500 } else { 2_000_000 };
        for range in [core::f32::consts::TAU, 1000.0] {
            let (error, units) = worst(range, count);
            println!("within {range}: {error:.2e}, {units:.2} ulp");
            assert!(error < 8e-8 && units < 1.6, "{error} {units}");
        }
    }

    #[test]
    fn every_angle_gives_something_finite() {
        let step = if cfg!(miri) { 99_999_989 } else { 9973 };
        let bits = (0..=u32::MAX).step_by(step).map(f32::from_bits);
        for x in bits.chain([f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 0.0, -0.0]) {
            let (sin, cos) = sin_cos(x);
            assert!(sin.abs() <= 1.0 && cos.abs() <= 1.0, "{x}: {sin} {cos}");
        }
        assert_eq!(sin_cos(0.0), (0.0, 1.0));
        assert_eq!(sin_cos(f32::NAN), (0.0, 1.0));
    }
}
