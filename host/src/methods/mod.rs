//! The learning methods: one policy shared by all modules, trained with PPO against a critic that sees the whole team.
//!
//! What is shared by all methods lives here: flat parameters with named blocks, orthogonal initialisation, Adam, and the rule by
//! which every random stream is derived from the seed of the run, and the threads that share the work.

pub mod actor;
pub mod actor_critic;
pub mod autodiff;
pub mod buffer;
pub mod critic;
pub mod fused;
pub mod imagination;
pub(crate) mod kernels;
pub mod normalise;
pub mod ppo;
pub mod rollout;
pub(crate) mod simd;

use std::sync::{Arc, Mutex};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};
use serde::{Deserialize, Serialize};

/// How a policy is built and trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// COMPOSER (paper, section III): self-attention over the latents of the modules heard, and the imagination policy ([`imagination`]).
    Composer,
    /// COMPOSER without the imagination policy.
    ComposerNoImagination,
    /// COMPOSER without attention: modules do not talk.
    ComposerNoAttention,
    /// MAPPO: the same actor with neither. PPO with one actor shared by all modules and a central critic.
    Mappo,
}

impl Method {
    /// Every method, in the order of the documentation.
    pub const ALL: [Method; 4] =
        [Method::Composer, Method::ComposerNoImagination, Method::ComposerNoAttention, Method::Mappo];

    /// Name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Method::Composer => "composer",
            Method::ComposerNoImagination => "composer-no-imagination",
            Method::ComposerNoAttention => "composer-no-attention",
            Method::Mappo => "mappo",
        }
    }

    /// The method of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|method| method.name() == name)
    }

    /// Whether the actor attends to the latents of other modules.
    pub fn attention(self) -> bool {
        matches!(self, Method::Composer | Method::ComposerNoImagination)
    }

    /// Whether an imagination policy guides the training.
    pub fn imagination(self) -> bool {
        matches!(self, Method::Composer | Method::ComposerNoAttention)
    }
}

impl std::fmt::Display for Method {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::from_name(name).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|method| method.name()).collect();
            format!("there is no method `{name}`; the methods are {}", names.join(", "))
        })
    }
}

/// Which code computes the gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Differentiation {
    /// The backward passes written by hand for these two networks ([`actor`], [`critic`]).
    #[default]
    Manual,
    /// burn's automatic differentiation ([`autodiff`]): several times slower, the same up to rounding. The reference for the former and
    /// where to begin with a network of another kind.
    Automatic,
}

/// The threads of a run. They live as long as this and its clones do.
#[derive(Clone, Debug)]
pub struct Workers {
    pool: Arc<rayon::ThreadPool>,
}

impl Workers {
    /// Starts so many threads.
    ///
    /// # Errors
    ///
    /// If the system does not give them.
    pub fn new(threads: usize) -> anyhow::Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.max(1)).build()?;
        Ok(Self { pool: Arc::new(pool) })
    }

    /// How many there are.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Runs `work` on one of the threads: what it asks the workers for in turn then starts without a switch of threads.
    pub fn enter<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        self.pool.install(work)
    }

    /// Applies `task` to every item; whoever is free takes the next. Each thread has an entry of `scratch` for itself meanwhile, so there
    /// should be as many as threads.
    pub fn for_each<I, S>(&self, items: I, scratch: &mut [S], task: impl Fn(I::Item, &mut S) + Sync)
    where
        I: IntoIterator,
        I::IntoIter: Send,
        S: Send,
    {
        let items = Mutex::new(items.into_iter());
        self.pool.install(|| {
            scratch.par_iter_mut().for_each(|scratch| {
                loop {
                    // The lock is held only to take the next item.
                    let next = items.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next();
                    let Some(item) = next else { return };
                    task(item, scratch);
                }
            });
        });
    }

    /// Runs both, side by side if two threads are free.
    pub fn join<A: Send, B: Send>(&self, a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
        self.pool.join(a, b)
    }
}

/// What a random stream is for. No state of a generator is ever stored: each use has a stream of its own, derived from the seed of the
/// run, so that a resumed run draws what the uninterrupted one would have drawn.
#[derive(Clone, Copy, Debug)]
pub enum Stream {
    /// Initial weights.
    Weights = 1,
    /// Seeds of episodes.
    Episode = 2,
    /// Noise on the actions of a rollout.
    Noise = 3,
    /// Order of the samples in the minibatches.
    Shuffle = 4,
    /// Seed of all streams of the imagination policy, which stands for the run's in them.
    Imagination = 5,
}

/// Seed of the stream `stream` of a run, numbered by (`major`, `minor`): iteration and environment, say.
pub fn derive_seed(run_seed: u64, stream: Stream, major: u64, minor: u64) -> u64 {
    // SplitMix64's finaliser over each part in turn: changing any bit of any part changes about half of the result's bits.
    [stream as u64, major, minor].into_iter().fold(mix(run_seed), |state, part| mix(state ^ mix(part)))
}

/// SplitMix64's finaliser.
pub(crate) fn mix(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// The generator of a stream (see [`derive_seed`]).
pub fn stream(run_seed: u64, stream: Stream, major: u64, minor: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(derive_seed(run_seed, stream, major, minor))
}

/// Two independent standard normal numbers (Box-Muller).
pub fn normal_pair(rng: &mut impl Rng) -> [f32; 2] {
    // 1 - u is in (0, 1]: its logarithm is finite.
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
    [(radius * cos) as f32, (radius * sin) as f32]
}

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

#[cfg(test)]
mod tests {
    use super::*;

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
    fn streams_differ_in_every_part() {
        let seeds = [
            derive_seed(1, Stream::Noise, 0, 0),
            derive_seed(2, Stream::Noise, 0, 0),
            derive_seed(1, Stream::Shuffle, 0, 0),
            derive_seed(1, Stream::Noise, 1, 0),
            derive_seed(1, Stream::Noise, 0, 1),
        ];
        for (i, a) in seeds.iter().enumerate() {
            assert!(!seeds[..i].contains(a));
        }
    }

    #[test]
    fn normal_numbers_have_mean_zero_and_variance_one() {
        let mut rng = stream(3, Stream::Noise, 0, 0);
        let samples: Vec<f64> = (0..20_000).flat_map(|_| normal_pair(&mut rng)).map(f64::from).collect();
        let mean = samples.iter().sum::<f64>() / samples.len() as f64;
        let variance = samples.iter().map(|x| x * x).sum::<f64>() / samples.len() as f64;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "{mean} {variance}");
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

    #[test]
    fn methods_have_names() {
        for method in Method::ALL {
            assert_eq!(method.name().parse::<Method>(), Ok(method));
            assert_eq!(serde_json::to_string(&method).unwrap(), format!("\"{}\"", method.name()));
        }
        assert!("composers".parse::<Method>().unwrap_err().contains("composer-no-attention, mappo"));
    }
}
