//! What people and programs are shown of a robot on its bus.

use std::fmt::Write;
use std::time::Duration;

use composer_shared::wire::{Heartbeat, LimitedBy, NOBODY};
use serde_json::{Value, json};

use super::robot::{Change, Module, Robot, fault_name};

/// The row of a module: what stands in the columns after its number.
fn row(module: &Module, now: Duration) -> [String; 9] {
    let or = |text: Option<String>| text.unwrap_or_else(|| "-".into());
    let mode = match (module.heard, module.gone) {
        (None, _) => "never heard".into(),
        (_, true) => "GONE".into(),
        _ => or(module.mode().map(|mode| mode.name().into())),
    };
    let fault = match (module.fault(), module.last_fault) {
        (Some(0), Some((last, at))) => format!("none (was {last}, {:.0} s ago)", now.saturating_sub(at).as_secs_f64()),
        (Some(fault), _) => fault_name(fault),
        (None, _) => "-".into(),
    };
    let keeper = |keeper: u8| if keeper == NOBODY { "nobody".into() } else { keeper.to_string() };
    [
        mode,
        fault,
        or(module.supply.map(|volts| format!("{volts:.1} V"))),
        or(module.telemetry.map(|telemetry| format!("{} C", telemetry.temperature))),
        or(module
            .telemetry
            .map(|t| format!("{:+.2} {:+.2}", f32::from(t.torque[0]) / 127.0, f32::from(t.torque[1]) / 127.0))),
        or(module.telemetry.and_then(|t| {
            let limit = LimitedBy::ALL.into_iter().find(|limit| *limit as u8 == t.limited_by)?;
            Some(format!("{limit:?}"))
        })),
        or(module.heartbeat.map(|heartbeat| keeper(heartbeat.time_keeper))),
        or(module.heartbeat.map(|heartbeat| policy(&heartbeat))),
        or(module.heard.map(|heard| age(now.saturating_sub(heard)))),
    ]
}

/// The tag of its policy, and what else is to be known of it: "lab" for a module without a key, which takes any policy.
fn policy(heartbeat: &Heartbeat) -> String {
    let lab = if heartbeat.lab() { " lab" } else { "" };
    let trial = if heartbeat.on_trial() { " on trial" } else { "" };
    format!("{:04x}{lab}{trial}", heartbeat.policy)
}

fn age(age: Duration) -> String {
    match age.as_millis() {
        ms @ ..1000 => format!("{ms} ms"),
        ms => format!("{:.1} s", ms as f64 / 1000.0),
    }
}

/// A table of all modules, and what is to be said of the robot as a whole.
pub fn table(robot: &Robot, now: Duration) -> String {
    const HEAD: [&str; 10] =
        ["node", "mode", "fault", "supply", "motor", "torque y p", "limited by", "follows", "policy", "heard"];
    let rows: Vec<Vec<String>> = std::iter::once(HEAD.map(String::from).to_vec())
        .chain(
            robot.modules().map(|(node, module)| std::iter::once(node.to_string()).chain(row(module, now)).collect()),
        )
        .collect();
    let widths: Vec<usize> = (0..HEAD.len()).map(|k| rows.iter().map(|row| row[k].len()).max().unwrap_or(0)).collect();
    let mut text = String::new();
    for row in &rows {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        let _ = writeln!(text, "{}", cells.join("  ").trim_end());
    }
    let (frames, malformed, stations) = robot.counts();
    let beat = match robot.sync() {
        Some((keeper, sync)) => format!(
            "cycle {} of {:.1} ms by module {keeper}, {} of {} modules alive",
            sync.cycle,
            robot.period().as_secs_f64() * 1e3,
            sync.alive,
            sync.modules
        ),
        None => "no control cycle".into(),
    };
    let stop = if robot.stop().stopped() { "; STOPPED" } else { "" };
    let _ = writeln!(text, "{beat}{stop}; {frames} frames, {malformed} malformed, {stations} of another station");
    for warning in robot.warnings() {
        let _ = writeln!(text, "{warning}");
    }
    text
}

