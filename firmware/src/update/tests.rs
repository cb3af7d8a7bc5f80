//! Updates as a station does them, with everything that may be wrong with a policy, and with the power cut at every operation of the flash.

use std::vec::Vec;

use composer_shared::policy::random_image;
use composer_shared::random::SplitMix64;
use composer_shared::update::{CHUNK_FRAME, Chunk, HEADER_SIZE, KEY_ID_SIZE, session};
use composer_shared::wire::Operation;
use ed25519_dalek::{Signer, SigningKey};

use super::model::{G4, Op, Torn};
use super::records::PLACES;
use super::*;

/// Keys for tests alone, from a seed.
pub(crate) fn test_key(seed: u8) -> SigningKey {
    SigningKey::from_bytes(&[seed; 32])
}

pub(crate) fn image(seed: u32) -> Vec<u8> {
    let mut image = [0; IMAGE_SIZE];
    random_image(seed, &mut image);
    image.to_vec()
}

fn header(image: &[u8], counter: u32) -> HeaderRepr {
    let mut sha = Sha512::new();
    sha.update(image);
    let crc = u32::from_le_bytes(*image.last_chunk().unwrap());
    let task = Policy::parse(image).map_or(composer_shared::policy::Task::GoalReaching, |policy| policy.task());
    let length = image.len() as u32;
    HeaderRepr { length, counter, edition: 0, task, crc, digest: sha.finalize(), key_id: [0; KEY_ID_SIZE] }
}

/// Header and image, signed if there is a key.
pub(crate) fn package(image: &[u8], counter: u32, key: Option<&SigningKey>) -> Vec<u8> {
    let mut repr = header(image, counter);
    let mut head = repr.emit(None);
    if let Some(key) = key {
        repr.key_id = *key.verifying_key().as_bytes().first_chunk().unwrap();
        let unsigned = repr.emit(Some(&[0; 64]));
        head = repr.emit(Some(&key.sign(&unsigned[..SIGNED_PART]).to_bytes()));
    }
    [&head[..], image].concat()
}

const SIGNED_PART: usize = composer_shared::update::SIGNED;

fn usable(flash: &G4, slot: Slot) -> bool {
    image_of(flash, slot).is_some_and(|image| Policy::parse(image).is_ok())
}

fn boot(flash: &mut G4, keys: [Key; 2]) -> Updater {
    Updater::start(flash, keys, usable)
}

/// The CRC-32 of the policy that a module runs with; 0 for the one that it was made with.
fn runs(flash: &G4, updater: &Updater) -> u32 {
    if !updater.records().state().confirmed && updater.started().slot == Slot::A {
        return 0;
    }
    let image = image_of(flash, updater.started().slot).expect("it runs with what lies in a slot");
    Policy::parse(image).expect("it is a policy").crc()
}

fn ask(updater: &mut Updater, flash: &mut G4, step: UpdateStep, value: u32) -> Result<u32, ServiceCode> {
    let request =
        ServiceRequest { destination: 0, operation: Operation::Update as u8, sequence: 0, index: step as u8, value };
    let policy = runs(flash, updater);
    if let Some(value) = updater.serve(&request, policy)? {
        return Ok(value);
    }
    for _ in 0..200 {
        if let Some((answered, result)) = updater.work(flash) {
            assert_eq!(answered, request);
            return result;
        }
    }
    panic!("{step:?} does not end");
}

fn send(updater: &mut Updater, flash: &mut G4, package: &[u8]) -> Result<u32, ServiceCode> {
    let session = session(package);
    ask(updater, flash, UpdateStep::Begin, u32::from(session) | (package.len() as u32) << 16)?;
    for number in 0..chunks(package.len()) as u16 {
        updater.hear_chunk(&ChunkRepr::of(package, session, number).unwrap());
        assert_eq!(updater.work(flash), None);
    }
    ask(updater, flash, UpdateStep::Verify, 0)
}

