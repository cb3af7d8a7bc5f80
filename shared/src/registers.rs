//! The registers of a module: everything that the station may read or write by number, with the operations READ and WRITE of
//! SERVICE_REQUEST. This is their one definition; [`document`] writes `firmware/registers.md` from it.
//!
//! A value is 32 bits on the wire: an unsigned or signed integer, or an IEEE 754 binary32 ([`Kind`]). The physical value of an integer is the
//! number times [`Words::scale`], in [`Words::unit`]. Several equal registers in a row (one a joint, an axis, a motor) are one entry with a
//! count; they have consecutive numbers, and their names end in `_0`, `_1` and so on.
//!
//! Numbers from [`STORED`] on are the fields of the node page: a write changes the module's copy of it, which the operation STORE keeps through a
//! loss of power, and which counts from the next start on. All others are what the module measures, counts and is at, since its last start.
//!
//! Numbers never change their meaning; new registers take free ones.

use core::fmt::{self, Write};

/// From this number on a register is a field of the node page.
pub const STORED: u8 = 128;

/// How the 32 bits of a value are to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Unsigned integer.
    U32,
    /// Signed integer, two's complement.
    I32,
    /// IEEE 754 binary32.
    F32,
}

impl Kind {
    /// The bits of a number of this kind; what does not fit is held at the end of the range.
    pub const fn bits(self, number: f64) -> u32 {
        match self {
            Kind::U32 => number as u32,
            Kind::I32 => (number as i32) as u32,
            Kind::F32 => (number as f32).to_bits(),
        }
    }

    /// The number that these bits say.
    pub const fn number(self, bits: u32) -> f64 {
        match self {
            Kind::U32 => bits as f64,
            Kind::I32 => (bits as i32) as f64,
            Kind::F32 => f32::from_bits(bits) as f64,
        }
    }

    /// Its name in Rust, and in the documentation.
    pub const fn name(self) -> &'static str {
        match self {
            Kind::U32 => "u32",
            Kind::I32 => "i32",
            Kind::F32 => "f32",
        }
    }
}

/// Who may write a register, and when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Nobody.
    ReadOnly,
    /// The station, at any time.
    ReadWrite,
    /// The station, while the module is disarmed.
    WhileDisarmed,
}

impl Access {
    /// In words.
    pub const fn name(self) -> &'static str {
        match self {
            Access::ReadOnly => "read",
            Access::ReadWrite => "read, write",
            Access::WhileDisarmed => "read, write while disarmed",
        }
    }
}

/// What a module has to know of a register.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spec {
    /// Number of the first.
    pub first: u8,
    /// How many there are in a row.
    pub count: u8,
    /// How its bits are to be read.
    pub kind: Kind,
    /// Who may write it.
    pub access: Access,
    /// The least value, as bits.
    low: u32,
    /// The largest.
    high: u32,
}

impl Spec {
    /// Whether a value (as bits) lies in the range. Not a number does not.
    pub const fn accepts(&self, bits: u32) -> bool {
        match self.kind {
            Kind::U32 => self.low <= bits && bits <= self.high,
            Kind::I32 => self.low as i32 <= bits as i32 && bits as i32 <= self.high as i32,
            Kind::F32 => {
                let value = f32::from_bits(bits);
                f32::from_bits(self.low) <= value && value <= f32::from_bits(self.high)
            }
        }
    }

    /// The least and the largest value.
    pub const fn range(&self) -> (f64, f64) {
        (self.kind.number(self.low), self.kind.number(self.high))
    }

    /// Whether its value is a field of the node page.
    pub const fn is_stored(&self) -> bool {
        self.first >= STORED
    }
}

/// What people are told of a register. Apart from [`Spec`], so that the flash of a module does not carry it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Words {
    /// Name; with a number appended where there are several.
    pub name: &'static str,
    /// Unit of the physical value.
    pub unit: &'static str,
    /// Physical value of one step of an integer.
    pub scale: f64,
    /// What it is.
    pub text: &'static str,
}

