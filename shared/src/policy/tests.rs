use super::random::RANDOM_LIMITS;
use super::*;
use crate::robot::MAX_MODULES;
use proptest::prelude::*;
use std::boxed::Box;
use std::string::{String, ToString};
use std::vec::Vec;

fn random(seed: u32) -> Box<[u8; IMAGE_SIZE]> {
    let mut image = Box::new([0; IMAGE_SIZE]);
    random_image(seed, &mut image);
    image
}

/// Observations of eight modules, from integers alone.
fn observations(seed: u32) -> [Observation; 8] {
    let mut state = seed.wrapping_mul(2_654_435_761) | 1;
    core::array::from_fn(|_| {
        let base: [f32; observation::BASE] = core::array::from_fn(|_| {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            (state >> 16) as f32 / 16384.0 - 2.0
        });
        core::array::from_fn(|i| base.get(i).copied().unwrap_or(-base[i % observation::BASE]))
    })
}

fn encode_all(policy: &Policy, observations: &[Observation; 8]) -> ([Encoded; 8], [Latent; MAX_MODULES]) {
    let encoded = observations.each_ref().map(|o| policy.encode(&mut Memory::default(), o));
    let mut latents = [Latent::ZERO; MAX_MODULES];
    latents.iter_mut().zip(&encoded).for_each(|(to, from)| *to = from.latent);
    (encoded, latents)
}

#[test]
fn a_written_image_reads_back() {
    let image = random(1);
    let policy = Policy::parse(&image[..]).unwrap();
    assert_eq!(policy.task(), Task::GoalReaching);
    assert_eq!(policy.geometry(), Geometry::default());
    assert_eq!(policy.limits(), RANDOM_LIMITS);
    assert_eq!((policy.control_period_us(), policy.relax_seconds()), (50_000, 0.25));
    assert_eq!(u32::from(policy.tag()), policy.crc() & 0xffff);
    assert_ne!(policy.tag(), Policy::parse(&random(2)[..]).unwrap().tag());

    let meta = Meta {
        task: Task::WallClimbing,
        goal_known_to: GoalKnownTo::Head,
        attention: false,
        trained_with_faults: true,
        geometry: Geometry { links_per_module: 3, link_length: 0.25 },
        limits: Limits { torque: 1.0, torque_slew: 2.0, joint_angle: 3.0, joint_speed: 4.0, temperature: 5.0 },
        control_period_us: 12_345,
        relax_seconds: 0.5,
        task_digest: 0x89ab_cdef,
    };
    let mut image = Box::new([0; IMAGE_SIZE]);
    let mut writer = ImageWriter::new(&meta, Shape::FULL, &mut image);
    writer.input(3, 1.5, 2.5);
    writer.shift(Layer::Output, 9);
    writer.row(Layer::Output, 1, -7, 77, &[-5; HIDDEN]);
    writer.row(Layer::Value, 31, 3, 99, &[6; EMBED]);
    writer.distance(12, -8);
    writer.finish().unwrap();
    let policy = Policy::parse(&image[..]).unwrap();
    assert_eq!((policy.meta(), policy.shape()), (meta, Shape::FULL));
    assert_eq!(policy.distance.unwrap()[11..], [[0; 4], (-8i32).to_le_bytes()]);
    assert!(policy.distance_bias());
    assert_eq!((f32::from_le_bytes(policy.mean[3]), f32::from_le_bytes(policy.gain[3])), (1.5, 2.5));
    assert_eq!((policy.output.shift, policy.output.weights[1]), (9, [0xfb; HIDDEN]));
    assert_eq!(policy.output.multipliers[1], (-7i32).to_le_bytes());
    assert_eq!(policy.output.bias.unwrap()[1], 77i32.to_le_bytes());
    let sixes = core::array::from_fn(|i| if i < EMBED { 6 } else { 0 });
    assert_eq!((policy.value.weights[31], policy.value.weights[30]), (sixes, [0; FEATURES]));
    assert!(policy.value.bias.is_none());
}

