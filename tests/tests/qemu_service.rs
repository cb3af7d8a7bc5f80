//! The service protocol with the modules as emulated microcontrollers: every answer is that of modules in this process. `tests/run` builds the image.
#![cfg(target_os = "linux")]

#[path = "../../sim-bridge/tests/conversation/mod.rs"]
mod conversation;

use composer_firmware::controller::BusKind;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_sim_bridge::computer::InProcess;
use composer_sim_bridge::qemu::{PATIENCE, Qemu};

#[test]
fn emulated_modules_answer_like_those_in_process() {
    // The test lies in target/release/deps.
    let program = std::env::current_exe().unwrap();
    let elf = program.ancestors().nth(3).unwrap().join("thumbv7em-none-eabihf/firmware/composer-qemu");
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    let policy = Policy::parse(&image).unwrap();
    let qemu = Qemu::new(&elf, &image, PATIENCE).unwrap();
    let emulated = conversation::talk(&qemu, policy, BusKind::Fd);
    assert_eq!(emulated, conversation::talk(&InProcess::new(policy), policy, BusKind::Fd));
}