macro_rules! registers {
    ($($(#[doc = $text:literal])+
        $first:literal $key:ident $([$count:literal])? $name:literal $kind:ident $access:ident $low:literal .. $high:expr,
        $scale:expr, $unit:literal;)+) => {
        /// A register, or several equal ones in a row.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[repr(u8)]
        pub enum Register {
            $($(#[doc = $text])+ $key,)+
        }

        impl Register {
            /// All of them, by number.
            pub const ALL: &[Register] = &[$(Register::$key,)+];
        }

        const SPECS: &[Spec] = &[$(Spec {
            first: $first,
            count: 1 $(* $count)?,
            kind: Kind::$kind,
            access: Access::$access,
            low: Kind::$kind.bits($low as f64),
            high: Kind::$kind.bits($high as f64),
        },)+];

        const WORDS: &[Words] = &[$(Words {
            name: $name,
            unit: $unit,
            scale: $scale as f64,
            text: concat!($($text),+),
        },)+];
    };
}

/// The end of the range of a counter.
const MOST: u32 = u32::MAX;

registers! {
    /// Version of the wire format.
    0 Protocol "protocol" U32 ReadOnly 0 .. 255, 1, "";
    /// Version of the firmware: major in bits 4 to 7, minor in bits 0 to 3.
    1 Firmware "firmware" U32 ReadOnly 0 .. 255, 1, "";
    /// CRC-32 of the policy image; its lower 16 bits are the tag in LATENT and HEARTBEAT.
    2 Policy "policy" U32 ReadOnly 0 .. MOST, 1, "";
    /// Version of the node page's layout.
    3 PageVersion "page_version" U32 ReadOnly 0 .. 65535, 1, "";
    /// The chip's unique identifier, three words.
    4 UniqueId[3] "unique_id" U32 ReadOnly 0 .. MOST, 1, "";
    /// 1 if a register of the node page was written and not stored since.
    7 PageChanged "page_changed" U32 ReadOnly 0 .. 1, 1, "";
    /// Any number. It is 0 after a start, so a station that wrote another one sees whether the module was restarted.
    8 Token "token" U32 ReadWrite 0 .. MOST, 1, "";

    /// What the module is at, as HEARTBEAT has it.
    16 Mode "mode" U32 ReadOnly 0 .. 255, 1, "";
    /// Active faults: bit n is fault 32 + n.
    17 Faults "faults" U32 ReadOnly 0 .. MOST, 1, "";
    /// What holds the torque back, as TELEMETRY has it.
    18 LimitedBy "limited_by" U32 ReadOnly 0 .. 255, 1, "";
    /// Number of the control cycle.
    19 Cycle "cycle" U32 ReadOnly 0 .. 65535, 1, "";
    /// Whose SYNC the module follows; 255: nobody's.
    20 TimeKeeper "time_keeper" U32 ReadOnly 0 .. 255, 1, "";
    /// Modules believed alive, itself included: bit n of word 0 is module n, of word 1 module 32 + n.
    21 Alive[2] "alive" U32 ReadOnly 0 .. MOST, 1, "";
    /// Modules attended over in the last action, in the same way.
    23 Heard[2] "heard" U32 ReadOnly 0 .. MOST, 1, "";
    /// Why the module started last: 1 power-on, 2 RESTART, 3 reset pin, 4 watchdog, 5 brown-out, 6 software, 7 anything else.
    25 ResetReason "reset_reason" U32 ReadOnly 0 .. 255, 1, "";
    /// Starts in a row that nobody asked for.
    26 Resets "resets" U32 ReadOnly 0 .. MOST, 1, "";
    /// Starts that the fault log knows of, this one included.
    27 Boots "boots" U32 ReadOnly 0 .. 65535, 1, "";
    /// Time since the start.
    28 Uptime "uptime" U32 ReadOnly 0 .. MOST, 0.001, "s";

    /// Control cycles started.
    32 Cycles "cycles" U32 ReadOnly 0 .. MOST, 1, "";
    /// Control cycles in which the module acted.
    33 Acted "acted" U32 ReadOnly 0 .. MOST, 1, "";
    /// Cycles in which a live neighbour's latent was missing when the module acted.
    34 DeadlineMisses "deadline_misses" U32 ReadOnly 0 .. MOST, 1, "";
    /// Age of the oldest latent used in the last cycle.
    35 LatentAge "latent_age" U32 ReadOnly 0 .. MOST, 0.000001, "s";
    /// The largest that ever was.
    36 LatentAgeMax "latent_age_max" U32 ReadOnly 0 .. MOST, 0.000001, "s";
    /// Frames received that are not of this protocol.
    37 Malformed "malformed" U32 ReadOnly 0 .. MOST, 1, "";
    /// Frames of modules that this robot does not have.
    38 Foreign "foreign" U32 ReadOnly 0 .. MOST, 1, "";
    /// Frames of another cycle than the current or the next.
    39 Stale "stale" U32 ReadOnly 0 .. MOST, 1, "";
    /// Times the module became time-keeper.
    40 Takeovers "takeovers" U32 ReadOnly 0 .. MOST, 1, "";
    /// Cycles started without their SYNC.
    41 WithoutSync "without_sync" U32 ReadOnly 0 .. MOST, 1, "";
    /// Frames lost because the receive queue was full.
    42 RxOverflow "rx_overflow" U32 ReadOnly 0 .. MOST, 1, "";
    /// Frames taken back from the CAN port before they were sent: more urgent or newer ones came, or they were too old.
    43 Aborted "aborted" U32 ReadOnly 0 .. MOST, 1, "";
    /// Transmit error counter of the CAN controller.
    44 Tec "tec" U32 ReadOnly 0 .. 256, 1, "";
    /// Receive error counter of the CAN controller.
    45 Rec "rec" U32 ReadOnly 0 .. 256, 1, "";
    /// Cut-offs by motor.
    46 Trips[2] "trips" U32 ReadOnly 0 .. MOST, 1, "";
    /// Why a motor is cut off: 0 it is not, 1 overcurrent, 2 no current reading, 3 an output failed.
    48 Trip[2] "trip" U32 ReadOnly 0 .. 3, 1, "";
    /// Failed readings by encoder.
    50 EncoderErrors[4] "encoder_errors" U32 ReadOnly 0 .. MOST, 1, "";
    /// Failed readings of the inertial sensor.
    54 ImuErrors "imu_errors" U32 ReadOnly 0 .. MOST, 1, "";
    /// Writes and erasures of the flash that failed.
    55 StorageErrors "storage_errors" U32 ReadOnly 0 .. MOST, 1, "";
    /// Number of the newest entry of the fault log.
    56 LogNewest "log_newest" U32 ReadOnly 0 .. MOST, 1, "";
    /// Entries that the fault log lost because its memory was full while the module was armed.
    57 LogLost "log_lost" U32 ReadOnly 0 .. MOST, 1, "";
    /// Times the CAN controller went bus-off.
    58 BusOffs "bus_offs" U32 ReadOnly 0 .. MOST, 1, "";
    /// Frames that found no room in the CAN port.
    59 TxLost "tx_lost" U32 ReadOnly 0 .. MOST, 1, "";

    /// Encoder as it reads, without zero and direction; 4294967295: no reading.
    64 EncoderRaw[4] "encoder_raw" U32 ReadOnly 0 .. MOST, core::f64::consts::TAU / 16384.0, "rad";
    /// Joint angle.
    68 JointAngle[4] "joint_angle" F32 ReadOnly -10 .. 10, 1, "rad";
    /// Joint speed.
    72 JointSpeed[4] "joint_speed" F32 ReadOnly -1000 .. 1000, 1, "rad/s";
    /// Specific force in the axes of the inertial sensor, without its mounting.
    76 Acceleration[3] "acceleration" F32 ReadOnly -16 .. 16, 1, "g";
    /// Angular rate in the axes of the inertial sensor, without its mounting.
    79 Rate[3] "rate" F32 ReadOnly -100 .. 100, 1, "rad/s";
    /// Direction against gravity in the module's own frame, from the attitude filter.
    82 Up[3] "up" F32 ReadOnly -1 .. 1, 1, "";
    /// Supply voltage.
    85 Supply "supply" F32 ReadOnly 0 .. 100, 1, "V";
    /// Temperature by motor.
    86 Temperature[2] "temperature" F32 ReadOnly -100 .. 300, 1, "degC";
    /// Current by motor.
    88 Current[2] "current" F32 ReadOnly -1000 .. 1000, 1, "A";
    /// Torque that the motors are told to give, yaw and pitch; 0 if relaxed.
    90 TorqueCommand[2] "torque_command" F32 ReadOnly -1000000 .. 1000000, 1, "torque";
    /// Torque by the measured currents, yaw and pitch, as a part of the limit.
    92 Torque[2] "torque" F32 ReadOnly -1000 .. 1000, 1, "limit";

    /// Number of the module, 0 is the head. Less than `modules`, and not one that is heard on the bus.
    128 Node "node" U32 WhileDisarmed 0 .. 63, 1, "";
    /// Modules of the robot.
    129 Modules "modules" U32 WhileDisarmed 1 .. 64, 1, "";
    /// After bus-off: 0 recover, 1 stay off until a restart.
    130 BusOff "bus_off" U32 WhileDisarmed 0 .. 1, 1, "";
    /// While the sensors say what cannot be true: 0 relax, 1 act on zeros, as the paper's observation fault does.
    131 BlindActs "blind_acts" U32 WhileDisarmed 0 .. 1, 1, "";
    /// What the encoder reads when the joint is straight.
    132 EncoderZero[4] "encoder_zero" U32 WhileDisarmed 0 .. 16383, core::f64::consts::TAU / 16384.0, "rad";
    /// 1 if the encoder counts down while the joint angle grows.
    136 EncoderReversed[4] "encoder_reversed" U32 WhileDisarmed 0 .. 1, 1, "";
    /// Rotation from the axes of the inertial sensor to the module's own frame, row by row.
    140 ImuMounting[9] "imu_mounting" F32 WhileDisarmed -1.001 .. 1.001, 1, "";
    /// Torque by current; negative if the wires are swapped. Magnitude at least 0.001.
    150 TorqueConstant[2] "torque_constant" F32 WhileDisarmed -1000000 .. 1000000, 1, "torque/A";
    /// Largest current.
    152 CurrentLimit[2] "current_limit" F32 WhileDisarmed 0.001 .. 100, 1, "A";
    /// Current that cuts the motor off: the largest current to 95 % of what the current sense can read in either direction.
    154 CutOff[2] "cut_off" F32 WhileDisarmed 0.001 .. 200, 1, "A";
    /// Winding resistance.
    156 Resistance[2] "resistance" F32 WhileDisarmed 0.001 .. 1000, 1, "ohm";
    /// Winding inductance.
    158 Inductance[2] "inductance" F32 WhileDisarmed 0.000001 .. 1, 1, "H";
    /// Current from one end of the converter's range to the other; negative if the sense is turned. Magnitude at least 0.001.
    160 SenseRange[2] "sense_range" F32 WhileDisarmed -1000 .. 1000, 1, "A";
    /// Reading of the current sense without current, as a part of the converter's range.
    162 SenseZero[2] "sense_zero" F32 WhileDisarmed 0 .. 1, 1, "";
    /// Least angle of a joint.
    164 JointMin[4] "joint_min" F32 WhileDisarmed -3.1 .. -0.05, 1, "rad";
    /// Greatest angle of a joint.
    168 JointMax[4] "joint_max" F32 WhileDisarmed 0.05 .. 3.1, 1, "rad";
    /// Cap of the torque; the policy's limit counts where it is smaller.
    172 TorqueCap "torque_cap" F32 WhileDisarmed 0.001 .. 1000000, 1, "torque";
    /// Cap of the slew; likewise.
    173 SlewCap "slew_cap" F32 WhileDisarmed 0.001 .. 100000000, 1, "torque/s";
    /// Cap of the motor temperature; likewise.
    174 TemperatureCap "temperature_cap" F32 WhileDisarmed 30 .. 150, 1, "degC";
    /// Supply below which the motors relax.
    175 SupplyUnder "supply_under" F32 WhileDisarmed 6 .. 60, 1, "V";
    /// Supply above which the motors relax; at least 1.2 times the lower one.
    176 SupplyOver "supply_over" F32 WhileDisarmed 7.2 .. 60, 1, "V";
    /// So long without a frame of the station, and the module relaxes and disarms: 0 never, or at least 0.2 s.
    177 DeadMan "dead_man" U32 WhileDisarmed 0 .. 60000, 0.001, "s";
    /// Ed25519 public key of who may change the policy, word by word; all 0: none. With a key the page cannot be changed over the bus (code 21), but for `node`.
    178 KeyA[8] "key_a" U32 WhileDisarmed 0 .. u32::MAX, 1, "";
    /// The same, a second key for the time in which keys are changed.
    186 KeyB[8] "key_b" U32 WhileDisarmed 0 .. u32::MAX, 1, "";
}

impl Register {
    /// What a module has to know of it.
    pub const fn spec(self) -> &'static Spec {
        &SPECS[self as usize]
    }

    /// What people are told of it.
    pub const fn words(self) -> &'static Words {
        &WORDS[self as usize]
    }

    /// The register with this number, and which of several it is.
    pub fn by_number(number: u8) -> Option<(Register, &'static Spec, u8)> {
        let mut all = Self::ALL.iter().zip(SPECS);
        all.find_map(|(register, spec)| {
            let offset = number.checked_sub(spec.first)?;
            (offset < spec.count).then_some((*register, spec, offset))
        })
    }

    /// The number of the register with this name, such as `supply` or `encoder_zero_2`.
    pub fn number_of(name: &str) -> Option<u8> {
        Self::ALL.iter().find_map(|register| {
            let (spec, words) = (register.spec(), register.words());
            let rest = name.strip_prefix(words.name)?;
            if spec.count == 1 {
                return rest.is_empty().then_some(spec.first);
            }
            let offset: u8 = rest.strip_prefix('_')?.parse().ok()?;
            // One spelling only: not `_02`, not `_+2`.
            let spelled = rest.len() == 2 && offset < spec.count;
            spelled.then_some(spec.first + offset)
        })
    }

    /// Its numbers.
    pub fn numbers(self) -> core::ops::Range<u8> {
        let spec = self.spec();
        spec.first..spec.first + spec.count
    }
}

/// The name of register `number`, for people; displays as nothing if there is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Name(pub u8);

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some((register, spec, offset)) = Register::by_number(self.0) else { return Ok(()) };
        f.write_str(register.words().name)?;
        if spec.count > 1 { write!(f, "_{offset}") } else { Ok(()) }
    }
}

