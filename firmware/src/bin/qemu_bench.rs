//! Counts instructions on the emulated Cortex-M4F, part by part; `snakectl bench firmware` runs it and prints the table.
//!
//! Under `qemu-system-arm -M mps2-an386 -icount shift=0` an instruction takes one nanosecond of virtual time, and SysTick counts the
//! board's 25 MHz, so a tick is 40 instructions. Work is repeated until that resolution does not matter, and the loop's own instructions
//! are subtracted. What is printed, one line each, `name = instructions`:
//!
//!     calibration = 1000          (a thousand NOPs)
//!     control_step/8/mean = ...
#![no_std]
#![no_main]

use core::hint::black_box;

use composer_firmware::attitude::Attitude;
use composer_firmware::controller::{Boot, BusKind, Config, Controller};
use composer_firmware::failsafe::{BusOffPolicy, BusStatus};
use composer_firmware::node_page::{Calibration, NodePage};
use composer_firmware::power::Power;
use composer_firmware::safety::Safety;
use composer_firmware::service::{Board, Raw, Service};
use composer_firmware::storage::RamFlash;
use composer_firmware::supply::Extremes;
use composer_firmware::update::{NoPolicies, Updater, verify};
use composer_shared::kinematics::Chain;
use composer_shared::nn::Dense;
use composer_shared::observation::{Motors, Seeker, Sensors, Told, observe};
use composer_shared::policies;
use composer_shared::policy::{IMAGE_SIZE, Latent, Memory, OBS, Policy, Shape, random_image_of};
use composer_shared::random::SplitMix64;
use composer_shared::registers::Register;
use composer_shared::robot::{Geometry, MAX_MODULES};
use composer_shared::sha512::Sha512;
use composer_shared::update::{Key, NO_KEY};
use composer_shared::wire::{
    Frame, Goal, Health, LatentMessage, Message, Operation, STATION, ServiceRequest, State, Sync,
};
use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};
use nalgebra::Vector3;

/// Instructions in one tick of SysTick: 25 MHz, one instruction a nanosecond.
const TICK: u32 = 40;
/// SysTick counts down from here; 24 bits.
const TOP: u32 = 0x00ff_ffff;
/// Repetitions of each part.
const REPETITIONS: u32 = 500;
/// Control cycles of a whole controller; the first few, in which it joins, do not count.
const CYCLES: u16 = 40;
const JOINING: u16 = 5;

/// Frames that a module receives in one control cycle at most: SYNC, GOAL, and STATE and LATENT of each other module.
const FRAMES: usize = 2 * MAX_MODULES;

/// Numbers without a meaning, the same ones every time.
struct Random(SplitMix64);

impl Random {
    fn byte(&mut self) -> u8 {
        self.0.byte()
    }

    fn angle(&mut self) -> f32 {
        f32::from(self.byte() as i8) / 100.0
    }

    fn latent(&mut self) -> Latent {
        Latent { key: [(); 16].map(|()| self.byte() as i8), value: [(); 32].map(|()| self.byte() as i8) }
    }
}

/// Ticks that `work` takes, at most 2^24.
fn ticks(work: impl FnOnce()) -> u32 {
    let before = SYST::get_current();
    work();
    before.wrapping_sub(SYST::get_current()) & TOP
}

/// Ticks that many times `work` takes; always the same code around it.
#[inline(never)]
fn repeat(work: &mut dyn FnMut()) -> u32 {
    ticks(|| (0..REPETITIONS).for_each(|_| work()))
}

/// Instructions of one call of `work`.
fn count<T>(mut work: impl FnMut() -> T) -> u32 {
    let whole = repeat(&mut || {
        // By reference: the copy would count.
        black_box(&work());
    });
    let empty = repeat(&mut || {
        black_box(&());
    });
    ((whole - empty) * TICK + REPETITIONS / 2) / REPETITIONS
}

fn report(name: core::fmt::Arguments<'_>, instructions: u32) {
    hprintln!("{} = {}", name, instructions);
}

fn sensors(random: &mut Random) -> Sensors {
    Sensors {
        joint_angles: [(); 4].map(|()| random.angle()),
        joint_speeds: [(); 4].map(|()| random.angle()),
        up: [0.0, 0.1, 0.99],
        angular_rate: [0.1, -0.2, 0.3],
        torque: [0.2, -0.1],
        temperature: 25.0,
    }
}

