//! What can go wrong, written as text, drawn by a seed.
//!
//! A [`FaultPlan`] is what a person writes, for example `unplug:1,drop:0.05`; [`FaultPlan::draw`] turns it into the
//! [`ScheduledFault`]s of one episode. The same plan, seed and number of modules always give the same faults.
//!
//! | text | what happens |
//! |---|---|
//! | `none` | nothing |
//! | `unplug:K` | K modules chosen at random lose power and leave the bus, each at a random time in the first [`FIRST_PART_NS`] |
//! | `brownout:K` | the supply of K modules breaks in, for [`BROWN_OUT_NS`] if no end is given, each at a random time in the first part; they restart and know it |
//! | `action:K` | the motors of K modules do nothing, from the start (the paper's action corruption) |
//! | `observation:K` | the sensors of K modules read zero, from the start (the paper's observation corruption) |
//! | `stuck:K` | the sensors of K modules keep their last reading, from a random time in the first part on |
//! | `babble:K` or `babble:K/0x0FF` | K modules flood the bus with frames of this identifier, from the start, as far as the [guard](composer_firmware::port::guard) of their port lets them |
//! | `cut` or `cut:M` | the cable breaks behind a random module, or behind module M, at a random time in the first part |
//! | `drop:P` | a receiver loses a frame that it has acknowledged, with probability P |
//! | `delay:TIME` | a receiver sees each frame up to TIME later (uniform, in order) |
//! | `corrupt:P` or `corrupt:P#M` | a bit of a frame flips on the wire, with probability P; with `#M` only module M misreads it |
//! | `duplicate:P` | a frame is sent twice, with probability P |
//!
//! `#M` in place of `K` names module M instead of choosing: `unplug:#3`. `@TIME` sets when it starts, `@TIME..TIME` also when it ends
//! (plugged in again, mended, restored): `cut:3@1s..2.5s`. Times have a unit: `s`, `ms` or `us`. Several faults are joined by commas.

use std::fmt;
use std::str::FromStr;

use composer_shared::robot::MAX_MODULES;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The first part of an episode, in which faults without a given time start, ns.
pub const FIRST_PART_NS: u64 = 2_000_000_000;
/// How long a supply breaks in unless told otherwise, ns.
pub const BROWN_OUT_NS: u64 = 10_000_000;
/// Identifier that a babbling node floods the bus with, unless told otherwise: more urgent than everything but EMERGENCY_STOP and the
/// SYNC of the modules.
pub const BABBLE_ID: u16 = 0x0ff;

/// What is wrong with a fault's text.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FaultError {
    /// The name is none of the known ones.
    #[error(
        "unknown fault `{0}`; known are unplug, brownout, action, observation, stuck, babble, cut, drop, delay, corrupt, duplicate and none"
    )]
    Unknown(String),
    /// Something is missing or superfluous behind the name.
    #[error("`{text}` does not say {wanted}, as in `{example}`")]
    Argument {
        /// What was read.
        text: String,
        /// What should be there.
        wanted: &'static str,
        /// How it is written.
        example: &'static str,
    },
    /// A probability outside of 0 to 1.
    #[error("`{0}` is not a probability; give a number from 0 to 1, as in `drop:0.05`")]
    Probability(String),
    /// A time without a unit, negative, or not a number.
    #[error("`{0}` is not a time; give a number and its unit (s, ms or us), as in `3.2s`")]
    Time(String),
    /// A fault that ends before it starts.
    #[error("`{0}` ends before it starts; give the earlier time first, as in `unplug:1@1s..4s`")]
    Order(String),
    /// An identifier that CAN does not have.
    #[error("`{0}` is not an identifier; give 0 to 0x7FF, as in `babble:1/0x0FF`")]
    Identifier(String),
    /// More modules than the robot has.
    #[error("`{text}` needs {needed} modules or more, the robot has {modules}")]
    Modules {
        /// The fault.
        text: String,
        /// The least number of modules.
        needed: usize,
        /// The modules there are.
        modules: usize,
    },
}