/// A whole update, with the restart in it.
fn update(flash: &mut G4, keys: [Key; 2], package: &[u8]) -> Result<Updater, ServiceCode> {
    let mut updater = boot(flash, keys);
    if updater.on_trial() {
        // The station is too late for what was on trial.
        updater = boot(flash, keys);
    }
    let crc = send(&mut updater, flash, package)?;
    ask(&mut updater, flash, UpdateStep::Commit, crc)?;
    let mut updater = boot(flash, keys);
    assert!(updater.on_trial());
    ask(&mut updater, flash, UpdateStep::Confirm, crc)?;
    assert!(!updater.on_trial());
    Ok(updater)
}

fn crc_of(package: &[u8]) -> u32 {
    u32::from_le_bytes(*package.last_chunk().unwrap())
}

const LAB: [Key; 2] = [NO_KEY; 2];

#[test]
fn policies_follow_one_another_in_the_two_slots() {
    let mut flash = G4::new();
    assert_eq!(runs(&flash.clone(), &boot(&mut flash, LAB)), 0);
    for (round, slot) in (1..=4).zip([Slot::B, Slot::A, Slot::B, Slot::A]) {
        let package = package(&image(round), round, None);
        let updater = update(&mut flash, LAB, &package).unwrap();
        assert_eq!((updater.started().slot, updater.records().state().counter), (slot, round));
        for _ in 0..3 {
            let updater = boot(&mut flash, LAB);
            assert_eq!((runs(&flash, &updater), updater.on_trial()), (crc_of(&package), false));
        }
    }
}

#[test]
fn without_a_confirmation_the_old_policy_comes_back() {
    let mut flash = G4::new();
    let (old, new) = (package(&image(1), 0, None), package(&image(2), 0, None));
    update(&mut flash, LAB, &old).unwrap();
    let mut updater = boot(&mut flash, LAB);
    let crc = send(&mut updater, &mut flash, &new).unwrap();
    assert_eq!(crc, crc_of(&new));
    // Verified alone it is not tried.
    assert_eq!(runs(&flash.clone(), &boot(&mut flash, LAB)), crc_of(&old));
    let mut updater = boot(&mut flash, LAB);
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Commit, crc), Err(ServiceCode::NoUpdate), "a restart forgets");
    send(&mut updater, &mut flash, &new).unwrap();
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Commit, crc ^ 1), Err(ServiceCode::NoUpdate));
    ask(&mut updater, &mut flash, UpdateStep::Commit, crc).unwrap();
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Commit, crc), Ok(crc), "asked again");
    let mut updater = boot(&mut flash, LAB);
    assert_eq!((runs(&flash, &updater), updater.on_trial()), (crc_of(&new), true));
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Begin, 1000 << 16), Err(ServiceCode::OnTrial));
    // Its time is over.
    updater.give_up();
    while updater.is_busy() {
        updater.work(&mut flash);
    }
    assert!(updater.given_up());
    let updater = boot(&mut flash, LAB);
    assert_eq!((runs(&flash, &updater), updater.on_trial()), (crc_of(&old), false));
    // Or it restarts by itself.
    let mut updater = updater;
    send(&mut updater, &mut flash, &new).unwrap();
    ask(&mut updater, &mut flash, UpdateStep::Commit, crc).unwrap();
    assert!(boot(&mut flash, LAB).on_trial());
    let updater = boot(&mut flash, LAB);
    assert_eq!((runs(&flash, &updater), updater.on_trial()), (crc_of(&old), false));
    let reasons: Vec<_> =
        (0..updater.records().count()).filter_map(|back| updater.records().back(&mut flash, back)).collect();
    let reverts: Vec<_> = reasons.iter().filter(|r| r.kind == RecordKind::Revert).map(|r| r.value).collect();
    assert_eq!(reverts, [Reason::Restarted as u32, Reason::NotConfirmed as u32]);
}

