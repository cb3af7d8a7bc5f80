//! Whole robots whose modules are at the end of a link, without QEMU: the module's side answers in this process. And links that fail.

use std::cell::Cell;

use composer_firmware::controller::{BusKind, BusOffPolicy};
use composer_firmware::link::module::{Module, hello};
use composer_shared::policy::{IMAGE_SIZE, Policy};
use composer_shared::wire::StopCommand;

use super::*;
use crate::computer::Launcher;
use crate::faults::FaultPlan;
use crate::policy_flash::Policies;
use crate::sil::tests::{Toy, image};
use crate::sil::{self, CycleView, SilConfig, SilError, SilReport};

/// A module in this process at the other end of a line.
struct Loopback<'a> {
    module: Module<'a, Policies>,
    receiver: Receiver,
    out: Vec<u8>,
    /// Messages after which somebody takes it away.
    life: usize,
}

impl Line for Loopback<'_> {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        for byte in bytes {
            let Some(message) = self.receiver.push(*byte) else { continue };
            let out = &mut self.out;
            let mut reply = |message: &FromModule<'_>| out.extend(link::encode(message, &mut [0; MESSAGE_MAX]));
            self.module.serve(message.and_then(link::decode), &mut reply);
            self.life = self.life.checked_sub(1).ok_or_else(|| Trouble::Gone("taken away".into()))?;
        }
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8]) -> Result<usize, Trouble> {
        assert!(!self.out.is_empty(), "nobody waits for an answer that does not come");
        // In small pieces, as a UART gives them.
        let length = self.out.len().min(3);
        buffer[..length].copy_from_slice(&self.out[..length]);
        self.out.drain(..length);
        Ok(length)
    }

    fn post_mortem(&mut self) -> String {
        " (as was to be expected)".into()
    }
}

struct Loopbacks<'a> {
    policy: Policy<'a>,
    /// Which module is taken away after how many messages.
    victim: Option<(u8, usize)>,
    started: Cell<usize>,
}

impl<'a> Launcher for Loopbacks<'a> {
    type Computer = Remote<Loopback<'a>>;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Self::Computer, Trouble> {
        config.check().map_err(Trouble::Config)?;
        self.started.set(self.started.get() + 1);
        let life = self.victim.filter(|(victim, _)| *victim == config.node).map_or(usize::MAX, |(_, life)| life);
        let out = link::encode(&hello(Some(&self.policy)), &mut [0; MESSAGE_MAX]).to_vec();
        let line = Loopback {
            module: Module::new(self.policy, Policies::default()),
            receiver: Receiver::default(),
            out,
            life,
        };
        Ok(Remote::new(line, config, boot, now))
    }
}

/// Everything that can be seen of a run.
type Seen = (SilReport, Vec<Vec<[u32; 2]>>, Vec<String>);

fn watch(run: impl FnOnce(&mut Toy, &mut dyn FnMut(&CycleView<'_>, &Toy)) -> Result<SilReport, SilError>) -> Seen {
    let mut toy = Toy::new(6, 80);
    let mut views = Vec::new();
    let report = run(&mut toy, &mut |view, _| views.push(format!("{view:?}"))).unwrap();
    let bits = |torques: &Vec<[f32; 2]>| torques.iter().map(|torque| torque.map(f32::to_bits)).collect();
    (report, toy.history.iter().map(bits).collect(), views)
}

fn loopbacks(image: &[u8; IMAGE_SIZE], victim: Option<(u8, usize)>) -> Loopbacks<'_> {
    Loopbacks { policy: Policy::parse(image).unwrap(), victim, started: Cell::new(0) }
}

#[test]
fn modules_at_the_end_of_a_link_do_the_same_to_the_bit() {
    let image = image();
    let launcher = loopbacks(&image, None);
    for (kind, faults) in [
        (BusKind::Fd, "none"),
        (BusKind::Classic, "drop:0.1,corrupt:0.05"),
        (BusKind::Fd, "unplug:#0@500ms..1s,unplug:#3@1s..2s,cut:2@2s..3s"),
        (BusKind::Classic, "unplug:#1@500ms..1500ms,stuck:#2@1s,observation:#4@1s..2s,delay:3ms"),
        (BusKind::Fd, "babble:#1/255@1s..2s,duplicate:0.2,action:#3"),
    ] {
        let plan: FaultPlan = faults.parse().unwrap();
        for (bus_off, numbers) in [(BusOffPolicy::Recover, vec![]), (BusOffPolicy::Latch, vec![0, 1, 2, 2])] {
            let stops = [(2200 * 1_000_000, StopCommand::Stop), (2501 * 1_000_000, StopCommand::Release)];
            let (commands, presses) = (stops.to_vec(), vec![(3_003_000_000, 4)]);
            let drawn = plan.draw(5, 6);
            let config =
                SilConfig { faults: drawn, seed: 5, bus_off, numbers, commands, presses, ..SilConfig::new(kind) };
            let local = watch(|toy, observer| sil::run(toy, &image, &config, None, observer));
            let remote = watch(|toy, observer| sil::run_on(&launcher, toy, launcher.policy, &config, None, observer));
            assert!(local.1.iter().flatten().flatten().any(|bits| *bits != 0) && local.2.len() >= 80);
            assert_eq!(local, remote, "{kind:?} {faults}");
        }
    }
}

#[test]
fn a_module_that_is_taken_away_is_unplugged_until_it_is_plugged_in_again() {
    let image = image();
    let launcher = loopbacks(&image, Some((2, 300)));
    let go = |faults: &str| {
        let plan: FaultPlan = faults.parse().unwrap();
        let config = SilConfig { faults: plan.draw(5, 6), ..SilConfig::new(BusKind::Fd) };
        launcher.started.set(0);
        let mut plugged = Vec::new();
        let mut toy = Toy::new(6, 80);
        let report = sil::run_on(&launcher, &mut toy, launcher.policy, &config, None, &mut |view, _| {
            plugged.push(view.modules.iter().filter(|module| module.plugged).count());
        });
        (report.unwrap(), plugged, launcher.started.get())
    };
    // Another fault that begins and ends does not bring it back.
    let (report, plugged, started) = go("action:#4@3s..3500ms");
    assert_eq!((report.lost.len(), report.lost[0].module, &*report.lost[0].how), (1, 2, "taken away"));
    assert!(report.lost[0].at_ns > 500_000_000 && report.lost[0].at_ns < 3_000_000_000, "{:?}", report.lost);
    assert_eq!((plugged[0], plugged.last(), started), (6, Some(&5), 6));
    assert!(!report.cut_short && report.modules[5].stats.acted > 70, "the others go on: {report:?}");
    assert!(report.modules[2].stats.acted > 0, "what it did before counts");
    // Being plugged in again does.
    let (report, plugged, started) = go("unplug:#2@3s..3200ms");
    assert_eq!((report.lost.len(), plugged.last(), started), (1, Some(&6), 7));
}

/// A line on which certain bytes come, then nothing.
struct Script(Vec<u8>);

impl Line for Script {
    fn send(&mut self, _: &[u8]) -> Result<(), Trouble> {
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8]) -> Result<usize, Trouble> {
        if self.0.is_empty() {
            return Err(LinkTrouble::Stalled(Duration::from_secs(1)).into());
        }
        let length = self.0.len().min(buffer.len());
        buffer[..length].copy_from_slice(&self.0[..length]);
        self.0.drain(..length);
        Ok(length)
    }

    fn post_mortem(&mut self) -> String {
        " (as was to be expected)".into()
    }
}

