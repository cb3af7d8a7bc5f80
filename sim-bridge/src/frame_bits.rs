//! Frames as bits on the wire: how long a classic CAN or CAN-FD data frame takes, from its actual bits.
//!
//! ISO 11898-1:2015, data frames with an 11-bit identifier. A frame is start of frame, arbitration field (identifier, RTR or RRS),
//! control field (IDE, FDF, for FD also res, BRS and ESI, then DLC), data, checksum, delimiters, acknowledgement and end of frame;
//! three bits of intermission separate it from the next.
//!
//! - Classic: dynamic stuffing (a complementary bit after five equal ones) from start of frame to the end of the CRC-15.
//! - FD: dynamic stuffing from start of frame to the end of the data. Then come the stuff-bit count (modulo 8, Gray coded, with a parity
//!   bit) and the CRC-17 (up to 16 data bytes) or CRC-21, with a fixed stuff bit ahead of them and after every fourth bit.
//!   The checksum covers the dynamic stuff bits and the stuff-bit count and starts from a one followed by zeros.
//!
//! Approximation: the bit rate switches at the end of the BRS bit and at the end of the CRC delimiter, not at their sample points.
//! The two differences cancel to within `(1/nominal - 1/data) * (sample point difference)`, some 10 ns with usual settings.
//! Not modelled: remote frames and extended identifiers, which this robot does not use.

use std::ops::Range;

use composer_shared::wire::Frame;

/// Bits of intermission between two frames.
pub const INTERFRAME_BITS: u32 = 3;

/// Bit rates of a bus, bit/s. Classic frames and the arbitration phase of FD frames use the nominal one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitRates {
    /// Nominal bit rate, bit/s.
    pub nominal: u32,
    /// Bit rate of the data phase of FD frames with a bit rate switch, bit/s.
    pub data: u32,
}

impl BitRates {
    /// 1 Mbit/s throughout.
    pub const CLASSIC_1M: BitRates = BitRates { nominal: 1_000_000, data: 1_000_000 };
    /// 1 Mbit/s, data phase 5 Mbit/s.
    pub const FD_1M_5M: BitRates = BitRates { nominal: 1_000_000, data: 5_000_000 };
    /// 1 Mbit/s, data phase 8 Mbit/s.
    pub const FD_1M_8M: BitRates = BitRates { nominal: 1_000_000, data: 8_000_000 };

    /// Time of `bits` at the nominal rate, ns.
    pub fn nominal_ns(&self, bits: u32) -> u64 {
        u64::from(bits) * 1_000_000_000 / u64::from(self.nominal.max(1))
    }

    /// Time of a number of bits at each rate, ns.
    pub fn ns(&self, length: Length) -> u64 {
        self.nominal_ns(length.nominal) + u64::from(length.data) * 1_000_000_000 / u64::from(self.data.max(1))
    }

    /// Time of a frame and the intermission that follows it, ns.
    pub fn with_interframe_ns(&self, length: Length) -> u64 {
        self.ns(Length { nominal: length.nominal + INTERFRAME_BITS, data: length.data })
    }
}

/// Length of a frame in bits, from start of frame to the end of its end-of-frame field, without intermission.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Length {
    /// Bits sent at the nominal rate.
    pub nominal: u32,
    /// Bits sent at the data rate: 0 unless the frame switches rates.
    pub data: u32,
}

impl Length {
    /// All bits.
    pub fn bits(self) -> u32 {
        self.nominal + self.data
    }
}

/// What kind of frame, for the lengths that do not depend on its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Classic CAN, up to 8 bytes.
    Classic,
    /// CAN-FD, up to 64 bytes, all at the nominal rate.
    Fd,
    /// CAN-FD with bit rate switch.
    FdBrs,
}

impl Format {
    /// The format of `frame`.
    pub fn of(frame: &Frame) -> Self {
        match (frame.fd, frame.brs) {
            (false, _) => Format::Classic,
            (true, false) => Format::Fd,
            (true, true) => Format::FdBrs,
        }
    }
}

/// Start of frame, identifier, RTR, IDE, FDF, DLC of a classic frame.
const CLASSIC_HEADER: u32 = 1 + 11 + 3 + 4;
/// Start of frame to BRS of an FD frame.
const FD_NOMINAL_HEAD: u32 = 1 + 11 + 5;
/// ESI and DLC of an FD frame.
const FD_DATA_HEAD: u32 = 1 + 4;
/// Acknowledgement slot, its delimiter, end of frame.
const TAIL: u32 = 1 + 1 + 7;

