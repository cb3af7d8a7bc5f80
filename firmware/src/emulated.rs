//! A module without hardware, emulated or simulated: controller and service as on a board, with a flash that is memory, and chips whose readings
//! follow from what the simulator says.
//!
//! The simulator says what is true of the module: its joint angles, which way is up. What the module makes of it depends on how its hardware is
//! [mounted](Hardware::mounted) and on what its node page says of that. If both agree, it senses what is true. If they do not, it is a module that
//! has yet to be calibrated.

use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::{AXES, MAX_JOINTS};
use composer_shared::update::{NO_KEY, Slot};
use composer_shared::wire::Frame;
use nalgebra::{Matrix3, Vector3};

use crate::boot::{Boot, ResetCause};
use crate::controller::{BusKind, BusStatus, Config, ConfigError, Controller, Micros, Outputs, Timing};
use crate::drivers::encoder::{JointCalibration, STEPS};
use crate::node_page::{Calibration, NodePage};
use crate::port::PortStatus;
use crate::safety::Safety;
use crate::service::{Board, Raw, Service};
use crate::storage::{RamFlash, read_page};
use crate::torque_off::{Interrupt, TorqueOff};
use crate::update::{PolicyFlash, Updater, image_of};

/// Bytes of an emulated flash.
const FLASH_SIZE: usize = 4 * 256;
/// The supply of a simulated robot, V.
const SUPPLY: f32 = 12.0;

/// Flash with policies whose images stay where they are for as long as `'a`: a controller borrows its policy.
pub trait Lasting<'a>: PolicyFlash {
    /// The image in a slot. The slot must not be written while a controller runs with it; [`Updater`] never does.
    fn lasting(&mut self, slot: Slot) -> Option<&'a [u8]>;
}

impl<'a> Lasting<'a> for crate::update::NoPolicies {
    fn lasting(&mut self, _: Slot) -> Option<&'a [u8]> {
        None
    }
}

/// What stands for the hardware of a module.
#[derive(Clone, Debug)]
pub struct Hardware<F> {
    /// How encoders, inertial sensor and motors really are.
    pub mounted: Calibration,
    unique_id: [u32; 3],
    storage: RamFlash<FLASH_SIZE>,
    policies: F,
    /// What is true now.
    truth: Sensors,
    /// Torque for which [`Sensors::torque`] says 1.
    torque_limit: f32,
    bus: BusStatus,
}

impl<F> Hardware<F> {
    fn off(policies: F) -> Self {
        Hardware {
            mounted: Calibration::NOMINAL,
            unique_id: [0; 3],
            storage: RamFlash::ERASED,
            policies,
            truth: Sensors::ZERO,
            torque_limit: 1.0,
            bus: BusStatus::ErrorActive,
        }
    }

    /// What the module senses if its page says that it is calibrated like this.
    fn sensed(&self, page: &Calibration) -> Sensors {
        let mut sensors = self.truth;
        let joints = sensors.joint_angles.iter_mut().zip(&mut sensors.joint_speeds);
        for ((angle, speed), (page, mounted)) in joints.zip(page.joints.iter().zip(&self.mounted.joints)) {
            if let Some(reading) = reading(mounted, *angle) {
                *angle = page.angle(reading);
            }
            if page.reversed != mounted.reversed {
                *speed = -*speed;
            }
        }
        let turned = |v: [f32; 3]| {
            (matrix(page.imu_mounting) * matrix(self.mounted.imu_mounting).transpose() * Vector3::from(v)).into()
        };
        sensors.up = turned(sensors.up);
        sensors.angular_rate = turned(sensors.angular_rate);
        sensors
    }

    /// The torque that the motors give when they are told this one.
    fn given(&self, page: &Calibration, torque: [f32; AXES]) -> [f32; AXES] {
        let mut given = torque;
        for (given, (page, mounted)) in given.iter_mut().zip(page.motors.iter().zip(&self.mounted.motors)) {
            *given = *given / page.torque_constant * mounted.torque_constant;
        }
        given
    }
}

