//! Logs in the format of `candump -l` (can-utils), which Wireshark, SavvyCAN, cantools and python-can read.
//!
//! `(SECONDS.MICROS) IFACE ID#DATA` for a classic frame, `(SECONDS.MICROS) IFACE ID##<flags>DATA` for CAN-FD, identifier and data in
//! hexadecimal, flags one hexadecimal digit: 1 bit rate switch, 2 error state indicator (read and ignored), 4 FD format.

use std::io::{self, Write};

use composer_shared::wire::Frame;

/// A line of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Time, microseconds.
    pub at_us: u64,
    /// Interface, for example `can0`.
    pub interface: String,
    /// The frame.
    pub frame: Frame,
}

/// What is wrong with a line of a log.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CandumpError {
    /// Not three parts.
    #[error("`{0}` is not a line of a candump log; it looks like `(12.000345) can0 183#0011223344556677`")]
    Form(String),
    /// Not a time.
    #[error("`{0}` is not a time; it is written `(SECONDS.MICROS)` with six digits of microseconds")]
    Time(String),
    /// Not an 11-bit identifier.
    #[error("`{0}` is not an 11-bit identifier; it has three hexadecimal digits, 000 to 7FF")]
    Identifier(String),
    /// Not a payload.
    #[error("`{0}` is not a payload; it has pairs of hexadecimal digits")]
    Payload(String),
    /// A length that no frame has.
    #[error("no {kind} frame has {len} bytes of payload; {right}")]
    Length {
        /// Classic or FD.
        kind: &'static str,
        /// The length read.
        len: usize,
        /// The lengths there are.
        right: &'static str,
    },
    /// A remote frame.
    #[error("`{0}` is a remote frame, which this robot does not use; only data frames are read")]
    Remote(String),
}

/// Writes one line, with a time in ns (cut to microseconds).
pub fn write_entry(out: &mut dyn Write, at_ns: u64, interface: &str, frame: &Frame) -> io::Result<()> {
    let us = at_ns / 1000;
    write!(out, "({:010}.{:06}) {interface} ", us / 1_000_000, us % 1_000_000)?;
    write_frame(out, frame)?;
    out.write_all(b"\n")
}

/// Writes a frame as cansend takes it.
pub fn write_frame(out: &mut dyn Write, frame: &Frame) -> io::Result<()> {
    const HEX: &[u8; 16] = b"0123456789ABCDEF";
    let mut text = [0; 130];
    let mut len = 0;
    for &byte in frame.payload() {
        text[len] = HEX[usize::from(byte >> 4)];
        text[len + 1] = HEX[usize::from(byte & 15)];
        len += 2;
    }
    write!(out, "{:03X}#", frame.id)?;
    if frame.fd {
        out.write_all(if frame.brs { b"#1" } else { b"#0" })?;
    }
    out.write_all(&text[..len])
}

/// The interface that stands for a piece of cable, from the head end: `can0`, after a cut also `can1`.
pub fn interface(piece: usize) -> String {
    format!("can{piece}")
}

/// Reads one line; a trailing `R` or `T` (direction, as newer versions write) is ignored.
pub fn parse_entry(line: &str) -> Result<Entry, CandumpError> {
    let mut parts = line.split_ascii_whitespace();
    let (Some(time), Some(interface), Some(frame)) = (parts.next(), parts.next(), parts.next()) else {
        return Err(CandumpError::Form(line.into()));
    };
    if !matches!(parts.next(), None | Some("R" | "T")) || parts.next().is_some() {
        return Err(CandumpError::Form(line.into()));
    }
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse::<u64>().ok()).flatten();
    let at_us = time
        .strip_prefix('(')
        .and_then(|time| time.strip_suffix(')')?.split_once('.'))
        .filter(|(_, micros)| micros.len() == 6)
        .and_then(|(seconds, micros)| digits(seconds)?.checked_mul(1_000_000)?.checked_add(digits(micros)?))
        .ok_or_else(|| CandumpError::Time(time.into()))?;
    Ok(Entry { at_us, interface: interface.into(), frame: parse_frame(frame)? })
}