/// Which modules are hit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// So many, chosen at random.
    Count(usize),
    /// This one.
    Module(usize),
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Target::Count(count) => write!(f, "{count}"),
            Target::Module(module) => write!(f, "#{module}"),
        }
    }
}

/// What a planned fault is, before modules and times are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FaultKind {
    /// Modules lose power and leave the bus.
    Unplug(Target),
    /// Their supply breaks in.
    BrownOut(Target),
    /// Motors do nothing.
    Action(Target),
    /// Sensors read zero.
    Observation(Target),
    /// Sensors keep their last reading.
    Stuck(Target),
    /// Modules flood the bus with this identifier.
    Babble(Target, u16),
    /// The cable breaks behind a module; at a random place if none is given.
    Cut(Option<usize>),
    /// Frames are lost at receivers, probability.
    Drop(f64),
    /// Frames are late at receivers, longest time in ns.
    Delay(u64),
    /// Bits flip, probability; on the wire, or as this module reads it.
    Corrupt(f64, Option<usize>),
    /// Frames are sent twice, probability.
    Duplicate(f64),
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            FaultKind::Unplug(target) => write!(f, "unplug:{target}"),
            FaultKind::BrownOut(target) => write!(f, "brownout:{target}"),
            FaultKind::Action(target) => write!(f, "action:{target}"),
            FaultKind::Observation(target) => write!(f, "observation:{target}"),
            FaultKind::Stuck(target) => write!(f, "stuck:{target}"),
            FaultKind::Babble(target, BABBLE_ID) => write!(f, "babble:{target}"),
            FaultKind::Babble(target, id) => write!(f, "babble:{target}/{id:#05X}"),
            FaultKind::Cut(None) => write!(f, "cut"),
            FaultKind::Cut(Some(module)) => write!(f, "cut:{module}"),
            FaultKind::Drop(p) => write!(f, "drop:{p}"),
            FaultKind::Delay(ns) => write!(f, "delay:{}", Time(ns)),
            FaultKind::Corrupt(p, None) => write!(f, "corrupt:{p}"),
            FaultKind::Corrupt(p, Some(module)) => write!(f, "corrupt:{p}#{module}"),
            FaultKind::Duplicate(p) => write!(f, "duplicate:{p}"),
        }
    }
}

/// A planned fault: what, and when if that is given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedFault {
    /// What happens.
    pub kind: FaultKind,
    /// When it starts, ns. If not given: at a random time in the first part of the episode for what happens to a working robot
    /// (unplug, stuck, cut), at the start for the others.
    pub at_ns: Option<u64>,
    /// When it ends, ns.
    pub until_ns: Option<u64>,
}

impl fmt::Display for PlannedFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.kind.fmt(f)?;
        match (self.at_ns, self.until_ns) {
            (Some(at), Some(until)) => write!(f, "@{}..{}", Time(at), Time(until)),
            (Some(at), None) => write!(f, "@{}", Time(at)),
            _ => Ok(()),
        }
    }
}

/// Writes a time in the largest unit that keeps it whole, seconds with decimals otherwise.
struct Time(u64);

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => write!(f, "0s"),
            ns if ns % 1_000_000_000 == 0 => write!(f, "{}s", ns / 1_000_000_000),
            ns if ns % 1_000_000 == 0 => write!(f, "{}ms", ns / 1_000_000),
            ns => write!(f, "{}us", ns as f64 / 1e3),
        }
    }
}

/// A list of planned faults; see the [module](self) for how it is written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultPlan {
    /// The faults, in the order in which they were written.
    pub faults: Vec<PlannedFault>,
}

impl fmt::Display for FaultPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.faults.is_empty() {
            return write!(f, "none");
        }
        for (k, fault) in self.faults.iter().enumerate() {
            write!(f, "{}{fault}", if k > 0 { "," } else { "" })?;
        }
        Ok(())
    }
}

