//! What was heard from the other modules, in which control cycle, and who is alive.
//!
//! Sets of modules are bit masks: bit `j` is module `j`. A frame belongs to the current cycle or, if this module missed or has not yet
//! heard its SYNC, to the next one; frames of any other cycle keep a neighbour alive and say nothing else.

use composer_shared::policy::Latent;
use composer_shared::robot::ROOM;
use composer_shared::wire::{FRAGMENTS, Fragment, Health, LatentMessage, PROTOCOL_VERSION, State, WireError};

use crate::motor_health::share;

/// What a frame brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    /// Something for the current cycle.
    Now,
    /// Something for the next cycle: its SYNC is still to come, or lost.
    Next,
    /// Something of another cycle: too late, or from a part of the chain that keeps another time.
    Stale,
    /// A part of a message that is not complete yet.
    Incomplete,
}

/// The pieces of a latent on their way in.
#[derive(Clone, Copy, Debug)]
struct Assembly {
    data: [[u8; 7]; FRAGMENTS],
    /// Bit `k`: piece `k` is here.
    pieces: u8,
    cycle4: u8,
}

/// All other modules as one module knows them.
#[derive(Clone, Debug)]
pub struct Neighbours {
    others: u64,
    modules: u8,
    dead_after: u8,
    policy: u16,
    /// The current cycle; none before the first.
    cycle: Option<u8>,
    /// Heard at all since the cycle started.
    heard: u64,
    state_now: u64,
    state_next: u64,
    /// LATENT came, whether it is of use or not.
    latent_now: u64,
    latent_next: u64,
    /// The latent may be attended to: plausible, and of the same policy.
    usable: u64,
    mismatch: u64,
    /// Speaks another version of the protocol.
    foreign_protocol: u64,
    /// Silent without any frame, without STATE, without LATENT.
    silence: Silence,
    silence_state: Silence,
    silence_latent: Silence,
    states: [State; ROOM],
    latents: [Latent; ROOM],
    assemblies: [Assembly; ROOM],
}

/// The bit of a module; none for a number that cannot be.
pub(crate) fn bit(module: u8) -> u64 {
    1u64.checked_shl(u32::from(module)).unwrap_or(0)
}

/// Modules `0 .. count`.
pub(crate) fn first(count: u8) -> u64 {
    bit(count).wrapping_sub(1)
}

impl Neighbours {
    /// The neighbours of module `own` among `modules`, all believed alive until they prove silent for `dead_after` cycles.
    pub fn new(own: u8, modules: u8, dead_after: u8, policy: u16) -> Self {
        Neighbours {
            others: first(modules) & !bit(own),
            modules,
            dead_after: dead_after.max(1),
            policy,
            cycle: None,
            heard: 0,
            state_now: 0,
            state_next: 0,
            latent_now: 0,
            latent_next: 0,
            usable: 0,
            mismatch: 0,
            foreign_protocol: 0,
            silence: Silence::NONE,
            silence_state: Silence::NONE,
            silence_latent: Silence::NONE,
            // Before it was heard a neighbour counts as well.
            states: [State::new(0, Health::SENSORS_PLAUSIBLE, &[0.0; 4]); ROOM],
            latents: [Latent::default(); ROOM],
            assemblies: [Assembly { data: [[0; 7]; FRAGMENTS], pieces: 0, cycle4: 0 }; ROOM],
        }
    }

    /// A control cycle starts: who was not heard in the last one has been silent for one more. Cost: one pass over the modules.
    pub fn start(&mut self, cycle: u8) {
        let follows = self.cycle.is_none_or(|last| last.wrapping_add(1) == cycle);
        self.silence.count(self.heard, self.modules, self.dead_after);
        self.silence_state.count(self.state_now, self.modules, self.dead_after);
        self.silence_latent.count(self.latent_now, self.modules, self.dead_after);
        self.heard = 0;
        self.state_now = if follows { self.state_next } else { 0 };
        self.latent_now = if follows { self.latent_next } else { 0 };
        self.usable &= self.latent_now;
        (self.state_next, self.latent_next) = (0, 0);
        self.cycle = Some(cycle);
        self.mismatch &= self.alive();
        self.foreign_protocol &= self.alive();
        for assembly in self.assemblies.iter_mut().take(usize::from(self.modules)) {
            // Pieces of older cycles must not meet those of a later cycle with the same lower 4 bits, also if the cycle jumps.
            if assembly.cycle4 != cycle & 15 || !follows {
                assembly.pieces = 0;
            }
        }
    }

    /// Takes note that `module` sent something.
    pub fn hear(&mut self, module: u8) {
        self.heard |= bit(module) & self.others;
    }

