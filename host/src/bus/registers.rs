//! Registers of a module as people write them: by name, with units.

use anyhow::{Result, bail};
use composer_shared::registers::{Kind, Name, Register};

/// The numbers of the registers that `name` means: one (`supply`, `encoder_zero_2`), all of a row (`encoder_zero`), or one by its number.
pub fn find(name: &str) -> Result<Vec<u8>> {
    if let Ok(number) = name.parse::<u8>() {
        if Register::by_number(number).is_some() {
            return Ok(vec![number]);
        }
        bail!("there is no register {number}: firmware/registers.md lists them");
    }
    if let Some(number) = Register::number_of(name) {
        return Ok(vec![number]);
    }
    if let Some(register) = Register::ALL.iter().find(|register| register.words().name == name) {
        return Ok(register.numbers().collect());
    }
    let words: Vec<&str> = name.split('_').filter(|word| word.len() > 2).collect();
    let near: Vec<&str> = Register::ALL
        .iter()
        .map(|register| register.words().name)
        .filter(|known| words.iter().any(|word| known.contains(word)))
        .collect();
    let hint = if near.is_empty() {
        "firmware/registers.md lists them".into()
    } else {
        format!("there is {}", near.join(", "))
    };
    bail!("there is no register `{name}`: {hint}");
}

/// A value with its unit.
pub fn show(number: u8, bits: u32) -> String {
    let Some((register, spec, _)) = Register::by_number(number) else { return format!("{bits}") };
    let words = register.words();
    let value = match spec.kind {
        Kind::F32 => f32::from_bits(bits).to_string(),
        _ => format!("{}", spec.kind.number(bits)),
    };
    match (words.scale, words.unit) {
        (1.0, "") => value,
        (1.0, unit) => format!("{value} {unit}"),
        (scale, unit) => format!("{value} ({:.4} {unit})", spec.kind.number(bits) * scale),
    }
}

/// The bits of a value that somebody wrote, if the register takes it.
pub fn bits(number: u8, text: &str) -> Result<u32> {
    let Some((_, spec, _)) = Register::by_number(number) else { bail!("there is no register {number}") };
    let name = Name(number);
    let (low, high) = spec.range();
    let range = match spec.kind {
        Kind::F32 => format!("{} to {}", low as f32, high as f32),
        _ => format!("{low} to {high}, a whole number"),
    };
    let bits = match spec.kind {
        Kind::U32 => text.parse::<u32>().ok(),
        Kind::I32 => text.parse::<i32>().ok().map(|value| value as u32),
        Kind::F32 => text.parse::<f32>().ok().map(f32::to_bits),
    };
    match bits.filter(|bits| spec.accepts(*bits)) {
        Some(bits) => Ok(bits),
        None => bail!("`{text}` is no value of {name}: it takes {range}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registers_are_found_by_name_number_and_row() {
        let zero = Register::EncoderZero.spec().first;
        assert_eq!(find("encoder_zero_2").unwrap(), [zero + 2]);
        assert_eq!(find("encoder_zero").unwrap(), (zero..zero + 4).collect::<Vec<u8>>());
        assert_eq!(find(&zero.to_string()).unwrap(), [zero]);
        for (name, word) in [("encoder_null", "encoder_zero"), ("255", "no register 255"), ("xyz", "registers.md")] {
            let error = find(name).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn values_are_read_and_shown() {
        let (zero, limit) = (Register::EncoderZero.spec().first, Register::CurrentLimit.spec().first);
        assert_eq!(bits(zero, "8192").unwrap(), 8192);
        assert_eq!(show(zero, 8192), "8192 (3.1416 rad)");
        assert_eq!(show(limit, bits(limit, "1.25").unwrap()), "1.25 A");
        for (number, text, word) in [
            (zero, "16384", "0 to 16383"),
            (zero, "1.5", "whole number"),
            (limit, "nan", "0.001 to 100"),
            (limit, "much", "`much`"),
        ] {
            let error = bits(number, text).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
