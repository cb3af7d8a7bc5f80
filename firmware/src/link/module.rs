//! The module's side of the link: a controller that is asked by messages.

use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::AXES;
use composer_shared::wire::NOBODY;

use super::{BUILD, Carried, FromModule, LinkError, PROTOCOL, Sample, Status, Text, ToModule, Weights};
use crate::controller::{Controller, FIRMWARE_VERSION};
use crate::emulated::{Emulated, Lasting};
use crate::node_page::Calibration;
use crate::torque_off::Interrupt;

/// What a module says when it has booted.
pub fn hello(policy: Option<&Policy<'_>>) -> FromModule<'static> {
    FromModule::Hello { protocol: PROTOCOL, firmware: FIRMWARE_VERSION, build: BUILD, policy: policy.map(Policy::tag) }
}

/// A module at the end of a link.
#[derive(Clone, Debug)]
pub struct Module<'a, F> {
    module: Emulated<'a, F>,
    sensors: Sensors,
    /// The torque that the simulator knows, by its bits.
    torque: [u32; AXES],
}

impl<'a, F: Lasting<'a>> Module<'a, F> {
    /// A module that was made with this policy, with its flash for others, that has not been started.
    pub fn new(policy: Policy<'a>, policies: F) -> Self {
        Module { module: Emulated::new(policy, policies), sensors: Sensors::ZERO, torque: [0; AXES] }
    }

    /// Does what a message says and sends the answer.
    pub fn serve(&mut self, request: Result<ToModule, LinkError>, send: &mut impl FnMut(&FromModule<'_>)) {
        match request {
            Ok(ToModule::Start { config, boot, now }) => {
                self.sensors = Sensors::ZERO;
                self.torque = [0; AXES];
                if let Err(error) = self.module.start(config, boot, now, Calibration::NOMINAL) {
                    send(&FromModule::Refused(Text::of(error).as_str()));
                }
            }
            Ok(request) if self.module.is_started() => {
                answer(&mut self.module, &mut self.sensors, &mut self.torque, &request, send);
            }
            Ok(_) => send(&FromModule::Refused("the module has not been started")),
            Err(error) => send(&FromModule::Refused(Text::of(error).as_str())),
        }
    }
}

fn answer<'a, F: Lasting<'a>>(
    module: &mut Emulated<'a, F>,
    sensors: &mut Sensors,
    torque: &mut [u32; AXES],
    request: &ToModule,
    send: &mut impl FnMut(&FromModule<'_>),
) {
    match request {
        ToModule::Poll { now, bus, room, sensors: sample, frame } => {
            if let Some(Sample(sample)) = sample {
                *sensors = *sample;
            }
            let outputs = module.poll(*now, sensors, frame.as_ref().map(|frame| &frame.0), *bus);
            let bits = outputs.torque.map(f32::to_bits);
            let changed = bits != *torque;
            *torque = bits;
            send_frames(module, *room, send);
            send(&FromModule::Answer {
                torque: changed.then_some(outputs.torque),
                motors_enabled: outputs.motors_enabled,
                deadline: outputs.deadline,
                acted: module.controller().map_or(0, |controller| controller.stats().acted),
                node: module.controller().map_or(NOBODY, |controller| controller.config().node),
            });
        }
        ToModule::Frames { room } => {
            send_frames(module, *room, send);
            send(&FromModule::Sent);
        }
        ToModule::Status => send(&FromModule::Status(status(module.controller()))),
        ToModule::Interrupt { frame } => {
            let interrupt = frame.as_ref().map_or(Interrupt::StopInput, |frame| Interrupt::Frame(&frame.0));
            let (off, told) = module.interrupt(interrupt);
            if let Some(frame) = told {
                send(&FromModule::Frame(Carried(frame)));
            }
            send(&FromModule::Interrupted { off });
        }
        // Served before there is a controller.
        ToModule::Start { .. } => {}
    }
}

/// What the controller is at. A module that could not start again says that it is off.
fn status(controller: Option<&Controller<'_>>) -> Status {
    let Some(controller) = controller else { return Status::off() };
    Status {
        mode: controller.mode() as u8,
        cycle: controller.cycle(),
        time_keeper: controller.time_keeper(),
        alive: controller.alive(),
        heard: controller.heard(),
        faults: controller.faults(),
        stats: *controller.stats(),
        retained: controller.retained(),
        attention: Weights { all: *controller.attention(), modules: controller.config().modules },
    }
}

fn send_frames<'a, F: Lasting<'a>>(module: &mut Emulated<'a, F>, room: u8, send: &mut impl FnMut(&FromModule<'_>)) {
    for _ in 0..room {
        let Some(frame) = module.next_frame() else { break };
        send(&FromModule::Frame(Carried(frame)));
    }
}
