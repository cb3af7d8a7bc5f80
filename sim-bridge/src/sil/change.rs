//! What changes in a run that goes on: faults that begin and end, what the station orders, where the goal is.

use std::mem::discriminant;

use composer_shared::wire::StopCommand;

use super::{Engine, SilError};
use crate::computer::Launcher;
use crate::faults::{Fault, ScheduledFault};
use crate::plant::Plant;

/// Something that changes in a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// Something goes wrong, for so long (ns), or until it is mended. A disturbance of the whole bus replaces the one of its kind.
    Begin(Fault, Option<u64>),
    /// What is wrong in this way and place is mended; how badly it was wrong does not matter.
    End(Fault),
    /// The station stops the robot, or releases it.
    Order(StopCommand),
    /// The goal moves to this place (robot units, the world's frame).
    Goal([f32; 3]),
}

/// Why something cannot change.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// No such module.
    #[error("there is no module {module}: this robot has {modules}, numbered from 0")]
    NoModule {
        /// The one that is asked for.
        module: usize,
        /// How many there are.
        modules: usize,
    },
    /// No cable there.
    #[error("there is no cable behind module {0}: it is the last one")]
    NoCable(usize),
    /// A probability outside of 0 to 1.
    #[error("{0} is no probability: it lies between 0 and 1")]
    Probability(f64),
    /// An identifier that CAN does not have.
    #[error("{0:#x} is no identifier: they go from 0 to 0x7FF")]
    Identifier(u16),
    /// It is so already.
    #[error("{} already", describe(*.0))]
    Already(Fault),
    /// There is nothing to mend.
    #[error("not so: {}", describe_whole(*.0))]
    NotSo(Fault),
    /// A module that is off can do nothing.
    #[error("module {0} has no power: plug it in first")]
    NoPower(usize),
    /// Nobody gives orders.
    #[error("there is no station in this run that could order it: send the frame yourself")]
    NoStation,
    /// The plant cannot do that.
    #[error("this plant has no goal that can be moved: its task says where things are")]
    NoGoal,
    /// A place that no goal can be at.
    #[error("a goal cannot be there: its coordinates are numbers within 1000 units")]
    NoPlace,
}

fn describe(fault: Fault) -> String {
    match fault {
        Fault::Unplug(m) => format!("module {m} is unplugged"),
        Fault::BrownOut(m) => format!("the supply of module {m} is down"),
        Fault::ActuatorDead(m) => format!("the motors of module {m} are dead"),
        Fault::SensorZeroed(m) => format!("the sensors of module {m} read zero"),
        Fault::SensorStuck(m) => format!("the sensors of module {m} are stuck"),
        Fault::Babble(m, _) => format!("module {m} babbles"),
        Fault::Cut(m) => format!("the cable is cut behind module {m}"),
        Fault::Misread(m, _) => format!("module {m} misreads frames"),
        Fault::Drop(_) => "frames are lost".into(),
        Fault::Delay(_) => "frames are late".into(),
        Fault::Corrupt(_) => "frames are corrupted".into(),
        Fault::Duplicate(_) => "frames are doubled".into(),
    }
}

fn describe_whole(fault: Fault) -> String {
    match fault {
        Fault::Unplug(m) | Fault::BrownOut(m) => format!("module {m} is plugged in"),
        Fault::ActuatorDead(m) => format!("the motors of module {m} work"),
        Fault::SensorZeroed(m) | Fault::SensorStuck(m) => format!("the sensors of module {m} work"),
        Fault::Babble(m, _) => format!("module {m} does not babble"),
        Fault::Cut(m) => format!("the cable is whole behind module {m}"),
        Fault::Misread(m, _) => format!("module {m} reads all frames"),
        Fault::Drop(_) => "no frames are lost".into(),
        Fault::Delay(_) => "no frames are late".into(),
        Fault::Corrupt(_) => "no frames are corrupted".into(),
        Fault::Duplicate(_) => "no frames are doubled".into(),
    }
}

/// Whether two faults are of one kind and in one place.
fn same(a: &Fault, b: &Fault) -> bool {
    let cut = |fault: &Fault| if let Fault::Cut(m) = fault { Some(*m) } else { None };
    discriminant(a) == discriminant(b) && a.module() == b.module() && cut(a) == cut(b)
}

