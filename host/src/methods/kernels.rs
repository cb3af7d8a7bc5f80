//! The inner loops that training spends its time in: products with the narrow matrices of the networks, tanh, and their ways back.
//!
//! Each is compiled for AVX-512, for AVX2 with FMA and for the bare target; the best that the processor has is chosen at run time. Every
//! number is summed in an order that depends on neither the width of the registers nor the number of rows, so both x86-64 copies give the
//! same bits, and a row has the same result alone as among others.

use super::simd::{Vector, vectorise};

/// What a product starts from.
#[derive(Clone, Copy)]
pub enum Start<'a> {
    /// Nothing.
    Zero,
    /// The same row for all.
    Bias(&'a [f32]),
    /// What is there already.
    Sum,
}

/// The longest row that [`Start::Zero`] can begin.
const LONGEST: usize = 256;
static ZERO: [f32; LONGEST] = [0.0; LONGEST];

/// `y = start + x w`: `x` is `[rows][inputs]`, `w` is `[inputs][outputs]`, `y` is `[rows][outputs]`; outputs is a multiple of 16.
///
/// With `w` one row per input this is the way forth of a layer; with `w` one row per output it is the way back from the gradient of the
/// outputs to that of the inputs.
pub fn dense(x: &[f32], inputs: usize, w: &[f32], start: Start, y: &mut [f32]) {
    let outputs = w.len() / inputs;
    let rows = x.len() / inputs;
    assert!(x.len() == rows * inputs && w.len() == inputs * outputs && y.len() == rows * outputs);
    let (start, start_stride) = match start {
        Start::Zero => (&ZERO[..outputs], 0),
        Start::Bias(bias) => (&bias[..outputs], 0),
        Start::Sum => (&[][..], outputs),
    };
    product(
        Product { a: x, a_row: inputs, a_step: 1, b: w, steps: inputs, start, start_stride, rows, columns: outputs },
        y,
    );
}

/// `of_w += x^T of_y`, the gradient of a layer's weights, one row per input: `x` is `[rows][inputs]`, `of_y` is `[rows][outputs]`, `of_w`
/// is `[inputs][outputs]`; outputs is a multiple of 16.
pub fn dense_weights(x: &[f32], inputs: usize, of_y: &[f32], of_w: &mut [f32]) {
    let outputs = of_w.len() / inputs;
    let rows = x.len() / inputs;
    assert!(x.len() == rows * inputs && of_w.len() == inputs * outputs && of_y.len() == rows * outputs);
    let (start, start_stride) = (&[][..], outputs);
    product(
        Product {
            a: x,
            a_row: 1,
            a_step: inputs,
            b: of_y,
            steps: rows,
            start,
            start_stride,
            rows: inputs,
            columns: outputs,
        },
        of_w,
    );
}

/// `c[r][j] = start[r][j] + sum_k a[r a_row + k a_step] b[k][j]`, the sum in the order of k.
#[derive(Clone, Copy)]
struct Product<'a> {
    a: &'a [f32],
    a_row: usize,
    a_step: usize,
    /// `[steps][columns]`
    b: &'a [f32],
    steps: usize,
    /// Empty: what is in c.
    start: &'a [f32],
    /// Distance between the rows of `start`; 0 if there is one.
    start_stride: usize,
    rows: usize,
    columns: usize,
}

