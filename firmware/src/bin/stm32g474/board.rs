//! What all images of this board begin with: watchdog, clocks, priorities of the interrupts.

use embassy_stm32::interrupt::{InterruptExt, Priority};
use embassy_stm32::peripherals::IWDG;
use embassy_stm32::rcc::{self, mux};
use embassy_stm32::time::Hertz;
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_stm32::{Peripherals, interrupt, pac};

use crate::fail;

/// The independent watchdog.
pub type Watchdog = IndependentWatchdog<'static, IWDG>;

/// One control period: a module that hangs pulls no longer than that.
pub const WATCHDOG_US: u32 = 50_000;

/// Full scale of the ADC.
pub const ADC_RANGE: f32 = 4095.0;

/// How often to look whether the crystal oscillates. It does after some milliseconds; a look takes at least eight cycles of the internal oscillator's 16 MHz, so
/// these are 20 ms, well within the watchdog's patience.
const CRYSTAL_LOOKS: u32 = 40_000;

/// The board, running.
pub struct Board {
    /// Its peripherals, but for the watchdog.
    pub peripherals: Peripherals,
    /// Running.
    pub watchdog: Watchdog,
    /// Whether the clocks come from the crystal. If not, they come from the internal oscillator, a per cent off: good for everything but CAN-FD, so such a
    /// module must not go onto the bus.
    pub crystal: bool,
}

/// Starts the board. The watchdog comes first: whatever else waits for ever, such as an oscillator, ends with a reset.
pub fn start() -> Board {
    // SAFETY: the only instance that is ever used; the one among the peripherals is left alone.
    let mut watchdog = Watchdog::new(unsafe { IWDG::steal() }, WATCHDOG_US);
    watchdog.unleash();
    prioritise();
    let crystal = crystal_oscillates();
    let mut config = embassy_stm32::Config::default();
    config.rcc = clocks(crystal);
    let peripherals = embassy_stm32::init(config);
    watchdog.pet();
    fail::prepare();
    if !crystal {
        defmt::error!("the crystal does not oscillate: the module stays off the bus");
    }
    Board { peripherals, watchdog, crystal }
}

/// The current loops interrupt everything, and nothing interrupts them: a burst of frames must not move the moment at which a current is measured and
/// answered. Time comes next, frames last. All at once are held up only by critical sections, which are short.
fn prioritise() {
    interrupt::ADC1_2.set_priority(Priority::P0);
    interrupt::TIM2.set_priority(Priority::P4);
    interrupt::FDCAN1_IT0.set_priority(Priority::P8);
    interrupt::FDCAN1_IT1.set_priority(Priority::P8);
}

/// Starts the crystal and says whether it oscillates. `embassy_stm32::init` would wait for it for ever.
fn crystal_oscillates() -> bool {
    pac::RCC.cr().modify(|w| {
        w.set_hsebyp(false);
        w.set_hseon(true);
    });
    (0..CRYSTAL_LOOKS).any(|_| pac::RCC.cr().read().hserdy())
}

/// 170 MHz for the core, the timers and FDCAN, from the crystal or, for want of it, from the internal oscillator.
fn clocks(crystal: bool) -> rcc::Config {
    let mut config = rcc::Config::new();
    let (source, prediv) = if crystal {
        config.hse = Some(rcc::Hse { freq: Hertz(24_000_000), mode: rcc::HseMode::Oscillator });
        (rcc::PllSource::HSE, rcc::PllPreDiv::DIV6)
    } else {
        (rcc::PllSource::HSI, rcc::PllPreDiv::DIV4)
    };
    config.hsi48 = None;
    config.pll = Some(rcc::Pll {
        source,
        prediv,
        mul: rcc::PllMul::MUL85,
        divp: None,
        divq: Some(rcc::PllQDiv::DIV2),
        divr: Some(rcc::PllRDiv::DIV2),
    });
    config.sys = rcc::Sysclk::PLL1_R;
    config.boost = true;
    config.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config.mux.adc12sel = mux::Adcsel::SYS;
    config
}
