//! The frames as a table: what documents, DBC files and the parser's length check are made from.

use core::fmt::{self, Write};

use super::{
    EmergencyStop, Fault, Fragment, Frame, Function, Goal, Heartbeat, LATENT_SIZE, LatentMessage, LimitedBy, Mode,
    Operation, Piece, STATION, ServiceCode, ServiceRequest, ServiceResponse, State, StopCommand, Sync, Telemetry,
};
use crate::robot::MAX_MODULES;
use crate::update::{CHUNK_SIZE, ChunkRepr};

/// Who may send a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Senders {
    /// Modules only.
    Modules,
    /// The station only.
    Station,
    /// Both.
    Both,
}

impl Senders {
    /// Whether `module` is one of them.
    pub fn may_send(self, module: u8) -> bool {
        match self {
            Senders::Modules => usize::from(module) < MAX_MODULES,
            Senders::Station => module == STATION,
            Senders::Both => true,
        }
    }
}

/// A field of a frame, or several equal ones in a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Name; with a number appended where there are several.
    pub name: &'static str,
    /// How many in a row.
    pub count: u8,
    /// Bits of each; fields follow one another, least significant bit first.
    pub bits: u8,
    /// Two's complement.
    pub signed: bool,
    /// Value of one step.
    pub scale: f64,
    /// Unit of the value.
    pub unit: &'static str,
}

/// A frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// What it says.
    pub function: Function,
    /// Who may send it.
    pub senders: Senders,
    /// Bytes without padding.
    pub size: usize,
    /// Its fields in order, without gaps.
    pub fields: &'static [Field],
}

impl Layout {
    /// Bytes on the wire, padding included.
    pub fn wire_len(&self) -> u8 {
        Frame::padded_len(self.size, true).unwrap_or(64)
    }
}

const fn unsigned(name: &'static str, bits: u8) -> Field {
    Field { name, count: 1, bits, signed: false, scale: 1.0, unit: "" }
}

const fn signed(name: &'static str, count: u8, bits: u8, scale: f64, unit: &'static str) -> Field {
    Field { name, count, bits, signed: true, scale, unit }
}

/// All frames, most urgent first.
pub const LAYOUTS: [Layout; 12] = [
    Layout {
        function: Function::EmergencyStop,
        senders: Senders::Both,
        size: 3,
        fields: &[unsigned("command", 8), unsigned("reason", 8), unsigned("counter", 8)],
    },
    Layout {
        function: Function::Sync,
        senders: Senders::Modules,
        size: 4,
        fields: &[unsigned("cycle", 16), unsigned("alive", 8), unsigned("modules", 8)],
    },
    Layout {
        function: Function::Goal,
        senders: Senders::Station,
        size: 8,
        fields: &[
            unsigned("cycle", 8),
            unsigned("known", 1),
            unsigned("point", 7),
            signed("position", 3, 16, 0.00390625, "unit"),
        ],
    },
    Layout {
        function: Function::State,
        senders: Senders::Modules,
        size: 8,
        fields: &[
            unsigned("cycle", 8),
            unsigned("health", 8),
            signed("angle", 4, 12, core::f64::consts::PI / 2048.0, "rad"),
        ],
    },
    Layout {
        function: Function::Latent,
        senders: Senders::Modules,
        size: LATENT_SIZE,
        fields: &[
            unsigned("cycle", 8),
            unsigned("health", 8),
            unsigned("policy", 16),
            signed("key", 16, 8, 1.0, ""),
            signed("value", 32, 8, 1.0, ""),
        ],
    },
    Layout {
        function: Function::LatentFragment,
        senders: Senders::Modules,
        size: 8,
        fields: &[
            unsigned("cycle4", 4),
            unsigned("index", 3),
            unsigned("reserved", 1),
            Field { count: 7, ..unsigned("data", 8) },
        ],
    },
    Layout {
        function: Function::ServiceRequest,
        senders: Senders::Station,
        size: 8,
        fields: &[
            unsigned("destination", 8),
            unsigned("operation", 8),
            unsigned("sequence", 8),
            unsigned("index", 8),
            unsigned("value", 32),
        ],
    },
    Layout {
        function: Function::ServiceResponse,
        senders: Senders::Modules,
        size: 8,
        fields: &[
            unsigned("operation", 8),
            unsigned("sequence", 8),
            unsigned("code", 8),
            unsigned("index", 8),
            unsigned("value", 32),
        ],
    },
    Layout {
        function: Function::Telemetry,
        senders: Senders::Modules,
        size: 8,
        fields: &[
            signed("torque", 2, 8, 1.0 / 127.0, "limit"),
            signed("temperature", 1, 8, 1.0, "degC"),
            unsigned("limited_by", 8),
            unsigned("heard", 8),
            unsigned("deadline_misses", 8),
            unsigned("attends_to", 8),
            Field { scale: 1.0 / 255.0, ..unsigned("attention", 8) },
        ],
    },
    Layout {
        function: Function::Heartbeat,
        senders: Senders::Modules,
        size: 8,
        fields: &[
            unsigned("mode", 4),
            unsigned("update", 4),
            unsigned("fault", 8),
            unsigned("health", 8),
            unsigned("time_keeper", 8),
            unsigned("protocol", 8),
            unsigned("firmware", 8),
            unsigned("policy", 16),
        ],
    },
    Layout {
        function: Function::UpdateChunk,
        senders: Senders::Station,
        size: size_of::<ChunkRepr>(),
        fields: &[
            unsigned("session", 16),
            unsigned("number", 16),
            Field { count: CHUNK_SIZE as u8, ..unsigned("data", 8) },
        ],
    },
    Layout {
        function: Function::UpdatePiece,
        senders: Senders::Station,
        size: 8,
        fields: &[unsigned("number4", 4), unsigned("index", 4), Field { count: 7, ..unsigned("data", 8) }],
    },
];

