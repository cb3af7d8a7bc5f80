//! The bytes themselves, the document against the code, and anything at all against the views.

use std::format;
use std::string::ToString;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;

const DOCUMENT: &str = include_str!("../../update-format.md");

fn repr() -> HeaderRepr {
    HeaderRepr {
        length: 14_908,
        counter: 7,
        edition: 42,
        task: Task::WallClimbing,
        crc: 0x1234_5678,
        digest: core::array::from_fn(|i| i as u8),
        key_id: *b"\x01\x02\x03\x04\x05\x06\x07\x08",
    }
}

fn signature() -> [u8; SIGNATURE_SIZE] {
    core::array::from_fn(|i| 0xc0 ^ i as u8)
}

#[test]
fn a_header_has_the_documented_bytes() {
    let bytes = repr().emit(Some(&signature()));
    let at = |from: usize, to: usize| &bytes[from..to];
    assert_eq!((at(0, 8), at(8, 12), at(12, 16)), (&b"COMPSIGN"[..], &[1, 0, 1, 0][..], &[0x3c, 0x3a, 0, 0][..]));
    assert_eq!((at(16, 24), at(24, 32)), (&[7, 0, 0, 0, 42, 0, 0, 0][..], &[4, 0, 0, 0, 0x78, 0x56, 0x34, 0x12][..]));
    assert_eq!((at(32, 34), at(96, 104), at(104, 105)), (&[0, 1][..], &repr().key_id[..], &[0xc0][..]));
    let header = Header::new_checked(&bytes).unwrap();
    assert_eq!((*header.repr(), header.signature()), (repr(), Some(&signature())));
    assert_eq!((header.signed_part(), header.repr().total()), (&bytes[..104], 15_076));
    let unsigned = HeaderRepr { key_id: [0; 8], ..repr() };
    let bytes = repr().emit(None);
    let header = Header::new_checked(&bytes).unwrap();
    assert_eq!((*header.repr(), header.signature()), (unsigned, None));
}

#[test]
fn what_is_wrong_with_a_header_is_said() {
    let good = repr().emit(Some(&signature()));
    let with = |at: usize, value: u8| {
        let mut bytes = good;
        bytes[at] = value;
        bytes
    };
    for (bytes, error) in [
        (with(0, b'X'), HeaderError::Magic),
        (with(8, 2), HeaderError::Version { found: 2 }),
        (with(10, 2), HeaderError::Class { found: 2 }),
        (with(14, 1), HeaderError::Length { stated: 14_908 + 65_536 }),
        (with(19, 1), HeaderError::Counter { stated: 7 + (1 << 24) }),
        (with(24, 5), HeaderError::Task(5)),
        (with(26, 1), HeaderError::Reserved),
    ] {
        assert_eq!(Header::new_checked(&bytes).map(|_| ()).unwrap_err(), error);
        assert!(error.to_string().len() > 30, "{error}");
    }
    let mut half = good;
    half[96..104].fill(0);
    assert_eq!(Header::new_checked(&half).map(|_| ()).unwrap_err(), HeaderError::HalfSigned);
    half = good;
    half[104..].fill(0);
    assert_eq!(Header::new_checked(&half).map(|_| ()).unwrap_err(), HeaderError::HalfSigned);
    half = good;
    half[12..16].fill(0);
    assert_eq!(Header::new_checked(&half).map(|_| ()).unwrap_err(), HeaderError::Length { stated: 0 });
    for length in 0..HEADER_SIZE {
        assert_eq!(Header::new_checked(&good[..length]).map(|_| ()).unwrap_err(), HeaderError::TooShort { length });
    }
}

#[test]
fn chunks_carry_all_bytes_and_pieces_carry_chunks() {
    let package: Vec<u8> = (0..15_076u32).map(|i| (i * 7) as u8).collect();
    let session = session(&package);
    let mut together = Vec::new();
    let mut assembly = Assembly::EMPTY;
    for number in 0..chunks(package.len()) as u16 {
        let chunk = ChunkRepr::of(&package, session, number).unwrap();
        assert_eq!(Chunk::new_checked(&chunk.emit()).unwrap().repr(), chunk);
        together.extend(chunk.data);
        let pieces = chunk.pieces();
        let last = pieces.iter().map(|piece| assembly.push(piece)).collect::<Vec<_>>();
        assert_eq!(last.iter().flatten().collect::<Vec<_>>(), [&chunk], "{number}");
        assert_eq!(last[PIECES - 1], Some(chunk));
    }
    assert_eq!(together[..package.len()], package[..]);
    assert!(together[package.len()..].iter().all(|byte| *byte == 0));
    assert_eq!(ChunkRepr::of(&package, session, chunks(package.len()) as u16), None);
    // A piece that is lost loses its chunk, and no other.
    let [a, b] = [3, 4].map(|number| ChunkRepr::of(&package, session, number).unwrap());
    assert!(a.pieces()[1..].iter().all(|piece| assembly.push(piece).is_none()));
    assert_eq!(b.pieces().iter().filter_map(|piece| assembly.push(piece)).collect::<Vec<_>>(), [b]);
}

