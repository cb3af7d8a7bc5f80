//! The bytes themselves, the document against the code, and anything at all against the parser.

use std::format;
use std::string::{String, ToString};
use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::registers::Register;
use crate::robot::MAX_MODULES;
use crate::update::ChunkRepr;

const DOCUMENT: &str = include_str!("../../wire-format.md");

/// `ID#HEX` as candump writes a classic frame.
fn frame(text: &str, fd: bool) -> Frame {
    let (id, hex) = text.split_once('#').unwrap();
    let bytes: Vec<u8> = (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect();
    Frame::new(u16::from_str_radix(id, 16).unwrap(), fd, &bytes).unwrap()
}

fn latent() -> LatentMessage {
    let mut key = core::array::from_fn(|i| i as i8);
    (key[0], key[1], key[2]) = (127, -128, 1);
    LatentMessage { cycle: 0x34, health: Health(1), policy: 0x1234, key, value: core::array::from_fn(|i| -(i as i8)) }
}

fn chunk() -> ChunkRepr {
    ChunkRepr { session: 0xabcd, number: 3, data: core::array::from_fn(|i| i as u8) }
}

/// Every message, with the bytes that the document shows.
fn examples() -> Vec<(Message, u8, &'static str)> {
    let lsb = ANGLE_LSB;
    std::vec![
        (Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::new(1))), 3, "003#010001"),
        (Message::EmergencyStop(EmergencyStop::new(StopCommand::Release, 0, StopCount::new(2))), STATION, "07F#020002"),
        (Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::UNKNOWN)), 3, "003#010000"),
        (Message::Sync(Sync::new(0x1234, 7, 8)), 0, "080#34120708"),
        (Message::Goal(Goal::new(0x34, 2, Some([0.5, 1.5, -0.25]))), STATION, "17F#340580008001C0FF"),
        (
            Message::State(State::new(
                0x34,
                Health(1).with(Health::PITCH_DEAD),
                &[lsb, -lsb, -2048.0 * lsb, -16.0 * lsb]
            )),
            3,
            "183#340901F0FF0008FF"
        ),
        (Message::LatentFragment(latent().fragments()[0]), 3, "283#04340134127F8001"),
        (
            Message::ServiceRequest(ServiceRequest {
                destination: ALL_MODULES,
                operation: Operation::Arm as u8,
                sequence: 7,
                index: 0,
                value: 0,
            }),
            STATION,
            "37F#FF02070000000000",
        ),
        (
            Message::ServiceResponse(ServiceResponse {
                operation: Operation::Arm as u8,
                sequence: 7,
                code: ServiceCode::NotArmable as u8,
                index: 0,
                value: 0,
            }),
            3,
            "383#0207060000000000",
        ),
        (
            Message::ServiceRequest(ServiceRequest {
                destination: 3,
                operation: Operation::Read as u8,
                sequence: 8,
                index: Register::JointAngle.spec().first,
                value: 0,
            }),
            STATION,
            "37F#0305084400000000",
        ),
        (
            Message::ServiceResponse(ServiceResponse {
                operation: Operation::Read as u8,
                sequence: 8,
                code: ServiceCode::Ok as u8,
                index: Register::JointAngle.spec().first,
                value: 0.5f32.to_bits(),
            }),
            3,
            "383#050800440000003F",
        ),
        (
            Message::Telemetry(Telemetry {
                torque: [127, -127],
                temperature: 25,
                limited_by: LimitedBy::Nothing as u8,
                heard: 8,
                deadline_misses: 0,
                attends_to: 5,
                attention: 140,
            }),
            3,
            "403#7F8119000800058C"
        ),
        (
            Message::Heartbeat(Heartbeat {
                mode: Mode::Relaxed as u8 | Heartbeat::LAB,
                fault: Fault::SyncLost as u8,
                health: Health::SENSORS_PLAUSIBLE.with(Health::PITCH_DEAD),
                time_keeper: 0,
                protocol: PROTOCOL_VERSION,
                firmware: 1,
                policy: 0x1234,
            }),
            3,
            "483#1222090003013412"
        ),
        (Message::UpdatePiece(Piece(chunk().pieces()[0])), STATION, "5FF#03CDAB0300000102"),
    ]
}

