//! The CAN port: FDCAN1 at 1 Mbit/s and 5 Mbit/s, by its registers.
//!
//! The driver of embassy-stm32 fills the chip's slots in order of arrival, so that frames which lose every arbitration keep the others from taking
//! part, and it knows no way to take one back. Here [`Sender`] decides what lies in the three transmit buffers, the same code that the simulator
//! runs; this file loads them, aborts them, and looks what became of them.
//!
//! - Line 0 of the interrupts empties both receive FIFOs, of three frames each, into one queue.
//! - A stop goes straight from there to the current loops ([`crate::stop`]), and one that the stop input asks for straight into a slot.
//! - Line 1 comes when a frame got through, came back, or the bus-off state changed. It puts the next frame into its slot at once, even while the
//!   main loop computes.

use core::cell::{Cell, UnsafeCell};
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use composer_firmware::controller::{BusStatus, Micros};
use composer_firmware::failsafe::BusOffPolicy;
use composer_firmware::port::{CanPort, Counts, Outcome, PortStatus, RECEIVED, SLOTS, Sender, Slots, element};
use composer_shared::wire::{Frame, Function};
use embassy_stm32::gpio::{AfType, Flex, OutputType, Pull, Speed};
use embassy_stm32::interrupt::InterruptExt;
use embassy_stm32::pac::can::regs;
use embassy_stm32::pac::can::vals::{Anfe, Anfs, Tfqm};
use embassy_stm32::peripherals::{FDCAN1, PA11, PA12};
use embassy_stm32::{Peri, interrupt, pac, rcc};
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::channel::Channel;
use embassy_time::Instant;

use crate::stop::TORQUE_OFF;

const CAN: pac::can::Fdcan = pac::FDCAN1;
const RAM: pac::fdcanram::Fdcanram = pac::FDCANRAM1;

/// Control period until the policy is known, us.
const PERIOD: Micros = 50_000;
/// Alternate function of both pins.
const AF: u8 = 9;

// 170 MHz without prescaler for both phases: 170 and 34 quanta a bit, sampled at 80 and 79.4 %.
const NOMINAL: (u8, u8) = (135, 34);
const DATA: (u8, u8) = (26, 7);

/// The bits of an identifier that say the function; the others say the module.
const FUNCTION: u16 = 0x780;

static SENDER: Shared = Shared(UnsafeCell::new(Sender::new(PERIOD)));
static QUEUE: Channel<CriticalSectionRawMutex, Frame, RECEIVED> = Channel::new();
/// What line 1 is to send at once.
static URGENT: Mutex<CriticalSectionRawMutex, Cell<Option<Frame>>> = Mutex::new(Cell::new(None));
static OVERFLOWED: AtomicU32 = AtomicU32::new(0);
/// Whether to come back after bus-off.
static RECOVER: AtomicBool = AtomicBool::new(true);

/// The CAN port.
pub struct Fdcan {
    /// They belong to FDCAN1 as long as this lives.
    _pins: [Flex<'static>; 2],
}

/// The transmit buffers.
struct Buffers;

// The bits of a slot as they are, without the checks of the register definitions: they could panic.
impl Slots for Buffers {
    fn load(&mut self, slot: usize, frame: &Frame) {
        // A slot and a word beyond the last would be the last; there are none.
        let word = |number: usize| RAM.txbuf((element::WORDS * slot + number).min(element::WORDS * SLOTS - 1));
        element::encode(frame, |number, value| word(number).write_value(value));
        CAN.txbar().write_value(regs::Txbar(1 << slot));
    }

    fn abort(&mut self, slot: usize) {
        CAN.txbcr().write_value(regs::Txbcr(1 << slot));
    }