/// Checksum bits of an FD frame with `len` data bytes, and the fixed stuff bits among stuff-bit count and checksum.
fn fd_checksum(len: usize) -> (u32, u32) {
    if len <= 16 { (17, 6) } else { (21, 7) }
}

/// Length of a frame with `len` data bytes before any dynamic stuffing.
pub fn unstuffed(format: Format, len: usize) -> Length {
    let data_bits = 8 * len as u32;
    if format == Format::Classic {
        return Length { nominal: CLASSIC_HEADER + data_bits + 15 + 1 + TAIL, data: 0 };
    }
    let (crc, fixed) = fd_checksum(len);
    let fast = FD_DATA_HEAD + data_bits + 4 + crc + fixed + 1;
    split(format, FD_NOMINAL_HEAD + TAIL, fast)
}

/// Longest that a frame with `len` data bytes can get: a stuff bit after the first five bits and every four from then on.
pub fn worst_case(format: Format, len: usize) -> Length {
    let plain = unstuffed(format, len);
    if format == Format::Classic {
        let stuffable = CLASSIC_HEADER + 8 * len as u32 + 15;
        return Length { nominal: plain.nominal + (stuffable - 1) / 4, data: 0 };
    }
    let all = (FD_NOMINAL_HEAD + FD_DATA_HEAD + 8 * len as u32 - 1) / 4;
    let early = (FD_NOMINAL_HEAD - 1) / 4;
    if format == Format::Fd {
        Length { nominal: plain.nominal + all, data: 0 }
    } else {
        Length { nominal: plain.nominal + early, data: plain.data + all - early }
    }
}

fn split(format: Format, nominal: u32, fast: u32) -> Length {
    if format == Format::FdBrs { Length { nominal, data: fast } } else { Length { nominal: nominal + fast, data: 0 } }
}

/// State of the stuffing rule after a bit: value of the last bit on the wire (bit 2) and length of its run minus one (bits 0 and 1).
/// Five equal bits cannot be a state: the stuff bit that follows starts a new run.
type StuffState = u8;

/// The next state and whether a stuff bit followed.
const fn stuff_step(state: StuffState, bit: bool) -> (StuffState, bool) {
    let last = state >> 2 == 1;
    if bit != last {
        ((bit as u8) << 2, false)
    } else if state & 3 == 3 {
        ((!last as u8) << 2, true)
    } else {
        (state + 1, false)
    }
}

/// [`stuff_step`] over the eight bits of a byte: next state (bits 0 to 2), stuff bits (3 and 4), one after the last bit (5).
const STUFF_BYTE: [[u8; 256]; 8] = {
    let mut table = [[0; 256]; 8];
    let mut start = 0;
    while start < 8 {
        let mut byte = 0;
        while byte < 256 {
            let (mut state, mut count, mut last, mut bit) = (start as u8, 0u8, false, 8);
            while bit > 0 {
                bit -= 1;
                (state, last) = stuff_step(state, byte >> bit & 1 == 1);
                count += last as u8;
            }
            table[start][byte] = state | count << 3 | (last as u8) << 5;
            byte += 1;
        }
        start += 1;
    }
    table
};

const CRC15: u32 = 0x4599;
const CRC17: u32 = 0x1685B;
const CRC21: u32 = 0x10_2899;

const fn crc_step(crc: u32, bit: bool, width: u32, polynomial: u32) -> u32 {
    let feedback = (crc >> (width - 1) & 1 == 1) != bit;
    let shifted = crc << 1 & ((1 << width) - 1);
    if feedback { shifted ^ polynomial } else { shifted }
}

/// CRC-15 over a byte at a time.
const CRC15_BYTE: [u16; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut crc, mut bit) = (0, 8);
        while bit > 0 {
            bit -= 1;
            crc = crc_step(crc, byte >> bit & 1 == 1, 15, CRC15);
        }
        table[byte] = crc as u16;
        byte += 1;
    }
    table
};

/// Counts stuff bits without writing the frame out.
struct Counter {
    state: StuffState,
    stuffed: u32,
    after_last: bool,
}

impl Counter {
    /// After start of frame, which is dominant (0).
    fn new() -> Self {
        Counter { state: 0, stuffed: 0, after_last: false }
    }

    /// Feeds the low `count` bits of `value`, high bit first.
    fn bits(&mut self, value: u32, count: u32) {
        for shift in (0..count).rev() {
            (self.state, self.after_last) = stuff_step(self.state, value >> shift & 1 == 1);
            self.stuffed += u32::from(self.after_last);
        }
    }