#[test]
fn every_message_has_exactly_the_documented_bytes() {
    for (message, module, text) in examples() {
        for fd in [false, true] {
            let emitted = message.emit(module, fd);
            assert_eq!(emitted, frame(text, fd));
            assert_eq!(Message::parse(&emitted), Ok(message));
        }
        assert!(DOCUMENT.contains(&format!("`{text}`")), "{text} is not in the document");
    }
    // And the document shows no others.
    let shown = DOCUMENT.split('`').filter(|code| code.len() > 4 && code.as_bytes()[3] == b'#').count();
    assert_eq!(shown, examples().len());
}

#[test]
fn a_latent_fills_one_fd_frame() {
    let emitted = Message::Latent(latent()).emit(7, false);
    assert_eq!((emitted.id, emitted.fd, emitted.len), (0x207, true, 64));
    assert_eq!(emitted.data[..8], [0x34, 1, 0x34, 0x12, 127, 0x80, 1, 3]);
    assert_eq!((emitted.data[20], emitted.data[51], emitted.data[52]), (0, -31i8 as u8, 0));
    assert_eq!(Message::parse(&emitted), Ok(Message::Latent(latent())));

    let pieces = latent().fragments().map(|piece| piece.data);
    assert_eq!(pieces.as_flattened()[..52], emitted.data[..52]);
    assert_eq!(LatentMessage::from_fragments(&pieces), Ok(latent()));
    assert!(latent().fragments().iter().enumerate().all(|(i, p)| usize::from(p.index()) == i && p.cycle4() == 4));
    let mut padded = pieces;
    padded[7][6] = 1;
    assert_eq!(LatentMessage::from_fragments(&padded), Err(WireError::ReservedBits(Function::LatentFragment)));
}

#[test]
fn a_chunk_fills_one_fd_frame() {
    let emitted = Message::UpdateChunk(chunk()).emit(STATION, false);
    assert_eq!((emitted.id, emitted.fd, emitted.len), (0x57f, true, 64));
    assert_eq!((&emitted.data[..6], &emitted.data[58..62]), (&[0xcd, 0xab, 3, 0, 0, 1][..], &[54, 55, 0, 0][..]));
    assert_eq!(Message::parse(&emitted), Ok(Message::UpdateChunk(chunk())));
}

#[test]
fn angles_survive_within_half_a_step() {
    for step in (-5000..5000).step_by(if cfg!(miri) { 99 } else { 1 }) {
        let angle = step as f32 * 0.001;
        let read = State::new(0, Health(0), &[0.0, angle, 0.0, -angle]).angles();
        assert_eq!(read, [0.0, quantise_angle(angle), 0.0, quantise_angle(-angle)]);
        if angle.abs() < 3.1 {
            assert!((read[1] - angle).abs() <= 0.5001 * ANGLE_LSB, "{angle}");
        }
        assert_eq!(quantise_angle(read[1]), read[1]);
    }
    assert_eq!(quantise_angle(f32::NAN), 0.0);
    assert_eq!(quantise_angle(f32::INFINITY), 2047.0 * ANGLE_LSB);
    assert_eq!(quantise_angle(-9.0), -core::f32::consts::PI);
}

#[test]
fn goals_are_held_within_their_range() {
    assert_eq!(Goal::new(1, 0, Some([1000.0, -1000.0, 0.001])).position(), Some([32767.0 / 256.0, -128.0, 0.0]));
    assert_eq!(Goal::new(1, 0, Some([f32::NAN, 0.0, 0.0])).position(), None);
    assert_eq!(Goal::new(1, 0, None).position(), None);
}

