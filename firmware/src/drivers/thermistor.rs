//! Motor temperature from a thermistor (NTC) in a voltage divider.

/// An NTC to ground below a resistor to the reference of the converter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thermistor {
    /// Resistance at 25 degrees Celsius, in ohm.
    pub nominal: f32,
    /// Beta coefficient, kelvin.
    pub beta: f32,
    /// The resistor above, in ohm.
    pub pull_up: f32,
}

/// 0 and 25 degrees Celsius, in kelvin.
const FREEZING: f32 = 273.15;
const NOMINAL: f32 = FREEZING + 25.0;
/// Beyond this part of the full scale, at either end, the thermistor is torn off or shorted.
const MARGIN: f32 = 0.005;

impl Thermistor {
    /// The temperature, degrees Celsius, for a reading as a fraction of the converter's full scale. Not a number if the thermistor is torn off
    /// or shorted, which the controller treats as too hot.
    pub fn celsius(&self, fraction: f32) -> f32 {
        if !(MARGIN..=1.0 - MARGIN).contains(&fraction) {
            return f32::NAN;
        }
        let resistance = self.pull_up * fraction / (1.0 - fraction);
        1.0 / (1.0 / NOMINAL + libm::logf(resistance / self.nominal) / self.beta) - FREEZING
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NTC: Thermistor = Thermistor { nominal: 10e3, beta: 3435.0, pull_up: 10e3 };

    #[test]
    fn temperatures_of_the_data_sheet() {
        // Resistances of a 10 kohm thermistor with a beta of 3435 K between 25 and 85 degrees; at 0 degrees beta alone is a degree off.
        for (ohm, celsius, within) in [(10e3, 25.0, 0.01), (1451.0, 85.0, 0.1), (27.3e3, 0.0, 1.5)] {
            let got = NTC.celsius(ohm / (ohm + 10e3));
            assert!((got - celsius).abs() < within, "{ohm}: {got}");
        }
    }

    #[test]
    fn torn_off_or_shorted_is_no_temperature() {
        for fraction in [0.0, 0.004, 0.996, 1.0, f32::NAN, -1.0] {
            assert!(NTC.celsius(fraction).is_nan(), "{fraction}");
        }
    }
}
