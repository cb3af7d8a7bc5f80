//! The text protocol of serial CAN adapters (Lawicel), with the CAN-FD frames of CANable 2.0 and python-can.
//!
//! Lines of ASCII end with a carriage return. Frames look the same in both directions; `I` is a digit of the identifier, `L` the data length
//! code, `D` the payload, all hexadecimal:
//!
//! | line | frame |
//! |---|---|
//! | `tIIILDD..` | classic |
//! | `dIIILDD..` | CAN-FD without bit-rate switch |
//! | `bIIILDD..` | CAN-FD with bit-rate switch |
//!
//! Capital letters have 29-bit identifiers, `r` and `R` are remote frames: this robot has neither. Towards the computer four more digits may
//! follow, the time of an adapter's clock, which is read and ignored. [`Adapter`] is the far end of such a line, [`frame`] and [`write_frame`]
//! serve both.

use composer_shared::wire::Frame;

/// Ends a line, and says on its own that a command was obeyed.
pub const OK: u8 = b'\r';
/// Says that a command was refused (the bell).
pub const REFUSED: u8 = 7;

/// Most bytes of a line: a CAN-FD frame of 64 bytes with a 29-bit identifier and a time.
pub const LINE_MAX: usize = 1 + 8 + 1 + 2 * 64 + 4;

/// Bit rates by the digit of the command `S`, bit/s.
pub const BIT_RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000];

/// What is wrong with a line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SlcanError {
    /// Its first letter is not a frame's.
    #[error("`{0}` is no frame: one begins with t (classic), d (CAN-FD) or b (CAN-FD with bit-rate switch)")]
    Kind(String),
    /// A 29-bit identifier.
    #[error("`{0}` has a 29-bit identifier, but this robot uses 11-bit ones: t, d or b and three hexadecimal digits")]
    Extended(String),
    /// A remote frame.
    #[error("`{0}` is a remote frame, which this robot does not use; only data frames are read")]
    Remote(String),
    /// Not an 11-bit identifier.
    #[error("`{0}` has no 11-bit identifier: three hexadecimal digits, 000 to 7FF, follow the first letter")]
    Identifier(String),
    /// Not a data length code.
    #[error("`{line}` has no length: a hexadecimal digit, {right}, follows the identifier")]
    Length {
        /// The line.
        line: String,
        /// What would be right.
        right: &'static str,
    },
    /// Too few or too many digits of payload, or something else.
    #[error("`{line}` announces {expected} bytes of payload, so {} hexadecimal digits must follow the length", 2 * .expected)]
    Payload {
        /// The line.
        line: String,
        /// Bytes that its length code says.
        expected: u8,
    },
    /// It does not end.
    #[error(
        "a line of more than {LINE_MAX} characters is no frame; is it an slcan adapter, and is its serial speed right?"
    )]
    TooLong,
}

/// Reads a frame: a line without its end. A time behind the payload (four hexadecimal digits) is ignored.
pub fn frame(line: &[u8]) -> Result<Frame, SlcanError> {
    let shown = || line.escape_ascii().to_string();
    let (fd, brs) = match line.first() {
        Some(b't') => (false, false),
        Some(b'd') => (true, false),
        Some(b'b') => (true, true),
        Some(b'T' | b'D' | b'B') => return Err(SlcanError::Extended(shown())),
        Some(b'r' | b'R') => return Err(SlcanError::Remote(shown())),
        _ => return Err(SlcanError::Kind(shown())),
    };
    let id = line.get(1..4).and_then(number).filter(|id| *id < 1 << 11);
    let id = id.ok_or_else(|| SlcanError::Identifier(shown()))?;
    let right = if fd { "0 to F" } else { "0 to 8" };
    let code = line.get(4..5).and_then(number).filter(|code| fd || *code <= 8);
    let code = code.ok_or_else(|| SlcanError::Length { line: shown(), right })?;
    let expected = Frame::dlc_to_len(code as u8, fd);
    let wrong = || SlcanError::Payload { line: shown(), expected };
    let digits = line.get(5..).unwrap_or_default();
    let (digits, time) = digits.split_at_checked(2 * usize::from(expected)).ok_or_else(wrong)?;
    if !(time.is_empty() || time.len() == 4 && number(time).is_some()) {
        return Err(wrong());
    }
    let bytes: Option<Vec<u8>> = digits.chunks(2).map(|pair| number(pair).map(|byte| byte as u8)).collect();
    let frame = Frame::new(id, fd, &bytes.ok_or_else(wrong)?).ok_or_else(wrong)?;
    Ok(Frame { brs, ..frame })
}

