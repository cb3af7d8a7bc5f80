use std::vec;
use std::vec::Vec;

use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_shared::registers::{Kind, Spec};
use composer_shared::update::{ChunkRepr, RecordKind, chunks, session};
use composer_shared::wire::{ALL_MODULES, Health, Mode, Piece, STATION, State, UpdateStep};
use proptest::prelude::*;

use super::*;
use crate::controller::{Boot, BusStatus, Config};
use crate::node_page::tests::page;
use crate::port::Counts;
use crate::power::Power;
use crate::storage::tests::Dying;
use crate::storage::{RamFlash, read_page};
use crate::update::model::G4;
use crate::update::tests::{image as update_image, package, test_key};

const MS: u64 = 1000;
const UNIQUE_ID: [u32; 3] = [0x1111_2222, 0x3333_4444, 0x5555_6666];
/// The number that the test's node page has.
const NODE: u8 = 3;

/// A board whose readings the test sets, and whose power it may cut.
struct Bench {
    storage: Dying,
    policies: G4,
    raw: Raw,
}

impl Board for Bench {
    type Flash = Dying;
    type Policies = G4;

    fn policies(&mut self) -> &mut G4 {
        &mut self.policies
    }

    fn storage(&mut self) -> &mut Dying {
        &mut self.storage
    }

    fn unique_id(&self) -> [u32; 3] {
        UNIQUE_ID
    }

    fn raw(&self) -> Raw {
        self.raw
    }
}

fn raw() -> Raw {
    Raw {
        encoders: [Some(1), Some(2), None, Some(4)],
        encoder_errors: [10, 11, 12, 13],
        force: [0.1, 0.2, 0.3],
        rate: [0.4, 0.5, 0.6],
        imu_errors: 14,
        supply: 12.5,
        temperatures: [30.0, 31.5],
        currents: [0.25, -0.5],
        port: PortStatus {
            bus: BusStatus::ErrorActive,
            transmit_errors: 17,
            receive_errors: 18,
            counts: Counts {
                overflowed: 15,
                displaced: 1,
                replaced: 5,
                stale: 10,
                crowded: 19,
                bus_off: 20,
                sent: 0,
                guarded: 7,
            },
        },
    }
}

fn image() -> [u8; IMAGE_SIZE] {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    image
}

/// A module with its service.
struct Module<'a> {
    now: u64,
    controller: Controller<'a>,
    service: Service,
    board: Bench,
    sensors: Sensors,
    sequence: u8,
}

impl<'a> Module<'a> {
    fn new(image: &'a [u8]) -> Self {
        Self::with_flash(image, RamFlash::ERASED)
    }

    /// Starts with what the flash has, or the test's page if it has none.
    fn with_flash(image: &'a [u8], flash: RamFlash<2048>) -> Self {
        Self::with_policies(image, flash, G4::new())
    }

    /// Starts with a policy that is on trial.
    fn on_trial(image: &'a [u8], policies: G4) -> Self {
        let module = Self::with_policies(image, RamFlash::ERASED, policies);
        assert!(module.service.updater().on_trial());
        module
    }

    fn with_policies(image: &'a [u8], flash: RamFlash<2048>, policies: G4) -> Self {
        let storage = Dying { flash, left: usize::MAX, noise: 1 };
        let mut board = Bench { storage, policies, raw: raw() };
        let page = read_page(board.storage()).unwrap_or(page());
        let policy = Policy::parse(image).unwrap();
        let settings = Config::new(page.node, page.modules, BusKind::Fd, &policy);
        let config = Config { safety: page.safety, bus_off: page.bus_off, ..settings };
        let mut controller = Controller::new(config, policy, Boot::default(), 0).unwrap();
        let updater = Updater::start(board.policies(), page.keys, |_, _| true);
        let service = Service::new(page, updater, &mut controller, 0, &mut board);
        let sensors = Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO };
        let mut module = Module { now: 0, controller, service, board, sensors, sequence: 100 };
        module.run(100 * MS);
        assert_eq!(read_page(module.board.storage()), Ok(page), "it was written to both places");
        module
    }

    /// What a board does with a frame.
    fn poll(&mut self, frame: Option<&Frame>) -> Vec<Frame> {
        self.controller.poll(self.now, &self.sensors, frame, BusStatus::ErrorActive);
        self.service.poll(self.now, &mut self.controller, &self.sensors, frame, &mut self.board);
        let controller = core::iter::from_fn(|| self.controller.next_frame()).collect::<Vec<_>>();
        let answers = core::iter::from_fn(|| self.service.next_frame(&self.controller));
        controller.into_iter().chain(answers).collect()
    }

    fn run(&mut self, us: u64) -> Vec<ServiceResponse> {
        let end = self.now + us;
        let mut answers = vec![];
        while self.now < end {
            self.now += MS;
            let frames = self.poll(None);
            answers.extend(frames.iter().filter_map(answer));
        }
        answers
    }

    /// Sends a request and gives the answers to it.
    fn send(&mut self, request: ServiceRequest) -> Vec<ServiceResponse> {
        self.now += MS;
        let frames = self.poll(Some(&Message::ServiceRequest(request).emit(STATION, true)));
        frames.iter().filter_map(answer).collect()
    }

    /// What the module answers, now or within a second.
    fn ask_raw(&mut self, operation: u8, index: u8, value: u32) -> (u8, u32) {
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        let request = ServiceRequest { destination: self.service.node, operation, sequence, index, value };
        let mut answers = self.send(request);
        for _ in 0..1000 {
            if !answers.is_empty() {
                break;
            }
            answers = self.run(MS);
        }
        assert_eq!(answers.len(), 1, "{request:?}");
        let ServiceResponse { code, value, .. } = answers[0];
        assert_eq!(answers[0], ServiceResponse { operation, sequence, code, index, value });
        (code, value)
    }

    fn ask(&mut self, operation: Operation, index: u8, value: u32) -> Result<u32, ServiceCode> {
        let (code, value) = self.ask_raw(operation as u8, index, value);
        match ServiceCode::from_number(code).unwrap() {
            ServiceCode::Ok => Ok(value),
            code => Err(code),
        }
    }

    fn read(&mut self, register: Register, offset: u8) -> u32 {
        self.ask(Operation::Read, register.spec().first + offset, 0).unwrap()
    }

    fn write(&mut self, register: Register, offset: u8, value: u32) -> Result<u32, ServiceCode> {
        self.ask(Operation::Write, register.spec().first + offset, value)
    }

    fn arm(&mut self) {
        assert_eq!(self.ask(Operation::Arm, 0, 1), Ok(0));
        assert!(self.controller.armed());
    }

    /// Has it hear module `node`.
    fn hears(&mut self, node: u8) {
        let state = State::new(0, Health::SENSORS_PLAUSIBLE, &[0.0; 4]);
        self.poll(Some(&Message::State(state).emit(node, true)));
    }
}