/// The parts of a control step by themselves.
#[inline(never)]
fn parts(policy: &Policy<'_>, random: &mut Random) {
    let mut chain = Chain::new(Geometry::default());
    for module in 0..MAX_MODULES {
        chain.hear(module, &[(); 4].map(|()| random.angle()));
    }
    for module in [0, 3, 7, 63] {
        let instructions = count(|| black_box(&chain).head_seen_from(black_box(module)));
        report(format_args!("kinematics/{module}"), instructions);
    }

    let sensors = sensors(random);
    let head = chain.head_seen_from(3);
    // What a module is told at most.
    let points =
        [Some(Vector3::new(12.0, -3.0, 0.5)), Some(Vector3::new(4.0, 1.0, 0.0)), Some(Vector3::new(8.0, 2.0, 0.0))];
    let told = Told { points, seeker: Seeker::Head };
    report(
        format_args!("observation"),
        count(|| observe(black_box(&sensors), &Motors::SOUND, 0.5, black_box(&head), black_box(&told))),
    );

    let mut attitude = Attitude::rested(sensors.up);
    let instructions = count(|| attitude.update(black_box(sensors.angular_rate), black_box([0.3, 0.1, 1.2]), 1e-3));
    report(format_args!("attitude"), instructions);

    let observation = observe(&sensors, &Motors::SOUND, 0.5, &head, &told);
    let mut memory = Memory::EMPTY;
    report(format_args!("encode"), count(|| policy.encode(&mut memory, black_box(&observation))));

    let own = policy.encode(&mut memory, &observation);
    let latents = [(); MAX_MODULES].map(|()| random.latent());
    let mut attend = 0;
    for modules in [8, 16, 32, 64] {
        let heard = u64::MAX >> (64 - modules);
        let instructions = count(|| policy.attend(black_box(&own), black_box(&latents), black_box(heard), 3));
        report(format_args!("attention/{modules}"), instructions);
        if modules == 8 {
            attend = instructions;
        }
    }
    let act = count(|| policy.act(black_box(&own), black_box(&latents), black_box(0xff), None, 3));
    report(format_args!("actor"), act.saturating_sub(attend));

    let state = Message::State(State::new(1, Health::SENSORS_PLAUSIBLE, &[0.1, 0.2, 0.3, 0.4]));
    let latent = Message::Latent(latent_message(policy, 1, own.latent));
    for (name, message) in [("state", state), ("latent", latent)] {
        report(format_args!("emit/{name}"), count(|| black_box(&message).emit(black_box(3), true)));
        let frame = message.emit(3, true);
        report(format_args!("parse/{name}"), count(|| Message::parse(black_box(&frame))));
    }
}

/// A fully connected layer of 64 x 64, requantised, with bias.
fn dense(random: &mut Random) {
    let mut weights = [[0; 64]; 64];
    weights.as_flattened_mut().fill_with(|| random.byte());
    let multipliers = [(); 64].map(|()| [random.byte(), random.byte(), random.byte(), 0x40]);
    let bias = [(); 64].map(|()| [random.byte(), random.byte(), 0, 0]);
    let input = [(); 64].map(|()| i16::from_le_bytes([random.byte(), random.byte()]).max(-32767));
    let layer = Dense { weights: &weights, multipliers: &multipliers, bias: Some(&bias), shift: 37, columns: 64 };
    let mut out = [0; 64];
    report(format_args!("dense64/dsp"), count(|| black_box(&layer).forward(black_box(&input), black_box(&mut out))));
    report(
        format_args!("dense64/portable"),
        count(|| black_box(&layer).forward_portable(black_box(&input), black_box(&mut out))),
    );
}

fn latent_message(policy: &Policy<'_>, cycle: u8, latent: Latent) -> LatentMessage {
    LatentMessage {
        cycle,
        health: Health::SENSORS_PLAUSIBLE,
        policy: policy.tag(),
        key: latent.key,
        value: latent.value,
    }
}

/// What a service needs of a board.
struct Bench(RamFlash<1024>, NoPolicies);

impl Board for Bench {
    type Flash = RamFlash<1024>;
    type Policies = NoPolicies;

    fn policies(&mut self) -> &mut NoPolicies {
        &mut self.1
    }

    fn storage(&mut self) -> &mut Self::Flash {
        &mut self.0
    }

    fn unique_id(&self) -> [u32; 3] {
        [1, 2, 3]
    }

