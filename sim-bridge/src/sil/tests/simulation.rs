//! Runs that stop on the way, are looked at, and changed.

use super::*;

fn start(bus: BusKind, plan: &str) -> Simulation<'static, Toy, InProcess<'static>> {
    let image = Box::leak(Box::new(image()));
    let policy = Policy::parse(image).unwrap();
    Simulation::new(InProcess::new(policy), Toy::new(8, 60), policy, with_faults(bus, plan, 8)).unwrap()
}

#[test]
fn a_run_in_pieces_is_the_run_as_a_whole() {
    let plan = "unplug:#3@0.5s..1s,drop:0.1,delay:2ms,corrupt:0.02,cut:5@1.2s..1.7s,babble:#6@2s..2.2s";
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut whole = start(bus, plan);
        whole.advance(u64::MAX).unwrap();
        let mut pieces = start(bus, plan);
        let mut lengths = [1, 333, 49_999_999, 7_000_001, 50_000_000].into_iter().cycle();
        while !pieces.over() {
            pieces.advance(lengths.next().unwrap()).unwrap();
            pieces.look(|_| ()).unwrap();
        }
        assert_eq!(whole.report().unwrap(), pieces.report().unwrap());
        assert_eq!(whole.plant().history, pieces.plant().history);
        assert!(whole.report().unwrap().dropped > 0);
    }
}

#[test]
fn a_change_does_what_a_plan_does() {
    // Between two events, so that what happens at one moment has one order.
    let plan = "unplug:#3@501us..1000501us,action:#2@1700001us,observation:#4@1800001us..2s";
    let mut planned = start(BusKind::Fd, plan);
    planned.advance(u64::MAX).unwrap();
    let mut changed = start(BusKind::Fd, "none");
    let at = |run: &mut Simulation<_, _>, us: u64| run.advance(us * 1000 - run.now_ns()).unwrap();
    let change = |run: &mut Simulation<_, _>, change| assert_eq!(run.change(change).unwrap(), Ok(()));
    at(&mut changed, 501);
    change(&mut changed, Change::Begin(Fault::Unplug(3), None));
    at(&mut changed, 1_000_501);
    change(&mut changed, Change::End(Fault::Unplug(3)));
    at(&mut changed, 1_700_001);
    change(&mut changed, Change::Begin(Fault::ActuatorDead(2), None));
    at(&mut changed, 1_800_001);
    change(&mut changed, Change::Begin(Fault::SensorZeroed(4), Some(199_999_000)));
    changed.advance(u64::MAX).unwrap();
    assert_eq!(planned.plant().history, changed.plant().history);
    assert_eq!(planned.report().unwrap(), changed.report().unwrap());
}

#[test]
fn everything_can_be_begun_and_mended_and_seen() {
    let mut run = start(BusKind::Fd, "none");
    run.advance_cycles(5).unwrap();
    let begin = |run: &mut Simulation<_, _>, fault| run.change(Change::Begin(fault, None)).unwrap().unwrap();
    let faults = [
        Fault::Unplug(1),
        Fault::ActuatorDead(2),
        Fault::SensorZeroed(3),
        Fault::SensorStuck(4),
        Fault::Cut(5),
        Fault::Misread(6, 0.1),
        Fault::Drop(0.1),
        Fault::Drop(0.2),
        Fault::Delay(MS),
        Fault::Corrupt(0.01),
        Fault::Duplicate(0.1),
        Fault::Babble(7, 0x0ff),
    ];
    for fault in faults {
        begin(&mut run, fault);
        run.advance_cycles(1).unwrap();
    }
    let active = run.look(|seen| seen.faults.to_vec()).unwrap();
    let expected: Vec<Fault> = faults.into_iter().filter(|fault| *fault != Fault::Drop(0.1)).collect();
    assert_eq!(active, expected, "one loss takes the place of the other");
    assert_eq!(run.look(|seen| (seen.modules[1].plugged, seen.cuts)).unwrap(), (false, 1 << 5));
    for fault in expected {
        assert_eq!(run.change(Change::End(fault)).unwrap(), Ok(()), "{fault:?}");
    }
    run.advance_cycles(30).unwrap();
    assert!(run.look(|seen| seen.faults.is_empty() && seen.modules.iter().all(|m| m.alive == 0xff)).unwrap());
    // The station's orders.
    assert_eq!(run.change(Change::Order(StopCommand::Stop)).unwrap(), Ok(()));
    run.advance_cycles(2).unwrap();
    assert!(run.look(|seen| seen.modules.iter().all(|m| m.mode == Mode::Stopped)).unwrap());
    assert_eq!(run.change(Change::Order(StopCommand::Release)).unwrap(), Ok(()));
    run.advance_cycles(2).unwrap();
    assert!(run.look(|seen| seen.modules.iter().all(|m| m.mode == Mode::Active)).unwrap());
}

#[test]
fn what_cannot_be_is_refused_and_changes_nothing() {
    let mut run = start(BusKind::Fd, "unplug:#3@0s");
    run.advance_cycles(2).unwrap();
    let before = run.look(|seen| seen.faults.to_vec()).unwrap();
    let begin = |fault| Change::Begin(fault, None);
    for (change, sentence) in [
        (begin(Fault::Unplug(8)), "there is no module 8: this robot has 8, numbered from 0"),
        (begin(Fault::Cut(7)), "there is no cable behind module 7: it is the last one"),
        (begin(Fault::Cut(9)), "there is no module 9"),
        (begin(Fault::Drop(1.5)), "1.5 is no probability"),
        (begin(Fault::Drop(f64::NAN)), "NaN is no probability"),
        (begin(Fault::Babble(1, 0x800)), "0x800 is no identifier"),
        (begin(Fault::Unplug(3)), "module 3 is unplugged already"),
        (begin(Fault::BrownOut(3)), "module 3 has no power"),
        (Change::End(Fault::Unplug(2)), "not so: module 2 is plugged in"),
        (Change::End(Fault::Cut(2)), "not so: the cable is whole behind module 2"),
        (Change::End(Fault::Delay(0)), "not so: no frames are late"),
        (Change::Goal([1.0, 2.0, f32::NAN]), "a goal cannot be there"),
        (Change::Goal([1.0, 2.0, 0.0]), "this plant has no goal that can be moved"),
    ] {
        let refusal = run.change(change).unwrap().unwrap_err().to_string();
        assert!(refusal.starts_with(sentence), "{refusal}");
    }
    assert_eq!(run.look(|seen| seen.faults.to_vec()).unwrap(), before);
    // Nobody can order what no station says.
    let image = image();
    let policy = Policy::parse(&image).unwrap();
    let config = SilConfig { station: false, ..SilConfig::new(BusKind::Fd) };
    let mut run = Simulation::new(InProcess::new(policy), Toy::new(2, 5), policy, config).unwrap();
    assert_eq!(run.change(Change::Order(StopCommand::Stop)).unwrap(), Err(Refusal::NoStation));
}