#[test]
fn the_layout_is_the_documented_one() {
    assert_eq!(Layer::ALL.map(Layer::offset), [516, 4104, 5452, 6800, 9492, 15128, 17436]);
    assert_eq!((IMAGE_SIZE, MEAN_AT, SOFTMAX_AT, CRC_AT), (17588, 72, 456, 17584));
    assert_eq!(CRC_32.checksum(b"123456789"), 0xcbf4_3926);
    let document = include_str!("../../policy-format.md");
    for layer in Layer::ALL {
        let (outputs, inputs, multipliers) = (layer.outputs(), layer.inputs(), layer.offset() + 4);
        let after = multipliers + 4 * outputs;
        let (biases, weights) =
            if layer.has_bias() { (after.to_string(), after + 4 * outputs) } else { ("-".into(), after) };
        let name = std::format!("{layer:?}").to_lowercase();
        let row = std::format!(
            "| {} | {name} | {outputs} x {inputs} | {multipliers} | {biases} | {weights} |",
            layer.offset()
        );
        assert!(document.contains(&row), "{row}");
    }
    for (at, field) in [
        (TASK_AT, "u8 | task"),
        (GOAL_KNOWN_TO_AT, "u8 | goal known to"),
        (LENGTH_AT, "u32 | length"),
        (DIMENSIONS_AT, "u16[6] | dimensions"),
        (ATTENTION_AT, "u8 | attention"),
        (FAULTS_AT, "u8 | trained with faults"),
        (LINKS_AT, "u8 | links per module"),
        (LINK_LENGTH_AT, "f32 | link length"),
        (LIMITS_AT, "f32 | torque limit"),
        (PERIOD_AT, "u32 | control period"),
        (RELAX_AT, "f32 | relaxation time"),
        (DIGEST_AT, "u32 | task digest"),
        (MEMORY_AT, "u8 | memory"),
        (RESERVED_2_AT, "u8[3] | reserved"),
        (MEAN_AT, "f32[48] | mean"),
        (GAIN_AT, "f32[48] | gain"),
        (SOFTMAX_AT, "i32 | softmax multiplier"),
        (DISTANCE_AT, "i32[13] | distance bias"),
        (CRC_AT, "u32 | checksum"),
    ] {
        assert!(document.contains(&std::format!("| {at} | {field} |")), "{field}");
    }
}

#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn every_damage_is_refused() {
    let mut image = random(3);
    for byte in 0..IMAGE_SIZE {
        // All bits of header and checksum; of the bulk between, one bit a byte.
        let all = !(LAYERS_AT..CRC_AT).contains(&byte);
        for bit in (0..8).filter(|bit| all || byte % 8 == *bit) {
            image[byte] ^= 1 << bit;
            assert!(Policy::parse(&image[..]).is_err(), "byte {byte} bit {bit}");
            image[byte] ^= 1 << bit;
        }
    }
    for length in 0..IMAGE_SIZE {
        assert_eq!(Policy::parse(&image[..length]).unwrap_err(), PolicyError::TooShort { length });
    }
    assert!(Policy::parse(&image[..]).is_ok());
}

