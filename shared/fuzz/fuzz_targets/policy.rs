//! Any policy image is refused or can be run.
#![no_main]

use composer_shared::observation::SIZE;
use composer_shared::policy::{IMAGE_SIZE, Latent, Memory, Policy, random_image};
use composer_shared::robot::MAX_MODULES;
use libfuzzer_sys::fuzz_target;

fn run(image: &[u8]) {
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

fuzz_target!(|input: &[u8]| {
    run(input);
    // Most bytes fail at the first check; so also a good image with some of its bytes changed, sealed with the right checksum.
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    for change in input.chunks_exact(4) {
        let at = usize::from(u16::from_le_bytes([change[0], change[1]])) | usize::from(change[2]) << 16;
        image[at % IMAGE_SIZE] = change[3];
    }
    let (body, checksum) = image.split_at_mut(IMAGE_SIZE - 4);
    let crc = body.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ if crc & 1 != 0 { 0xedb8_8320 } else { 0 })
    });
    checksum.copy_from_slice(&(!crc).to_le_bytes());
    run(&image);
});
