//! The image of a module's board: STM32G474RE (Cortex-M4F, 170 MHz) with FDCAN, four joint encoders, an inertial sensor, two motors.
//!
//! # Pins
//!
//! | pin | function | to |
//! |---|---|---|
//! | PF0, PF1 | HSE, 24 MHz crystal | CAN-FD needs better than the internal oscillator |
//! | PA11, PA12 | FDCAN1 RX, TX | CAN-FD transceiver for 5 Mbit/s (for example TCAN1044V), its standby tied low |
//! | PA5, PA6, PA7 | SPI1 SCK, MISO, MOSI, mode 1, 5.3 MHz | four AS5047P, all on this bus |
//! | PC6, PC7, PC8, PC9 | chip selects, low active | encoders of joint 0 to 3, head end first |
//! | PC10, PC11, PC12 | SPI3 SCK, MISO, MOSI, mode 3, 5.3 MHz | LSM6DSO |
//! | PD2 | chip select, low active | LSM6DSO |
//! | PA8, PA9 | TIM1 CH1, CH2, PWM 20 kHz | EN inputs of the bridges: yaw, pitch |
//! | PB4, PB5 | direction | PH inputs of the bridges: yaw, pitch |
//! | PB6, PB7 | enable, with pull-downs on the board | nSLEEP of the bridges: yaw, pitch; low lets the motor coast |
//! | PA0, PA1 | ADC1 IN1, IN2 | current sense of yaw, pitch: an amplifier in the motor line (for example INA240), half the range at no current |
//! | PA2 | ADC1 IN3 | supply voltage over 10 kohm : 1 kohm |
//! | PC4, PC5 | ADC2 IN5, IN11 | thermistors of yaw, pitch: 10 kohm, 3435 K, below 10 kohm |
//! | PB10 | status light | on: running; flashing once: no node page, twice: no policy, three times: no crystal, four times: the number is taken, five times: stopped |
//! | PB11 | stop input, with pull-up | a switch to ground that opens to stop the robot; a bridge where there is none |
//! | PA13, PA14 | SWDIO, SWCLK | debug probe: flashing, and the log (defmt over RTT) |
//!
//! # Who runs when
//!
//! - The interrupt of the ADC, 10,000 times a second: the stop input and the current loops ([`drive`]). Nothing interrupts it ([`board`]).
//! - The interrupts of FDCAN: received frames into a queue, because the chip's own holds only three, a stop past that to the current loops ([`stop`]), and the next frame into a transmit buffer ([`can`]).
//! - The main loop: waits for a frame, the controller's deadline, or the next sample of the sensors a millisecond later; polls the
//!   controller and the service, sets the motors, sends what they offer.
//!
//! The independent watchdog is fed by the main loop and only if the current loops ran since the last time. Anything that stops either
//! resets the chip within [`board::WATCHDOG_US`]; then all pins float and the motors coast. It runs before anything is waited for. If the crystal does not
//! oscillate, the chip runs on its internal oscillator, says so by light and log, and stays off the bus.
//!
//! This image was built and looked at, but has not run on a chip yet.
#![no_std]
#![no_main]

mod board;
mod can;
mod drive;
mod fail;
mod flash;
mod hardware;
mod retained;
mod sense;
mod stop;

use core::cell::RefCell;

use composer_firmware::boot::Boot;
use composer_firmware::controller::{BusKind, Config, ConfigError, Controller, FIRMWARE_VERSION, Timing};
use composer_firmware::light;
use composer_firmware::node_page::NodePage;
use composer_firmware::port::CanPort;
use composer_firmware::service::Service;
use composer_firmware::storage::read_page;
use composer_firmware::update::Updater;
use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::wire::{Fault, Health, Heartbeat, Message, Mode, NOBODY, PROTOCOL_VERSION};
use defmt::Display2Format;
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::adc::{Adc, AdcConfig};
use embassy_stm32::gpio::{Input, Level, Output, Pull, Speed};
use embassy_stm32::spi::{MODE_1, MODE_3, Spi};
use embassy_time::{Duration, Instant, Timer, with_deadline};
use static_cell::StaticCell;

use board::{Board, Watchdog};
use can::Fdcan;
use flash::{Policies, Storage};
use hardware::Hardware;
use sense::Sense;
use stop::TORQUE_OFF;

defmt::timestamp!("{=u64:us}", now());

/// Time between two samples of the sensors; the inertial sensor has a new one every 0.6 ms.
const SAMPLE: Duration = Duration::from_millis(1);
/// Time between two HEARTBEAT frames of a module without a policy. Every one of them makes the others wait for its latent for three
/// cycles, so they are rare.
const REFUSED_HEARTBEAT: Duration = Duration::from_secs(2);

fn now() -> u64 {
    Instant::now().as_micros()
}