    fn raw(&self) -> Raw {
        Raw::default()
    }
}

/// The service: with a frame that is not for it, and with a request.
#[inline(never)]
fn service(policy: Policy<'_>, random: &mut Random) {
    let Ok(mut controller) = Controller::new(Config::new(3, 8, BusKind::Fd, &policy), policy, Boot::default(), 0)
    else {
        return;
    };
    let page = NodePage {
        node: 3,
        modules: 8,
        bus_off: BusOffPolicy::Recover,
        safety: Safety::BOARD,
        calibration: Calibration::NOMINAL,
        keys: [NO_KEY; 2],
    };
    let mut board = Bench(RamFlash::ERASED, NoPolicies);
    let updater = Updater::start(board.policies(), page.keys, |_, _| false);
    let mut service = Service::new(page, updater, &mut controller, 0, &mut board);
    let sensors = sensors(random);
    while service.is_busy() {
        service.work(&mut controller, &mut board);
    }
    let index = Register::DeadMan.spec().first;
    let request = ServiceRequest { destination: 3, operation: Operation::Read as u8, sequence: 0, index, value: 0 };
    let frames = [
        ("idle", Message::State(State::new(1, Health::SENSORS_PLAUSIBLE, &[0.0; 4])).emit(2, true)),
        ("read", Message::ServiceRequest(request).emit(STATION, true)),
    ];
    for (name, frame) in frames {
        let mut now = 0;
        let instructions = count(|| {
            now += 1;
            service.poll(now, &mut controller, &sensors, Some(black_box(&frame)), &mut board);
            service.next_frame(&controller)
        });
        report(format_args!("service/{name}"), instructions);
    }
}

/// RFC 8032, 7.1, test 3.
const KEY: Key = [
    0xfc, 0x51, 0xcd, 0x8e, 0x62, 0x18, 0xa1, 0xa3, 0x8d, 0xa4, 0x7e, 0xd0, 0x02, 0x30, 0xf0, 0x58, 0x08, 0x16, 0xed,
    0x13, 0xba, 0x33, 0x03, 0xac, 0x5d, 0xeb, 0x91, 0x15, 0x48, 0x90, 0x80, 0x25,
];
const SIGNED: [u8; 2] = [0xaf, 0x82];
const SIGNATURE: [u8; 64] = [
    0x62, 0x91, 0xd6, 0x57, 0xde, 0xec, 0x24, 0x02, 0x48, 0x27, 0xe6, 0x9c, 0x3a, 0xbe, 0x01, 0xa3, 0x0c, 0xe5, 0x48,
    0xa2, 0x84, 0x74, 0x3a, 0x44, 0x5e, 0x36, 0x80, 0xd7, 0xdb, 0x5a, 0xc3, 0xac, 0x18, 0xff, 0x9b, 0x53, 0x8d, 0x16,
    0xf2, 0x90, 0xae, 0x67, 0xf7, 0x60, 0x98, 0x4d, 0xc6, 0x59, 0x4a, 0x7c, 0x15, 0xe9, 0x71, 0x6e, 0xd2, 0x8d, 0xc0,
    0x27, 0xbe, 0xce, 0xea, 0x1e, 0xc4, 0x0a,
];

/// What a new policy costs: its signature, and its digest by the kilobyte.
fn update() {
    let mut good = false;
    let signature = ticks(|| good = verify(black_box(&KEY), black_box(&SIGNED), black_box(&SIGNATURE)));
    if !good {
        return hprintln!("a good signature was refused");
    }
    report(format_args!("update/signature"), signature * TICK);
    let mut sha = Sha512::new();
    let kilobyte = [0x5a; 1024];
    report(
        format_args!("update/kilobyte"),
        ticks(|| (0..16).for_each(|_| sha.update(black_box(&kilobyte)))) * TICK / 16,
    );
    black_box(sha.finalize());
}