    fn byte(&mut self, byte: u8) {
        let entry = STUFF_BYTE[usize::from(self.state & 7)][usize::from(byte)];
        self.state = entry & 7;
        self.stuffed += u32::from(entry >> 3 & 3);
        self.after_last = entry >> 5 == 1;
    }
}

/// Actual length of `frame`, stuff bits counted from its bits. Costs well below a microsecond.
pub fn length(frame: &Frame) -> Length {
    let payload = frame.payload();
    let format = Format::of(frame);
    let mut length = unstuffed(format, payload.len());
    let mut count = Counter::new();
    let id = u32::from(frame.id & 0x7ff);
    if format == Format::Classic {
        // RTR, IDE and FDF are dominant.
        let header = id << 7 | u32::from(frame.dlc());
        count.bits(header, CLASSIC_HEADER - 1);
        let mut crc = (0..CLASSIC_HEADER - 1).rev().fold(0, |crc, k| crc_step(crc, header >> k & 1 == 1, 15, CRC15));
        for &byte in payload {
            count.byte(byte);
            crc = (crc << 8 & 0x7fff) ^ u32::from(CRC15_BYTE[usize::from((crc >> 7) as u8 ^ byte)]);
        }
        count.bits(crc, 15);
        length.nominal += count.stuffed;
        return length;
    }
    // RRS 0, IDE 0, FDF 1, res 0, BRS.
    count.bits(id << 5 | 0b00100 | u32::from(frame.brs), FD_NOMINAL_HEAD - 1);
    let early = count.stuffed;
    count.bits(u32::from(frame.dlc()), FD_DATA_HEAD);
    payload.iter().for_each(|&byte| count.byte(byte));
    // The fixed stuff bit ahead of the stuff-bit count takes the place of a stuff bit due after the last bit of the data.
    let late = count.stuffed - early - u32::from(count.after_last);
    if format == Format::FdBrs {
        length.nominal += early;
        length.data += late;
    } else {
        length.nominal += early + late;
    }
    length
}

/// A frame written out bit by bit (`true` is recessive), without intermission, as a transmitter sends it: the acknowledgement slot is recessive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BitStream {
    /// Every bit from start of frame to end of frame.
    pub bits: Vec<bool>,
    /// First bit after the arbitration field.
    pub control: usize,
    /// Bits sent at the data rate; empty without a bit rate switch.
    pub fast: Range<usize>,
    /// The acknowledgement slot.
    pub ack: usize,
}

impl BitStream {
    /// Writes out `frame`.
    pub fn new(frame: &Frame) -> Self {
        let payload = frame.payload();
        let mut w = Writer { bits: Vec::with_capacity(160 + 10 * payload.len()), state: 0, stuffed: 0, pending: false };
        w.bits.push(false);
        w.dynamic(u32::from(frame.id & 0x7ff) << 1, 12);
        let control = w.bits.len();
        let mut fast = 0..0;
        if frame.fd {
            w.dynamic(0b0100 | u32::from(frame.brs), 4 + 1 - 1);
            let start = w.bits.len();
            w.dynamic(u32::from(frame.dlc()), FD_DATA_HEAD);
            payload.iter().for_each(|&byte| w.dynamic(byte.into(), 8));
            let (width, polynomial) = if payload.len() <= 16 { (17, CRC17) } else { (21, CRC21) };
            let count = w.stuffed % 8;
            let gray = count ^ count >> 1;
            let count_field = gray << 1 | gray.count_ones() & 1;
            let crc = w.bits.iter().fold(1 << (width - 1), |crc, &bit| crc_step(crc, bit, width, polynomial));
            let crc = (0..4).rev().fold(crc, |crc, k| crc_step(crc, count_field >> k & 1 == 1, width, polynomial));
            for k in 0..4 + width {
                if k % 4 == 0 {
                    let complement = w.bits.last().is_some_and(|last| !last);
                    w.bits.push(complement);
                }
                w.bits.push(if k < 4 { count_field >> (3 - k) & 1 == 1 } else { crc >> (width + 3 - k) & 1 == 1 });
            }
            w.bits.push(true);
            if frame.brs {
                fast = start..w.bits.len();
            }
        } else {
            w.dynamic(u32::from(frame.dlc()), 6);
            payload.iter().for_each(|&byte| w.dynamic(byte.into(), 8));
            let header = u32::from(frame.id & 0x7ff) << 7 | u32::from(frame.dlc());
            let crc = (0..CLASSIC_HEADER).rev().fold(0, |crc, k| crc_step(crc, header >> k & 1 == 1, 15, CRC15));
            let bits = payload.iter().flat_map(|&byte| (0..8).rev().map(move |k| byte >> k & 1 == 1));
            w.dynamic(bits.fold(crc, |crc, bit| crc_step(crc, bit, 15, CRC15)), 15);
            w.flush();
            w.bits.push(true);
        }
        let ack = w.bits.len();
        w.bits.resize(ack + TAIL as usize, true);
        BitStream { bits: w.bits, control, fast, ack }
    }