vectorise! {
    fn product(p: Product<'_>, c: &mut [f32]) = product_body
}

#[inline(always)]
fn product_body<V: Vector>(p: Product, c: &mut [f32]) {
    let Product { rows, columns, steps, .. } = p;
    assert!(columns.is_multiple_of(V::LANES) && c.len() == rows * columns && p.b.len() == steps * columns);
    assert!(rows == 0 || steps == 0 || (rows - 1) * p.a_row + (steps - 1) * p.a_step < p.a.len());
    assert!(p.start_stride == columns || p.start.len() == columns);
    // SAFETY: the lengths just checked; `vectorise!` only runs copies for registers that the processor has.
    unsafe {
        let mut column = 0;
        while column + 2 * V::LANES <= columns {
            stripe::<V, 2>(&p, column, c);
            column += 2 * V::LANES;
        }
        if column < columns {
            stripe::<V, 1>(&p, column, c);
        }
    }
}

/// All rows by `W` registers of columns.
///
/// # Safety
///
/// As for [`tile`].
#[inline(always)]
unsafe fn stripe<V: Vector, const W: usize>(p: &Product, column: usize, c: &mut [f32]) {
    let mut row = 0;
    // SAFETY: the caller's promise; the rows lie within what `p` and `c` describe.
    unsafe {
        if V::REGISTERS >= 32 {
            while row + 8 <= p.rows {
                tile::<V, 8, W>(p, row, column, c);
                row += 8;
            }
        }
        while row + 4 <= p.rows {
            tile::<V, 4, W>(p, row, column, c);
            row += 4;
        }
        while row < p.rows {
            tile::<V, 1, W>(p, row, column, c);
            row += 1;
        }
    }
}

/// `N` rows by `W` registers of columns.
///
/// # Safety
///
/// All of it must lie inside of what `p` and `c` describe, and the processor must have the registers.
#[inline(always)]
unsafe fn tile<V: Vector, const N: usize, const W: usize>(p: &Product, row: usize, column: usize, c: &mut [f32]) {
    // SAFETY: see above.
    unsafe {
        let c = c.as_mut_ptr().add(row * p.columns + column);
        let start = if p.start_stride == 0 { p.start.as_ptr().add(column) } else { c.cast_const() };
        let mut sums = [[V::splat(0.0); W]; N];
        for (i, sums) in sums.iter_mut().enumerate() {
            for (lane, sum) in sums.iter_mut().enumerate() {
                *sum = V::load(start.add(i * p.start_stride + lane * V::LANES));
            }
        }
        let mut a = p.a.as_ptr().add(row * p.a_row);
        let mut b = p.b.as_ptr().add(column);
        for _ in 0..p.steps {
            let mut of_b = [V::splat(0.0); W];
            for (lane, of_b) in of_b.iter_mut().enumerate() {
                *of_b = V::load(b.add(lane * V::LANES));
            }
            for (i, sums) in sums.iter_mut().enumerate() {
                let a = V::splat(*a.add(i * p.a_row));
                for (sum, b) in sums.iter_mut().zip(of_b) {
                    *sum = a.multiply_add(b, *sum);
                }
            }
            a = a.wrapping_add(p.a_step);
            b = b.wrapping_add(p.columns);
        }
        for (i, sums) in sums.iter().enumerate() {
            for (lane, sum) in sums.iter().enumerate() {
                sum.store(c.add(i * p.columns + lane * V::LANES));
            }
        }
    }
}

/// The inner product, summed in 16 parts; the lengths are the same and a multiple of 16.
#[inline(always)]
pub fn dot<V: Vector>(x: &[f32], y: &[f32]) -> f32 {
    let mut parts = [0.0f32; 16];
    for (x, y) in x.chunks_exact(16).zip(y.chunks_exact(16)) {
        for i in 0..16 {
            parts[i] = V::scalar(x[i], y[i], parts[i]);
        }
    }
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            parts[i] += parts[i + half];
        }
    }
    parts[0]
}

vectorise! {
    /// A layer of few outputs: `y = bias + x w^T`, `x` is `[rows][N]`, `w` is `[outputs][N]`, `y` is `[rows][outputs]`.
    pub fn head[const N: usize](x: &[f32], w: &[f32], bias: &[f32], y: &mut [f32]) = head_body
}

#[inline(always)]
fn head_body<V: Vector, const N: usize>(x: &[f32], w: &[f32], bias: &[f32], y: &mut [f32]) {
    for (x, y) in x.as_chunks::<N>().0.iter().zip(y.chunks_exact_mut(bias.len())) {
        for ((y, w), bias) in y.iter_mut().zip(w.as_chunks::<N>().0).zip(bias) {
            *y = bias + dot::<V>(x, w);
        }
    }
}

vectorise! {
    /// The way back of [`head`]: gradient of its input into `of_x`, of its weights and bias added to `of_w` and `of_bias`.
    pub fn head_backward[const N: usize](
        x: &[f32], w: &[f32], of_y: &[f32], of_x: &mut [f32], of_w: &mut [f32], of_bias: &mut [f32]
    ) = head_backward_body
}

