//! Random numbers of a run: the rule by which every stream is derived from its seed.

use composer_shared::random::mix;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

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

/// Standard normal numbers for `modules` modules of `outputs` actions each, appended to `to`. They come in pairs; the last of a module is
/// thrown away if there is an odd number of actions.
pub fn normal_noise(rng: &mut impl Rng, modules: usize, outputs: usize, to: &mut Vec<f32>) {
    for _ in 0..modules {
        for i in (0..outputs).step_by(2) {
            let pair = normal_pair(rng);
            to.extend_from_slice(&pair[..(outputs - i).min(2)]);
        }
    }
}

/// Standard normal numbers for tests, the same ones from the same seed.
#[cfg(test)]
pub(crate) fn numbers(count: usize, seed: u64) -> Vec<f32> {
    let mut numbers = Vec::new();
    normal_noise(&mut stream(seed, Stream::Noise, 0, 0), count, 1, &mut numbers);
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