#[test]
fn what_was_interrupted_goes_on_and_chunks_may_come_in_any_order() {
    let mut flash = G4::new();
    let package = package(&image(1), 0, None);
    let (session, total) = (session(&package), package.len() as u32);
    let mut updater = boot(&mut flash, LAB);
    let begin = u32::from(session) | total << 16;
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Begin, begin), Ok(0));
    let count = chunks(package.len()) as u16;
    let of = |number| ChunkRepr::of(&package, session, number).unwrap();
    let hear = |updater: &mut Updater, flash: &mut G4, chunk: &ChunkRepr| {
        updater.hear_chunk(chunk);
        updater.work(flash);
    };
    for number in (0..count).rev().filter(|number| number % 3 != 0) {
        hear(&mut updater, &mut flash, &of(number));
    }
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Verify, 0), Err(ServiceCode::Missing));
    assert_eq!(updater.item(0), Some(0xb6db_6db6), "every third is missing");
    // Chunks of another update, and those that are there already, are left alone.
    hear(&mut updater, &mut flash, &ChunkRepr { session: session ^ 1, ..of(0) });
    hear(&mut updater, &mut flash, &ChunkRepr { data: [0; CHUNK_SIZE], ..of(1) });
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Begin, begin), Ok(1), "what is there stays");
    for number in (0..count).filter(|number| number % 3 == 0) {
        let pieces = of(number).pieces();
        for piece in pieces {
            updater.hear_piece(&Piece(piece));
        }
        updater.work(&mut flash);
    }
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Verify, 0), Ok(crc_of(&package)));
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Abandon, 0), Ok(0));
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Verify, 0), Err(ServiceCode::NoUpdate));
    // What was to be tried is taken back.
    let crc = send(&mut updater, &mut flash, &package).unwrap();
    ask(&mut updater, &mut flash, UpdateStep::Commit, crc).unwrap();
    ask(&mut updater, &mut flash, UpdateStep::Abandon, 0).unwrap();
    assert!(!boot(&mut flash, LAB).on_trial());
}

/// Everything that is refused, each with its code, and the policy of before untouched.
#[test]
fn whatever_is_not_signed_whole_and_new_is_refused() {
    let (own, next, foreign) = (test_key(1), test_key(2), test_key(3));
    let key = |key: &SigningKey| *key.verifying_key().as_bytes();
    let keys = [key(&own), key(&next)];
    let mut flash = G4::new();
    let old = package(&image(1), 5, Some(&own));
    update(&mut flash, keys, &old).unwrap();
    let before = image_of(&flash, Slot::B).unwrap().to_vec();
    let good = package(&image(2), 5, Some(&next));
    let resign = |change: &dyn Fn(&mut [u8])| {
        let mut bytes = good.clone();
        change(&mut bytes);
        let signature = next.sign(&bytes[..SIGNED_PART]).to_bytes();
        bytes[SIGNED_PART..HEADER_SIZE].copy_from_slice(&signature);
        bytes
    };
    let flipped = |at: usize| {
        let mut bytes = good.clone();
        bytes[at] ^= 0x10;
        bytes
    };
    let mut other_image = image(2);
    other_image[100] ^= 1;
    let cases: Vec<(&str, Vec<u8>, ServiceCode)> = std::vec![
        ("another key", package(&image(2), 5, Some(&foreign)), ServiceCode::BadSignature),
        ("not signed", package(&image(2), 5, None), ServiceCode::Unsigned),
        ("a lower counter", package(&image(2), 4, Some(&own)), ServiceCode::OldCounter),
        ("another class", resign(&|bytes| bytes[10] = 2), ServiceCode::WrongClass),
        ("another layout", resign(&|bytes| bytes[8] = 2), ServiceCode::NotSignedPolicy),
        ("another task than the image's", resign(&|bytes| bytes[24] = 3), ServiceCode::NotSignedPolicy),
        ("another length", resign(&|bytes| bytes[12] ^= 1), ServiceCode::NotSignedPolicy),
        ("the image changed", flipped(HEADER_SIZE + 1234), ServiceCode::BadDigest),
        ("the signature changed", flipped(SIGNED_PART + 3), ServiceCode::BadSignature),
        ("no policy, but signed", package(&other_image, 5, Some(&own)), ServiceCode::BadPolicy),
        ("the image alone", image(2), ServiceCode::NotSignedPolicy),
        ("a short image", good[..good.len() - 8].to_vec(), ServiceCode::NotSignedPolicy),
    ];
    for (what, package, code) in cases {
        let mut updater = boot(&mut flash, keys);
        assert_eq!(send(&mut updater, &mut flash, &package), Err(code), "{what}");
        assert_eq!(
            ask(&mut updater, &mut flash, UpdateStep::Commit, crc_of(&good)),
            Err(ServiceCode::NoUpdate),
            "{what}"
        );
        assert!(code.sentence().len() > 20);
        assert_eq!(image_of(&flash, Slot::B).unwrap(), before, "{what}");
        assert_eq!(runs(&flash.clone(), &boot(&mut flash, keys)), crc_of(&old), "{what}");
    }
    // The good one is taken, with the second key; and then the first one's session, replayed, has too low a counter.
    update(&mut flash, keys, &package(&image(3), 6, Some(&next))).unwrap();
    let mut updater = boot(&mut flash, keys);
    assert_eq!(send(&mut updater, &mut flash, &old), Err(ServiceCode::OldCounter));
    // Chunks of it alone are nobody's.
    let mut updater = boot(&mut flash, keys);
    let replayed = session(&old);
    flash.take_log();
    for number in 0..chunks(old.len()) as u16 {
        updater.hear_chunk(&ChunkRepr::of(&old, replayed, number).unwrap());
        updater.work(&mut flash);
    }
    assert_eq!(flash.take_log(), []);
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Verify, 0), Err(ServiceCode::NoUpdate));
    assert_eq!(ask(&mut updater, &mut flash, UpdateStep::Confirm, crc_of(&old)), Err(ServiceCode::NoUpdate));
}

