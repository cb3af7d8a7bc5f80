//! Whoever takes part in a run from outside.

use composer_shared::wire::Frame;

use super::{Change, Refusal};

/// Somebody outside of the simulation who takes part in a run: nodes at the tail end of the cable, and how fast time goes.
pub trait Outside {
    /// How many nodes it plays.
    fn nodes(&self) -> usize;

    /// The simulation is at `now` and will go on at `next` (ns) if nobody sends anything before. This may take its time.
    fn wait(&mut self, now: u64, next: u64) -> Turn;

    /// What became of the change that it asked for last, at `now` (ns).
    fn changed(&mut self, _now: u64, _outcome: Result<(), Refusal>) {}

    /// Node `node` of those it plays, from 0, has received a frame that another node sent.
    fn hear(&mut self, node: usize, frame: &Frame);
}

/// What somebody [`Outside`] does next.
#[derive(Clone, Debug, PartialEq)]
pub enum Turn {
    /// Nothing until then.
    GoOn,
    /// One of its nodes sends a frame.
    Send {
        /// Which node, from 0.
        node: usize,
        /// When, ns; held within the time that was asked for.
        at_ns: u64,
        /// What.
        frame: Frame,
    },
    /// Something changes now.
    Change(Change),
    /// The run is to end.
    End,
}