#[test]
fn each_reason_is_one_clear_sentence() {
    let said = |at: usize, bytes: &[u8]| -> String {
        let mut image = random(4);
        image[at..at + bytes.len()].copy_from_slice(bytes);
        seal(&mut image);
        Policy::parse(&image[..]).unwrap_err().to_string()
    };
    assert_eq!(said(0, b"ELF"), "this is not a policy image: it does not begin with COMPOSER");
    assert_eq!(
        said(VERSION_AT, &[3]),
        "the policy image has layout version 3, this build reads version 4: export the policy again"
    );
    assert!(said(DIMENSIONS_AT + 2, &[128]).contains("dimensions [128, 16, 32, 64, 2], this build runs [64, 16"));
    assert_eq!(
        said(DIMENSIONS_AT, &[41]),
        "the policy image holds a network of 41 inputs, this build knows the first 40 fields of the observation or all 48"
    );
    assert_eq!(
        said(MEMORY_AT, &[32]),
        "the policy image holds a network with a memory of 32 channels, there is room for 16 or none"
    );
    assert_eq!(said(LENGTH_AT, &[0, 0]), "the policy image says it is 0 bytes long, layout version 4 is 17588");
    assert_eq!(said(TASK_AT, &[5]), "the policy image is for task 5, this build knows tasks 0 to 4");
    assert!(said(GOAL_KNOWN_TO_AT, &[2]).contains("2 in field `goal known to`"));
    assert!(said(ATTENTION_AT, &[2]).contains("`attention`"));
    assert!(said(FAULTS_AT, &[2]).contains("`trained with faults`"));
    assert!(said(RESERVED_AT, &[1]).contains("`reserved`"));
    assert!(said(RESERVED_2_AT + 2, &[1]).contains("`reserved`"));
    let (nan, infinite) = (f32::NAN.to_le_bytes(), f32::INFINITY.to_le_bytes());
    assert!(said(LINKS_AT, &[5]).contains("links per module that is not a number from 2 to 4"));
    for (at, field) in [
        (LINK_LENGTH_AT, "link length"),
        (LIMITS_AT, "torque limit"),
        (LIMITS_AT + 4, "torque slew limit"),
        (LIMITS_AT + 8, "joint angle limit"),
        (LIMITS_AT + 12, "joint speed limit"),
        (LIMITS_AT + 16, "temperature limit"),
        (RELAX_AT, "relaxation time"),
        (MEAN_AT + 4 * 47, "input mean"),
        (GAIN_AT + 4 * 47, "input gain"),
    ] {
        assert!(said(at, &nan).contains(field) && said(at, &infinite).contains(field), "{field}");
    }
    assert!(said(PERIOD_AT, &[0; 4]).contains("control period that is not a number from 1000 to"));
    assert!(said(SOFTMAX_AT + 3, &[0x80]).contains("softmax multiplier"));
    assert!(said(SOFTMAX_AT + 4, &[0]).contains("shift that is not a number from 1 to 62"));
    assert!(said(DISTANCE_AT + 4 * 12 + 3, &[0x40]).contains("distance bias that is not a number from -536870912"));
    assert!(said(Layer::Context.offset(), &[63]).contains("shift"));

    let mut image = random(4);
    image[5000] ^= 4;
    assert!(Policy::parse(&image[..]).unwrap_err().to_string().starts_with("the policy image is damaged: its CRC-32"));
    let cut = Policy::parse(&image[..9000]).unwrap_err().to_string();
    assert_eq!(cut, "the policy image is cut short: it has 9000 bytes where 17588 are needed");
    let long: Vec<u8> = image.iter().copied().chain([0]).collect();
    assert!(Policy::parse(&long).unwrap_err().to_string().contains("too long"));
}

#[test]
fn the_writer_refuses_what_the_reader_would() {
    let mut image = Box::new([0; IMAGE_SIZE]);
    let good = Policy::parse(&random(1)[..]).unwrap().meta();
    let relax = Meta { relax_seconds: -1.0, ..good };
    assert!(ImageWriter::new(&relax, Shape::BASE, &mut image).finish().is_err());
    let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
    writer.input(0, f32::NAN, 1.0);
    writer.input(1, 0.0, 1.0);
    assert!(writer.finish().is_err());
    assert!(Policy::parse(&image[..]).is_err());
    let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
    writer.softmax(-1, 5);
    assert!(writer.finish().is_err());
    let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
    writer.shift(Layer::Key, 0);
    assert!(writer.finish().is_err());
    let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
    writer.distance(0, i32::MIN);
    assert!(writer.finish().is_err());
    assert!(ImageWriter::new(&good, Shape { inputs: 44, ..Shape::BASE }, &mut image).finish().is_err());
    assert!(ImageWriter::new(&good, Shape { memory: 8, ..Shape::BASE }, &mut image).finish().is_err());
    // What does not exist is ignored.
    let mut writer = ImageWriter::new(&good, Shape::BASE, &mut image);
    writer.input(OBS, f32::NAN, 0.0);
    writer.distance(DISTANCE_BUCKETS, i32::MIN);
    writer.row(Layer::Output, OUT, 1, 1, &[1; 200]);
    writer.finish().unwrap();
    assert!(Policy::parse(&image[..]).is_ok());
}

#[test]
fn every_point_that_a_module_observes_is_told() {
    for task in Task::ALL {
        for modules in [1, 2, 8, MAX_MODULES as u8] {
            assert!(usize::from(task.points(modules)) <= crate::wire::GOAL_POINTS);
            let mut seen = 0u64;
            for module in 0..modules {
                let observed = task.observed(module, modules);
                assert!(observed[0].is_some());
                for point in observed.into_iter().flatten() {
                    assert!(point < task.points(modules), "{task} {module} of {modules}");
                    seen |= 1 << point;
                }
            }
            assert_eq!(seen.count_ones(), u32::from(task.points(modules)), "{task}");
        }
    }
}