fn answer(frame: &Frame) -> Option<ServiceResponse> {
    match Message::parse(frame) {
        Ok(Message::ServiceResponse(response)) => Some(response),
        _ => None,
    }
}

#[test]
fn who_is_asked_answers_and_nobody_else() {
    let image = image();
    let mut module = Module::new(&image);
    let request = |destination| ServiceRequest {
        destination,
        operation: Operation::Hello as u8,
        sequence: 9,
        index: 4,
        value: 0,
    };
    assert_eq!(module.send(request(NODE + 1)), []);
    let crc = Policy::parse(&image).unwrap().crc();
    for destination in [NODE, ALL_MODULES] {
        assert_eq!(module.send(request(destination)), [request(destination).answer(ServiceCode::Ok, crc)]);
    }
    // Only the station may ask.
    let frame = Message::ServiceRequest(request(NODE)).emit(STATION, true);
    let frame = Frame { id: Function::ServiceRequest.id(2), ..frame };
    assert!(module.poll(Some(&frame)).iter().filter_map(answer).next().is_none());
}

#[test]
fn hello_says_who_it_is() {
    let image = image();
    let mut module = Module::new(&image);
    let versions = module.ask(Operation::Hello, 0, 0).unwrap().to_le_bytes();
    assert_eq!(versions, [PROTOCOL_VERSION, FIRMWARE_VERSION, node_page::VERSION as u8, 8]);
    let id = [1, 2, 3].map(|item| module.ask(Operation::Hello, item, 0).unwrap());
    assert_eq!(id, UNIQUE_ID);
    assert_eq!(module.ask(Operation::Hello, 5, 0).unwrap() >> 16, 1, "the first start");
    assert_eq!(module.ask(Operation::Hello, 6, 0), Err(ServiceCode::NoSuchRegister));
}

/// Every operation has an answer, and what moves or forgets anything is refused while armed.
#[test]
fn while_armed_nothing_is_moved_or_forgotten() {
    let image = image();
    let mut module = Module::new(&image);
    let zero = Register::EncoderZero.spec().first;
    let node = Register::Node.spec().first;
    module.arm();
    for operation in 0..=255u8 {
        let (index, value) = match Operation::from_number(operation) {
            Some(Operation::Disarm) => continue,
            Some(Operation::Write) => (zero, 5),
            Some(Operation::SetNode) => (3, 2),
            Some(Operation::Jog) => (0, 100 << 16 | 100),
            _ => (0, 0),
        };
        if operation == Operation::SetNode as u8 {
            for (index, word) in (0..).zip(UNIQUE_ID) {
                assert_eq!(module.ask(Operation::SetNode, index, word), Ok(0));
            }
        }
        let (code, _) = module.ask_raw(operation, index, value);
        let expected = match Operation::from_number(operation) {
            None => ServiceCode::UnknownOperation,
            Some(
                Operation::Clear
                | Operation::Write
                | Operation::Store
                | Operation::SetNode
                | Operation::Jog
                | Operation::ClearLog
                | Operation::Restart
                | Operation::Update,
            ) => ServiceCode::Armed,
            Some(Operation::UpdateLog) => ServiceCode::NoSuchRegister,
            Some(_) => ServiceCode::Ok,
        };
        assert_eq!(ServiceCode::from_number(code), Some(expected), "operation {operation}");
        assert!(module.controller.armed());
    }
    module.run(200 * MS);
    assert!(!module.service.restart_due(module.now));
    assert_eq!(module.service.page, page());
    assert_eq!(read_page(module.board.storage()), Ok(page()));
    // One that may be written at any time.
    assert_eq!(module.write(Register::Token, 0, 77), Ok(77));
    assert_eq!(module.ask(Operation::Disarm, 0, 0), Ok(0));
    assert!(!module.controller.armed());
    assert_eq!(module.write(Register::EncoderZero, 0, 5), Ok(5));
    assert_eq!(module.ask(Operation::Write, node, 2), Ok(2));
}

