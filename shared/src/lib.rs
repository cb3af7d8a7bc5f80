#![no_std]
#![deny(unsafe_code)]
//! What the firmware of a snake module and the host that trains it must agree on, written once.
//!
//! No I/O, no allocation, no operating system. Lengths are in *robot units* (SomoGym's scale, see [`robot`]), angles in
//! radians, times in seconds unless a name says otherwise.

#[cfg(test)]
extern crate std;

pub mod kinematics;
pub mod math;
pub mod nn;
pub mod observation;
pub mod policies;
pub mod policy;
pub mod random;
pub mod registers;
pub mod robot;
pub mod sha512;
pub mod update;
pub mod wire;

/// CRC-32 (ISO-HDLC), which policy images, updates, node pages, records and files are checked and told apart by.
pub const CRC_32: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
