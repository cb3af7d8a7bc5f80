//! The CAN port of the board stm32g474 alone: logs every frame of this protocol that it hears, and how the chip is; ten times a second it sends a HEARTBEAT
//! (mode service) under the number of its node page. Without a node page it only listens.
#![no_std]
#![no_main]

#[path = "../stm32g474/board.rs"]
#[allow(dead_code)] // Each image uses its part.
mod board;
#[path = "../stm32g474/can.rs"]
#[allow(dead_code)]
mod can;
#[path = "../stm32g474/fail.rs"]
mod fail;
#[path = "../stm32g474/flash.rs"]
#[allow(dead_code)]
mod flash;
#[path = "../stm32g474/stop.rs"]
mod stop;

use composer_firmware::controller::FIRMWARE_VERSION;
use composer_firmware::failsafe::{BusOffPolicy, BusStatus};
use composer_firmware::port::CanPort;
use composer_firmware::storage::read_page;
use composer_shared::wire::{Health, Heartbeat, Message, Mode, NOBODY, PROTOCOL_VERSION};
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_time::{Duration, Instant, Timer, with_timeout};

use board::Board;
use can::Fdcan;
use flash::Storage;

defmt::timestamp!("{=u64:us}", Instant::now().as_micros());

/// Time between two HEARTBEAT frames.
const SEND_EVERY: Duration = Duration::from_millis(100);
/// How long to wait for a frame: shorter than the watchdog's patience.
const PATIENCE: Duration = Duration::from_millis(20);

#[embassy_executor::main]
async fn main(_spawner: Spawner) -> ! {
    let Board { peripherals: p, mut watchdog, crystal } = board::start();
    while !crystal {
        watchdog.pet();
        Timer::after(PATIENCE).await;
    }
    let node = read_page(&mut Storage::new(p.FLASH)).ok().map(|page| page.node);
    match node {
        Some(node) => defmt::info!("module {=u8}", node),
        None => defmt::warn!("no node page: listening only"),
    }
    let mut can = Fdcan::new(p.FDCAN1, p.PA11, p.PA12, BusOffPolicy::Recover);
    let heartbeat = Heartbeat {
        mode: Mode::Service as u8,
        fault: 0,
        health: Health(0),
        time_keeper: NOBODY,
        protocol: PROTOCOL_VERSION,
        firmware: FIRMWARE_VERSION,
        policy: 0,
    };
    let mut send_at = Instant::now();
    let mut last = BusStatus::ErrorActive;
    loop {
        watchdog.pet();
        if let Ok(frame) = with_timeout(PATIENCE, can.received()).await {
            defmt::info!("{=u16:03x} {=[u8]:02x}", frame.id, frame.payload());
        }
        let status = can.status();
        if status.bus != last {
            let (sent, received) = (status.transmit_errors, status.receive_errors);
            defmt::info!("transmit errors {=u16}, receive errors {=u16}", sent, received);
            match status.bus {
                BusStatus::ErrorActive => defmt::info!("error active: few errors"),
                BusStatus::ErrorPassive => defmt::warn!("error passive: many errors; is anybody else on the bus?"),
                BusStatus::BusOff => defmt::error!("bus-off"),
            }
            last = status.bus;
        }
        if Instant::now() >= send_at {
            send_at = Instant::now() + SEND_EVERY;
            if let Some(node) = node {
                can.send(&Message::Heartbeat(heartbeat).emit(node, true));
            }
        }
        can.poll();
    }
}