#[test]
fn every_register_is_read_and_no_other() {
    let image = image();
    let mut module = Module::new(&image);
    for number in 0..=255 {
        let read = module.ask(Operation::Read, number, 0);
        match Register::by_number(number) {
            Some((_, spec, _)) => assert!(read.is_ok(), "{number} {spec:?}: {read:?}"),
            None => assert_eq!(read, Err(ServiceCode::NoSuchRegister), "{number}"),
        }
    }
    // Each from where it comes.
    let float = |module: &mut Module<'_>, register, offset| f32::from_bits(module.read(register, offset));
    assert_eq!([0, 1, 2, 3].map(|i| module.read(Register::EncoderRaw, i)), [1, 2, u32::MAX, 4]);
    assert_eq!([0, 1, 2, 3].map(|i| module.read(Register::EncoderErrors, i)), [10, 11, 12, 13]);
    assert_eq!([0, 1, 2].map(|i| float(&mut module, Register::Acceleration, i)), [0.1, 0.2, 0.3]);
    assert_eq!([0, 1, 2].map(|i| float(&mut module, Register::Rate, i)), [0.4, 0.5, 0.6]);
    assert_eq!([0, 1, 2].map(|i| float(&mut module, Register::Up, i)), [0.0, 0.0, 1.0]);
    assert_eq!(float(&mut module, Register::Supply, 0), 12.5);
    assert_eq!([0, 1].map(|i| float(&mut module, Register::Temperature, i)), [30.0, 31.5]);
    assert_eq!([0, 1].map(|i| float(&mut module, Register::Current, i)), [0.25, -0.5]);
    module.controller.set_power(Power { supply: None, trips: [None, Some(Trip::Output)] });
    module.run(5 * MS);
    assert_eq!([0, 1].map(|i| module.read(Register::Trip, i)), [0, 3]);
    assert_eq!([0, 1].map(|i| module.read(Register::Trips, i)), [0, 1]);
    let counts = [Register::ImuErrors, Register::RxOverflow, Register::Aborted, Register::Tec, Register::Rec];
    assert_eq!(counts.map(|register| module.read(register, 0)), [14, 15, 16, 17, 18]);
    assert_eq!([Register::TxLost, Register::BusOffs].map(|register| module.read(register, 0)), [19, 20]);
    assert_eq!([0, 1, 2].map(|i| module.read(Register::UniqueId, i)), UNIQUE_ID);
    assert_eq!(module.read(Register::Alive, 0), 1 << NODE);
    assert_eq!(module.read(Register::Uptime, 0), (module.now / 1000) as u32);
}

fn middle(spec: &Spec) -> u32 {
    let (low, high) = spec.range();
    spec.kind.bits(match spec.kind {
        Kind::F32 => (low + high) / 2.0,
        _ => ((low + high) / 2.0).floor(),
    })
}

#[test]
fn what_is_written_is_read_and_what_cannot_be_is_refused() {
    let image = image();
    let mut module = Module::new(&image);
    for number in 0..=255 {
        let Some((register, spec, _)) = Register::by_number(number) else {
            assert_eq!(module.ask(Operation::Write, number, 0), Err(ServiceCode::NoSuchRegister), "{number}");
            continue;
        };
        if spec.access == Access::ReadOnly {
            assert_eq!(module.ask(Operation::Write, number, 0), Err(ServiceCode::ReadOnly), "{register:?}");
            continue;
        }
        let before = module.ask(Operation::Read, number, 0);
        let (low, high) = spec.range();
        let outside = match spec.kind {
            Kind::F32 => {
                let [low, high] = [low, high].map(|end| end as f32);
                vec![low.next_down(), high.next_up(), f32::NAN, f32::INFINITY, f32::NEG_INFINITY]
                    .into_iter()
                    .map(f32::to_bits)
                    .collect()
            }
            _ if high == f64::from(u32::MAX) => vec![],
            _ => vec![high as u32 + 1, u32::MAX],
        };
        for value in outside {
            assert_eq!(module.ask(Operation::Write, number, value), Err(ServiceCode::OutOfRange), "{register:?}");
            assert_eq!(module.ask(Operation::Read, number, 0), before);
        }
        for value in [spec.kind.bits(low), middle(spec)] {
            let value = if register == Register::Modules { 8 } else { value };
            let value = if register == Register::Node { value % 8 } else { value };
            assert_eq!(module.ask(Operation::Write, number, value), Ok(value), "{register:?}");
            assert_eq!(module.ask(Operation::Read, number, 0), Ok(value), "{register:?}");
        }
    }
    // Every number kept its own value: none is written in another's place.
    for number in 0..=255 {
        if let Some((register, spec, _)) = Register::by_number(number)
            && spec.is_stored()
            && ![Register::Modules, Register::Node].contains(&register)
        {
            assert_eq!(module.ask(Operation::Read, number, 0), Ok(middle(spec)), "{register:?}");
        }
    }
}

