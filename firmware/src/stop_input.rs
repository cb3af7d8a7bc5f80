//! The stop input of a board: a switch that opens to stop.
//!
//! A closed contact holds the input low and lets the robot run; an open one, a cable that broke, or no switch at all (the input has a pull-up) stops it.
//! An open contact must last [`BOUNCE_US`]. Closing it releases nothing: only the station does.

use crate::controller::Micros;

/// Shorter than this is the bounce of a contact or a spark on the cable, microseconds.
pub const BOUNCE_US: Micros = 5_000;

/// The switch.
#[derive(Clone, Copy, Debug, Default)]
pub struct StopInput {
    /// Since when it has been open.
    open_since: Option<Micros>,
}

impl StopInput {
    /// Takes a reading; whether the robot is to be stopped now.
    pub fn sample(&mut self, now: Micros, open: bool) -> bool {
        if !open {
            self.open_since = None;
            return false;
        }
        let since = *self.open_since.get_or_insert(now);
        now.saturating_sub(since) >= BOUNCE_US
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_open_contact_stops_and_a_bounce_does_not() {
        let mut input = StopInput::default();
        let mut sample = |ms: u64, open| input.sample(ms * 1000, open);
        assert!(!sample(0, false) && !sample(1, true) && !sample(5, true) && !sample(6, false), "a bounce");
        assert!(!sample(7, true) && !sample(11, true) && sample(12, true) && sample(500, true));
        assert!(!sample(501, false));
        assert!(!sample(502, true), "each opening is debounced");
    }
}