#[test]
fn names_round_trip() {
    for task in Task::ALL {
        assert_eq!(Task::from_name(task.name()), Some(task));
    }
    assert_eq!((Task::from_name("dancing"), GoalKnownTo::from_name("head")), (None, Some(GoalKnownTo::Head)));
    assert_eq!((GoalKnownTo::from_name("tail"), GoalKnownTo::All.to_string().as_str()), (None, "all"));
}

/// Pins the bits: other targets run the same test, and a kernel that is made faster must still pass it.
#[test]
fn the_bits_are_pinned() {
    let image = random(7);
    let policy = Policy::parse(&image[..]).unwrap();
    let (encoded, latents) = encode_all(&policy, &observations(7));
    let mut digest = CRC_32.digest();
    for (i, own) in encoded.iter().enumerate() {
        own.latent.key.iter().chain(&own.latent.value).for_each(|x| digest.update(&x.to_le_bytes()));
        let mut attention = [0; MAX_MODULES];
        let action = policy.act(own, &latents, 0xdb, Some(&mut attention), i);
        attention.iter().for_each(|x| digest.update(&x.to_le_bytes()));
        action.iter().for_each(|x| digest.update(&x.to_bits().to_le_bytes()));
    }
    assert_eq!((policy.crc(), digest.finalize()), (2_477_611_875, 3_900_035_348));
}

/// The same for memory, bias and the whole observation.
#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn the_bits_of_a_memory_are_pinned() {
    let mut image = Box::new([0; IMAGE_SIZE]);
    random_image_of(Shape::FULL, 7, &mut image);
    let policy = Policy::parse(&image[..]).unwrap();
    let (mut memories, mut digest) = ([Memory::EMPTY; 8], CRC_32.digest());
    for step in 0..20 {
        let mut latents = [Latent::ZERO; MAX_MODULES];
        let observations = observations(7 + step);
        let encoded: [Encoded; 8] = core::array::from_fn(|i| policy.encode(&mut memories[i], &observations[i]));
        latents.iter_mut().zip(&encoded).for_each(|(to, from)| *to = from.latent);
        for (i, own) in encoded.iter().enumerate() {
            let action = policy.act(own, &latents, 0xff, None, i);
            action.iter().for_each(|x| digest.update(&x.to_bits().to_le_bytes()));
        }
    }
    assert_eq!((policy.crc(), digest.finalize()), (1_128_826_676, 3_867_806_610));
}

#[test]
fn buckets_of_distance_are_the_documented_ones() {
    let away = [0, 1, 2, 3, 4, 5, 8, 9, 16, 17, 63];
    assert_eq!(away.map(|j| distance_bucket(0, j)), [6, 7, 8, 9, 9, 10, 10, 11, 11, 12, 12]);
    assert_eq!(away.map(|j| distance_bucket(j, 0)), [6, 5, 4, 3, 3, 2, 2, 1, 1, 0, 0]);
    assert_eq!((distance_bucket(40, 37), distance_bucket(20, 21)), (3, 7));
}

/// A bias of the size of the logits' range decides alone whom a module attends to.
#[test]
fn a_bias_by_distance_turns_the_attention() {
    let mut image = random(7);
    let bias = DISTANCE_AT + 4 * distance_bucket(5, 3);
    image[bias..bias + 4].copy_from_slice(&DISTANCE_BIAS_MAX.to_le_bytes());
    seal(&mut image);
    let policy = Policy::parse(&image[..]).unwrap();
    assert!(policy.distance_bias() && !Policy::parse(&random(7)[..]).unwrap().distance_bias());
    let (encoded, latents) = encode_all(&policy, &observations(3));
    let mut attention = [0; MAX_MODULES];
    policy.act(&encoded[5], &latents, 0xff, Some(&mut attention), 5);
    assert!(attention[3] > 32000, "{attention:?}");
    // Modules 4 and 3 lie towards the head of module 6 at the same distance as bucket 4 and 3.
    policy.act(&encoded[4], &latents, 0b1000_0000, Some(&mut attention), 4);
    assert!(attention[4] > 0 && attention[7] > 0, "nobody is two ahead: {attention:?}");
}

