//! From the float network of training to the integer image that modules run ([`composer_shared::policy`]), and how much
//! is lost.
//!
//! Weights become int8 with one scale per output (the row's largest weight is 127). The latent message becomes int8
//! with one scale per channel, which costs nothing at run time: the key's scales are multiplied into the queries, the
//! value's into the columns of the hidden layer. Those scales, and the queries', come from observations of real
//! episodes (calibration). A memory needs no scale of its own: it is a mean of activations, and the leak is a shift. The bias of distance comes
//! in the unit of a logit.

use std::ops::Range;

use composer_shared::nn::{ARGUMENT_BITS, MAX_SHIFT, ONE};
use composer_shared::observation::Observation;
use composer_shared::policy::{
    CLIP, CONTEXT_SHIFT, Encoded, HIDDEN, IMAGE_SIZE, ImageWriter, KEY, Latent, Layer, MEMORY, Memory, Meta, OUT,
    Policy, PolicyError, VALUE,
};
use composer_shared::robot::MAX_MODULES;

use crate::methods::composer::float::FloatPolicy;
use crate::network::{Dense, Network, NetworkError};

/// Why a network cannot be frozen.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FreezeError {
    /// The network itself is unusable.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// Network and description disagree.
    #[error("the description says attention = {meta}, the network says {network}")]
    Attention {
        /// What the description says.
        meta: bool,
        /// What the network says.
        network: bool,
    },
    /// Nothing to take scales from.
    #[error("freezing needs observations of real episodes to choose scales from, and there are none")]
    NoCalibration,
    /// A step of more modules than a bus has.
    #[error("a calibration step has {0} modules, at most {MAX_MODULES} are possible")]
    Modules(usize),
    /// An observation is infinite or not a number.
    #[error("a calibration observation contains {0}, only finite numbers can be used")]
    Observation(f32),
    /// Weights too large for the fixed point of the layer.
    #[error(
        "the weights of the {layer} layer are too large for fixed point: training has diverged, use an earlier checkpoint"
    )]
    Range {
        /// Which layer.
        layer: &'static str,
    },
    /// The image would be refused.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// Difference between float and integer actions.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Parity {
    /// Root mean square, in fractions of the torque limit.
    pub rms: f32,
    /// Largest.
    pub max: f32,
    /// 99 of 100 differences are at most this.
    pub p99: f32,
    /// Actions compared, one for each axis of each module in each step.
    pub samples: usize,
}

impl Parity {
    /// Of these differences.
    pub fn of(mut differences: Vec<f32>) -> Self {
        differences.sort_by(f32::total_cmp);
        let samples = differences.len();
        let squares: f64 = differences.iter().map(|d| f64::from(*d).powi(2)).sum();
        Parity {
            rms: (squares / samples.max(1) as f64).sqrt() as f32,
            max: differences.last().copied().unwrap_or(0.0),
            p99: differences.get((samples * 99).div_ceil(100).saturating_sub(1)).copied().unwrap_or(0.0),
            samples,
        }
    }
}

/// Shares of the latents seen in calibration that the int8 range has to cover, tried in turn.
const COVERED: [f64; 2] = [1.0, 0.999];
/// How much further than that the range reaches: a latent that saturates costs more than a slightly coarser step.
const LATENT_HEADROOM: f32 = 1.2;
/// Calibration steps used: more would not change a scale noticeably.
const CALIBRATION_STEPS: usize = 1000;
/// Of these, steps on which each choice of scales is tried out.
const TRIAL_STEPS: usize = 200;
/// The largest bias of distance in units of a logit: finer than that would not show.
const DISTANCE_REACH: f32 = (1u32 << 28) as f32;
/// How much larger than in calibration a query may be before it saturates; int16 has bits to spare.
const QUERY_HEADROOM: f32 = 4.0;

/// The observations of all modules at every step of an episode.
pub type Steps = Vec<Vec<Observation>>;

