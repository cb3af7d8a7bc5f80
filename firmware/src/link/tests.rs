use std::string::{String, ToString};
use std::vec::Vec;
use std::{format, vec};

use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_shared::wire::{Function, Message, Sync};
use proptest::prelude::*;

use super::module::{Module, hello};
use super::*;
use crate::controller::{BusKind, Controller};
use crate::update::NoPolicies;
use composer_shared::wire::Heartbeat;

fn bytes_of(message: &impl Serialize) -> Vec<u8> {
    encode(message, &mut [0; MESSAGE_MAX]).to_vec()
}

/// The messages in these bytes.
fn received(receiver: &mut Receiver, bytes: &[u8]) -> Vec<Result<Vec<u8>, LinkError>> {
    bytes.iter().filter_map(|byte| receiver.push(*byte).map(|message| message.map(<[u8]>::to_vec))).collect()
}

fn image() -> [u8; IMAGE_SIZE] {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    image
}

/// What a module answers, as text: messages borrow.
fn answers(module: &mut Module<'_, NoPolicies>, request: Result<ToModule, LinkError>) -> Vec<String> {
    let mut said = vec![];
    module.serve(request, &mut |message| said.push(format!("{message:?}")));
    said
}

#[test]
fn every_message_fits_and_arrives() {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let config = Config::new(63, 64, BusKind::Classic, &policy);
    let sample = Sample(Sensors { temperature: -0.0, up: [f32::MAX, f32::MIN, 1e-40], ..Sensors::ZERO });
    let frame = Carried(Frame { brs: false, ..Frame::new(0x7ff, true, &[0xff; 64]).unwrap() });
    let requests = [
        ToModule::Start { config, boot: Boot::default(), now: u64::MAX },
        ToModule::Poll { now: u64::MAX, bus: BusStatus::BusOff, room: 255, sensors: Some(sample), frame: Some(frame) },
        ToModule::Frames { room: 0 },
        ToModule::Status,
    ];
    for request in requests {
        let bytes = bytes_of(&request);
        assert!(bytes.len() > 1 && bytes.len() <= MESSAGE_MAX && !bytes[..bytes.len() - 1].contains(&0));
        let messages = received(&mut Receiver::default(), &bytes);
        assert_eq!(decode::<ToModule>(messages[0].as_ref().unwrap()), Ok(request));
    }
    let most = Stats { cycles: u32::MAX, acted: u32::MAX, malformed: u32::MAX, ..Stats::default() };
    let full = Stats { deadline_misses: u32::MAX, latent_age_us: u32::MAX, latent_age_max_us: u32::MAX, ..most };
    let full = Stats { foreign: u32::MAX, stale: u32::MAX, takeovers: u32::MAX, without_sync: u32::MAX, ..full };
    let status = Status {
        mode: Mode::Alone as u8,
        cycle: u16::MAX,
        time_keeper: Some(63),
        alive: u64::MAX,
        heard: u64::MAX,
        faults: FaultSet::default(),
        stats: full,
        retained: Retained { resets: 255, commanded: true, ..Retained::default() },
        // Weights are Q15, never more than 32767; these are the longest varints.
        attention: Weights { all: [u16::MAX; ROOM], modules: ROOM as u8 },
    };
    assert_eq!(status.mode(), Some(Mode::Alone));
    let long = "x".repeat(TEXT_MAX);
    let replies = [
        FromModule::Hello { protocol: u16::MAX, firmware: 255, build: u64::MAX, policy: Some(u16::MAX) },
        FromModule::Refused(&long),
        FromModule::Frame(frame),
        FromModule::Answer {
            torque: Some([-1.5, f32::NAN]),
            motors_enabled: true,
            deadline: 1,
            acted: u32::MAX,
            node: 63,
        },
        FromModule::Sent,
        FromModule::Interrupted { off: true },
        FromModule::Status(status),
        FromModule::LastWords(&long),
    ];
    for reply in replies {
        let bytes = bytes_of(&reply);
        assert!(bytes.len() > 1 && bytes.len() <= MESSAGE_MAX, "{reply:?} has {} bytes", bytes.len());
        let messages = received(&mut Receiver::default(), &bytes);
        // By text, because a NaN does not equal itself.
        let decoded = decode::<FromModule<'_>>(messages[0].as_ref().unwrap()).unwrap();
        assert_eq!(format!("{decoded:?}"), format!("{reply:?}"));
    }
}

#[test]
fn floats_keep_their_bits() {
    let bits = [0x8000_0000, 0x7fc0_1234, 1, 0xff80_0000];
    let sample = Sample(Sensors { joint_angles: bits.map(f32::from_bits), ..Sensors::ZERO });
    let messages = received(&mut Receiver::default(), &bytes_of(&sample));
    let Sample(arrived) = decode(messages[0].as_ref().unwrap()).unwrap();
    assert_eq!(arrived.joint_angles.map(f32::to_bits), bits);
}