impl FromStr for FaultPlan {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        if matches!(text.trim(), "" | "none") {
            return Ok(FaultPlan::default());
        }
        text.split(',')
            .map(|item| parse_fault(item.trim()))
            .collect::<Result<_, _>>()
            .map(|faults| FaultPlan { faults })
    }
}

fn parse_fault(text: &str) -> Result<PlannedFault, FaultError> {
    let (what, when) = text.split_once('@').map_or((text, None), |(what, when)| (what, Some(when)));
    let (name, argument) = what.split_once(':').map_or((what, None), |(name, argument)| (name, Some(argument)));
    let missing = |wanted, example| FaultError::Argument { text: text.into(), wanted, example };
    let target = |argument: Option<&str>, example| {
        let parse = |argument: &str| match argument.strip_prefix('#') {
            Some(module) => module.parse().ok().filter(|module| *module < MAX_MODULES).map(Target::Module),
            None => argument.parse().ok().filter(|count| (1..=MAX_MODULES).contains(count)).map(Target::Count),
        };
        argument.and_then(parse).ok_or_else(|| missing("how many modules (1 to 64) or which one (#0 to #63)", example))
    };
    let module = |argument: &str, example| {
        argument
            .parse()
            .ok()
            .filter(|module| *module < MAX_MODULES)
            .ok_or_else(|| missing("which module (0 to 63)", example))
    };
    let probability = |argument: Option<&str>, example| {
        let argument = argument.ok_or_else(|| missing("with which probability", example))?;
        let value: Option<f64> = argument.parse().ok().filter(|p| (0.0..=1.0).contains(p));
        value.ok_or_else(|| FaultError::Probability(argument.into()))
    };
    let kind = match name {
        "unplug" => FaultKind::Unplug(target(argument, "unplug:1")?),
        "brownout" => FaultKind::BrownOut(target(argument, "brownout:1")?),
        "action" => FaultKind::Action(target(argument, "action:1")?),
        "observation" => FaultKind::Observation(target(argument, "observation:1")?),
        "stuck" => FaultKind::Stuck(target(argument, "stuck:1")?),
        "babble" => {
            let (who, id) = match argument.and_then(|argument| argument.split_once('/')) {
                Some((who, id)) => (Some(who), Some(id)),
                None => (argument, None),
            };
            let parse = |id: &str| match id.strip_prefix("0x").or_else(|| id.strip_prefix("0X")) {
                Some(hex) => u16::from_str_radix(hex, 16).ok(),
                None => id.parse().ok(),
            };
            let id = id.map_or(Ok(BABBLE_ID), |id| {
                parse(id).filter(|id| *id < 0x800).ok_or_else(|| FaultError::Identifier(id.into()))
            })?;
            FaultKind::Babble(target(who, "babble:1")?, id)
        }
        "cut" => FaultKind::Cut(argument.map(|argument| module(argument, "cut:3")).transpose()?),
        "drop" => FaultKind::Drop(probability(argument, "drop:0.05")?),
        "duplicate" => FaultKind::Duplicate(probability(argument, "duplicate:0.01")?),
        "corrupt" => match argument.and_then(|argument| argument.split_once('#')) {
            Some((p, who)) => {
                let example = "corrupt:0.01#3";
                FaultKind::Corrupt(probability(Some(p), example)?, Some(module(who, example)?))
            }
            None => FaultKind::Corrupt(probability(argument, "corrupt:0.01")?, None),
        },
        "delay" => {
            let longest = argument.ok_or_else(|| missing("how long at most", "delay:2ms"))?;
            FaultKind::Delay(parse_time(longest)?)
        }
        _ => return Err(FaultError::Unknown(name.into())),
    };
    let (at_ns, until_ns) = match when.map(|when| when.split_once("..").map_or((when, None), |(a, b)| (a, Some(b)))) {
        None => (None, None),
        Some((at, until)) => (Some(parse_time(at)?), until.map(parse_time).transpose()?),
    };
    if until_ns.is_some_and(|until| Some(until) <= at_ns) {
        return Err(FaultError::Order(text.into()));
    }
    Ok(PlannedFault { kind, at_ns, until_ns })
}