/// Freezes `network` to a policy image. `calibration` holds episodes.
pub fn freeze(network: &Network, meta: &Meta, calibration: &[Steps]) -> Result<Vec<u8>, FreezeError> {
    network.check()?;
    if meta.attention != network.attention {
        return Err(FreezeError::Attention { meta: meta.attention, network: network.attention });
    }
    if let Some(value) = calibration.iter().flatten().flatten().flatten().find(|x| !x.is_finite()) {
        return Err(FreezeError::Observation(*value));
    }
    if let Some(step) = calibration.iter().flatten().find(|step| step.len() > MAX_MODULES) {
        return Err(FreezeError::Modules(step.len()));
    }
    let sequences = thin_out(network, calibration, CALIBRATION_STEPS);
    if sequences.iter().flatten().all(|step| step.is_empty()) {
        return Err(FreezeError::NoCalibration);
    }
    if !network.attention {
        return image(network, meta, &Scales { key: [1.0; KEY], value: [1.0; VALUE], query: 1.0 });
    }
    let float = FloatPolicy::new(network);
    let samples = Samples::of(&float, &sequences);
    let mut trial = thin_out(network, calibration, TRIAL_STEPS);
    // Averaged over many values the clipping of one hardly shows, so every module alone is tried as well.
    let alone: Vec<Sequence> = trial.iter().flat_map(|sequence| one_by_one(sequence)).collect();
    trial.extend(alone);
    let mut best: Option<(f32, Vec<u8>)> = None;
    for key in COVERED {
        for value in COVERED {
            let image = image(network, meta, &samples.scales(key, value, &network.distance_bias))?;
            let parity = compare(&float, &Policy::parse(&image)?, &trial);
            // Rare large differences count too.
            let cost = parity.rms + parity.max / 4.0;
            if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                best = Some((cost, image));
            }
        }
    }
    best.map(|(_, image)| image).ok_or(FreezeError::NoCalibration)
}

/// Compares the actions of `network` and `policy` in these episodes, in which every module hears every other.
///
/// # Panics
/// If a step has more than 64 modules.
pub fn parity(network: &Network, policy: &Policy, episodes: &[Steps]) -> Parity {
    compare(&FloatPolicy::new(network), policy, &thin_out(network, episodes, usize::MAX))
}

fn compare(float: &FloatPolicy, policy: &Policy, sequences: &[Sequence]) -> Parity {
    let mut differences = Vec::new();
    for sequence in sequences {
        let n = sequence.iter().map(|step| step.len()).max().unwrap_or(0);
        let (mut exact_memories, mut memories) = (vec![[0.0; MEMORY]; n], vec![Memory::EMPTY; n]);
        for observations in sequence {
            let n = observations.len();
            let mut exact = vec![[0.0; OUT]; n];
            float.act(&mut exact_memories[..n], observations, &vec![u64::MAX; n], &mut exact, None);
            let integer = act(policy, &mut memories[..n], observations);
            differences.extend(exact.as_flattened().iter().zip(integer.as_flattened()).map(|(f, i)| (f - i).abs()));
        }
    }
    Parity::of(differences)
}

/// The actions of the integer `policy` for all modules of one robot, all of which hear each other; `memories` has one a module, which goes on by a
/// step.
///
/// # Panics
/// If there are more than 64 modules.
pub fn act(policy: &Policy, memories: &mut [Memory], observations: &[Observation]) -> Vec<[f32; OUT]> {
    let encoded: Vec<Encoded> =
        observations.iter().zip(memories).map(|(observation, memory)| policy.encode(memory, observation)).collect();
    let mut latents = [Latent::ZERO; MAX_MODULES];
    latents[..encoded.len()].iter_mut().zip(&encoded).for_each(|(to, from)| *to = from.latent);
    let heard = u64::MAX.checked_shr(64 - encoded.len() as u32).unwrap_or(0);
    encoded.iter().enumerate().map(|(i, own)| policy.act(own, &latents, heard, None, i)).collect()
}

/// Steps that follow each other.
type Sequence<'a> = Vec<&'a [Observation]>;

/// At most `count` steps of these episodes, evenly spread, each for itself; of a network with memory whole episodes, evenly spread, until there are so
/// many steps.
fn thin_out<'a>(network: &Network, episodes: &'a [Steps], count: usize) -> Vec<Sequence<'a>> {
    let steps: usize = episodes.iter().map(Vec::len).sum();
    let every = steps.div_ceil(count).max(1);
    if network.memory == 0 {
        return episodes.iter().flatten().step_by(every).map(|step| vec![&step[..]]).collect();
    }
    episodes.iter().step_by(every).map(|episode| episode.iter().map(|step| &step[..]).collect()).collect()
}

/// The sequences of its modules.
fn one_by_one<'a>(sequence: &Sequence<'a>) -> Vec<Sequence<'a>> {
    let modules = sequence.iter().map(|step| step.len()).min().unwrap_or(0);
    (0..modules).map(|module| sequence.iter().map(|step| &step[module..=module]).collect()).collect()
}