    /// Length of the first `bits` bits.
    pub fn length_of(&self, bits: usize) -> Length {
        let fast = bits.min(self.fast.end).saturating_sub(self.fast.start);
        Length { nominal: (bits - fast) as u32, data: fast as u32 }
    }
}

struct Writer {
    bits: Vec<bool>,
    state: StuffState,
    stuffed: u32,
    /// A stuff bit is due, if another bit under the dynamic rule or the end of a classic frame follows.
    pending: bool,
}

impl Writer {
    fn flush(&mut self) {
        if self.pending {
            let complement = self.state >> 2 == 1;
            self.bits.push(complement);
            self.stuffed += 1;
            self.pending = false;
        }
    }

    fn dynamic(&mut self, value: u32, count: u32) {
        for shift in (0..count).rev() {
            self.flush();
            let bit = value >> shift & 1 == 1;
            self.bits.push(bit);
            (self.state, self.pending) = stuff_step(self.state, bit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LENGTHS: [usize; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

    fn frame(format: Format, id: u16, payload: &[u8]) -> Frame {
        let mut data = [0; 64];
        data[..payload.len()].copy_from_slice(payload);
        Frame { id, fd: format != Format::Classic, brs: format == Format::FdBrs, len: payload.len() as u8, data }
    }

    /// Frame times with intermission, in tenths of a microsecond, as measured and tabulated for this project.
    #[test]
    fn the_table_of_frame_times_is_exact() {
        let classic = |length: Length| length.bits() + INTERFRAME_BITS;
        assert_eq!(classic(worst_case(Format::Classic, 8)), 135);
        assert_eq!(classic(unstuffed(Format::Classic, 8)), 111);
        let us10 = |rates: BitRates, length| (rates.with_interframe_ns(length) as f64 / 100.0).round() as u64;
        assert_eq!(us10(BitRates::FD_1M_5M, worst_case(Format::FdBrs, 16)), 718);
        assert_eq!(us10(BitRates::FD_1M_5M, worst_case(Format::FdBrs, 32)), 1048);
        assert_eq!(us10(BitRates::FD_1M_5M, worst_case(Format::FdBrs, 64)), 1688);
        assert_eq!(us10(BitRates::FD_1M_5M, unstuffed(Format::FdBrs, 64)), 1390);
        assert_eq!(us10(BitRates::FD_1M_8M, worst_case(Format::FdBrs, 64)), 1179);
    }

    /// Check values of the CRC catalogue ("123456789", initial value 0): CRC-15/CAN, CRC-17/CAN-FD, CRC-21/CAN-FD.
    #[test]
    fn the_checksums_are_the_standards() {
        let crc = |width, polynomial| {
            let bits = b"123456789".iter().flat_map(|byte| (0..8).rev().map(move |k| byte >> k & 1 == 1));
            bits.fold(0, |crc, bit| crc_step(crc, bit, width, polynomial))
        };
        assert_eq!(crc(15, CRC15), 0x059e);
        assert_eq!(crc(17, CRC17), 0x4f03);
        assert_eq!(crc(21, CRC21), 0x0e_d841);
    }

    /// Without data, identifier 0: fifteen dominant header bits and DLC 0000 give a stuff bit after each five.
    #[test]
    fn a_frame_written_out_by_hand() {
        let stream = BitStream::new(&frame(Format::Classic, 0, &[]));
        let text: String = stream.bits.iter().map(|&bit| if bit { '1' } else { '0' }).collect();
        // SOF and 18 zeros in fives (the stuff bits are ones), the CRC of zeros is zero: 34 zeros in all, then delimiter, ACK, EOF.
        assert_eq!(text, format!("{}{}{}", "000001000001000001000001000001000001", "0000", "1111111111"));
    }

    #[test]
    fn a_stuff_bit_due_at_the_end_of_fd_data_is_left_to_the_fixed_one() {
        let full = frame(Format::Fd, 0x555, &[0b1101_1111]);
        let stream = BitStream::new(&full);
        assert_eq!(stream.bits.len() as u32, length(&full).bits());
        // Counted from the end: the data ends in five ones, then comes a single zero, the fixed stuff bit, then the stuff-bit count.
        let data_end = stream.bits.len() - (6 + 4 + 17 + 1 + TAIL) as usize;
        assert_eq!(stream.bits[data_end - 6..=data_end], [false, true, true, true, true, true, false]);
        assert_eq!(read(&stream, true), Some((0x555, vec![0b1101_1111])));
    }

    /// Reads a frame as a receiver would: takes the stuff bits out again and checks each of them and the checksum.
    fn read(stream: &BitStream, fd: bool) -> Option<(u16, Vec<u8>)> {
        let mut input = stream.bits.iter().copied();
        let (mut raw, mut run, mut last, mut stuffed) = (Vec::new(), 0, None, 0u32);
        let mut plain = Vec::new();
        let header = if fd { 22 } else { 19 };
        let mut wanted = header;
        while plain.len() < wanted {
            let bit = input.next()?;
            raw.push(bit);
            if run == 5 {
                if Some(bit) == last {
                    return None;
                }
                stuffed += 1;
                run = 1;
            } else {
                run = if Some(bit) == last { run + 1 } else { 1 };
                plain.push(bit);
            }
            last = Some(bit);
            if plain.len() == header && wanted == header {
                let code = plain[header - 4..].iter().fold(0, |v, &b| v << 1 | usize::from(b));
                wanted += 8 * LENGTHS[code] + if fd { 0 } else { 15 };
            }
        }
        let number = |bits: &[bool]| bits.iter().fold(0u32, |v, &b| v << 1 | u32::from(b));
        let data_end = if fd { plain.len() } else { plain.len() - 15 };
        if fd {
            let len = (data_end - header) / 8;
            let (width, polynomial) = if len <= 16 { (17, CRC17) } else { (21, CRC21) };
            let mut tail = Vec::new();
            let mut previous = *raw.last()?;
            for k in 0..4 + width {
                if k % 4 == 0 && input.next()? == previous {
                    return None;
                }
                previous = input.next()?;
                tail.push(previous);
            }
            let gray = number(&tail[..3]);
            if gray ^ gray >> 1 ^ gray >> 2 != stuffed % 8 || tail[..4].iter().filter(|&&b| b).count() % 2 != 0 {
                return None;
            }
            let covered = raw.iter().chain(&tail[..4]);
            let crc = covered.fold(1 << (width - 1), |crc, &bit| crc_step(crc, bit, width, polynomial));
            if crc != number(&tail[4..]) {
                return None;
            }
        } else {
            if run == 5 && Some(input.next()?) == last {
                return None;
            }
            if plain.iter().fold(0, |crc, &bit| crc_step(crc, bit, 15, CRC15)) != 0 {
                return None;
            }
        }
        if input.len() != 1 + TAIL as usize || !input.all(|bit| bit) {
            return None;
        }
        let bytes = plain[header..data_end].chunks(8).map(|byte| number(byte) as u8).collect();
        Some((number(&plain[1..12]) as u16, bytes))
    }

    proptest! {
        #[test]
        fn actual_lengths_lie_between_the_bounds_and_match_the_bits(
            id in 0u16..0x800, code in 0usize..16, kind in 0usize..3, sparse in any::<bool>(), bytes in proptest::array::uniform32(any::<u16>()),
        ) {
            let format = [Format::Classic, Format::Fd, Format::FdBrs][kind];
            let len = if format == Format::Classic { LENGTHS[code].min(8) } else { LENGTHS[code] };
            // Half of the cases consist of long runs of equal bits, where the stuffing happens.
            let mask = |v: u8| if sparse { if v & 1 == 1 { 0xff } else { 0 } } else { v };
            let payload: Vec<u8> = bytes.iter().flat_map(|v| v.to_le_bytes()).map(mask).take(len).collect();
            let frame = frame(format, id, &payload);
            let (length, stream) = (length(&frame), BitStream::new(&frame));
            let (least, most) = (unstuffed(format, len), worst_case(format, len));
            prop_assert!(least.nominal <= length.nominal && length.nominal <= most.nominal);
            prop_assert!(least.data <= length.data && length.data <= most.data);
            prop_assert_eq!(length, stream.length_of(stream.bits.len()));
            prop_assert_eq!(read(&stream, frame.fd), Some((id, payload)));
            // One flipped bit ahead of the delimiter never reads as the same frame.
            let flip = bytes[0] as usize % (stream.ack - 1);
            let mut broken = stream.clone();
            broken.bits[flip] = !broken.bits[flip];
            prop_assert_eq!(read(&broken, frame.fd), None);
        }
    }
}