/// Reads a time such as `3.2s`, `2ms` or `250us` as ns, a year at most.
pub fn parse_time(text: &str) -> Result<u64, FaultError> {
    let units = [("ms", 1e6), ("us", 1e3), ("s", 1e9)];
    let (number, scale) = units
        .iter()
        .find_map(|(unit, scale)| text.strip_suffix(unit).map(|number| (number, scale)))
        .ok_or_else(|| FaultError::Time(text.into()))?;
    let value: f64 = number.trim().parse().map_err(|_| FaultError::Time(text.into()))?;
    let ns = (value * scale).round();
    if (0.0..3.2e16).contains(&ns) { Ok(ns as u64) } else { Err(FaultError::Time(text.into())) }
}

/// A fault of one episode, its module drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fault {
    /// The module loses power and leaves the bus.
    Unplug(usize),
    /// The module's supply breaks in: it is off, and remembers what outlasts that when it comes back.
    BrownOut(usize),
    /// The module's motors do nothing.
    ActuatorDead(usize),
    /// The module's sensors read zero.
    SensorZeroed(usize),
    /// The module's sensors keep their last reading.
    SensorStuck(usize),
    /// The module floods the bus with frames of this identifier.
    Babble(usize, u16),
    /// The cable is broken between this module and the next.
    Cut(usize),
    /// Receivers lose frames with this probability.
    Drop(f64),
    /// Receivers see frames up to this much later, ns.
    Delay(u64),
    /// A bit of a frame flips on the wire with this probability.
    Corrupt(f64),
    /// The module misreads frames with this probability.
    Misread(usize, f64),
    /// A frame is sent twice with this probability.
    Duplicate(f64),
}

impl Fault {
    /// Whether it changes which modules there are, or which of them hear each other.
    pub fn changes_line(&self) -> bool {
        matches!(self, Fault::Unplug(_) | Fault::BrownOut(_) | Fault::Cut(_))
    }

    /// The module that it happens to, if it is one.
    pub fn module(&self) -> Option<usize> {
        match *self {
            Fault::Unplug(m) | Fault::ActuatorDead(m) | Fault::SensorZeroed(m) | Fault::SensorStuck(m) => Some(m),
            Fault::BrownOut(m) | Fault::Babble(m, _) | Fault::Misread(m, _) => Some(m),
            _ => None,
        }
    }
}

/// A fault of one episode and its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScheduledFault {
    /// When it starts, ns from the start of the episode.
    pub at_ns: u64,
    /// When it ends, ns; none lasts to the end of the episode.
    pub until_ns: Option<u64>,
    /// What happens.
    pub fault: Fault,
}

impl ScheduledFault {
    /// Whether it is on at this time, ns.
    pub fn active(&self, now: u64) -> bool {
        now >= self.at_ns && self.until_ns.is_none_or(|until| now < until)
    }
}

impl FaultPlan {
    /// Whether a robot of `modules` modules can suffer this plan.
    pub fn check(&self, modules: usize) -> Result<(), FaultError> {
        for fault in &self.faults {
            let needed = match fault.kind {
                FaultKind::Unplug(target)
                | FaultKind::BrownOut(target)
                | FaultKind::Action(target)
                | FaultKind::Observation(target)
                | FaultKind::Stuck(target)
                | FaultKind::Babble(target, _) => match target {
                    Target::Count(count) => count,
                    Target::Module(module) => module + 1,
                },
                FaultKind::Cut(module) => module.unwrap_or(0) + 2,
                FaultKind::Corrupt(_, Some(module)) => module + 1,
                _ => 0,
            };
            if needed > modules {
                return Err(FaultError::Modules { text: fault.to_string(), needed, modules });
            }
        }
        Ok(())
    }