/// No bit of header and image may flip without the module noticing, and saying so.
#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn a_flipped_bit_anywhere_is_refused() {
    let key = test_key(1);
    let keys = [*key.verifying_key().as_bytes(), NO_KEY];
    let mut flash = G4::new();
    let old = package(&image(1), 4, Some(&key));
    update(&mut flash, keys, &old).unwrap();
    let good = package(&image(2), 5, Some(&key));
    let exhaustive = std::env::var_os("COMPOSER_EXHAUSTIVE").is_some();
    // Of the header every bit, of the image every 997th, or all.
    let step = if exhaustive { 1 } else { 997 };
    let bits = (0..8 * HEADER_SIZE).chain((8 * HEADER_SIZE..8 * good.len()).step_by(step));
    let mut flips = 0;
    for bit in bits {
        let mut bytes = good.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let mut updater = boot(&mut flash, keys);
        let refused = send(&mut updater, &mut flash, &bytes).expect_err("a flipped bit");
        if bit >= 8 * HEADER_SIZE {
            assert_eq!(refused, ServiceCode::BadDigest, "bit {bit}");
        } else {
            use ServiceCode::{BadSignature, NotSignedPolicy, OldCounter, Unsigned, WrongClass};
            let codes = [BadSignature, NotSignedPolicy, OldCounter, Unsigned, WrongClass];
            assert!(codes.contains(&refused), "bit {bit}: {refused:?}");
        }
        assert_eq!(image_of(&flash, updater.started().slot).unwrap(), &old[HEADER_SIZE..], "bit {bit}");
        flips += 1;
    }
    std::println!("{flips} bits flipped, each refused");
    assert_eq!(send(&mut boot(&mut flash, keys), &mut flash, &good), Ok(crc_of(&good)));
}

/// A module after a loss of power.
struct Examiner<'a> {
    /// Two images that are known to be policies: the same bytes need not be parsed a million times.
    old: &'a [u8],
    new: &'a [u8],
    /// Contents of flash, and the least counter, that were looked at before.
    examined: std::collections::HashSet<(u64, u32)>,
}