/// What a poll comes to when these messages answer everything.
fn poll(messages: &[FromModule<'_>], noise: &[u8]) -> String {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let mut bytes: Vec<u8> = Vec::new();
    messages.iter().for_each(|message| bytes.extend(link::encode(message, &mut [0; MESSAGE_MAX])));
    bytes.extend(noise);
    let mut remote = Remote::new(Script(bytes), Config::new(0, 1, BusKind::Fd, &policy), Boot::default(), 0);
    let sensors = composer_shared::observation::Sensors::ZERO;
    let poll = Poll { now: 1, sensors: &sensors, frame: None, bus: Default::default(), room: 1 };
    let answer = remote.ask_poll(&poll).and_then(|()| remote.answer());
    answer.map_or_else(|trouble| trouble.to_string(), |answer| format!("{answer:?}"))
}

#[test]
fn a_link_that_fails_says_how() {
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let good = || hello(Some(&policy));
    let answer = FromModule::Answer { torque: None, motors_enabled: true, deadline: 7, acted: 0, node: 0 };
    let boot = |build| {
        let hello = FromModule::Hello { protocol: PROTOCOL, firmware: 1, build, policy: Some(9) };
        let bytes = link::encode(&hello, &mut [0; MESSAGE_MAX]).to_vec();
        Remote::new(Script(bytes), Config::new(0, 1, BusKind::Fd, &policy), Boot::default(), 0).hello().unwrap()
    };
    assert_eq!(boot(BUILD), Hello { firmware: 1, same_controller: true, policy: 9 });
    assert!(!boot(BUILD ^ 1).same_controller);
    let frame = || FromModule::Frame(Carried(Frame::new(1, true, &[]).unwrap()));
    assert!(poll(&[good(), answer.clone()], &[]).contains("deadline: 7"));
    let old = FromModule::Hello { protocol: PROTOCOL + 1, firmware: 1, build: 1, policy: Some(1) };
    for (messages, noise, words) in [
        (vec![old], &[][..], &["version 4", "version 3", "cargo qemu-image"][..]),
        (
            vec![hello(None), FromModule::Refused("the policy image is damaged")],
            &[],
            &["refuses: the policy image is damaged"],
        ),
        (vec![hello(None)], &[], &["1 s", "stalls"]),
        (vec![], &[], &["1 s", "stalls"]),
        (vec![answer.clone()], &[], &["hello"]),
        (
            vec![good(), FromModule::LastWords("index out of bounds")],
            &[],
            &["crashed: index out of bounds (as was to be expected)"],
        ),
        (vec![FromModule::LastWords("no stack")], &[], &["crashed: no stack"]),
        (vec![good(), FromModule::Refused("the module is tired")], &[], &["refuses: the module is tired"]),
        (vec![good(), good()], &[], &["started again"]),
        (vec![good(), frame(), frame(), answer.clone()], &[], &["more frames than there is room for"]),
        (vec![good(), FromModule::Sent], &[], &["something else"]),
        (vec![good()], &[7, 7, 0], &["cannot be decoded"]),
        (vec![good()], &[1; 1000], &["more than 320 bytes"]),
        (vec![good()], &[0; 1000], &["more than 320 bytes"]),
    ] {
        let said = poll(&messages, noise);
        assert!(words.iter().all(|word| said.contains(word)), "{messages:?}: {said}");
    }
}
