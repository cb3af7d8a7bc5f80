//! `snakectl flash` drives `probe-rs`: a stand-in for that tool, first on the PATH, records what it is asked to do.
#![cfg(unix)]

mod common;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Output;

use common::{arm_image, command, refuse, succeed};
use composer_firmware::failsafe::BusOffPolicy;
use composer_firmware::limits::{Caps, JointRange};
use composer_firmware::memory_map::{FLASH_ADDRESS, NODE_PAGE_ADDRESS, POLICY_ADDRESS, RECORDS_ADDRESS};
use composer_firmware::node_page::NodePage;
use composer_firmware::safety::Safety;
use composer_firmware::supply::Thresholds;
use composer_firmware::update::records::of_new_module;
use composer_shared::policies;

/// Keeps its arguments, one call a line, and a copy of each file it is to write. `list` prints the file `probes`; the call whose arguments
/// contain what the file `fails-at` says fails as probe-rs does.
const STAND_IN: &str = r#"#!/bin/sh
here=$(dirname "$0")
echo "$*" >> "$here/calls"
if [ "$1" = list ]; then cat "$here/probes"; exit; fi
if [ -f "$here/fails-at" ] && echo "$*" | grep -q "$(cat "$here/fails-at")"; then
    echo "Error: Failed to open probe" >&2
    exit 1
fi
if [ "$1" = download ]; then
    for file; do :; done
    cp "$file" "$here/$(basename "$file").written"
fi
"#;

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("tools")).unwrap();
        let bench = Bench { folder };
        bench.write("tools/probe-rs", STAND_IN.as_bytes());
        let tool = bench.path().join("tools/probe-rs");
        std::fs::set_permissions(tool, PermissionsExt::from_mode(0o755)).unwrap();
        bench.write("tools/probes", b"The following debug probes were found:\n[0]: STLINK-V3 -- 0483:374e (ST-LINK)\n");
        bench.write("module.elf", &arm_image(FLASH_ADDRESS));
        bench
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path().join(name), bytes).unwrap();
    }

    fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path().join(name)).unwrap()
    }

    fn calls(&self) -> Vec<String> {
        let calls = std::fs::read_to_string(self.path().join("tools/calls")).unwrap_or_default();
        calls.lines().map(str::to_string).collect()
    }

    fn flash(&self, more: &[&str]) -> Output {
        let arguments = [&["flash", "--node", "3", "--image", "module.elf"], more].concat();
        let path = format!("{}:/usr/bin:/bin", self.path().join("tools").display());
        command(self.path(), &arguments).env("PATH", path).output().unwrap()
    }

    /// The complaint of a call that must fail.
    fn complaint(&self, output: &Output) -> String {
        assert!(!output.status.success());
        let complaint = String::from_utf8_lossy(&output.stderr).trim().to_string();
        assert_eq!(complaint.lines().filter(|line| !line.contains("nominal values")).count(), 1, "{complaint}");
        complaint
    }
}

#[test]
fn image_policy_and_node_page_come_to_their_places() {
    let bench = Bench::new();
    let output = bench.flash(&["--bus-off", "latch", "--probe", "0483:374e"]);
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("module 3 of 8") && said.contains("100 % (yaw)"), "{said}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("nominal values"));

    let calls = bench.calls();
    let [list, policy, records, page, firmware, reset] = &calls[..] else { panic!("{calls:#?}") };
    assert_eq!(list, "list");
    for (call, address) in [(policy, POLICY_ADDRESS), (records, RECORDS_ADDRESS), (page, NODE_PAGE_ADDRESS)] {
        assert!(call.starts_with("download ") && call.contains(" --verify "), "{call}");
        assert!(call.contains(&format!(" --binary-format bin --base-address {address:#010x} ")), "{call}");
    }
    assert!(firmware.contains(" --verify ") && firmware.ends_with(" --binary-format elf module.elf"), "{firmware}");
    assert!(reset.starts_with("reset "), "{reset}");
    assert!(calls[1..].iter().all(|call| call.contains(" --chip STM32G474RETx --probe 0483:374e")), "{calls:#?}");

    assert_eq!(bench.read("tools/policy.bin.written"), policies::shipped("goal-reaching").unwrap());
    assert_eq!(bench.read("tools/records.bin.written"), of_new_module(0));
    let page = NodePage::parse(&bench.read("tools/node-page.bin.written")).unwrap();
    assert_eq!((page.node, page.modules, page.bus_off), (3, 8, BusOffPolicy::Latch));
    assert_eq!(page.keys, [[0; 32]; 2]);
    // 0.2 N m per A, and a torque unit is 0.0025 N m.
    assert_eq!(page.calibration.motors[0].torque_constant, 80.0);
    assert_eq!(bench.read("tools/module.elf.written"), bench.read("module.elf"));
}

