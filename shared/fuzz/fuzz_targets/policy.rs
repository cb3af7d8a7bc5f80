//! Any policy image is refused or can be run.
#![no_main]

#[path = "../checks.rs"]
#[allow(dead_code)]
mod checks;

use composer_shared::policy::{IMAGE_SIZE, random_image, seal};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    checks::image(input);
    // Most bytes fail at the first check; so also a good image with some of its bytes changed, sealed with the right checksum.
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    for change in input.chunks_exact(4) {
        let at = usize::from(u16::from_le_bytes([change[0], change[1]])) | usize::from(change[2]) << 16;
        image[at % IMAGE_SIZE] = change[3];
    }
    seal(&mut image);
    checks::image(&image);
});
