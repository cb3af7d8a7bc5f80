//! A station talks to three modules on the simulated bus, wherever they run.

use composer_firmware::controller::BusKind;
use composer_shared::policy::Policy;
use composer_shared::registers::Register;
use composer_shared::wire::{ALL_MODULES, Message, Operation, STATION, ServiceCode, ServiceRequest, ServiceResponse};
use composer_sim_bridge::candump;
use composer_sim_bridge::computer::Launcher;
use composer_sim_bridge::plant::Bench;
use composer_sim_bridge::sil::{Injected, SilConfig, run_on};

/// A request, and what each module that is asked answers.
pub struct Exchange {
    request: ServiceRequest,
    code: ServiceCode,
    /// None: not checked here.
    value: Option<u32>,
}

fn exchange(
    destination: u8,
    operation: Operation,
    index: u8,
    value: u32,
    answer: Result<Option<u32>, ServiceCode>,
) -> Exchange {
    let request = ServiceRequest { destination, operation: operation as u8, sequence: 0, index, value };
    let (code, value) = match answer {
        Ok(value) => (ServiceCode::Ok, value),
        Err(code) => (code, Some(0)),
    };
    Exchange { request, code, value }
}

/// Everything that a station may ask, with every code that a module refuses with on its own.
pub fn script(policy: &Policy<'_>) -> Vec<Exchange> {
    use Operation::*;
    let at = |register: Register, offset: u8| register.spec().first + offset;
    let zero = at(Register::EncoderZero, 2);
    let mut script = vec![
        exchange(ALL_MODULES, Hello, 4, 0, Ok(Some(policy.crc()))),
        exchange(1, Read, at(Register::Supply, 0), 0, Ok(Some(12f32.to_bits()))),
        exchange(ALL_MODULES, Read, at(Register::Boots, 0), 0, Ok(Some(1))),
        exchange(1, Read, 255, 0, Err(ServiceCode::NoSuchRegister)),
        exchange(1, Write, at(Register::Supply, 0), 0, Err(ServiceCode::ReadOnly)),
        exchange(1, Write, zero, 16384, Err(ServiceCode::OutOfRange)),
        exchange(1, Write, at(Register::Node, 0), 2, Err(ServiceCode::WrongModule)),
        exchange(1, SetNode, 0, 5, Err(ServiceCode::WrongModule)),
        exchange(1, Write, zero, 777, Ok(Some(777))),
        exchange(1, Store, 0, 0, Ok(Some(0))),
        // Armed, and what is refused then.
        exchange(ALL_MODULES, Arm, 0, 0, Ok(Some(0))),
        exchange(1, Write, zero, 1, Err(ServiceCode::Armed)),
        exchange(1, Restart, 0, 0, Err(ServiceCode::Armed)),
        exchange(1, Jog, 0, 100 << 16 | 100, Err(ServiceCode::Armed)),
        exchange(ALL_MODULES, Disarm, 0, 0, Ok(Some(0))),
        exchange(1, Jog, 0, 50 << 16 | 500, Ok(Some(40f32.to_bits()))),
        exchange(1, Jog, 0, 50 << 16 | 700, Err(ServiceCode::OutOfRange)),
        exchange(2, Identify, 0, 1, Ok(Some(0))),
        // The motors of the bench gave no torque in the jog: fault 50 was logged last.
        exchange(1, Log, 0, 2, Ok(Some(50 << 16 | 1))),
        exchange(1, Log, 9, 0, Err(ServiceCode::NoSuchRegister)),
        exchange(1, Restart, 0, 0, Ok(Some(0))),
    ];
    // It listens for a cycle before it talks again.
    script.extend((0..3).map(|_| exchange(2, Read, at(Register::Boots, 0), 0, Ok(Some(1)))));
    script.extend([
        exchange(1, Read, at(Register::Boots, 0), 0, Ok(Some(2))),
        exchange(1, Read, zero, 0, Ok(Some(777))),
        exchange(1, Read, at(Register::JointAngle, 2), 0, Ok(None)),
        exchange(ALL_MODULES, Arm, 0, 0, Ok(Some(0))),
    ]);
    for (sequence, exchange) in (1..).zip(&mut script) {
        exchange.request.sequence = sequence;
    }
    script
}

/// Holds the script against modules that `launcher` starts. Gives all answers, with the module that gave each.
pub fn talk<L: Launcher>(launcher: &L, policy: Policy<'_>, bus: BusKind) -> Vec<(u8, ServiceResponse)> {
    const MODULES: u8 = 3;
    const BETWEEN_NS: u64 = 100_000_000;
    let script = script(&policy);
    let injected = (10u64..).zip(&script).map(|(i, exchange)| Injected {
        at_ns: i * BETWEEN_NS,
        frame: Message::ServiceRequest(exchange.request).emit(STATION, bus == BusKind::Fd),
    });
    let config = SilConfig { station: false, injected: injected.collect(), ..SilConfig::new(bus) };
    let mut plant = Bench { modules: MODULES.into(), steps: (script.len() as u32 + 12) * 20 };
    let mut log = Vec::new();
    run_on(launcher, &mut plant, policy, &config, Some(&mut log), &mut |_, _| {}).unwrap();
    let entries = candump::parse(std::str::from_utf8(&log).unwrap()).unwrap();
    let answers: Vec<(u8, ServiceResponse)> = entries
        .iter()
        .filter_map(|entry| match Message::parse(&entry.frame) {
            Ok(Message::ServiceResponse(response)) => Some((entry.frame.module(), response)),
            _ => None,
        })
        .collect();
    for Exchange { request, code, value } in &script {
        let given: Vec<_> = answers.iter().filter(|(_, answer)| answer.sequence == request.sequence).collect();
        let mut modules: Vec<u8> = given.iter().map(|(module, _)| *module).collect();
        modules.sort_unstable();
        let asked: Vec<u8> = (0..MODULES).filter(|module| request.is_for(*module)).collect();
        assert_eq!(modules, asked, "{request:?}");
        for (module, answer) in given {
            let expected = request.answer(*code, value.unwrap_or(answer.value));
            assert_eq!(*answer, expected, "module {module}");
        }
    }
    answers
}