/// The layout of the frames that say `function`.
pub(super) fn of(function: Function) -> &'static Layout {
    match function {
        Function::EmergencyStop => &LAYOUTS[0],
        Function::Sync => &LAYOUTS[1],
        Function::Goal => &LAYOUTS[2],
        Function::State => &LAYOUTS[3],
        Function::Latent => &LAYOUTS[4],
        Function::LatentFragment => &LAYOUTS[5],
        Function::ServiceRequest => &LAYOUTS[6],
        Function::ServiceResponse => &LAYOUTS[7],
        Function::Telemetry => &LAYOUTS[8],
        Function::Heartbeat => &LAYOUTS[9],
        Function::UpdateChunk => &LAYOUTS[10],
        Function::UpdatePiece => &LAYOUTS[11],
    }
}

/// A struct's size in memory is its size on the wire (no padding between fields), and the table's fields fill it exactly.
const fn check(index: usize, function: Function, size: usize) {
    let layout = &LAYOUTS[index];
    assert!(layout.function as u8 == function as u8 && layout.size == size);
    let (mut bits, mut i) = (0, 0);
    while i < layout.fields.len() {
        bits += layout.fields[i].bits as usize * layout.fields[i].count as usize;
        i += 1;
    }
    assert!(bits == 8 * size);
}

const _: () = {
    check(0, Function::EmergencyStop, size_of::<EmergencyStop>());
    check(1, Function::Sync, size_of::<Sync>());
    check(2, Function::Goal, size_of::<Goal>());
    check(3, Function::State, size_of::<State>());
    check(4, Function::Latent, size_of::<LatentMessage>());
    check(5, Function::LatentFragment, size_of::<Fragment>());
    check(6, Function::ServiceRequest, size_of::<ServiceRequest>());
    check(7, Function::ServiceResponse, size_of::<ServiceResponse>());
    check(8, Function::Telemetry, size_of::<Telemetry>());
    check(9, Function::Heartbeat, size_of::<Heartbeat>());
    check(10, Function::UpdateChunk, size_of::<ChunkRepr>());
    check(11, Function::UpdatePiece, size_of::<Piece>());
};

