//! The joint encoders of the board stm32g474 alone: logs ten times a second what each reads, as the chip has it and as a joint angle by the calibration of the
//! node page (without one: by the nominal calibration), or what is wrong with it.
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

use core::cell::RefCell;

use composer_firmware::drivers::encoder::As5047p;
use composer_firmware::node_page::Calibration;
use composer_firmware::storage::read_page;
use composer_shared::robot::MAX_JOINTS;
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::Peri;
use embassy_stm32::gpio::{AnyPin, Level, Output, Speed};
use embassy_stm32::spi::{MODE_1, Spi};
use embassy_time::{Delay, Instant, Timer};
use embedded_hal_bus::spi::RefCellDevice;

use board::Board;
use flash::Storage;

defmt::timestamp!("{=u64:us}", Instant::now().as_micros());

#[embassy_executor::main]
async fn main(_spawner: Spawner) -> ! {
    let Board { peripherals: p, mut watchdog, .. } = board::start();
    let calibration = read_page(&mut Storage::new(p.FLASH)).map_or(Calibration::NOMINAL, |page| page.calibration);
    let bus = RefCell::new(Spi::new_blocking(p.SPI1, p.PA5, p.PA7, p.PA6, sense::spi_config(MODE_1)));
    let selects: [Peri<'static, AnyPin>; MAX_JOINTS] = [p.PC6.into(), p.PC7.into(), p.PC8.into(), p.PC9.into()];
    let mut encoders = selects.map(|pin| {
        // Setting a pin cannot fail here.
        let Ok(device) = RefCellDevice::new(&bus, Output::new(pin, Level::High, Speed::Medium), Delay);
        As5047p::new(device, Delay)
    });
    loop {
        for (joint, (encoder, calibration)) in encoders.iter_mut().zip(calibration.joints).enumerate() {
            match encoder.angle() {
                Ok(reading) => {
                    defmt::info!("joint {=usize}: {=u16}, {=f32} rad", joint, reading, calibration.angle(reading));
                }
                Err(error) => defmt::error!("joint {=usize}: {=str}", joint, error.name()),
            }
        }
        for _ in 0..4 {
            watchdog.pet();
            Timer::after_millis(25).await;
        }
    }
}