/// Reads a frame as cansend writes it: `ID#DATA` or `ID##<flags>DATA`.
pub fn parse_frame(text: &str) -> Result<Frame, CandumpError> {
    let (id_text, data) = text.split_once('#').ok_or_else(|| CandumpError::Form(text.into()))?;
    let hex =
        |text: &str| text.bytes().all(|b| b.is_ascii_hexdigit()).then(|| u16::from_str_radix(text, 16).ok()).flatten();
    let id = hex(id_text).filter(|id| id_text.len() == 3 && *id < 0x800);
    let id = id.ok_or_else(|| CandumpError::Identifier(id_text.into()))?;
    let bad = || CandumpError::Payload(data.into());
    let (fd, brs, data) = match data.strip_prefix('#') {
        None => (false, false, data),
        Some(data) => {
            let flags = data.get(..1).and_then(hex).ok_or_else(bad)?;
            (true, flags & 1 == 1, data.get(1..).unwrap_or(""))
        }
    };
    if !fd && data.starts_with('R') {
        return Err(CandumpError::Remote(text.into()));
    }
    if data.len() % 2 != 0 {
        return Err(bad());
    }
    let bytes: Option<Vec<u8>> =
        (0..data.len()).step_by(2).map(|k| data.get(k..k + 2).and_then(hex).map(|byte| byte as u8)).collect();
    let bytes = bytes.ok_or_else(bad)?;
    let (kind, right) = if fd {
        ("CAN-FD", "there are 0 to 8, 12, 16, 20, 24, 32, 48 and 64")
    } else {
        ("classic CAN", "there are 0 to 8")
    };
    let whole = |frame: &Frame| usize::from(frame.len) == bytes.len();
    let frame = Frame::new(id, fd, &bytes).filter(whole);
    let frame = frame.ok_or(CandumpError::Length { kind, len: bytes.len(), right })?;
    Ok(Frame { brs, ..frame })
}

/// A log that has been read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Log {
    /// Its lines, each with its number, from 1; empty ones are left out.
    pub entries: Vec<(u64, Entry)>,
    /// The number of its last line, if that has no end: whoever wrote it was cut off. It is left out, because of a frame half of it may look like another whole one.
    pub cut: Option<u64>,
}

impl Log {
    /// Reads a log that may have been cut off. The error names the line, from 1.
    ///
    /// # Errors
    ///
    /// If a line with an end cannot be read.
    pub fn parse(log: &str) -> Result<Self, (u64, CandumpError)> {
        let mut read = Log::default();
        for (number, line) in (1..).zip(log.split_inclusive('\n')) {
            match line.strip_suffix('\n') {
                None => read.cut = Some(number),
                Some(line) if line.trim().is_empty() => {}
                Some(line) => read.entries.push((number, parse_entry(line).map_err(|error| (number, error))?)),
            }
        }
        Ok(read)
    }

    /// The line of this number, from 1.
    pub fn line(&self, number: u64) -> Option<&Entry> {
        let index = self.entries.binary_search_by_key(&number, |(number, _)| *number).ok()?;
        self.entries.get(index).map(|(_, entry)| entry)
    }
}