/// Writes a DBC file of all frames of a robot with `modules` modules and its station, for candump users' tools (cantools,
/// SavvyCAN, Kayak). On a CAN-FD bus (`fd`) every frame is an FD frame with bit-rate switch (`VFrameFormat` 14), the short ones
/// too; on a classic bus there is no LATENT and no UPDATE_CHUNK, and on an FD bus no LATENT_FRAGMENT and no UPDATE_PIECE.
pub fn dbc(out: &mut impl Write, modules: u8, fd: bool) -> fmt::Result {
    let modules = modules.min(MAX_MODULES as u8);
    out.write_str("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: STATION")?;
    (0..modules).try_for_each(|m| write!(out, " M{m}"))?;
    out.write_str("\n")?;
    let foreign = match fd {
        true => [Function::LatentFragment, Function::UpdatePiece],
        false => [Function::Latent, Function::UpdateChunk],
    };
    let frames = || {
        LAYOUTS.iter().filter(move |layout| !foreign.contains(&layout.function)).flat_map(move |layout| {
            let senders = (0..modules).chain([STATION]);
            senders.filter(|m| layout.senders.may_send(*m)).map(move |m| (layout, m))
        })
    };
    for (layout, module) in frames() {
        let name = layout.function.name();
        let (id, len) = (layout.function.id(module), layout.wire_len());
        if module == STATION {
            writeln!(out, "\nBO_ {id} {name}_STATION: {len} STATION")?;
        } else {
            writeln!(out, "\nBO_ {id} {name}_M{module}: {len} M{module}")?;
        }
        let mut start = 0u16;
        for field in layout.fields {
            for k in 0..field.count {
                let sign = if field.signed { '-' } else { '+' };
                write!(out, " SG_ {}", field.name)?;
                if field.count > 1 {
                    write!(out, "_{k}")?;
                }
                let steps = (1u64 << (field.bits - u8::from(field.signed))) as f64;
                let (low, high) = (if field.signed { -steps * field.scale } else { 0.0 }, (steps - 1.0) * field.scale);
                writeln!(
                    out,
                    " : {start}|{}@1{sign} ({},0) [{low}|{high}] \"{}\" Vector__XXX",
                    field.bits, field.scale, field.unit
                )?;
                start += u16::from(field.bits);
            }
        }
    }
    out.write_str("\nBA_DEF_ \"BusType\" STRING ;\nBA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\"")?;
    (2..14).try_for_each(|_| out.write_str(",\"reserved\""))?;
    out.write_str(",\"StandardCAN_FD\",\"ExtendedCAN_FD\";\n")?;
    out.write_str("BA_DEF_DEF_ \"BusType\" \"CAN\";\nBA_DEF_DEF_ \"VFrameFormat\" \"StandardCAN\";\n")?;
    if fd {
        out.write_str("BA_ \"BusType\" \"CAN FD\";\n")?;
        frames().try_for_each(|(layout, m)| writeln!(out, "BA_ \"VFrameFormat\" BO_ {} 14;", layout.function.id(m)))?;
    }
    for (layout, module) in frames() {
        let id = layout.function.id(module);
        match layout.function {
            Function::EmergencyStop => {
                let (stop, release) = (StopCommand::Stop as u8, StopCommand::Release as u8);
                writeln!(out, "VAL_ {id} command {stop} \"stop\" {release} \"release\" ;")?;
                faults(out, id, "reason")?;
            }
            Function::ServiceRequest => operations(out, id)?,
            Function::ServiceResponse => {
                operations(out, id)?;
                write!(out, "VAL_ {id} code")?;
                ServiceCode::ALL.into_iter().try_for_each(|c| write!(out, " {} \"{c:?}\"", c as u8))?;
                out.write_str(" ;\n")?;
            }
            Function::Telemetry => {
                write!(out, "VAL_ {id} limited_by")?;
                LimitedBy::ALL.into_iter().try_for_each(|l| write!(out, " {} \"{l:?}\"", l as u8))?;
                out.write_str(" ;\n")?;
            }
            Function::Heartbeat => {
                write!(out, "VAL_ {id} mode")?;
                Mode::ALL.into_iter().try_for_each(|m| write!(out, " {} \"{}\"", m as u8, m.name()))?;
                out.write_str(" ;\n")?;
                faults(out, id, "fault")?;
            }
            _ => {}
        }
    }
    Ok(())
}

fn faults(out: &mut impl Write, id: u16, field: &str) -> fmt::Result {
    write!(out, "VAL_ {id} {field} 0 \"none\"")?;
    Fault::ALL.into_iter().try_for_each(|f| write!(out, " {} \"{f:?}\"", f as u8))?;
    out.write_str(" ;\n")
}

fn operations(out: &mut impl Write, id: u16) -> fmt::Result {
    write!(out, "VAL_ {id} operation")?;
    Operation::ALL.into_iter().try_for_each(|o| write!(out, " {} \"{}\"", o as u8, o.name()))?;
    out.write_str(" ;\n")
}