/// What one unit of the integers stands for.
struct Scales {
    key: [f32; KEY],
    value: [f32; VALUE],
    /// Of a query that has the key's scales multiplied in.
    query: f32,
}

/// Magnitudes seen in calibration, in ascending order, channel by channel.
struct Samples {
    query: [Vec<f32>; KEY],
    key: [Vec<f32>; KEY],
    value: [Vec<f32>; VALUE],
}

impl Samples {
    fn of(float: &FloatPolicy, sequences: &[Sequence]) -> Self {
        let mut samples = Samples {
            query: [const { Vec::new() }; KEY],
            key: [const { Vec::new() }; KEY],
            value: [const { Vec::new() }; VALUE],
        };
        let push = |to: &mut [Vec<f32>], from: &[f32]| to.iter_mut().zip(from).for_each(|(to, x)| to.push(x.abs()));
        for sequence in sequences {
            let mut memories = vec![[0.0; MEMORY]; sequence.iter().map(|step| step.len()).max().unwrap_or(0)];
            for latent in sequence.iter().flat_map(|step| float.latents(&mut memories[..step.len()], step)) {
                push(&mut samples.query, &latent[..KEY]);
                push(&mut samples.key, &latent[KEY..2 * KEY]);
                push(&mut samples.value, &latent[2 * KEY..]);
            }
        }
        let all = samples.query.iter_mut().chain(&mut samples.key).chain(&mut samples.value);
        all.for_each(|channel| channel.sort_by(f32::total_cmp));
        samples
    }

    /// Scales that represent these shares of keys and values without saturating, and a bias of distance.
    fn scales(&self, key_share: f64, value_share: f64, distance_bias: &[f32]) -> Scales {
        let scale = |channel: &Vec<f32>, share: f64| {
            let rank = (channel.len() as f64 * share).ceil() as usize;
            let reach = channel.get(rank.clamp(1, channel.len().max(1)) - 1).copied().unwrap_or(0.0);
            // A channel that is always zero may have any scale.
            if reach > 1e-20 { LATENT_HEADROOM * reach / 127.0 } else { 1.0 }
        };
        let key = self.key.each_ref().map(|channel| scale(channel, key_share));
        let value = self.value.each_ref().map(|channel| scale(channel, value_share));
        let reaches = self.query.iter().zip(key).map(|(channel, key)| channel.last().copied().unwrap_or(0.0) * key);
        let reach = reaches.fold(0.0, f32::max);
        let query = if reach > 1e-20 { QUERY_HEADROOM * reach / f32::from(ONE) } else { 1.0 };
        let bias = distance_bias.iter().fold(0.0, |largest: f32, bias| largest.max(bias.abs()));
        let query = query.max(bias * (KEY as f32).sqrt() / DISTANCE_REACH);
        Scales { key, value, query }
    }
}

/// Writes the image for given scales.
fn image(network: &Network, meta: &Meta, scales: &Scales) -> Result<Vec<u8>, FreezeError> {
    let one = f64::from(ONE);
    let argument = f64::from(1u32 << ARGUMENT_BITS);
    let mut image = Box::new([0; IMAGE_SIZE]);
    let mut writer = ImageWriter::new(meta, network.shape(), &mut image);
    for field in 0..network.inputs {
        let gain = one / (f64::from(CLIP) * f64::from(network.std[field]));
        writer.input(field, network.mean[field], gain as f32);
    }

    // The unit of an activation is 1 / 32767, that of an argument of tanh 1 / 65536.
    let activation = 1.0 / one;
    let features = network.features();
    let biased = |dense: &Dense, unit: f64| Some((dense.bias.clone(), unit));
    let encoder = Rows::of(&network.encoder, "encoder", 0..network.inputs, |_| f64::from(CLIP) * activation);
    encoder.write(&mut writer, Layer::Encoder, |_| argument, biased(&network.encoder, argument))?;
    if network.attention {
        let query = Rows::of(&network.query, "query", 0..features, |_| activation);
        let query_unit = |o: usize| f64::from(scales.query) / f64::from(scales.key[o]);
        query.write(&mut writer, Layer::Query, |o| query_unit(o).recip(), None)?;
        let key = Rows::of(&network.key, "key", 0..features, |_| activation);
        key.write(&mut writer, Layer::Key, |o| f64::from(scales.key[o]).recip(), None)?;
        let value = Rows::of(&network.value, "value", 0..features, |_| activation);
        value.write(&mut writer, Layer::Value, |o| f64::from(scales.value[o]).recip(), None)?;
        // A unit of the logits in Q16 of base-2 logarithms.
        let unit = f64::from(scales.query) / (KEY as f64).sqrt() * std::f64::consts::LOG2_E * 65536.0;
        let shift = shift_for(unit).ok_or_else(|| query.too_large())?;
        writer.softmax((unit * 2f64.powi(shift.into())).round() as i32, shift);
        for (bucket, bias) in network.distance_bias.iter().enumerate() {
            let unit = f64::from(scales.query) / (KEY as f64).sqrt();
            writer.distance(bucket, (f64::from(*bias) / unit).round() as i32);
        }
        let unit = |i: usize| f64::from(scales.value[i]) * f64::from(1u32 << CONTEXT_SHIFT) * activation;
        let context = Rows::of(&network.hidden, "hidden", features..features + VALUE, unit);
        context.write(&mut writer, Layer::Context, |_| argument, None)?;
    }
    let hidden = Rows::of(&network.hidden, "hidden", 0..features, |_| activation);
    hidden.write(&mut writer, Layer::Hidden, |_| argument, biased(&network.hidden, argument))?;
    let output = Rows::of(&network.output, "output", 0..HIDDEN, |_| activation);
    output.write(&mut writer, Layer::Output, |_| one, biased(&network.output, one))?;
    writer.finish()?;
    Ok(image.to_vec())
}