#[test]
fn a_page_is_stored_and_counts_from_the_next_start_on() {
    let image = image();
    let mut module = Module::new(&image);
    assert_eq!(module.read(Register::PageChanged, 0), 0);
    module.write(Register::EncoderZero, 2, 777).unwrap();
    module.write(Register::JointMin, 1, (-1.25f32).to_bits()).unwrap();
    module.write(Register::EncoderReversed, 0, 1).unwrap();
    assert_eq!(module.read(Register::PageChanged, 0), 1);
    assert_eq!(read_page(module.board.storage()), Ok(page()), "not before it is stored");
    assert_eq!(module.ask(Operation::Store, 0, 0), Ok(0));
    assert_eq!(module.read(Register::PageChanged, 0), 0);
    let stored = read_page(module.board.storage()).unwrap();
    let mut expected = page();
    expected.calibration.joints[2].zero = 777;
    expected.calibration.joints[0].reversed = true;
    expected.safety.joints[1].min = -1.25;
    assert_eq!(stored, expected);
    assert!(is_doubled(module.board.storage()));

    // What was not stored is forgotten.
    module.write(Register::EncoderZero, 2, 1).unwrap();
    let mut module = Module::with_flash(&image, module.board.storage.flash.clone());
    assert_eq!(module.read(Register::EncoderZero, 2), 777);
    assert_eq!(module.read(Register::Boots, 0), 2);
}

#[test]
fn while_a_page_is_stored_it_does_not_change() {
    let image = image();
    let mut module = Module::new(&image);
    module.write(Register::EncoderZero, 0, 11).unwrap();
    let request = |operation: Operation, index, value| ServiceRequest {
        destination: NODE,
        operation: operation as u8,
        sequence: 102,
        index,
        value,
    };
    assert_eq!(module.send(request(Operation::Store, 0, 0)), []);
    let zero = Register::EncoderZero.spec().first;
    let busy =
        [request(Operation::Store, 0, 0), request(Operation::Write, zero, 12), request(Operation::Restart, 0, 0)];
    let mut answers: Vec<_> = busy.into_iter().flat_map(|request| module.send(request)).collect();
    answers.extend(module.run(10 * MS));
    let expected = busy.map(|request| request.answer(ServiceCode::Busy, 0));
    assert_eq!(answers[..3], expected);
    assert_eq!(answers[3..], [request(Operation::Store, 0, 0).answer(ServiceCode::Ok, 0)]);
    assert_eq!(read_page(module.board.storage()).unwrap().calibration.joints[0].zero, 11);
}

#[test]
fn no_page_is_stored_during_a_jog_and_no_jog_begun_during_a_store() {
    let image = image();
    let mut module = Module::new(&image);
    module.run(500 * MS);
    assert!(module.ask(Operation::Jog, 0, jog(300, 100)).is_ok());
    assert_eq!(module.ask(Operation::Store, 0, 0), Err(ServiceCode::Busy));
    module.run(200 * MS);
    let request = |operation: Operation, value| ServiceRequest {
        destination: NODE,
        operation: operation as u8,
        sequence: module.sequence,
        index: 0,
        value,
    };
    let (store, begun) = (request(Operation::Store, 0), request(Operation::Jog, jog(300, 100)));
    assert_eq!(module.send(store), []);
    assert_eq!(module.send(begun), [begun.answer(ServiceCode::Busy, 0)]);
    assert_eq!(module.run(20 * MS), [store.answer(ServiceCode::Ok, 0)]);
    assert!(module.ask(Operation::Jog, 0, jog(300, 100)).is_ok());
}

#[test]
fn a_page_that_does_not_fit_together_is_refused_by_the_register() {
    let image = image();
    let bad = |register: Register, value: f32| (register, register.spec().first, value.to_bits());
    let cases = [
        bad(Register::ImuMounting, 0.5),
        bad(Register::CutOff, 150.0),
        bad(Register::TorqueConstant, 0.0),
        bad(Register::SenseRange, 0.0),
        bad(Register::SupplyOver, 9.6),
        (Register::DeadMan, Register::DeadMan.spec().first, 100),
    ];
    for (register, number, value) in cases {
        let mut module = Module::new(&image);
        assert_eq!(module.ask(Operation::Write, number, value), Ok(value), "{register:?}");
        assert_eq!(module.ask_raw(Operation::Store as u8, 0, 0), (ServiceCode::OutOfRange as u8, number.into()));
        assert_eq!(read_page(module.board.storage()), Ok(page()));
    }
}

/// What [`NodePage::check`] complains about has a register to blame.
#[test]
fn every_field_that_can_be_wrong_has_its_register() {
    let mut blamed = std::collections::BTreeSet::new();
    for number in 0..=255u8 {
        let Some((register, spec, offset)) = Register::by_number(number).filter(|(_, spec, _)| spec.is_stored()) else {
            continue;
        };
        for value in [0u32, 255, 100, u16::MAX.into(), 0f32.to_bits(), 1e9f32.to_bits(), f32::NAN.to_bits()] {
            let mut page = page();
            set(&mut page, register, offset, value);
            if let Err(error) = page.check() {
                let blame = culprit(&error);
                assert_ne!(blame, 0, "{error:?}");
                blamed.insert(blame);
                // A limit that is out of order with another may be blamed on either.
                let related = [Register::Node, Register::Modules, Register::CurrentLimit, Register::CutOff];
                let supply = [Register::SupplyUnder, Register::SupplyOver, Register::SenseRange, Register::SenseZero];
                let either = |r: &Register| r.spec().first == blame;
                assert!(blame == spec.first || related.iter().chain(&supply).any(either), "{register:?}: {error:?}");
            }
        }
    }
    let missing: Vec<_> = FIELDS.iter().filter(|(_, r)| !blamed.contains(&r.spec().first)).collect();
    assert!(missing.is_empty(), "{missing:?} cannot be wrong");
}