impl Examiner<'_> {
    fn is_known(&self, image: &[u8]) -> bool {
        image == self.old || image == self.new
    }

    /// It starts with the old policy or the new one, and its counter has not fallen: the counter.
    fn examine(&self, cut: &G4, least: u32, what: &dyn Fn() -> std::string::String) -> u32 {
        let mut lowest = u32::MAX;
        for phase in 0..if cut.wavers() { 2 } else { 1 } {
            let mut flash = cut.clone();
            flash.waver(phase);
            let mut counter = least;
            for _ in 0..3 {
                let updater = Updater::start(&mut flash, LAB, |flash, slot| {
                    image_of(flash, slot).is_some_and(|image| self.is_known(image) || Policy::parse(image).is_ok())
                });
                let image = image_of(&flash, updater.started().slot).expect("it runs with what lies in a slot");
                assert!(self.is_known(image), "{}: it runs with neither", what());
                let state = updater.records().state();
                assert!(state.counter >= counter, "{}: the counter fell from {counter} to {}", what(), state.counter);
                counter = state.counter;
                // The counter rises with the policy, and not before.
                let risen = state.counter == 5 && image == self.new;
                assert!(state.counter == 3 || risen, "{}: {state:?}", what());
            }
            lowest = lowest.min(counter);
        }
        lowest
    }

    /// The same, unless it was asked before.
    fn examine_once(&mut self, cut: &G4, least: u32, what: &dyn Fn() -> std::string::String) {
        if self.examined.insert((cut.digest(), least)) {
            self.examine(cut, least, what);
        }
    }
}

/// The power goes before, inside and after every operation of an update, and again during every one of the recovery from it: the start, and the same update once more.
///
/// All pairs are gone through. Most leave the same flash behind, because the recovery erases what the first cut left in the slot: what a flash of the same contents comes
/// to is looked at once.
#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn whenever_the_power_goes_the_module_has_the_old_policy_or_the_new_one() {
    let (first, new) = (package(&image(1), 3, None), package(&image(2), 5, None));
    let mut before = G4::new();
    update(&mut before, LAB, &first).unwrap();
    before.take_log();
    let mut whole = before.clone();
    update(&mut whole, LAB, &new).unwrap();
    let log = whole.take_log();
    let data = SLOT_SIZE / 4;
    let is_data = |op: &Op| matches!(op, Op::Write { word, .. } if *word < data);
    // A header and an image, seven double words a chunk; slot A in as many sections as needed; commit, try, twice confirm.
    assert_eq!(log.iter().filter(|op| is_data(op)).count(), 7 * chunks(new.len()));
    assert_eq!(log.iter().filter(|op| !is_data(op)).count(), new.len().div_ceil(SECTION as usize) + 4);
    let (old_crc, new_crc) = (crc_of(&first), crc_of(&new));
    let mut at = before;
    let (mut kept, mut changed, mut cuts) = (0u32, 0u32, 0u64);
    let (old_image, new_image) = (&first[HEADER_SIZE..], &new[HEADER_SIZE..]);
    let mut examiner = Examiner { old: old_image, new: new_image, examined: Default::default() };
    for (index, op) in log.iter().enumerate() {
        for torn in Torn::ALL {
            let mut cut = at.clone();
            cut.tear(op, torn, index as u32);
            let what = || std::format!("{op:?} ({index}) {torn:?}");
            cuts += 1;
            let counter = examiner.examine(&cut, 3, &what);
            // The recovery: it starts, and the station does it all again.
            let mut recovering = cut.clone();
            let policy = runs(&recovering.clone(), &boot(&mut recovering, LAB));
            if policy == old_crc {
                kept += 1
            } else {
                changed += 1
            }
            let mut recovered = cut.clone();
            let updater = update(&mut recovered, LAB, &new).unwrap_or_else(|e| panic!("{}: {e:?}", what()));
            assert_eq!((runs(&recovered, &updater), updater.records().state().counter), (new_crc, 5), "{}", what());
            let second = recovered.take_log();
            let mut again = cut;
            for (later, op) in second.iter().enumerate() {
                for second_torn in Torn::ALL {
                    let what = || std::format!("{}, then {op:?} ({later}) {second_torn:?}", what());
                    // What a torn word of data holds does not depend on the first cut, so that those are the same flashes, too.
                    let seed = if is_data(op) { later } else { index * 31 + later } as u32;
                    cuts += 1;
                    match *op {
                        Op::Write { word, .. } => {
                            let saved = again.save(word);
                            again.tear(op, second_torn, seed);
                            examiner.examine_once(&again, counter, &what);
                            again.put(saved);
                        }
                        Op::Erase { .. } => {
                            let mut twice = again.clone();
                            twice.tear(op, second_torn, seed);
                            examiner.examine_once(&twice, counter, &what);
                        }
                    }
                }
                again.apply(op);
            }
            assert_eq!(again.digest(), recovered.digest(), "{}: what was logged is what was done", what());
        }
        at.apply(op);
    }
    let states = examiner.examined.len();
    std::println!("{cuts} cuts, {states} flashes: the old policy {kept} times, the new one {changed} times");
    assert!(kept > 1000 && changed > 3, "{kept} {changed}");
}