/// Whole control steps of the last module among `modules`, fed with the frames of all others and of the station.
#[inline(never)]
fn control_steps(name: &str, policy: Policy<'_>, modules: u8, random: &mut Random) {
    let node = modules - 1;
    let config = Config::new(node, modules, BusKind::Fd, &policy);
    let period = config.timing.period_us;
    let Ok(mut controller) = Controller::new(config, policy, Boot::default(), 0) else { return };
    controller.set_power(Power { supply: Some(Extremes::steady(12.0)), ..Power::default() });
    let armed = controller.arm(false).is_ok();
    let empty = Message::Sync(Sync::new(0, 0, 1)).emit(0, true);
    let mut frames = [empty; FRAMES];
    let (mut sum, mut most) = (0u64, 0);
    for cycle in 0..CYCLES {
        let low = cycle as u8;
        let now = u64::from(period) * (2 + u64::from(cycle));
        let sensors = sensors(random);
        let mut received = 0;
        let mut put = |message: Message, module: u8| {
            frames[received] = message.emit(module, true);
            received += 1;
        };
        put(Message::Sync(Sync::new(cycle, modules, modules)), 0);
        put(Message::Goal(Goal::new(low, 0, Some([12.0, -3.0, 0.5]))), STATION);
        for module in 0..node {
            let angles = [(); 4].map(|()| random.angle());
            put(Message::State(State::new(low, Health::SENSORS_PLAUSIBLE, &angles)), module);
        }
        for module in 0..node {
            put(Message::Latent(latent_message(&policy, low, random.latent())), module);
        }
        let instructions = TICK
            * ticks(|| {
                for (i, frame) in frames.iter().take(received).enumerate() {
                    step(&mut controller, now + i as u64, &sensors, frame);
                }
            });
        if cycle >= JOINING {
            sum += u64::from(instructions);
            most = most.max(instructions);
        }
    }
    let stats = controller.stats();
    let whole =
        armed && controller.armed() && stats.acted + 1 >= u32::from(CYCLES) && stats.stale == 0 && stats.malformed == 0;
    if !whole || controller.heard().count_ones() != u32::from(modules) || stats.deadline_misses != 0 {
        hprintln!("the controller among {} modules did not take part in every cycle: {:?}", modules, stats);
        debug::exit(debug::EXIT_FAILURE);
    }
    report(format_args!("{name}/{modules}/mean"), (sum / u64::from(CYCLES - JOINING)) as u32);
    report(format_args!("{name}/{modules}/max"), most);
}

/// The same of a network that has all there is; its weights do not matter. It lies in RAM only here.
#[inline(never)]
fn control_steps_with_memory(random: &mut Random) {
    let mut image = [0; IMAGE_SIZE];
    random_image_of(Shape::FULL, 1, &mut image);
    let Ok(policy) = Policy::parse(&image) else { return };
    let (mut memory, observation) = (Memory::EMPTY, [0.5; OBS]);
    report(format_args!("encode_memory"), count(|| policy.encode(&mut memory, black_box(&observation))));
    for modules in [8, 16, 32, 64] {
        control_steps("control_step_memory", policy, modules, random);
    }
}

/// What a board does with a frame.
fn step(controller: &mut Controller<'_>, now: u64, sensors: &Sensors, frame: &Frame) {
    black_box(controller.poll(now, sensors, Some(frame), BusStatus::ErrorActive));
    while let Some(frame) = controller.next_frame() {
        black_box(frame);
    }
}

#[entry]
fn main() -> ! {
    if let Some(mut core) = cortex_m::Peripherals::take() {
        core.SYST.set_clock_source(SystClkSource::Core);
        core.SYST.set_reload(TOP);
        core.SYST.clear_current();
        core.SYST.enable_counter();
    }
    report(format_args!("controller_bytes"), size_of::<Controller>() as u32);
    let mut random = Random(SplitMix64(1));
    report(format_args!("calibration"), count(thousand_nops));
    dense(&mut random);
    match policies::shipped("goal-reaching").map(Policy::parse) {
        Some(Ok(policy)) => {
            parts(&policy, &mut random);
            service(policy, &mut random);
            update();
            for modules in [8, 16, 32, 64] {
                control_steps("control_step", policy, modules, &mut random);
            }
            control_steps_with_memory(&mut random);
            debug::exit(debug::EXIT_SUCCESS);
        }
        _ => hprintln!("the shipped policy is not valid"),
    }
    debug::exit(debug::EXIT_FAILURE);
    loop {
        cortex_m::asm::nop();
    }
}

fn thousand_nops() {
    // SAFETY: does nothing, a thousand times.
    unsafe { core::arch::asm!(".rept 1000", "nop", ".endr", options(nomem, nostack, preserves_flags)) }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo) -> ! {
    hprintln!("{}", info);
    debug::exit(debug::EXIT_FAILURE);
    loop {}
}