#[test]
fn whatever_is_not_exactly_right_is_refused_with_its_reason() {
    let cases: &[(&str, WireError)] = &[
        ("183#00", WireError::WrongLength { function: Function::State, got: 1, expected: 8 }),
        ("203#0000000000000000", WireError::WrongLength { function: Function::Latent, got: 8, expected: 64 }),
        ("600#", WireError::UnknownFunction(12)),
        ("7FF#0000", WireError::UnknownFunction(15)),
        ("1C0#0000000000000000", WireError::UnknownModule(64)),
        ("1FE#0000000000000000", WireError::UnknownModule(126)),
        ("1FF#0000000000000000", WireError::WrongSender { function: Function::State, module: STATION }),
        ("103#0000000000000000", WireError::WrongSender { function: Function::Goal, module: 3 }),
        ("003#0100", WireError::WrongLength { function: Function::EmergencyStop, got: 2, expected: 3 }),
        ("003#020000", WireError::WrongSender { function: Function::EmergencyStop, module: 3 }),
        ("003#030000", WireError::WrongValue { function: Function::EmergencyStop, field: "command", value: 3 }),
        ("003#010010", WireError::WrongValue { function: Function::EmergencyStop, field: "counter", value: 16 }),
        ("080#00000000", WireError::WrongValue { function: Function::Sync, field: "modules", value: 0 }),
        ("080#00000041", WireError::WrongValue { function: Function::Sync, field: "modules", value: 65 }),
        ("303#0000000000000000", WireError::WrongSender { function: Function::ServiceRequest, module: 3 }),
        (
            "37F#4001000000000000",
            WireError::WrongValue { function: Function::ServiceRequest, field: "destination", value: 64 },
        ),
        ("3FF#0000000000000000", WireError::WrongSender { function: Function::ServiceResponse, module: STATION }),
        ("283#8000000000000000", WireError::ReservedBits(Function::LatentFragment)),
        ("403#0000000000004000", WireError::WrongValue { function: Function::Telemetry, field: "module", value: 64 }),
        ("483#4200000000000000", WireError::ReservedBits(Function::Heartbeat)),
        ("583#0000000000000000", WireError::WrongSender { function: Function::UpdatePiece, module: 3 }),
        ("57F#0000000000000000", WireError::WrongLength { function: Function::UpdateChunk, got: 8, expected: 64 }),
        ("5FF#9000000000000000", WireError::WrongValue { function: Function::UpdatePiece, field: "index", value: 9 }),
        ("483#0700000000000000", WireError::WrongValue { function: Function::Heartbeat, field: "mode", value: 7 }),
        (
            "483#0000004000000000",
            WireError::WrongValue { function: Function::Heartbeat, field: "time-keeper", value: 64 },
        ),
    ];
    for (text, error) in cases {
        assert_eq!(Message::parse(&frame(text, false)), Err(*error), "{text}");
        assert!(format!("{error}").len() > 10);
    }
    let mut latent = Message::Latent(latent()).emit(0, true);
    latent.data[63] = 1;
    assert_eq!(Message::parse(&latent), Err(WireError::ReservedBits(Function::Latent)));
    let mut much = Message::UpdateChunk(chunk()).emit(STATION, true);
    much.data[3] = 2;
    let wrong = WireError::WrongValue { function: Function::UpdateChunk, field: "number", value: 2 };
    assert_eq!(Message::parse(&much), Err(wrong));
    let long = Frame { id: 0x880, fd: false, brs: false, len: 8, data: [0; 64] };
    assert_eq!(Message::parse(&long), Err(WireError::Identifier(0x880)));
    assert_eq!(
        format!("{}", WireError::WrongSender { function: Function::Goal, module: 3 }),
        "GOAL came from module 3, but only the station sends it"
    );
    assert_eq!(
        format!("{}", WireError::WrongSender { function: Function::EmergencyStop, module: 3 }),
        "EMERGENCY_STOP with a release came from module 3, but only the station sends it"
    );
}

#[test]
fn the_document_says_what_the_code_does() {
    let has = |line: &str| assert!(DOCUMENT.lines().any(|l| l.starts_with(line)), "wire-format.md lacks: {line}");
    for layout in &LAYOUTS {
        let function = layout.function;
        let modules = format!("0x{:03X} to 0x{:03X}", function.id(0), function.id(MAX_MODULES as u8 - 1));
        let station = format!("0x{:03X}", function.id(STATION));
        let (ids, senders) = match layout.senders {
            Senders::Modules => (modules, "modules"),
            Senders::Station => (station, "station"),
            Senders::Both => (format!("{modules}, {station}"), "modules, station"),
        };
        let (name, number, size, wire) = (function.name(), function as u8, layout.size, layout.wire_len());
        has(&format!("| {name} | {number} | {ids} | {senders} | {size} | {wire} |"));

        let section = DOCUMENT.split("\n### ").find(|s| s.starts_with(&format!("{name}\n"))).unwrap();
        let mut rows = section.lines().filter(|l| l.starts_with("| ") && !l.starts_with("| start"));
        let mut start = 0;
        for field in layout.fields {
            let count = if field.count > 1 { format!("{} x ", field.count) } else { String::new() };
            let row = format!("| {start} | {count}{} | {} | ", field.bits, field.name);
            assert!(rows.next().is_some_and(|r| r.starts_with(&row)), "{name}: {row}");
            start += u16::from(field.bits) * u16::from(field.count);
        }
        assert_eq!(rows.next().filter(|r| !r.starts_with("| bit")), None, "{name} has more rows than fields");
    }
    for fault in Fault::ALL {
        let arming = if fault.forbids_arming() { "refused" } else { "allowed" };
        let (effect, cleared_by) = (fault.effect().text(), fault.cleared_by());
        has(&format!("| {} | {fault:?} | {effect} | {arming} | {cleared_by} |", fault as u8));
    }
    for mode in Mode::ALL {
        has(&format!("| {} | {} | ", mode as u8, mode.name()));
        assert_eq!(Mode::from_number(mode as u8), Some(mode));
    }
    for operation in Operation::ALL {
        has(&format!("| {} | {} | ", operation as u8, operation.name()));
        assert_eq!(Operation::from_number(operation as u8), Some(operation));
    }
    for code in ServiceCode::ALL {
        has(&format!("| {} | {code:?} | {code} |", code as u8));
        assert_eq!(ServiceCode::from_number(code as u8), Some(code));
    }
    for limit in LimitedBy::ALL {
        has(&format!("| {} | {limit:?} | ", limit as u8));
    }
    has(&format!("Version {PROTOCOL_VERSION}."));
}