    fn which(&self, cycle: u8) -> Heard {
        match self.cycle.map(|current| cycle.wrapping_sub(current)) {
            Some(0) => Heard::Now,
            Some(1) => Heard::Next,
            _ => Heard::Stale,
        }
    }

    /// Takes a STATE.
    pub fn hear_state(&mut self, module: u8, state: State) -> Heard {
        self.hear(module);
        let which = self.which(state.cycle);
        let bit = bit(module) & self.others;
        match which {
            Heard::Now => self.state_now |= bit,
            Heard::Next => {
                // The slot holds one state: that of the current cycle, if any, is gone.
                self.state_now &= !bit;
                self.state_next |= bit;
            }
            _ => return which,
        }
        if let Some(slot) = self.states.get_mut(usize::from(module)) {
            *slot = state;
        }
        which
    }

    /// Takes a LATENT.
    pub fn hear_latent(&mut self, module: u8, message: &LatentMessage) -> Heard {
        self.hear(module);
        self.hear_policy(module, message.policy);
        let which = self.which(message.cycle);
        let bit = bit(module) & self.others;
        match which {
            Heard::Now => self.latent_now |= bit,
            Heard::Next => {
                self.latent_now &= !bit;
                self.latent_next |= bit;
            }
            _ => return which,
        }
        self.usable &= !bit;
        if message.health.sensors_plausible() && message.policy == self.policy {
            self.usable |= bit;
            if let Some(slot) = self.latents.get_mut(usize::from(module)) {
                *slot = Latent { key: message.key, value: message.value };
            }
        }
        which
    }

    /// Takes an eighth of a LATENT; with the last missing piece the whole message, which can turn out to be malformed.
    pub fn hear_fragment(&mut self, module: u8, fragment: &Fragment) -> Result<Heard, WireError> {
        self.hear(module);
        let cycle4 = fragment.cycle4();
        let ahead = self.cycle.map(|current| cycle4.wrapping_sub(current) & 15);
        let (Some(0 | 1), Some(assembly)) = (ahead, self.assemblies.get_mut(usize::from(module))) else {
            return Ok(Heard::Stale);
        };
        if assembly.cycle4 != cycle4 {
            assembly.pieces = 0;
            assembly.cycle4 = cycle4;
        }
        if let Some(piece) = assembly.data.get_mut(usize::from(fragment.index())) {
            *piece = fragment.data;
        }
        assembly.pieces |= 1 << fragment.index();
        if assembly.pieces != u8::MAX {
            return Ok(Heard::Incomplete);
        }
        assembly.pieces = 0;
        let message = LatentMessage::from_fragments(&assembly.data)?;
        // The full cycle number inside must agree with the four bits outside.
        if message.cycle & 15 != cycle4 {
            return Ok(Heard::Stale);
        }
        Ok(self.hear_latent(module, &message))
    }

    /// Takes note of the policy that `module` says it runs.
    pub fn hear_policy(&mut self, module: u8, policy: u16) {
        let bit = bit(module) & self.others;
        if policy == self.policy {
            self.mismatch &= !bit;
        } else {
            self.mismatch |= bit;
        }
    }

    /// Takes note of the version of the protocol that `module` says it speaks.
    pub fn hear_protocol(&mut self, module: u8, version: u8) {
        let bit = bit(module) & self.others;
        if version == PROTOCOL_VERSION {
            self.foreign_protocol &= !bit;
        } else {
            self.foreign_protocol |= bit;
        }
    }

    /// Live neighbours that speak another version of the protocol.
    pub fn foreign_protocol(&self) -> u64 {
        self.foreign_protocol
    }

    /// Neighbours that were heard within the last `dead_after` cycles.
    pub fn alive(&self) -> u64 {
        self.others & (self.heard | self.silence.shorter)
    }

    /// Live neighbours that run another policy.
    pub fn mismatch(&self) -> u64 {
        self.mismatch
    }

    /// Live neighbours whose STATE of this cycle has not come.
    pub fn missing_states(&self) -> u64 {
        self.others & self.silence_state.shorter & !(self.state_now | self.state_next)
    }

    /// Live neighbours whose LATENT of this cycle has not come.
    pub fn missing_latents(&self) -> u64 {
        self.others & (self.silence_latent.shorter | self.state_now) & !(self.latent_now | self.latent_next)
    }

    /// Neighbours whose latent of this cycle may be attended to.
    pub fn usable(&self) -> u64 {
        self.usable & self.latent_now
    }