fn matrix(rows: [[f32; 3]; 3]) -> Matrix3<f32> {
    let [a, b, c] = rows;
    Matrix3::from([a, b, c]).transpose()
}

/// What an encoder that is mounted like this reads at an angle (rad); nothing if that is not a number.
fn reading(mounted: &JointCalibration, angle: f32) -> Option<u16> {
    if !angle.is_finite() {
        return None;
    }
    let angle = if mounted.reversed { -angle } else { angle };
    let steps = libm::roundf(angle * (f32::from(STEPS) / core::f32::consts::TAU)) as i32;
    Some(steps.wrapping_add(mounted.zero.into()).rem_euclid(STEPS.into()) as u16)
}

impl<F: PolicyFlash> Board for Hardware<F> {
    type Flash = RamFlash<FLASH_SIZE>;
    type Policies = F;

    fn policies(&mut self) -> &mut F {
        &mut self.policies
    }

    fn storage(&mut self) -> &mut Self::Flash {
        &mut self.storage
    }

    fn unique_id(&self) -> [u32; 3] {
        self.unique_id
    }

    fn raw(&self) -> Raw {
        let mut encoders = [None; MAX_JOINTS];
        for ((encoder, mounted), angle) in encoders.iter_mut().zip(&self.mounted.joints).zip(self.truth.joint_angles) {
            *encoder = reading(mounted, angle);
        }
        let back = matrix(self.mounted.imu_mounting).transpose();
        let mut currents = self.truth.torque;
        for (current, motor) in currents.iter_mut().zip(&self.mounted.motors) {
            *current *= self.torque_limit / motor.torque_constant;
        }
        Raw {
            encoders,
            encoder_errors: [0; MAX_JOINTS],
            // Without accelerations; a module that is not simulated feels them, too.
            force: (back * Vector3::from(self.truth.up)).into(),
            rate: (back * Vector3::from(self.truth.angular_rate)).into(),
            imu_errors: 0,
            supply: SUPPLY,
            temperatures: [self.truth.temperature; AXES],
            currents,
            // The simulator's port keeps its own counts.
            port: PortStatus { bus: self.bus, ..PortStatus::default() },
        }
    }
}

/// Things to do with the flash at most: a slot to be erased, or a policy to be verified; a page in two places and a few entries of the log are less.
const MOST_WORK: usize = 48;
/// How long a module sleeps that cannot start, us.
const SLEEP_US: u64 = 1_000_000;

/// A module without hardware.
#[derive(Clone, Debug)]
pub struct Emulated<'a, F> {
    /// The policy that it was made with, in slot A until another is confirmed.
    born: Policy<'a>,
    /// The one that it runs with.
    policy: Policy<'a>,
    hardware: Hardware<F>,
    /// What the simulator wants it to be.
    config: Option<Config>,
    /// The page that its first start had, and the one that counts.
    pages: [Option<NodePage>; 2],
    controller: Option<Controller<'a>>,
    service: Option<Service>,
    torque_off: TorqueOff,
}

/// Flash that is memory takes no time: what is on its way gets there at once.
fn settle<F: PolicyFlash>(service: &mut Service, controller: &mut Controller<'_>, hardware: &mut Hardware<F>) {
    for _ in 0..MOST_WORK {
        if !service.is_busy() {
            break;
        }
        service.work(controller, hardware);
    }
}

/// The page of a module that nobody has written one for.
fn first_page(config: &Config, mounted: Calibration) -> NodePage {
    let page = NodePage {
        node: config.node,
        modules: config.modules,
        bus_off: config.bus_off,
        safety: config.safety,
        calibration: mounted,
        keys: [NO_KEY; 2],
    };
    // A simulated robot may keep to less than a page can say.
    if page.check().is_ok() { page } else { NodePage { safety: Safety::BOARD, ..page } }
}

