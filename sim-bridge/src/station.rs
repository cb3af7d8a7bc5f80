//! The ground station: tells the robot where its goal is, and may stop and release it.

use composer_shared::wire::{EmergencyStop, Frame, Goal, Message, STATION, StopCommand};

/// A ground station without I/O. It answers the SYNC of each control cycle with the GOAL of that cycle.
#[derive(Clone, Debug)]
pub struct Station {
    fd: bool,
    answered: Option<u16>,
}

impl Station {
    /// A station on a CAN-FD bus, or on a classic one.
    pub fn new(fd: bool) -> Self {
        Station { fd, answered: None }
    }

    /// Takes a received frame; `goal` is where the goal is now (robot units, frame of the head link). Returns the frame to send, if
    /// this was the SYNC of a new cycle. Frames that are malformed or none of its business are ignored.
    pub fn receive(&mut self, frame: &Frame, goal: Option<[f32; 3]>) -> Option<Frame> {
        let Ok(Message::Sync(sync)) = Message::parse(frame) else { return None };
        if self.answered == Some(sync.cycle) {
            return None;
        }
        self.answered = Some(sync.cycle);
        Some(Message::Goal(Goal::new(sync.cycle as u8, goal)).emit(STATION, self.fd))
    }

    /// The frame that stops all modules, or releases them again.
    pub fn command(&self, command: StopCommand) -> Frame {
        Message::EmergencyStop(EmergencyStop::new(command, 0)).emit(STATION, self.fd)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::Sync;

    #[test]
    fn each_cycle_is_answered_once() {
        let mut station = Station::new(true);
        let sync = |cycle| Message::Sync(Sync::new(cycle, 8)).emit(0, true);
        let goal = station.receive(&sync(300), Some([1.0, 2.0, -3.0])).unwrap();
        let Ok(Message::Goal(goal)) = Message::parse(&goal) else { panic!("{goal:?}") };
        assert_eq!((goal.cycle, goal.position()), (300u16 as u8, Some([1.0, 2.0, -3.0])));
        assert_eq!(station.receive(&sync(300), None), None);
        assert!(station.receive(&sync(301), None).is_some());
        assert_eq!(station.receive(&Frame::new(0x080, true, &[1, 2, 3]).unwrap(), None), None);
    }

    #[test]
    fn it_stops_and_releases() {
        for command in [StopCommand::Stop, StopCommand::Release] {
            let frame = Station::new(false).command(command);
            assert!(matches!(Message::parse(&frame), Ok(Message::EmergencyStop(stop)) if stop.command() == command));
        }
    }
}
