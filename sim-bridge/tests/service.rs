//! The service protocol on the simulated bus, with the modules in this process; `tests/tests/qemu.rs` has the same with emulated ones.

mod conversation;

use composer_firmware::controller::BusKind;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_sim_bridge::computer::InProcess;

#[test]
fn modules_answer_on_both_kinds_of_bus() {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    let policy = Policy::parse(&image).unwrap();
    let fd = conversation::talk(&InProcess::new(policy), policy, BusKind::Fd);
    let classic = conversation::talk(&InProcess::new(policy), policy, BusKind::Classic);
    assert_eq!(fd.len(), classic.len());
}