#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn a_memory_leaks_without_stalling_and_starts_empty() {
    for now in [nn::ONE, -nn::ONE, 1, -1, 12_345] {
        let mut memory = Memory::default();
        let embedding = [now; EMBED];
        let mut exact = [0.0f64; MEMORY];
        for step in 0..400 {
            memory.update(&embedding);
            for (channel, (mean, got)) in exact.iter_mut().zip(memory.activations()).enumerate() {
                *mean += (f64::from(now) - *mean) / f64::from(1 << leak(channel));
                assert!((*mean - f64::from(got)).abs() < 0.51, "{now}, step {step}, channel {channel}: {mean} {got}");
            }
        }
        assert_eq!(memory.activations(), [now; MEMORY]);
    }
    assert_eq!(Memory::default().activations(), [0; MEMORY]);
}

#[test]
fn a_memory_is_the_modules_own_and_only_where_the_network_has_one() {
    let (base, mut full) = (random(5), Box::new([0; IMAGE_SIZE]));
    random_image_of(Shape::FULL, 5, &mut full);
    let (base, full) = (Policy::parse(&base[..]).unwrap(), Policy::parse(&full[..]).unwrap());
    let [first, second, ..] = observations(5);
    let mut memory = Memory::default();
    let fresh = base.encode(&mut memory, &first);
    assert_eq!((memory, base.encode(&mut memory, &first)), (Memory::EMPTY, fresh));
    // Fields behind those it takes do not count.
    let mut other = first;
    other[observation::BASE..].fill(9.0);
    assert_eq!(base.encode(&mut memory, &other), fresh);
    let fresh = full.encode(&mut Memory::default(), &first);
    assert_ne!(full.encode(&mut Memory::default(), &other), fresh);
    full.encode(&mut memory, &second);
    assert_ne!(full.encode(&mut memory, &first), fresh, "what was seen before counts");
}

#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn random_policies_are_alive() {
    let mut largest = 0.0f32;
    for seed in 0..20 {
        let image = random(seed);
        let policy = Policy::parse(&image[..]).unwrap();
        let (encoded, latents) = encode_all(&policy, &observations(seed));
        let actions = core::array::from_fn::<_, 8, _>(|i| policy.act(&encoded[i], &latents, 0xff, None, i));
        assert!(actions.iter().any(|a| *a != actions[0]));
        let saturated = encoded.iter().flat_map(|e| e.features).filter(|e| e.abs() == nn::ONE).count();
        assert!(saturated < 50, "{saturated} of 512");
        let mut attention = [0; MAX_MODULES];
        policy.act(&encoded[0], &latents, 0xff, Some(&mut attention), 0);
        largest = actions.as_flattened().iter().fold(largest, |m, a| m.max(a.abs()));
        assert!(attention[..8].iter().max() > attention[..8].iter().min());
    }
    assert!(largest > 0.3, "{largest}");
}

#[test]
fn nonsense_in_an_observation_becomes_something_finite() {
    let image = random(8);
    let policy = Policy::parse(&image[..]).unwrap();
    let nan = policy.encode(&mut Memory::default(), &[f32::NAN; OBS]);
    assert_eq!(nan, policy.encode(&mut Memory::default(), &[0.0; OBS]), "the means are 0");
    let encode = |x| policy.encode(&mut Memory::default(), &[x; OBS]);
    assert_eq!(encode(f32::INFINITY), encode(5.0));
    assert_eq!(encode(f32::NEG_INFINITY), encode(-1e9));
    let action = policy.act(&nan, &[Latent::ZERO; MAX_MODULES], u64::MAX, None, usize::MAX);
    assert!(action.iter().all(|a| a.is_finite()));
}

#[test]
fn without_attention_the_others_do_not_matter() {
    let mut image = random(9);
    image[ATTENTION_AT] = 0;
    seal(&mut image);
    let policy = Policy::parse(&image[..]).unwrap();
    let (encoded, latents) = encode_all(&policy, &observations(9));
    assert_eq!(encoded[0].latent, Latent::ZERO);
    let mut attention = [1; MAX_MODULES];
    let action = policy.act(&encoded[2], &latents, 0xff, Some(&mut attention), 2);
    assert_eq!(action, policy.act(&encoded[2], &[Latent { key: [9; 16], value: [9; 32] }; 64], 0, None, 2));
    assert_eq!(attention, core::array::from_fn(|j| if j == 2 { 32767 } else { 0 }));
}

