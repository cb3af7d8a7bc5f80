//! The configuration of a whole robot as a file: the node pages of all modules, each with the unique identifier of its chip.

use std::collections::BTreeMap;

use composer_shared::registers::{Kind, Name, Register};
use composer_shared::wire::{Mode, Operation, ServiceCode};
use serde::{Deserialize, Serialize};
use toml::Value;

use super::station::{Answer, Station};
use super::{BusError, sentence};

/// A robot's configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotFile {
    /// How many modules it has.
    pub modules: u8,
    /// Its modules.
    pub module: Vec<ModuleFile>,
}

/// A module's node page: its registers by name, those in a row as a list.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModuleFile {
    /// Its number.
    pub node: u8,
    /// The unique identifier of its chip, three words in hexadecimal.
    pub unique_id: String,
    /// Everything else.
    #[serde(flatten)]
    pub registers: BTreeMap<String, Value>,
}

/// What a restore did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Restored {
    /// Modules whose node page was changed, with the number of registers.
    pub changed: Vec<(u8, usize)>,
    /// Modules that agreed already.
    pub same: Vec<u8>,
}

/// The registers that make a node page, its number apart.
fn stored() -> impl Iterator<Item = Register> {
    Register::ALL.iter().copied().filter(|register| register.spec().is_stored() && *register != Register::Node)
}

/// A number as the file has it.
fn value(kind: Kind, bits: u32) -> Value {
    match kind {
        // By its shortest text: 0.2, not 0.20000000298023224.
        Kind::F32 => Value::Float(f32::from_bits(bits).to_string().parse().unwrap_or(f64::NAN)),
        _ => Value::Integer(kind.number(bits) as i64),
    }
}

/// The bits of a number in a file.
fn bits(number: u8, kind: Kind, value: &Value) -> Option<u32> {
    let bits = match (kind, value) {
        (Kind::F32, Value::Float(value)) => (*value as f32).to_bits(),
        (Kind::F32, Value::Integer(value)) => (*value as f32).to_bits(),
        (Kind::U32, Value::Integer(value)) => u32::try_from(*value).ok()?,
        (Kind::I32, Value::Integer(value)) => i32::try_from(*value).ok()? as u32,
        _ => return None,
    };
    Register::by_number(number).filter(|(_, spec, _)| spec.accepts(bits)).map(|_| bits)
}

fn unique_id(station: &mut Station, node: u8) -> Result<String, BusError> {
    let words = Register::UniqueId.numbers().map(|number| station.request(node, Operation::Read, number, 0));
    let words = words.collect::<Result<Vec<u32>, _>>()?;
    Ok(words.iter().map(|word| format!("{word:08x}")).collect::<Vec<_>>().join("-"))
}

/// Reads the configuration of all modules. Refused if one is missing.
pub fn dump(station: &mut Station) -> Result<RobotFile, BusError> {
    let nodes = everybody(station)?;
    let mut module = Vec::new();
    for node in &nodes {
        let mut registers = BTreeMap::new();
        for register in stored() {
            let spec = register.spec();
            let mut values = Vec::new();
            for number in register.numbers() {
                values.push(value(spec.kind, station.request(*node, Operation::Read, number, 0)?));
            }
            let one = if spec.count == 1 { values.remove(0) } else { Value::Array(values) };
            registers.insert(register.words().name.to_string(), one);
        }
        module.push(ModuleFile { node: *node, unique_id: unique_id(station, *node)?, registers });
    }
    Ok(RobotFile { modules: nodes.len() as u8, module })
}

/// The modules of the robot; all have to be there.
fn everybody(station: &mut Station) -> Result<Vec<u8>, BusError> {
    let nodes = station.meet()?;
    let expected = station.robot().expected();
    if expected > 0 && usize::from(expected) != nodes.len() {
        let missing: Vec<String> =
            (0..expected).filter(|node| !nodes.contains(node)).map(|node| node.to_string()).collect();
        return Err(BusError::Refusal(format!(
            "module {} of {expected} is not on the bus; a robot's configuration is that of all its modules",
            missing.join(", ")
        )));
    }
    Ok(nodes)
}

impl RobotFile {
    /// The file.
    pub fn to_toml(&self) -> String {
        let body = toml::to_string(self).unwrap_or_default();
        format!(
            "# The configuration of a robot, as `snakectl bus ... dump` read it. `snakectl bus ... restore` writes it to the same modules.\n\
             # Registers and their units: firmware/registers.md.\n\n{body}"
        )
    }

    /// Reads a file; whatever no node page can hold is refused.
    pub fn parse(text: &str) -> Result<Self, BusError> {
        let refuse = |reason: String| Err(BusError::Refusal(format!("it is no configuration of a robot: {reason}")));
        let file: RobotFile = match toml::from_str(text) {
            Ok(file) => file,
            Err(error) => return refuse(error.to_string().trim().replace('\n', " ")),
        };
        let nodes: Vec<u8> = file.module.iter().map(|module| module.node).collect();
        if nodes != (0..file.modules).collect::<Vec<u8>>() {
            return refuse(format!(
                "modules = {} wants modules 0 to {} in order, each once",
                file.modules,
                i32::from(file.modules) - 1
            ));
        }
        for module in &file.module {
            if let Err(reason) = module.numbers() {
                return refuse(format!("module {}: {reason}", module.node));
            }
        }
        Ok(file)
    }
}