/// The weights of a layer, or of some of its columns, for integer inputs.
struct Rows {
    name: &'static str,
    rows: Vec<Vec<f64>>,
}

impl Rows {
    /// The given columns; `unit(i)` is what one unit of integer input `i` of these stands for.
    fn of(dense: &Dense, name: &'static str, columns: Range<usize>, unit: impl Fn(usize) -> f64) -> Self {
        let scaled = |row: &[f32]| row.iter().enumerate().map(|(i, weight)| f64::from(*weight) * unit(i)).collect();
        Rows { name, rows: dense.weights.chunks_exact(dense.inputs).map(|row| scaled(&row[columns.clone()])).collect() }
    }

    /// Writes them as `layer`; `unit(o)` is how many units of integer output `o` make 1. The biases come with the units
    /// that make 1.
    fn write(
        &self,
        writer: &mut ImageWriter,
        layer: Layer,
        unit: impl Fn(usize) -> f64,
        bias: Option<(Vec<f32>, f64)>,
    ) -> Result<(), FreezeError> {
        let steps: Vec<f64> = self.rows.iter().map(|row| largest(row) / 127.0).collect();
        let multipliers: Vec<f64> = steps.iter().enumerate().map(|(o, step)| step * unit(o)).collect();
        let shift = shift_for(largest(&multipliers)).ok_or_else(|| self.too_large())?;
        writer.shift(layer, shift);
        for (o, row) in self.rows.iter().enumerate() {
            let quantised = |weight: &f64| if steps[o] > 0.0 { (weight / steps[o]).round() as i8 } else { 0 };
            let weights: Vec<i8> = row.iter().map(quantised).collect();
            let multiplier = (multipliers[o] * 2f64.powi(shift.into())).round() as i32;
            // `as` saturates; a bias that large drives its output into saturation anyway.
            let bias = bias.as_ref().map_or(0, |(bias, unit)| (f64::from(bias[o]) * unit).round() as i32);
            writer.row(layer, o, multiplier, bias, &weights);
        }
        Ok(())
    }

    fn too_large(&self) -> FreezeError {
        FreezeError::Range { layer: self.name }
    }
}

fn largest(numbers: &[f64]) -> f64 {
    numbers.iter().fold(0.0, |largest, x| largest.max(x.abs()))
}

