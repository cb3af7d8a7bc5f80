//! Any frame is refused or understood completely.
#![no_main]

use composer_shared::wire::{FRAGMENTS, Frame, LatentMessage, Message};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let Some((&[low, high, flags, len], rest)) = input.split_first_chunk() else { return };
    let mut data = [0; 64];
    for (to, from) in data.iter_mut().zip(rest) {
        *to = *from;
    }
    // Identifiers and lengths that no CAN controller delivers are tried, too.
    let mut frame = Frame { id: u16::from_le_bytes([low, high]), fd: flags & 1 != 0, brs: flags & 2 != 0, len, data };
    match Message::parse(&frame) {
        Ok(message) => {
            let fd = frame.fd || len > 8;
            frame.data[usize::from(len)..].fill(0);
            let canonical = Frame { fd, brs: fd, ..frame };
            assert_eq!(message.emit(frame.module(), fd), canonical);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
    let mut pieces = [[0; 7]; FRAGMENTS];
    pieces.as_flattened_mut().iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
    if let Ok(latent) = LatentMessage::from_fragments(&pieces) {
        assert_eq!(latent.fragments().map(|piece| piece.data), pieces);
    }
});
