//! The module's side of the link: a controller that is asked by messages.

use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::AXES;

use super::{BUILD, Carried, FromModule, LinkError, PROTOCOL, Sample, Status, Text, ToModule, Weights};
use crate::controller::{Controller, FIRMWARE_VERSION};

/// What a module says when it has booted.
pub fn hello(policy: Option<&Policy<'_>>) -> FromModule<'static> {
    FromModule::Hello { protocol: PROTOCOL, firmware: FIRMWARE_VERSION, build: BUILD, policy: policy.map(Policy::tag) }
}

/// A module at the end of a link.
#[derive(Clone, Debug)]
pub struct Module<'a> {
    policy: Policy<'a>,
    controller: Option<Controller<'a>>,
    sensors: Sensors,
    /// The torque that the simulator knows, by its bits.
    torque: [u32; AXES],
}

impl<'a> Module<'a> {
    /// A module with this policy in its flash that has not been started.
    pub fn new(policy: Policy<'a>) -> Self {
        Module { policy, controller: None, sensors: Sensors::ZERO, torque: [0; AXES] }
    }

    /// Does what a message says and sends the answer.
    pub fn serve(&mut self, request: Result<ToModule, LinkError>, send: &mut impl FnMut(&FromModule<'_>)) {
        match request {
            Ok(ToModule::Start { config, boot, now }) => {
                // Not `*self = Module::new(..)`: that would be one more controller on the stack.
                self.controller = None;
                self.sensors = Sensors::ZERO;
                self.torque = [0; AXES];
                match Controller::new(config, self.policy, boot, now) {
                    Ok(controller) => self.controller = Some(controller),
                    Err(error) => send(&FromModule::Refused(Text::of(error).as_str())),
                }
            }
            Ok(request) => match &mut self.controller {
                Some(controller) => answer(controller, &mut self.sensors, &mut self.torque, &request, send),
                None => send(&FromModule::Refused("the module has not been started")),
            },
            Err(error) => send(&FromModule::Refused(Text::of(error).as_str())),
        }
    }
}

fn answer(
    controller: &mut Controller<'_>,
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
            let outputs = controller.poll(*now, sensors, frame.as_ref().map(|frame| &frame.0), *bus);
            let bits = outputs.torque.map(f32::to_bits);
            let changed = bits != *torque;
            *torque = bits;
            send_frames(controller, *room, send);
            send(&FromModule::Answer {
                torque: changed.then_some(outputs.torque),
                motors_enabled: outputs.motors_enabled,
                deadline: outputs.deadline,
                acted: controller.stats().acted,
            });
        }
        ToModule::Frames { room } => {
            send_frames(controller, *room, send);
            send(&FromModule::Sent);
        }
        ToModule::Status => send(&FromModule::Status(Status {
            mode: controller.mode() as u8,
            cycle: controller.cycle(),
            time_keeper: controller.time_keeper(),
            alive: controller.alive(),
            heard: controller.heard(),
            faults: controller.faults(),
            stats: *controller.stats(),
            retained: controller.retained(),
            attention: Weights { all: *controller.attention(), modules: controller.config().modules },
        })),
        // Served before there is a controller.
        ToModule::Start { .. } => {}
    }
}

fn send_frames(controller: &mut Controller<'_>, room: u8, send: &mut impl FnMut(&FromModule<'_>)) {
    for _ in 0..room {
        let Some(frame) = controller.next_frame() else { break };
        send(&FromModule::Frame(Carried(frame)));
    }
}