#[test]
fn the_first_two_numbers_say_the_version() {
    let hello = FromModule::Hello { protocol: 700, firmware: 1, build: 2, policy: None };
    let message = received(&mut Receiver::default(), &bytes_of(&hello)).remove(0).unwrap();
    assert_eq!(hello_protocol(&message), Some(700));
    // Another version may go on differently.
    assert_eq!(hello_protocol(&message[..3]), Some(700));
    assert_eq!(hello_protocol(&[3, 1]), None);
    assert_eq!(hello_protocol(&[]), None);
}

#[test]
fn the_linker_script_reserves_the_flash_for_the_policy() {
    let script = include_str!("../../boards/qemu.x");
    assert!(script.contains(&format!("POLICY (rw) : ORIGIN = {POLICY_ADDRESS:#010x}")), "{script}");
}

#[test]
fn a_text_is_cut_at_a_whole_letter() {
    let text = Text::of("ä".repeat(TEXT_MAX));
    assert_eq!(text.as_str().len(), TEXT_MAX);
    let text = Text::of(format_args!("a{}", "ä".repeat(TEXT_MAX)));
    assert_eq!(text.as_str().len(), TEXT_MAX - 1);
    assert!(text.as_str().ends_with('ä'));
}

#[test]
fn too_long_and_damaged_messages_are_errors_and_the_next_one_counts() {
    let mut receiver = Receiver::default();
    let good = bytes_of(&ToModule::Status);
    let mut bytes = vec![1; MESSAGE_MAX + 50];
    bytes.push(0);
    // Empty ones mean nothing.
    bytes.extend([0, 0]);
    bytes.extend(&good);
    // Cut short by the end of the message.
    bytes.extend([9, 1, 0]);
    bytes.extend(&good);
    let messages = received(&mut receiver, &bytes);
    let decoded: Vec<_> = messages.into_iter().map(|m| m.and_then(|m| decode::<ToModule>(&m))).collect();
    let expected = [Err(LinkError::TooLong), Ok(ToModule::Status), Err(LinkError::Garbled), Ok(ToModule::Status)];
    assert_eq!(decoded, expected);
    // More behind a whole message is not it.
    assert_eq!(decode::<ToModule>(&[3, 0]), Err(LinkError::Garbled));
    assert_eq!(decode::<ToModule>(&[4]), Err(LinkError::Garbled));
    // Frames that cannot be: 12 bits of identifier, unknown flags, a length that no DLC says, too long for classic CAN.
    for frame in [(0x800u16, 0u8, &[0u8; 8][..]), (1, 4, &[]), (1, 1, &[0; 9]), (1, 0, &[0; 12]), (1, 1, &[0; 65])] {
        let mut buffer = [0; 128];
        let bytes = postcard::to_slice(&frame, &mut buffer).unwrap();
        assert_eq!(decode::<Carried>(bytes), Err(LinkError::Garbled), "{frame:?}");
    }
    // 65 weights.
    assert_eq!(decode::<Weights>(&[[65].as_slice(), &[0; 65]].concat()), Err(LinkError::Garbled));
}

#[test]
fn a_module_says_who_it_is_and_what_it_cannot_do() {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let FromModule::Hello { protocol, build, policy: tag, .. } = hello(Some(&policy)) else { panic!("no hello") };
    assert_eq!((protocol, build, tag), (PROTOCOL, BUILD, Some(policy.tag())));
    let mut module = Module::new(policy, NoPolicies);
    for request in [ToModule::Status, ToModule::Frames { room: 3 }] {
        assert_eq!(answers(&mut module, Ok(request)), ["Refused(\"the module has not been started\")"]);
    }
    let refused = answers(&mut module, Err(LinkError::TooLong));
    assert!(refused[0].starts_with("Refused(\"a message on the link has more than 320"), "{refused:?}");
    let impossible = Config { node: 8, ..Config::new(0, 8, BusKind::Fd, &policy) };
    let refused = answers(&mut module, Ok(ToModule::Start { config: impossible, boot: Boot::default(), now: 0 }));
    assert!(refused[0].contains("module 8 cannot be one of 8"), "{refused:?}");
    assert_eq!(answers(&mut module, Ok(ToModule::Status)).len(), 1);
}

#[test]
fn a_module_that_is_started_again_is_a_new_one() {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let start =
        || Ok(ToModule::Start { config: Config::new(0, 1, BusKind::Fd, &policy), boot: Boot::default(), now: 0 });
    let mut module = Module::new(policy, NoPolicies);
    let poll = |now| Ok(ToModule::Poll { now, bus: BusStatus::ErrorActive, room: 16, sensors: None, frame: None });
    assert!(answers(&mut module, start()).is_empty());
    answers(&mut module, poll(200_000));
    let first = answers(&mut module, Ok(ToModule::Status));
    assert!(first[0].contains("cycles: 1"), "{first:?}");
    assert!(answers(&mut module, start()).is_empty());
    assert!(answers(&mut module, Ok(ToModule::Status))[0].contains("cycles: 0"));
}

