//! What is compared between the host and the emulated processor: one run through every kernel, and through whole policies.
//!
//! The same function runs on both sides. The host's [`Side`] makes up the inputs and writes them down together with its results; the
//! image's reads the inputs and compares its results. So there is one definition of what a case is, and no format but the order.

use composer_shared::kinematics::Chain;
use composer_shared::math::sin_cos;
use composer_shared::nn::{self, Dense, Query};
use composer_shared::observation::{Motors, Seeker, Sensors, Told, observe};
use composer_shared::policy::{
    DISTANCE_BUCKETS, FEATURES, IMAGE_SIZE, ImageWriter, Latent, Layer, Memory, Meta, OBS, Policy, Shape, random_image,
};
use composer_shared::robot::{Geometry, MAX_MODULES};
use nalgebra::Vector3;

/// The first bytes of the file, before the number of rounds (u32, little-endian).
pub const MAGIC: [u8; 8] = *b"VECTORS1";
/// Where the file is loaded: in the middle of the board's RAM, beyond what the image uses.
#[allow(dead_code)] // The host takes it for the command line, the image for the address.
pub const ADDRESS: usize = 0x2020_0000;
/// Most bytes of a file: up to the end of the RAM.
#[allow(dead_code)] // The image takes what there is.
pub const CAPACITY: usize = 0x20_0000;