    /// The faults of the episode with this seed, in order of time. What the robot is too short for does not happen
    /// (see [`FaultPlan::check`]). Each planned fault has a random stream of its own: adding one at the end changes none before it.
    pub fn draw(&self, seed: u64, modules: usize) -> Vec<ScheduledFault> {
        let mut drawn = Vec::new();
        for (number, planned) in self.faults.iter().enumerate() {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(number as u64);
            let hit = |target, rng: &mut ChaCha8Rng| match target {
                Target::Module(module) => Vec::from_iter((module < modules).then_some(module)),
                Target::Count(count) => {
                    let mut all: Vec<usize> = (0..modules).collect();
                    all.shuffle(rng);
                    all.truncate(count);
                    all
                }
            };
            let (sudden, faults): (bool, Vec<Fault>) = match planned.kind {
                FaultKind::Unplug(target) => (true, hit(target, &mut rng).into_iter().map(Fault::Unplug).collect()),
                FaultKind::BrownOut(target) => (true, hit(target, &mut rng).into_iter().map(Fault::BrownOut).collect()),
                FaultKind::Stuck(target) => (true, hit(target, &mut rng).into_iter().map(Fault::SensorStuck).collect()),
                FaultKind::Action(target) => {
                    (false, hit(target, &mut rng).into_iter().map(Fault::ActuatorDead).collect())
                }
                FaultKind::Observation(target) => {
                    (false, hit(target, &mut rng).into_iter().map(Fault::SensorZeroed).collect())
                }
                FaultKind::Babble(target, id) => {
                    (false, hit(target, &mut rng).into_iter().map(|module| Fault::Babble(module, id)).collect())
                }
                FaultKind::Cut(place) => {
                    let random =
                        if modules > 1 { Some(rng.random_range(0..modules as u64 - 1) as usize) } else { None };
                    let place = place.or(random).filter(|place| place + 1 < modules);
                    (true, Vec::from_iter(place.map(Fault::Cut)))
                }
                FaultKind::Drop(p) => (false, vec![Fault::Drop(p)]),
                FaultKind::Delay(ns) => (false, vec![Fault::Delay(ns)]),
                FaultKind::Corrupt(p, None) => (false, vec![Fault::Corrupt(p)]),
                FaultKind::Corrupt(p, Some(module)) => {
                    (false, Vec::from_iter((module < modules).then_some(Fault::Misread(module, p))))
                }
                FaultKind::Duplicate(p) => (false, vec![Fault::Duplicate(p)]),
            };
            for fault in faults {
                let random = if sudden { rng.random_range(0..FIRST_PART_NS) } else { 0 };
                let at_ns = planned.at_ns.unwrap_or(random);
                let brief = matches!(fault, Fault::BrownOut(_)).then(|| at_ns.saturating_add(BROWN_OUT_NS));
                drawn.push(ScheduledFault { at_ns, until_ns: planned.until_ns.or(brief), fault });
            }
        }
        drawn.sort_by_key(|fault| fault.at_ns);
        drawn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(text: &str) -> FaultPlan {
        text.parse().unwrap()
    }

    #[test]
    fn every_form_is_read_and_written_back() {
        let forms = "unplug:1,unplug:#3@1s,unplug:1@3200ms,unplug:2@1s..4s,action:2,observation:1,stuck:#0,cut,cut:3@1500us..2s,\
                     drop:0.05,delay:2ms,corrupt:0.01,corrupt:0.01#3,duplicate:0.5,babble:1,babble:1/0x6FF";
        let plan = plan(forms);
        assert_eq!(plan.faults.len(), 16);
        assert_eq!(plan.to_string(), forms);
        assert_eq!(
            plan.faults[2],
            PlannedFault { kind: FaultKind::Unplug(Target::Count(1)), at_ns: Some(3_200_000_000), until_ns: None }
        );
        assert_eq!(plan, plan.to_string().parse().unwrap());
        assert_eq!("unplug:1@3.2s".parse::<FaultPlan>().unwrap().faults[0], plan.faults[2]);
        assert!("none".parse::<FaultPlan>().unwrap().faults.is_empty());
        assert_eq!(FaultPlan::default().to_string(), "none");
    }

    #[test]
    fn every_mistake_gets_its_sentence() {
        let cases = [
            ("unplugged:1", "unknown fault `unplugged`; known are unplug, "),
            ("unplug", "`unplug` does not say how many modules"),
            ("unplug:0", "`unplug:0` does not say how many modules"),
            ("unplug:65", "`unplug:65` does not say how many modules"),
            ("unplug:#64", "`unplug:#64` does not say how many modules"),
            ("unplug:-1", "`unplug:-1` does not say how many modules"),
            ("unplug:1@3", "`3` is not a time"),
            ("unplug:1@-3s", "`-3s` is not a time"),
            ("unplug:1@nans", "`nans` is not a time"),
            ("unplug:1@3s..2s", "`unplug:1@3s..2s` ends before it starts"),
            ("drop:5", "`5` is not a probability"),
            ("drop:NaN", "`NaN` is not a probability"),
            ("drop", "`drop` does not say with which probability"),
            ("delay:2", "`2` is not a time"),
            ("cut:x", "`cut:x` does not say which module"),
            ("babble:1/0x800", "`0x800` is not an identifier"),
            ("drop:0.1,", "unknown fault ``"),
        ];
        for (text, sentence) in cases {
            let error = text.parse::<FaultPlan>().unwrap_err().to_string();
            assert!(error.starts_with(sentence), "{text}: {error}");
        }
        assert_eq!(
            plan("unplug:9").check(8).unwrap_err().to_string(),
            "`unplug:9` needs 9 modules or more, the robot has 8"
        );
        assert!(plan("cut:7").check(8).is_err() && plan("cut:6").check(8).is_ok() && plan("cut").check(1).is_err());
    }

    #[test]
    fn a_draw_follows_from_its_seed() {
        let plan = plan("unplug:2,action:1,cut");
        let first = plan.draw(7, 8);
        assert_eq!(first, plan.draw(7, 8));
        assert!((0..20).any(|seed| plan.draw(seed, 8) != first));
        assert_eq!(first.len(), 4);
        assert!(first.windows(2).all(|pair| pair[0].at_ns <= pair[1].at_ns));
        // One more at the end leaves the others alone.
        let longer: FaultPlan = "unplug:2,action:1,cut,drop:0.1".parse().unwrap();
        assert!(first.iter().all(|fault| longer.draw(7, 8).contains(fault)));
    }

    #[test]
    fn chosen_modules_are_distinct_and_all_of_them_get_hit() {
        let mut seen = [0; 8];
        for seed in 0..200 {
            let drawn = plan("unplug:2").draw(seed, 8);
            assert_eq!(drawn.len(), 2);
            assert_ne!(drawn[0].fault, drawn[1].fault);
            for fault in drawn {
                assert!(fault.at_ns < FIRST_PART_NS);
                seen[fault.fault.module().unwrap()] += 1;
            }
        }
        assert!(seen.iter().all(|count| (25..80).contains(count)), "{seen:?}");
        assert!(plan("action:1").draw(3, 8).iter().all(|fault| fault.at_ns == 0));
        assert_eq!(plan("unplug:#3@1s").draw(0, 8)[0].fault, Fault::Unplug(3));
        assert!(plan("unplug:#3@1s").draw(0, 3).is_empty() && plan("cut").draw(0, 1).is_empty());
    }

    #[test]
    fn a_fault_is_on_between_its_times() {
        let fault = plan("cut:3@1s..2s").draw(0, 8)[0];
        let at = |ms: u64| fault.active(ms * 1_000_000);
        assert_eq!([at(0), at(1000), at(1999), at(2000)], [false, true, true, false]);
    }
}
