//! What the station may ask of a module, and what a module may answer.

use core::fmt;

use serde::{Deserialize, Serialize};

use super::NOBODY;

/// The destination of a request that all modules answer.
pub const ALL_MODULES: u8 = NOBODY;

/// SERVICE_REQUEST: the station asks one module for something, or all of them. Each module that is asked answers once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceRequest {
    /// The module that is asked, or [`ALL_MODULES`].
    pub destination: u8,
    /// What is asked for ([`Operation`]).
    pub operation: u8,
    /// Any number; the answer repeats it.
    pub sequence: u8,
    /// Which item of the operation, for those that have several.
    pub index: u8,
    /// Depends on the operation.
    #[serde(with = "postcard::fixint::le")]
    pub value: u32,
}

impl ServiceRequest {
    /// Whether module `node` is asked.
    pub const fn is_for(&self, node: u8) -> bool {
        self.destination == node || self.destination == ALL_MODULES
    }

    /// The answer to it.
    pub const fn answer(&self, code: ServiceCode, value: u32) -> ServiceResponse {
        let ServiceRequest { operation, sequence, index, .. } = *self;
        ServiceResponse { operation, sequence, code: code as u8, index, value }
    }
}

/// SERVICE_RESPONSE: a module's answer to a SERVICE_REQUEST.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceResponse {
    /// That of the request.
    pub operation: u8,
    /// That of the request.
    pub sequence: u8,
    /// Whether it was done, and if not, why ([`ServiceCode`]).
    pub code: u8,
    /// That of the request.
    pub index: u8,
    /// Depends on the operation.
    #[serde(with = "postcard::fixint::le")]
    pub value: u32,
}

/// What the station may ask for. Numbers never change their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Operation {
    /// Who the module is; the index selects the item.
    Hello = 1,
    /// Allow the motors to be driven. Bit 0 of the value: even after a restart that nobody asked for.
    Arm = 2,
    /// Take that back.
    Disarm = 3,
    /// Clear those latched faults that a person may clear.
    Clear = 4,
    /// Read the register that the index names.
    Read = 5,
    /// Write it.
    Write = 6,
    /// Keep what was written through a loss of power.
    Store = 7,
    /// Give the module another number.
    SetNode = 8,
    /// Drive one axis at a small torque for a short time.
    Jog = 9,
    /// Flash the light.
    Identify = 10,
    /// Read an entry of the fault log.
    Log = 11,
    /// Forget the fault log.
    ClearLog = 12,
    /// Restart.
    Restart = 13,
    /// Change the policy; the index selects the step ([`UpdateStep`]).
    Update = 14,
    /// How far an update is; the index selects the item.
    UpdateStatus = 15,
    /// Read a record of what became of the policies.
    UpdateLog = 16,
}

/// Steps of [`Operation::Update`]. Numbers never change their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum UpdateStep {
    /// A new policy comes; value: session (bits 0 to 15) and bytes of header and image (16 to 31).
    Begin = 0,
    /// All chunks were sent: check the policy; value: its CRC-32.
    Verify = 1,
    /// Try it from the next start on; value: its CRC-32.
    Commit = 2,
    /// It works: keep it; value: its CRC-32.
    Confirm = 3,
    /// Forget what was received, or was to be tried and is not tried yet.
    Abandon = 4,
}

impl UpdateStep {
    /// All of them.
    pub const ALL: [UpdateStep; 5] =
        [UpdateStep::Begin, UpdateStep::Verify, UpdateStep::Commit, UpdateStep::Confirm, UpdateStep::Abandon];

    /// The step with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|step| *step as u8 == number)
    }

    /// The name that `wire-format.md` uses.
    pub const fn name(self) -> &'static str {
        match self {
            UpdateStep::Begin => "begin",
            UpdateStep::Verify => "verify",
            UpdateStep::Commit => "commit",
            UpdateStep::Confirm => "confirm",
            UpdateStep::Abandon => "abandon",
        }
    }
}

impl Operation {
    /// All of them.
    pub const ALL: [Operation; 16] = [
        Operation::Hello,
        Operation::Arm,
        Operation::Disarm,
        Operation::Clear,
        Operation::Read,
        Operation::Write,
        Operation::Store,
        Operation::SetNode,
        Operation::Jog,
        Operation::Identify,
        Operation::Log,
        Operation::ClearLog,
        Operation::Restart,
        Operation::Update,
        Operation::UpdateStatus,
        Operation::UpdateLog,
    ];

    /// The operation with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|operation| *operation as u8 == number)
    }

    /// The name that `wire-format.md` uses.
    pub const fn name(self) -> &'static str {
        match self {
            Operation::Hello => "HELLO",
            Operation::Arm => "ARM",
            Operation::Disarm => "DISARM",
            Operation::Clear => "CLEAR",
            Operation::Read => "READ",
            Operation::Write => "WRITE",
            Operation::Store => "STORE",
            Operation::SetNode => "SET_NODE",
            Operation::Jog => "JOG",
            Operation::Identify => "IDENTIFY",
            Operation::Log => "LOG",
            Operation::ClearLog => "CLEAR_LOG",
            Operation::Restart => "RESTART",
            Operation::Update => "UPDATE",
            Operation::UpdateStatus => "UPDATE_STATUS",
            Operation::UpdateLog => "UPDATE_LOG",
        }
    }
}