/// Reads the `k`-th value of a field as the table says.
fn field(frame: &Frame, function: Function, name: &str, k: u16) -> i64 {
    let layout = LAYOUTS.iter().find(|l| l.function == function).unwrap();
    let mut start = 0;
    for f in layout.fields {
        let bits = u16::from(f.bits);
        if f.name == name {
            start += k * bits;
            let bit = |n: u16| i64::from(frame.data[usize::from(n / 8)] >> (n % 8) & 1);
            let value: i64 = (0..bits).map(|b| bit(start + b) << b).sum();
            return if f.signed && value >> (bits - 1) != 0 { value - (1 << bits) } else { value };
        }
        start += bits * u16::from(f.count);
    }
    panic!("no field {name}");
}

#[test]
fn the_table_finds_the_fields_where_the_structs_put_them() {
    let by_function = |f: Function| examples().into_iter().rev().find(|e| e.0.function() == f).unwrap();
    let state = by_function(Function::State).0.emit(3, true);
    let angles = [0, 1, 2, 3].map(|k| field(&state, Function::State, "angle", k));
    assert_eq!(angles, [1, -1, -2048, -16]);
    let goal = by_function(Function::Goal).0.emit(STATION, true);
    assert_eq!([0, 1, 2].map(|k| field(&goal, Function::Goal, "position", k)), [128, 384, -64]);
    assert_eq!(field(&goal, Function::Goal, "known", 0), 1);
    let sync = by_function(Function::Sync).0.emit(0, true);
    assert_eq!((field(&sync, Function::Sync, "cycle", 0), field(&sync, Function::Sync, "alive", 0)), (0x1234, 7));
    let latent = Message::Latent(latent()).emit(0, true);
    assert_eq!(field(&latent, Function::Latent, "policy", 0), 0x1234);
    assert_eq!(
        (field(&latent, Function::Latent, "key", 1), field(&latent, Function::Latent, "value", 31)),
        (-128, -31)
    );
    let telemetry = by_function(Function::Telemetry).0.emit(0, true);
    assert_eq!(field(&telemetry, Function::Telemetry, "torque", 1), -127);
    assert_eq!(field(&telemetry, Function::Telemetry, "attention", 0), 140);
    let heartbeat = by_function(Function::Heartbeat).0.emit(0, true);
    assert_eq!(field(&heartbeat, Function::Heartbeat, "fault", 0), 34);
    assert_eq!(field(&heartbeat, Function::Heartbeat, "policy", 0), 0x1234);
}

#[test]
fn a_health_carries_the_last_stop_or_release() {
    let health = Health::PITCH_DEAD.with(Health::EMERGENCY_STOP).with_stop_count(StopCount::new(11));
    assert_eq!(health, Health(0xbc));
    assert_eq!(health.stop_count().number(), 11);
    assert!(health.has(Health::EMERGENCY_STOP) && !health.sensors_plausible());
    let moved = health.with_stop_count(StopCount::new(2));
    assert_eq!((moved.0 & 15, moved.stop_count().number()), (12, 2));
}