#[embassy_executor::main]
async fn main(_spawner: Spawner) -> ! {
    let Board { peripherals: p, mut watchdog, crystal } = board::start();
    let boot = retained::boot();
    defmt::info!("start: cause {=u8}, {=u8} unclean in a row", boot.reason(), boot.resets);
    let mut light = Output::new(p.PB10, Level::Low, Speed::Low);
    if !crystal {
        // CAN-FD needs a better clock: other modules' frames would suffer.
        refuse(light::NO_CRYSTAL, None, &mut light, &mut watchdog).await
    }

    let mut storage = Storage::new(p.FLASH);
    let page = match read_page(&mut storage) {
        Ok(page) => page,
        Err(error) => {
            defmt::error!("{}", Display2Format(&error));
            // Without a number of its own it must not send anything.
            refuse(light::NO_PAGE, None, &mut light, &mut watchdog).await
        }
    };
    defmt::info!("module {=u8} of {=u8}", page.node, page.modules);
    let mut can = Fdcan::new(p.FDCAN1, p.PA11, p.PA12, page.bus_off);
    can.guard(page.node);
    let mut policies = Policies::new(&storage);
    let updater = Updater::start(&mut policies, page.keys, |_, slot| flash::policy(slot).is_ok());
    let started = updater.started();
    if started.trial {
        defmt::info!("the policy in slot {=str} is on trial", started.slot.name());
    }
    let policy = match flash::policy(started.slot) {
        Ok(policy) => policy,
        Err(error) => {
            defmt::error!("{}", Display2Format(&error));
            refuse(light::NO_POLICY, Some((&mut can, page.node)), &mut light, &mut watchdog).await
        }
    };
    can.set_period(policy.control_period_us().into());
    defmt::info!("policy {=u32:08x} for {=str}", policy.crc(), policy.task().name());
    let controller = match make_controller(&page, policy, boot) {
        Ok(controller) => controller,
        Err(error) => {
            defmt::error!("{}", Display2Format(error));
            refuse(light::NO_POLICY, Some((&mut can, page.node)), &mut light, &mut watchdog).await
        }
    };
    light.set_high();

    // Both converters before either is set up further: they share a reset.
    let (adc1, adc2) = (Adc::new(p.ADC1, AdcConfig::default()), Adc::new(p.ADC2, AdcConfig::default()));
    let bridges = drive::Bridges {
        pwm: (p.PA8, p.PA9),
        direction: [p.PB4.into(), p.PB5.into()],
        enable: [p.PB6.into(), p.PB7.into()],
    };
    drive::start(p.TIM1, bridges, adc1, (p.PA0, p.PA1, p.PA2), &page.calibration.motors);
    let encoders = RefCell::new(Spi::new_blocking(p.SPI1, p.PA5, p.PA7, p.PA6, sense::spi_config(MODE_1)));
    let imu = Spi::new_blocking(p.SPI3, p.PC10, p.PC12, p.PC11, sense::spi_config(MODE_3));
    let mut sense = Sense::new(
        (&encoders, [p.PC6.into(), p.PC7.into(), p.PC8.into(), p.PC9.into()]),
        (imu, p.PD2.into()),
        (adc2, p.PC4, p.PC5),
        &page,
        policy.geometry(),
    );
    let mut hardware = Hardware::new(storage, policies);
    let service = make_service(page, updater, controller, &mut hardware);
    TORQUE_OFF.follow(boot.stop);
    drive::watch_stop_input(Input::new(p.PB11, Pull::Up), page.node, can::send_at_once);
    let mut parts = Parts { can: &mut can, sense: &mut sense, hardware: &mut hardware, light: &mut light };
    run(controller, service, policy.limits().torque, &mut parts, &mut watchdog).await
}

/// Makes the controller where it stays. Apart, and not inlined, because it is large: a copy of it in the frame of the main loop would take
/// stack for ever.
#[inline(never)]
fn make_controller(
    page: &NodePage,
    policy: Policy<'static>,
    boot: Boot,
) -> Result<&'static mut Controller<'static>, &'static mut ConfigError> {
    static CONTROLLER: StaticCell<Result<Controller<'static>, ConfigError>> = StaticCell::new();
    let timing = Timing::for_policy(&policy, BusKind::Fd, page.modules).watched_by(board::WATCHDOG_US);
    let settings = Config {
        bus_off: page.bus_off,
        safety: page.safety,
        timing,
        ..Config::new(page.node, page.modules, BusKind::Fd, &policy)
    };
    CONTROLLER.init_with(|| Controller::new(settings, policy, boot, now())).as_mut()
}

/// Makes the service where it stays, for the same reason.
#[inline(never)]
fn make_service(
    page: NodePage,
    updater: Updater,
    controller: &mut Controller<'static>,
    hardware: &mut Hardware,
) -> &'static mut Service {
    static SERVICE: StaticCell<Service> = StaticCell::new();
    SERVICE.init_with(|| Service::new(page, updater, controller, now(), hardware))
}

