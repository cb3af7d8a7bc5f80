//! Error confinement of ISO 11898-1:2015: the counters of a node, and how it may take part in the bus because of them.

/// How a node takes part in the bus (ISO 11898-1:2015, 12.1.4.1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ErrorState {
    /// Signals errors with a dominant flag.
    #[default]
    Active,
    /// Signals errors with a recessive flag, which disturbs nobody.
    Passive,
    /// Takes no part.
    BusOff,
}

/// Transmit and receive error counters and the rules that change them (ISO 11898-1:2015, 12.1.4.2, rules a to l).
///
/// Rules d, e and f (errors within an error flag) cannot arise here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounters {
    /// Transmit error counter.
    pub transmit: u16,
    /// Receive error counter.
    pub receive: u16,
}

impl ErrorCounters {
    /// Rules i, j, k: error passive when a counter exceeds 127, bus-off when the transmit counter exceeds 255.
    pub fn state(self) -> ErrorState {
        if self.transmit > 255 {
            ErrorState::BusOff
        } else if self.transmit > 127 || self.receive > 127 {
            ErrorState::Passive
        } else {
            ErrorState::Active
        }
    }

    /// Rules a and b: a receiver that detects an error adds 1, and 8 more if it sees a dominant bit right after its own error flag,
    /// which means that it was the first to detect the error.
    pub fn receive_error(&mut self, first: bool) {
        self.receive = (self.receive + if first { 9 } else { 1 }).min(255);
    }

    /// Rule c: a transmitter that sends an error flag adds 8, except (exception 1) an error-passive one that misses an acknowledgement
    /// and sees no dominant bit while it sends its flag: a node alone on the bus does not drive itself bus-off.
    pub fn transmit_error(&mut self, missing_acknowledgement: bool) {
        if !(missing_acknowledgement && self.state() == ErrorState::Passive) {
            self.transmit += 8;
        }
    }

    /// Rule g: a successful transmission takes 1 off.
    pub fn transmitted(&mut self) {
        self.transmit = self.transmit.saturating_sub(1);
    }

    /// Rule h: a successful reception takes 1 off, or brings a counter above 127 to a value between 119 and 127 (here 127).
    pub fn received(&mut self) {
        self.receive = if self.receive > 127 { 127 } else { self.receive.saturating_sub(1) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counters(transmit: u16, receive: u16) -> ErrorCounters {
        ErrorCounters { transmit, receive }
    }

    /// Rules a, b, c, g, h, i, k.
    #[test]
    fn the_counters_follow_the_rules() {
        let mut c = counters(0, 0);
        c.transmitted();
        c.received();
        assert_eq!(c, counters(0, 0));
        c.receive_error(false);
        assert_eq!(c, counters(0, 1));
        c.receive_error(true);
        assert_eq!(c, counters(0, 10));
        c.received();
        assert_eq!(c, counters(0, 9));
        c.transmit_error(false);
        c.transmitted();
        assert_eq!(c, counters(7, 9));
        for (pair, state) in [
            ((127, 127), ErrorState::Active),
            ((128, 0), ErrorState::Passive),
            ((0, 128), ErrorState::Passive),
            ((255, 0), ErrorState::Passive),
            ((256, 0), ErrorState::BusOff),
        ] {
            assert_eq!(counters(pair.0, pair.1).state(), state, "{pair:?}");
        }
        let mut passive = counters(128, 200);
        passive.received();
        assert!((119..=127).contains(&passive.receive));
        passive.transmit_error(true);
        assert_eq!(passive.transmit, 128);
        passive.transmit_error(false);
        assert_eq!(passive.transmit, 136);
    }
}