#[test]
fn a_flash_that_fails_is_said_and_the_old_page_stays() {
    let image = image();
    let mut module = Module::new(&image);
    module.write(Register::EncoderZero, 0, 11).unwrap();
    module.board.storage.left = 3;
    assert_eq!(module.ask(Operation::Store, 0, 0), Err(ServiceCode::StorageFailed));
    assert_eq!(module.read(Register::StorageErrors, 0), 1);
    assert_eq!(module.read(Register::PageChanged, 0), 1);
    assert_eq!(read_page(module.board.storage()), Ok(page()));
}

/// The power goes while the page is erased or written: the module starts with the old or the new page, and mends what was cut short.
#[test]
fn a_store_that_was_cut_short_leaves_the_old_or_the_new_page() {
    let image = image();
    let mut started = Module::new(&image);
    started.write(Register::Node, 0, 6).unwrap();
    let (mut old, mut new) = (0, 0);
    for left in (0..190).step_by(3) {
        let mut storage = started.board.storage.clone();
        storage.left = left;
        let mut module = Module::with_flash(&image, storage.flash.clone());
        module.write(Register::Node, 0, 6).unwrap();
        module.board.storage.left = left;
        let answered = module.ask(Operation::Store, 0, 0);
        let mut module = Module::with_flash(&image, module.board.storage.flash.clone());
        match module.read(Register::Node, 0) {
            3 => old += 1,
            6 => new += 1,
            other => panic!("{other} after {left}"),
        }
        assert!(answered.is_err() || module.read(Register::Node, 0) == 6);
        assert!(is_doubled(module.board.storage()), "mended after {left}");
    }
    assert!(old > 10 && new > 10, "{old} {new}");
}

#[test]
fn a_number_is_given_by_the_unique_identifier() {
    let image = image();
    let mut module = Module::new(&image);
    module.hears(5);
    let select = |module: &mut Module<'_>| {
        for (index, word) in (0..).zip(UNIQUE_ID) {
            assert_eq!(module.ask(Operation::SetNode, index, word), Ok(0));
        }
    };
    // Nobody was chosen, another one was, or it is too long ago.
    assert_eq!(module.ask(Operation::SetNode, 3, 2), Err(ServiceCode::WrongModule));
    select(&mut module);
    assert_eq!(module.ask(Operation::SetNode, 1, 1), Err(ServiceCode::WrongModule));
    assert_eq!(module.ask(Operation::SetNode, 3, 2), Err(ServiceCode::WrongModule));
    select(&mut module);
    module.run(SELECTED_US);
    assert_eq!(module.ask(Operation::SetNode, 3, 2), Err(ServiceCode::WrongModule));
    module.hears(5);
    select(&mut module);
    assert_eq!(module.ask(Operation::SetNode, 3, 8), Err(ServiceCode::OutOfRange), "the robot has 8");
    assert_eq!(module.ask(Operation::SetNode, 3, 5), Err(ServiceCode::WrongModule), "5 is on the bus");
    assert_eq!(module.write(Register::Node, 0, 5), Err(ServiceCode::WrongModule));
    assert_eq!(module.ask(Operation::SetNode, 4, 0), Err(ServiceCode::NoSuchRegister));
    assert_eq!(read_page(module.board.storage()), Ok(page()));
    assert_eq!(module.ask(Operation::SetNode, 3, 2), Ok(2));
    assert_eq!(read_page(module.board.storage()).unwrap().node, 2);
    // It counts from the next start on.
    assert_eq!(module.controller.config().node, 3);
    assert_eq!(module.ask(Operation::Restart, 0, 0), Ok(0));
    assert!(!module.service.restart_due(module.now));
    module.run(100 * MS);
    assert!(module.service.restart_due(module.now));
    let module = Module::with_flash(&image, module.board.storage.flash.clone());
    assert_eq!(module.controller.config().node, 2);
}

#[test]
fn a_module_with_a_twin_takes_its_new_number_in_silence() {
    let image = image();
    let mut module = Module::new(&image);
    for _ in 0..100 {
        let cycle = module.controller.cycle() as u8;
        let state = State::new(cycle, Health::SENSORS_PLAUSIBLE, &[0.0; 4]);
        module.poll(Some(&Message::State(state).emit(NODE, true)));
        module.run(20 * MS);
    }
    assert!(module.controller.silenced());
    let words = UNIQUE_ID.into_iter().chain([6]);
    for (index, value) in (0..).zip(words) {
        let operation = Operation::SetNode as u8;
        let request = ServiceRequest { destination: ALL_MODULES, operation, sequence: index, index, value };
        assert_eq!(module.send(request), []);
    }
    assert_eq!(module.run(50 * MS), []);
    assert_eq!(read_page(module.board.storage()).unwrap().node, 6);
}

