//! The sensors: four encoders on one SPI bus, the inertial sensor on another, the thermistors on the ADC.

use core::cell::RefCell;

use composer_firmware::drivers::encoder::{As5047p, EncoderError};
use composer_firmware::drivers::imu::{ImuError, Lsm6dso};
use composer_firmware::drivers::sensors::{Joint, ModuleSensors, RawReadings};
use composer_firmware::drivers::thermistor::Thermistor;
use composer_firmware::node_page::NodePage;
use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, Geometry, MAX_JOINTS};
use embassy_stm32::Peri;
use embassy_stm32::adc::{Adc, SampleTime};
use embassy_stm32::gpio::{AnyPin, Level, Output, Speed};
use embassy_stm32::mode::Blocking;
use embassy_stm32::peripherals::{ADC2, PC4, PC5};
use embassy_stm32::spi::mode::Master;
use embassy_stm32::spi::{self, Spi};
use embassy_stm32::time::Hertz;
use embassy_time::{Delay, Duration, Instant};
use embedded_hal_bus::spi::{ExclusiveDevice, RefCellDevice};

use crate::board::ADC_RANGE;

/// Both kinds of chip allow 10 MHz; the prescaler makes 5.3 MHz of this.
const SPI_CLOCK: Hertz = Hertz(6_000_000);
const THERMISTOR: Thermistor = Thermistor { nominal: 10e3, beta: 3435.0, pull_up: 10e3 };
/// Time between two looks at what is wrong.
const LOG_EVERY: Duration = Duration::from_secs(1);

/// An SPI port.
pub type Bus = Spi<'static, Blocking, Master>;
type Shared<'a> = RefCellDevice<'a, Bus, Output<'static>, Delay>;
type Alone = ExclusiveDevice<Bus, Output<'static>, Delay>;

/// The settings of an SPI port.
pub fn spi_config(mode: spi::Mode) -> spi::Config {
    let mut config = spi::Config::default();
    config.mode = mode;
    config.frequency = SPI_CLOCK;
    config
}

/// All sensors of the module.
pub struct Sense<'a> {
    sensors: ModuleSensors<Shared<'a>, Alone, Delay>,
    adc: Adc<'static, ADC2>,
    thermistors: (Peri<'static, PC4>, Peri<'static, PC5>),
    temperatures: [f32; AXES],
    log_at: Instant,
}

impl<'a> Sense<'a> {
    /// The sensors behind these ports and chip selects, with the calibration of the node page.
    pub fn new(
        (encoders, selects): (&'a RefCell<Bus>, [Peri<'static, AnyPin>; MAX_JOINTS]),
        (imu, imu_select): (Bus, Peri<'static, AnyPin>),
        (adc, yaw, pitch): (Adc<'static, ADC2>, Peri<'static, PC4>, Peri<'static, PC5>),
        page: &NodePage,
        geometry: Geometry,
    ) -> Self {
        let select = |pin| Output::new(pin, Level::High, Speed::Medium);
        let mut calibrations = page.calibration.joints.into_iter();
        let joints = selects.map(|pin| {
            // Setting a pin cannot fail here.
            let Ok(device) = RefCellDevice::new(encoders, select(pin), Delay);
            let calibration = calibrations.next().unwrap_or_default();
            Joint::new(As5047p::new(device, Delay), calibration)
        });
        let Ok(imu) = ExclusiveDevice::new(imu, select(imu_select), Delay);
        let imu = Lsm6dso::new(imu, page.calibration.imu_mounting);
        // The last joint of the last module does not exist.
        let last = page.node + 1 == page.modules;
        let joint_count = usize::from(geometry.links_per_module) - usize::from(last);
        let mut sensors = ModuleSensors::new(joints, joint_count, imu);
        // If it fails, the samples fail; it is tried again when they have failed for a while.
        let _ = sensors.init(&mut Delay);
        Sense { sensors, adc, thermistors: (yaw, pitch), temperatures: [f32::NAN; AXES], log_at: Instant::now() }
    }

    /// Reads everything, `seconds` after the last time; the motors say their `torque`.
    pub fn sample(&mut self, seconds: f32, torque: [f32; AXES]) -> Sensors {
        if self.sensors.imu_lost() {
            let _ = self.sensors.init(&mut Delay);
        }
        let temperature = self.temperature();
        self.sensors.sample(seconds, torque, temperature)
    }

    /// The hotter motor's temperature, degrees Celsius; not a number if a thermistor is torn off.
    fn temperature(&mut self) -> f32 {
        let time = SampleTime::CYCLES92_5;
        let yaw = self.adc.blocking_read(&mut self.thermistors.0, time);
        let pitch = self.adc.blocking_read(&mut self.thermistors.1, time);
        let [yaw, pitch] = [yaw, pitch].map(|raw| THERMISTOR.celsius(f32::from(raw) / ADC_RANGE));
        self.temperatures = [yaw, pitch];
        // `f32::max` would hide the one that is torn off.
        if yaw.is_nan() || yaw > pitch { yaw } else { pitch }
    }

    /// What failed in the last sample: joint by joint, and the inertial sensor.
    pub fn errors(&self) -> ([Option<EncoderError>; MAX_JOINTS], Option<ImuError>) {
        self.sensors.errors()
    }

    /// What the chips read last.
    pub fn raw(&self) -> RawReadings {
        self.sensors.raw()
    }

    /// The motors' temperatures in the last sample, degrees Celsius.
    pub fn temperatures(&self) -> [f32; AXES] {
        self.temperatures
    }

    /// Whether it is time for a look at them.
    pub fn log_due(&mut self) -> bool {
        let now = Instant::now();
        let due = now >= self.log_at;
        if due {
            self.log_at = now + LOG_EVERY;
        }
        due
    }
}
