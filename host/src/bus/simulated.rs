//! A simulated robot whose station is a program of this process, in the bus's own time: the same run every time, and no faster or slower machine changes it.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use composer_shared::policy::Policy;
use composer_shared::wire::Frame;
use composer_sim_bridge::Plant;
use composer_sim_bridge::computer::Launcher;
use composer_sim_bridge::sil::{self, CycleView, Outside, SilConfig, SilError, SilReport, Turn};

use super::{BusError, Station, Transport};

/// What the station wants of the simulation.
enum Wish {
    Send(Frame),
    Receive(Duration),
}

/// What it gets: the time on the bus, ns, and perhaps a frame.
type Answer = (u64, Option<Frame>);

/// The station's end.
struct Wire {
    wishes: Sender<Wish>,
    answers: Receiver<Answer>,
    now: u64,
    fd: bool,
}

impl Wire {
    fn ask(&mut self, wish: Wish) -> Result<Option<Frame>, BusError> {
        let over =
            |_| BusError::Failed { transport: "the simulated bus".into(), reason: "the simulation is over".into() };
        self.wishes.send(wish).map_err(|_| over(()))?;
        let (now, frame) = self.answers.recv().map_err(|_| over(()))?;
        self.now = now;
        Ok(frame)
    }
}

impl Transport for Wire {
    fn send(&mut self, frame: &Frame) -> Result<(), BusError> {
        self.ask(Wish::Send(*frame)).map(drop)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<Frame>, BusError> {
        self.ask(Wish::Receive(patience))
    }

    fn fd(&self) -> bool {
        self.fd
    }

    fn now(&self) -> Duration {
        Duration::from_nanos(self.now)
    }
}

/// The simulation's end.
struct Meeting {
    wishes: Receiver<Wish>,
    answers: Sender<Answer>,
    heard: VecDeque<Frame>,
    /// Until when the station waits for a frame, ns.
    until: Option<u64>,
}

impl Outside for Meeting {
    fn nodes(&self) -> usize {
        1
    }

    fn wait(&mut self, now: u64, _next: u64) -> Turn {
        loop {
            if let Some(until) = self.until {
                let frame = self.heard.pop_front();
                if frame.is_none() && now < until {
                    return Turn::GoOn;
                }
                self.until = None;
                if self.answers.send((now, frame)).is_err() {
                    return Turn::End;
                }
            }
            match self.wishes.recv() {
                Ok(Wish::Send(frame)) => {
                    return match self.answers.send((now, None)) {
                        Ok(()) => Turn::Send { node: 0, at_ns: now, frame },
                        Err(_) => Turn::End,
                    };
                }
                // Whoever has no patience left must not stop the time.
                Ok(Wish::Receive(patience)) => self.until = Some(now + (patience.as_nanos() as u64).max(1_000)),
                // The station has done what it wanted.
                Err(_) => return Turn::End,
            }
        }
    }

    fn hear(&mut self, _node: usize, frame: &Frame) {
        self.heard.push_back(*frame);
    }
}

/// Runs a robot with `client` as its station until that is done. Gives what it came to, and the run. The modules are switched on in the calling thread.
///
/// `config` ought to have no station of its own.
pub fn with_station<P: Plant, L: Launcher, T: Send>(
    launcher: &L,
    plant: &mut P,
    policy: Policy<'_>,
    config: &SilConfig,
    capture: Option<&mut dyn std::io::Write>,
    client: impl FnOnce(&mut Station) -> T + Send,
) -> Result<(T, SilReport), SilError> {
    let (wishes, wished) = channel();
    let (answers, answered) = channel();
    let fd = config.bus == composer_firmware::controller::BusKind::Fd;
    let mut meeting = Meeting { wishes: wished, answers, heard: VecDeque::new(), until: None };
    std::thread::scope(|scope| {
        let client =
            scope.spawn(move || client(&mut Station::new(Box::new(Wire { wishes, answers: answered, now: 0, fd }))));
        let report = sil::run_with(
            launcher,
            plant,
            policy,
            config,
            Some(&mut meeting),
            capture,
            &mut |_: &CycleView<'_>, _: &P| {},
        );
        // If the run is over first, the station is told by this.
        drop(meeting);
        match client.join() {
            Ok(result) => Ok((result, report?)),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}

/// A robot that lies still and never ends, in steps short enough for a station.
#[derive(Clone, Copy, Debug)]
pub struct Still {
    /// Modules.
    pub modules: usize,
}

impl Plant for Still {
    fn modules(&self) -> usize {
        self.modules
    }

    fn step_ns(&self) -> u64 {
        100_000
    }

    fn sensors(&self, _module: usize) -> composer_shared::observation::Sensors {
        use composer_shared::observation::Sensors;
        Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
    }

    fn point(&self, _number: u8) -> Option<[f32; 3]> {
        None
    }

    fn set_torque(&mut self, _module: usize, _torque: [f32; composer_shared::robot::AXES]) {}

    fn step(&mut self) {}

    fn done(&self) -> bool {
        false
    }
}