/// A number of hexadecimal digits and nothing else, at most four.
fn number(digits: &[u8]) -> Option<u16> {
    digits.iter().try_fold(0u16, |number, digit| Some(number << 4 | (*digit as char).to_digit(16)? as u16))
}

/// Appends a frame as a line, its end included.
pub fn write_frame(out: &mut Vec<u8>, frame: &Frame) {
    const HEX: &[u8; 16] = b"0123456789ABCDEF";
    let digit = |number: u16| HEX[usize::from(number & 15)];
    out.push(if !frame.fd {
        b't'
    } else if frame.brs {
        b'b'
    } else {
        b'd'
    });
    out.extend([frame.id >> 8, frame.id >> 4, frame.id, u16::from(frame.dlc())].map(digit));
    for byte in frame.payload() {
        out.extend([u16::from(byte >> 4), u16::from(*byte)].map(digit));
    }
    out.push(OK);
}

/// Puts bytes together to lines.
#[derive(Clone, Debug, Default)]
pub struct Lines {
    line: Vec<u8>,
    /// The rest of a line that was too long is not looked at.
    skipping: bool,
}

/// What came in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Received {
    /// A line without its end; empty: an acknowledgement, or somebody who clears the line.
    Line(Vec<u8>),
    /// The bell: a command was refused.
    Refused,
}

impl Lines {
    /// Takes a byte; gives what it completes. Line feeds are ignored.
    pub fn push(&mut self, byte: u8) -> Option<Result<Received, SlcanError>> {
        match byte {
            OK => {
                let line = std::mem::take(&mut self.line);
                let skipped = std::mem::take(&mut self.skipping);
                Some(if skipped { Err(SlcanError::TooLong) } else { Ok(Received::Line(line)) })
            }
            REFUSED => {
                *self = Lines::default();
                Some(Ok(Received::Refused))
            }
            b'\n' => None,
            _ => {
                if self.line.len() >= LINE_MAX {
                    self.skipping = true;
                    self.line.clear();
                }
                if !self.skipping {
                    self.line.push(byte);
                }
                None
            }
        }
    }
}

/// The adapter's side: obeys the commands of whoever opened the serial line.
///
/// It knows `O` and `L` (open, and open to listen only), `C` (close), `S0` to `S8`, `Y` with a digit and `s` (bit rates: accepted and ignored, the
/// bus has its own), `V`, `v` and `N` (versions and serial number), `F` (status), `Z0` (no times), `M` and `m` (filters; accepted only if they let
/// everything through), and frames.
#[derive(Clone, Debug)]
pub struct Adapter {
    fd: bool,
    channel: Channel,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Channel {
    Closed,
    Listening,
    Open,
}

/// What comes of a line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Obeyed {
    /// What to send back.
    pub reply: Vec<u8>,
    /// What to send on the bus.
    pub frame: Option<Frame>,
}

impl Adapter {
    /// A closed adapter on a CAN-FD bus, or on a classic one.
    pub fn new(fd: bool) -> Self {
        Adapter { fd, channel: Channel::Closed }
    }

    /// Whether frames of the bus are passed on.
    pub fn hears(&self) -> bool {
        self.channel != Channel::Closed
    }

    /// Whoever spoke has gone.
    pub fn close(&mut self) {
        self.channel = Channel::Closed;
    }