    fn outcome(&mut self, slot: usize) -> Outcome {
        // A request stays pending until the frame got through or, asked back, is off the wire.
        if CAN.txbrp().read().0 >> slot & 1 == 1 {
            Outcome::Pending
        } else if CAN.txbto().read().0 >> slot & 1 == 1 {
            Outcome::Sent
        } else {
            Outcome::Returned
        }
    }
}

/// The sender belongs to the interrupt of line 1. The main loop works on it with that line masked, and that line alone: the current loops do not
/// wait for it.
struct Shared(UnsafeCell<Sender>);

// SAFETY: only `with_sender`, in the main loop, and the handler of line 1 touch it, and the first masks the second.
unsafe impl Sync for Shared {}

/// Works on the sender, from the main loop.
fn with_sender<T>(work: impl FnOnce(&mut Sender) -> T) -> T {
    interrupt::FDCAN1_IT1.disable();
    // What was on its way to the processor is through.
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
    // SAFETY: the handler does not run, and `work` has no way to come here again.
    let result = work(unsafe { &mut *SENDER.0.get() });
    // SAFETY: nothing refers to the sender any more.
    unsafe { interrupt::FDCAN1_IT1.enable() };
    result
}

/// Now, us.
fn now() -> Micros {
    Instant::now().as_micros()
}

impl Fdcan {
    /// Goes onto the bus. Only once.
    pub fn new(
        _fdcan: Peri<'static, FDCAN1>,
        rx: Peri<'static, PA11>,
        tx: Peri<'static, PA12>,
        bus_off: BusOffPolicy,
    ) -> Self {
        let (mut rx, mut tx) = (Flex::new(rx), Flex::new(tx));
        rx.set_as_af_unchecked(AF, AfType::input(Pull::None));
        tx.set_as_af_unchecked(AF, AfType::output(OutputType::PushPull, Speed::VeryHigh));
        RECOVER.store(bus_off == BusOffPolicy::Recover, Ordering::Relaxed);
        rcc::enable_and_reset::<FDCAN1>();
        configure();
        // SAFETY: the handlers only touch registers of FDCAN1, a queue behind a lock, and the sender, see `with_sender`.
        unsafe {
            interrupt::FDCAN1_IT0.enable();
            interrupt::FDCAN1_IT1.enable();
        }
        Fdcan { _pins: [rx, tx] }
    }

    /// Sets the control period of the robot, us: how long frames are worth sending.
    pub fn set_period(&mut self, period: Micros) {
        with_sender(|sender| sender.set_period(period));
    }

    /// From now on it sends only what a module with this number may.
    pub fn guard(&mut self, node: u8) {
        with_sender(|sender| sender.guard(Some(node)));
    }

    /// Waits for the next received frame. Cancelling it loses nothing.
    pub async fn received(&mut self) -> Frame {
        QUEUE.receive().await
    }
}

/// Sends a frame without waiting for the main loop; from any interrupt.
pub fn send_at_once(frame: Frame) {
    URGENT.lock(|urgent| urgent.set(Some(frame)));
    interrupt::FDCAN1_IT1.pend();
}

impl CanPort for Fdcan {
    fn send(&mut self, frame: &Frame) {
        with_sender(|sender| sender.push(now(), frame));
    }

    fn room(&self) -> usize {
        with_sender(|sender| sender.room())
    }

    fn receive(&mut self) -> Option<Frame> {
        QUEUE.try_receive().ok()
    }

    fn poll(&mut self) {
        with_sender(|sender| sender.poll(now(), &mut Buffers));
    }

