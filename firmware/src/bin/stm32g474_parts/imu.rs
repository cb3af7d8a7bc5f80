//! The inertial sensor of the board stm32g474 alone: logs five times a second what it feels in the module's own frame, by the mounting of the node page
//! (without one: as if it sat straight), and what the attitude filter makes of it. At rest the force is a unit vector upwards, and so is "up".
#![no_std]
#![no_main]

#[path = "../stm32g474/board.rs"]
#[allow(dead_code)] // Each image uses its part.
mod board;
#[path = "../stm32g474/fail.rs"]
mod fail;
#[path = "../stm32g474/flash.rs"]
#[allow(dead_code)]
mod flash;
#[path = "../stm32g474/sense.rs"]
#[allow(dead_code)]
mod sense;

use composer_firmware::attitude::Attitude;
use composer_firmware::drivers::imu::Lsm6dso;
use composer_firmware::node_page::Calibration;
use composer_firmware::storage::read_page;
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::gpio::{Level, Output, Speed};
use embassy_stm32::spi::{MODE_3, Spi};
use embassy_time::{Delay, Duration, Instant, Timer};
use embedded_hal_bus::spi::ExclusiveDevice;

use board::Board;
use flash::Storage;

defmt::timestamp!("{=u64:us}", Instant::now().as_micros());

/// Time between two readings; the sensor has a new one every 0.6 ms.
const SAMPLE: Duration = Duration::from_millis(1);
/// Time between two lines of the log.
const LOG_EVERY: Duration = Duration::from_millis(200);
/// Failed readings in a row after which it is set up anew.
const LOST: u32 = 100;

#[embassy_executor::main]
async fn main(_spawner: Spawner) -> ! {
    let Board { peripherals: p, mut watchdog, .. } = board::start();
    let calibration = read_page(&mut Storage::new(p.FLASH)).map_or(Calibration::NOMINAL, |page| page.calibration);
    let bus = Spi::new_blocking(p.SPI3, p.PC10, p.PC12, p.PC11, sense::spi_config(MODE_3));
    // Setting a pin cannot fail here.
    let Ok(device) = ExclusiveDevice::new(bus, Output::new(p.PD2, Level::High, Speed::Medium), Delay);
    let mut imu = Lsm6dso::new(device, calibration.imu_mounting);
    let mut attitude = Attitude::UNKNOWN;
    let (mut failures, mut log_at, mut sampled_at) = (LOST, Instant::now(), Instant::now());
    loop {
        watchdog.pet();
        if failures >= LOST {
            failures = 0;
            if let Err(error) = imu.init(&mut Delay) {
                defmt::error!("{=str}", error.name());
            }
        }
        Timer::after(SAMPLE).await;
        let due = Instant::now() >= log_at;
        if due {
            log_at = Instant::now() + LOG_EVERY;
        }
        match imu.sample() {
            Ok(motion) => {
                failures = 0;
                let seconds = sampled_at.elapsed().as_micros() as f32 * 1e-6;
                sampled_at = Instant::now();
                let [x, y, z] = attitude.update(motion.rate, motion.force, seconds);
                if due {
                    let ([a, b, c], [d, e, f]) = (motion.force, motion.rate);
                    defmt::info!("force {=f32} {=f32} {=f32} g, rate {=f32} {=f32} {=f32} rad/s", a, b, c, d, e, f);
                    defmt::info!("up {=f32} {=f32} {=f32}", x, y, z);
                }
            }
            Err(error) => {
                failures += 1;
                if due {
                    defmt::error!("{=str}", error.name());
                }
            }
        }
    }
}