    /// Obeys a line, or refuses it with the bell.
    pub fn obey(&mut self, line: &[u8]) -> Obeyed {
        let says = |text: &str| Obeyed { reply: text.bytes().chain([OK]).collect(), frame: None };
        match line {
            // Whoever opens the line sends a few of these to clear it; they need no answer.
            b"" => Obeyed::default(),
            b"O" | b"L" | b"C" => {
                self.channel = match line {
                    b"O" => Channel::Open,
                    b"L" => Channel::Listening,
                    _ => Channel::Closed,
                };
                says("")
            }
            [b'S', b'0'..=b'8'] | [b'Y', b'0'..=b'9'] | b"Z0" => says(""),
            [b's', rest @ ..] if rest.len() == 4 && number(rest).is_some() => says(""),
            b"M00000000" | b"mFFFFFFFF" => says(""),
            b"V" => says("V0100"),
            b"v" => says("v0100"),
            b"N" => says("NSIM0"),
            b"F" => says("F00"),
            _ => match frame(line) {
                Ok(frame) if self.channel == Channel::Open && (self.fd || !frame.fd) => {
                    Obeyed { frame: Some(frame), ..says("z") }
                }
                _ => Obeyed { reply: vec![REFUSED], frame: None },
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn written(frame: &Frame) -> String {
        let mut out = Vec::new();
        write_frame(&mut out, frame);
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn frames_look_as_adapters_write_them() {
        let classic = Frame::new(0x7f, false, &[1, 0]).unwrap();
        assert_eq!(written(&classic), "t07F20100\r");
        let fast = Frame::new(0x183, true, &[0xab; 9]).unwrap();
        assert_eq!(written(&fast), "b1839ABABABABABABABABAB000000\r");
        assert_eq!(written(&Frame { brs: false, ..fast })[..5], *"d1839");
        assert_eq!(frame(b"t07F20100"), Ok(classic));
        assert_eq!(frame(b"t07f20100cafe"), Ok(classic), "with a time");
    }

    #[test]
    fn every_mistake_gets_its_sentence() {
        for (line, sentence) in [
            ("x123", "`x123` is no frame: one begins with t"),
            ("", "`` is no frame"),
            ("T000001232AABB", "`T000001232AABB` has a 29-bit identifier"),
            ("B000001230", "`B000001230` has a 29-bit identifier"),
            ("r1230", "`r1230` is a remote frame"),
            ("t8001AA", "`t8001AA` has no 11-bit identifier: three hexadecimal digits, 000 to 7FF"),
            ("t1G01AA", "`t1G01AA` has no 11-bit identifier"),
            ("t+1201", "`t+1201` has no 11-bit identifier"),
            ("t12", "`t12` has no 11-bit identifier"),
            ("t123", "`t123` has no length: a hexadecimal digit, 0 to 8"),
            ("t1239", "`t1239` has no length"),
            ("t1232AA", "`t1232AA` announces 2 bytes of payload, so 4 hexadecimal digits must follow"),
            ("t1231AABB", "`t1231AABB` announces 1 bytes of payload"),
            ("d123FAA", "`d123FAA` announces 64 bytes of payload, so 128 hexadecimal digits"),
            ("t1231A\r", "`t1231A\\r` announces 1 bytes"),
            ("t1231+A", "`t1231+A` announces 1 bytes"),
        ] {
            let error = frame(line.as_bytes()).unwrap_err().to_string();
            assert!(error.starts_with(sentence), "{line}: {error}");
        }
    }

    #[test]
    fn an_adapter_obeys() {
        let mut adapter = Adapter::new(true);
        let obeyed = |adapter: &mut Adapter, line: &str| {
            let Obeyed { reply, frame } = adapter.obey(line.as_bytes());
            (String::from_utf8(reply).unwrap(), frame)
        };
        assert_eq!(obeyed(&mut adapter, "t1230"), ("\x07".into(), None), "it is closed");
        for line in ["C", "S8", "Y5", "s031C", "Z0", "M00000000", "O"] {
            assert_eq!(obeyed(&mut adapter, line), ("\r".into(), None), "{line}");
        }
        assert_eq!(obeyed(&mut adapter, ""), (String::new(), None));
        assert_eq!(obeyed(&mut adapter, "V").0, "V0100\r");
        let (reply, frame) = obeyed(&mut adapter, "b1230");
        assert!(adapter.hears() && reply == "z\r" && frame.unwrap().brs);
        for line in ["S9", "S", "Z1", "M00000001", "t123", "T000001230", "hello", "s031"] {
            assert_eq!(obeyed(&mut adapter, line), ("\x07".into(), None), "{line}");
        }
        assert_eq!(obeyed(&mut adapter, "L").0, "\r");
        assert!(adapter.hears() && obeyed(&mut adapter, "t1230") == ("\x07".into(), None), "it only listens");
        adapter.close();
        assert!(!adapter.hears());
        let mut classic = Adapter::new(false);
        classic.obey(b"O");
        assert_eq!(obeyed(&mut classic, "d1230"), ("\x07".into(), None), "no CAN-FD on a classic bus");
    }

    #[test]
    fn lines_end_and_overlong_ones_are_skipped() {
        let mut lines = Lines::default();
        let mut all =
            |bytes: &[u8]| bytes.iter().filter_map(|byte| lines.push(*byte)).collect::<Vec<Result<Received, _>>>();
        assert_eq!(all(b"\r\nt12"), [Ok(Received::Line(vec![]))]);
        assert_eq!(all(b"30\rO\x07"), [Ok(Received::Line(b"t1230".to_vec())), Ok(Received::Refused)]);
        let long = [&[b'a'; 3 * LINE_MAX][..], b"\rO\r"].concat();
        assert_eq!(all(&long), [Err(SlcanError::TooLong), Ok(Received::Line(b"O".to_vec()))]);
        let most = [b'a'; LINE_MAX];
        assert_eq!(all(&[&most[..], b"\r"].concat()), [Ok(Received::Line(most.to_vec()))]);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(
            id in 0u16..0x800, fd: bool, brs: bool, data in proptest::collection::vec(any::<u8>(), 0..65), time: Option<u16>,
        ) {
            let bytes = if fd { &data[..] } else { &data[..data.len().min(8)] };
            let mut sent = Frame::new(id, fd, bytes).unwrap();
            sent.brs = fd && brs;
            let mut line = written(&sent).trim_end().to_string();
            if let Some(time) = time {
                line += &format!("{time:04X}");
            }
            prop_assert_eq!(frame(line.as_bytes()), Ok(sent));
        }

        /// Whatever comes over the line: no panic, every answer is an acknowledgement or the bell, and what is taken for a frame is one.
        #[test]
        fn any_bytes_are_survived(bytes in proptest::collection::vec(
            prop_oneof![any::<u8>(), proptest::sample::select(&b"tdbTDBrOLCSYVNFZ0123456789ABCDEFabcdef\r\r\r\x07"[..])], 0..600,
        ), fd: bool) {
            let (mut lines, mut adapter) = (Lines::default(), Adapter::new(fd));
            for received in bytes.iter().filter_map(|byte| lines.push(*byte)) {
                let Ok(Received::Line(line)) = received else { continue };
                prop_assert!(line.len() <= LINE_MAX);
                let before = adapter.hears();
                let Obeyed { reply, frame: sent } = adapter.obey(&line);
                prop_assert!(reply.is_empty() == line.is_empty());
                prop_assert!(reply.is_empty() || matches!(reply.last(), Some(&OK | &REFUSED)));
                if let Some(sent) = sent {
                    prop_assert!(before && sent.id < 0x800 && (fd || !sent.fd));
                    prop_assert!(written(&sent).trim_end().eq_ignore_ascii_case(std::str::from_utf8(&line[..5 + 2 * usize::from(sent.len)]).unwrap()));
                }
            }
        }
    }
}