/// Reads a whole log; empty lines are skipped. The error names the line, from 1.
pub fn parse(log: &str) -> Result<Vec<Entry>, (usize, CandumpError)> {
    let lines = log.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines.map(|(k, line)| parse_entry(line).map_err(|error| (k + 1, error))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn lines_look_as_candump_writes_them() {
        let mut out = Vec::new();
        write_entry(&mut out, 1_345_212_884_318_850_123, "can0", &Frame::new(0x123, false, &[0xde, 0xad]).unwrap())
            .unwrap();
        write_entry(&mut out, 5_000, "can1", &Frame::new(0x00a, true, &[1; 9]).unwrap()).unwrap();
        let text = String::from_utf8(out).unwrap();
        assert_eq!(
            text,
            "(1345212884.318850) can0 123#DEAD\n(0000000000.000005) can1 00A##1010101010101010101000000\n"
        );
        let entries = parse(&text).unwrap();
        assert_eq!(entries.len(), 2);
        assert_eq!((entries[1].at_us, entries[1].frame.len, entries[1].interface.as_str()), (5, 12, "can1"));
    }

    #[test]
    fn a_log_that_was_cut_off_is_read_up_to_there() {
        let text = "(0.000001) can0 123#DEAD\n\n(0.000002) can0 124#DEADBEEF\n";
        let log = Log::parse(text).unwrap();
        assert_eq!((log.entries.len(), log.cut), (2, None));
        assert_eq!((log.line(3).unwrap().frame.id, log.line(2)), (0x124, None));
        // Two digits less would be another frame, three no frame at all.
        for missing in [1, 3, 4, 20] {
            let log = Log::parse(&text[..text.len() - missing]).unwrap();
            assert_eq!((log.entries.len(), log.cut), (1, Some(3)), "{missing}");
        }
        assert_eq!(Log::parse("nonsense\n").unwrap_err().0, 1);
    }

    #[test]
    fn lines_of_other_tools_are_read() {
        assert_eq!(parse_entry("(0.000001) vcan0 7FF# R").unwrap().frame.len, 0);
        let quiet = parse_frame("123##4AA").unwrap();
        assert!(quiet.fd && !quiet.brs && quiet.payload() == [0xaa]);
    }

    #[test]
    fn every_mistake_gets_its_sentence() {
        let cases = [
            ("can0 123#", "`can0 123#` is not a line of a candump log"),
            ("(0.1) can0 123#", "`(0.1)` is not a time"),
            ("(+1.000000) can0 123#", "`(+1.000000)` is not a time"),
            ("(0.000000) can0 12345678#", "`12345678` is not an 11-bit identifier"),
            ("(0.000000) can0 800#", "`800` is not an 11-bit identifier"),
            ("(0.000000) can0 +12#", "`+12` is not an 11-bit identifier"),
            ("(0.000000) can0 123#ABC", "`ABC` is not a payload"),
            ("(0.000000) can0 123#+A", "`+A` is not a payload"),
            ("(0.000000) can0 123##", "`#` is not a payload"),
            ("(0.000000) can0 123#R", "`123#R` is a remote frame"),
            ("(0.000000) can0 123#001122334455667788", "no classic CAN frame has 9 bytes of payload; there are 0 to 8"),
            ("(0.000000) can0 123##1001122334455667788", "no CAN-FD frame has 9 bytes"),
            ("(0.000000) can0 123#é", "`é` is not a payload"),
            ("(99999999999999999999.000000) can0 123#", "`(99999999999999999999.000000)` is not a time"),
        ];
        for (text, sentence) in cases {
            let error = parse(text).unwrap_err();
            assert!(error.0 == 1 && error.1.to_string().starts_with(sentence), "{text}: {}", error.1);
        }
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(
            us in 0u64..1 << 50, id in 0u16..0x800, fd in any::<bool>(), brs in any::<bool>(), data in proptest::collection::vec(any::<u8>(), 0..65),
        ) {
            let bytes = if fd { &data[..] } else { &data[..data.len().min(8)] };
            let mut frame = Frame::new(id, fd, bytes).unwrap();
            frame.brs = fd && brs;
            let mut out = Vec::new();
            write_entry(&mut out, us * 1000, "can0", &frame).unwrap();
            let entry = parse_entry(std::str::from_utf8(&out).unwrap()).unwrap();
            prop_assert_eq!((entry.at_us, entry.frame), (us, frame));
        }

        #[test]
        fn no_line_makes_it_panic(line in "\\PC*") {
            let _ = parse(&line);
            let _ = parse_frame(&line);
        }
    }
}
