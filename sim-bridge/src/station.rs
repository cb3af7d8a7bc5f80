//! The ground station: arms the robot, tells it where its goal is, and may stop and release it.

use std::collections::VecDeque;

use composer_shared::wire::{
    ALL_MODULES, EmergencyStop, Frame, Goal, Health, Message, Operation, STATION, ServiceRequest, StopCommand,
    StopLatch,
};

/// Control cycles between two ARM requests.
pub const ARM_EVERY: u8 = 20;

/// A ground station without I/O. It answers the SYNC of each control cycle with the GOAL frames of that cycle, one for each point of
/// the scene. While it wants the robot armed it says so every [`ARM_EVERY`] cycles, so that a module that comes in later joins. It
/// follows the stops and releases of the robot, and repeats its own to modules that have not heard of them.
#[derive(Clone, Debug)]
pub struct Station {
    fd: bool,
    points: u8,
    answered: Option<u16>,
    arming: bool,
    /// Cycles until the next ARM.
    arm_in: u8,
    stop: StopLatch,
    /// A module knows of an older stop or release only.
    repeat: bool,
    sequence: u8,
}

impl Station {
    /// A station on a CAN-FD bus, or on a classic one, that tells so many points and wants the robot armed.
    pub fn new(fd: bool, points: u8) -> Self {
        Station {
            fd,
            points,
            answered: None,
            arming: true,
            arm_in: ARM_EVERY,
            stop: StopLatch::default(),
            repeat: false,
            sequence: 0,
        }
    }

    /// Takes a received frame; `point` says where a point of the scene is now (robot units, frame of the head link). Returns the frames
    /// to send, in order, if this was the SYNC of a new cycle. Frames that are malformed or none of its business are ignored.
    pub fn receive(&mut self, frame: &Frame, point: impl Fn(u8) -> Option<[f32; 3]>) -> Option<VecDeque<Frame>> {
        let sync = match Message::parse(frame).ok()? {
            Message::Sync(sync) => sync,
            Message::State(state) => return self.follow(state.health),
            Message::Heartbeat(heartbeat) => return self.follow(heartbeat.health),
            Message::EmergencyStop(stop) => {
                self.stop.command(stop.command(), stop.count());
                return None;
            }
            _ => return None,
        };
        if self.answered == Some(sync.cycle) {
            return None;
        }
        self.answered = Some(sync.cycle);
        let goal = |number| Message::Goal(Goal::new(sync.cycle as u8, number, point(number)));
        let mut frames: VecDeque<Frame> = (0..self.points).map(|number| goal(number).emit(STATION, self.fd)).collect();
        if core::mem::take(&mut self.repeat) {
            frames.push_front(self.stop_frame());
        }
        self.arm_in = self.arm_in.saturating_sub(1);
        if self.arming && self.arm_in == 0 && !self.stop.stopped() {
            frames.push_back(self.arm(false));
        }
        Some(frames)
    }

    fn follow(&mut self, health: Health) -> Option<VecDeque<Frame>> {
        self.stop.hear(health.has(Health::EMERGENCY_STOP), health.stop_count());
        self.repeat |= self.stop.count().newer_than(health.stop_count());
        None
    }

    /// The frame that arms all modules; `acknowledge`: even those that restarted though nobody asked for it.
    pub fn arm(&mut self, acknowledge: bool) -> Frame {
        self.arm_in = ARM_EVERY;
        self.sequence = self.sequence.wrapping_add(1);
        let request = ServiceRequest {
            destination: ALL_MODULES,
            operation: Operation::Arm as u8,
            sequence: self.sequence,
            index: 0,
            value: acknowledge.into(),
        };
        Message::ServiceRequest(request).emit(STATION, self.fd)
    }

    /// The frames that stop all modules, or release and arm them again.
    pub fn command(&mut self, command: StopCommand) -> VecDeque<Frame> {
        self.stop.command(command, self.stop.count().next());
        let mut frames = VecDeque::from([self.stop_frame()]);
        if command == StopCommand::Release && self.arming {
            frames.push_back(self.arm(false));
        }
        frames
    }

    /// The last stop or release.
    fn stop_frame(&self) -> Frame {
        let command = if self.stop.stopped() { StopCommand::Stop } else { StopCommand::Release };
        Message::EmergencyStop(EmergencyStop::new(command, 0, self.stop.count())).emit(STATION, self.fd)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::{State, StopCount, Sync};

    fn sync(cycle: u16) -> Frame {
        Message::Sync(Sync::new(cycle, 8, 8)).emit(0, true)
    }

    #[test]
    fn each_cycle_is_answered_once() {
        let mut station = Station::new(true, 3);
        let frames = station.receive(&sync(300), |n| (n != 1).then_some([1.0, 2.0, -f32::from(n)])).unwrap();
        let goals = frames.iter().map(|frame| match Message::parse(frame) {
            Ok(Message::Goal(goal)) => (goal.cycle, goal.point(), goal.position()),
            other => panic!("{other:?}"),
        });
        let cycle = 300u16 as u8;
        let expected = [(cycle, 0, Some([1.0, 2.0, 0.0])), (cycle, 1, None), (cycle, 2, Some([1.0, 2.0, -2.0]))];
        assert_eq!(goals.collect::<Vec<_>>(), expected);
        assert_eq!(station.receive(&sync(300), |_| None), None);
        assert!(station.receive(&sync(301), |_| None).is_some());
        assert_eq!(station.receive(&Frame::new(0x080, true, &[1, 2, 3]).unwrap(), |_| None), None);
    }

    #[test]
    fn it_arms_once_a_second_and_never_while_stopped() {
        let mut station = Station::new(true, 1);
        let mut armed = Vec::new();
        for cycle in 0..100 {
            if cycle == 50 {
                station.command(StopCommand::Stop);
            }
            if cycle == 90 {
                assert_eq!(station.command(StopCommand::Release).len(), 2, "released, then armed at once");
            }
            let frames = station.receive(&sync(cycle), |_| None).unwrap();
            let arm = |frame: &Frame| match Message::parse(frame) {
                Ok(Message::ServiceRequest(r)) => r.operation == Operation::Arm as u8 && r.value == 0,
                _ => false,
            };
            armed.extend(frames.iter().any(arm).then_some(cycle));
        }
        assert_eq!(armed, [19, 39]);
    }

    #[test]
    fn its_stops_and_releases_are_newer_than_all_that_it_heard_of() {
        let mut station = Station::new(false, 1);
        let health = Health::EMERGENCY_STOP.with_stop_count(StopCount::new(15));
        station.receive(&Message::State(State::new(0, health, &[0.0; 4])).emit(3, false), |_| None);
        for (command, number) in [(StopCommand::Release, 1), (StopCommand::Stop, 2)] {
            let frame = station.command(command)[0];
            let stop = EmergencyStop::new(command, 0, StopCount::new(number));
            assert_eq!(Message::parse(&frame), Ok(Message::EmergencyStop(stop)));
        }
        // A module that lost the frame says so by its STATE, and is told again.
        station.receive(&Message::State(State::new(1, health, &[0.0; 4])).emit(3, false), |_| None);
        let frames = station.receive(&sync(2), |_| None).unwrap();
        assert!(matches!(Message::parse(&frames[0]), Ok(Message::EmergencyStop(stop)) if stop.count().number() == 2));
    }
}
