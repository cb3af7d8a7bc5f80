//! The motors: PWM, current measurement and current loops, in step with each other.
//!
//! TIM1 counts up and down 20,000 times a second. At every second valley, in the middle of the time in which the bridge is on, where the current is at
//! its mean, it triggers ADC1; when that is done its interrupt runs both current loops ([`composer_firmware::drivers::stage`]). Before, it looks at the stop input and
//! whether a stop was heard: then the motors coast, whatever the main loop is at ([`composer_firmware::torque_off`]).

use core::cell::{Cell, RefCell};

use composer_firmware::drivers::motor::Motor;
use composer_firmware::drivers::stage::{self, Readings, motor_config};
pub use composer_firmware::drivers::stage::{Command, Measured};
use composer_firmware::node_page::MotorCalibration;
use composer_firmware::stop_input::StopInput;
use composer_firmware::torque_off::WITHIN_US;
use composer_shared::robot::AXES;
use composer_shared::wire::Frame;
use embassy_stm32::adc::{Adc, AdcChannel, Exten, InjectedAdc, SampleTime};
use embassy_stm32::gpio::{AnyPin, Input, Level, Output, OutputType, Speed};
use embassy_stm32::interrupt::InterruptExt;
use embassy_stm32::peripherals::{ADC1, PA0, PA1, PA2, PA8, PA9, TIM1};
use embassy_stm32::time::Hertz;
use embassy_stm32::timer::low_level::CountingMode;
use embassy_stm32::timer::simple_pwm::{PwmPin, SimplePwm, SimplePwmChannel};
use embassy_stm32::{Peri, interrupt, pac, triggers};
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;

use crate::board::ADC_RANGE;
use crate::stop::TORQUE_OFF;

const PWM: Hertz = Hertz(20_000);
/// Time between two runs of the current loops, s.
const PERIOD: f32 = WITHIN_US as f32 * 1e-6;
/// Bandwidth of the current loops, rad/s: 500 Hz, a twentieth of their rate.
const BANDWIDTH: f32 = 3142.0;
/// Supply voltage at full scale: 3.3 V over the divider of 10 kohm and 1 kohm.
const SUPPLY_RANGE: f32 = 3.3 * 11.0;

type Axis = Motor<SimplePwmChannel<'static, TIM1>, Output<'static>, Output<'static>>;
type Stage = stage::Stage<SimplePwmChannel<'static, TIM1>, Output<'static>, Output<'static>>;

type Shared<T> = Mutex<CriticalSectionRawMutex, T>;