#[test]
fn a_request_is_answered_by_those_it_is_for() {
    let request = ServiceRequest { destination: 3, operation: 5, sequence: 9, index: 17, value: 0 };
    assert!(request.is_for(3) && !request.is_for(4));
    assert!(ServiceRequest { destination: ALL_MODULES, ..request }.is_for(63));
    let answer = request.answer(ServiceCode::NoSuchRegister, 0xa1b2_c3d4);
    assert_eq!(Message::ServiceResponse(answer).emit(3, false), frame("383#05090211D4C3B2A1", false));
}

/// On an FD bus every frame is marked as FD, so that tools send the short ones as FD frames, too.
#[test]
fn the_dbc_file_lists_every_frame_of_its_bus_once() {
    for fd in [true, false] {
        let mut text = String::new();
        dbc(&mut text, 8, fd).unwrap();
        let ids: Vec<u16> = text
            .lines()
            .filter_map(|l| l.strip_prefix("BO_ "))
            .map(|l| l.split(' ').next().unwrap().parse().unwrap())
            .collect();
        // Seven functions of eight modules; the station's GOAL, EMERGENCY_STOP, SERVICE_REQUEST, and UPDATE_CHUNK or UPDATE_PIECE.
        assert_eq!(ids.len(), 7 * 8 + 4);
        assert!(ids.windows(2).all(|w| w[0] < w[1]));
        assert_eq!(text.contains("BO_ 515 LATENT_M3: 64 M3\n"), fd);
        assert_eq!(text.contains("BO_ 643 LATENT_FRAGMENT_M3: 8 M3\n"), !fd);
        assert!(text.contains(" SG_ angle_1 : 28|12@1- (0.00153398"));
        for id in &ids {
            assert_eq!(text.contains(&format!("BA_ \"VFrameFormat\" BO_ {id} 14;\n")), fd);
        }
        assert!(text.contains("VAL_ 1155 fault 0 \"none\" 32 \"EmergencyStop\""));
        assert!(text.contains("VAL_ 1155 mode 0 \"boot\" 1 \"active\""));
        assert!(text.contains("VAL_ 895 operation 1 \"HELLO\""));
        assert!(text.contains("VAL_ 899 code 0 \"Ok\""));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4096, failure_persistence: None, ..ProptestConfig::default() })]

    /// No bytes make the parser panic, and what it accepts is written back as the same frame.
    #[test]
    fn any_frame_is_refused_or_understood_completely(
        id in prop_oneof![9 => 0u16..0x600, 1 => any::<u16>()],
        fd in any::<bool>(),
        len in prop_oneof![4 => Just(8u8), 1 => Just(3u8), 1 => Just(4u8), 2 => Just(64u8), 1 => any::<u8>()],
        mut data in prop::array::uniform32(any::<u8>()),
        zeros in any::<bool>(),
    ) {
        let mut whole = [0; 64];
        if zeros {
            // Most random bytes have a reserved bit set.
            data.iter_mut().for_each(|b| *b &= 3);
        }
        whole[..32].copy_from_slice(&data);
        whole[usize::from(len.min(64))..].fill(0);
        let fd = fd || len > 8;
        let frame = Frame { id, fd, brs: fd, len, data: whole };
        let _ = format!("{frame:?}");
        match Message::parse(&frame) {
            Ok(message) => prop_assert_eq!(message.emit(frame.module(), fd), frame),
            Err(error) => prop_assert!(error.to_string().len() > 10),
        }
    }

    #[test]
    fn whatever_is_emitted_is_understood(
        module in 0u8..64, cycle in any::<u16>(), fd in any::<bool>(), health in any::<u8>(),
        x in prop::array::uniform4(any::<f32>()), key in prop::array::uniform16(any::<i8>()),
        value in prop::array::uniform32(any::<i8>()), policy in any::<u16>(),
    ) {
        let low = cycle as u8;
        let latent = LatentMessage { cycle: low, health: Health(health), policy, key, value };
        let messages = [
            Message::Sync(Sync::new(cycle, module, module + 1)),
            Message::State(State::new(low, Health(health), &x)),
            Message::Latent(latent),
            Message::LatentFragment(latent.fragments()[usize::from(low & 7)]),
        ];
        for message in messages {
            prop_assert_eq!(Message::parse(&message.emit(module, fd)), Ok(message));
        }
        let goal = Message::Goal(Goal::new(low, low & 0x7f, Some([x[0], x[1], x[2]])));
        prop_assert_eq!(Message::parse(&goal.emit(STATION, fd)), Ok(goal));
        prop_assert_eq!(LatentMessage::from_fragments(&latent.fragments().map(|f| f.data)), Ok(latent));
    }
}