#[test]
fn of_two_stations_at_work_the_second_is_refused() {
    let image = image();
    let mut module = Module::new(&image);
    let zero = Register::EncoderZero.spec().first;
    let request = |sequence, operation: Operation, value| ServiceRequest {
        destination: NODE,
        operation: operation as u8,
        sequence,
        index: zero,
        value,
    };
    let code = |module: &mut Module<'_>, sequence, operation| {
        let answers = module.send(request(sequence, operation, 1));
        ServiceCode::from_number(answers[0].code).unwrap()
    };
    use ServiceCode::{AnotherStation, Ok};
    // A single command keeps nobody out.
    assert_eq!(code(&mut module, 10, Operation::Write), Ok);
    assert_eq!(code(&mut module, 200, Operation::Write), Ok);
    // One that works does: it counts on, with gaps and repetitions.
    let mut sequence = 200u8;
    for _ in 0..20 {
        sequence = sequence.wrapping_add(3);
        assert_eq!(code(&mut module, sequence, Operation::Write), Ok);
        assert_eq!(code(&mut module, sequence, Operation::Read), Ok);
        module.run(200 * MS);
        assert_eq!(code(&mut module, sequence.wrapping_sub(2), Operation::Write), Ok);
    }
    let other = sequence.wrapping_add(100);
    for operation in [Operation::Write, Operation::Arm, Operation::Clear, Operation::ClearLog, Operation::Restart] {
        assert_eq!(code(&mut module, other, operation), AnotherStation, "{operation:?}");
    }
    for operation in [Operation::Read, Operation::Identify, Operation::Disarm] {
        assert_eq!(code(&mut module, other, operation), Ok, "{operation:?}");
    }
    // Requests to others count, too.
    for i in 0..30u8 {
        let elsewhere = ServiceRequest { destination: 1, ..request(sequence.wrapping_add(i), Operation::Write, 1) };
        assert_eq!(module.send(elsewhere), []);
    }
    assert_eq!(code(&mut module, sequence.wrapping_add(30), Operation::Write), Ok);
    assert_eq!(code(&mut module, other, Operation::Write), AnotherStation);
    // When it has gone, the other one may.
    module.run(STATION_US);
    assert_eq!(code(&mut module, other, Operation::Write), Ok);
}

#[test]
fn faults_are_logged_and_outlive_the_power() {
    let image = image();
    let mut module = Module::new(&image);
    module.board.raw.temperatures = [40.0, 91.5];
    module.sensors.temperature = 91.5;
    module.run(5 * MS);
    let hot_at = (module.now / 1000) as u32;
    // Of a fault that comes and goes there is one entry in ten seconds.
    for _ in 0..5 {
        module.sensors.temperature = 25.0;
        module.run(5 * MS);
        module.sensors.temperature = 91.5;
        module.run(5 * MS);
    }
    let word = |module: &mut Module<'_>, entry, word| module.ask(Operation::Log, entry, word);
    let number = word(&mut module, 0, 0).unwrap();
    let time = word(&mut module, 0, 1).unwrap();
    assert!((hot_at - 5..=hot_at).contains(&time), "{time}");
    assert_eq!(word(&mut module, 0, 2), Ok(37 << 16 | 1));
    assert_eq!(word(&mut module, 0, 3), Ok(915));
    assert_eq!(word(&mut module, 0, 4), Err(ServiceCode::NoSuchRegister));
    // The entry before is the start.
    assert_eq!(word(&mut module, 1, 0), Ok(number - 1));
    assert_eq!(word(&mut module, 1, 2), Ok(1));
    assert_eq!(word(&mut module, 2, 0), Err(ServiceCode::NoSuchRegister));
    assert_eq!(module.read(Register::LogNewest, 0), number);

    let mut module = Module::with_flash(&image, module.board.storage.flash.clone());
    assert_eq!(word(&mut module, 0, 2), Ok(2), "the second start");
    assert_eq!(word(&mut module, 1, 2), Ok(37 << 16 | 1));
    // An entry that is written between the words of another does no harm.
    assert_eq!(word(&mut module, 1, 0), Ok(number));
    module.sensors.temperature = 91.5;
    module.run(20 * MS);
    assert_eq!(word(&mut module, 1, 3), Ok(915));
    assert_eq!(word(&mut module, 1, 0), Ok(number + 1));
    assert_eq!(module.ask(Operation::ClearLog, 0, 0), Ok(0));
    module.run(20 * MS);
    assert_eq!(word(&mut module, 0, 2), Ok(2));
    assert_eq!(word(&mut module, 1, 0), Err(ServiceCode::NoSuchRegister));
}

/// The value of JOG.
fn jog(milliamperes: i16, ms: u16) -> u32 {
    u32::from(milliamperes as u16) | u32::from(ms) << 16
}

#[test]
fn one_axis_is_jogged_within_its_limits_and_for_a_limited_time() {
    let image = image();
    let mut module = Module::new(&image);
    module.run(500 * MS);
    // 79 torque units an ampere, the wires swapped.
    let torque = module.ask(Operation::Jog, 1, jog(300, 400)).map(f32::from_bits);
    assert_eq!(torque, Ok(-79.0 * 0.3));
    assert_eq!(module.controller.mode(), Mode::Service);
    let slew = module.controller.policy().limits().torque_slew.min(page().safety.caps.torque_slew);
    let (start, mut before, mut reached) = (module.now, 0.0f32, 0.0f32);
    while module.controller.mode() == Mode::Service {
        module.run(MS);
        let [yaw, pitch] = module.controller.torque();
        assert_eq!(yaw, 0.0);
        assert!(pitch == 0.0 || (pitch - before).abs() <= slew * 2.1e-3, "from {before} to {pitch}");
        (before, reached) = (pitch, reached.min(pitch));
    }
    assert_eq!(reached, -79.0 * 0.3);
    assert!((398 * MS..=402 * MS).contains(&(module.now - start)), "{}", module.now - start);
    assert_eq!((module.controller.torque(), module.controller.mode()), ([0.0; 2], Mode::Disarmed));

    // What it does not take.
    for (axis, value, code) in [
        (2, jog(100, 100), ServiceCode::NoSuchRegister),
        (0, jog(601, 100), ServiceCode::OutOfRange),
        (0, jog(-601, 100), ServiceCode::OutOfRange),
        (0, jog(100, 2001), ServiceCode::OutOfRange),
    ] {
        assert_eq!(module.ask(Operation::Jog, axis, value), Err(code), "{axis} {value:#x}");
        assert_ne!(module.controller.mode(), Mode::Service);
    }
}