// Numbers ascend without overlap, and ranges are in order.
const _: () = {
    let (mut i, mut free) = (0, 0);
    while i < SPECS.len() {
        let spec = &SPECS[i];
        let (low, high) = spec.range();
        assert!(spec.first as usize >= free && spec.count > 0 && spec.count <= 10 && low < high);
        let stored = spec.first >= STORED;
        assert!(stored == matches!(spec.access, Access::WhileDisarmed));
        free = spec.first as usize + spec.count as usize;
        i += 1;
    }
    assert!(free <= 256);
};

/// Writes the table of all registers, the file `firmware/registers.md`.
pub fn document(out: &mut impl Write) -> fmt::Result {
    out.write_str(
        "# Registers\n\n\
        What the station can read of a module, and write, by the operations READ and WRITE of SERVICE_REQUEST\n\
        ([wire format](../shared/wire-format.md)): the register's number in `index`, the value in `value`. Generated from\n\
        `shared/src/registers.rs` by `cargo run -p composer-shared --example registers > firmware/registers.md`; a test compares.\n\n\
        A value has 32 bits: unsigned (u32), signed (i32) or IEEE 754 binary32 (f32), least significant byte first. The physical value of an\n\
        integer is the number times its step. Several equal registers in a row have consecutive numbers, and names that end in `_0`,\n\
        `_1` and so on: joints head end first, motors and axes yaw before pitch. Counters start at 0 with the module, and stay at their end.\n\
        A float that is not a number says that there is no reading.\n\n\
        Refused are: a number that is not in a table (code 2), a write to a register that can only be read (3), a value out of its range or\n\
        not a number (4), a write while the module is armed where the table says \"while disarmed\" (5).\n",
    )?;
    section(out, "What it is, measures and counts", |spec| !spec.is_stored())?;
    section(out, "The node page", Spec::is_stored)?;
    out.write_str(
        "\nA write to the node page changes a copy. STORE checks it as a whole, refuses what does not fit together (code 4), and keeps it through a\n\
        loss of power; it counts from the next start (RESTART) on. What was not stored is forgotten at the next start.\n",
    )
}