#[inline(always)]
fn head_backward_body<V: Vector, const N: usize>(
    x: &[f32],
    w: &[f32],
    of_y: &[f32],
    of_x: &mut [f32],
    of_w: &mut [f32],
    of_bias: &mut [f32],
) {
    let rows = x.as_chunks::<N>().0.iter().zip(of_x.as_chunks_mut::<N>().0).zip(of_y.chunks_exact(of_bias.len()));
    for ((x, of_x), of_y) in rows {
        *of_x = [0.0; N];
        let outputs = of_y.iter().zip(w.as_chunks::<N>().0).zip(of_w.as_chunks_mut::<N>().0).zip(&mut *of_bias);
        for (((of_y, w), of_w), of_bias) in outputs {
            *of_bias += of_y;
            for i in 0..N {
                of_x[i] = V::scalar(*of_y, w[i], of_x[i]);
                of_w[i] = V::scalar(*of_y, x[i], of_w[i]);
            }
        }
    }
}

vectorise! {
    /// Replaces every number by its hyperbolic tangent, to within 4 units in the last place of 1.
    pub fn tanh(x: &mut [f32]) = tanh_all
}

#[inline(always)]
fn tanh_all<V: Vector>(x: &mut [f32]) {
    x.iter_mut().for_each(|x| *x = tanh_body(*x, V::scalar));
}

vectorise! {
    /// Replaces every number by its hyperbolic tangent and writes the slope there, both out of e^(-2 |x|). The slope is good to 1e-6 of itself
    /// however flat the tangent is: 1 - tanh^2 of a rounded tangent is rounding alone there, of either sign, and an optimiser that divides
    /// gradients by their size makes whole steps of it.
    pub fn tanh_and_slope(x: &mut [f32], slope: &mut [f32]) = tanh_and_slope_body
}

#[inline(always)]
fn tanh_and_slope_body<V: Vector>(x: &mut [f32], slope: &mut [f32]) {
    for (x, slope) in x.iter_mut().zip(slope) {
        let e = exp_body(-2.0 * x.abs(), V::scalar);
        let scale = 1.0 / (1.0 + e);
        *slope = 4.0 * e * scale * scale;
        *x = ((1.0 - e) * scale).copysign(*x);
    }
}

vectorise! {
    /// Adds `bias` to every row of `x` and replaces it by its hyperbolic tangent.
    pub fn bias_tanh(x: &mut [f32], bias: &[f32]) = bias_tanh_body
}

#[inline(always)]
fn bias_tanh_body<V: Vector>(x: &mut [f32], bias: &[f32]) {
    for row in x.chunks_exact_mut(bias.len()) {
        for (x, bias) in row.iter_mut().zip(bias) {
            *x = tanh_body(*x + bias, V::scalar);
        }
    }
}

vectorise! {
    /// The way back of [`bias_tanh`]: turns the gradient of its output `y` into that of its input, and adds its rows up in `of_bias`.
    pub fn bias_tanh_backward(gradient: &mut [f32], y: &[f32], of_bias: &mut [f32]) = bias_tanh_backward_body
}

