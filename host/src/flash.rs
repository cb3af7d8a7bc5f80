//! What goes into the flash of a module: its node page from a calibration file, its policy, its image; and the commands that bring them there.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use composer_firmware::drivers::encoder::JointCalibration;
use composer_firmware::limits::{Caps, JointRange};
use composer_firmware::memory_map::{FLASH_ADDRESS, FLASH_SIZE, NODE_PAGE_ADDRESS, POLICY_ADDRESS, RECORDS_ADDRESS};
use composer_firmware::node_page::{Calibration, MotorCalibration};
use composer_firmware::safety::Safety;
use composer_firmware::supply::Thresholds;
use composer_shared::robot::MAX_JOINTS;
use object::read::elf::{FileHeader, ProgramHeader};
use object::{LittleEndian, elf};
use serde::Deserialize;

use crate::robot::Robot;

/// Used where nobody measured: `host/configs/calibration.toml`.
pub const NOMINAL_CALIBRATION: &str = include_str!("../configs/calibration.toml");

/// Where `cargo image-stm32g474` leaves the image.
pub const IMAGE: &str = "target/thumbv7em-none-eabihf/firmware/composer-stm32g474";

/// The chip as probe-rs calls it.
pub const CHIP: &str = "STM32G474RETx";

/// A calibration file, in SI units.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationFile {
    encoders: [Encoder; MAX_JOINTS],
    imu: Imu,
    limits: Limits,
    supply: Supply,
    yaw: Motor,
    pitch: Motor,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Encoder {
    zero: u16,
    reversed: bool,
    min: f32,
    max: f32,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Limits {
    torque: f32,
    torque_slew: f32,
    temperature: f32,
    dead_man_ms: u16,
    blind_relaxes: bool,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Supply {
    lowest: f32,
    highest: f32,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Imu {
    mounting: [[f32; 3]; 3],
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Motor {
    torque_constant: f32,
    current_limit: f32,
    cut_off: f32,
    resistance: f32,
    inductance: f32,
    sense_range: f32,
    sense_zero: f32,
}

/// Reads the text of a calibration file: what was measured, and what the module is to keep to. `robot` says how many newton metres its unit of torque is.
/// Ranges are checked when the node page is made of it.
pub fn calibration(text: &str, robot: &Robot) -> Result<(Calibration, Safety)> {
    let file: CalibrationFile =
        toml::from_str(text).map_err(|e| anyhow::anyhow!("{}", e.to_string().trim().replace('\n', " ")))?;
    let units = |newton_metres: f32| newton_metres / robot.scale.newton_metres_per_unit;
    let motor = |motor: &Motor| MotorCalibration {
        torque_constant: units(motor.torque_constant),
        current_limit: motor.current_limit,
        cut_off: motor.cut_off,
        resistance: motor.resistance,
        inductance: motor.inductance,
        sense_range: motor.sense_range,
        sense_zero: motor.sense_zero,
    };
    let safety = Safety {
        joints: file.encoders.each_ref().map(|encoder| JointRange { min: encoder.min, max: encoder.max }),
        caps: Caps {
            torque: units(file.limits.torque),
            torque_slew: units(file.limits.torque_slew),
            temperature: file.limits.temperature,
        },
        supply: Thresholds { under: file.supply.lowest, over: file.supply.highest },
        dead_man_ms: file.limits.dead_man_ms,
        blind_relaxes: file.limits.blind_relaxes,
    };
    let joints = file.encoders.map(|encoder| JointCalibration { zero: encoder.zero, reversed: encoder.reversed });
    let motors = [motor(&file.yaw), motor(&file.pitch)];
    Ok((Calibration { joints, imu_mounting: file.imu.mounting, motors }, safety))
}

/// Checks that a file is an image for the board: an ARM program all of whose bytes lie in the flash region for code.
pub fn check_image(path: &Path) -> Result<()> {
    let shown = path.display();
    let bytes = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            bail!("there is no image {shown}: build it with `cargo image-stm32g474`, or say with --image where it is")
        }
        bytes => bytes.with_context(|| format!("cannot read the image {shown}"))?,
    };
    let wrong = || format!("{shown} is no ARM program in ELF form: build the image with `cargo image-stm32g474`");
    let header = elf::FileHeader32::<LittleEndian>::parse(&*bytes).map_err(|_| anyhow::anyhow!(wrong()))?;
    ensure!(header.e_machine(LittleEndian) == elf::EM_ARM, wrong());
    let segments = header.program_headers(LittleEndian, &*bytes).map_err(|_| anyhow::anyhow!(wrong()))?;
    let (first, end) = (u64::from(FLASH_ADDRESS), u64::from(FLASH_ADDRESS) + u64::from(FLASH_SIZE));
    let mut loaded = 0;
    for segment in segments.iter().filter(|s| s.p_type(LittleEndian) == elf::PT_LOAD) {
        let (address, size) = (u64::from(segment.p_paddr(LittleEndian)), u64::from(segment.p_filesz(LittleEndian)));
        if size > 0 && (address < first || address + size > end) {
            bail!(
                "{shown} is not for this board: it has bytes at {address:#010x}, the board's code lies from {first:#010x} to {end:#010x}"
            );
        }
        loaded += size;
    }
    ensure!(loaded > 0, wrong());
    Ok(())
}

/// What is to be written.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The image, an ELF file.
    pub image: PathBuf,
    /// The policy image, with its header if it is signed.
    pub policy: PathBuf,
    /// The records that make it count.
    pub records: PathBuf,
    /// The node page.
    pub node_page: PathBuf,
    /// The chip as probe-rs calls it.
    pub chip: String,
    /// Which probe, if there are several.
    pub probe: Option<String>,
}

/// One call of probe-rs: what it does, in words, and its arguments.
pub type Step = (&'static str, Vec<OsString>);

impl Plan {
    /// The calls of probe-rs, in order; each write is verified. The image comes last, so that a new one never starts with the parts of another module.
    pub fn steps(&self) -> Vec<Step> {
        let at = |address: u32| {
            ["--binary-format", "bin", "--base-address"]
                .map(OsString::from)
                .into_iter()
                .chain([format!("{address:#010x}").into()])
        };
        let download = |format: Vec<OsString>, file: &Path| {
            let start = ["download", "--non-interactive", "--disable-progressbars", "--verify"].map(OsString::from);
            start.into_iter().chain(self.target()).chain(format).chain([file.into()]).collect()
        };
        let elf = ["--binary-format", "elf"].map(OsString::from).to_vec();
        let reset = ["reset", "--non-interactive"].map(OsString::from).into_iter().chain(self.target()).collect();
        vec![
            ("write the policy", download(at(POLICY_ADDRESS).collect(), &self.policy)),
            ("write the records of policies", download(at(RECORDS_ADDRESS).collect(), &self.records)),
            ("write the node page", download(at(NODE_PAGE_ADDRESS).collect(), &self.node_page)),
            ("write the image", download(elf, &self.image)),
            ("restart the module", reset),
        ]
    }

    fn target(&self) -> impl Iterator<Item = OsString> {
        let probe = self.probe.iter().flat_map(|probe| ["--probe".into(), probe.into()]);
        ["--chip".into(), self.chip.clone().into()].into_iter().chain(probe)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_firmware::failsafe::BusOffPolicy;
    use composer_firmware::node_page::NodePage;
    use composer_shared::update::NO_KEY;

    #[test]
    fn the_nominal_calibration_fits_the_robot_that_ships() {
        let robot = Robot::default();
        let (calibration, safety) = calibration(NOMINAL_CALIBRATION, &robot).unwrap();
        let page =
            NodePage { node: 0, modules: 8, bus_off: BusOffPolicy::Recover, safety, calibration, keys: [NO_KEY; 2] };
        assert_eq!(NodePage::parse(&page.encode().unwrap()), Ok(page));
        // One definition: the file says in SI units what the firmware says in those of the robot.
        assert_eq!((calibration, safety), (Calibration::NOMINAL, Safety::BOARD));
        assert_eq!((safety.caps.torque, safety.caps.torque_slew), (robot.torque_limit, robot.torque_slew));
        for motor in calibration.motors {
            let reachable = motor.current_limit * motor.torque_constant;
            assert!(reachable >= robot.torque_limit, "{reachable}");
            assert!(motor.measurable() > motor.cut_off, "the cut-off current can be measured");
        }
    }

    #[test]
    fn calibration_errors_name_the_field() {
        for (from, to, word) in [
            ("cut_off", "cutoff", "cutoff"),
            ("zero = 0 ", "zero = 70000 ", "70000"),
            ("[limits]", "[bounds]", "bounds"),
            ("dead_man_ms = 2000", "dead_man_ms = 70000", "70000"),
            ("highest = 16.0", "", "highest"),
            ("[[encoders]]\nzero = 0\nreversed = false\nmin = -3.0\nmax = 3.0\n\n[imu]", "[imu]", "length 3"),
        ] {
            let text = NOMINAL_CALIBRATION.replacen(from, to, 1);
            assert_ne!(text, NOMINAL_CALIBRATION);
            let error = calibration(&text, &Robot::default()).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