/// The same as one JSON object: `at` (s), `stopped`, `modules` (a list), `warnings`.
pub fn json_state(robot: &Robot, now: Duration) -> Value {
    let modules: Vec<Value> = robot
        .modules()
        .map(|(node, module)| {
            let fault = module.fault().filter(|fault| *fault != 0);
            json!({
                "node": node,
                "present": module.heard.is_some() && !module.gone,
                "mode": module.mode().map(|mode| mode.name()),
                "fault": fault,
                "fault_name": fault.map(fault_name),
                "last_fault": module.last_fault.map(|(fault, _)| fault),
                "supply": module.supply,
                "temperature": module.telemetry.map(|telemetry| telemetry.temperature),
                "age": module.heard.map(|heard| now.saturating_sub(heard).as_secs_f64()),
                "policy": module.heartbeat.map(|heartbeat| format!("{:04x}", heartbeat.policy)),
                "lab": module.heartbeat.map(|heartbeat| heartbeat.lab()),
                "on_trial": module.heartbeat.map(|heartbeat| heartbeat.on_trial()),
                "time_keeper": module.heartbeat.map(|heartbeat| heartbeat.time_keeper).filter(|node| *node != NOBODY),
            })
        })
        .collect();
    json!({ "at": now.as_secs_f64(), "stopped": robot.stop().stopped(), "modules": modules, "warnings": robot.warnings() })
}

/// A change as one JSON object: `at` (s), `event`, and what belongs to it.
pub fn json_change(change: Change, now: Duration) -> Value {
    let at = now.as_secs_f64();
    match change {
        Change::Came(node) => json!({ "at": at, "event": "came", "node": node }),
        Change::Gone { node, last_fault } => {
            json!({ "at": at, "event": "gone", "node": node, "last_fault": last_fault, "fault_name": fault_name(last_fault) })
        }
        Change::Fault { node, fault } => {
            json!({ "at": at, "event": "fault", "node": node, "fault": fault, "fault_name": fault_name(fault) })
        }
        Change::Stopped(stopped) => json!({ "at": at, "event": if stopped { "stopped" } else { "released" } }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::{Health, Heartbeat, Message, Mode, PROTOCOL_VERSION, Sync, Telemetry};

    #[test]
    fn the_table_shows_who_is_there_and_who_is_not() {
        let mut robot = Robot::default();
        let ms = Duration::from_millis;
        let health = Health::SENSORS_PLAUSIBLE;
        let beat = |fault| {
            let mode = Mode::Relaxed as u8 | Heartbeat::LAB;
            Heartbeat { mode, fault, health, time_keeper: 0, protocol: PROTOCOL_VERSION, firmware: 16, policy: 0xa1 }
        };
        robot.hear(ms(0), &Message::Sync(Sync::new(7, 2, 3)).emit(0, true));
        robot.hear(ms(1), &Message::Heartbeat(beat(0)).emit(0, true));
        robot.hear(ms(1), &Message::Heartbeat(beat(37)).emit(1, true));
        let telemetry = Telemetry {
            temperature: 81,
            torque: [127, -64],
            limited_by: 99,
            attends_to: NOBODY,
            ..Telemetry::default()
        };
        robot.hear(ms(2), &Message::Telemetry(telemetry).emit(1, true));
        robot.note_supply(1, 11.96);
        let text = table(&robot, ms(42));
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].starts_with("node  mode"), "{text}");
        assert!(lines[1].starts_with("0     relaxed"), "{text}");
        for word in ["37 OverTemperature", "12.0 V", "81 C", "+1.00 -0.50", "Relaxed", "00a1 lab", "40 ms"] {
            assert!(lines[2].contains(word), "{word}: {text}");
        }
        assert!(lines[3].contains("never heard"), "{text}");
        assert!(lines[4].contains("cycle 7") && lines[4].contains("2 of 3 modules alive"), "{text}");
        let value = json_state(&robot, ms(42));
        assert_eq!((&value["modules"][1]["fault"], &value["modules"][1]["temperature"]), (&json!(37), &json!(81)));
        assert_eq!(value["modules"][2]["present"], json!(false));
        assert_eq!((&value["modules"][1]["lab"], &value["modules"][1]["on_trial"]), (&json!(true), &json!(false)));
        robot.hear(ms(300), &Message::Sync(Sync::new(13, 2, 3)).emit(0, true));
        let gone = robot.look(ms(310));
        assert_eq!(gone.len(), 1);
        assert!(table(&robot, ms(310)).contains("GONE"));
        assert_eq!(json_change(gone[0], ms(310))["fault_name"], json!("37 OverTemperature"));
    }
}
