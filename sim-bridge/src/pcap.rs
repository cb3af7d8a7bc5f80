//! Logs as pcap files, for Wireshark and tshark: link type 227, `LINKTYPE_CAN_SOCKETCAN`, times in ns.
//!
//! The file begins with the [pcap heading](https://www.ietf.org/archive/id/draft-ietf-opsawg-pcap-04.html) in little endian. Each packet is a frame with the
//! [heading of SocketCAN](https://www.tcpdump.org/linktypes/LINKTYPE_CAN_SOCKETCAN.html): identifier (4 bytes, big endian), length of the payload, flags
//! (1 bit-rate switch, 4 CAN-FD), two reserved bytes, then the payload. The flag for CAN-FD is what tells it from a classic frame of the same length.

use std::io::{self, Write};

use composer_shared::wire::Frame;

/// Magic number of a file with times in ns.
const MAGIC: u32 = 0xa1b2_3c4d;
const VERSION: [u16; 2] = [2, 4];
/// `LINKTYPE_CAN_SOCKETCAN`.
const LINK_TYPE: u32 = 227;
/// Most bytes of a packet.
const LONGEST: u32 = 72;
const BIT_RATE_SWITCH: u8 = 1;
const CAN_FD: u8 = 4;

/// Writes what a file begins with.
pub fn write_heading(out: &mut dyn Write) -> io::Result<()> {
    let mut heading = Vec::with_capacity(24);
    heading.extend(MAGIC.to_le_bytes());
    heading.extend(VERSION.map(u16::to_le_bytes).as_flattened());
    // Time zone and accuracy, which nobody uses.
    heading.extend([0; 8]);
    heading.extend(LONGEST.to_le_bytes());
    heading.extend(LINK_TYPE.to_le_bytes());
    out.write_all(&heading)
}

/// Writes a frame with its time, ns.
pub fn write_frame(out: &mut dyn Write, at_ns: u64, frame: &Frame) -> io::Result<()> {
    let payload = frame.payload();
    let length = (8 + payload.len()) as u32;
    let mut packet = Vec::with_capacity(16 + length as usize);
    packet.extend(((at_ns / 1_000_000_000) as u32).to_le_bytes());
    packet.extend(((at_ns % 1_000_000_000) as u32).to_le_bytes());
    packet.extend(length.to_le_bytes());
    packet.extend(length.to_le_bytes());
    packet.extend(u32::from(frame.id).to_be_bytes());
    let brs = if frame.brs { BIT_RATE_SWITCH } else { 0 };
    packet.extend([payload.len() as u8, if frame.fd { CAN_FD | brs } else { 0 }, 0, 0]);
    packet.extend(payload);
    out.write_all(&packet)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_what_its_specification_says() {
        let mut out = Vec::new();
        write_heading(&mut out).unwrap();
        write_frame(&mut out, 3_000_000_500, &Frame::new(0x123, true, &[7; 12]).unwrap()).unwrap();
        write_frame(&mut out, 3_000_000_600, &Frame::new(0x7ff, false, &[8]).unwrap()).unwrap();
        let heading = [0x4d, 0x3c, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 72, 0, 0, 0, 227, 0, 0, 0];
        assert_eq!(out[..24], heading);
        assert_eq!(out[24..40], [3, 0, 0, 0, 0xf4, 1, 0, 0, 20, 0, 0, 0, 20, 0, 0, 0]);
        assert_eq!(out[40..60], [0, 0, 1, 0x23, 12, 5, 0, 0, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7]);
        assert_eq!(out[76..], [0, 0, 7, 0xff, 1, 0, 0, 0, 8]);
    }
}