impl ModuleFile {
    /// What each register is to hold. The error is a part of a sentence.
    fn numbers(&self) -> Result<Vec<(u8, u32)>, String> {
        let mut all = Vec::new();
        for (name, given) in &self.registers {
            let Some(register) = stored().find(|register| register.words().name == name) else {
                return Err(format!("`{name}` is no register of a node page"));
            };
            let spec = register.spec();
            let values = match given {
                Value::Array(values) if spec.count > 1 => values.clone(),
                Value::Array(_) => Vec::new(),
                one if spec.count == 1 => vec![one.clone()],
                _ => Vec::new(),
            };
            if values.len() != usize::from(spec.count) {
                return Err(format!("`{name}` has {} values", spec.count));
            }
            for (number, value) in register.numbers().zip(&values) {
                let (low, high) = spec.range();
                let bits = bits(number, spec.kind, value).ok_or_else(|| {
                    format!("{value} is no value of {}: it takes {} to {}", Name(number), low as f32, high as f32)
                })?;
                all.push((number, bits));
            }
        }
        let known = stored().map(|register| register.words().name);
        match known.into_iter().find(|name| !self.registers.contains_key(*name)) {
            Some(missing) => Err(format!("`{missing}` is missing")),
            None => Ok(all),
        }
    }
}

/// Writes a configuration to the robot that it is of, and stores it. Everything is checked before anything is written: that all modules are there,
/// that each has the chip that the file says, and that none is armed. It counts from the next start of each module on.
pub fn restore(station: &mut Station, file: &RobotFile) -> Result<Restored, BusError> {
    let nodes = everybody(station)?;
    if nodes.len() != usize::from(file.modules) {
        return Err(BusError::Refusal(format!(
            "the file is of a robot of {} modules, this one has {}: it is another robot's",
            file.modules,
            nodes.len()
        )));
    }
    for module in &file.module {
        let node = module.node;
        let found = unique_id(station, node)?;
        if found != module.unique_id {
            return Err(BusError::Refusal(format!(
                "the file is of another robot: its module {node} has the chip {}, this one {found}; nothing was written",
                module.unique_id
            )));
        }
        let mode = station.request(node, Operation::Read, Register::Mode.spec().first, 0)?;
        if [Mode::Active, Mode::Relaxed, Mode::Alone].map(|mode| mode as u32).contains(&mode) {
            return Err(BusError::Refused { node, what: "a new configuration".into(), code: ServiceCode::Armed as u8 });
        }
    }
    let mut restored = Restored::default();
    for module in &file.module {
        let node = module.node;
        let wanted = module.numbers().map_err(BusError::Refusal)?;
        let mut changed = 0;
        for (number, bits) in wanted {
            if station.request(node, Operation::Read, number, 0)? != bits {
                station.request(node, Operation::Write, number, bits)?;
                changed += 1;
            }
        }
        if changed == 0 {
            restored.same.push(node);
        } else {
            store(station, node)?;
            restored.changed.push((node, changed));
        }
    }
    Ok(restored)
}

/// Has a module keep its node page; the error names the register that does not fit the others.
pub fn store(station: &mut Station, node: u8) -> Result<(), BusError> {
    let Answer { code, value } = station.answer_of(node, Operation::Store, 0, 0)?;
    if code == ServiceCode::Ok as u8 {
        return Ok(());
    }
    match Register::by_number(value as u8) {
        Some(_) if code == ServiceCode::OutOfRange as u8 && value > 0 => Err(BusError::Refusal(format!(
            "module {node} refuses STORE: {} does not fit the other registers; firmware/registers.md says what does",
            Name(value as u8)
        ))),
        _ => Err(BusError::Refused { node, what: format!("STORE ({})", sentence(code)), code }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> RobotFile {
        let registers = stored().map(|register| {
            let (spec, words) = (register.spec(), register.words());
            let (low, high) = spec.range();
            let middle = value(spec.kind, spec.kind.bits((low + high) / 3.0));
            let one = if spec.count == 1 { middle } else { Value::Array(vec![middle; usize::from(spec.count)]) };
            (words.name.to_string(), one)
        });
        let module =
            ModuleFile { node: 0, unique_id: "00000001-00000002-00000003".into(), registers: registers.collect() };
        RobotFile { modules: 2, module: vec![module.clone(), ModuleFile { node: 1, ..module }] }
    }

    #[test]
    fn what_is_written_is_read_back_to_the_last_bit() {
        let read = RobotFile::parse(&file().to_toml()).unwrap();
        assert_eq!(read, file());
        assert_eq!(read.module[0].numbers(), file().module[0].numbers());
        for number in [0.1f32, 1e-6, 3.1, 16777217.0, 0.333_333_34] {
            let kind = Kind::F32;
            let Value::Float(float) = value(kind, number.to_bits()) else { panic!() };
            assert_eq!(float as f32, number);
        }
    }

    #[test]
    fn what_is_no_configuration_is_refused_with_a_sentence() {
        let good = file().to_toml();
        for (from, to, word) in [
            ("modules = 2\n", "modules = 3\n", "modules 0 to 2"),
            ("node = 1", "node = 5", "modules 0 to 1"),
            ("bus_off = 0", "bus_off = 2", "2 is no value of bus_off: it takes 0 to 1"),
            ("bus_off = 0", "busoff = 0", "`busoff` is no register"),
            ("bus_off = 0", "", "`bus_off` is missing"),
            ("bus_off = 0", "bus_off = [0, 0]", "`bus_off` has 1 values"),
            ("unique_id", "uniqueid", "unique_id"),
            ("[[module]]", "[[modul]]", "modul"),
        ] {
            let text = good.replacen(from, to, 1);
            assert_ne!(text, good, "{from}");
            let error = RobotFile::parse(&text).unwrap_err().to_string();
            assert!(error.contains("no configuration of a robot") && error.contains(word), "{error}");
        }
    }
}