    /// The latents; those outside of [`Neighbours::usable`] are old or empty.
    pub fn latents(&self) -> &[Latent; ROOM] {
        &self.latents
    }

    /// The STATE of this cycle of `module`, if it came and its sensors are plausible.
    pub fn state(&self, module: u8) -> Option<State> {
        let state = self.states.get(usize::from(module)).filter(|_| self.state_now & bit(module) != 0)?;
        state.health.sensors_plausible().then_some(*state)
    }

    /// Share of the motors of `module` that work, by its last STATE: 0 if it is silent or blind, and 1 for a module that the robot does not have.
    pub fn motors(&self, module: Option<u8>) -> f32 {
        let Some(module) = module.filter(|module| *module < self.modules) else { return 1.0 };
        let state = self.states.get(usize::from(module)).filter(|_| self.alive() & bit(module) != 0);
        let state = state.filter(|state| state.health.sensors_plausible());
        state.map_or(0.0, |state| share(state.health.motors_work()))
    }

    /// Whether somebody is already in the next cycle.
    pub fn next_cycle_seen(&self) -> bool {
        self.state_next | self.latent_next != 0
    }
}

/// For how many cycles each module has been silent in some way.
#[derive(Clone, Debug)]
struct Silence {
    cycles: [u8; ROOM],
    /// Those that were silent for less than `dead_after` cycles. Kept, because it is asked for with every frame.
    shorter: u64,
}

impl Silence {
    const NONE: Silence = Silence { cycles: [0; ROOM], shorter: u64::MAX };