/// The currents' converter and the power stage that they act on.
type Sensed = (InjectedAdc<'static, ADC1, 3>, Stage);

static COMMAND: Shared<Cell<Command>> = Mutex::new(Cell::new(Command { torque: None, rearm: [false; AXES] }));
static MEASURED: Shared<Cell<Measured>> = Mutex::new(Cell::new(Measured::NOTHING));
static SWITCH: Shared<RefCell<Option<Switch>>> = Mutex::new(RefCell::new(None));
static STAGE: Shared<RefCell<Option<Sensed>>> = Mutex::new(RefCell::new(None));

/// The stop input, its reading, the time by its own count (us), and what to do when it opens.
struct Switch {
    pin: Input<'static>,
    input: StopInput,
    time: u64,
    node: u8,
    tell: fn(Frame),
}

impl Switch {
    fn sample(&mut self) {
        self.time += WITHIN_US;
        if self.input.sample(self.time, self.pin.is_high())
            && let Some(frame) = TORQUE_OFF.trip(self.node, true)
        {
            (self.tell)(frame);
        }
    }
}

/// The pins of both bridges, yaw and pitch.
pub struct Bridges {
    /// EN.
    pub pwm: (Peri<'static, PA8>, Peri<'static, PA9>),
    /// PH.
    pub direction: [Peri<'static, AnyPin>; AXES],
    /// nSLEEP.
    pub enable: [Peri<'static, AnyPin>; AXES],
}

/// Starts the current loops; the motors coast until the first command.
pub fn start(
    timer: Peri<'static, TIM1>,
    bridges: Bridges,
    adc: Adc<'static, ADC1>,
    (yaw, pitch, supply): (Peri<'static, PA0>, Peri<'static, PA1>, Peri<'static, PA2>),
    calibrations: &[MotorCalibration; AXES],
) {
    let output = |pin| Output::new(pin, Level::Low, Speed::Low);
    let [yaw_direction, pitch_direction] = bridges.direction.map(output);
    let [yaw_enable, pitch_enable] = bridges.enable.map(output);
    let (yaw_pwm, pitch_pwm) = bridges.pwm;
    let pwm = SimplePwm::new(
        timer,
        Some(PwmPin::new(yaw_pwm, OutputType::PushPull)),
        Some(PwmPin::new(pitch_pwm, OutputType::PushPull)),
        None,
        None,
        PWM,
        CountingMode::CenterAlignedBothInterrupts,
    );
    let mut channels = pwm.split();
    channels.ch1.enable();
    channels.ch2.enable();
    let [yaw_calibration, pitch_calibration] = *calibrations;
    let axes = [
        (axis(channels.ch1, yaw_direction, yaw_enable, &yaw_calibration), yaw_calibration),
        (axis(channels.ch2, pitch_direction, pitch_enable, &pitch_calibration), pitch_calibration),
    ];
    // Four half turns of the counter from one trigger to the next: every second valley.
    pac::TIM1.rcr().write(|w| w.set_rep(3));
    pac::TIM1.cr2().modify(|w| w.set_mms2(pac::timer::vals::Mms2::UPDATE));
    // The break that a locked-up processor triggers (see `fail`); the break pin is not used.
    pac::TIM1.af1().modify(|w| w.set_bkine(false));
    pac::TIM1.bdtr().modify(|w| {
        w.set_bkp(0, pac::timer::vals::Bkp::ACTIVE_HIGH);
        w.set_bke(0, true);
        w.set_moe(true);
    });
    let time = SampleTime::CYCLES24_5;
    let sequence = [(yaw.degrade_adc(), time), (pitch.degrade_adc(), time), (supply.degrade_adc(), time)];
    let adc = adc.setup_injected_conversions(sequence, triggers::TIM1_TRGO2, Exten::RISING_EDGE, true);
    STAGE.lock(|stage| *stage.borrow_mut() = Some((adc, Stage::new(axes, SUPPLY_RANGE))));
    // SAFETY: the handler only touches what is behind a lock, and that is complete now.
    unsafe { interrupt::ADC1_2.enable() };
}

fn axis(
    pwm: SimplePwmChannel<'static, TIM1>,
    direction: Output<'static>,
    enable: Output<'static>,
    calibration: &MotorCalibration,
) -> Axis {
    Motor::new(pwm, direction, enable, motor_config(calibration, BANDWIDTH, PERIOD))
}

/// From now on the stop input of this module is looked at; `tell` gets the frame that stops the others.
#[allow(dead_code)] // The image for the motors alone has no bus.
pub fn watch_stop_input(pin: Input<'static>, node: u8, tell: fn(Frame)) {
    SWITCH.lock(|switch| *switch.borrow_mut() = Some(Switch { pin, input: StopInput::default(), time: 0, node, tell }));
}

/// Sets what the current loops do from now on.
pub fn command(command: Command) {
    COMMAND.lock(|shared| shared.set(command.after(shared.get())));
}

/// What the current loops measured, and the extremes of the supply since the last call.
pub fn measured() -> Measured {
    MEASURED.lock(|shared| {
        let measured = shared.get();
        shared.set(measured.taken());
        measured
    })
}

#[embassy_stm32::interrupt]
fn ADC1_2() {
    SWITCH.lock(|switch| {
        if let Ok(mut switch) = switch.try_borrow_mut()
            && let Some(switch) = switch.as_mut()
        {
            switch.sample();
        }
    });
    let command = COMMAND.lock(|shared| {
        let command = shared.get();
        shared.set(command.seen());
        command.unless(TORQUE_OFF.is_off())
    });
    STAGE.lock(|stage| {
        if let Ok(mut stage) = stage.try_borrow_mut()
            && let Some((adc, stage)) = stage.as_mut()
        {
            let [yaw, pitch, supply] = adc.read_injected_samples().map(|raw| f32::from(raw) / ADC_RANGE);
            let readings = Readings { currents: [yaw, pitch], supply };
            MEASURED.lock(|shared| shared.set(stage.run(command, shared.get(), readings)));
        }
    });
}