/// What happens to a module, in the words of [`ToModule`]; small numbers, so that it often fits together.
fn poll() -> impl Strategy<Value = ToModule> {
    let frame = (0u8..9, 0u8..4, 0u16..6, any::<bool>()).prop_map(|(kind, node, cycle, classic)| {
        let frame = match kind {
            0..=4 => Message::Sync(Sync::new(cycle, 4, 4)).emit(node, !classic),
            _ => Frame::new(Function::ALL[usize::from(kind) % 8].id(node), !classic, &[cycle as u8; 8]).unwrap(),
        };
        Carried(frame)
    });
    let sample = any::<u32>().prop_map(|bits| {
        let up = [0.0, 0.0, 1.0];
        Sample(Sensors { up, joint_angles: [f32::from_bits(bits); 4], temperature: 30.0, ..Sensors::ZERO })
    });
    (0u64..30_000, 0u8..3, prop::option::of(sample), prop::option::of(frame)).prop_map(|(now, room, sensors, frame)| {
        ToModule::Poll { now, bus: BusStatus::ErrorActive, room, sensors, frame }
    })
}

proptest! {
    /// Over the link a module does what its controller does when it is called: the same frames, the same torque to the bit.
    #[test]
    fn a_module_does_what_its_controller_does(polls in prop::collection::vec(poll(), 1..60)) {
        let image = image();
        let policy = Policy::parse(&image).unwrap();
        let config = Config::new(2, 4, BusKind::Fd, &policy);
        let mut direct = Controller::new(config, policy, Boot::default(), 0).unwrap();
        direct.set_remark(Heartbeat::LAB);
        let mut module = Module::new(policy, NoPolicies);
        let started = answers(&mut module, Ok(ToModule::Start { config, boot: Boot::default(), now: 0 }));
        prop_assert!(started.is_empty());
        let (mut clock, mut sensors, mut torque) = (0, Sensors::ZERO, [0u32; AXES]);
        for mut request in polls {
            let ToModule::Poll { now, bus, room, sensors: sample, frame } = &mut request else { unreachable!() };
            clock += *now;
            *now = clock;
            sensors = sample.map_or(sensors, |sample| sample.0);
            let outputs = direct.poll(clock, &sensors, frame.as_ref().map(|frame| &frame.0), *bus);
            let mut expected: Vec<_> = (0..*room).map_while(|_| direct.next_frame()).map(|f| format!("Frame({:?})", Carried(f))).collect();
            let bits = outputs.torque.map(f32::to_bits);
            let changed = core::mem::replace(&mut torque, bits) != bits;
            expected.push(format!("{:?}", FromModule::Answer {
                torque: changed.then_some(outputs.torque),
                motors_enabled: outputs.motors_enabled,
                deadline: outputs.deadline,
                acted: direct.stats().acted,
                node: direct.config().node,
            }));
            prop_assert_eq!(answers(&mut module, Ok(request)), expected);
        }
    }

    /// Whatever bytes come, a module neither panics nor falls silent: each message gets an answer, and the next one is understood.
    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn any_bytes_are_survived(noise in prop::collection::vec(prop_oneof![Just(0u8), any::<u8>()], 0..1500), damage in any::<(u8, u8)>()) {
        let image = image();
        let policy = Policy::parse(&image).unwrap();
        let config = Config::new(0, 8, BusKind::Fd, &policy);
        let mut module = Module::new(policy, NoPolicies);
        let mut receiver = Receiver::default();
        let mut bytes = bytes_of(&ToModule::Start { config, boot: Boot::default(), now: 0 });
        let poll = ToModule::Poll { now: 5, bus: BusStatus::ErrorActive, room: 9, sensors: Some(Sample(Sensors::ZERO)), frame: None };
        let mut damaged = bytes_of(&poll);
        let at = usize::from(damage.0) % damaged.len();
        damaged[at] = damage.1;
        bytes.extend(damaged);
        bytes.extend(noise);
        bytes.push(0);
        for byte in bytes {
            if let Some(message) = receiver.push(byte) {
                let request = message.and_then(decode::<ToModule>);
                let silent = matches!(request, Ok(ToModule::Start { .. }));
                prop_assert!(!answers(&mut module, request).is_empty() || silent);
            }
        }
        for byte in bytes_of(&ToModule::Start { config, boot: Boot::default(), now: 0 }).into_iter().chain(bytes_of(&ToModule::Status)) {
            if let Some(message) = receiver.push(byte) {
                let request = message.and_then(decode::<ToModule>);
                prop_assert!(request.is_ok());
                let said = answers(&mut module, request);
                prop_assert!(said.iter().all(|reply| reply.starts_with("Status")), "{:?}", said);
            }
        }
    }

    /// The host reads anything too.
    #[test]
    fn any_answer_decodes_to_something_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = decode::<FromModule<'_>>(&bytes).map(|reply| format!("{reply:?}").to_string());
        let _ = hello_protocol(&bytes);
    }
}