#[test]
fn what_was_measured_arrives() {
    let bench = Bench::new();
    let text = composer_host::flash::NOMINAL_CALIBRATION;
    let text = text.replacen("zero = 0 ", "zero = 4711 ", 1).replacen("reversed = false", "reversed = true", 1);
    let text = text.replacen("torque_constant = 0.2", "torque_constant = -0.1", 1);
    let text = text.replacen("min = -3.0 ", "min = -1.25 ", 1).replacen("max = 3.0", "max = 2.5", 1);
    let text = text.replacen("torque_slew = 0.5 ", "torque_slew = 0.25 ", 1).replacen("= 2000", "= 500", 1);
    let text = text.replacen("lowest = 9.0", "lowest = 10.5", 1);
    bench.write("three.toml", text.as_bytes());
    let output = bench.flash(&["--calibration", "three.toml", "--modules", "4"]);
    assert!(output.status.success() && output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).contains("60 % (yaw)"));
    let page = NodePage::parse(&bench.read("tools/node-page.bin.written")).unwrap();
    let joint = page.calibration.joints[0];
    assert_eq!((joint.zero, joint.reversed, page.modules), (4711, true, 4));
    assert_eq!(page.calibration.motors.map(|motor| motor.torque_constant), [-40.0, 80.0]);
    let expected = Safety {
        caps: Caps { torque_slew: 100.0, ..Safety::BOARD.caps },
        supply: Thresholds { under: 10.5, ..Safety::BOARD.supply },
        dead_man_ms: 500,
        joints: [
            JointRange { min: -1.25, max: 2.5 },
            page.safety.joints[1],
            page.safety.joints[2],
            page.safety.joints[3],
        ],
        ..Safety::BOARD
    };
    assert_eq!(page.safety, expected);
    assert_eq!(page.safety.joints[1..], Safety::BOARD.joints[1..]);
}

#[test]
fn a_dry_run_prints_the_commands_and_keeps_the_files() {
    let bench = Bench::new();
    let output = bench.flash(&["--dry-run", "--out", "my module"]);
    assert!(output.status.success());
    assert!(bench.calls().is_empty(), "nothing is run");
    let printed = String::from_utf8(output.stdout).unwrap();
    let path = format!("{}:/usr/bin:/bin", bench.path().join("tools").display());
    // What it prints can be run as it stands, with the same effect.
    let shell =
        std::process::Command::new("sh").current_dir(bench.path()).env("PATH", path).args(["-ec", &printed]).output();
    assert!(shell.unwrap().status.success());
    assert_eq!(bench.calls().len(), 5, "policy, records, node page, image, restart");
    assert_eq!(bench.read("tools/node-page.bin.written"), bench.read("my module/node-page.bin"));
}

#[test]
fn without_tool_probe_or_chip_it_says_so() {
    let bench = Bench::new();
    let nowhere = bench.path().join("empty");
    std::fs::create_dir(&nowhere).unwrap();
    let mut without = command(bench.path(), &["flash", "--node", "3", "--image", "module.elf"]);
    let complaint = bench.complaint(&without.env("PATH", nowhere).output().unwrap());
    assert!(complaint.contains("probe-rs is not installed") && complaint.contains("cargo install"), "{complaint}");

    bench.write("tools/probes", b"No debug probes were found.\n");
    let complaint = bench.complaint(&bench.flash(&[]));
    assert!(complaint.contains("no debug probe") && complaint.contains("SWD"), "{complaint}");
    assert_eq!(bench.calls(), ["list"], "nothing else is tried");

    let bench = Bench::new();
    bench.write("tools/fails-at", format!("{NODE_PAGE_ADDRESS:#010x}").as_bytes());
    let complaint = bench.complaint(&bench.flash(&[]));
    assert!(complaint.contains("could not write the node page: Error: Failed to open probe"), "{complaint}");
    assert!(complaint.contains("STM32G474RETx"), "{complaint}");
    assert_eq!(bench.calls().len(), 4, "it stops there, after the probes, the policy and its records");
}