impl<L: Launcher> Engine<'_, L> {
    /// See [`super::Simulation::change`].
    pub(super) fn change<P: Plant + ?Sized>(
        &mut self,
        plant: &mut P,
        change: Change,
        now: u64,
    ) -> Result<Result<(), Refusal>, SilError> {
        match change {
            Change::Begin(fault, length) => {
                if let Err(refusal) = self.can_begin(&fault) {
                    return Ok(Err(refusal));
                }
                if fault.module().is_none() && !matches!(fault, Fault::Cut(_)) {
                    self.end(&fault, now);
                }
                let until_ns = length.map(|length| now.saturating_add(length));
                if let Some(until) = until_ns {
                    let place = self.changes[self.next_change..].partition_point(|change| change.0 <= until);
                    self.changes.insert(self.next_change + place, (until, false, fault));
                }
                self.active.push(fault);
                self.config.faults.push(ScheduledFault { at_ns: now, until_ns, fault });
            }
            Change::End(fault) => {
                if let Err(refusal) = self.exists(&fault) {
                    return Ok(Err(refusal));
                }
                let lost = fault.module().filter(|_| matches!(fault, Fault::Unplug(_)));
                let lost = lost.is_some_and(|module| std::mem::take(&mut self.modules[module].lost));
                if !self.end(&fault, now) && !lost {
                    return Ok(Err(Refusal::NotSo(fault)));
                }
            }
            Change::Order(command) => {
                if !self.config.station {
                    return Ok(Err(Refusal::NoStation));
                }
                self.order(command, now);
                return Ok(Ok(()));
            }
            Change::Goal(place) => {
                if !place.iter().all(|x| (-1000.0..=1000.0).contains(x)) {
                    return Ok(Err(Refusal::NoPlace));
                }
                return Ok(if plant.move_goal(place) { Ok(()) } else { Err(Refusal::NoGoal) });
            }
        }
        self.obey_faults(plant, now)?;
        Ok(Ok(()))
    }

    /// Ends what is active of this kind in this place; whether anything was.
    fn end(&mut self, fault: &Fault, now: u64) -> bool {
        let before = self.active.len();
        self.active.retain(|active| !same(active, fault));
        let next = self.next_change;
        let mut index = 0;
        // What would have ended it later has nothing left to end.
        self.changes.retain(|(_, starts, ending)| {
            index += 1;
            index <= next || *starts || !same(ending, fault)
        });
        for scheduled in &mut self.config.faults {
            if same(&scheduled.fault, fault) && scheduled.active(now) {
                scheduled.until_ns = Some(now);
            }
        }
        self.active.len() < before
    }

    /// Whether there is a place where this can be.
    fn exists(&self, fault: &Fault) -> Result<(), Refusal> {
        let modules = self.modules.len();
        match *fault {
            Fault::Cut(module) if module + 1 == modules => Err(Refusal::NoCable(module)),
            Fault::Cut(module) if module >= modules => Err(Refusal::NoModule { module, modules }),
            _ => match fault.module().filter(|module| *module >= modules) {
                Some(module) => Err(Refusal::NoModule { module, modules }),
                None => Ok(()),
            },
        }
    }

    fn can_begin(&self, fault: &Fault) -> Result<(), Refusal> {
        self.exists(fault)?;
        match *fault {
            Fault::Drop(p) | Fault::Corrupt(p) | Fault::Duplicate(p) | Fault::Misread(_, p)
                if !(0.0..=1.0).contains(&p) =>
            {
                return Err(Refusal::Probability(p));
            }
            Fault::Babble(_, id) if id > 0x7ff => return Err(Refusal::Identifier(id)),
            _ => {}
        }
        let placed = fault.module().is_some() || matches!(fault, Fault::Cut(_));
        if placed && self.active.iter().any(|active| same(active, fault)) {
            return Err(Refusal::Already(*fault));
        }
        match *fault {
            Fault::BrownOut(module) | Fault::Babble(module, _) if self.modules[module].controller.is_none() => {
                Err(Refusal::NoPower(module))
            }
            _ => Ok(()),
        }
    }
}