/// The largest shift with which `largest * 2^shift` still is an i32.
fn shift_for(largest: f64) -> Option<u8> {
    (1..=MAX_SHIFT).rev().find(|shift| largest * 2f64.powi((*shift).into()) < f64::from(i32::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::testing::{observations, random_network, random_network_of};
    use composer_shared::observation::{BASE, SIZE};
    use composer_shared::policy::{GoalKnownTo, Task};
    use composer_shared::robot::{Geometry, Limits};

    fn meta(attention: bool) -> Meta {
        Meta {
            task: Task::GoalReaching,
            goal_known_to: GoalKnownTo::Head,
            attention,
            trained_with_faults: true,
            geometry: Geometry::default(),
            limits: Limits::default(),
            control_period_us: 50_000,
            relax_seconds: 0.3,
            task_digest: 7,
        }
    }

    fn steps(seed: u64, count: u64, modules: usize) -> Vec<Steps> {
        vec![(0..count).map(|step| observations(seed * 1_000_003 + step, modules)).collect()]
    }

    /// Episodes in which what a module observes changes slowly, as that of a robot does.
    fn episodes(seed: u64, count: u64, length: u64, modules: usize) -> Vec<Steps> {
        (0..count)
            .map(|episode| {
                let mut now = observations(seed * 7919 + episode, modules);
                let mut go_on = |step| {
                    for (now, to) in now.iter_mut().zip(observations(seed * 7919 + episode + 1_000_000 * step, modules))
                    {
                        now.iter_mut().zip(to).for_each(|(now, to)| *now = 0.9 * *now + 0.4 * to);
                    }
                    now.clone()
                };
                (1..=length).map(&mut go_on).collect()
            })
            .collect()
    }

    #[test]
    fn integers_follow_the_float_network() {
        let mut worst = 0.0f32;
        for seed in 0..20 {
            let attention = seed % 4 != 3;
            let network = random_network(seed, attention);
            let image = freeze(&network, &meta(attention), &steps(seed, 300, 8)).unwrap();
            let policy = Policy::parse(&image).unwrap();
            assert_eq!(policy.meta(), meta(attention));
            for modules in [1, 8, 11, 64] {
                let parity = parity(&network, &policy, &steps(seed + 100, 1 + 400 / modules as u64, modules));
                println!("seed {seed}, {modules} modules, attention {attention}: {parity:?}");
                assert!(parity.rms < 0.01 && parity.p99 < 0.025 && parity.max < 0.04, "{parity:?}");
                worst = worst.max(parity.max);
            }
        }
        println!("largest difference of an action: {worst:.4}");
    }

    /// Memory, bias of distance and the whole observation, over episodes longer than any task's.
    #[test]
    fn integers_with_a_memory_follow_the_float_network() {
        let mut worst = 0.0f32;
        for seed in 0..8 {
            let (attention, inputs) = (seed % 4 != 3, [SIZE, SIZE, BASE, SIZE][seed as usize % 4]);
            let network = random_network_of(seed, attention, inputs, MEMORY);
            let image = freeze(&network, &meta(attention), &episodes(seed, 10, 60, 8)).unwrap();
            let policy = Policy::parse(&image).unwrap();
            assert_eq!(policy.shape(), network.shape());
            assert_eq!(policy.distance_bias(), attention);
            for (modules, length) in [(1, 2000), (8, 500), (11, 100), (64, 20)] {
                let parity = parity(&network, &policy, &episodes(seed + 100, 2, length, modules));
                println!("seed {seed}, {modules} modules, {length} steps, attention {attention}: {parity:?}");
                assert!(parity.rms < 0.01 && parity.p99 < 0.025 && parity.max < 0.05, "{parity:?}");
                worst = worst.max(parity.max);
            }
        }
        println!("largest difference of an action: {worst:.4}");
    }

    /// The memories themselves drift apart by no more than the embeddings do, however long it goes on.
    #[test]
    fn a_memory_of_integers_does_not_drift() {
        let network = random_network_of(3, true, SIZE, MEMORY);
        let image = freeze(&network, &meta(true), &episodes(3, 10, 60, 8)).unwrap();
        let (policy, float) = (Policy::parse(&image).unwrap(), FloatPolicy::new(&network));
        let (mut memories, mut exact) = ([Memory::EMPTY; 4], [[0.0; MEMORY]; 4]);
        let mut worst = [0.0f32; 2];
        for (step, observations) in episodes(9, 1, 4000, 4)[0].iter().enumerate() {
            act(&policy, &mut memories, observations);
            float.latents(&mut exact, observations);
            for (memory, exact) in memories.iter().zip(&exact) {
                for (got, exact) in memory.activations().iter().zip(exact) {
                    let half = usize::from(step >= 2000);
                    worst[half] = worst[half].max((f32::from(*got) / f32::from(ONE) - exact).abs());
                }
            }
        }
        println!("largest difference of a memory: {worst:?}");
        // That of int8 weights, no more in the second half than in the first.
        assert!(worst[0] < 0.05 && worst[1] < 1.2 * worst[0], "{worst:?}");
    }

    #[test]
    fn a_large_bias_over_small_queries_fits() {
        let mut network = random_network_of(11, true, SIZE, MEMORY);
        network.query.weights.iter_mut().for_each(|w| *w *= 1e-9);
        network.distance_bias[8] = 30.0;
        let image = freeze(&network, &meta(true), &episodes(11, 2, 50, 8)).unwrap();
        let policy = Policy::parse(&image).unwrap();
        let parity = parity(&network, &policy, &episodes(12, 2, 50, 8));
        assert!(parity.max < 0.05, "{parity:?}");
    }

    #[test]
    fn attention_of_integers_follows_the_float_network() {
        let network = random_network(1, true);
        let image = freeze(&network, &meta(true), &steps(1, 300, 8)).unwrap();
        let policy = Policy::parse(&image).unwrap();
        let mut worst = 0.0f32;
        for step in steps(2, 100, 8).remove(0) {
            let (mut actions, mut expected) = ([[0.0; 2]; 8], [0.0; 64]);
            let heard = [0b1010_0110; 8];
            FloatPolicy::new(&network).act(&mut [[0.0; MEMORY]; 8], &step, &heard, &mut actions, Some(&mut expected));
            let encoded: Vec<_> = step.iter().map(|o| policy.encode(&mut Memory::default(), o)).collect();
            let mut latents = [Latent::ZERO; MAX_MODULES];
            (0..8).for_each(|j| latents[j] = encoded[j].latent);
            for i in 0..8 {
                let mut weights = [0; MAX_MODULES];
                let action = policy.act(&encoded[i], &latents, heard[i], Some(&mut weights), i);
                (0..2).for_each(|axis| assert!((action[axis] - actions[i][axis]).abs() < 0.05));
                for j in 0..8 {
                    worst = worst.max((f32::from(weights[j]) / 32767.0 - expected[8 * i + j]).abs());
                }
                assert!(weights[8..].iter().all(|w| *w == 0));
            }
        }
        println!("largest difference of an attention weight: {worst:.4}");
        assert!(worst < 0.03, "{worst}");
    }

    #[test]
    fn a_network_of_zeros_and_one_of_small_weights_freeze() {
        let network = Network::zeros(true);
        let image = freeze(&network, &meta(true), &steps(5, 10, 4)).unwrap();
        assert_eq!(parity(&network, &Policy::parse(&image).unwrap(), &steps(6, 10, 4)).max, 0.0);
        // As right after initialisation: an output layer near zero must not come out as exactly zero.
        let mut network = random_network(7, true);
        network.output.weights.iter_mut().for_each(|w| *w *= 1e-3);
        network.output.bias.fill(0.0);
        let image = freeze(&network, &meta(true), &steps(7, 10, 4)).unwrap();
        let policy = Policy::parse(&image).unwrap();
        assert!(parity(&network, &policy, &steps(8, 10, 4)).max < 1e-4);
        assert!(act(&policy, &mut [Memory::EMPTY; 4], &observations(8, 4)).as_flattened().iter().any(|a| *a != 0.0));
    }

    #[test]
    fn what_cannot_be_frozen_is_refused_in_one_sentence() {
        let network = random_network(9, true);
        let said =
            |network: &Network, meta: &Meta, steps: &[Steps]| freeze(network, meta, steps).unwrap_err().to_string();
        let good = steps(9, 3, 8);
        assert!(said(&network, &meta(true), &[]).contains("needs observations of real episodes"));
        assert!(said(&network, &meta(false), &good).contains("attention = false"));
        assert!(said(&network, &meta(true), &steps(9, 1, 65)).contains("65 modules"));
        let mut bad = good.clone();
        bad[0][1][2][3] = f32::INFINITY;
        assert!(said(&network, &meta(true), &bad).contains("contains inf"));
        let mut broken = network.clone();
        broken.query.weights[0] = f32::NAN;
        assert!(said(&broken, &meta(true), &good).contains("the query layer"));
        let too_much = Network::zeros_of(true, SIZE, 32);
        assert!(said(&too_much, &meta(true), &good).contains("has room for 16 or none"));
        let mut huge = network.clone();
        huge.hidden.weights[0] = 1e30;
        assert!(said(&huge, &meta(true), &good).contains("too large for fixed point"));
        let endless = Meta { relax_seconds: f32::INFINITY, ..meta(true) };
        assert!(said(&network, &endless, &good).contains("relaxation time"));
    }

    #[test]
    fn the_same_network_gives_the_same_image() {
        let network = random_network(10, true);
        let calibration = steps(10, 50, 8);
        assert_eq!(freeze(&network, &meta(true), &calibration), freeze(&network, &meta(true), &calibration));
    }
}