#[test]
fn what_cannot_be_a_module_is_refused_before_anything_is_written() {
    let bench = Bench::new();
    let flash = |more: &[&str], words: &[&str]| {
        let arguments = [&["flash", "--dry-run", "--image", "module.elf"], more].concat();
        refuse(bench.path(), &arguments, words)
    };
    flash(&[], &["--node"]);
    flash(&["--node", "8"], &["number of this module", "0 to the number of modules - 1"]);
    flash(&["--node", "0", "--modules", "65"], &["number of modules", "1 to 64"]);
    flash(&["--node", "0", "--modules", "300"], &["300"]);
    let node = |more: &[&str], words: &[&str]| flash(&[&["--node", "0"], more].concat(), words);

    let mut damaged = policies::shipped("goal-reaching").unwrap().to_vec();
    damaged[5000] ^= 1;
    bench.write("damaged.policy", &damaged);
    node(&["--policy", "damaged.policy"], &["damaged.policy", "CRC"]);
    node(&["--policy", "dancing"], &["no policy dancing", "goal-reaching"]);
    node(&["--policy", "random"], &["random is no policy image", "snakectl export"]);

    let nominal = composer_host::flash::NOMINAL_CALIBRATION;
    for (from, to, word) in [
        ("cut_off", "cutoff", "cutoff"),
        ("cut_off = 2.5", "cut_off = 0.5", "cut-off current"),
        // 6.6 A from end to end of the converter: 10 A would never be seen.
        ("cut_off = 2.5", "cut_off = 10.0", "it could never cut off"),
        ("min = -3.0", "min = -3.2", "-3.1 to -0.05 rad"),
        ("max = 3.0", "max = 0.0", "0.05 to 3.1 rad"),
        ("torque = 0.2 ", "torque = 0.0 ", "cap of the torque"),
        ("torque_slew = 0.5", "torque_slew = nan", "cap of the slew"),
        ("temperature = 80.0", "temperature = 300.0", "30 to 150 degrees Celsius"),
        ("dead_man_ms = 2000", "dead_man_ms = 50", "0 (never), or 200 to 60000 ms"),
        ("dead_man_ms = 2000", "dead_man_ms = 2e6", "dead_man_ms"),
        ("blind_relaxes = true", "blind_relaxes = 1", "blind_relaxes"),
        ("lowest = 9.0", "lowest = 5.0", "6 to 60 V"),
        ("highest = 16.0", "highest = 10.0", "1.2 times the lowest to 60 V"),
        ("[limits]", "[limit]", "limit"),
        ("zero = 0 ", "zero = 16384 ", "0 to 16383"),
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0, -1.0]]", "rotation"),
        ("torque_constant = 0.2", "torque_constant = nan", "torque constant"),
    ] {
        bench.write("bad.toml", nominal.replacen(from, to, 1).as_bytes());
        node(&["--calibration", "bad.toml"], &[word]);
    }
    node(&["--calibration", "none.toml"], &["cannot read the calibration none.toml"]);
    node(&["--robot", "none.toml"], &["none.toml"]);

    let image_at = |bytes: &[u8], words: &[&str]| {
        bench.write("other.elf", bytes);
        refuse(bench.path(), &["flash", "--dry-run", "--node", "0", "--image", "other.elf"], words);
    };
    // The emulated board's image begins at 0; one that is too long would reach into the policy.
    image_at(&arm_image(0), &["not for this board", "0x08000000"]);
    image_at(&arm_image(POLICY_ADDRESS - 8), &["not for this board"]);
    image_at(b"", &["no ARM program"]);
    image_at(&arm_image(FLASH_ADDRESS)[..70], &["no ARM program"]);
    let mut x86 = arm_image(FLASH_ADDRESS);
    x86[18] = 3;
    image_at(&x86, &["no ARM program"]);
    refuse(bench.path(), &["flash", "--dry-run", "--node", "0"], &["there is no image", "cargo image-stm32g474"]);
    refuse(bench.path(), &["flash", "--node", "0", "--image", "module.elf", "--out", "x"], &["--dry-run"]);
    assert!(!bench.path().join("module").exists(), "nothing was written");
}

#[test]
fn a_key_and_a_signed_policy_come_to_their_places() {
    let bench = Bench::new();
    succeed(bench.path(), &["key", "new", "lab"]);
    succeed(bench.path(), &["sign", "tube-crossing", "--key", "lab", "--counter", "9", "-o", "tube.signed"]);
    let output = bench.flash(&["--policy", "tube.signed", "--key", "lab.pub"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(bench.read("tools/policy.bin.written"), bench.read("tube.signed"));
    assert_eq!(bench.read("tools/records.bin.written"), of_new_module(9));
    let page = NodePage::parse(&bench.read("tools/node-page.bin.written")).unwrap();
    let digits: String = page.keys[0].iter().map(|byte| format!("{byte:02x}")).collect();
    assert!(String::from_utf8(bench.read("lab.pub")).unwrap().contains(&digits));
    assert_eq!(page.keys[1], [0; 32]);
    let complaint = bench.complaint(&bench.flash(&["--key", "lab"]));
    assert!(complaint.contains("lab is a secret key") && complaint.contains("lab.pub"), "{complaint}");
    let complaint = bench.complaint(&bench.flash(&["--key", "lab.pub", "--key", "lab.pub", "--key", "lab.pub"]));
    assert!(complaint.contains("room for two keys"), "{complaint}");
}
