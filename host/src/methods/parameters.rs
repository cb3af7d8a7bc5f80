//! Flat parameter vectors: their layout in named blocks, orthogonal initialisation, Adam, and the clipping of gradients.

use rand::Rng;

use super::random::normal_pair;

/// A named matrix inside a flat parameter vector, row-major, one row per output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// What the matrix is.
    pub name: &'static str,
    /// Outputs.
    pub rows: usize,
    /// Inputs.
    pub columns: usize,
    /// Where the matrix starts in the vector.
    pub offset: usize,
}

impl Block {
    /// Numbers in the block.
    pub fn len(&self) -> usize {
        self.rows * self.columns
    }

    /// Whether the block holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The block's place in the vector.
    pub fn range(&self) -> std::ops::Range<usize> {
        self.offset..self.offset + self.len()
    }
}

/// Lays blocks out one after the other. Returns them and their total length.
pub(crate) fn lay_out<const N: usize>(blocks: [(&'static str, usize, usize); N]) -> ([Block; N], usize) {
    let mut offset = 0;
    let blocks = blocks.map(|(name, rows, columns)| {
        let block = Block { name, rows, columns, offset };
        offset += block.len();
        block
    });
    (blocks, offset)
}

/// A random (semi-)orthogonal matrix times `gain`, row-major: orthonormal rows if `rows <= columns`, else orthonormal columns.
pub fn orthogonal(rows: usize, columns: usize, gain: f32, rng: &mut impl Rng) -> Vec<f32> {
    let (count, length) = (rows.min(columns), rows.max(columns));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(count);
    while basis.len() < count {
        let mut v: Vec<f64> =
            (0..length.div_ceil(2)).flat_map(|_| normal_pair(rng)).map(f64::from).take(length).collect();
        // Gram-Schmidt, twice: once alone leaves rounding errors in the last vectors.
        for _ in 0..2 {
            for b in &basis {
                let dot: f64 = v.iter().zip(b).map(|(x, y)| x * y).sum();
                v.iter_mut().zip(b).for_each(|(x, y)| *x -= dot * y);
            }
        }
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm > 1e-6 {
            basis.push(v.into_iter().map(|x| x / norm).collect());
        }
    }
    let at = |r: usize, c: usize| if rows <= columns { basis[r][c] } else { basis[c][r] };
    (0..rows * columns).map(|i| gain * at(i / columns, i % columns) as f32).collect()
}

/// The Adam optimiser over a flat parameter vector (Kingma and Ba, 2015), without weight decay.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// Running mean of the gradient.
    pub first: Vec<f32>,
    /// Running mean of its square.
    pub second: Vec<f32>,
    /// Steps taken.
    pub steps: u64,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

impl Adam {
    const BETA: [f64; 2] = [0.9, 0.999];

    /// For `parameters` numbers.
    pub fn new(parameters: usize, epsilon: f32) -> Self {
        Self { first: vec![0.0; parameters], second: vec![0.0; parameters], steps: 0, epsilon }
    }

    /// One step against `gradient`.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32], learning_rate: f32) {
        self.steps += 1;
        let [beta1, beta2] = Self::BETA;
        let power = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let rate = (f64::from(learning_rate) / (1.0 - beta1.powi(power))) as f32;
        let scale = (1.0 / (1.0 - beta2.powi(power)).sqrt()) as f32;
        let (beta1, beta2) = (beta1 as f32, beta2 as f32);
        for (((p, g), m), v) in parameters.iter_mut().zip(gradient).zip(&mut self.first).zip(&mut self.second) {
            *m = beta1 * *m + (1.0 - beta1) * g;
            *v = beta2 * *v + (1.0 - beta2) * g * g;
            *p -= rate * *m / (v.sqrt() * scale + self.epsilon);
        }
    }
}

/// Scales `gradient` down to a norm of at most `limit`, over all of it (not per matrix). Returns the norm it had.
pub fn clip_norm(gradient: &mut [f32], limit: f32) -> f32 {
    let norm = gradient.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt() as f32;
    if norm > limit {
        let scale = limit / norm;
        gradient.iter_mut().for_each(|g| *g *= scale);
    }
    norm
}

/// The same parameters with each of `blocks` the other way round: one row per input where there was one per output.
pub(crate) fn transpose(parameters: &[f32], blocks: &[Block], to: &mut [f32]) {
    for block in blocks {
        let (from, to) = (&parameters[block.range()], &mut to[block.range()]);
        for (row, from) in from.chunks_exact(block.columns.max(1)).enumerate() {
            for (column, x) in from.iter().enumerate() {
                to[column * block.rows + row] = *x;
            }
        }
    }
}

/// Undoes [`transpose`].
pub(crate) fn transpose_back(transposed: &[f32], blocks: &[Block], to: &mut [f32]) {
    for block in blocks {
        let (from, to) = (&transposed[block.range()], &mut to[block.range()]);
        for (row, to) in to.chunks_exact_mut(block.columns.max(1)).enumerate() {
            for (column, x) in to.iter_mut().enumerate() {
                *x = from[column * block.rows + row];
            }
        }
    }
}

/// The first `len` numbers of `memory`, which grows if it must and is not cleared.
pub(crate) fn room(memory: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if memory.len() < len {
        memory.resize(len, 0.0);
    }
    &mut memory[..len]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::random::{Stream, stream};

    #[test]
    fn orthogonal_matrices_are() {
        let mut rng = stream(1, Stream::Weights, 0, 0);
        for (rows, columns) in [(5, 12), (12, 5), (7, 7)] {
            let m = orthogonal(rows, columns, 2.0, &mut rng);
            let at = |r: usize, c: usize| m[r * columns + c];
            let short = rows.min(columns);
            for i in 0..short {
                for j in 0..short {
                    let dot: f32 = if rows <= columns {
                        (0..columns).map(|c| at(i, c) * at(j, c)).sum()
                    } else {
                        (0..rows).map(|r| at(r, i) * at(r, j)).sum()
                    };
                    assert!((dot - if i == j { 4.0 } else { 0.0 }).abs() < 1e-5, "{rows}x{columns} {i} {j}: {dot}");
                }
            }
        }
    }

    #[test]
    fn adam_makes_first_steps_of_the_learning_rate_and_finds_a_minimum() {
        let mut x = vec![3.0f32, -2.0];
        let mut adam = Adam::new(2, 1e-8);
        adam.step(&mut x, &[10.0, -0.001], 0.1);
        assert!((x[0] - 2.9).abs() < 1e-5 && (x[1] + 1.9).abs() < 1e-4, "{x:?}");
        for _ in 0..500 {
            let gradient: Vec<f32> = x.iter().map(|x| 2.0 * (x - 1.0)).collect();
            adam.step(&mut x, &gradient, 0.05);
        }
        assert!(x.iter().all(|x| (x - 1.0).abs() < 1e-2), "{x:?}");
    }

    #[test]
    fn the_norm_is_clipped_over_everything() {
        let mut g = vec![3.0, 4.0];
        assert_eq!(clip_norm(&mut g, 10.0), 5.0);
        assert_eq!(g, [3.0, 4.0]);
        clip_norm(&mut g, 1.0);
        assert!((g[0] - 0.6).abs() < 1e-6 && (g[1] - 0.8).abs() < 1e-6);
    }
}