#[inline(always)]
fn bias_tanh_backward_body<V: Vector>(gradient: &mut [f32], y: &[f32], of_bias: &mut [f32]) {
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

vectorise! {
    /// Replaces every x by the Gaussian error linear unit, x P(x) with the normal distribution's P, and writes its slope P(x) + x P'(x).
    pub fn gelu(x: &mut [f32], slope: &mut [f32]) = gelu_body
}

#[inline(always)]
fn gelu_body<V: Vector>(x: &mut [f32], slope: &mut [f32]) {
    /// P'(0)
    const PEAK: f32 = 0.398_942_3;
    for (x, slope) in x.iter_mut().zip(slope) {
        let below = V::scalar(erf_body(*x * std::f32::consts::FRAC_1_SQRT_2, V::scalar), 0.5, 0.5);
        *slope = V::scalar(*x * PEAK, exp_body(-0.5 * *x * *x, V::scalar), below);
        *x *= below;
    }
}

/// The error function to within 5e-7: the rational approximation of degree 13 over 8 that Eigen and XLA use (`ErfImpl32`), itself good to 7e-8;
/// the rest is rounding.
#[inline(always)]
#[allow(clippy::excessive_precision)]
fn erf_body(x: f32, fma: impl Fn(f32, f32, f32) -> f32) -> f32 {
    // Beyond this it is 1 in single precision.
    let x = x.clamp(-4.0, 4.0);
    let x2 = x * x;
    let mut p = fma(x2, -2.726_142_258_013_06e-10, 2.770_681_424_959_02e-8);
    p = fma(x2, p, -2.101_024_020_825_08e-6);
    p = fma(x2, p, -5.692_506_394_623_46e-5);
    p = fma(x2, p, -7.349_906_303_268_55e-4);
    p = fma(x2, p, -2.954_599_808_540_25e-3);
    p = fma(x2, p, -1.609_603_332_624_15e-2);
    let mut q = fma(x2, -1.456_607_184_649_96e-5, -2.133_740_552_789_05e-4);
    q = fma(x2, q, -1.682_826_974_382_03e-3);
    q = fma(x2, q, -7.373_329_167_204_68e-3);
    q = fma(x2, q, -1.426_473_905_141_89e-2);
    x * p / q
}

/// e to the power of x to within 2e-7 of itself, for x in -87 to 88 (beyond, as if it were that): 2^n times Cephes' polynomial (`expf`).
#[inline(always)]
#[allow(clippy::excessive_precision)]
pub fn exp_body(x: f32, fma: impl Fn(f32, f32, f32) -> f32) -> f32 {
    /// The numbers from here on are whole, so adding it rounds, and n stands in the lowest bits.
    const WHOLE: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 88.0);
    let shifted = fma(x, std::f32::consts::LOG2_E, WHOLE);
    let n = shifted - WHOLE;
    // ln 2 in two parts, the first of few digits.
    let r = fma(n, 2.121_944_40e-4, fma(n, -0.693_359_375, x));
    let mut p = fma(r, 1.987_569_150_0e-4, 1.398_199_950_7e-3);
    p = fma(r, p, 8.333_451_907_3e-3);
    p = fma(r, p, 4.166_579_589_4e-2);
    p = fma(r, p, 1.666_666_545_9e-1);
    p = fma(r, p, 5.000_000_120_1e-1);
    fma(r * r, p, r + 1.0) * f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0f32.to_bits()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_and_error_functions_are_as_good_as_they_say() {
        let fma = |a: f32, b: f32, c: f32| a.mul_add(b, c);
        for x in (-870_000..880_000).map(|i| i as f32 * 1e-4).chain([0.0, -87.0, 88.0]) {
            let exact = f64::from(x).exp();
            assert!((f64::from(exp_body(x, fma)) / exact - 1.0).abs() < 2e-7, "{x}");
        }
        assert!(exp_body(-1e9, fma) < 1e-37 && exp_body(f32::NAN, fma).is_nan());
        for x in (-60_000..60_000).map(|i| i as f32 * 1e-4) {
            let exact = libm::erf(f64::from(x));
            assert!((f64::from(erf_body(x, fma)) - exact).abs() < 5e-7, "{x}");
        }
    }

    #[test]
    fn the_error_unit_and_its_slope_are_those_of_the_normal_distribution() {
        let x: Vec<f32> = (-80_000..80_000).map(|i| i as f32 * 1e-4).chain([-1e4, 1e4]).collect();
        let (mut y, mut slope) = (x.clone(), vec![0.0; x.len()]);
        gelu(&mut y, &mut slope);
        for ((x, y), slope) in x.iter().map(|x| f64::from(*x)).zip(y).zip(slope) {
            let below = 0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2);
            let density = (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
            assert!((f64::from(y) - x * below).abs() < 2e-7 * x.abs().max(1.0), "{x}: {y}");
            assert!((f64::from(slope) - below - x * density).abs() < 4e-7, "{x}: {slope}");
        }
    }

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
    fn the_slope_of_tanh_is_exact_where_it_is_flat() {
        let x: Vec<f32> = (-40_000..40_000).map(|i| i as f32 * 1e-3).chain([0.0]).collect();
        let (mut y, mut slopes) = (x.clone(), vec![0.0; x.len()]);
        tanh_and_slope(&mut y, &mut slopes);
        for ((x, y), slope) in x.iter().zip(&y).zip(&slopes) {
            let exact = f64::from(*x).cosh().powi(-2);
            assert!((f64::from(*x).tanh() - f64::from(*y)).abs() < 2e-7 && y.abs() <= 1.0, "{x}: {y}");
            assert!((f64::from(*slope) - exact).abs() < 1e-6 * exact, "{x}: {slope} instead of {exact}");
        }
        assert_eq!((y.last(), slopes.last()), (Some(&0.0), Some(&1.0)));
        let (mut nan, mut slope) = ([f32::NAN], [0.0]);
        tanh_and_slope(&mut nan, &mut slope);
        assert!(nan[0].is_nan() && slope[0].is_nan());
    }

    #[test]
    fn dense_multiplies_and_does_not_depend_on_the_number_of_rows() {
        let (rows, inputs) = (15, 5);
        let x: Vec<f32> = (0..rows * inputs).map(|i| (i as f32 * 0.7).sin()).collect();
        let w: Vec<f32> = (0..inputs * 32).map(|i| (i as f32 * 0.3).cos()).collect();
        let bias: Vec<f32> = (0..32).map(|i| i as f32).collect();
        let mut y = vec![0.0; rows * 32];
        dense(&x, inputs, &w, Start::Bias(&bias), &mut y);
        for r in 0..rows {
            for c in 0..32 {
                let expected: f32 = bias[c] + (0..inputs).map(|k| x[r * inputs + k] * w[k * 32 + c]).sum::<f32>();
                assert!((y[r * 32 + c] - expected).abs() < 1e-5);
            }
            let mut one = vec![0.0; 32];
            dense(&x[r * inputs..(r + 1) * inputs], inputs, &w, Start::Bias(&bias), &mut one);
            assert_eq!(one, y[r * 32..(r + 1) * 32]);
        }
    }

    #[test]
    fn gradients_of_weights_are_sums_over_the_rows() {
        let (rows, inputs, outputs) = (11, 13, 64);
        let x: Vec<f32> = (0..rows * inputs).map(|i| (i as f32 * 0.7).sin()).collect();
        let of_y: Vec<f32> = (0..rows * outputs).map(|i| (i as f32 * 0.3).cos()).collect();
        let mut of_w = vec![1.0; inputs * outputs];
        dense_weights(&x, inputs, &of_y, &mut of_w);
        for i in 0..inputs {
            for o in 0..outputs {
                let sum: f32 = (0..rows).map(|r| x[r * inputs + i] * of_y[r * outputs + o]).sum();
                assert!((of_w[i * outputs + o] - 1.0 - sum).abs() < 1e-5);
            }
        }
    }

    #[test]
    #[cfg(target_arch = "x86_64")]
    fn both_register_widths_give_the_same_bits() {
        use std::arch::x86_64::{__m256, __m512};
        if !(std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma")) {
            return;
        }
        #[target_feature(enable = "avx512f,avx2,fma")]
        fn wide(p: Product, c: &mut [f32]) {
            product_body::<__m512>(p, c);
        }
        #[target_feature(enable = "avx2,fma")]
        fn narrow(p: Product, c: &mut [f32]) {
            product_body::<__m256>(p, c);
        }
        let a: Vec<f32> = (0..13 * 40).map(|i| (i as f32 * 0.7).sin()).collect();
        let b: Vec<f32> = (0..40 * 64).map(|i| (i as f32 * 0.3).cos()).collect();
        let p = Product {
            a: &a,
            a_row: 40,
            a_step: 1,
            b: &b,
            steps: 40,
            start: &ZERO[..64],
            start_stride: 0,
            rows: 13,
            columns: 64,
        };
        let [mut one, mut other] = [vec![0.0; 13 * 64], vec![0.0; 13 * 64]];
        // SAFETY: the processor has both.
        unsafe {
            wide(p, &mut one);
            narrow(p, &mut other);
        }
        assert_eq!(one, other);
    }
}