#[test]
fn a_jog_does_not_push_a_joint_beyond_its_end() {
    let image = image();
    let mut module = Module::new(&image);
    module.run(500 * MS);
    let outwards = |module: &mut Module<'_>, angle| {
        module.sensors.joint_angles[2] = angle;
        module.ask(Operation::Jog, 0, jog(300, 300)).unwrap();
        module.run(200 * MS);
        module.controller.torque()[0]
    };
    // The end of joint 2 is at 1.5 rad, and outward torque falls over the last tenth.
    assert_eq!(outwards(&mut module, 1.3), 24.0);
    let near = outwards(&mut module, 1.45);
    assert!(near > 0.0 && near < 13.0, "{near}");
    assert_eq!(outwards(&mut module, 1.51), 0.0);
    assert_eq!(module.controller.mode(), Mode::Service);
    // Inwards it may be driven back.
    module.ask(Operation::Jog, 0, jog(-300, 300)).unwrap();
    module.run(200 * MS);
    assert_eq!(module.controller.torque()[0], -24.0);
}

#[test]
fn a_jog_ends_by_a_command_a_stop_or_a_fault() {
    let image = image();
    let mut module = Module::new(&image);
    module.run(500 * MS);
    let ends: [fn(&mut Module<'_>); 5] = [
        |module| assert_eq!(module.ask(Operation::Jog, 0, jog(0, 100)), Ok(0)),
        |module| assert_eq!(module.ask(Operation::Disarm, 0, 0), Ok(0)),
        |module| module.arm(),
        |module| module.sensors.temperature = 95.0,
        |module| module.controller.emergency_stop(0),
    ];
    for (i, end) in ends.into_iter().enumerate() {
        assert_eq!(module.ask(Operation::Jog, 0, jog(300, 2000)).map(f32::from_bits), Ok(24.0));
        module.run(100 * MS);
        assert!(module.controller.torque()[0] > 5.0);
        end(&mut module);
        module.run(3 * MS);
        assert_ne!(module.controller.mode(), Mode::Service, "end {i}");
        assert!(module.controller.torque()[0] == 0.0 || module.controller.armed(), "end {i}");
        module.sensors.temperature = 25.0;
        module.controller.disarm();
        module.run(20 * MS);
    }
    // Stopped: no jog before the release.
    assert_eq!(module.ask(Operation::Jog, 0, jog(100, 100)), Err(ServiceCode::NotArmable));
    module.controller.release();
    module.run(3 * MS);
    assert!(module.ask(Operation::Jog, 0, jog(100, 100)).is_ok());
}

#[test]
fn the_light_flashes_for_as_long_as_was_asked() {
    let image = image();
    let mut module = Module::new(&image);
    assert_eq!(module.service.light(module.now), None);
    assert_eq!(module.ask(Operation::Identify, 0, 601), Err(ServiceCode::OutOfRange));
    assert_eq!(module.ask(Operation::Identify, 0, 2), Ok(0));
    let start = module.now;
    let seen: Vec<_> = (0..2000).map(|ms| module.service.light(start + ms * MS)).collect();
    assert!(seen.iter().all(Option::is_some));
    assert_eq!(seen.windows(2).filter(|pair| pair[0] != pair[1]).count(), 20);
    assert_eq!(module.service.light(start + 2000 * MS), None);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if cfg!(debug_assertions) { 16 } else { 200 }))]

    /// Any requests at all: one answer to each at most, never a page that cannot be, and while armed neither page nor flash change.
    #[test]
    fn any_requests_at_all(requests in prop::collection::vec((0u8..16, any::<u8>(), any::<u32>(), 0u8..3, any::<u8>()), 1..200)) {
        let image = image();
        let mut module = Module::new(&image);
        for (operation, index, value, kind, jump) in requests {
            module.sequence = module.sequence.wrapping_add(if jump < 250 { 1 } else { jump });
            // Values that mean something, too.
            let value = match kind {
                0 => value,
                1 => value % 16,
                _ => f32::to_bits((value % 2000) as f32 / 1000.0 - 1.0),
            };
            let index = if jump & 1 == 0 { index } else { index % 4 };
            let destination = if jump < 230 { NODE } else { jump % 64 };
            let before = (module.service.page, read_page(module.board.storage()));
            let armed = module.controller.armed();
            let request = ServiceRequest { destination, operation, sequence: module.sequence, index, value };
            let mut answers = module.send(request);
            answers.extend(module.run(20 * MS));
            prop_assert!(answers.len() <= 1 && (destination == NODE) == (answers.len() == 1), "{request:?}: {answers:?}");
            if armed && operation != Operation::Disarm as u8 {
                prop_assert_eq!((module.service.page, read_page(module.board.storage())), before);
            }
            let stored = read_page(module.board.storage());
            prop_assert!(stored.is_ok_and(|page| page.check().is_ok()));
            prop_assert!(Mode::from_number(module.controller.mode() as u8).is_some());
        }
    }
}