/// What the main loop deals with.
struct Parts<'a, 'b> {
    can: &'a mut Fdcan,
    sense: &'a mut Sense<'b>,
    hardware: &'a mut Hardware,
    light: &'a mut Output<'static>,
}

/// The main loop.
async fn run(
    controller: &mut Controller<'static>,
    service: &mut Service,
    torque_limit: f32,
    parts: &mut Parts<'_, '_>,
    watchdog: &mut Watchdog,
) -> ! {
    let Parts { can, sense, hardware, light } = parts;
    let mut kept = controller.retained();
    retained::keep(kept);
    let mut sensors = Sensors::ZERO;
    let mut deadline = Instant::now();
    let mut sample_at = Instant::now();
    let mut sampled_at = Instant::now();
    let mut drive = drive::Measured::NOTHING;
    let mut loops = 0;
    loop {
        let received = with_deadline(deadline.min(sample_at), can.received()).await.ok();
        let moment = Instant::now();
        if moment >= sample_at {
            drive = drive::measured();
            controller.set_power(drive.power());
            // After a long computation some samples are left out instead of made up for.
            sample_at = moment + SAMPLE;
            let seconds = (moment - sampled_at).as_micros() as f32 * 1e-6;
            sampled_at = moment;
            sensors = sense.sample(seconds, drive.torque.map(|torque| torque / torque_limit));
            hardware.note(sense, &drive, can.status());
            log_trouble(&drive, sense);
        }
        controller.follow_stop(TORQUE_OFF.latch());
        let outputs = controller.poll(now(), &sensors, received.as_ref(), can.status().bus);
        service.poll(now(), controller, &sensors, received.as_ref(), *hardware);
        TORQUE_OFF.follow(controller.stop_latch());
        let restart = service.restart_due(now());
        if restart {
            controller.expect_restart();
        }
        if controller.retained() != kept {
            kept = controller.retained();
            retained::keep(kept);
        }
        if restart {
            cortex_m::peripheral::SCB::sys_reset();
        }
        let lit = light::lit(light::flashes(controller.faults()), now());
        light.set_level(service.light(now()).unwrap_or(lit).into());
        drive::command(drive::Command {
            torque: outputs.motors_enabled.then_some(outputs.torque),
            rearm: controller.rearm(),
        });
        deadline = Instant::from_micros(outputs.deadline.min(service.deadline()));
        can.send_all(|| controller.next_frame().or_else(|| service.next_frame(controller)));
        if drive.loops != loops {
            loops = drive.loops;
            watchdog.pet();
        }
    }
}

/// Says once a second what is wrong with sensors and motors.
fn log_trouble(drive: &drive::Measured, sense: &mut Sense<'_>) {
    if !sense.log_due() {
        return;
    }
    for (axis, trip) in drive.trip.iter().enumerate() {
        if let Some(trip) = trip {
            defmt::error!("motor {=usize} is cut off: {=str}", axis, trip.name());
        }
    }
    let (joints, imu) = sense.errors();
    for (joint, error) in joints.iter().enumerate() {
        if let Some(error) = error {
            defmt::warn!("encoder {=usize}: {=str}", joint, error.name());
        }
    }
    if let Some(error) = imu {
        defmt::warn!("inertial sensor: {=str}", error.name());
    }
}

/// A module that cannot run: the motors are off, the light says why (`flashes` in a row), and with a number it sends HEARTBEAT now and then, so
/// that the station sees it. Ends with a restart only.
async fn refuse(flashes: u8, can: Option<(&mut Fdcan, u8)>, light: &mut Output<'_>, watchdog: &mut Watchdog) -> ! {
    let heartbeat = can.map(|(can, node)| {
        let heartbeat = Heartbeat {
            mode: Mode::Boot as u8,
            fault: Fault::PolicyMismatch as u8,
            health: Health(0),
            time_keeper: NOBODY,
            protocol: PROTOCOL_VERSION,
            firmware: FIRMWARE_VERSION,
            policy: 0,
        };
        (can, Message::Heartbeat(heartbeat).emit(node, true))
    });
    let mut heartbeat = heartbeat;
    let mut heartbeat_at = Instant::now();
    let mut blink = 0;
    loop {
        if let Some((can, frame)) = &mut heartbeat
            && Instant::now() >= heartbeat_at
        {
            heartbeat_at += REFUSED_HEARTBEAT;
            can.send(frame);
            can.poll();
        }
        // On and off for every flash, then a pause as long as six.
        blink = (blink + 1) % (2 * (flashes + 3));
        light.set_level((blink % 2 == 1 && blink < 2 * flashes).into());
        // In pieces, each shorter than the watchdog's patience.
        for _ in 0..8 {
            watchdog.pet();
            Timer::after_millis(25).await;
        }
    }
}