fn latents() -> impl Strategy<Value = [Latent; MAX_MODULES]> {
    any::<u64>().prop_map(|seed| {
        let mut state = seed;
        let mut next = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as i8
        };
        core::array::from_fn(|_| Latent {
            key: core::array::from_fn(|_| next()),
            value: core::array::from_fn(|_| next()),
        })
    })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn parsing_never_panics(bytes in proptest::collection::vec(any::<u8>(), 0..400), keep in 0usize..200) {
        prop_assert!(Policy::parse(&bytes).is_err());
        let mut image = random(1);
        let end = (keep + bytes.len()).min(IMAGE_SIZE);
        image[keep..end].copy_from_slice(&bytes[..end - keep]);
        let _ = Policy::parse(&image[..]);
    }

    /// Whatever numbers an image holds: if it is accepted, it runs (overflow traps in debug builds).
    #[test]
    fn an_accepted_image_never_panics(seed in any::<u64>(), others in latents(), heard in any::<u64>()) {
        let mut image = random(1);
        let mut state = seed | 1;
        for at in SOFTMAX_AT..CRC_AT {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            image[at] = if seed % 3 == 0 { [0x80, 0x7f][(state & 1) as usize] } else { state as u8 };
        }
        image[SOFTMAX_AT + 3] &= 0x7f;
        for bucket in 0..DISTANCE_BUCKETS {
            image[DISTANCE_AT + 4 * bucket + 3] = [0x1f, 0xe0][bucket % 2];
        }
        image[MEMORY_AT] = [0, MEMORY as u8][seed as usize % 2];
        for at in Layer::ALL.map(Layer::offset).into_iter().chain([SOFTMAX_AT + 4]) {
            state = state.rotate_left(17).wrapping_mul(5);
            let shift = 1 + (state % 62) as u32;
            image[at..at + 4].copy_from_slice(&shift.to_le_bytes());
        }
        seal(&mut image);
        let policy = Policy::parse(&image[..]).unwrap();
        let mut memory = Memory::default();
        for observation in observations(seed as u32) {
            let own = policy.encode(&mut memory, &observation);
            let action = policy.act(&own, &others, heard, None, seed as usize % 70);
            prop_assert!(action.iter().all(|a| a.abs() <= 1.0));
        }
    }

    #[test]
    fn neighbours_have_no_order_and_the_masked_no_say(
        seed in 0u32..50, mut others in latents(), heard in any::<u64>(), own_index in 0usize..64, turn in 1u32..64,
    ) {
        let image = random(seed);
        let policy = Policy::parse(&image[..]).unwrap();
        let own = policy.encode(&mut Memory::default(), &observations(seed)[0]);
        let mut attention = [7; MAX_MODULES];
        let action = policy.act(&own, &others, heard, Some(&mut attention), own_index);
        prop_assert_eq!(policy.act(&own, &others, heard, None, own_index), action);

        let mask = heard | 1 << own_index;
        let total: i32 = attention.iter().map(|w| i32::from(*w)).sum();
        prop_assert!((total - 32767).abs() <= 32, "{}", total);
        prop_assert!((0..64).all(|j| mask >> j & 1 == 1 || attention[j] == 0));

        // Everybody moves to another slot.
        let mut turned = others;
        turned.rotate_right(turn as usize);
        let moved = (own_index + turn as usize) % 64;
        prop_assert_eq!(policy.act(&own, &turned, heard.rotate_left(turn), None, moved), action);

        // Who is not heard, and what lies in the own slot, does not count.
        for (j, latent) in others.iter_mut().enumerate() {
            if j == own_index || mask >> j & 1 == 0 {
                *latent = Latent { key: [127; KEY], value: [-128; VALUE] };
            }
        }
        prop_assert_eq!(policy.act(&own, &others, heard, None, own_index), action);
        prop_assert_eq!(policy.act(&own, &others, mask, None, own_index), action);
        let alone = policy.act(&own, &others, 0, None, own_index);
        prop_assert_eq!(policy.act(&own, &others, 1 << own_index, None, own_index), alone);
    }
}