    /// One more cycle, in which `heard` were not silent.
    fn count(&mut self, heard: u64, modules: u8, dead_after: u8) {
        self.shorter = 0;
        for (module, cycles) in self.cycles.iter_mut().enumerate().take(usize::from(modules)) {
            let bit = 1 << module;
            *cycles = if heard & bit != 0 { 0 } else { cycles.saturating_add(1) };
            if *cycles < dead_after {
                self.shorter |= bit;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TAG: u16 = 0x1234;

    fn state(cycle: u8) -> State {
        State::new(cycle, Health::SENSORS_PLAUSIBLE, &[0.5; 4])
    }

    fn latent(cycle: u8) -> LatentMessage {
        LatentMessage {
            cycle,
            health: Health::SENSORS_PLAUSIBLE,
            policy: TAG,
            key: core::array::from_fn(|i| i as i8),
            value: core::array::from_fn(|i| -(i as i8)),
        }
    }

    fn started(cycle: u8) -> Neighbours {
        let mut neighbours = Neighbours::new(1, 4, 3, TAG);
        neighbours.start(cycle);
        neighbours
    }

    #[test]
    fn masks_reach_module_63() {
        assert_eq!((first(64), first(1), bit(63), bit(64), bit(0x7f)), (u64::MAX, 1, 1 << 63, 0, 0));
        let mut neighbours = Neighbours::new(0, 64, 1, TAG);
        neighbours.start(0);
        assert_eq!(neighbours.alive(), 0);
        neighbours.hear_state(63, state(0));
        assert_eq!(neighbours.missing_latents(), 1 << 63);
    }

    #[test]
    fn everybody_is_expected_until_silent_for_three_cycles() {
        let mut neighbours = started(0);
        assert_eq!(neighbours.missing_states(), 0b1101);
        for cycle in 1..4 {
            neighbours.hear_state(0, state(cycle - 1));
            neighbours.hear_latent(0, &latent(cycle - 1));
            neighbours.start(cycle);
        }
        assert_eq!((neighbours.alive(), neighbours.missing_states(), neighbours.missing_latents()), (1, 1, 1));
        // One fresh frame brings it back, and its latent is waited for.
        neighbours.hear_state(3, state(3));
        assert_eq!(
            (neighbours.alive(), neighbours.missing_states(), neighbours.missing_latents()),
            (0b1001, 1, 0b1001)
        );
    }

    #[test]
    fn old_cycles_are_ignored_and_the_next_is_kept() {
        let mut neighbours = started(255);
        assert_eq!(neighbours.hear_latent(0, &latent(254)), Heard::Stale);
        assert_eq!(neighbours.hear_latent(2, &latent(255)), Heard::Now);
        assert_eq!(neighbours.hear_latent(3, &latent(0)), Heard::Next);
        assert_eq!(neighbours.hear_latent(0, &latent(1)), Heard::Stale);
        assert!(neighbours.next_cycle_seen());
        assert_eq!(neighbours.usable(), 0b0100);
        neighbours.start(0);
        assert_eq!(neighbours.usable(), 0b1000);
        assert_eq!(neighbours.latents()[3].key[5], 5);
        // A jump to a foreign cycle forgets everything.
        neighbours.hear_latent(2, &latent(1));
        neighbours.start(77);
        assert_eq!(neighbours.usable(), 0);
    }

    #[test]
    fn implausible_and_foreign_latents_are_masked_but_not_waited_for() {
        let mut neighbours = started(9);
        neighbours.hear_latent(0, &LatentMessage { health: Health(0), ..latent(9) });
        neighbours.hear_latent(2, &LatentMessage { policy: 1, ..latent(9) });
        neighbours.hear_state(2, State::new(9, Health(0), &[1.0; 4]));
        assert_eq!((neighbours.usable(), neighbours.missing_latents(), neighbours.mismatch()), (0, 0b1000, 0b0100));
        assert_eq!(neighbours.state(2), None);
        neighbours.hear_latent(2, &latent(9));
        assert_eq!((neighbours.usable(), neighbours.mismatch()), (0b0100, 0));
    }

    #[test]
    fn the_motors_of_a_neighbour_are_those_of_its_last_state() {
        let mut neighbours = started(0);
        assert_eq!([None, Some(4), Some(0), Some(2)].map(|module| neighbours.motors(module)), [1.0; 4]);
        neighbours.hear_state(0, State::new(0, Health::SENSORS_PLAUSIBLE.with(Health::YAW_DEAD), &[0.5; 4]));
        neighbours.hear_state(2, State::new(0, Health(0), &[0.5; 4]));
        assert_eq!([0, 2, 3].map(|module| neighbours.motors(Some(module))), [0.5, 0.0, 1.0]);
        // Two lost frames change nothing; with the third it counts as gone.
        for (cycle, share) in [(1, 0.5), (2, 0.5), (3, 0.5), (4, 0.0)] {
            neighbours.start(cycle);
            assert_eq!(neighbours.motors(Some(0)), share, "{cycle}");
        }
    }

    #[test]
    fn a_latent_is_put_together_from_eight_pieces_in_any_order() {
        let mut neighbours = started(40);
        let pieces = latent(40).fragments();
        for piece in pieces.iter().skip(1).rev() {
            assert_eq!(neighbours.hear_fragment(2, piece), Ok(Heard::Incomplete));
        }
        assert_eq!(neighbours.usable(), 0);
        assert_eq!(neighbours.hear_fragment(2, &pieces[0]), Ok(Heard::Now));
        assert_eq!((neighbours.usable(), neighbours.latents()[2].value[31]), (0b0100, -31));
    }

    /// Pieces of two latents of 16 cycles apart have the same number outside.
    #[test]
    fn fragments_of_two_latents_do_not_mix_when_the_cycle_jumps_by_16() {
        let mut neighbours = started(40);
        for piece in &latent(40).fragments()[1..] {
            neighbours.hear_fragment(2, piece).unwrap();
        }
        neighbours.start(56);
        let other = LatentMessage { value: [7; 32], ..latent(56) };
        assert_eq!(neighbours.hear_fragment(2, &other.fragments()[0]), Ok(Heard::Incomplete));
        assert_eq!(neighbours.usable(), 0);
        for piece in &other.fragments()[1..] {
            neighbours.hear_fragment(2, piece).unwrap();
        }
        assert_eq!((neighbours.usable(), neighbours.latents()[2].value), (0b0100, [7; 32]));
    }

    #[test]
    fn pieces_of_different_cycles_never_mix() {
        let mut neighbours = started(40);
        for piece in &latent(40).fragments()[1..] {
            neighbours.hear_fragment(2, piece).unwrap();
        }
        // The next cycle's first piece throws the old ones away.
        assert_eq!(neighbours.hear_fragment(2, &latent(41).fragments()[0]), Ok(Heard::Incomplete));
        assert_eq!(neighbours.hear_fragment(2, &latent(40).fragments()[0]), Ok(Heard::Incomplete));
        // Sixteen cycles on the lower bits agree again.
        for cycle in 41..=56 {
            neighbours.start(cycle);
        }
        for piece in &latent(56).fragments()[1..] {
            assert_eq!(neighbours.hear_fragment(2, piece), Ok(Heard::Incomplete));
        }
        // A piece 0 from another cycle with the same lower bits makes a message of a wrong cycle.
        assert_eq!(neighbours.hear_fragment(2, &latent(40).fragments()[0]), Ok(Heard::Stale));
        assert_eq!(neighbours.hear_fragment(2, &latent(50).fragments()[0]), Ok(Heard::Stale));
        assert_eq!(neighbours.usable(), 0);
    }
}