/// The records go from one section into the other many times, and the power may go in between.
#[test]
fn records_outlive_the_turn_of_their_sections() {
    let mut flash = G4::new();
    let new = package(&image(1), 3, None);
    update(&mut flash, LAB, &new).unwrap();
    let mut records = Records::open(&mut flash);
    let state = *records.state();
    let pending = Pending { slot: Slot::A, policy: 7, tried: false };
    let mut turns = 0;
    for round in 0..2 * PLACES {
        let kind = if round % 2 == 0 { RecordKind::Commit } else { RecordKind::Revert };
        let record = Record { kind, slot: Slot::A, value: 7 };
        let before = flash.clone();
        flash.take_log();
        records.append(&mut flash, record).unwrap();
        let log = flash.take_log();
        turns += u32::from(log.len() > 1);
        let mut at = before;
        for (index, op) in log.iter().enumerate().take(if log.len() > 1 { usize::MAX } else { 0 }) {
            for torn in Torn::ALL {
                let mut cut = at.clone();
                cut.tear(op, torn, round);
                for _ in 0..3 {
                    let mut read = Records::open(&mut cut);
                    read.mend(&mut cut);
                    let found = *read.state();
                    let same = (found.own, found.counter, found.confirmed) == (state.own, state.counter, true);
                    assert!(same, "round {round}, operation {index} {torn:?}: {found:?}");
                    assert!(found.pending.is_none() || found.pending == Some(pending));
                }
            }
            at.apply(op);
        }
        assert_eq!(Records::open(&mut flash).state().pending, (kind == RecordKind::Commit).then_some(pending));
    }
    assert!(turns >= 2, "{turns}");
}

/// What a debug probe writes makes slot A count, whatever was confirmed before.
#[test]
fn a_module_that_was_made_anew_has_the_policy_of_its_slot_a() {
    let mut flash = G4::new();
    update(&mut flash, LAB, &package(&image(1), 3, None)).unwrap();
    let made = package(&image(2), 2, None);
    let words = |bytes: &[u8]| {
        bytes
            .chunks(8)
            .map(|word| core::array::from_fn(|i| word.get(i).copied().unwrap_or(0)))
            .collect::<Vec<[u8; 8]>>()
    };
    for (from, bytes) in [(0, &made[..]), (2 * SLOT_SIZE, &records::of_new_module(2)[..])] {
        for section in from / SECTION as usize..(from + bytes.len()).div_ceil(SECTION as usize) {
            flash.apply(&Op::Erase { section });
        }
        for (word, value) in (from / 8..).zip(words(bytes)) {
            flash.apply(&Op::Write { word, value });
        }
    }
    let updater = boot(&mut flash, LAB);
    assert_eq!((updater.started().slot, updater.records().state().counter), (Slot::A, 2));
    assert_eq!(runs(&flash, &updater), crc_of(&made));
    let next = package(&image(3), 2, None);
    let updater = update(&mut flash, LAB, &next).unwrap();
    assert_eq!((updater.started().slot, runs(&flash, &updater)), (Slot::B, crc_of(&next)));
}

