//! Frames as they lie in the message memory of Bosch's M_CAN (FDCAN of the STM32G4): two words of header and up to 16 of
//! data, the lowest byte first.
//!
//! Both frame formats are understood. A node on a CAN-FD bus receives classic frames too: a person with a classic adapter can stop the robot.

use composer_shared::wire::Frame;

/// Words of an element: a transmit buffer, or a place in a receive FIFO.
pub const WORDS: usize = 18;

/// Header word 0: an identifier of 29 bits.
const XTD: u32 = 1 << 30;
/// Header word 0: a remote frame.
const RTR: u32 = 1 << 29;
/// Header word 1: CAN-FD format.
const FDF: u32 = 1 << 21;
/// Header word 1: bit-rate switch.
const BRS: u32 = 1 << 20;

/// Writes a frame as a transmit buffer: `put` gets the number of each word and the word, as many as the frame has.
pub fn encode(frame: &Frame, mut put: impl FnMut(usize, u32)) {
    let format = if frame.fd { FDF | if frame.brs { BRS } else { 0 } } else { 0 };
    put(0, u32::from(frame.id & 0x7ff) << 18);
    put(1, format | u32::from(frame.dlc()) << 16);
    for (number, bytes) in frame.payload().chunks(4).enumerate() {
        let word = bytes.iter().rev().fold(0, |word, byte| word << 8 | u32::from(*byte));
        put(2 + number, word);
    }
}

/// Reads the frame in a place of a receive FIFO; `get` gives a word of it. `None` for what this protocol has not: remote frames, identifiers of 29
/// bits.
pub fn decode(get: impl Fn(usize) -> u32) -> Option<Frame> {
    let (identifier, format) = (get(0), get(1));
    if identifier & (XTD | RTR) != 0 {
        return None;
    }
    let fd = format & FDF != 0;
    let len = usize::from(Frame::dlc_to_len((format >> 16 & 15) as u8, fd));
    let mut data = [0; 64];
    for (number, bytes) in data.get_mut(..len)?.chunks_mut(4).enumerate() {
        let word = get(2 + number).to_le_bytes();
        bytes.iter_mut().zip(word).for_each(|(byte, read)| *byte = read);
    }
    let frame = Frame::new((identifier >> 18 & 0x7ff) as u16, fd, data.get(..len)?)?;
    Some(Frame { brs: fd && format & BRS != 0, ..frame })
}

/// A filter element: frames with a standard identifier that agrees with `id` in the bits of `mask` go into receive FIFO 0 or 1.
pub const fn filter(id: u16, mask: u16, second: bool) -> u32 {
    // Classic filter by mask.
    const SFT_MASK: u32 = 0b10 << 30;
    let fifo = if second { 2 } else { 1 };
    SFT_MASK | fifo << 27 | ((id & 0x7ff) as u32) << 16 | (mask & 0x7ff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::{Message, StopCommand};
    use std::vec::Vec;

    fn written(frame: &Frame) -> Vec<u32> {
        let mut words = Vec::new();
        encode(frame, |number, word| {
            assert_eq!(number, words.len());
            words.push(word);
        });
        words
    }

    fn read(words: &[u32]) -> Option<Frame> {
        decode(|number| words[number])
    }

    #[test]
    fn frames_of_both_formats_come_back_as_they_were() {
        let bytes: Vec<u8> = (1..=64).collect();
        for len in 0..=64 {
            for (fd, brs) in [(false, false), (true, false), (true, true)] {
                let Some(frame) = Frame::new(0x7a5, fd, &bytes[..len]).filter(|_| fd || len <= 8) else { continue };
                let frame = Frame { brs, ..frame };
                let words = written(&frame);
                assert_eq!(words.len(), 2 + usize::from(frame.len).div_ceil(4));
                assert_eq!(read(&words), Some(frame));
            }
        }
    }

    /// `cansend can0 003#010000` and every frame that a DBC calls StandardCAN.
    #[test]
    fn the_board_understands_a_stop_in_a_classic_frame() {
        let frame = read(&[0x003 << 18, 3 << 16, 0xff00_0001]).unwrap();
        assert_eq!((frame.id, frame.fd, frame.brs, frame.payload()), (0x003, false, false, &[1, 0, 0][..]));
        assert!(
            matches!(Message::parse(&frame), Ok(Message::EmergencyStop(stop)) if stop.command() == StopCommand::Stop)
        );
        // What is beyond the length does not count, nor do the time stamp and the number of the filter.
        assert_eq!(read(&[0x003 << 18, 0x8500_1234 | 3 << 16, 1]), Some(frame));
    }

    #[test]
    fn words_are_where_the_reference_manual_has_them() {
        let frame = Frame::new(0x201, true, &[0x11, 0x22, 0x33, 0x44, 0x55, 0, 0, 0, 9]).unwrap();
        assert_eq!(written(&frame), [0x201 << 18, 0x0039_0000, 0x4433_2211, 0x0000_0055, 0x0000_0009]);
        let classic = Frame::new(0x7ff, false, &[1]).unwrap();
        assert_eq!(written(&classic), [0x1ffc_0000, 0x0001_0000, 1]);
    }

    #[test]
    fn a_classic_length_code_above_eight_means_eight() {
        let frame = read(&[0x180 << 18, 15 << 16, 0x0403_0201, 0x0807_0605]).unwrap();
        assert_eq!(frame.payload(), [1, 2, 3, 4, 5, 6, 7, 8]);
        assert!(!frame.brs);
        assert_eq!(read(&[0x180 << 18, 15 << 16 | BRS, 0, 0]).map(|frame| frame.brs), Some(false));
    }

    #[test]
    fn a_filter_is_where_the_reference_manual_has_it() {
        assert_eq!(filter(0x180, 0x780, false), 0x8980_0780);
        assert_eq!(filter(0x080, 0x780, true), 0x9080_0780);
    }

    #[test]
    fn what_this_protocol_has_not_is_none() {
        assert_eq!(read(&[XTD | 0x1234_5678, 8 << 16, 0, 0]), None);
        assert_eq!(read(&[RTR | 0x080 << 18, 4 << 16, 0]), None);
    }
}