    fn status(&self) -> PortStatus {
        let (state, errors) = (CAN.psr().read(), CAN.ecr().read());
        let (bus, transmit_errors) = match (state.bo(), state.ep()) {
            (true, _) => (BusStatus::BusOff, 256),
            (_, true) => (BusStatus::ErrorPassive, errors.tec().into()),
            _ => (BusStatus::ErrorActive, errors.tec().into()),
        };
        // The counter itself ends at 127.
        let receive_errors = if errors.rp() { 128 } else { errors.rec().into() };
        let counts = with_sender(|sender| sender.counts());
        let overflowed = OVERFLOWED.load(Ordering::Relaxed);
        PortStatus { bus, transmit_errors, receive_errors, counts: Counts { overflowed, ..counts } }
    }
}

/// Sets the peripheral up and lets it go onto the bus.
fn configure() {
    CAN.cccr().modify(|w| w.set_init(true));
    while !CAN.cccr().read().init() {}
    CAN.cccr().modify(|w| w.set_cce(true));
    CAN.cccr().modify(|w| {
        w.set_fdoe(true);
        w.set_brse(true);
    });
    CAN.nbtp().write(|w| {
        w.set_nbrp(0);
        w.set_ntseg1(NOMINAL.0 - 1);
        w.set_ntseg2(NOMINAL.1 - 1);
        w.set_nsjw(NOMINAL.1 - 1);
    });
    CAN.dbtp().write(|w| {
        w.set_dbrp(0);
        w.set_dtseg1(DATA.0 - 1);
        w.set_dtseg2(DATA.1 - 1);
        w.set_dsjw(DATA.1 - 1);
        w.set_tdc(true);
    });
    // Transmitter delay compensation: at 5 Mbit/s a bit comes back through the transceiver when the next one is already being sent, so a
    // sender has to look later than at its own sample point: as far behind the delay it measures as that lies behind the start of the bit.
    CAN.tdcr().write(|w| w.set_tdco(1 + DATA.0));
    CAN.txbc().write(|w| w.set_tfqm(Tfqm::QUEUE));

    // One filter for every function that this bus has, so that noise does not even cost an interrupt. The bursts of all modules go into one
    // of the receive FIFOs, what must not get lost among them into the other.
    let functions = Function::ALL.into_iter().filter(|function| *function != Function::LatentFragment);
    let mut filters = 0;
    for (slot, function) in functions.enumerate() {
        let second = !matches!(function, Function::State | Function::Latent);
        RAM.flssa(slot).write_value(element::filter(function.id(0), FUNCTION, second));
        filters += 1;
    }
    CAN.rxgfc().write(|w| {
        w.set_lss(filters);
        w.set_lse(0);
        // What no filter knows is not for us, nor are remote frames.
        w.set_anfs(Anfs::REJECT);
        w.set_anfe(Anfe::REJECT);
        w.set_rrfs(true);
        w.set_rrfe(true);
    });

    // Every transmit buffer reports that its frame got through, and that it came back.
    CAN.txbtie().write(|w| (0..3).for_each(|slot| w.set_tie(slot, true)));
    CAN.txbcie().write(|w| (0..3).for_each(|slot| w.set_cfie(slot, true)));
    CAN.ie().write(|w| {
        for fifo in 0..2 {
            w.set_rfne(fifo, true);
            w.set_rfle(fifo, true);
        }
        w.set_tce(true);
        w.set_tcfe(true);
        w.set_boe(true);
    });
    CAN.ils().write(|w| {
        w.set_smsg(true);
        w.set_perr(true);
    });
    CAN.ile().write(|w| {
        w.set_eint0(true);
        w.set_eint1(true);
    });
    go_online();
}

/// Takes part in the bus; after bus-off that takes 128 times 11 recessive bits.
fn go_online() {
    CAN.cccr().modify(|w| w.set_cce(false));
    CAN.cccr().modify(|w| w.set_init(false));
}

/// Takes what a receive FIFO has.
fn empty(fifo: usize) {
    loop {
        let state = CAN.rxfs(fifo).read();
        if state.ffl() == 0 {
            return;
        }
        let first = element::WORDS * usize::from(state.fgi());
        let frame = element::decode(|number| {
            if fifo == 0 { RAM.rxfifo0(first + number).read() } else { RAM.rxfifo1(first + number).read() }
        });
        CAN.rxfa(fifo).write(|w| w.set_fai(state.fgi()));
        if let Some(frame) = frame {
            TORQUE_OFF.hear(&frame);
            if QUEUE.try_send(frame).is_err() {
                OVERFLOWED.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

#[embassy_stm32::interrupt]
fn FDCAN1_IT0() {
    let flags = CAN.ir().read();
    for fifo in 0..2 {
        CAN.ir().write(|w| {
            w.set_rfn(fifo, true);
            w.set_rfl(fifo, true);
        });
        if flags.rfl(fifo) {
            OVERFLOWED.fetch_add(1, Ordering::Relaxed);
        }
        empty(fifo);
    }
}

#[embassy_stm32::interrupt]
fn FDCAN1_IT1() {
    let flags = CAN.ir().read();
    CAN.ir().write(|w| {
        w.set_tc(true);
        w.set_tcf(true);
        w.set_bo(flags.bo());
    });
    // SAFETY: the main loop is not at it, or this line would be masked; and the handler does not interrupt itself.
    let sender = unsafe { &mut *SENDER.0.get() };
    if flags.bo() {
        let off = CAN.psr().read().bo();
        sender.set_bus_off(off);
        if off {
            // Forgets all requests. The chip is in initialisation now, and stays there until it is told to come back.
            CAN.cccr().modify(|w| w.set_cce(true));
            if RECOVER.load(Ordering::Relaxed) {
                go_online();
            }
        }
    }
    if let Some(frame) = URGENT.lock(Cell::take) {
        sender.push(now(), &frame);
    }
    sender.poll(now(), &mut Buffers);
}