/// A flash that was never erased has no records, and the first update begins them.
#[test]
fn zeros_are_no_records() {
    let mut flash = G4::new();
    for section in 0..16 {
        for word in 0..512 {
            flash.apply(&Op::Write { word: section * 512 + word, value: [0; 8] });
        }
    }
    let updater = boot(&mut flash, LAB);
    assert_eq!((updater.started(), updater.records().count()), (Start { slot: Slot::A, trial: false }, 0));
    let new = package(&image(1), 3, None);
    update(&mut flash, LAB, &new).unwrap();
    assert_eq!(runs(&flash.clone(), &boot(&mut flash, LAB)), crc_of(&new));
}

/// Numbers without a meaning, the same ones every time.
struct Random(SplitMix64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0.next_u64()
    }

    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        core::array::from_fn(|_| self.next() as u8)
    }
}

/// Good signatures, and signatures, messages and keys that were spoilt: salty and dalek are of one mind. COMPOSER_EXHAUSTIVE: of 10^5 messages.
#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn signatures_are_judged_as_dalek_judges_them() {
    let messages = if std::env::var_os("COMPOSER_EXHAUSTIVE").is_some() { 100_000 } else { 1_000 };
    let mut random = Random(SplitMix64(1));
    let (mut good, mut bad) = (0, 0);
    // The order of the group, and points of small order.
    let order: [u8; 32] = [
        0xed, 0xd3, 0xf5, 0x5c, 0x1a, 0x63, 0x12, 0x58, 0xd6, 0x9c, 0xf7, 0xa2, 0xde, 0xf9, 0xde, 0x14, 0, 0, 0, 0, 0,
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
    ];
    for round in 0..messages {
        let key = SigningKey::from_bytes(&random.bytes());
        let length = (random.next() % 200) as usize;
        let mut message: Vec<u8> = (0..length).map(|_| random.next() as u8).collect();
        let mut signature = key.sign(&message).to_bytes();
        let mut public = *key.verifying_key().as_bytes();
        match round % 8 {
            0 => signature[(random.next() % 64) as usize] ^= 1 << (random.next() % 8),
            1 if length > 0 => message[random.next() as usize % length] ^= 1 << (random.next() % 8),
            2 => public[(random.next() % 32) as usize] ^= 1 << (random.next() % 8),
            3 => {
                // The same signature with the order added: only whoever forgets to look takes it.
                let mut carry = 0;
                for (digit, more) in signature[32..].iter_mut().zip(order) {
                    let sum = u16::from(*digit) + u16::from(more) + carry;
                    (*digit, carry) = (sum as u8, sum >> 8);
                }
            }
            4 => signature = random.bytes(),
            _ => {}
        }
        let dalek = ed25519_dalek::VerifyingKey::from_bytes(&public).is_ok_and(|public| {
            use ed25519_dalek::Verifier;
            public.verify(&message, &ed25519_dalek::Signature::from_bytes(&signature)).is_ok()
        });
        assert_eq!(verify(&public, &message, &signature), dalek, "message {round}");
        if dalek { good += 1 } else { bad += 1 }
    }
    std::println!("{good} good, {bad} bad");
    assert!(good >= messages / 4 && bad >= messages / 4, "{good} {bad}");
}

