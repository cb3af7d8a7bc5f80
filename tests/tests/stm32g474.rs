//! The image of the board stm32g474, as `cargo image-stm32g474` links it: what can be seen without the chip.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use composer_firmware::memory_map::FLASH_ADDRESS;
use object::{Object, ObjectSection, ObjectSymbol};

/// Builds the image and returns where it lies.
fn build() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo).current_dir(root).arg("image-stm32g474").output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}\nflip-link missing? `cargo install flip-link --locked --version 0.1.12`");
    assert!(!said.contains("warning"), "{said}");
    root.join(composer_host::flash::IMAGE)
}

#[test]
fn the_linked_image_fits_the_board() {
    let path = build();
    let bytes = std::fs::read(&path).unwrap();
    let elf = object::File::parse(&*bytes).unwrap();
    let symbols: BTreeMap<_, _> = elf.symbols().filter_map(|s| Some((s.name().ok()?, s.address()))).collect();

    // Every byte lies in the region for code; policy and node page are left to `snakectl flash`.
    composer_host::flash::check_image(&path).unwrap();

    // The vectors: initial stack pointer, reset, and the interrupts that this board uses (numbers of RM0440, table 102).
    let vectors = elf.section_by_name(".vector_table").unwrap();
    assert_eq!(vectors.address(), u64::from(FLASH_ADDRESS));
    let vectors: Vec<u64> =
        vectors.data().unwrap().as_chunks().0.iter().map(|w| u64::from(u32::from_le_bytes(*w))).collect();
    let default = symbols["DefaultHandler"] | 1;
    assert_eq!((vectors[0], vectors[1]), (symbols["_stack_start"], symbols["Reset"] | 1));
    for (number, name) in [(18, "ADC1_2"), (21, "FDCAN1_IT0"), (22, "FDCAN1_IT1"), (28, "TIM2")] {
        assert_eq!(vectors[16 + number], symbols[name] | 1, "{name}");
        assert_ne!(vectors[16 + number], default, "{name}");
    }
    assert!(vectors.iter().enumerate().skip(16).filter(|(_, vector)| **vector == default).count() > 90, "all others");

    // flip-link: the stack at the start of the RAM, the variables above it.
    assert!(symbols["_stack_start"] <= symbols["__sdata"]);
    assert!(symbols["_stack_start"] > 0x2000_0000 + 16 * 1024, "not much is left for the stack");

    // The log is formatted on the host: its strings are not in the flash, and nothing here formats a float.
    assert!(elf.section_by_name(".defmt").is_some_and(|section| section.size() > 0));
    let formatting: Vec<_> =
        symbols.keys().filter(|name| name.contains("flt2dec") || name.contains("float_to_")).collect();
    assert!(formatting.is_empty(), "{formatting:?}");
}
