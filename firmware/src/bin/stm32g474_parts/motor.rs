//! The motors of the board stm32g474 alone: one after the other, forwards and backwards for half a second each, with a tenth of the torque that the node page
//! allows (without one: of the nominal calibration). Logs five times a second current, torque, supply and what is cut off. Supply thresholds, cut-off, rest
//! and slew are those of the whole module; the ends of the joints are not watched, so take the motors off the joints, or hold the joints in the middle.
#![no_std]
#![no_main]

#[path = "../stm32g474/board.rs"]
#[allow(dead_code)] // Each image uses its part.
mod board;
#[path = "../stm32g474/drive.rs"]
mod drive;
#[path = "../stm32g474/fail.rs"]
mod fail;
#[path = "../stm32g474/flash.rs"]
#[allow(dead_code)]
mod flash;
#[path = "../stm32g474/stop.rs"]
mod stop;

use composer_firmware::node_page::Calibration;
use composer_firmware::power::PowerWatch;
use composer_firmware::safety::Safety;
use composer_firmware::storage::read_page;
use composer_firmware::supply::Supply;
use composer_shared::robot::{AXES, slew};
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::adc::{Adc, AdcConfig};
use embassy_time::{Duration, Instant, Timer};

use board::Board;
use flash::Storage;

defmt::timestamp!("{=u64:us}", Instant::now().as_micros());

/// Time between two commands.
const STEP: Duration = Duration::from_millis(1);
/// Time between two lines of the log.
const LOG_EVERY: Duration = Duration::from_millis(200);
/// How long a motor pulls one way.
const PULL: Duration = Duration::from_millis(500);
/// The part of the cap that it pulls with.
const PART: f32 = 0.1;

#[embassy_executor::main]
async fn main(_spawner: Spawner) -> ! {
    let Board { peripherals: p, mut watchdog, .. } = board::start();
    let page = read_page(&mut Storage::new(p.FLASH)).ok();
    let (calibration, safety) =
        page.map_or((Calibration::NOMINAL, Safety::BOARD), |page| (page.calibration, page.safety));
    // Both converters before either is set up further: they share a reset.
    let (adc1, _adc2) = (Adc::new(p.ADC1, AdcConfig::default()), Adc::new(p.ADC2, AdcConfig::default()));
    let bridges = drive::Bridges {
        pwm: (p.PA8, p.PA9),
        direction: [p.PB4.into(), p.PB5.into()],
        enable: [p.PB6.into(), p.PB7.into()],
    };
    drive::start(p.TIM1, bridges, adc1, (p.PA0, p.PA1, p.PA2), &calibration.motors);
    let mut power = PowerWatch::new(safety.supply);
    let mut torque = [0.0f32; AXES];
    let (mut log_at, mut loops) = (Instant::now(), 0);
    loop {
        Timer::after(STEP).await;
        let now = Instant::now();
        let measured = drive::measured();
        power.follow(now.as_micros(), &measured.power());
        let good = power.supply() == Supply::Good;
        // Yaw forwards, yaw backwards, pitch forwards, pitch backwards, and a pause as long as each of them.
        let phase = now.as_millis() / PULL.as_millis() % 5;
        let pull = PART * safety.caps.torque;
        for (axis, torque) in torque.iter_mut().enumerate() {
            let own = phase / 2 == axis as u64 && good && !power.trips().off(axis);
            let wanted = if own { if phase % 2 == 0 { pull } else { -pull } } else { 0.0 };
            *torque = if good { slew(*torque, wanted, safety.caps.torque_slew * 1e-3) } else { 0.0 };
        }
        drive::command(drive::Command { torque: good.then_some(torque), rearm: power.rearm(now.as_micros()) });
        if measured.loops != loops {
            loops = measured.loops;
            watchdog.pet();
        }
        if now >= log_at {
            log_at = now + LOG_EVERY;
            let ([yaw, pitch], [a, b]) = (measured.torque, measured.current);
            defmt::info!(
                "{=f32} V; yaw {=f32} A, torque {=f32}; pitch {=f32} A, torque {=f32}",
                measured.volts,
                a,
                yaw,
                b,
                pitch
            );
            for (axis, trip) in measured.trip.iter().enumerate() {
                if let Some(trip) = trip {
                    defmt::error!("motor {=usize} is cut off: {=str}", axis, trip.name());
                }
            }
            match power.supply() {
                Supply::Good => {}
                Supply::Under => defmt::error!("the supply is too low"),
                Supply::Over => defmt::error!("the supply is too high"),
            }
        }
    }
}