/// Anything at all as header, chunk, piece, record and page of records: nothing panics, what is understood is written back as the same bytes, a module starts with
/// one of its slots, and no header is authentic that dalek refuses. COMPOSER_FUZZ says how many inputs.
#[test]
#[cfg_attr(miri, ignore = "takes hours there")]
fn any_bytes_are_survived_and_nothing_is_authentic_that_dalek_refuses() {
    use ed25519_dalek::Verifier;
    let inputs: u64 = std::env::var("COMPOSER_FUZZ").map_or(200_000, |text| text.parse().expect("a number"));
    let mut random = Random(SplitMix64(2));
    let key = test_key(5);
    let keys = [*key.verifying_key().as_bytes(), *test_key(6).verifying_key().as_bytes()];
    let good = package(&image(1), 5, Some(&key));
    let mut flash = G4::new();
    let mut updater = boot(&mut flash, keys);
    let (mut headers, mut chunked, mut recorded, mut judged, mut authentic) = (0u64, 0u64, 0u64, 0u64, 0u64);
    let mut assembly = Assembly::EMPTY;
    for input in 0..inputs {
        let mut bytes: [u8; HEADER_SIZE] = *good.first_chunk().unwrap();
        match random.next() % 8 {
            0 => bytes = random.bytes(),
            1 => {}
            kind => {
                for _ in 0..kind {
                    // Mostly bytes that have few values, so that the rest is looked at, too.
                    bytes[(random.next() % HEADER_SIZE as u64) as usize] =
                        (random.next() >> (random.next() % 60)) as u8;
                }
            }
        }
        let length =
            if random.next().is_multiple_of(16) { (random.next() % HEADER_SIZE as u64) as usize } else { HEADER_SIZE };
        if let Ok(header) = Header::new_checked(&bytes[..length]) {
            headers += 1;
            assert_eq!(header.repr().emit(header.signature()), bytes);
            // The signature takes longer than all the rest.
            if input.is_multiple_of(64) {
                judged += 1;
                if updater.is_authentic(&header, header.repr()) {
                    authentic += 1;
                    let signature = ed25519_dalek::Signature::from_bytes(header.signature().unwrap());
                    assert!(key.verifying_key().verify(header.signed_part(), &signature).is_ok());
                    assert_eq!(bytes[..], good[..HEADER_SIZE]);
                }
            }
        }
        let mut frame: [u8; CHUNK_FRAME] = *bytes.first_chunk().unwrap();
        if random.next().is_multiple_of(2) {
            // A header's bytes at this place are no chunk's number: one about as large as there are.
            frame[2..4].copy_from_slice(&((random.next() % (2 * CHUNKS_MAX as u64)) as u16).to_le_bytes());
        }
        if let Some(chunk) = Chunk::new_checked(&frame) {
            chunked += 1;
            assert_eq!(chunk.repr().emit(), frame);
            updater.hear_chunk(&chunk.repr());
        }
        if let Some(chunk) = assembly.push(bytes.last_chunk().unwrap()) {
            assert!(usize::from(chunk.number) < CHUNKS_MAX);
        }
        updater.hear_piece(&Piece(*bytes.first_chunk().unwrap()));
        let mut record: [u8; 8] = *bytes[40..].first_chunk().unwrap();
        if random.next().is_multiple_of(2) {
            record = Record {
                kind: RecordKind::ALL[(random.next() % 5) as usize],
                slot: if random.next().is_multiple_of(2) { Slot::A } else { Slot::B },
                value: random.next() as u32 & 0x00ff_ffff,
            }
            .emit();
        }
        if let Some(read) = Record::parse(&record) {
            recorded += 1;
            assert_eq!(read.emit(), record);
        }
        // A place among the records, wherever; now and then the module starts with what has become of them.
        let word = 2 * SLOT_SIZE / 8 + (random.next() % u64::from(2 * PLACES)) as usize;
        flash.apply(&Op::Write {
            word: if random.next().is_multiple_of(8) { 2 * SLOT_SIZE / 8 } else { word },
            value: record,
        });
        if input.is_multiple_of(4096) {
            let records = Records::open(&mut flash);
            assert!(records.state().counter <= composer_shared::update::COUNTER_MAX);
            let mut copy = flash.clone();
            let started = Updater::start(&mut copy, keys, |_, _| input.is_multiple_of(8192)).started();
            assert!(started.slot == Slot::A || started.slot == Slot::B);
            if input.is_multiple_of(65_536) {
                flash = G4::new();
            }
        }
    }
    std::println!(
        "{inputs} inputs: {headers} headers, {chunked} chunks, {recorded} records, {judged} judged, {authentic} authentic"
    );
    assert!(headers > inputs / 20 && chunked > inputs / 20 && recorded > inputs / 4 && authentic > 0);
}
