//! The CAN port: FDCAN1, 1 Mbit/s and 5 Mbit/s, behind queues.

use core::num::{NonZeroU8, NonZeroU16};

use composer_firmware::controller::BusStatus;
use composer_firmware::failsafe::BusOffPolicy;
use composer_shared::wire::{Frame, Function};
use embassy_stm32::Peri;
use embassy_stm32::can::config::{
    DataBitTiming, FdCanConfig, FrameTransmissionConfig, GlobalFilter, NominalBitTiming, TxBufferMode,
};
use embassy_stm32::can::enums::BusErrorMode;
use embassy_stm32::can::filter::{Action, Filter, FilterType, StandardFilter};
use embassy_stm32::can::frame::{FdFrame, Header};
use embassy_stm32::can::{BufferedCanFd, BufferedFdCanSender, CanConfigurator, OperatingMode, RxFdBuf, TxFdBuf};
use embassy_stm32::pac;
use embassy_stm32::peripherals::{FDCAN1, PA11, PA12};
use embedded_can::{Id, StandardId};

use static_cell::ConstStaticCell;

use crate::Irqs;

/// Frames that may wait while the controller computes: at 5 Mbit/s one of 64 bytes takes at least 0.14 ms.
const RECEIVED: usize = 16;
/// Frames that may wait for the bus, besides three in the chip. What the controller has beyond that it keeps, and replaces when it gets old.
const SENT: usize = 2;

static RX: ConstStaticCell<RxFdBuf<RECEIVED>> = ConstStaticCell::new(RxFdBuf::new());
static TX: ConstStaticCell<TxFdBuf<SENT>> = ConstStaticCell::new(TxFdBuf::new());

// 170 MHz without prescaler for both phases: 170 and 34 quanta a bit, sampled at 80 and 79.4 %.
const SEG1: u8 = 26;
const SEG2: u8 = 7;

/// The bits of an identifier that say the function; the others say the module.
const FUNCTION: u16 = 0x780;

/// The CAN port.
pub struct CanPort {
    bus: BufferedCanFd<'static, SENT, RECEIVED>,
    sender: BufferedFdCanSender,
    /// A frame that found the queue full.
    waiting: Option<FdFrame>,
}

fn count(n: u8) -> NonZeroU8 {
    NonZeroU8::new(n).unwrap_or(NonZeroU8::MIN)
}

fn config(bus_off: BusOffPolicy) -> FdCanConfig {
    FdCanConfig::default()
        .set_nominal_bit_timing(NominalBitTiming {
            prescaler: NonZeroU16::MIN,
            seg1: count(135),
            seg2: count(34),
            sync_jump_width: count(34),
        })
        .set_data_bit_timing(DataBitTiming {
            // embassy-stm32 0.6 ignores this, see `compensate_delay`.
            transceiver_delay_compensation: true,
            prescaler: NonZeroU16::MIN,
            seg1: count(SEG1),
            seg2: count(SEG2),
            sync_jump_width: count(SEG2),
        })
        .set_frame_transmit(FrameTransmissionConfig::AllowFdCanAndBRS)
        .set_tx_buffer_mode(TxBufferMode::Priority)
        // What no filter knows is not for us.
        .set_global_filter(GlobalFilter::reject_all())
        .set_automatic_bus_off_recovery(bus_off == BusOffPolicy::Recover)
}

/// One filter for every function that this bus has, so that noise does not even cost an interrupt. By mask: the range filters of embassy-stm32 0.6
/// are broken. The bursts of all modules go into one of the chip's queues, what must not get lost among them into the other.
fn filters() -> impl Iterator<Item = StandardFilter> {
    let functions = Function::ALL.into_iter().filter(|function| *function != Function::LatentFragment);
    functions.map(|function| Filter {
        filter: FilterType::BitMask { filter: function.id(0), mask: FUNCTION },
        action: match function {
            Function::State | Function::Latent => Action::StoreInFifo0,
            _ => Action::StoreInFifo1,
        },
    })
}

/// Transmitter delay compensation: at 5 Mbit/s a bit comes back through the transceiver when the next one is already being sent, so a sender
/// has to look later than at its own sample point, by the delay it measures. embassy-stm32 0.6 does not set it.
fn compensate_delay() {
    let regs = pac::FDCAN1;
    regs.cccr().modify(|w| w.set_init(true));
    while !regs.cccr().read().init() {}
    regs.cccr().modify(|w| w.set_cce(true));
    // As far behind the measured delay as the sample point lies behind the start of the bit.
    regs.tdcr().write(|w| w.set_tdco(1 + SEG1));
    regs.dbtp().modify(|w| w.set_tdc(true));
    regs.cccr().modify(|w| w.set_cce(false));
    regs.cccr().modify(|w| w.set_init(false));
    while regs.cccr().read().init() {}
}

impl CanPort {
    /// Goes onto the bus. Only once.
    pub fn new(
        fdcan: Peri<'static, FDCAN1>,
        rx: Peri<'static, PA11>,
        tx: Peri<'static, PA12>,
        bus_off: BusOffPolicy,
    ) -> Self {
        let mut configurator = CanConfigurator::new(fdcan, rx, tx, Irqs);
        configurator.set_config(config(bus_off));
        let mut slots = [StandardFilter::disable(); 28];
        slots.iter_mut().zip(filters()).for_each(|(slot, filter)| *slot = filter);
        configurator.properties().set_standard_filters(&slots);
        let can = configurator.start(OperatingMode::NormalOperationMode);
        compensate_delay();
        let bus = can.buffered_fd(TX.take(), RX.take());
        CanPort { sender: bus.writer(), bus, waiting: None }
    }

    /// The next frame of this protocol. Cancelling it loses nothing.
    pub async fn receive(&mut self) -> Frame {
        loop {
            // An error here is the chip's note about the last bit that went wrong; it counts those itself, see `status`.
            let Ok(envelope) = self.bus.read().await else { continue };
            let header = envelope.frame.header();
            let (Id::Standard(id), true) = (header.id(), header.fdcan()) else { continue };
            if let Some(mut frame) = Frame::new(id.as_raw(), true, envelope.frame.data()) {
                frame.brs = header.bit_rate_switching();
                return frame;
            }
        }
    }

    /// Sends what `next` offers as long as there is room.
    pub fn send(&mut self, mut next: impl FnMut() -> Option<Frame>) {
        while let Some(frame) = self.waiting.take().or_else(|| next().as_ref().and_then(encode)) {
            if let Err(embassy_sync::channel::TrySendError::Full(frame)) = self.sender.try_write(frame) {
                self.waiting = Some(frame);
                break;
            }
        }
    }

    /// How the chip is (ISO 11898-1 fault confinement).
    pub fn status(&self) -> BusStatus {
        match self.bus.properties().bus_error_mode() {
            BusErrorMode::ErrorActive => BusStatus::ErrorActive,
            BusErrorMode::ErrorPassive => BusStatus::ErrorPassive,
            BusErrorMode::BusOff => BusStatus::BusOff,
        }
    }
}

fn encode(frame: &Frame) -> Option<FdFrame> {
    let header = Header::new_fd(StandardId::new(frame.id)?.into(), frame.len, false, frame.brs);
    FdFrame::new(header, frame.payload()).ok()
}