#[test]
fn a_record_has_the_documented_bytes_and_no_bit_may_flip() {
    for kind in RecordKind::ALL {
        for slot in [Slot::A, Slot::B] {
            let record = Record { kind, slot, value: 0x00ab_cdef };
            let bytes = record.emit();
            assert_eq!((bytes[0], &bytes[1..4]), (kind as u8 | (slot as u8) << 4, &[0xef, 0xcd, 0xab][..]));
            assert_eq!(Record::parse(&bytes), Some(record));
            for bit in 0..64 {
                let mut wrong = bytes;
                wrong[bit / 8] ^= 1 << (bit % 8);
                assert_eq!(Record::parse(&wrong), None);
            }
            assert!(record.to_string().len() > 20);
        }
    }
    assert_eq!(Record::parse(&[0xff; 8]), None);
    assert_eq!(Record::parse(&[0; 8]), None);
}

#[test]
fn the_document_says_what_the_code_does() {
    let has = |line: &str| assert!(DOCUMENT.lines().any(|l| l.starts_with(line)), "update-format.md lacks: {line}");
    for (at, kind, name) in [
        (0, "u8[8]", "magic"),
        (8, "u16", "layout version"),
        (CLASS_AT, "u16", "device class"),
        (LENGTH_AT, "u32", "length"),
        (COUNTER_AT, "u32", "security counter"),
        (EDITION_AT, "u32", "edition"),
        (TASK_AT, "u8", "task"),
        (RESERVED_AT, "u8[3]", "reserved"),
        (CRC_AT, "u32", "policy"),
        (DIGEST_AT, "u8[64]", "digest"),
        (KEY_AT, "u8[8]", "key"),
        (SIGNED, "u8[64]", "signature"),
    ] {
        has(&format!("| {at} | {kind} | {name} |"));
    }
    for kind in RecordKind::ALL {
        has(&format!("| {} | {kind:?} | ", kind as u8));
    }
    for reason in Reason::ALL {
        has(&format!("| {} | {reason:?} | {} |", reason as u8, reason.text()));
    }
    let record = Record { kind: RecordKind::Confirm, slot: Slot::B, value: 7 }.emit();
    let hex: std::string::String = record.iter().map(|byte| format!("{byte:02X}")).collect();
    assert!(DOCUMENT.contains(&format!("`{hex}`")), "{hex}");
    for number in [HEADER_SIZE, SIGNED, SLOT_SIZE, IMAGE_MAX, CHUNKS_MAX, CHUNK_SIZE] {
        assert!(DOCUMENT.contains(&number.to_string()), "{number}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 20_000, failure_persistence: None, ..ProptestConfig::default() })]

    /// No bytes make a view panic, and what it accepts is written back as the same bytes.
    #[test]
    fn any_bytes_are_refused_or_understood_completely(
        mut bytes in prop::collection::vec(any::<u8>(), 0..200),
        spoil in prop::option::of((0usize..HEADER_SIZE, any::<u8>())),
        record in prop::array::uniform8(any::<u8>()),
        piece in prop::array::uniform8(any::<u8>()),
        from in 0usize..7,
    ) {
        if let Some((at, value)) = spoil {
            bytes = repr().emit(Some(&signature())).to_vec();
            bytes[at] = value;
        }
        if let Ok(header) = Header::new_checked(&bytes) {
            prop_assert_eq!(&header.repr().emit(header.signature())[..], &bytes[..HEADER_SIZE]);
        }
        if let Some(chunk) = bytes.get(..CHUNK_FRAME).and_then(Chunk::new_checked) {
            prop_assert_eq!(&chunk.repr().emit()[..], &bytes[..CHUNK_FRAME]);
        }
        let mut whole = record;
        if from > 3 {
            whole[4..].copy_from_slice(&crate::CRC_32.checksum(&record[..4]).to_le_bytes());
        }
        if let Some(record) = Record::parse(&whole) {
            prop_assert_eq!(record.emit(), whole);
        }
        let mut assembly = Assembly::EMPTY;
        prop_assert_eq!(assembly.push(&piece), None);
    }
}