/// Frames of an update, as a station sends them.
fn send_policy(module: &mut Module<'_>, package: &[u8], classic: bool) -> Result<u32, ServiceCode> {
    let session = session(package);
    module.step(UpdateStep::Begin, u32::from(session) | (package.len() as u32) << 16)?;
    for number in 0..chunks(package.len()) as u16 {
        let chunk = ChunkRepr::of(package, session, number).unwrap();
        let messages: Vec<Message> = match classic {
            false => vec![Message::UpdateChunk(chunk)],
            true => chunk.pieces().map(|piece| Message::UpdatePiece(Piece(piece))).to_vec(),
        };
        for message in messages {
            module.now += MS;
            module.poll(Some(&message.emit(STATION, !classic)));
        }
    }
    module.step(UpdateStep::Verify, 0)
}

impl Module<'_> {
    fn step(&mut self, step: UpdateStep, value: u32) -> Result<u32, ServiceCode> {
        self.ask(Operation::Update, step as u8, value)
    }

    fn remark(&mut self) -> u8 {
        self.controller.heartbeat().mode & !15
    }
}

#[test]
fn a_policy_is_received_tried_and_confirmed_over_the_bus() {
    for classic in [false, true] {
        let old = image();
        let mut module = Module::new(&old);
        let new = package(&update_image(2), 7, None);
        let crc = send_policy(&mut module, &new, classic).unwrap();
        assert_eq!((module.ask(Operation::UpdateStatus, 16, 0), module.remark()), (Ok(3), Heartbeat::LAB));
        assert_eq!(module.step(UpdateStep::Confirm, crc), Err(ServiceCode::NoUpdate), "it runs with another");
        assert_eq!(module.step(UpdateStep::Commit, crc), Ok(crc));
        assert_eq!(module.ask(Operation::UpdateStatus, 16, 0), Ok(4));
        assert_eq!(module.ask(Operation::Restart, 0, 0), Ok(0));
        // The next start.
        let flash = module.board.policies.clone();
        let fresh = update_image(2);
        let mut module = Module::on_trial(&fresh, flash);
        assert_eq!(module.remark(), Heartbeat::LAB | Heartbeat::TRIAL);
        assert_eq!(module.ask(Operation::Arm, 0, 0), Err(ServiceCode::OnTrial));
        assert_eq!(module.step(UpdateStep::Begin, 1000 << 16), Err(ServiceCode::OnTrial));
        assert_eq!(module.step(UpdateStep::Confirm, crc), Ok(crc));
        assert_eq!((module.remark(), module.ask(Operation::Arm, 0, 0)), (Heartbeat::LAB, Ok(0)));
        // What happened, the newest first.
        let log: Vec<_> = (0..5).map(|back| module.ask(Operation::UpdateLog, back, 0)).collect();
        let low = crc & 0x00ff_ffff;
        let record = |kind: RecordKind, value: u32| Ok(kind as u32 | 1 << 4 | value << 8);
        let confirm = record(RecordKind::Confirm, 7);
        let commit = record(RecordKind::Commit, low);
        assert_eq!(log, [confirm, confirm, record(RecordKind::Try, low), commit, Err(ServiceCode::NoSuchRegister)]);
        assert_eq!(module.ask(Operation::UpdateStatus, 17, 0), Ok(7));
    }
}

#[test]
fn a_trial_that_nobody_confirms_ends_with_a_restart() {
    let old = image();
    let mut module = Module::new(&old);
    let new = package(&update_image(2), 0, None);
    let crc = send_policy(&mut module, &new, false).unwrap();
    module.step(UpdateStep::Commit, crc).unwrap();
    let fresh = update_image(2);
    let mut module = Module::on_trial(&fresh, module.board.policies.clone());
    let period = u64::from(module.controller.config().timing.period_us);
    module.run(u64::from(TRIAL_CYCLES) * period);
    assert!(!module.service.restart_due(module.now), "not yet");
    module.run(2 * u64::from(TRIAL_CYCLES) * period);
    assert!(module.service.restart_due(module.now));
    let again = Updater::start(&mut module.board.policies, page().keys, |_, _| true);
    assert!(!again.on_trial());
}

#[test]
fn a_module_with_a_key_takes_no_changes_of_its_page() {
    let old = image();
    let key = test_key(9);
    let mut module = Module::new(&old);
    for (word, bytes) in (0..).zip(key.verifying_key().as_bytes().as_chunks::<4>().0) {
        assert_eq!(module.write(Register::KeyA, word, u32::from_le_bytes(*bytes)), Ok(u32::from_le_bytes(*bytes)));
    }
    assert_eq!(module.ask(Operation::Store, 0, 0), Ok(0));
    let keyed = read_page(&mut module.board.storage).unwrap();
    assert_eq!(keyed.keys, [*key.verifying_key().as_bytes(), [0; 32]]);
    let mut module = Module::with_flash(&old, module.board.storage.flash.clone());
    assert_eq!(module.remark(), 0);
    for (register, value) in [
        (Register::TorqueCap, 1e6f32.to_bits()),
        (Register::KeyA, 0),
        (Register::KeyB, 1),
        (Register::JointMax, 3.0f32.to_bits()),
        (Register::DeadMan, 0),
    ] {
        assert_eq!(module.write(register, 0, value), Err(ServiceCode::Locked), "{register:?}");
    }
    assert_eq!(module.write(Register::Node, 0, 4), Ok(4), "who it is may change");
    assert_eq!(module.write(Register::Token, 0, 4), Ok(4));
    let unsigned = package(&update_image(2), 0, None);
    assert_eq!(send_policy(&mut module, &unsigned, false), Err(ServiceCode::Unsigned));
    let signed = package(&update_image(2), 0, Some(&key));
    assert!(send_policy(&mut module, &signed, false).is_ok());
}
