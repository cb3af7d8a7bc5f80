//! The ground station: tells the robot where its goal is, and may stop and release it.

use std::collections::VecDeque;

use composer_shared::wire::{EmergencyStop, Frame, Goal, Message, STATION, StopCommand, StopCount};

/// A ground station without I/O. It answers the SYNC of each control cycle with the GOAL frames of that cycle, one for each point of
/// the scene.
#[derive(Clone, Debug)]
pub struct Station {
    fd: bool,
    points: u8,
    answered: Option<u16>,
}

impl Station {
    /// A station on a CAN-FD bus, or on a classic one, that tells so many points.
    pub fn new(fd: bool, points: u8) -> Self {
        Station { fd, points, answered: None }
    }

    /// Takes a received frame; `point` says where a point of the scene is now (robot units, frame of the head link). Returns the frames
    /// to send, in order, if this was the SYNC of a new cycle. Frames that are malformed or none of its business are ignored.
    pub fn receive(&mut self, frame: &Frame, point: impl Fn(u8) -> Option<[f32; 3]>) -> Option<VecDeque<Frame>> {
        let Ok(Message::Sync(sync)) = Message::parse(frame) else { return None };
        if self.answered == Some(sync.cycle) {
            return None;
        }
        self.answered = Some(sync.cycle);
        let goal = |number| Message::Goal(Goal::new(sync.cycle as u8, number, point(number)));
        Some((0..self.points).map(|number| goal(number).emit(STATION, self.fd)).collect())
    }

    /// The frame that stops all modules, or releases them again.
    pub fn command(&self, command: StopCommand) -> Frame {
        Message::EmergencyStop(EmergencyStop::new(command, 0, StopCount::UNKNOWN)).emit(STATION, self.fd)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::Sync;

    #[test]
    fn each_cycle_is_answered_once() {
        let mut station = Station::new(true, 3);
        let sync = |cycle| Message::Sync(Sync::new(cycle, 8, 8)).emit(0, true);
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
    fn it_stops_and_releases() {
        for command in [StopCommand::Stop, StopCommand::Release] {
            let frame = Station::new(false, 1).command(command);
            assert!(matches!(Message::parse(&frame), Ok(Message::EmergencyStop(stop)) if stop.command() == command));
        }
    }
}