/// How a request ended. Numbers never change their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ServiceCode {
    /// Done.
    Ok = 0,
    /// No operation has this number, or not in this firmware.
    UnknownOperation = 1,
    /// No register, item or entry has this index.
    NoSuchRegister = 2,
    /// The register can be read only.
    ReadOnly = 3,
    /// The value is not one that this register or operation takes.
    OutOfRange = 4,
    /// Refused, because the module is armed.
    Armed = 5,
    /// A fault, a stop or an unclean restart forbids it.
    NotArmable = 6,
    /// The unique identifier is another module's, or the number is taken.
    WrongModule = 7,
    /// The flash could not be written.
    StorageFailed = 8,
    /// Something else is still going on.
    Busy = 9,
    /// Another station is at work.
    AnotherStation = 10,
    /// No update of this session or policy is under way.
    NoUpdate = 11,
    /// Chunks are missing.
    Missing = 12,
    /// The header is damaged, or of another version.
    NotSignedPolicy = 13,
    /// The policy is for another class of device.
    WrongClass = 14,
    /// The security counter is lower than the module's.
    OldCounter = 15,
    /// The policy is not signed, and the module has a key.
    Unsigned = 16,
    /// None of the module's keys signed it, or it was changed afterwards.
    BadSignature = 17,
    /// The image is not the one that was signed.
    BadDigest = 18,
    /// The image is none that this firmware runs.
    BadPolicy = 19,
    /// A policy is on trial.
    OnTrial = 20,
    /// The module has a key.
    Locked = 21,
}

impl ServiceCode {
    /// All of them.
    pub const ALL: [ServiceCode; 22] = [
        ServiceCode::Ok,
        ServiceCode::UnknownOperation,
        ServiceCode::NoSuchRegister,
        ServiceCode::ReadOnly,
        ServiceCode::OutOfRange,
        ServiceCode::Armed,
        ServiceCode::NotArmable,
        ServiceCode::WrongModule,
        ServiceCode::StorageFailed,
        ServiceCode::Busy,
        ServiceCode::AnotherStation,
        ServiceCode::NoUpdate,
        ServiceCode::Missing,
        ServiceCode::NotSignedPolicy,
        ServiceCode::WrongClass,
        ServiceCode::OldCounter,
        ServiceCode::Unsigned,
        ServiceCode::BadSignature,
        ServiceCode::BadDigest,
        ServiceCode::BadPolicy,
        ServiceCode::OnTrial,
        ServiceCode::Locked,
    ];

    /// The code with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|code| *code as u8 == number)
    }

    /// What it means, and what would be right, as a part of a sentence.
    pub const fn sentence(self) -> &'static str {
        match self {
            ServiceCode::Ok => "done",
            ServiceCode::UnknownOperation => "this firmware knows no such operation",
            ServiceCode::NoSuchRegister => "there is no such register, item or entry",
            ServiceCode::ReadOnly => "this register can be read, not written",
            ServiceCode::OutOfRange => "the value is out of range",
            ServiceCode::Armed => "refused while armed: disarm first",
            ServiceCode::NotArmable => {
                "a fault, a stop or an unclean restart forbids it: clear or release it, or arm with the acknowledgement"
            }
            ServiceCode::WrongModule => "the unique identifier is another module's, or the number is taken",
            ServiceCode::StorageFailed => "the flash could not be written: what was stored before is unchanged",
            ServiceCode::Busy => "the module is still busy with another request: ask again",
            ServiceCode::AnotherStation => "another station is at work: end it first",
            ServiceCode::NoUpdate => "no update of this session or policy is under way: begin it",
            ServiceCode::Missing => "chunks are missing: send them again",
            ServiceCode::NotSignedPolicy => {
                "what was received is no signed policy: its header is damaged or of another version"
            }
            ServiceCode::WrongClass => "the policy is for another class of device",
            ServiceCode::OldCounter => "its security counter is lower than the module's: sign a newer policy",
            ServiceCode::Unsigned => "the policy is not signed and the module has a key: sign it with `snakectl sign`",
            ServiceCode::BadSignature => "none of the module's keys signed the policy, or it was changed afterwards",
            ServiceCode::BadDigest => "the image is not the one that the header names",
            ServiceCode::BadPolicy => "the image is no policy that this firmware runs",
            ServiceCode::OnTrial => "a policy is on trial: confirm it, or wait until it is given up",
            ServiceCode::Locked => {
                "a module with a key takes no changes of its node page over the bus: use the debug probe"
            }
        }
    }
}

impl fmt::Display for ServiceCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.sentence())
    }
}