fn section(out: &mut impl Write, title: &str, wanted: impl Fn(&Spec) -> bool) -> fmt::Result {
    write!(
        out,
        "\n## {title}\n\n| number | name | type | access | range | step | what |\n|---|---|---|---|---|---|---|\n"
    )?;
    for register in Register::ALL {
        let (spec, words) = (register.spec(), register.words());
        if !wanted(spec) {
            continue;
        }
        let (last, (low, high)) = (spec.first + spec.count - 1, spec.range());
        match spec.count {
            1 => write!(out, "| {} | `{}`", spec.first, words.name)?,
            count => write!(out, "| {} to {last} | `{}_0` to `_{}`", spec.first, words.name, count - 1)?,
        }
        write!(out, " | {} | {} | ", spec.kind.name(), spec.access.name())?;
        // Through f32, so that 0.001 is not written as 0.0010000000474974513.
        match spec.kind {
            Kind::F32 => write!(out, "{} to {}", low as f32, high as f32)?,
            _ => write!(out, "{low} to {high}")?,
        }
        match (words.scale, words.unit) {
            (1.0, "") => out.write_str(" | |")?,
            (1.0, unit) => write!(out, " | 1 {unit} |")?,
            (scale, unit) => write!(out, " | {} {unit} |", scale as f32)?,
        }
        writeln!(out, " {} |", words.text.trim())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::{String, ToString};

    #[test]
    fn the_document_is_up_to_date() {
        let mut made = String::new();
        document(&mut made).unwrap();
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../firmware/registers.md");
        let read = std::fs::read_to_string(path).unwrap();
        assert!(
            made == read,
            "write it again: cargo run -p composer-shared --example registers > firmware/registers.md"
        );
    }

    #[test]
    fn every_number_has_one_name_and_every_name_one_number() {
        let mut names = std::collections::BTreeSet::new();
        for number in 0..=255 {
            let name = Name(number).to_string();
            match Register::by_number(number) {
                Some((register, spec, offset)) => {
                    assert_eq!(register.spec(), spec);
                    assert_eq!(register.numbers().nth(usize::from(offset)), Some(number));
                    assert_eq!(Register::number_of(&name), Some(number), "{name}");
                    assert!(names.insert(name), "{number}");
                }
                None => assert_eq!(name, ""),
            }
        }
        for wrong in
            ["", "encoder", "encoder_zero", "encoder_zero_4", "encoder_zero_02", "supply_0", "Supply", "trip_+1"]
        {
            assert_eq!(Register::number_of(wrong), None, "{wrong}");
        }
        assert_eq!(Name(Register::EncoderZero.spec().first + 2).to_string(), "encoder_zero_2");
    }

    #[test]
    fn ranges_are_kept_and_nothing_that_is_not_a_number_gets_in() {
        let zero = Register::EncoderZero.spec();
        assert!(zero.accepts(0) && zero.accepts(16383) && !zero.accepts(16384) && !zero.accepts(u32::MAX));
        let limit = Register::CurrentLimit.spec();
        for (value, good) in [(0.001f32, true), (100.0, true), (0.0, false), (100.1, false), (-1.0, false)] {
            assert_eq!(limit.accepts(value.to_bits()), good, "{value}");
        }
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(!limit.accepts(value.to_bits()), "{value}");
        }
        let spec = Spec { first: 0, count: 1, kind: Kind::I32, access: Access::ReadOnly, low: -5i32 as u32, high: 5 };
        assert!(spec.accepts(-5i32 as u32) && spec.accepts(0) && !spec.accepts(-6i32 as u32) && !spec.accepts(6));
    }
}
