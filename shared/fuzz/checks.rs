//! What must hold for any bytes, for the targets here and for whoever else feeds bytes to the readers.

use composer_shared::observation::SIZE;
use composer_shared::policy::{Latent, Memory, Policy};
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::{FRAGMENTS, Frame, LatentMessage, Message};

/// Any frame is refused or understood completely.
pub fn frame(input: &[u8]) {
    let Some((&[low, high, flags, len], rest)) = input.split_first_chunk() else { return };
    let mut data = [0; 64];
    data.iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
    // Identifiers and lengths that no CAN controller delivers are tried, too.
    let mut frame = Frame { id: u16::from_le_bytes([low, high]), fd: flags & 1 != 0, brs: flags & 2 != 0, len, data };
    match Message::parse(&frame) {
        Ok(message) => {
            let fd = frame.fd || len > 8;
            frame.data[usize::from(len)..].fill(0);
            assert_eq!(message.emit(frame.module(), fd), Frame { fd, brs: fd, ..frame });
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
    let mut pieces = [[0; 7]; FRAGMENTS];
    pieces.as_flattened_mut().iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
    if let Ok(latent) = LatentMessage::from_fragments(&pieces) {
        assert_eq!(latent.fragments().map(|piece| piece.data), pieces);
    }
}

/// Any policy image is refused or can be run.
pub fn image(image: &[u8]) {
    match Policy::parse(image) {
        Ok(policy) => {
            let mut memory = Memory::EMPTY;
            let latents = [Latent { key: [-128; 16], value: [127; 32] }; MAX_MODULES];
            for x in [0.5, f32::MAX, -1.0] {
                let own = policy.encode(&mut memory, &[x; SIZE]);
                let action = policy.act(&own, &latents, u64::MAX, None, 0);
                assert!(action.iter().all(|a| (-1.01..=1.01).contains(a)));
            }
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}