impl<'a, F: Lasting<'a>> Emulated<'a, F> {
    /// A module that is off, made with this policy, and its flash for others.
    pub fn new(policy: Policy<'a>, policies: F) -> Self {
        Emulated {
            born: policy,
            policy,
            hardware: Hardware::off(policies),
            config: None,
            pages: [None; 2],
            controller: None,
            service: None,
            torque_off: TorqueOff::new(),
        }
    }

    /// It starts, for this reason, with new storage, its hardware mounted like this, and a page that says so. Its policies stay.
    pub fn start(&mut self, config: Config, boot: Boot, now: Micros, mounted: Calibration) -> Result<(), ConfigError> {
        let page = first_page(&config, mounted);
        self.hardware.mounted = mounted;
        // "SIM", and the place where it was made.
        self.hardware.unique_id = [0x004d_4953, 0, config.node.into()];
        (self.hardware.storage, self.hardware.truth) = (RamFlash::ERASED, Sensors::ZERO);
        self.hardware.bus = BusStatus::ErrorActive;
        self.pages = [Some(page); 2];
        let begun = self.begin(config, page, boot, now);
        self.config = begun.is_ok().then_some(config);
        begun
    }

    /// Begins anew, with the page that the flash has.
    fn restart(&mut self, now: Micros) {
        let (Some(mut config), [Some(first), _]) = (self.config, self.pages) else { return };
        let page = read_page(&mut self.hardware.storage).unwrap_or(first);
        let kept = self.controller.as_mut().map(|controller| {
            controller.expect_restart();
            controller.retained()
        });
        let boot = kept.map_or_else(Boot::default, |kept| Boot::after(kept, ResetCause::Software));
        (config.node, config.modules, config.bus_off) = (page.node, page.modules, page.bus_off);
        // What the simulator said holds until the page says something else.
        if page.safety != first.safety {
            config.safety = page.safety;
        }
        self.pages = [Some(first), Some(page)];
        // A page for a robot that this build has no room for leaves the module off.
        let _ = self.begin(config, page, boot, now);
    }

    fn begin(&mut self, config: Config, page: NodePage, boot: Boot, now: Micros) -> Result<(), ConfigError> {
        // First make room: two controllers are too much for the stack of an emulated module.
        (self.controller, self.service) = (None, None);
        let usable = |flash: &F, slot| image_of(flash, slot).is_some_and(|image| Policy::parse(image).is_ok());
        let updater = Updater::start(&mut self.hardware.policies, page.keys, usable);
        let slot = updater.started().slot;
        let policy = if slot == Slot::A && !updater.records().state().confirmed {
            self.born
        } else {
            // Without its policy a module does not start.
            let image = self.hardware.policies.lasting(slot).map(Policy::parse);
            let Some(Ok(policy)) = image else { return Ok(()) };
            policy
        };
        let mut config = config;
        if config.timing == Timing::for_policy(&self.born, config.bus, config.modules) {
            config.timing = Timing::for_policy(&policy, config.bus, config.modules);
        }
        self.policy = policy;
        self.hardware.torque_limit = policy.limits().torque;
        let controller = self.controller.insert(Controller::new(config, policy, boot, now)?);
        self.torque_off.restart(controller.stop_latch());
        let service = self.service.insert(Service::new(page, updater, controller, now, &mut self.hardware));
        settle(service, controller, &mut self.hardware);
        Ok(())
    }

    /// Its hardware.
    pub fn hardware(&mut self) -> &mut Hardware<F> {
        &mut self.hardware
    }

    /// The policy that it runs with.
    pub fn policy(&self) -> &Policy<'a> {
        &self.policy
    }

    /// Whether it was ever switched on.
    pub fn is_started(&self) -> bool {
        self.config.is_some()
    }

    /// Its controller, if it is on.
    pub fn controller(&self) -> Option<&Controller<'a>> {
        self.controller.as_ref()
    }

    /// Its service, if it is on.
    pub fn service(&self) -> Option<&Service> {
        self.service.as_ref()
    }

    /// Something interrupts whatever the module computes. Returns whether its motors coast from now on ([`crate::torque_off::WITHIN_US`] later), and what it tells the others
    /// at once.
    pub fn interrupt(&mut self, interrupt: Interrupt<'_>) -> (bool, Option<Frame>) {
        let Some(config) = self.controller.as_ref().map(Controller::config) else { return (true, None) };
        let told = match interrupt {
            Interrupt::Frame(frame) => {
                self.torque_off.hear(frame);
                None
            }
            Interrupt::StopInput => self.torque_off.trip(config.node, config.bus == BusKind::Fd),
        };
        (self.torque_off.is_off(), told)
    }

    /// Goes on to `now`: polls controller and service, and restarts if the station wants it. `truth` is what is true of the module; the torque that comes out is
    /// what its motors give.
    pub fn poll(&mut self, now: Micros, truth: &Sensors, received: Option<&Frame>, bus: BusStatus) -> Outputs {
        if self.service.as_ref().is_some_and(|service| service.restart_due(now)) {
            self.restart(now);
        }
        let (Some(controller), Some(service), [_, Some(page)]) = (&mut self.controller, &mut self.service, &self.pages)
        else {
            return Outputs { torque: [0.0; AXES], motors_enabled: false, deadline: now.saturating_add(SLEEP_US) };
        };
        self.hardware.truth = *truth;
        self.hardware.bus = bus;
        let calibration = &page.calibration;
        let sensed;
        let sensors = if *calibration == self.hardware.mounted {
            truth
        } else {
            sensed = self.hardware.sensed(calibration);
            &sensed
        };
        controller.follow_stop(self.torque_off.latch());
        let mut outputs = controller.poll(now, sensors, received, bus);
        service.poll(now, controller, sensors, received, &mut self.hardware);
        self.torque_off.follow(controller.stop_latch());
        settle(service, controller, &mut self.hardware);
        outputs.deadline = outputs.deadline.min(service.deadline()).max(now.saturating_add(1));
        if *calibration != self.hardware.mounted {
            outputs.torque = self.hardware.given(calibration, outputs.torque);
        }
        outputs
    }

    /// The next frame to send.
    pub fn next_frame(&mut self) -> Option<Frame> {
        let (Some(controller), Some(service)) = (&mut self.controller, &mut self.service) else { return None };
        controller.next_frame().or_else(|| service.next_frame(controller))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::update::NoPolicies;
    use composer_shared::policy::{IMAGE_SIZE, random_image};
    use composer_shared::registers::Register;
    use composer_shared::wire::{Message, Operation, STATION, ServiceCode, ServiceRequest};
    use std::vec::Vec;

    fn truth() -> Sensors {
        let up = [0.6, 0.0, 0.8];
        Sensors { joint_angles: [0.1, -0.2, 0.3, -0.4], joint_speeds: [1.0; 4], up, temperature: 25.0, ..Sensors::ZERO }
    }

    fn image() -> [u8; IMAGE_SIZE] {
        let mut image = [0; IMAGE_SIZE];
        random_image(1, &mut image);
        image
    }

    struct Rig<'a> {
        module: Emulated<'a, NoPolicies>,
        now: Micros,
        sequence: u8,
    }

    impl Rig<'_> {
        fn run(&mut self, frame: Option<Frame>, us: u64) -> Vec<(u8, Message)> {
            let end = self.now + us;
            let mut frame = frame;
            let mut said = Vec::new();
            while self.now < end {
                self.now += 1000;
                self.module.poll(self.now, &truth(), frame.take().as_ref(), BusStatus::ErrorActive);
                let sent = core::iter::from_fn(|| self.module.next_frame());
                said.extend(sent.map(|frame| (frame.module(), Message::parse(&frame).unwrap())));
            }
            said
        }

        /// Asks whoever is there.
        fn ask(&mut self, operation: Operation, index: u8, value: u32) -> (u8, u32) {
            self.sequence += 1;
            let (operation, sequence) = (operation as u8, self.sequence);
            let request = ServiceRequest { destination: 255, operation, sequence, index, value };
            let said = self.run(Some(Message::ServiceRequest(request).emit(STATION, true)), 20_000);
            let answers: Vec<_> = said
                .into_iter()
                .filter_map(|(module, message)| match message {
                    Message::ServiceResponse(response) => Some((module, response)),
                    _ => None,
                })
                .collect();
            assert_eq!(answers.len(), 1, "{request:?}: {answers:?}");
            assert_eq!(answers[0].1.code, ServiceCode::Ok as u8, "{request:?}");
            (answers[0].0, answers[0].1.value)
        }

        fn angle(&mut self, joint: u8) -> f32 {
            f32::from_bits(self.ask(Operation::Read, Register::JointAngle.spec().first + joint, 0).1)
        }

        fn up(&mut self) -> [f32; 3] {
            [0, 1, 2].map(|i| f32::from_bits(self.ask(Operation::Read, Register::Up.spec().first + i, 0).1))
        }

        fn write(&mut self, register: Register, offset: u8, value: u32) {
            self.ask(Operation::Write, register.spec().first + offset, value);
        }

        fn restart(&mut self) {
            self.ask(Operation::Store, 0, 0);
            self.ask(Operation::Restart, 0, 0);
            self.run(None, 200_000);
        }
    }

    fn rig(image: &[u8], mounted: Calibration) -> Rig<'_> {
        let policy = Policy::parse(image).unwrap();
        let mut module = Emulated::new(policy, NoPolicies);
        assert!(!module.is_started());
        module.start(Config::new(3, 8, BusKind::Fd, &policy), Boot::default(), 0, mounted).unwrap();
        let mut rig = Rig { module, now: 0, sequence: 0 };
        rig.run(None, 200_000);
        rig
    }

    #[test]
    fn a_calibrated_module_senses_what_is_true_to_the_last_bit() {
        let image = image();
        let mut rig = rig(&image, Calibration::NOMINAL);
        for (joint, angle) in (0..).zip(truth().joint_angles) {
            assert_eq!(rig.angle(joint), angle);
        }
        assert_eq!(rig.up(), truth().up);
    }

    /// Hardware that is not what the page says is sensed wrongly, until the page is written as the raw readings say.
    #[test]
    fn a_module_is_calibrated_over_the_bus() {
        let image = image();
        let mut mounted = Calibration::NOMINAL;
        mounted.joints[1] = JointCalibration { zero: 4096, reversed: true };
        mounted.imu_mounting = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let mut rig = rig(&image, Calibration::NOMINAL);
        rig.module.hardware().mounted = mounted;
        rig.run(None, 10_000);
        assert!((rig.angle(1) - (core::f32::consts::FRAC_PI_2 + 0.2)).abs() < 1e-3, "{}", rig.angle(1));
        // The page says that the sensor sits straight: what it feels along its y is taken for the module's.
        assert_eq!(rig.up(), [0.0, 0.6, 0.8]);
        let raw = rig.ask(Operation::Read, Register::EncoderRaw.spec().first + 1, 0).1;
        assert_eq!(raw, 4096 + (0.2f32 / core::f32::consts::TAU * 16384.0).round() as u32);
        rig.write(Register::EncoderZero, 1, 4096);
        rig.write(Register::EncoderReversed, 1, 1);
        for (i, value) in (0..).zip(mounted.imu_mounting.as_flattened()) {
            rig.write(Register::ImuMounting, i, value.to_bits());
        }
        rig.restart();
        assert_eq!(rig.angle(1), -0.2);
        assert_eq!(rig.up(), truth().up);
    }

    #[test]
    fn a_new_number_counts_after_a_restart() {
        let image = image();
        let mut rig = rig(&image, Calibration::NOMINAL);
        let node = Register::Node.spec().first;
        assert_eq!(rig.ask(Operation::Write, node, 5), (3, 5));
        assert_eq!(rig.ask(Operation::Read, node, 0), (3, 5));
        rig.restart();
        assert_eq!(rig.ask(Operation::Read, node, 0), (5, 5));
        assert_eq!(rig.ask(Operation::Read, Register::Boots.spec().first, 0).1, 2);
    }
}
