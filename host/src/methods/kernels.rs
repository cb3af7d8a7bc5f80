//! The few inner loops that training spends its time in, in a form that compilers turn into vector instructions.
//!
//! On x86-64 with AVX2 and FMA a second copy of each is compiled for those and chosen at run time.

/// Rows computed at a time.
const ROWS: usize = 4;
/// Columns computed at a time.
const COLUMNS: usize = 16;

/// Whether the copies for AVX2 and FMA may be used.
#[cfg(target_arch = "x86_64")]
fn fast() -> bool {
    std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
}

/// `y = x w + bias` (or `y += x w` without a bias), row by row.
///
/// `x` is `[rows][inputs]`, `w` is `[inputs][OUTPUTS]`, `y` is `[rows][OUTPUTS]`; OUTPUTS is a multiple of 16.
pub fn dense<const OUTPUTS: usize>(x: &[f32], inputs: usize, w: &[f32], bias: Option<&[f32]>, y: &mut [f32]) {
    assert!(OUTPUTS.is_multiple_of(COLUMNS) && w.len() == inputs * OUTPUTS && x.len() / inputs == y.len() / OUTPUTS);
    if let Some(bias) = bias {
        y.chunks_exact_mut(OUTPUTS).for_each(|y| y.copy_from_slice(bias));
    }
    #[cfg(target_arch = "x86_64")]
    if fast() {
        // SAFETY: the processor has AVX2 and FMA.
        unsafe { dense_fma::<OUTPUTS>(x, inputs, w, y) };
        return;
    }
    dense_body::<OUTPUTS>(x, inputs, w, y, |a, b, c| a * b + c);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn dense_fma<const OUTPUTS: usize>(x: &[f32], inputs: usize, w: &[f32], y: &mut [f32]) {
    dense_body::<OUTPUTS>(x, inputs, w, y, |a, b, c| a.mul_add(b, c));
}

#[inline(always)]
fn dense_body<const OUTPUTS: usize>(
    x: &[f32],
    inputs: usize,
    w: &[f32],
    y: &mut [f32],
    fma: impl Fn(f32, f32, f32) -> f32 + Copy,
) {
    for column in (0..OUTPUTS).step_by(COLUMNS) {
        let mut xs = x.chunks_exact(ROWS * inputs);
        let mut ys = y.chunks_exact_mut(ROWS * OUTPUTS);
        for (x, y) in xs.by_ref().zip(ys.by_ref()) {
            tile::<ROWS, OUTPUTS>(x, inputs, w, y, column, fma);
        }
        for (x, y) in xs.remainder().chunks_exact(inputs).zip(ys.into_remainder().chunks_exact_mut(OUTPUTS)) {
            tile::<1, OUTPUTS>(x, inputs, w, y, column, fma);
        }
    }
}

/// Adds to `COLUMNS` columns of `N` rows.
#[inline(always)]
fn tile<const N: usize, const OUTPUTS: usize>(
    x: &[f32],
    inputs: usize,
    w: &[f32],
    y: &mut [f32],
    column: usize,
    fma: impl Fn(f32, f32, f32) -> f32,
) {
    let mut sums = [[0.0f32; COLUMNS]; N];
    for (row, sums) in sums.iter_mut().enumerate() {
        sums.copy_from_slice(&y[row * OUTPUTS + column..][..COLUMNS]);
    }
    for (k, w) in w.chunks_exact(OUTPUTS).enumerate() {
        let w = &w[column..column + COLUMNS];
        for (row, sums) in sums.iter_mut().enumerate() {
            let x = x[row * inputs + k];
            for j in 0..COLUMNS {
                sums[j] = fma(x, w[j], sums[j]);
            }
        }
    }
    for (row, sums) in sums.iter().enumerate() {
        y[row * OUTPUTS + column..][..COLUMNS].copy_from_slice(sums);
    }
}

/// Replaces every number by its hyperbolic tangent, to within 4 units in the last place of 1.
pub fn tanh(x: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if fast() {
        // SAFETY: the processor has AVX2 and FMA.
        unsafe { tanh_fma(x) };
        return;
    }
    x.iter_mut().for_each(|x| *x = tanh_body(*x, |a, b, c| a * b + c));
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn tanh_fma(x: &mut [f32]) {
    x.iter_mut().for_each(|x| *x = tanh_body(*x, |a, b, c| a.mul_add(b, c)));
}

/// Adds `bias` to every row of `x` and replaces it by its hyperbolic tangent.
pub fn bias_tanh(x: &mut [f32], bias: &[f32]) {
    #[cfg(target_arch = "x86_64")]
    if fast() {
        // SAFETY: the processor has AVX2 and FMA.
        unsafe { bias_tanh_fma(x, bias) };
        return;
    }
    bias_tanh_body(x, bias, |a, b, c| a * b + c);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn bias_tanh_fma(x: &mut [f32], bias: &[f32]) {
    bias_tanh_body(x, bias, |a, b, c| a.mul_add(b, c));
}

#[inline(always)]
fn bias_tanh_body(x: &mut [f32], bias: &[f32], fma: impl Fn(f32, f32, f32) -> f32 + Copy) {
    for row in x.chunks_exact_mut(bias.len()) {
        for (x, bias) in row.iter_mut().zip(bias) {
            *x = tanh_body(*x + bias, fma);
        }
    }
}

/// The way back of [`bias_tanh`]: turns the gradient of its output `y` into that of its input, and adds its rows up in `of_bias`.
pub fn bias_tanh_backward(gradient: &mut [f32], y: &[f32], of_bias: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if fast() {
        // SAFETY: the processor has AVX2 and FMA.
        unsafe { bias_tanh_backward_fma(gradient, y, of_bias) };
        return;
    }
    bias_tanh_backward_body(gradient, y, of_bias);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn bias_tanh_backward_fma(gradient: &mut [f32], y: &[f32], of_bias: &mut [f32]) {
    bias_tanh_backward_body(gradient, y, of_bias);
}

#[inline(always)]
fn bias_tanh_backward_body(gradient: &mut [f32], y: &[f32], of_bias: &mut [f32]) {
    let columns = of_bias.len();
    for (gradient, y) in gradient.chunks_exact_mut(columns).zip(y.chunks_exact(columns)) {
        for ((g, y), b) in gradient.iter_mut().zip(y).zip(of_bias.iter_mut()) {
            *g *= 1.0 - y * y;
            *b += *g;
        }
    }
}

/// The rational approximation of degree 13 over 6 that Eigen and XLA use.
#[inline(always)]
#[allow(clippy::excessive_precision)]
fn tanh_body(x: f32, fma: impl Fn(f32, f32, f32) -> f32) -> f32 {
    // Beyond this tanh is 1 in single precision.
    let x = x.clamp(-7.905_311_1, 7.905_311_1);
    let x2 = x * x;
    let mut p = fma(x2, -2.760_768_477_423_55e-16, 2.000_187_904_824_77e-13);
    p = fma(x2, p, -8.604_671_522_137_35e-11);
    p = fma(x2, p, 5.122_297_090_371_14e-8);
    p = fma(x2, p, 1.485_722_357_179_79e-5);
    p = fma(x2, p, 6.372_619_288_754_36e-4);
    p = fma(x2, p, 4.893_524_558_917_86e-3);
    let mut q = fma(x2, 1.198_258_394_667_02e-6, 1.185_347_056_866_54e-4);
    q = fma(x2, q, 2.268_434_632_439_e-3);
    q = fma(x2, q, 4.893_525_185_543_85e-3);
    x * p / q
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tanh_is_tanh() {
        let mut worst = 0.0f32;
        let x: Vec<f32> = (-200_000..200_000).map(|i| i as f32 * 5e-5).chain([1e-20, -1e-20, 50.0, -1e9]).collect();
        let mut y = x.clone();
        tanh(&mut y);
        for (x, y) in x.iter().zip(&y) {
            worst = worst.max((f64::from(*x).tanh() as f32 - y).abs());
            assert!((tanh_body(*x, |a, b, c| a * b + c) - y).abs() < 1e-6);
        }
        assert!(worst < 4.0 * f32::EPSILON, "{worst}");
        let mut nan = [f32::NAN];
        tanh(&mut nan);
        assert!(nan[0].is_nan());
    }

    #[test]
    fn dense_multiplies_and_does_not_depend_on_the_number_of_rows() {
        let (rows, inputs) = (7, 5);
        let x: Vec<f32> = (0..rows * inputs).map(|i| (i as f32 * 0.7).sin()).collect();
        let w: Vec<f32> = (0..inputs * 32).map(|i| (i as f32 * 0.3).cos()).collect();
        let bias: Vec<f32> = (0..32).map(|i| i as f32).collect();
        let mut y = vec![0.0; rows * 32];
        dense::<32>(&x, inputs, &w, Some(&bias), &mut y);
        for r in 0..rows {
            for c in 0..32 {
                let expected: f32 = bias[c] + (0..inputs).map(|k| x[r * inputs + k] * w[k * 32 + c]).sum::<f32>();
                assert!((y[r * 32 + c] - expected).abs() < 1e-5);
            }
            let mut one = vec![0.0; 32];
            dense::<32>(&x[r * inputs..(r + 1) * inputs], inputs, &w, Some(&bias), &mut one);
            assert_eq!(one, y[r * 32..(r + 1) * 32]);
        }
    }
}