/// The host or the image.
pub trait Side {
    /// Input for the next case.
    fn input(&mut self, bytes: &mut [u8]);
    /// The result of a case.
    fn result(&mut self, case: &'static str, bytes: &[u8]);

    /// A byte of input.
    fn byte(&mut self) -> u8 {
        let mut byte = [0];
        self.input(&mut byte);
        byte[0]
    }

    /// A number of input.
    fn i32(&mut self) -> i32 {
        let mut bytes = [0; 4];
        self.input(&mut bytes);
        i32::from_le_bytes(bytes)
    }

    /// A number from `low` to `high`.
    fn within(&mut self, low: u8, high: u8) -> u8 {
        low + (u32::from(self.byte()) * (u32::from(high - low) + 1) / 256) as u8
    }

    /// Activations.
    fn i16s<const N: usize>(&mut self) -> [i16; N] {
        let mut bytes = [[0; 2]; N];
        self.input(bytes.as_flattened_mut());
        bytes.map(i16::from_le_bytes)
    }

    /// Weights, keys, values.
    fn i8s<const N: usize>(&mut self) -> [i8; N] {
        let mut bytes = [0; N];
        self.input(&mut bytes);
        bytes.map(|b| b as i8)
    }

    /// An angle, a speed, a length: within +-64 in steps of 2^-25.
    fn float(&mut self) -> f32 {
        self.i32() as f32 / (1 << 25) as f32
    }

    /// Results that are words.
    fn words<const N: usize>(&mut self, case: &'static str, words: [u32; N]) {
        self.result(case, words.map(u32::to_le_bytes).as_flattened());
    }
}

/// Something at an address that is `PAD` more than a multiple of four.
#[repr(C, align(4))]
struct Misaligned<const PAD: usize, T> {
    pad: [u8; PAD],
    value: T,
}

/// All cases once.
pub fn round(side: &mut impl Side) {
    // The layers of the network, and widths that the kernels treat apart: 1, 2, 3 and 4 groups of inputs a turn, rows left over.
    dense::<48, 64, 0>(side, "dense 48 x 64");
    dense::<80, 64, 0>(side, "dense 80 x 64");
    dense::<80, 16, 1>(side, "dense 80 x 16, at an odd address");
    dense::<28, 64, 0>(side, "dense 28 x 64");
    dense::<36, 64, 0>(side, "dense 36 x 64");
    dense::<64, 16, 0>(side, "dense 64 x 16");
    dense::<64, 32, 1>(side, "dense 64 x 32, at an odd address");
    dense::<64, 64, 0>(side, "dense 64 x 64");
    dense::<32, 64, 2>(side, "dense 32 x 64, at an even address");
    dense::<64, 2, 3>(side, "dense 64 x 2, at an odd address");
    dense::<4, 5, 0>(side, "dense 4 x 5");
    dense::<12, 7, 1>(side, "dense 12 x 7, at an odd address");
    dense::<20, 9, 3>(side, "dense 20 x 9, at an odd address");
    dot::<16>(side, "dot product of 16");
    dot::<32>(side, "dot product of 32");
    add_weighted::<4>(side, "weighted sum of 4");
    add_weighted::<32>(side, "weighted sum of 32");
    activations(side);
    softmax(side);
    kinematics(side);
    policy(side);
}

fn dense<const IN: usize, const OUT: usize, const PAD: usize>(side: &mut impl Side, case: &'static str) {
    let mut weights = Misaligned { pad: [0; PAD], value: [[0; IN]; OUT] };
    side.input(&mut weights.pad);
    side.input(weights.value.as_flattened_mut());
    let (mut multipliers, mut bias) = ([[0; 4]; OUT], [[0; 4]; OUT]);
    side.input(multipliers.as_flattened_mut());
    side.input(bias.as_flattened_mut());
    // Shifts of trained layers are 35 to 48.
    let shift = if side.byte() & 3 == 0 { side.byte() } else { side.within(33, 62) };
    let bias = (side.byte() & 1 == 0).then_some(&bias);
    let mut input = side.i16s::<IN>();
    // Now and then only the first inputs count.
    let columns = if side.byte() & 3 == 0 { IN.min(1 + side.byte() as usize) } else { IN };
    input.iter_mut().skip(columns).for_each(|x| *x = 0);
    let layer = Dense { weights: &weights.value, multipliers: &multipliers, bias, shift, columns };
    let mut out = [0; OUT];
    layer.forward(&input, &mut out);
    side.words(case, out.map(|v| v as u32));
    let mut portable = [0; OUT];
    layer.forward_portable(&input, &mut portable);
    side.result("the portable way", &[u8::from(portable == out)]);
}

fn dot<const N: usize>(side: &mut impl Side, case: &'static str) {
    let (query, key) = (side.i16s::<N>(), side.i8s());
    side.words(case, [Query::new(&query).dot(&key) as u32]);
}

fn add_weighted<const N: usize>(side: &mut impl Side, case: &'static str) {
    let mut sums = [0; N];
    for sum in &mut sums {
        // The caller sees to it that nothing overflows.
        *sum = side.i32() / 4;
    }
    let (weights, a, b) = (side.i16s(), side.i8s(), side.i8s());
    nn::add_weighted(&mut sums, weights, [&a, &b]);
    side.words(case, sums.map(|v| v as u32));
}

fn activations(side: &mut impl Side) {
    let (x, multiplier, shift) = (side.i32(), side.i32(), side.byte());
    side.words("requantise", [nn::requantise(x, multiplier, shift) as u32]);
    // Most arguments beyond 8 are saturated.
    side.words("tanh", [nn::tanh(x) as u32, nn::tanh(x >> 12) as u32]);
    side.words("exp2", [nn::exp2_neg(x as u32 >> 11), nn::exp2_neg(x as u32)]);
    let (value, mean, gain) = (f32::from_bits(x as u32), side.float(), f32::from_bits(multiplier as u32));
    side.words("quantise", [nn::quantise(value, mean, gain) as u32, nn::quantise(mean, 0.5, 6553.4) as u32]);
    let (sin, cos) = sin_cos(side.float());
    side.words("sine and cosine", [sin.to_bits(), cos.to_bits()]);
}

fn mask(side: &mut impl Side) -> u64 {
    (side.i32() as u32 as u64) << 32 | side.i32() as u32 as u64
}

fn softmax(side: &mut impl Side) {
    let mut logits = [0; 64];
    for logit in &mut logits {
        *logit = side.i32() >> 4;
    }
    let (mask, multiplier, shift) = (mask(side), side.i32() & i32::MAX, side.within(25, 45));
    let weights = nn::softmax(&logits, mask, multiplier, shift);
    side.result("softmax", weights.map(u16::to_le_bytes).as_flattened());
}

fn kinematics(side: &mut impl Side) {
    let mut chain = Chain::new(Geometry { links_per_module: side.within(2, 4), link_length: side.float().abs() });
    for module in 0..MAX_MODULES {
        let angles = [(); 4].map(|()| side.float() / 16.0);
        chain.hear(module, &angles);
    }
    let head = chain.head_seen_from(side.within(0, 63).into());
    side.words("kinematics", core::array::from_fn::<_, 3, _>(|i| head.position[i].to_bits()));
    side.words("kinematics", core::array::from_fn::<_, 9, _>(|i| head.rotation[i].to_bits()));
    let sensors = Sensors {
        joint_angles: [(); 4].map(|()| side.float()),
        joint_speeds: [(); 4].map(|()| side.float()),
        up: [(); 3].map(|()| side.float() / 64.0),
        angular_rate: [(); 3].map(|()| side.float()),
        torque: [(); 2].map(|()| side.float()),
        temperature: 20.0,
    };
    let points = [(); 3].map(|()| {
        let point = Vector3::new(side.float(), side.float(), side.float());
        (side.byte() & 7 != 0).then_some(point)
    });
    let seeker = if side.byte() & 1 == 0 { Seeker::Head } else { Seeker::Each };
    let motors = Motors {
        commanded: [(); 2].map(|()| side.float()),
        work: [(); 2].map(|()| side.byte() & 1 == 0),
        beside: [(); 2].map(|()| side.float()),
    };
    let observation = observe(&sensors, &motors, side.float(), &head, &Told { points, seeker });
    side.words("observation", observation.map(f32::to_bits));
}

/// An image of random numbers, four observations, and four actions on what others say.
fn policy(side: &mut impl Side) {
    let mut image = [0; IMAGE_SIZE];
    let meta = random_meta(&mut image);
    let shape = if side.byte() & 1 == 0 { Shape::FULL } else { Shape::BASE };
    let mut writer = ImageWriter::new(&meta, shape, &mut image);
    for field in 0..OBS {
        writer.input(field, side.float(), side.float().abs() * 200.0);
    }
    writer.softmax(side.i32() & i32::MAX, side.within(28, 36));
    for bucket in 0..DISTANCE_BUCKETS {
        writer.distance(bucket, side.i32() >> 8);
    }
    for layer in Layer::ALL {
        // Such that most results are neither nothing nor saturated.
        let scale = match layer {
            Layer::Encoder | Layer::Hidden | Layer::Context => 34,
            Layer::Query | Layer::Output => 38,
            Layer::Key | Layer::Value => 46,
        };
        writer.shift(layer, side.within(scale - 3, scale + 4));
        for output in 0..layer.outputs() {
            let (multiplier, bias) = (side.i32(), side.i32() >> side.within(8, 24));
            let weights = side.i8s::<FEATURES>();
            writer.row(layer, output, multiplier, bias, weights.get(..layer.inputs()).unwrap_or_default());
        }
    }
    let valid = writer.finish().is_ok();
    let Ok(policy) = Policy::parse(&image) else {
        return side.result("a policy image that is refused", &[u8::from(valid)]);
    };
    let mut latents = [Latent::ZERO; MAX_MODULES];
    let mut memory = Memory::EMPTY;
    for _ in 0..4 {
        let observation = [(); OBS].map(|()| side.float());
        let own = policy.encode(&mut memory, &observation);
        side.result("encode", &own.latent.key.map(|v| v as u8));
        side.result("encode", &own.latent.value.map(|v| v as u8));
        for _ in 0..16 {
            let module = usize::from(side.within(0, 63));
            latents[module % MAX_MODULES] = Latent { key: side.i8s(), value: side.i8s() };
        }
        let mut attention = [0; MAX_MODULES];
        let (heard, index) = (mask(side), side.within(0, 63));
        let action = policy.act(&own, &latents, heard, Some(&mut attention), index.into());
        side.result("attention", attention.map(u16::to_le_bytes).as_flattened());
        side.words("action", action.map(f32::to_bits));
    }
}

/// What the image of any robot could say about itself.
fn random_meta(image: &mut [u8; IMAGE_SIZE]) -> Meta {
    random_image(0, image);
    match Policy::parse(&image[..]) {
        Ok(policy) => policy.meta(),
        Err(_) => unreachable!("a random image is valid"),
    }
}
