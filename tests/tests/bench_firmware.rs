//! `snakectl bench firmware`: the instructions that the README states, within bounds.

#[path = "common/arm.rs"]
#[allow(dead_code)] // The command under test runs the emulator.
mod arm;
mod common;

use common::{json, refuse, succeed};
use composer_firmware::budget::{MEMORY_INSTRUCTIONS, step_instructions};

#[test]
fn the_kernels_are_as_fast_as_promised() {
    let folder = tempfile::tempdir().unwrap();
    let image = arm::image("composer-qemu-bench", "board-qemu");
    let image = image.to_str().unwrap();
    let counts = json(folder.path(), &["bench", "firmware", "--json", "--image", image]);
    let count = |name: &str| counts[name].as_f64().unwrap_or_else(|| panic!("{name} is missing in {counts}"));
    assert!(64.0 * 64.0 / count("dense64/dsp") >= 0.60, "{counts}");
    assert!(count("dense64/portable") > 2.0 * count("dense64/dsp"), "{counts}");
    // What the simulator takes for the time of a control step is what the microcontroller needs, and little more.
    for modules in [8, 16, 32, 64] {
        let (longest, budget) = (count(&format!("control_step/{modules}/max")), f64::from(step_instructions(modules)));
        assert!((0.8 * budget..=budget).contains(&longest), "{modules} modules: {longest} of {budget} instructions");
        // With a memory, a bias by distance and the whole observation.
        let (longest, budget) =
            (count(&format!("control_step_memory/{modules}/max")), budget + f64::from(MEMORY_INSTRUCTIONS));
        assert!((0.8 * budget..=budget).contains(&longest), "{modules} modules: {longest} of {budget} instructions");
        assert!(modules > 8 || longest <= 90_000.0, "{longest}");
    }
    // A new policy is checked in steps that the watchdog allows.
    let budgets: toml::Table = toml::from_str(include_str!("../../firmware/budgets.toml")).unwrap();
    let images = budgets["image"].as_array().unwrap();
    let bench = images.iter().find(|image| image["program"].as_str() == Some("composer-qemu-bench")).unwrap();
    for (name, budget) in [("update/signature", "signature_instructions"), ("update/kilobyte", "kilobyte_instructions")]
    {
        let limit = bench[budget].as_integer().unwrap() as f64;
        assert!((0.5 * limit..=limit).contains(&count(name)), "{name}: {} of {limit}", count(name));
    }
    let table = succeed(folder.path(), &["bench", "firmware", "--image", image]);
    for line in ["attention over 64 modules", "with the DSP extension", "framing, LATENT parsed", "1.5 cycles/insn"] {
        assert!(table.contains(line), "{table}");
    }
}

#[test]
fn what_cannot_count_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    refuse(folder.path(), &["bench", "firmware", "--image", "nothing"], &["no image", "nothing", "cargo qemu-bench"]);
    std::fs::write(folder.path().join("noise"), [0x5a; 100]).unwrap();
    refuse(folder.path(), &["bench", "firmware", "--image", "noise"], &["noise", "failed"]);
    // The image that compares finds nothing to compare, and says so.
    let image = arm::image("composer-qemu-vectors", "board-qemu");
    refuse(folder.path(), &["bench", "firmware", "--image", image.to_str().unwrap()], &["no file of cases"]);
}
